"""Pieces of fields along rays: exact, without a gap, equal where they meet; and bounds of values by brick."""

from __future__ import annotations

import math
from functools import partial
from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

import filterlab as fl
from filterlab import bernstein, kernels
from filterlab.fields import ranges as bounds
from filterlab.kernels import KERNELS
from filterlab.methods import from_kernel
from filterlab.ops.differentiable.bounds import bits_of_blocks
from filterlab.ops.differentiable.raycast import marks_of_bits
from filterlab.ops.raycast import marks_of
from filterlab.ops.reference import bounds as hulls
from tests import oracles
from tests.pairs import covering
from tests.test_methods import CONTINUOUS, TENSOR_PRODUCTS

BOUNDARIES = [str(b) for b in fl.Boundary]
AFFINE = np.array([[1.0, 0.2, 0.0, 3.0], [0.0, 0.5, 0.1, 1.0], [0.1, 0.0, 2.0, -5.0], [0.0, 0.0, 0.0, 1.0]])


def samples(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rays(field, count: int = 40, seed: int = 1) -> tuple[Tensor, Tensor]:
    """Rays from around towards the middle half of the domain; directions of any length."""
    random = np.random.default_rng(seed)
    center, size = np.array(field.domain.center), field.domain.diagonal
    origins = center + random.normal(size=(count, 3)) * size
    targets = center + random.uniform(-0.25, 0.25, (count, 3)) * size
    directions = (targets - origins) * random.uniform(0.1, 10, (count, 1))
    return torch.from_numpy(origins), torch.from_numpy(directions)


def awkward_rays(field) -> tuple[Tensor, Tensor]:
    """Parallel to axes of the voxels, in planes of knots, through edges and corners of cells, from inside, from far."""
    n = np.array(field.coefficients.size)
    rows = []
    for axis in range(3):
        for where in ((1.0, 1.0), (1.5, 2.0), (0.3, 1.5), (0.0, -0.4), (2.5, 2.5)):
            origin, step = np.insert(np.array(where), axis, -3.0), np.eye(3)[axis]
            rows += [(origin, step), (origin + step * (n[axis] + 6), -step)]
    rows += [(np.full(3, -2.0), np.ones(3)), (n + 1.0, -np.ones(3)), (np.array([-2.5, -2, 1.0]), np.array([1.0, 1, 0]))]
    rows += [(np.array([1.0, 1, 1]), np.array([1.0, 0.5, 0.25])), (np.array([1.2, 2.5, 1]), np.array([-1.0, -1, -1]))]
    rows += [(np.array([1e6, 2e6, -1e6]) + 1.3, np.array([-1.0, -2, 1]))]
    voxels, steps = (torch.from_numpy(np.array(x)) for x in zip(*rows, strict=True))
    geometry = field.domain.geometry
    return geometry.to_world(voxels), geometry.to_world(voxels + steps) - geometry.to_world(voxels)


def values_of(pieces, within: Tensor) -> Tensor:
    return bernstein.evaluate(pieces.coefficients[:, None], bernstein.on_interval(within.to(pieces.coefficients)))


def points_of(pieces, origins: Tensor, directions: Tensor, within: Tensor) -> Tensor:
    return origins[pieces.ray][:, None] + pieces.t(within)[..., None] * directions[pieces.ray][:, None]


def voxels_of(points: Tensor) -> np.ndarray:
    return (points.numpy().reshape(-1, 3) - AFFINE[:3, 3]) @ np.linalg.inv(AFFINE[:3, :3]).T


def within(pieces, count: int = 3) -> Tensor:
    return torch.rand(len(pieces.ray), count, generator=torch.Generator().manual_seed(7), dtype=torch.float64)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_pieces_are_the_field_as_its_definition_gives_it(method, boundary):
    volume = fl.Volume(samples(4, 5, 6), affine=AFFINE)
    field = fl.reconstruct(volume, method, boundary=boundary)
    origins, directions = rays(field)
    pieces = field.pieces_along(origins, directions)
    assert pieces.coefficients.shape == (len(pieces.ray), field.degree_along_rays + 1)
    assert len(pieces.ray) > 100
    at = within(pieces)
    points = voxels_of(points_of(pieces, origins, directions, at))
    expected = oracles.reconstruct(method, volume.samples.numpy(), points, boundary, order=0)[0]
    assert np.abs(values_of(pieces, at).numpy().reshape(-1) - expected).max() < 2e-13


DEGREES = {"nearest": 1, "trilinear": 3, "ncrsi": 5, "triquadratic": 6, "notch": 6}
DEGREES |= {"catmull-rom": 9, "mitchell": 9, "tricubic": 9}


@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_degrees_along_rays(method):
    assert fl.reconstruct(samples(3, 3, 3), method).degree_along_rays == DEGREES[method]


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("name", KERNELS)
def test_pieces_of_every_kernel(name, boundary):
    volume = fl.Volume(samples(3, 4, 5))
    field = fl.reconstruct(volume, from_kernel(KERNELS[name]), boundary=boundary, prefilter=False, scheme="direct")
    origins, directions = rays(field, 12)
    pieces = field.pieces_along(origins, directions)
    at = within(pieces)
    points = points_of(pieces, origins, directions, at).numpy().reshape(-1, 3)
    expected = oracles.tensor_product(volume.samples.numpy(), points, oracles.PIECES[name], (), boundary, 0)[0]
    assert np.abs(values_of(pieces, at).numpy().reshape(-1) - expected).max() < 2e-13


def test_pieces_of_a_kernel_that_is_a_tensor():
    field = fl.reconstruct(samples(4, 4, 4), kernels.bc(torch.tensor(0.3, dtype=torch.float64), 0.2), prefilter=False)
    origins, directions = rays(field)
    pieces = field.pieces_along(origins, directions)
    at = within(pieces)
    expected = field(points_of(pieces, origins, directions, at)).detach()
    assert float((values_of(pieces, at) - expected).abs().max()) < 1e-12
    assert torch.equal(pieces.coefficients[1:][pieces.joined[1:], 0], pieces.coefficients[:-1][pieces.joined[1:], -1])


@pytest.mark.parametrize(
    ("method", "storage"),
    covering(
        product(TENSOR_PRODUCTS, ("float16", "bfloat16", "float32", "int16", "uint8")),
        lambda method, storage: (method, storage, (method == "ncrsi", storage)),
    ),
)
def test_storage(method, storage):
    field = fl.reconstruct(100 + 7 * samples(4, 5, 6), method, storage=storage)
    origins, directions = rays(field)
    pieces = field.pieces_along(origins, directions)
    at = within(pieces)
    expected = field(points_of(pieces, origins, directions, at))
    assert float((values_of(pieces, at) - expected).abs().max()) < 1e-11


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("method", CONTINUOUS)
def test_pieces_cover_the_domain_and_share_their_ends(method, boundary):
    """Without gap or overlap from where a ray enters to where it leaves, and equal to the bit where two meet."""
    field = fl.reconstruct(fl.Volume(samples(4, 5, 6), affine=AFFINE), method, boundary=boundary)
    for origins, directions in (rays(field), awkward_rays(field)):
        pieces = field.pieces_along(origins, directions)
        joined = pieces.joined
        assert int((~joined).sum()) == len(pieces.ray.unique())
        assert bool((pieces.near <= pieces.far).all())
        first, last = ~joined, torch.cat((~joined[1:], torch.ones(1, dtype=torch.bool)))
        for side, at in ((first, pieces.near), (last, pieces.far)):
            t = (pieces.start[pieces.ray] + at)[side, None]
            voxels = voxels_of(origins[pieces.ray[side]] + t * directions[pieces.ray[side]])
            middle = np.abs(voxels - (np.array([6, 5, 4]) - 1) / 2) - np.array([6, 5, 4]) / 2
            outside = np.abs(middle.max(-1))
            inside = (t.numpy()[:, 0] == 0) & (middle.max(-1) < 0)
            assert (inside | (outside < 1e-9)).all()  # the far origin's own rounding is 1e-10
        assert torch.equal(pieces.coefficients[1:][joined[1:], 0], pieces.coefficients[:-1][joined[1:], -1])


@pytest.mark.parametrize("method", CONTINUOUS)
def test_pieces_of_awkward_rays(method):
    field = fl.reconstruct(fl.Volume(samples(4, 5, 6), affine=AFFINE), method)
    origins, directions = awkward_rays(field)
    pieces = field.pieces_along(origins, directions)
    assert len(pieces.ray.unique()) == len(origins)
    at = within(pieces)
    expected = field(points_of(pieces, origins, directions, at))
    near = (pieces.ray < len(origins) - 1)[:, None]
    error = (values_of(pieces, at) - expected).abs()
    assert float((error * near).max()) < 1e-13
    assert float(error.max()) < 1e-8  # from afar: the rounding of o + t d itself


@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_float32_is_rounded_only(method):
    field = fl.reconstruct(samples(6, 6, 6), method, boundary="reflect")
    origins, directions = (x.float() for x in rays(field))
    pieces = field.pieces_along(origins, directions)
    exact = field.pieces_along(origins.double(), directions.double())
    assert pieces.coefficients.dtype == torch.float32
    assert torch.equal(pieces.ray, exact.ray)
    largest = float(field.coefficients.values.abs().max())
    assert float((pieces.coefficients - exact.coefficients).abs().max()) < 3e-6 * largest


def test_a_ray_that_misses_or_leaves_has_no_pieces():
    field = fl.reconstruct(samples(4, 4, 4), "tricubic")
    origins = torch.tensor([[-5.0, 0, 0], [-5.0, 9, 0], [-5.0, 1, 1]])
    directions = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0]])
    pieces = field.pieces_along(origins, directions)
    assert pieces.ray.unique().tolist() == [2]
    assert field.pieces_along(origins[:0], directions[:0]).coefficients.shape == (0, 10)


