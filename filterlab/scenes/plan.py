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
from filterlab.scenes.build import AnyPrepared, Prepared, PreparedSurface
from filterlab.scenes.model import Scene
from filterlab.scenes.shown import Casting, Shown
from filterlab.scenes.shown import OfField as ShownField
from filterlab.scenes.terrain import COMPASS, PreparedTerrain
from filterlab.scenes.values import PreparedProjection, PreparedValues, samples_of
from filterlab.surfaces import Quadrics, Slim
from filterlab.surfaces.meshes import BYTES_OF_TRIANGLE, NODE_BYTES, Grid, mesh

_PROBE_RAYS = 4096
_PROBE_SEGMENTS = 1 << 21
_PROBE_NODES = 1 << 17
_REPEATS = 5
_PIECE_BYTES, _PLANE_BYTES = 188, 32  # of an index and what is in it (`surfaces.Slim`, `surfaces.Quadrics`)
_DERIVATIVES = ("values", "values and gradients", "values, gradients and Hessians")


@dataclass(frozen=True, kw_only=True)
class AnyPlan:
    """What a picture, or whatever else is made of a scene, takes.

    Attributes:
        seconds: from the median and the quartiles of a few runs of a part of it.
        chosen: how `method: auto` came to its choice, or nothing.
    """

    seconds: Quartiles
    chosen: tuple[str, ...] = ()

    def data(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class OfImage(AnyPlan):
    """Of a picture.

    Attributes:
        rays: of the whole image, without those to lights.
        image_bytes: memory.
        absent: what the scene leaves out and is therefore not computed.
    """

    rays: int
    image_bytes: int
    absent: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class OfField(AnyPlan):
    """Of a field.

    Attributes:
        method, scheme, storage: the method of a signal that is not sampled is `exact`.
        taps: coefficients that one value needs; None where there are none.
        volume_bytes, coefficient_bytes: memory.
    """

    method: str
    scheme: str
    storage: str
    taps: int | None
    volume_bytes: int
    coefficient_bytes: int


@dataclass(frozen=True, kw_only=True)
class Plan(OfImage, OfField):
    """What rendering a medium takes.

    Attributes:
        order: the highest derivative that is asked of the field: 1 with lighting, else 0.
        marcher: fused or plain.
        not_fused: why the marcher is plain.
        samples: of the whole image, before any is skipped or left out behind what is opaque.
        empty_bricks: which part of the bricks has no opacity; None: no brick is known, as none is looked for.
        skipped: which part of the samples lies in them.
        step: in voxels.
        ray_bytes: memory of rays that are in work or kept.
    """

    order: int
    marcher: str
    not_fused: str | None
    samples: int
    empty_bricks: float | None
    skipped: float | None
    step: float
    ray_bytes: int

    @property
    def derivatives(self) -> str:
        """The order in words."""
        return _DERIVATIVES[self.order]


@dataclass(frozen=True, kw_only=True)
class OfSurface(OfImage):
    """Of a surface that rays are cast at.

    Attributes:
        order: derivatives of the surface that its material needs: 1 normals, 2 curvatures.
    """

    order: int


@dataclass(frozen=True, kw_only=True)
class SurfacePlan(OfSurface, OfField):
    """What casting rays at a level set takes.

    Attributes:
        level: the value on the surface.
        degree: of the field's pieces along a ray.
        cells, pieces: how many of the volume may hold the level; no others are looked into.
    """

    level: float
    degree: int
    cells: int
    pieces: int


@dataclass(frozen=True, kw_only=True)
class PiecesPlan(OfSurface):
    """What casting rays at quadrics takes, blended or not.

    Attributes:
        pieces: how many there are, and `called`: what they are.
        planes: that some of them are cut by, for each.
        surface_bytes: memory of their numbers and their index.
    """

    pieces: int
    called: str
    planes: int
    surface_bytes: int


@dataclass(frozen=True, kw_only=True)
class TerrainPlan(OfSurface):
    """What casting rays at a terrain takes.

    Attributes:
        size: heights along x and y. missing: how many of them there are none.
        filled: whether those are made from others.
        spacing, extent: in metres.
        span: the lowest and the highest height, but for ½ % at either end, in `unit` ("" where none is declared).
        spline, cells: of the surface; two quartics in each cell.
        exaggeration: how many times as high as it is, and `suggested`: whether by its relief.
        looks, sun: azimuth and degrees down, or up; `looks` is None for a camera at a place.
        shadows: whether they are cast.
        height_bytes, bound_bytes: memory of heights, and of bounds of blocks of them.
    """

    size: tuple[int, int]
    missing: int
    filled: bool
    spacing: tuple[float, float]
    extent: tuple[float, float]
    span: tuple[float, float]
    unit: str
    spline: str
    cells: tuple[int, int]
    exaggeration: float
    suggested: bool
    looks: tuple[float, float] | None
    sun: tuple[float, float] | None
    shadows: bool
    height_bytes: int
    bound_bytes: int


@dataclass(frozen=True, kw_only=True)
class ValuePlan(OfImage, OfField):
    """What a picture of values takes: a maximum intensity projection, or a slice.

    Attributes:
        kind: which of both.
        samples: of the whole image; of a slice one a ray at most.
        step: of a projection, in voxels.
        work_bytes: memory of what is looked at together, at most.
    """

    kind: str
    samples: int
    step: float | None
    work_bytes: int


@dataclass(frozen=True, kw_only=True)
class MeshPlan(OfField):
    """What making triangles of the surface of a scene takes: at most `seconds`, for all of it grows as the grid does.

    Attributes:
        level: as in `SurfacePlan`.
        step: of the grid, in voxels.
        size: points of the grid along x, y, z.
        triangles: about; from those on a coarser grid.
        residual: the largest |f − level| at a vertex there.
        grid_bytes, mesh_bytes: memory; of the grid what is looked at together.
    """

    level: float
    step: float
    size: tuple[int, int, int]
    triangles: int
    residual: float
    grid_bytes: int
    mesh_bytes: int


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
        **_of_field(prepared),
        level=float(surface.level),
        step=step,
        size=grid.size,
        triangles=triangles,
        residual=made.residual,
        grid_bytes=NODE_BYTES * nx * ny * (min(grid.layers_at_once, nz - 1) + 1),
        mesh_bytes=triangles * BYTES_OF_TRIANGLE,
        seconds=_timed(lambda: mesh(surface, step * coarser).vertices, share),
    )


