"""The program that casts rays against its plain twin: the same hits, the same pieces."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import filterlab as fl
from filterlab.fields.grid import GridField
from filterlab.kernels import KERNELS
from filterlab.methods import from_kernel
from filterlab.ops import cpu
from filterlab.ops.cpu import machine
from filterlab.ops.cpu import raycast as vector_code
from filterlab.ops.differentiable import raycast
from filterlab.ops.raycast import Raycast, bits_of
from tests.test_methods import CONTINUOUS, TENSOR_PRODUCTS

AFFINE = [[1.5, 0.2, 0.1, 3.0], [0.0, -0.8, 0.3, -2.0], [0.1, 0.0, 2.0, 5.0], [0.0, 0.0, 0.0, 1.0]]
LEVEL = 0.5


def samples(seed: int = 0, shape: tuple[int, int, int] = (9, 8, 7)) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rays(field: GridField, count: int = 203, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(1)
    inside = torch.rand(count, 3, generator=g, dtype=torch.float64) * 6
    directions = torch.randn(count, 3, generator=g, dtype=torch.float64)
    directions[::7, 0] = 0  # within planes, along axes, and away from the volume
    directions[::14, 1:] = torch.tensor([0.0, -2.0])
    geometry = field.domain.geometry
    origins = geometry.to_world(inside - 20 * directions * (torch.arange(count) % 3 > 0)[:, None])
    ways = geometry.to_world(directions) - geometry.to_world(torch.zeros_like(directions))
    return origins.to(dtype), ways.to(dtype)


def described(field: GridField, dtype: torch.dtype = torch.float64) -> Raycast:
    o, d = rays(field, 1, dtype)
    return field._raycast(LEVEL, o, d)


def assert_alike(field: GridField, tolerance: float = 1e-12) -> None:
    given, (o, d) = described(field), rays(field)
    assert raycast.missing(given, o) is None
    expected, found = (raycast.first(given, o, d, way) for way in ("reference", "cpu"))
    assert 0.2 < (expected < torch.inf).double().mean() < 1
    assert torch.equal(expected < torch.inf, found < torch.inf)
    hit = expected < torch.inf
    assert float((expected - found)[hit].abs().max()) <= tolerance
    all_, mine = (raycast.candidates(given, o, d, way) for way in ("reference", "cpu"))
    order = mine.ray.argsort(stable=True)  # those with many come later
    assert torch.equal(mine.ray[order], all_.ray)
    for name in ("start", "near", "far", "coefficients"):
        difference = getattr(mine, name)[order] - getattr(all_, name)
        assert float(difference.abs().max()) <= tolerance, name
    for name in ("jump", "repeated"):
        assert torch.equal(getattr(mine, name)[order], getattr(all_, name)), name


def rays_through_a_level_between_cells() -> tuple[Raycast, Tensor, Tensor]:
    """Up and down, at samples 0 … 5 with the level 2: one piece ends on it, and the next begins on it."""
    field = fl.reconstruct(torch.arange(6.0, dtype=torch.float64)[:, None, None].expand(6, 6, 6), "trilinear")
    origins, directions = torch.tensor([[[2.3, 1.7, -3.0], [2.3, 1.7, 9.0]], [[0, 0, 1], [0, 0, -1]]]).double()
    return field._raycast(2.0, origins, directions), origins, directions


def test_a_piece_that_begins_where_one_ended_on_the_level_is_told_of():
    given, o, d = rays_through_a_level_between_cells()
    for way in ("reference", "cpu"):
        found = raycast.candidates(given, o, d, way)
        order = found.ray.argsort(stable=True)
        assert found.ray[order].tolist() == [0, 0, 1, 1]
        assert found.repeated[order].tolist() == [False, True] * 2


@pytest.mark.parametrize("boundary", ["mirror", "zeros"])
@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_the_same_hits_and_pieces(method, boundary):
    assert_alike(fl.reconstruct(fl.Volume(samples(), affine=AFFINE), method, boundary=boundary))


@pytest.mark.parametrize("name", [name for name, kernel in KERNELS.items() if kernel.degree <= 3])
def test_every_kernel(name):
    """Those that jump as well: there every cell is looked into."""
    assert_alike(fl.reconstruct(samples(), from_kernel(KERNELS[name]), prefilter=False))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(16, 24), (2, 3, 8, 16), (15, 100), (7, 9), (33, 3), (1, 64), (64, 1), (2, 0, 8)])
def test_rays_of_an_image_are_hit_as_each_alone(shape, dtype):
    """In packs of two rows, with places left over at the ends; or of one row, where these would be many."""
    field = fl.reconstruct(samples(), "triquadratic")
    o, d = (x.reshape(*shape, 3) for x in rays(field, math.prod(shape), dtype))
    given = described(field, dtype)
    together, alone = (raycast.first(given, *x, "cpu") for x in ((o, d), (o.reshape(-1, 3), d.reshape(-1, 3))))
    assert together.shape == shape
    assert torch.equal(together.flatten(), alone)
    assert math.prod(shape) == 0 or 0.2 < (alone < torch.inf).double().mean() < 1


def test_images_are_cast_in_packs_of_two_rows():
    lanes = machine.lanes_of(torch.float32)
    packs = lambda *shape: vector_code._in_packs(torch.Size(shape), torch.float32)  # noqa: E731
    assert packs(512, 512) == (512, 512, 512 * 512 // lanes, (lanes // 2).bit_length() - 1)
    assert packs(33, 3) == (1, 99, -(-99 // lanes), lanes.bit_length() - 1)
    assert packs(99) == packs(33, 3)


@pytest.mark.parametrize("storage", ["float16", "bfloat16", "float32", "int16", "uint8"])
def test_storage(storage):
    assert_alike(fl.reconstruct(samples(), "triquadratic", storage=storage))


@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_float32_is_rounded_only(method):
    field = fl.reconstruct(samples(), method)
    o, d = rays(field, 2000, torch.float32)
    exact = raycast.first(described(field), o.double(), d.double(), "cpu")
    found = raycast.first(described(field, torch.float32), o, d, "cpu")
    plain = raycast.first(described(field, torch.float32), o, d, "reference")
    for other in (exact, plain):
        assert float(((other < torch.inf) == (found < torch.inf)).double().mean()) > 0.998
        same = (other - found).abs() < 1e-4
        assert float(same[(other < torch.inf) & (found < torch.inf)].double().mean()) > 0.998


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("method", CONTINUOUS)
def test_neighbouring_pieces_share_their_ends_to_the_bit(method, dtype):
    field = fl.reconstruct(fl.Volume(samples(), affine=AFFINE), method)
    found = raycast.candidates(described(field, dtype), *rays(field, 2000, dtype), "cpu")
    order = found.ray.argsort(stable=True)
    ray, near, far, c = (x[order] for x in (found.ray, found.near, found.far, found.coefficients))
    joined = (ray[1:] == ray[:-1]) & (near[1:] == far[:-1])
    assert int(joined.sum()) > 100
    assert torch.equal(c[1:][joined, 0], c[:-1][joined, -1])


@pytest.mark.parametrize("way", ["reference", "cpu"])
def test_a_level_that_is_reached_where_the_domain_ends_is_hit_there(way):
    """Coefficients 1 and −1 meet at the last face, half of each: 0, to the bit, and nothing follows."""
    line = torch.tensor([-1.0, 3, 3, 3, 3, 1], dtype=torch.float64)
    field = fl.reconstruct(line.expand(4, 4, 6), "triquadratic", boundary="wrap", prefilter=False)
    o, d = torch.tensor([[2.2, 1.3, 1.6]], dtype=torch.float64), torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    given = field._raycast(0.0, o, d)
    assert raycast.candidates(given, o, d, way).coefficients[-1, -1] == 0
    assert torch.allclose(raycast.first(given, o, d, way), o.new_tensor([5.5 - 2.2]), rtol=0, atol=1e-12)


def rays_on_the_last_faces() -> tuple[GridField, Tensor, Tensor]:
    """Of a sheet y = 3 between clear bricks, the last of which are cut off by the end of the domain."""
    y = torch.arange(7, dtype=torch.float64)[:, None].expand(7, 7, 7)
    field = fl.reconstruct(y, "triquadratic", boundary="border", prefilter=False)
    end = field.domain.upper[0]
    o = torch.tensor([[end, -9.0, 2.2], [end, 14.0, end], [2.2, -0.5, end], [end, end, 1.0], [end, 6.0, 0.7]])
    d = torch.tensor([[0.0, 1.0, 0.0], [0.0, -2.0, 0.0], [0.0, 1.0, 0.0], [-0.1, -1.0, 0.0], [0.0, -1.0, 0.3]])
    return field, o.double(), d.double()


def test_rays_on_the_last_faces_of_the_domain():
    """Over clear bricks they were led out of the lattice, once: a place on the end is that of no cell."""
    field, o, d = rays_on_the_last_faces()
    given = field._raycast(3.0, o, d)
    assert (given.marks < 0).any()
    expected = raycast.first(given, o, d, "reference")
    assert (expected < torch.inf).all()
    assert torch.allclose(raycast.first(given, o, d, "cpu"), expected, rtol=0, atol=1e-12)


def test_many_pieces_of_a_ray_are_cast_again(monkeypatch):
    """Eight of one ray find room at first, then eight times as many, and none is lost or told twice."""
    field = fl.reconstruct(samples(3, (5, 5, 90)), "trilinear")
    o = torch.tensor([[-2.0, 2.3, 1.7], [200.0, 0.0, 0.0], [92.0, 1.2, 3.1]], dtype=torch.float64)
    d = torch.tensor([[1.0, 0.01, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.004]], dtype=torch.float64)
    all_, mine = (raycast.candidates(described(field), o, d, way) for way in ("reference", "cpu"))
    assert (all_.ray == 0).sum() > 32
    order = mine.ray.argsort(stable=True)
    assert torch.equal(mine.ray[order], all_.ray)
    assert torch.allclose(mine.near[order], all_.near, rtol=0, atol=1e-12)


def test_no_rays():
    field = fl.reconstruct(samples(), "triquadratic")
    o, d = rays(field, 0)
    for way in ("reference", "cpu"):
        assert raycast.first(described(field), o, d, way).shape == (0,)
        assert raycast.candidates(described(field), o, d, way).coefficients.shape == (0, 7)


def test_threads_change_no_bit(monkeypatch):
    field = fl.reconstruct(samples(), "triquadratic")
    o, d = rays(field, 3000)
    results = []
    for threads in (1, 2, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        results.append(raycast.first(described(field), o, d, "cpu"))
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_a_ray_is_what_it_is_in_any_company():
    field = fl.reconstruct(samples(), "tricubic")
    o, d = rays(field, 40)
    together = raycast.first(described(field), o, d, "cpu")
    alone = torch.cat([raycast.first(described(field), o[i : i + 1], d[i : i + 1], "cpu") for i in range(40)])
    assert torch.equal(together, alone)


def test_what_cannot_run_is_said_and_runs_plainly(monkeypatch):
    field = fl.reconstruct(samples(), "triquadratic")
    o, d = rays(field)
    expected = raycast.first(described(field), o, d, "reference")
    monkeypatch.setattr(cpu, "llvmlite_problem", lambda: "no llvmlite")
    assert raycast.missing(described(field), o) == "no llvmlite"
    assert torch.equal(raycast.first(described(field), o, d), expected)
    plain = fl.reconstruct(samples(), "triquadratic", scheme="direct").first_crossing(o, d, LEVEL)
    assert torch.allclose(plain, expected, rtol=0, atol=1e-12)  # its prefilter is another one


@pytest.mark.parametrize("implementation", ["reference", "cpu"])
def test_clear_bricks_are_as_far_from_the_others_as_is_said(implementation):
    g = torch.Generator().manual_seed(0)
    parts = torch.rand(41, 11, 94, generator=g) < 0.0002
    marks = raycast.marks_of_bits(bits_of(torch.nn.functional.pad(parts, (0, 0, 0, 1, 0, 1))), implementation)
    assert marks.shape == (21, 6, 47)
    clear, relevant = (-marks).clamp_min(0), marks > 0
    assert set(clear.unique().tolist()) == set(range(10))
    for part in torch.randint(0, 1 << 30, (2000, 3), generator=g).remainder(torch.tensor(parts.shape)).tolist():
        z, y, x = (i % 2 for i in part)
        mark = int(marks[tuple(i // 2 for i in part)])
        assert (mark > 0 and bool(mark >> (x + 2 * y + 4 * z) & 1)) == bool(parts[tuple(part)])
    assert int(sum((marks[relevant] >> k) & 1 for k in range(8)).sum()) == int(parts.sum())
    where = relevant.nonzero()
    for brick in torch.randint(0, 1 << 30, (400, 3), generator=g).remainder(torch.tensor(relevant.shape)):
        distance = int((where - brick).abs().amax(1).min())
        expected = max((1 + r for r in range(9) if r < distance), default=0)
        assert clear[tuple(brick)] == expected