def test_who_has_no_pieces_says_so():
    ray = torch.zeros(1, 3), torch.ones(1, 3)
    with pytest.raises(TypeError, match="not piecewise polynomial"):
        fl.signals.marschner_lobb().pieces_along(*ray)
    texture = fl.reconstruct(samples(3, 3, 3), "triquadratic", scheme="eight_trilinear", sampler="texture_unit")
    assert texture.degree_along_rays is None
    with pytest.raises(TypeError, match="not piecewise polynomial"):
        texture.pieces_along(*ray)
    batched = fl.reconstruct(samples(2, 1, 3, 3, 3), "triquadratic")
    with pytest.raises(ValueError, match="select"):
        batched.pieces_along(*ray)
    assert batched.select(1, 0).pieces_along(*ray).ray.numel()


# ---- bounds by brick


def straddling(pieces, level: float) -> list[tuple[int, float, float]]:
    c = pieces.coefficients
    mask = (c.amin(-1) <= level) & (c.amax(-1) >= level)
    return [(int(r), float(a), float(b)) for r, a, b in zip(*(x[mask] for x in pieces[:3]), strict=True)]


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_bounds_hold_everywhere_in_a_brick(method, boundary):
    field = fl.reconstruct(fl.Volume(samples(9, 7, 6)), method, boundary=boundary, storage="int16")
    lattice = field.lattice
    found = bounds.ranges(lattice, 4)
    points = torch.rand(20_000, 3, dtype=torch.float64) * torch.tensor(field.coefficients.size) - 0.5
    part = ((points - torch.tensor(lattice.offset, dtype=torch.float64)) / 2).floor().long().unbind(-1)[::-1]
    values = field(points)
    assert bool((found.codes.least(found.low[part]) <= values + 1e-12).all())
    assert bool((found.codes.most(found.high[part]) >= values - 1e-12).all())