def plan(prepared: AnyPrepared) -> OfImage:
    """The plan of a scene that is built; some of its rays are followed, the picture is not made.

    Takes as long as a few thousand rays do, five times over.
    """
    if isinstance(prepared, Prepared):
        return _plan_of_medium(prepared)
    if isinstance(prepared, PreparedValues):
        return _plan_of_values(prepared)
    if isinstance(prepared, PreparedTerrain):
        return _plan_of_terrain(prepared)
    return _plan_of_surface(prepared) if isinstance(prepared, PreparedSurface) else _plan_of_pieces(prepared)


def _plan_of_values(prepared: PreparedValues) -> ValuePlan:
    (width, height), scene = prepared.size, prepared.scene
    projected = isinstance(prepared, PreparedProjection)
    return ValuePlan(
        **_of_field(prepared),
        kind="maximum along every ray" if projected else "slice",
        rays=width * height,
        samples=samples_of(prepared) if isinstance(prepared, PreparedProjection) else width * height,
        step=scene.step_or_default if projected else None,
        image_bytes=width * height * 5 * scene.dtype.itemsize,
        work_bytes=prepared.work_bytes,
        seconds=_seconds_of_a_smaller(prepared, width * height),
        absent=_absent_of_values(scene),
    )


def _absent_of_values(scene: Scene) -> tuple[str, ...]:
    return () if scene.region is not None else ("region: rays are cut to the volume only",)


