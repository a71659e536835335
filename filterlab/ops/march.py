"""The march, described: rays through coefficients, a transfer function and lights, to light and optical depth.

Everything is prepared by the caller as plain tensors: rays cut to the volume, in coordinates of the coefficients; the
tables of the transfer function; lights and halfway vectors of every ray. `ops.reference.march` says what is computed,
`ops.cpu.march` and `ops.cuda.march` are the programs, `ops.march_derivatives` how their adjoints lay derivatives out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from torch import Tensor

from filterlab.ops.tetrahedra import AnyStencil

MAX_LIGHTS = 8

_FEWEST_BUCKETED = 16  # inner control points; fewer are compared one by one
_MOST_BUCKETS = 1 << 12
_DARK = {torch.float32: 104.5, torch.float64: 746.0}  # optical depth from where e^−τ is 0
_SLACK = {torch.float32: 2.0**-21, torch.float64: 2.0**-50}  # rounding of a point, relative to the coordinates


@dataclass(frozen=True)
class Chords:
    """The parts of R rays that lie in a volume: points entry + t direction, 0 ≤ t ≤ length.

    Attributes:
        entry, direction: (R, 3) float64; in the world with unit directions, or, for a `March`, in coordinates of the
            coefficients and the direction per world length.
        length: (R,) float64, world lengths; 0 for a ray that misses.
        offset: (R,) float64: how far into a step the first segment reaches, in (0, 1].
        count: (R,) int64, segments.
    """

    entry: Tensor
    direction: Tensor
    length: Tensor
    offset: Tensor
    count: Tensor

    @property
    def nbytes(self) -> int:
        """Memory."""
        return sum(x.nbytes for x in (self.entry, self.direction, self.length, self.offset, self.count))

    def at(self, rays: Tensor) -> Chords:
        """Those of some of the rays."""
        return Chords(*(x[rays] for x in (self.entry, self.direction, self.length, self.offset, self.count)))


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
        return self.even or _buckets(self.positions.detach(), self.opacities.detach())

    @cached_property
    def even(self) -> Steps | None:
        """Of control points at equal steps; None where they are not."""
        return _equal_steps(self.positions.detach())


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

    def at(self, rays: Tensor) -> Lighting:
        """As seen along some of the rays."""
        return replace(self, toward=self.toward[rays], halfway=self.halfway[rays])


@dataclass(frozen=True)
class Bricks:
    """Bricks of 2^edge cells along each axis; a point's cell is its first tap, counted from coefficient 0.

    Attributes:
        distance: (bz, by, bx) uint8: to the nearest brick that is not empty, in bricks along the axis where it is
            farthest; `render.bricks` tells no more than 15 apart.
    """

    distance: Tensor
    edge: int


@dataclass(frozen=True)
class March:
    """A march: what rays go through. Tensors are in one dtype, float32 or float64, but for the rays (float64).

    Attributes:
        coefficients: (D, H, W), of any dtype of `ops.gather.STORAGE`.
        start: the coordinate of coefficient 0.
        stencil: its rows are the value, and with lights the gradient.
        chords, transfer, lighting: see there; lighting None: unlit.
        step: world length of a segment.
        faint: transmittance below which a ray ends; 0: where nothing passes any more.
        bricks: which parts of the volume are empty; None: not known.
    """

    coefficients: Tensor
    start: int
    stencil: AnyStencil
    chords: Chords
    transfer: Transfer
    lighting: Lighting | None
    step: float
    faint: float = 0.0
    bricks: Bricks | None = None

    @property
    def dtype(self) -> torch.dtype:
        return self.transfer.positions.dtype

    @property
    def lights(self) -> int | None:
        """K; None: unlit."""
        return None if self.lighting is None else self.lighting.lights

    @property
    def opaque(self) -> float:
        """Optical depth beyond which a ray ends."""
        return min(_DARK[self.dtype], -math.log(self.faint) if self.faint > 0 else math.inf)

    @property
    def slack(self) -> float:
        """By how much a point may be rounded, in voxels."""
        return _SLACK[self.dtype] * (abs(self.start) + max(self.coefficients.shape))

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Every tensor by its name here or in the parts."""
        parts = (part for part in (self.chords, self.transfer, self.lighting) if part is not None)
        named = {f.name: getattr(part, f.name) for part in parts for f in fields(part)}
        return {"coefficients": self.coefficients} | {k: v for k, v in named.items() if isinstance(v, Tensor)}

    @property
    def inputs(self) -> dict[str, Tensor]:
        """What every program reads: rays as they are, tables of the transfer function and of the lights, bricks."""
        bricks = {} if self.bricks is None else {"bricks": self.bricks.distance}
        lit = {} if self.lighting is None else _lit(self.lighting)
        return vars(self.chords) | _tables(self.transfer) | lit | bricks

    def with_tensors(self, tensors: Mapping[str, Tensor]) -> March:
        """The same with other tensors in place of those of `tensors`."""

        def changed(part):
            return None if part is None else replace(part, **{k: v for k, v in tensors.items() if hasattr(part, k)})

        coefficients = tensors.get("coefficients", self.coefficients)
        parts = {"chords": changed(self.chords), "transfer": changed(self.transfer), "lighting": changed(self.lighting)}
        return replace(self, coefficients=coefficients, **parts)


def _equal_steps(x: Tensor) -> Steps | None:
    """The intervals, if every control point starts its own step exactly, as computed in its dtype.

    Rounding is monotonic, so that no value lands on the wrong side of a control point then.
    """
    count = len(x) - 1
    if count < 1:
        return None
    scale = (count / (x[-1].double() - x[0].double())).to(x.dtype)
    if not torch.equal((x - x[0]) * scale, torch.arange(count + 1, dtype=x.dtype, device=x.device)):
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


def _lit(s: Lighting) -> dict[str, Tensor]:
    """Lights as the programs read them."""
    numbers = torch.stack((s.ambient, s.shininess))
    tints = torch.stack((s.diffuse, s.specular), 1).reshape(-1)
    view = torch.stack((s.toward, s.halfway), 2)
    return {"shading": torch.cat((numbers, tints)), "view": view, "world": s.world}
