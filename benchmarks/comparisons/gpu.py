"""On a GPU: Triton programs against plain torch there, against CuPy, and against the texture units.

A call ends when the GPU has finished. Sizes are larger than elsewhere: what a thread does in a millisecond takes a GPU
less time than Python needs to ask for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from benchmarks import workloads
from benchmarks.comparisons import slim, surfaces, terrain
from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, race_item
from benchmarks.level_sets import hits_and_normals, surface_of, task_of
from benchmarks.peers import cupy_march, cupy_ndimage, cupy_texture
from benchmarks.scene import Scene, blobs, marschner_lobb, without_skipping
from benchmarks.settings import Settings
from filterlab import ops
from filterlab.kernels import bspline
from filterlab.methods import METHODS, Tetrahedral, reconstruct
from filterlab.names import SPLINES
from filterlab.ops.differentiable import height_hits, heights, quadrics
from filterlab.ops.differentiable import slim as sheets
from filterlab.ops.differentiable.prefilter import prefilter_samples
from filterlab.roots import first_root
from filterlab.surfaces import BilinearQuads, Slim

_POINTS = 16  # times as many as elsewhere
_IMAGE = 4  # times the edge
_TETRAHEDRAL = tuple(name for name, method in METHODS.items() if isinstance(method, Tetrahedral))
_WAYS = {"fused": "cuda", "direct": "reference"}
_FLOATS = 3 + 4  # of a point and of its rows


def _on_gpu(what: str, build: Callable[[], Race]) -> Race:
    if torch.cuda.is_available():
        return build()
    return Race(what, [], absent={"everything": "no GPU that torch can use"})


def _finished(name: str, call: Callable[[], Any], computes: str | None, samples: int) -> Contestant:
    """Whose call gives arrays, and ends when the GPU has."""

    def until_done() -> Any:
        result = call()
        torch.cuda.synchronize()
        return result

    return Contestant(name, until_done, computes, samples=samples)


def _with_peers(
    race: Race, peers: Sequence[tuple[ModuleType, Callable[[], Contestant]]], above: Sequence[str] = ("fused",)
) -> Race:
    """The race with those peers that are there, and the contestants' ratios to them."""
    contestants, ratios, absent = list(race.contestants), list(race.ratios), dict(race.absent)
    for peer, make in peers:
        if why := peer.missing():
            absent[peer.NAME] = why
        else:
            contestants.append(make())
            ratios += [Ratio(name, peer.NAME) for name in above]
    return replace(race, contestants=contestants, ratios=ratios, absent=absent)


# --- sums at points ---------------------------------------------------------------------------------------------------