def _plan_of_surface(prepared: PreparedSurface) -> SurfacePlan:
    relevant = prepared.surface.relevant()
    return SurfacePlan(
        **_of_field(prepared),
        **_of_rays(prepared),
        level=float(prepared.surface.level),
        degree=prepared.field.degree_along_rays or 0,
        cells=relevant.cells,
        pieces=relevant.pieces,
    )


def _plan_of_pieces(prepared: Casting) -> PiecesPlan:
    surface = prepared.surface
    assert isinstance(surface, Slim | Quadrics)
    if isinstance(surface, Slim):
        called, planes = "SLIM, {} balls", surface.cuts
    else:
        called, planes = "{} quadrics", surface.bounds.planes
    count = 0 if planes is None else planes.shape[1]
    numbers = sum(x.nbytes for x in surface.tensors) + (0 if planes is None else planes.nbytes)
    return PiecesPlan(
        **_of_rays(prepared),
        pieces=len(surface),
        called=called.format(f"{len(surface):,}"),
        planes=count,
        surface_bytes=numbers + len(surface) * (_PIECE_BYTES + _PLANE_BYTES * count),
    )


def _plan_of_terrain(prepared: PreparedTerrain) -> TerrainPlan:
    terrain, surface, view = prepared.terrain, prepared.surface, prepared.scene.camera
    left, bottom, right, top = terrain.heights.extent
    dx, dy = terrain.heights.spacing
    return TerrainPlan(
        **_of_rays(prepared),
        size=terrain.heights.size,
        missing=int(terrain.heights.missing.sum()),
        filled=terrain.look.fill,
        spacing=(abs(dx), abs(dy)),
        extent=(right - left, top - bottom),
        span=terrain.span,
        unit=terrain.unit,
        spline=surface.spline.name,
        cells=surface.cells,
        exaggeration=terrain.exaggeration,
        suggested=terrain.look.exaggeration is None,
        looks=COMPASS if view.framed else view.compass,
        sun=terrain.look.sun if prepared.scene.lighting is None else None,
        shadows=terrain.look.shadows,
        height_bytes=surface.heights.nbytes,
        bound_bytes=surface.cast.pyramid.numbers.nbytes,
    )


def _of_field(prepared: ShownField) -> dict[str, Any]:
    """What every plan of a field has."""
    sizes = {"volume_bytes": prepared.volume_bytes, "coefficient_bytes": coefficient_bytes(prepared.field)}
    return _described(prepared.field) | sizes | {"chosen": prepared.chosen}


def _of_rays(prepared: Casting) -> dict[str, Any]:
    """What every plan of a surface has."""
    (width, height), rays = prepared.size, prepared.size[0] * prepared.size[1] * prepared.subpixels**2
    return {
        "rays": rays,
        "image_bytes": width * height * 4 * prepared.scene.dtype.itemsize,
        "order": prepared.material.order,
        "seconds": _seconds_of_a_smaller(replace(prepared, subpixels=1), rays),
        "absent": _absent_of_surface(prepared.scene),
    }


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
    return Plan(
        **_of_field(prepared),
        order=medium.order,
        marcher="fused" if isinstance(frame.marcher, FusedMarcher) else "plain",
        not_fused=why_not_fused(medium),
        rays=frame.pixels,
        samples=frame.samples,
        empty_bricks=empty,
        skipped=skipped,
        step=prepared.scene.step_or_default,
        image_bytes=frame.image_bytes,
        ray_bytes=frame.ray_bytes,
        seconds=seconds,
        absent=_absent(prepared.scene),
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
    asked = scene.cast
    assert asked is not None
    parts = []
    if asked.sheets == 1:
        parts.append("sheets behind the first")
    if not asked.shadows:
        parts.append("shadows")
    if scene.region is None:
        parts.append(f"region: rays are cut to {'the volume' if scene.alone is None else 'what is shown'} only")
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
