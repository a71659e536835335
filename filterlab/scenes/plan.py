"""What a scene will take: derived from the very frame that `render` would run, and from a small part of it that is run.

scene ──▶ Prepared ──▶ Frame (dvr.prepare) ──▶ rays, segments, derivative order, marcher
                           │
                           └─ some of the rays, marched ──▶ time;   their segments in empty bricks ──▶ what is skipped
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from filterlab.costs import Quartiles, coefficient_bytes
from filterlab.fields.base import Field
from filterlab.fields.grid import GridField
from filterlab.methods import METHODS
from filterlab.ops.march import Chords
from filterlab.ops.reference.march import segments
from filterlab.render.dvr import Frame
from filterlab.render.fused import FusedMarcher, empty_bricks, why_not_fused
from filterlab.render.plain import Medium
from filterlab.scenes.build import AnyPrepared, Cast, Prepared, PreparedSlim, PreparedSurface
from filterlab.scenes.model import Scene
from filterlab.scenes.shown import Shown
from filterlab.scenes.values import PreparedProjection, PreparedValues, samples_of
from filterlab.surfaces.meshes import BYTES_OF_TRIANGLE, NODE_BYTES, Grid, mesh

_PROBE_RAYS = 4096
_PROBE_SEGMENTS = 1 << 21
_PROBE_NODES = 1 << 17
_REPEATS = 5
_BALL_BYTES, _PLANE_BYTES = 188, 32  # of an index and what is in it (`surfaces.Slim`)
_DERIVATIVES = ("values", "values and gradients", "values, gradients and Hessians")


@dataclass(frozen=True)
class Plan:
    """What rendering a scene takes.

    Attributes:
        method, scheme, storage: of the field; the method of a signal that is not sampled is `exact`.
        taps: coefficients that one value needs; None where there are none.
        order: the highest derivative that is asked of the field: 1 with lighting, else 0.
        marcher: fused or plain.
        not_fused: why the marcher is plain.
        rays, samples: of the whole image; samples before any is skipped or left out behind what is opaque.
        empty_bricks: which part of the bricks has no opacity; None: no brick is known, as none is looked for.
        skipped: which part of the samples lies in them.
        step: in voxels.
        volume_bytes, coefficient_bytes, image_bytes, ray_bytes: memory; rays are those that are in work or kept.
        seconds: of the march, from the median and the quartiles of a few runs of some rays.
        absent: what the scene leaves out and is therefore not computed.
        chosen: how `method: auto` came to its choice, or nothing.
    """

    method: str
    scheme: str
    storage: str
    taps: int | None
    order: int
    marcher: str
    not_fused: str | None
    rays: int
    samples: int
    empty_bricks: float | None
    skipped: float | None
    step: float
    volume_bytes: int
    coefficient_bytes: int
    image_bytes: int
    ray_bytes: int
    seconds: Quartiles
    absent: tuple[str, ...]
    chosen: tuple[str, ...] = ()

    @property
    def derivatives(self) -> str:
        """The order in words."""
        return _DERIVATIVES[self.order]

    def data(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


@dataclass(frozen=True)
class SurfacePlan:
    """What casting rays at the surface of a scene takes.

    Attributes:
        method, scheme, storage, taps: as in `Plan`.
        level: the value on the surface.
        degree: of the field's pieces along a ray.
        cells, pieces: how many of the volume may hold the level; no others are looked into.
        order: derivatives of the surface that its material needs: 1 normals, 2 curvatures.
        rays: of the whole image, without those to lights.
        volume_bytes, coefficient_bytes, image_bytes: memory.
        seconds: from the median and the quartiles of a few runs of some rays.
        absent, chosen: as in `Plan`.
    """

    method: str
    scheme: str
    storage: str
    taps: int | None
    level: float
    degree: int
    cells: int
    pieces: int
    order: int
    rays: int
    volume_bytes: int
    coefficient_bytes: int
    image_bytes: int
    seconds: Quartiles
    absent: tuple[str, ...]
    chosen: tuple[str, ...] = ()

    def data(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


@dataclass(frozen=True)
class ValuePlan:
    """What a picture of values takes: a maximum intensity projection, or a slice.

    Attributes:
        method, scheme, storage, taps: as in `Plan`.
        kind: which of both.
        rays, samples: of the whole image; of a slice one sample a ray at most.
        step: of a projection, in voxels.
        volume_bytes, coefficient_bytes, image_bytes, work_bytes: memory; work is what is looked at together, at most.
        seconds: of all rays, from the median and the quartiles of a few runs of some.
        absent, chosen: as in `Plan`.
    """

    method: str
    scheme: str
    storage: str
    taps: int | None
    kind: str
    rays: int
    samples: int
    step: float | None
    volume_bytes: int
    coefficient_bytes: int
    image_bytes: int
    work_bytes: int
    seconds: Quartiles
    absent: tuple[str, ...]
    chosen: tuple[str, ...] = ()

    def data(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


@dataclass(frozen=True)
class MeshPlan:
    """What making triangles of the surface of a scene takes.

    Attributes:
        method, scheme, storage, taps, level: as in `SurfacePlan`.
        step: of the grid, in voxels.
        size: points of the grid along x, y, z.
        triangles: about; from those on a coarser grid.
        residual: the largest |f − level| at a vertex there.
        volume_bytes, coefficient_bytes, grid_bytes, mesh_bytes: memory; of the grid what is looked at together.
        seconds: from a few runs on a coarser grid, as if all of it grew as the grid does: at most that.
        chosen: as in `Plan`.
    """

    method: str
    scheme: str
    storage: str
    taps: int | None
    level: float
    step: float
    size: tuple[int, int, int]
    triangles: int
    residual: float
    volume_bytes: int
    coefficient_bytes: int
    grid_bytes: int
    mesh_bytes: int
    seconds: Quartiles
    chosen: tuple[str, ...] = ()

    def data(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


@dataclass(frozen=True)
class SlimPlan:
    """What casting rays at a SLIM surface takes.

    Attributes:
        balls: of the cover. cuts: planes that some of them are cut by, for each.
        order, rays, image_bytes, seconds, absent: as in `SurfacePlan`.
        cover_bytes: memory of its numbers and their index.
        chosen: nothing.
    """

    balls: int
    cuts: int
    order: int
    rays: int
    cover_bytes: int
    image_bytes: int
    seconds: Quartiles
    absent: tuple[str, ...]
    chosen: tuple[str, ...] = ()

    def data(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


AnyPlan = Plan | SurfacePlan | SlimPlan | ValuePlan


def plan_of_mesh(prepared: PreparedSurface, step: float) -> MeshPlan:
    """The plan of the mesh of a scene that is built; a coarser one is made, a few times."""
    surface, domain = prepared.surface, prepared.surface.domain
    grid = Grid.of(domain, step, surface.device)
    coarser = max(1.0, (math.prod(grid.size) / _PROBE_NODES) ** (1 / 3))
    probe = Grid.of(domain, step * coarser, surface.device)
    made = mesh(surface, step * coarser)
    share = math.prod(probe.size) / math.prod(grid.size)
    triangles = round(len(made.faces) * coarser**2)
    nx, ny, nz = grid.size
    return MeshPlan(
        **_described(prepared.field),
        level=float(surface.level),
        step=step,
        size=grid.size,
        triangles=triangles,
        residual=made.residual,
        volume_bytes=prepared.volume_bytes,
        coefficient_bytes=coefficient_bytes(prepared.field),
        grid_bytes=NODE_BYTES * nx * ny * (min(grid.layers_at_once, nz - 1) + 1),
        mesh_bytes=triangles * BYTES_OF_TRIANGLE,
        seconds=_timed(lambda: mesh(surface, step * coarser).vertices, share),
        chosen=prepared.chosen,
    )


def plan(prepared: AnyPrepared) -> AnyPlan:
    """The plan of a scene that is built; some of its rays are followed, the picture is not made.

    Takes as long as a few thousand rays do, five times over.
    """
    if isinstance(prepared, PreparedValues):
        return _plan_of_values(prepared)
    if isinstance(prepared, PreparedSlim):
        return _plan_of_slim(prepared)
    return _plan_of_surface(prepared) if isinstance(prepared, PreparedSurface) else _plan_of_medium(prepared)


def _plan_of_values(prepared: PreparedValues) -> ValuePlan:
    (width, height), scene = prepared.size, prepared.scene
    projected = isinstance(prepared, PreparedProjection)
    return ValuePlan(
        **_described(prepared.field),
        kind="maximum along every ray" if projected else "slice",
        rays=width * height,
        samples=samples_of(prepared) if isinstance(prepared, PreparedProjection) else width * height,
        step=scene.step_or_default if projected else None,
        volume_bytes=prepared.volume_bytes,
        coefficient_bytes=coefficient_bytes(prepared.field),
        image_bytes=width * height * 5 * scene.dtype.itemsize,
        work_bytes=prepared.work_bytes,
        seconds=_seconds_of_a_smaller(prepared, width * height),
        absent=_absent_of_values(scene),
        chosen=prepared.chosen,
    )


def _absent_of_values(scene: Scene) -> tuple[str, ...]:
    return () if scene.region is not None else ("region: rays are cut to the volume only",)


def _plan_of_surface(prepared: PreparedSurface) -> SurfacePlan:
    field, scene = prepared.field, prepared.scene
    assert scene.surface is not None
    relevant, (width, height) = prepared.surface.relevant(), prepared.size
    rays = width * height * scene.surface.subpixels**2
    return SurfacePlan(
        **_described(field),
        level=float(prepared.surface.level),
        degree=field.degree_along_rays or 0,
        cells=relevant.cells,
        pieces=relevant.pieces,
        order=prepared.material.order,
        rays=rays,
        volume_bytes=prepared.volume_bytes,
        coefficient_bytes=coefficient_bytes(field),
        image_bytes=width * height * 4 * scene.dtype.itemsize,
        seconds=_seconds_of_surface(prepared, rays),
        absent=_absent_of_surface(scene),
        chosen=prepared.chosen,
    )


def _plan_of_slim(prepared: PreparedSlim) -> SlimPlan:
    scene, slim, (width, height) = prepared.scene, prepared.surface, prepared.size
    assert scene.surface is not None
    rays, cuts = width * height * scene.surface.subpixels**2, 0 if slim.cuts is None else slim.cuts.shape[1]
    numbers = sum(x.nbytes for x in slim.tensors) + (0 if slim.cuts is None else slim.cuts.nbytes)
    return SlimPlan(
        balls=len(slim),
        cuts=cuts,
        order=prepared.material.order,
        rays=rays,
        cover_bytes=numbers + len(slim) * (_BALL_BYTES + _PLANE_BYTES * cuts),
        image_bytes=width * height * 4 * scene.dtype.itemsize,
        seconds=_seconds_of_surface(prepared, rays),
        absent=_absent_of_surface(scene),
    )


def _seconds_of_surface(prepared: Cast, rays: int) -> Quartiles:
    """Of all rays, from one for each pixel of a smaller picture."""
    scene = prepared.scene.model_copy(
        update={"surface": prepared.scene.surface.model_copy(update={"subpixels": 1})}  # type: ignore[union-attr]
    )
    return _seconds_of_a_smaller(replace(prepared, scene=scene), rays)


def _seconds_of_a_smaller(prepared: Shown, rays: int) -> Quartiles:
    """Of all rays, from a smaller picture of the same view."""
    width, height = prepared.size
    scale = min(1.0, (_PROBE_RAYS / (width * height)) ** 0.5)
    small = max(round(width * scale), 1), max(round(height * scale), 1)
    return _timed(replace(prepared, size=small).render, small[0] * small[1] / rays)


def _timed(run: Callable[[], Tensor], share: float) -> Quartiles:
    """Seconds of everything, from runs of a share of it; the first run, which compiles, does not count."""
    taken = []
    for _ in range(_REPEATS + 1):
        start = time.perf_counter()
        found = run()
        if found.device.type == "cuda":
            torch.cuda.synchronize(found.device)
        taken.append((time.perf_counter() - start) / share)
    return Quartiles.of(taken[1:])


def _described(field: Field) -> dict[str, Any]:
    """Method, scheme, storage and taps of a field."""
    known = isinstance(field, GridField)
    return {
        "method": field.method if known else "exact",
        "scheme": field.scheme.name,
        "storage": str(field.coefficients.values.dtype).removeprefix("torch.") if known else "–",
        "taps": METHODS[field.method].facts.taps if known and field.method in METHODS else None,
    }


def _plan_of_medium(prepared: Prepared) -> Plan:
    frame = prepared.frame()
    medium, some = frame.media[0], _some_rays(frame)
    seconds = _seconds(frame, medium, some)
    empty, skipped = _skipped(frame, medium, some)
    field = prepared.field
    return Plan(
        **_described(field),
        order=medium.order,
        marcher="fused" if isinstance(frame.marcher, FusedMarcher) else "plain",
        not_fused=why_not_fused(medium),
        rays=frame.pixels,
        samples=frame.samples,
        empty_bricks=empty,
        skipped=skipped,
        step=prepared.scene.step_or_default,
        volume_bytes=prepared.volume_bytes,
        coefficient_bytes=coefficient_bytes(field),
        image_bytes=frame.image_bytes,
        ray_bytes=frame.ray_bytes,
        seconds=seconds,
        absent=_absent(prepared.scene),
        chosen=prepared.chosen,
    )


def _some_rays(frame: Frame) -> Chords:
    """Every k-th ray, so many that a few thousand rays or a few million segments are marched."""
    fewest = max(frame.samples // _PROBE_SEGMENTS, frame.pixels // _PROBE_RAYS, 1)
    first = fewest // 2
    device = frame.media[0].transfer.positions.device
    return frame.chords(torch.arange(min(first, frame.pixels - 1), frame.pixels, fewest, device=device))


def _seconds(frame: Frame, medium: Medium, some: Chords) -> Quartiles:
    """Of all rays of all images, from runs of some."""
    share = len(some.count) / (frame.pixels * len(frame.media))
    return _timed(lambda: frame.marcher.march(medium, some, lambda done: None)[0], share)


def _skipped(frame: Frame, medium: Medium, some: Chords) -> tuple[float | None, float | None]:
    """(part of the bricks that is empty, part of the segments of some rays whose middles lie in them)."""
    if not isinstance(frame.marcher, FusedMarcher):
        return None, None
    found = empty_bricks(medium)
    if found is None:
        return 0.0, 0.0
    empty = found.bricks.distance > 0
    longest = int(some.count.max()) if len(some.count) else 0
    inside = total = 0
    for first in range(0, longest, 64):
        middle, _ = segments(some.length, medium.step, first, 64, some.offset)
        real = torch.arange(first, first + 64, device=middle.device) < some.count[:, None]
        points = some.entry[:, None] + middle[..., None] * some.direction[:, None]
        inside += int(found.empty(points[real]).sum())
        total += int(real.sum())
    return float(empty.double().mean()), inside / max(total, 1)


def _absent_of_surface(scene: Scene) -> tuple[str, ...]:
    """What is not computed of a surface, because the scene does not ask for it."""
    asked = scene.surface
    assert asked is not None
    parts = []
    if asked.sheets == 1:
        parts.append("sheets behind the first")
    if not asked.shadows:
        parts.append("shadows")
    if scene.region is None:
        parts.append("region: rays are cut to the volume only")
    if asked.subpixels == 1:
        parts.append("subpixels: one ray for each pixel")
    return tuple(parts)


def _absent(scene: Scene) -> tuple[str, ...]:
    """What is not computed, because the scene does not ask for it."""
    parts = []
    if scene.lighting is None:
        parts.append("lighting: no gradient is computed")
    if scene.region is None:
        parts.append("region: rays are cut to the volume only")
    if scene.jitter is None:
        parts.append("jitter")
    if scene.termination is None:
        parts.append("termination: rays end only behind what is exactly opaque")
    return tuple(parts)
