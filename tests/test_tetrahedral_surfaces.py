"""Level sets of splines on tetrahedra: pieces are the field, hits are all crossings that a scan by the oracle sees."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import filterlab as fl
from filterlab import bernstein
from filterlab.fields.ranges import ranges
from filterlab.fields.tetrahedral_pieces import Planes
from filterlab.methods import METHODS, Tetrahedral
from filterlab.ops.bounds import in_pairs
from filterlab.ops.differentiable import raycast as casting
from filterlab.ops.raycast import Raycast, Sheets
from filterlab.render import PerspectiveCamera, raycast
from filterlab.surfaces import LevelSet
from tests import tetrahedral_oracle

SPLINES = [name for name, method in METHODS.items() if isinstance(method, Tetrahedral)]
SHAPE = (5, 6, 7)
AFFINE = np.array([[1.0, 0.2, 0.0, 3.0], [0.0, 0.5, 0.1, 1.0], [0.1, 0.0, 2.0, -5.0], [0.0, 0.0, 0.0, 1.0]])
every_spline = pytest.mark.parametrize("name", SPLINES)


def samples(*shape: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random(shape or SHAPE))


def rays(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """In all directions; along axes, within planes of faces, through vertices and edges of both partitions."""
    g = np.random.default_rng(seed)
    size = np.array(SHAPE[::-1])
    origins = g.normal(size=(count, 3)) * 8 + size / 2
    directions = (g.random((count, 3)) * size - origins) * g.uniform(0.2, 3, (count, 1))
    special = np.arange(count) % 3 == 1
    steps = g.choice([0.0, 0.0, 1.0, -1.0, 2.0, 0.5], (count, 3))
    steps[(steps == 0).all(1)] = 1
    directions[special] = steps[special]
    through = g.integers(0, 4 * size, (count, 3)) / 4  # vertices, middles of edges and faces
    origins[special] = (through - 8 * steps)[special]
    inside = np.arange(count) % 3 == 2
    origins[inside] = (g.random((count, 3)) * (size - 1))[inside]
    return torch.from_numpy(origins), torch.from_numpy(directions)


# ---- the partition


def test_planes_and_tetrahedra_of_the_partitions():
    assert [len(METHODS[name].spline.tetrahedra) for name in SPLINES] == [24, 24, 144]
    type6 = Planes.of(METHODS["cubic-c1"].spline)
    assert type6.outer == (((0, 0, 1), 0.5), ((0, 1, 0), 0.5), ((1, 0, 0), 0.5))
    assert set(type6.inner) == {(0, 1, 1), (0, 1, -1), (1, 0, 1), (1, 0, -1), (1, 1, 0), (1, -1, 0)}
    octahedra = Planes.of(METHODS["quadratic-c1"].spline)
    assert len(octahedra.outer) == 7  # squares and hexagons
    assert len(octahedra.inner) == 3 + 6 + 12 + 12


# ---- pieces


@every_spline
@pytest.mark.parametrize("boundary", list(fl.Boundary))
def test_pieces_are_the_field(name, boundary):
    field = fl.reconstruct(fl.Volume(samples(), affine=AFFINE), name, boundary=boundary)
    geometry = field.domain.geometry
    origins, directions = rays(30)
    origins, directions = (
        geometry.to_world(origins),
        geometry.to_world(directions) - geometry.to_world(torch.zeros(3).double()),
    )
    found = field.pieces_along(origins, directions)
    assert found.coefficients.shape[1] == field.degree_along_rays + 1 == METHODS[name].spline.degree + 1
    within = torch.rand(len(found.ray), 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    t = found.start[found.ray][:, None] + torch.lerp(found.near[:, None], found.far[:, None], within)
    points = origins[found.ray][:, None] + t[..., None] * directions[found.ray][:, None]
    values = bernstein.evaluate(found.coefficients[:, None].expand(-1, 4, -1), bernstein.on_interval(within))
    assert float((values - field(points)).abs().max()) < 1e-12
    same = found.ray[1:] == found.ray[:-1]
    assert torch.equal(found.near[1:][same], found.far[:-1][same])  # without a gap
    assert torch.equal(found.coefficients[1:][same, 0], found.coefficients[:-1][same, -1])  # to the bit


@every_spline
def test_no_piece_that_may_hold_the_level_is_left_out(name):
    axis = torch.arange(14, dtype=torch.float64) - 3
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    field = fl.reconstruct(x * x + y * y + z * z + 3 * samples(14, 14, 14), name)
    origins, directions = rays(60)
    for level in (5.0, 20.0, 60.0):
        counts = []
        for asked in (None, level):
            pieces = field.pieces_along(origins, directions, asked)
            low, high = pieces.coefficients.aminmax(dim=-1)
            counts.append((len(low), int(((low <= level) & (high >= level)).sum())))
        (every, of_every), (some, of_some) = counts
        assert of_every == of_some > 0
        assert some < every
    assert len(field.pieces_along(origins, directions, 999.0).ray) == 0


@every_spline
def test_bounds_are_those_of_the_samples_that_are_there(name):
    """Of others that a copy of the field got, of those that were written since, of those that count no writing."""
    ray = torch.tensor([[2.2, 2.1, -3.0]], dtype=torch.float64), torch.tensor([[0.0, 0.1, 1.0]], dtype=torch.float64)
    count = lambda field: len(field.pieces_along(*ray, 0.5).ray)  # noqa: E731
    expected = count(fl.reconstruct(samples(6, 6, 6), name))
    dark, bright = (fl.reconstruct(v, name) for v in (torch.zeros(6, 6, 6, dtype=torch.float64), samples(6, 6, 6)))
    assert (count(dark), expected > 0) == (0, True)
    assert count(dark.with_tensors([bright.coefficients.values])) == expected
    dark.coefficients.values.copy_(bright.coefficients.values)
    assert count(dark) == expected
    with torch.inference_mode():
        assert count(fl.reconstruct(samples(6, 6, 6).clone(), name)) == expected


# ---- hits


@every_spline
@pytest.mark.parametrize("boundary", ["mirror", "zeros"])
def test_hits_are_all_crossings_that_a_scan_sees(name, boundary):
    """Between neighbours of a dense scan by the oracle signs differ where an odd number of hits lies, nowhere else."""
    volume, level, count = samples(), 0.45, 1000
    surface = LevelSet(fl.reconstruct(volume, name, boundary=boundary), level)
    origins, directions = rays(25, seed=3)
    hits = surface.hits(origins, directions, 40).t.numpy()
    first = surface.hit(origins, directions)
    assert np.allclose(hits[:, 0], first.t.numpy(), rtol=0, atol=1e-12, equal_nan=True)
    o, d, seen = origins.numpy(), directions.numpy(), 0
    low, high = -0.5, np.array(SHAPE[::-1]) - 0.5
    for ray in range(len(o)):
        still = d[ray] == 0
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.sort(np.stack([(low - o[ray]) / d[ray], (high - o[ray]) / d[ray]]), 0)
        if ((o[ray] < low) | (o[ray] > high))[still].any():
            assert np.isinf(hits[ray]).all()
            continue
        begin, end = max(ends[0][~still].max(), 0.0), ends[1][~still].min()
        own = hits[ray][np.isfinite(hits[ray])]
        if begin >= end:
            assert len(own) == 0
            continue
        assert (np.diff(own) >= 0).all()
        assert len(own) == 0 or begin - 1e-9 <= own[0] <= own[-1] <= end + 1e-9
        t = np.linspace(begin + 1e-9, end - 1e-9, count)
        (values,) = tetrahedral_oracle.reconstruct(
            name, volume.numpy(), o[ray] + t[:, None] * d[ray], boundary, True, 0
        )
        between = np.histogram(own, t)[0]
        clear = np.minimum(np.abs(values[1:] - level), np.abs(values[:-1] - level)) > 1e-10
        assert ((between % 2 == 1) == (values[1:] > level) ^ (values[:-1] > level))[clear].all()
        seen += len(own)
        if len(own):
            at = o[ray] + own[:, None] * d[ray]
            (found,) = tetrahedral_oracle.reconstruct(name, volume.numpy(), at, boundary, True, 0)
            assert np.abs(found - level).max() < 1e-12
    assert seen > 30


@every_spline
def test_derivatives_of_hits(name):
    volume = samples(3, 3, 3).requires_grad_()
    origins = torch.tensor([[1.3, 1.1, -3.0]], dtype=torch.float64, requires_grad=True)
    directions = torch.tensor([[0.02, 0.05, 1.0]], dtype=torch.float64, requires_grad=True)
    with torch.no_grad():
        through = fl.reconstruct(volume, name)(origins + torch.linspace(2.6, 4.4, 9).double()[:, None] * directions)
    level = ((through.max() + through.min()) / 2).requires_grad_()

    def seen(values: Tensor, level: Tensor, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        surface = LevelSet(fl.reconstruct(values, name), level)
        hit = surface.hit(o, d)
        assert bool(hit.valid.all())
        normal = surface.at(o, d, hit).normal
        assert normal is not None
        return hit.t, normal

    assert torch.autograd.gradcheck(seen, (volume, level, origins, directions))


@every_spline
def test_relevant_cells_and_tetrahedra(name):
    """Those of a ball: its surface has to be in them, and the bounds of cells leave no tetrahedron out."""
    axis = torch.arange(10, dtype=torch.float64) - 4.5
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    field = fl.reconstruct(x * x + y * y + z * z, name)
    few, none = field.relevant(9.0), field.relevant(1000.0)
    assert none == (0, 0)
    spline = METHODS[name].spline
    assert 0 < few.cells < 1000 / (4 if spline.period == 2 else 1) / 2
    assert few.cells < few.pieces < len(spline.tetrahedra) * few.cells


@every_spline
def test_pictures(name):
    """−r² becomes −r² − ¾ where it is not prefiltered: the level −6 is a sphere."""
    axis = torch.arange(12, dtype=torch.float64) - 5.5
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    surface = LevelSet(fl.reconstruct(-(x * x + y * y + z * z), name, prefilter=False), -6.0)
    camera = PerspectiveCamera.framing(surface.domain)
    image = raycast(surface, camera, size=(24, 24), channels=("depth", "normal"))
    hit = image["depth"][..., 0] < math.inf
    assert 0.05 < hit.double().mean() < 0.5
    origins, directions = camera.rays(24, 24)
    points = (origins + image["depth"].double() * directions)[hit] - 5.5
    r = math.sqrt(5.25)
    assert float((points.norm(dim=-1) - r).abs().max()) < 1e-5
    cosine = -(image["normal"][hit].double() * points).sum(-1) / r  # normals look inside, to greater values
    assert float(cosine.min()) > (1 - 1e-5 if name != "qss" else 0.99)


def test_fields_of_several_channels_are_selected_first():
    field = fl.reconstruct(samples(2, 1, 4, 4, 4), "cubic-c1")
    ray = torch.zeros(1, 3), torch.ones(1, 3)
    with pytest.raises(ValueError, match="select"):
        field.pieces_along(*ray)
    assert field.select(1, 0).pieces_along(*ray).ray.numel()


KINDS = {
    "as it is": {},
    "integers": {"storage": "uint8"},
    "parts of eight cubes": {"many": 1},
    "in reverse": {"scale": -1.5},
    "parts, in reverse": {"many": 1, "scale": -1.5},
    "float32": {"dtype": torch.float32},
}


@every_spline
@pytest.mark.parametrize("kind", KINDS)
def test_trends_leave_out_no_hit(name, kind, monkeypatch):
    """Against casting where nothing is known of them, all sheets of smooth data and of a noisy sample."""
    own = KINDS[kind]
    monkeypatch.setattr("filterlab.fields.ranges._MANY", own.get("many", 1 << 25))
    z, y, x = np.indices(SHAPE)
    smooth = torch.from_numpy(0.5 + 0.4 * np.sin(1.1 * x - 0.5 * y + 0.7 * z))
    smooth[2, 3, 3] += 0.3
    field = fl.reconstruct(smooth, name, storage=own.get("storage"))
    o, d = (x.to(own.get("dtype", torch.float64)) for x in rays(1500))
    given = field._raycast(0.45, o, d)
    assert given.off_trend is not None
    if "scale" in own:
        lattice = replace(field.lattice, scale=own["scale"], shift=1.2)
        known = ranges(lattice)
        numbers = known.marks(0.5, o.dtype), known.edge, known.margin(o.dtype), known.off_trend
        given = Raycast(lattice, given.geometry, 0.5, o.dtype, *numbers)
    nothing = torch.full_like(given.off_trend, torch.nan, dtype=torch.float64)
    everything = replace(given, off_trend=in_pairs(nothing, nothing))
    tolerance = 1e-4 if o.dtype == torch.float32 else 1e-11
    found, all_ = (casting.sheets(x, o, d, Sheets(4, False, 20.0), "cpu") for x in (given, everything))
    assert torch.equal(found < torch.inf, all_ < torch.inf)
    hit = found < torch.inf
    assert 0.2 < float(hit[:, 0].double().mean()) < 1
    assert float((found - all_)[hit].abs().max()) <= tolerance