@pytest.mark.parametrize("method", CONTINUOUS)
def test_no_piece_that_may_hold_the_level_is_left_out(method):
    field = fl.reconstruct(samples(12, 11, 10) ** 6, method)
    origins, directions = rays(field, 60)
    for level in (-0.05, 0.0, 0.3, 0.9):
        every, some = field.pieces_along(origins, directions), field.pieces_along(origins, directions, level)
        assert straddling(some, level) == straddling(every, level)
    assert len(field.pieces_along(origins, directions, 99).ray) == 0


@pytest.mark.parametrize("edge", [1, 2, 4])
def test_bounds_do_not_depend_on_what_is_summed_at_once(edge, monkeypatch):
    lattice = fl.reconstruct(samples(9, 7, 6), "triquadratic").lattice
    found = []
    for at_once in (1, 8, 1000):
        monkeypatch.setattr(hulls, "_cells_at_once", lambda lattice, at_once=at_once: at_once)
        low, high = zip(*hulls.layers_of(lattice, edge), strict=True)
        found.append(torch.stack((torch.cat(low), torch.cat(high))))
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


@pytest.mark.parametrize("edge", [2, 4])
@pytest.mark.parametrize("name", ["linear", "bspline0", "bspline2", "bspline3", "catmull-rom", "notch"])
def test_bounds_are_the_hulls_of_the_cells(name, edge):
    """Every cell's own Bernstein coefficients, one cell at a time, by the definition of a hull.

    Where the field jumps parts have to hold their neighbours too.
    """
    field = fl.reconstruct(samples(4, 5, 6), from_kernel(KERNELS[name]), prefilter=False, scheme="direct")
    lattice = field.lattice
    found = bounds.ranges(lattice, edge)
    low = torch.full(found.low.shape, math.inf, dtype=torch.float64)
    high = -low
    kernel = lattice.row[0].kernels[0]
    table = bernstein.from_monomial(kernel.taps(torch.float64))
    for z, y, x in np.ndindex(*lattice.cells[::-1]):
        taps = lattice.coefficients[z : z + len(table), y : y + len(table), x : x + len(table)]
        hull = torch.einsum("kji,ka,jb,ic->abc", taps, table, table, table)
        part = tuple(2 * i // edge for i in (z, y, x))
        low[part], high[part] = torch.minimum(low[part], hull.min()), torch.maximum(high[part], hull.max())
    if not lattice.continuous:
        around = [tuple(slice(max(i - 1, 0), i + 2) for i in part) for part in np.ndindex(*low.shape)]
        low = torch.stack([low[own].min() for own in around]).view_as(low)
        high = torch.stack([high[own].max() for own in around]).view_as(high)
    least, most = found.codes.least(found.low), found.codes.most(found.high)
    assert bool(((least <= low + 1e-14) & (most >= high - 1e-14)).all())
    within = found.codes.step * (1 + 1e-9)
    assert bool((low - least <= within)[least.isfinite()].all())
    assert bool((most - high <= within)[most.isfinite()].all())
    assert bool(least.isfinite().all())
    assert bool(most.isfinite().all())


@pytest.mark.parametrize("implementation", ["reference", "cpu"])
@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 2, 64), (2, 17, 129), (16, 24, 40)])
def test_marks_are_those_of_parts_one_by_one(shape, implementation, monkeypatch):
    """Blocks, words and bytes against their definition, a brick at a time."""
    found = partial(bits_of_blocks, implementation=implementation)
    monkeypatch.setattr(bounds, "bits_of_blocks", found)
    generator = torch.Generator().manual_seed(sum(shape))
    low = (torch.randn(shape, generator=generator) * 500).short()
    high = low + 30
    blocks = bounds.Blocks.of(low, high)
    assert torch.equal(blocks.in_order(blocks.low, shape), low)
    holds = (low <= 1510) & (high >= 1500)
    assert torch.equal(blocks.straddling(1500, 1510), holds)
    marks = marks_of_bits(blocks.bits(1500, 1510), implementation)
    assert torch.equal(marks_of(holds), marks)
    whole = np.zeros([2 * -(-n // 2) for n in shape], dtype=bool)
    whole[tuple(slice(n) for n in shape)] = holds.numpy()
    relevant = np.argwhere(whole.reshape(*(k for n in whole.shape for k in (n // 2, 2))).any((1, 3, 5)))
    for z, y, x in np.ndindex(*marks.shape):
        part = whole[2 * z : 2 * z + 2, 2 * y : 2 * y + 2, 2 * x : 2 * x + 2].ravel()
        apart = np.abs(relevant - (z, y, x)).max(1).min(initial=9)
        expected = int(part @ (1 << np.arange(8))) if part.any() else -min(9, apart)
        assert int(marks[z, y, x]) == expected


def test_bounds_see_what_is_written_to_coefficients():
    field = fl.reconstruct(samples(5, 5, 5), "trilinear")
    assert not bool(bounds.ranges(field.lattice).may_hold(5.0, torch.float64).any())
    field.coefficients.values[3, 3, 3] = 9
    assert bool(bounds.ranges(field.lattice).may_hold(5.0, torch.float64).any())


def test_bounds_see_what_is_written_to_a_kernel():
    table = kernels.LINEAR.table().clone()
    field = fl.reconstruct(samples(5, 5, 5), kernels.TensorKernel("scaled", table), prefilter=False)
    before = bounds.ranges(field.lattice).may_hold(0.5, torch.float64)
    assert bool(before.any())
    assert not bool(bounds.ranges(field.lattice).may_hold(13.5, torch.float64).any())
    table *= 3  # along three axes
    assert torch.equal(bounds.ranges(field.lattice).may_hold(13.5, torch.float64), before)


def test_bounds_of_what_is_not_finite_are_none():
    s = samples(12, 12, 12)
    s[9, 9, 9] = math.nan
    field = fl.reconstruct(s, "tricubic", nan="propagate")
    found = bounds.ranges(field.lattice)
    unknown = torch.cat([low for low, _ in hulls.layers_of(field.lattice, 1)]).isnan()
    assert bool(unknown.any())
    assert not bool(unknown.all())
    assert torch.equal(found.may_hold(50.0, torch.float64), unknown)


@pytest.mark.parametrize("outlier", [1e30, -1e300, math.inf])
def test_outliers_cost_bounds_no_precision(outlier):
    """Most values are told apart as well as without them; levels among outliers are held by their neighbours alone."""
    s = samples(12, 12, 12)
    usual = bounds.ranges(fl.reconstruct(s.clone(), "trilinear").lattice)
    s[6, 6, 6] = outlier
    found = bounds.ranges(fl.reconstruct(s, "trilinear", nan="propagate").lattice)
    assert found.codes.step == pytest.approx(usual.codes.step, rel=0.01)
    if math.isfinite(outlier):
        assert 0 < int(found.may_hold(outlier / 2, torch.float32).sum()) <= 8
    else:
        assert int(found.may_hold(0.5, torch.float32).sum()) < found.low.numel()
