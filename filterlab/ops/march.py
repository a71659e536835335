"""The fused march: rays through coefficients, a transfer function and lights, to light and optical depth.

Everything is prepared by the caller as plain tensors: rays cut to the volume, in coordinates of the coefficients; the
tables of the transfer function; lights and halfway vectors of every ray. `ops.cpu.march` is the program, on a GPU
`ops.cuda.march` and `ops.cuda.adjoint`. No derivatives are recorded here: `March.adjoint` computes them from what
`March.run` gave.

Memory beyond the result: 48 bytes per interval of the transfer function and 32 per bucket (at most 4096) in float32;
for the adjoint 8 · (9 + 12 K) bytes per ray, K lights, and for derivatives by the coefficients one volume of them per
thread (within `SPLAT_MEMORY`); on a GPU one volume, and 6 KiB per interval of the transfer function.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from filterlab import forking
from filterlab.ops import cpu, cuda
from filterlab.ops.autograd import differentiating
from filterlab.ops.derivatives import GRADIENTS, TABLE_ROW, by_name, columns_of_rays
from filterlab.ops.fused import STORAGE
from filterlab.ops.stencil import Stencil

if TYPE_CHECKING:
    from filterlab.ops.cpu.march import Job

MAX_LIGHTS = 8
RAYS_AT_ONCE = 1 << 13  # then progress is reported, and Ctrl-C heard

_FEWEST_BUCKETED = 16  # inner control points; fewer are compared one by one
_MOST_BUCKETS = 1 << 12
_DARK = {torch.float32: 104.5, torch.float64: 746.0}  # optical depth from where e^−τ is 0
_SLACK = {torch.float32: 2.0**-21, torch.float64: 2.0**-50}  # rounding of a point, relative to the coordinates


@dataclass(frozen=True)
class Rays:
    """R rays inside the volume: points entry + t direction, 0 ≤ t ≤ length.

    Attributes:
        entry, direction: (R, 3) float64, in coordinates of the coefficients; the direction per world length.
        length: (R,) float64, world lengths.
        offset: (R,) float64: how far into a step the first segment reaches.
        count: (R,) int64, segments.
    """

    entry: Tensor
    direction: Tensor
    length: Tensor
    offset: Tensor
    count: Tensor


@dataclass(frozen=True)
class Transfer:
    """M control points: positions (M,), colors (M, 3), opacities (M,) per `unit` world length."""

    positions: Tensor
    colors: Tensor
    opacities: Tensor
    unit: float

    @cached_property
    def steps(self) -> Steps | None:
        """Of control points at equal steps, or of buckets; None where comparing with every control point is as fast."""
        positions = self.positions.detach()
        return _equal_steps(positions) or _buckets(positions, self.opacities.detach())


@dataclass(frozen=True)
class Steps:
    """Value v is in step (v − low) · scale, rounded down, between the first and the last.

    Attributes:
        low, scale: numbers of the dtype of the positions.
        count: how many steps there are.
        buckets: (count, 8), see `ops.cpu.optics`; None: the steps are the intervals between control points.
    """

    low: float
    scale: float
    count: int
    buckets: Tensor | None = None


@dataclass(frozen=True)
class Lighting:
    """K lights.

    Attributes:
        ambient, shininess: numbers, ().
        diffuse, specular: (K, 3) colours, times the weights of either kind of reflection.
        toward, halfway: (R, K, 3) unit vectors l and h in the world.
        world: (3, 3): gradient in the world = gradient by coordinates of the coefficients · world.
    """

    ambient: Tensor
    shininess: Tensor
    diffuse: Tensor
    specular: Tensor
    toward: Tensor
    halfway: Tensor
    world: Tensor

    @property
    def lights(self) -> int:
        return self.diffuse.shape[0]


@dataclass(frozen=True)
class Bricks:
    """Bricks of 2^edge cells along each axis; a point's cell is its first tap, counted from coefficient 0.

    Attributes:
        distance: (bz, by, bx) uint8: to the nearest brick that is not empty, in bricks along the axis where it is
            farthest; `render.bricks` tells no more than 15 apart.
    """

    distance: Tensor
    edge: int


def missing(coefficients: Tensor, stencil: Stencil, start: int, dtype: torch.dtype, lights: int) -> str | None:
    """What keeps the march from running here as asked; None: nothing does.

    Args:
        coefficients: (D, H, W).
        stencil: value, and gradient when lit.
        start: the coordinate of coefficient 0.
        dtype: of the samples.
        lights: K.
    """
    if lights > MAX_LIGHTS:
        return f"up to {MAX_LIGHTS} lights; got {lights}"
    points = torch.empty(1, 0, 3, dtype=dtype, device=coefficients.device)
    implementation = cuda if on_gpu(coefficients) else cpu
    return implementation.missing(coefficients.detach()[None, None], points, stencil, None, start)


def on_gpu(tensor: Tensor) -> bool:
    """Whether rays through these coefficients are marched by the Triton programs."""
    return tensor.device.type == "cuda"


@dataclass(frozen=True)
class March:
    """A march and its adjoint. Tensors are in one dtype, float32 or float64, but for the rays (float64).

    Attributes:
        coefficients: (D, H, W), of any dtype that `ops.cpu` reads.
        start: the coordinate of coefficient 0.
        stencil: its rows are the value, and with lights the gradient.
        rays, transfer, lighting: see there; lighting None: unlit.
        step: world length of a segment.
        faint: transmittance below which a ray ends; 0: where nothing passes any more.
        bricks: which parts of the volume are empty; None: not known.
    """

    coefficients: Tensor
    start: int
    stencil: Stencil
    rays: Rays
    transfer: Transfer
    lighting: Lighting | None
    step: float
    faint: float = 0.0
    bricks: Bricks | None = None

    @property
    def dtype(self) -> torch.dtype:
        return self.transfer.positions.dtype

    @property
    def opaque(self) -> float:
        """Optical depth beyond which a ray ends."""
        return min(_DARK[self.dtype], -math.log(self.faint) if self.faint > 0 else math.inf)

    @property
    def slack(self) -> float:
        """By how much a point may be rounded, in voxels."""
        return _SLACK[self.dtype] * (abs(self.start) + max(self.coefficients.shape))

    @cached_property
    def _readable(self) -> Tensor:
        """The coefficients as they are read."""
        return self.coefficients.detach().resolve_neg().contiguous()

    @differentiating(False)
    def run(self, report: Callable[[int], None] = lambda rays: None) -> tuple[Tensor, Tensor]:
        """Light (R, 3) and optical depth (R,), float64. `report` is given the number of rays done, now and then."""
        if on_gpu(self.coefficients):
            from filterlab.ops.cuda import march

            return march.run(self, report)
        rays = self.rays.count.shape[0]
        light = torch.zeros(rays, 3, dtype=torch.float64)
        depth = torch.zeros(rays, dtype=torch.float64)
        if rays:
            job = self._job((), light=light, depth=depth)
            self._launch((), job, report)
        return light, depth

    @differentiating(False)
    def adjoint(
        self,
        light: Tensor,
        light_cotangent: Tensor,
        depth_cotangent: Tensor,
        wanted: Collection[str],
        report: Callable[[int], None] = lambda rays: None,
    ) -> dict[str, Tensor]:
        """Derivatives of Σ light · its cotangent + Σ depth · its cotangent.

        Args:
            light: what `run` gave, (R, 3).
            light_cotangent, depth_cotangent: (R, 3) and (R,), float64.
            wanted: some of "coefficients", "rays", "table", "shading".
            report: as for `run`.

        Returns:
            by name, in the shapes of what they belong to: for "coefficients" coefficients; for "rays" entry, direction,
            length; for "table" positions, colors, opacities; for "shading" ambient, shininess, diffuse, specular,
            toward, halfway. Float64 but for the coefficients' (the dtype of the march).

        On the CPU the same bits for one number of threads: every thread has rays of its own and adds into partial
        results of its own, which are summed in order. Those by rays and shading do not depend on the threads at all. On
        a GPU those by coefficients and table are added atomically, and repeat themselves up to rounding only.
        """
        gradients = tuple(name for name in GRADIENTS if name in wanted)
        arrays = {"light": light, "light_cotangent": light_cotangent, "depth_cotangent": depth_cotangent}
        if on_gpu(self.coefficients):
            from filterlab.ops.cuda import adjoint

            return adjoint.run(self, gradients, arrays, report)
        from filterlab.ops.cpu.march import TABLES

        lights = self.lighting.lights if self.lighting else None
        rays, intervals = self.rays.count.shape[0], max(len(self.transfer.positions) - 1, 1)
        threads = self._threads_of_adjoint("coefficients" in gradients)
        by_ray = torch.zeros(rays, columns_of_rays(lights), dtype=torch.float64)
        tables = torch.zeros(threads, TABLES, intervals, TABLE_ROW, dtype=torch.float64)
        volumes = []
        if "coefficients" in gradients:
            volumes = [cpu._zeros((1, *self.coefficients.shape), self.dtype)[0] for _ in range(threads)]
        if rays:
            job = self._job(gradients, ray_gradient=by_ray, **arrays)
            own = [job.copy() for _ in range(threads)]
            for i, one in enumerate(own):
                one.point(table_gradient=tables[i])
                if volumes:
                    one.point(coefficient_gradient=volumes[i])
            self._launch_parts(gradients, own, report)
        for part in volumes[1:]:
            volumes[0] += part
        volume = volumes[0] if volumes else None
        return by_name(gradients, volume, by_ray, tables.sum((0, 1)), len(self.transfer.positions), lights)

    def _threads_of_adjoint(self, with_volumes: bool) -> int:
        """One for every so many rays, and no more volumes of derivatives than memory allows."""
        from filterlab.ops.cpu.traversal import RAYS_OF_A_BLOCK

        threads = max(1, min(torch.get_num_threads(), self.rays.count.shape[0] // RAYS_OF_A_BLOCK))
        if with_volumes:
            threads = min(threads, 1 + cpu.SPLAT_MEMORY // (self.coefficients.numel() * self.dtype.itemsize))
        return threads

    # --- jobs ---

    def _job(self, gradients: tuple[str, ...], **arrays: Tensor) -> Job:
        with forking.lock:
            from filterlab.ops.cpu import march

        d, h, w = self.coefficients.shape
        job = march.Job(
            width=w,
            height=h,
            start=self.start,
            step=self.step,
            per_unit=1 / self.transfer.unit,
            faint=self.faint,
            opaque=self.opaque,
        )
        for axis, size, support in zip(march.AXES, (w, h, d), self.stencil.supports, strict=True):
            setattr(job, f"low_{axis}", self.start)
            setattr(job, f"high_{axis}", self.start + size - support)
        job.intervals = max(len(self.transfer.positions) - 1, 1)
        inputs = {
            "coefficients": self._readable,
            **{name: getattr(self.rays, name) for name in ("entry", "direction", "length", "offset", "count")},
            **_tables(self.transfer),
            **(self._lit() if self.lighting else {}),
            **arrays,
        }
        if (steps := self.transfer.steps) is not None:
            job.steps_low, job.steps_scale, job.steps_last = steps.low, steps.scale, steps.count - 1
            if steps.buckets is not None:
                inputs["buckets"] = steps.buckets
        if self.bricks is not None:
            inputs["bricks"] = self.bricks.distance
            job.edge = self.bricks.edge
            job.slack = self.slack
            for axis, count in zip(march.AXES, self.bricks.distance.shape[::-1], strict=True):
                setattr(job, f"bricks_{axis}", count)
        job.point(**{name: tensor.detach().resolve_neg().contiguous() for name, tensor in inputs.items()})
        return job

    def _lit(self) -> dict[str, Tensor]:
        s = self.lighting
        assert s is not None
        numbers = torch.stack((s.ambient, s.shininess))
        tints = torch.stack((s.diffuse, s.specular), 1).reshape(-1)
        view = torch.stack((s.toward, s.halfway), 2)
        return {"shading": torch.cat((numbers, tints)), "view": view, "world": s.world}

    def _launch(self, gradients: tuple[str, ...], job: Job, report: Callable[[int], None]) -> None:
        """Let the threads loose on one portion of the rays after the other."""
        from filterlab.ops.cpu import compiler
        from filterlab.ops.cpu import threads as pool
        from filterlab.ops.cpu.traversal import RAYS_OF_A_BLOCK

        function = compiler.compiled(self._recipe(gradients))
        rays = self.rays.count.shape[0]
        for first in range(0, rays, RAYS_AT_ONCE):
            job.first, job.last = first, min(first + RAYS_AT_ONCE, rays)
            job.stride = job.chunks = -(-(job.last - first) // RAYS_OF_A_BLOCK)
            job.next = 0
            pool.run(function, [job] * max(1, min(torch.get_num_threads(), job.chunks)))
            report(job.last)

    def _launch_parts(self, gradients: tuple[str, ...], jobs: list[Job], report: Callable[[int], None]) -> None:
        """The same with a job for every thread: thread i takes blocks i, i + threads, … of the rays."""
        from filterlab.ops.cpu import compiler
        from filterlab.ops.cpu import threads as pool

        function = compiler.compiled(self._recipe(gradients))
        rays = self.rays.count.shape[0]
        for first in range(0, rays, RAYS_AT_ONCE):
            for i, job in enumerate(jobs):
                job.first, job.last = first, min(first + RAYS_AT_ONCE, rays)
                job.next, job.chunks, job.stride = i, i + 1, len(jobs)
            pool.run(function, jobs)
            report(min(first + RAYS_AT_ONCE, rays))

    def _recipe(self, gradients: tuple[str, ...]):
        from filterlab.ops.cpu import compiler
        from filterlab.ops.cpu.march import Recipe

        raised = self.stencil.derivatives if "rays" in gradients else None
        return Recipe(
            gradients,
            self.stencil.lowered,
            None if raised is None else (raised[0].lowered, raised[1]),
            self.lighting is not None,
            self.lighting.lights if self.lighting else 0,
            self.bricks is not None,
            _way_to_intervals(self.transfer.steps),
            cpu._ARITHMETIC[self.dtype],
            STORAGE[self.coefficients.dtype],
            cpu.has_room(self._readable),
            cpu._lanes(compiler.features(), self.dtype.itemsize),
        )


def _way_to_intervals(steps: Steps | None) -> str:
    """One of `ops.cpu.optics.WAYS`."""
    if steps is None:
        return "compared"
    return "even" if steps.buckets is None else "bucketed"


def _equal_steps(x: Tensor) -> Steps | None:
    """The intervals, if every control point starts its own step exactly, as computed in its dtype.

    Rounding is monotonic, so that no value lands on the wrong side of a control point then.
    """
    count = len(x) - 1
    if count < 1:
        return None
    scale = (count / (x[-1].double() - x[0].double())).to(x.dtype)
    if not torch.equal((x - x[0]) * scale, torch.arange(count + 1, dtype=x.dtype)):
        return None
    return Steps(float(x[0]), float(scale), count)


def _buckets(x: Tensor, alpha: Tensor) -> Steps | None:
    """As few buckets as have no more than one inner control point each, at most `_MOST_BUCKETS`."""
    inner = x[1:-1]
    if len(inner) < _FEWEST_BUCKETED:
        return None
    count = 1 << len(inner).bit_length()
    while count <= _MOST_BUCKETS:
        low, scale = inner[0], (count - 1) / (inner[-1] - inner[0])
        if not 0 < scale < math.inf:
            return None
        own = ((inner - low) * scale).clamp(0, count - 1).long()
        if bool((own.diff() > 0).all()):
            numbers = torch.arange(int(own[-1]) + 1)  # the last one has the last inner control point
            first = torch.searchsorted(own, numbers)  # inner control points before the bucket
            ends = torch.stack([t[(first + k).clamp_max(len(x) - 1)] for t in (x, alpha) for k in range(3)], -1)
            rows = torch.cat((ends[:, :3], first[:, None].to(x.dtype), ends[:, 3:], torch.zeros_like(ends[:, :1])), -1)
            return Steps(float(low), float(scale), len(rows), rows)
        count *= 2
    return None


def _tables(transfer: Transfer) -> dict[str, Tensor]:
    """The rows that the program reads, one per interval. A single control point: an interval without an end."""
    x, rgb, alpha = (t.detach() for t in (transfer.positions, transfer.colors, transfer.opacities))
    if len(x) == 1:
        x = torch.stack((torch.zeros_like(x[0]), torch.full_like(x[0], math.inf)))
        rgb, alpha = rgb.expand(2, 3), alpha.expand(2)
    colors = torch.stack((rgb[:-1], rgb[1:]), -1).reshape(-1, 6)
    return {
        "inner": x[1:-1] if len(x) > 2 else x,
        "opacities": torch.stack((x[:-1], x[1:], alpha[:-1], alpha[1:]), -1),
        "colors": torch.cat((colors, torch.stack((alpha[:-1], alpha[1:]), -1)), -1),
    }