def _jets(settings: Settings, arrangement: str) -> Race:
    """Also a copy within memory of as many bytes as points and rows have: nothing that reads and writes them is faster.

    The texture units round the fractions of their samples to 8 bits: their numbers are not compared.
    """
    volume = workloads.noise(settings.voxels).cuda()
    points = workloads.points(arrangement, settings.voxels, _POINTS * settings.points).cuda()
    count = len(points)
    block = points.new_empty(_FLOATS * count // 2)

    def jet(implementation: str) -> tuple[Tensor, ...]:
        rows = ops.jet(volume[None, None], points[None], bspline(2), 1, 0, implementation)[0, 0]
        return rows[0], rows[1:]

    contestants = [
        _finished("fused", lambda: jet("cuda"), "value and gradient", count),
        _finished("direct", lambda: jet("reference"), "value and gradient", count),
        _finished("copy", lambda: (block.clone(),), None, count),
    ]
    race = Race(
        f"triquadratic value + gradient, {count:,} points, {arrangement}",
        contestants,
        [Ratio("fused", "direct"), Ratio("fused", "copy")],
    )

    def textured() -> Contestant:
        return _finished(cupy_texture.NAME, cupy_texture.triquadratic(volume, points), None, count)

    return _with_peers(race, [(cupy_texture, textured)])


def _on_tetrahedra(settings: Settings, arrangement: str) -> Race:
    """Splines on tetrahedra against the tensor product of the same accuracy."""
    volume = workloads.noise(settings.voxels).cuda()
    points = workloads.points(arrangement, settings.voxels, _POINTS * settings.points).cuda()
    fields = {name: reconstruct(volume, name) for name in ("triquadratic", *_TETRAHEDRAL)}
    contestants = [
        _finished(name, partial(field.value_and_gradient, points), None, len(points)) for name, field in fields.items()
    ]
    ratios = [Ratio(name, "triquadratic") for name in _TETRAHEDRAL]
    return Race(f"value + gradient, {len(points):,} points, {arrangement}", contestants, ratios)


def _splats(settings: Settings, arrangement: str) -> Race:
    """The adjoint: rows of value and gradient to coefficients, by atomic additions."""
    shape = (settings.voxels,) * 3
    points = workloads.points(arrangement, settings.voxels, _POINTS * settings.points).cuda()
    rows = torch.randn(1, 1, 4, len(points)).to(points)
    volume = workloads.noise(settings.voxels).cuda()[None, None]
    stencil = ops.Stencil.jet(bspline(2), 1)

    def splat(implementation: str) -> tuple[Tensor]:
        return (ops.splat(rows, points[None], bspline(2), 1, shape, 0, implementation),)

    contestants = [
        _finished("fused", lambda: splat("cuda"), "coefficients", len(points)),
        _finished("direct", lambda: splat("reference"), "coefficients", len(points)),
        _finished("gather", lambda: (ops.gather(volume, points[None], stencil, 0, "cuda"),), None, len(points)),
    ]
    what = f"triquadratic splat of value + gradient, {len(points):,} points, {arrangement}"
    return Race(what, contestants, [Ratio("fused", "direct"), Ratio("fused", "gather")], tolerance=1e-4)


# --- whole volumes ----------------------------------------------------------------------------------------------------


def _prefilter(settings: Settings, name: str, order: int) -> Race:
    """Also a copy of the samples: nothing that reads them and writes as many coefficients is faster."""
    n = settings.prefilter_voxels
    samples = workloads.noise(n).cuda()

    def filtered(implementation: str) -> tuple[Tensor]:
        return (prefilter_samples(samples, name, "mirror", implementation=implementation),)

    contestants = [
        _finished("fused", lambda: filtered("cuda"), "coefficients", samples.numel()),
        _finished("plain torch", lambda: filtered("reference"), "coefficients", samples.numel()),
        _finished("copy", lambda: (samples.clone(),), None, samples.numel()),
    ]
    race = Race(
        f"{name} prefilter of {n}³ float32, boundary mirror",
        contestants,
        [Ratio("fused", "plain torch"), Ratio("fused", "copy")],
        tolerance=5e-6,
    )
    return _with_peers(race, [(cupy_ndimage, lambda: cupy_ndimage.prefiltering(samples, order, "coefficients"))])


# --- images -----------------------------------------------------------------------------------------------------------


def _scene(settings: Settings, edge: int = _IMAGE, build: Callable[..., Scene] = marschner_lobb) -> Scene:
    scene = build(settings.image_voxels, settings.image * edge)
    return replace(scene, volume=scene.volume.cuda())


def _described(scene: Scene) -> str:
    return (
        f"image {scene.size}², volume {scene.volume.shape[-1]}³ float32, step {scene.step:g} voxel, lit, triquadratic"
    )


def _frame(scene: Scene, scheme: str, name: str | None = None) -> Contestant:
    field = scene.field("triquadratic", scheme)

    def call() -> tuple[Tensor]:
        with torch.no_grad():
            return (scene.image(field),)

    return _finished(name or scheme, call, "triquadratic image", scene.size**2)


def _march(settings: Settings) -> Race:
    scene = _scene(settings)
    race = Race(_described(scene), [_frame(scene, "fused")], tolerance=2e-2)
    return _with_peers(race, [(cupy_march, lambda: cupy_march.marching_on_gpu(scene))])


def _march_direct(settings: Settings) -> Race:
    scene = _scene(settings, edge=1)
    contestants = [_frame(scene, scheme) for scheme in ("fused", "direct")]
    return Race(_described(scene), contestants, [Ratio("fused", "direct")], tolerance=5e-4)


def _skipping(settings: Settings) -> Race:
    """The same image, bit by bit."""
    scene = _scene(settings, build=blobs)
    skipping = _frame(scene, "fused", "skipping")
    contestants = [replace(skipping, name="not skipping", call=without_skipping(skipping.call)), skipping]
    what = f"{_described(scene)}, 80 % of the bricks of 8³ voxels empty"
    return Race(what, contestants, [Ratio("skipping", "not skipping")], tolerance=0.0)


def _adjoint(settings: Settings, edge: int, schemes: Sequence[str]) -> Race:
    """Gradients of the mean of an image to volume and transfer function.

    In float32 rounding decides which interval of the table a sample is in, and derivatives by the volume jump from one
    to the next: any float32 march is some thousandths of the largest from one in float64.
    """
    scene = _scene(settings, edge)
    volume = scene.volume.clone().requires_grad_()
    table = scene.table.clone().requires_grad_()

    def both(scheme: str) -> tuple[Tensor, ...]:
        image = scene.image(scene.field("triquadratic", scheme, volume), table)
        return torch.autograd.grad(image.mean(), (volume, table))

    contestants = [_frame(scene, "fused", "forward")]
    contestants += [_finished(f"{s}, both ways", partial(both, s), "gradients", scene.size**2) for s in schemes]
    ratios = [Ratio(f"{schemes[0]}, both ways", "forward")]
    ratios += [Ratio(f"{schemes[0]}, both ways", f"{s}, both ways") for s in schemes[1:]]
    return Race(f"{_described(scene)}: gradients to volume and table", contestants, ratios, tolerance=1e-2)


# --- level sets -------------------------------------------------------------------------------------------------------


def _hits(settings: Settings) -> Race:
    """First hits and normals by every method, and the program alone for one of them."""
    task = task_of(settings, _IMAGE * settings.image, device="cuda")
    rays = task.origins, task.directions
    contestants = [
        _finished(method, partial(hits_and_normals, surface_of(task, method), *rays), None, task.rays)
        for method in surfaces.SEARCHED
    ]
    surface = surface_of(task, "triquadratic")
    contestants.append(
        _finished("program", lambda: (surface.field.first_crossing(*rays, task.level),), None, task.rays)
    )
    what = f"{surfaces.described(task)}: first hits and normals; triquadratic hits alone: program"
    ratios = [Ratio("triquadratic", "trilinear"), Ratio("triquadratic", "program")]
    return Race(what, contestants, ratios + [Ratio(name, "triquadratic") for name in _TETRAHEDRAL])


def _hits_direct(settings: Settings) -> Race:
    task = task_of(settings, settings.image // 4, device="cuda")

    def cast(scheme: str) -> Callable[[], Any]:
        surface = surface_of(task, "triquadratic", scheme)
        return lambda: tuple(x.nan_to_num(posinf=0) for x in hits_and_normals(surface, task.origins, task.directions))

    contestants = [_finished(scheme, cast(scheme), "hits", task.rays) for scheme in ("fused", "direct")]
    return Race(surfaces.described(task), contestants, [Ratio("fused", "direct")], tolerance=1e-2)


def _hits_adjoint(settings: Settings) -> Race:
    task = task_of(settings, _IMAGE * settings.image, device="cuda")
    forward, both = surfaces.ways_of(task)
    contestants = [
        _finished("forward", forward, None, task.rays),
        _finished("both ways", both, None, task.rays),
    ]
    what = f"{surfaces.described(task)}: gradients of depths and normals to samples and origins, triquadratic"
    return Race(what, contestants, [Ratio("both ways", "forward")])


# --- terrains and covers ----------------------------------------------------------------------------------------------


def _moved(rays: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    origins, directions = (x.reshape(-1, 3).cuda() for x in rays)
    return origins, directions


def _finite(*numbers: Tensor) -> tuple[Tensor, ...]:
    return tuple(x.nan_to_num(posinf=0) for x in numbers)


def _heights(settings: Settings, arrangement: str) -> Race:
    """Heights and slopes of one terrain. Also a copy of as many bytes as points and rows have."""
    jet, points = _of_ground(settings, arrangement, _POINTS * settings.points)
    count = points.shape[1]
    block = points.new_empty(5 * count // 2)
    contestants = [
        _finished("fused", partial(jet, "cuda"), None, count),
        _finished("copy", lambda: (block.clone(),), None, count),
    ]
    return Race(f"c1 height + slope, {count:,} points, {arrangement}", contestants, [Ratio("fused", "copy")])


def _heights_direct(settings: Settings) -> Race:
    jet, points = _of_ground(settings, "random", settings.points // 4)
    count = points.shape[1]
    contestants = [_finished(name, partial(jet, how), "heights and slopes", count) for name, how in _WAYS.items()]
    return Race(f"c1 height + slope, {count:,} points", contestants, [Ratio("fused", "direct")], tolerance=1e-4)


def _of_ground(settings: Settings, arrangement: str, count: int) -> tuple[Callable[[str], tuple[Tensor]], Tensor]:
    """What gives the jets of a terrain by an implementation, and where."""
    grid = terrain.ground(terrain.hills(terrain.size_of(settings)).cuda(), "c1").cast.heights
    points = workloads.points(arrangement, settings.voxels, count)[None, :, :2].cuda() / settings.voxels
    return lambda implementation: (heights.jet(grid, points, 1, implementation)[0],), points


def _terrain(settings: Settings) -> Race:
    """First hits by every spline, and of c1 the program alone."""
    data, rays = terrain.hills(terrain.size_of(settings)).cuda(), _moved(terrain.view(_IMAGE * settings.image))
    grounds = {spline: terrain.ground(data, spline) for spline in SPLINES}
    count = len(rays[0])
    contestants = [
        _finished(name, partial(hits_and_normals, surface, *rays), None, count) for name, surface in grounds.items()
    ]
    cast = grounds["c1"].cast
    contestants.append(_finished("program", lambda: (height_hits.first(cast, *rays),), None, count))
    what = f"{len(data)}² data, {count:,} float32 rays: first hits and normals; c1 hits alone: program"
    return Race(what, contestants, [Ratio("c1", "linear"), Ratio("c1", "program")])


def _terrain_direct(settings: Settings) -> Race:
    data, rays = terrain.hills(terrain.size_of(settings) // 2).cuda(), _moved(terrain.view(settings.image // 4))
    cast = terrain.ground(data, "c1").cast
    by = lambda how: lambda: _finite(height_hits.first(cast, *rays, how))  # noqa: E731
    contestants = [
        _finished(n, by(how), "hits", len(rays[0])) for n, how in (("fused", "cuda"), ("direct", "reference"))
    ]
    what = f"{len(data)}² data, {len(rays[0]):,} rays: first hits of c1"
    return Race(what, contestants, [Ratio("fused", "direct")], tolerance=1e-6)


def _cover(settings: Settings, balls: int) -> Slim:
    cover = slim.cover_of(settings, balls)
    return cover.with_tensors([x.cuda() for x in cover.tensors])


def _slim(settings: Settings) -> Race:
    """First hits and normals of covers of a torus, a fifth of the rays hit."""
    covers = {f"{n:,} balls": _cover(settings, n) for n in (5_000, 180_000)}
    rays = _moved(slim.rays_of(slim.cover_of(settings, 5_000), _IMAGE * settings.image))
    contestants = [
        _finished(name, partial(hits_and_normals, cover, *rays), None, len(rays[0])) for name, cover in covers.items()
    ]
    few, many = covers
    (given,) = covers[few].described
    contestants.append(_finished("program", lambda: tuple(sheets.sheets(given, *rays, 1)), None, len(rays[0])))
    what = f"a torus, {len(rays[0]):,} float32 rays: first hits and normals; hits of {few} alone: program"
    return Race(what, contestants, [Ratio(many, few), Ratio(few, "program")])


def _slim_direct(settings: Settings) -> Race:
    (given,) = _cover(settings, 5_000).described
    rays = _moved(slim.rays_of(slim.cover_of(settings, 5_000), settings.image // 4))

    def by(how: str) -> Callable[[], Any]:
        def call() -> tuple[Tensor, ...]:
            found = sheets.sheets(given, *rays, 1, implementation=how)
            return _finite(found.t, found.normal)

        return call

    contestants = [
        _finished(n, by(how), "hits", len(rays[0])) for n, how in (("fused", "cuda"), ("direct", "reference"))
    ]
    what = f"a torus in 5,000 balls, {len(rays[0]):,} rays: first sheets"
    return Race(what, contestants, [Ratio("fused", "direct")], tolerance=1e-6)


def _mesh(settings: Settings, rings: int) -> BilinearQuads:
    vertices, faces = slim.quads(rings if not settings.quick else 6)
    return BilinearQuads(torch.from_numpy(vertices).cuda(), torch.from_numpy(faces).cuda())


def _quads(settings: Settings) -> Race:
    """First hits and normals of quads through points of the same torus."""
    meshes = {f"{len(mesh):,} quads": mesh for mesh in (_mesh(settings, rings) for rings in (45, 268))}
    rays = _moved(slim.rays_of(slim.cover_of(settings, 5_000), _IMAGE * settings.image))
    contestants = [
        _finished(name, partial(hits_and_normals, mesh, *rays), None, len(rays[0])) for name, mesh in meshes.items()
    ]
    few, *many = meshes
    given = meshes[few].described
    contestants.append(_finished("program", lambda: quadrics.hits(given, *rays, 1), None, len(rays[0])))
    what = f"a torus, {len(rays[0]):,} float32 rays: first hits and normals; hits of {few} alone: program"
    return Race(what, contestants, [*(Ratio(name, few) for name in many), Ratio(few, "program")])


def _quads_direct(settings: Settings) -> Race:
    given = _mesh(settings, 45).described
    rays = _moved(slim.rays_of(slim.cover_of(settings, 5_000), settings.image // 4))
    by = lambda how: lambda: _finite(quadrics.hits(given, *rays, 1, implementation=how)[0])  # noqa: E731
    contestants = [
        _finished(n, by(how), "hits", len(rays[0])) for n, how in (("fused", "cuda"), ("direct", "reference"))
    ]
    what = f"a torus of 5,085 quads, {len(rays[0]):,} rays: first hits"
    return Race(what, contestants, [Ratio("fused", "direct")], tolerance=1e-6)


# --- roots ------------------------------------------------------------------------------------------------------------


def _roots(settings: Settings, dtype: torch.dtype) -> Race:
    """First roots by plain torch, on the GPU and on the CPU."""
    generator = torch.Generator().manual_seed(4)
    c = (2 * torch.rand(4 * settings.points, 5, generator=generator, dtype=torch.float64) - 1).to(dtype)
    there = c.cuda()
    contestants = [
        _finished("GPU", lambda: (first_root(there).nan_to_num(2.0, posinf=2.0),), None, len(c)),
        Contestant("CPU, one thread", lambda: (first_root(c[: len(c) // 16]),), samples=len(c) // 16),
    ]
    return Race(f"first roots of {len(c):,} quartics, {str(dtype).removeprefix('torch.')}, plain torch", contestants)


_ITEMS: dict[str, tuple[float, Callable[[Settings], Race]]] = {
    **{f"jets-{a}": (5, partial(_jets, arrangement=a)) for a in workloads.ARRANGEMENTS},
    **{f"tetrahedra-{a}": (15, partial(_on_tetrahedra, arrangement=a)) for a in workloads.ARRANGEMENTS},
    **{f"splats-{a}": (5, partial(_splats, arrangement=a)) for a in workloads.ARRANGEMENTS},
    "prefilter-quadratic": (5, partial(_prefilter, name="quadratic", order=2)),
    "prefilter-cubic": (5, partial(_prefilter, name="cubic", order=3)),
    "march": (5, _march),
    "march-direct": (20, _march_direct),
    "skipping": (5, _skipping),
    "adjoint": (5, partial(_adjoint, edge=2, schemes=("fused",))),
    "adjoint-direct": (20, lambda s: _adjoint(replace(s, image=s.image // 2), 1, ("fused", "direct"))),
    "hits": (5, _hits),
    "hits-direct": (20, _hits_direct),
    "hits-adjoint": (5, _hits_adjoint),
    **{f"heights-{a}": (5, partial(_heights, arrangement=a)) for a in workloads.ARRANGEMENTS},
    "heights-direct": (20, _heights_direct),
    "terrain": (5, _terrain),
    "terrain-direct": (20, _terrain_direct),
    "slim": (5, _slim),
    "slim-direct": (20, _slim_direct),
    "quads": (5, _quads),
    "quads-direct": (20, _quads_direct),
    "roots-float32": (10, partial(_roots, dtype=torch.float32)),
    "roots-float64": (10, partial(_roots, dtype=torch.float64)),
}


def _item(name: str, seconds: float, build: Callable[[Settings], Race]) -> Item:
    return race_item(name, seconds, lambda settings: _on_gpu(name, lambda: build(settings)))


COMPARISON = Comparison(
    "gpu",
    "on a GPU: Triton programs against plain torch there, CuPy and the texture units",
    lambda settings: [_item(name, *item) for name, item in _ITEMS.items()],
)
