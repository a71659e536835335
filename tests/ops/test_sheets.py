"""The program that writes k sheets against its plain twin: as many hits, in the same places, in the same order."""

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
from filterlab.ops.cpu import raycast as cpu_raycast
from filterlab.ops.differentiable import raycast
from filterlab.ops.raycast import Raycast, Sheets
from filterlab.surfaces import LevelSet
from tests.ops.test_raycast import AFFINE, LEVEL, described, rays, rays_through_a_level_between_cells, samples

EXTENT = 20.0
JUMPING = [name for name, kernel in KERNELS.items() if kernel.degree <= 3 and kernel.continuity < 0]


def asked(count: int, farthest: bool = False) -> Sheets:
    return Sheets(count, farthest, EXTENT)


def of_twin(given: Raycast, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """50 sheets, more than any ray has, from the first on and from the last on."""
    near = raycast.sheets(given, o, d, asked(50), "reference")
    assert (near[:, -1] == torch.inf).all()
    return near, torch.stack([torch.cat((t[t < torch.inf].flip(0), t[t == torch.inf])) for t in near])


def assert_near(found: Tensor, expected: Tensor, tolerance: float = 1e-11) -> None:
    assert found.shape == expected.shape
    hit = expected < torch.inf
    assert torch.equal(hit, found < torch.inf)
    assert float((found - expected)[hit].abs().max()) <= tolerance


def assert_alike(given: Raycast, o: Tensor, d: Tensor) -> None:
    assert raycast.missing(given, o) is None
    near, far = of_twin(given, o, d)
    assert int((near < torch.inf).sum(1).max()) > 3
    for count in (1, 3, 8, 50):
        for farthest, every in ((False, near), (True, far)):
            assert_near(raycast.sheets(given, o, d, asked(count, farthest), "cpu"), every[:, :count])
    assert torch.equal(raycast.sheets(given, o, d, asked(3, True), "reference"), far[:, :3])
    first = raycast.first(given, o, d, "cpu")
    for count in (1, 2, 8):
        assert torch.equal(raycast.sheets(given, o, d, asked(count), "cpu")[:, 0], first)


@pytest.mark.parametrize(
    ("method", "boundary"),
    [*zip(("nearest", "trilinear", "ncrsi", "triquadratic", "tricubic"), map(str, fl.Boundary), strict=True)],
)
def test_the_same_sheets(method, boundary):
    field = fl.reconstruct(fl.Volume(samples(), affine=AFFINE), method, boundary=boundary)
    assert_alike(described(field), *rays(field))


@pytest.mark.parametrize("name", JUMPING)
def test_of_fields_that_jump(name):
    field = fl.reconstruct(samples(), from_kernel(KERNELS[name]), prefilter=False)
    assert_alike(described(field), *rays(field))


def test_float32_is_rounded_only():
    field = fl.reconstruct(samples(), "tricubic")
    o, d = rays(field, 2000, torch.float32)
    given = described(field, torch.float32)
    expected, found = (raycast.sheets(given, o, d, asked(50), way) for way in ("reference", "cpu"))
    same = ((expected < torch.inf) == (found < torch.inf)).all(1)
    assert float(same.double().mean()) > 0.998
    apart = (expected - found)[same].nan_to_num(0.0).abs()
    assert float((apart < 1e-4).double().mean()) > 0.998


def test_where_coefficients_are_missing():
    values = samples()
    values[4, 3, 3] = math.nan
    field = fl.reconstruct(values, "trilinear", nan="propagate")
    given, (o, d) = described(field), rays(field)
    whole = raycast.sheets(described(fl.reconstruct(samples(), "trilinear")), o, d, asked(8), "cpu")
    found = raycast.sheets(given, o, d, asked(8), "cpu")
    assert_near(found, raycast.sheets(given, o, d, asked(8), "reference"))
    assert not torch.equal(found, whole)


# --- roots that are none of one sign change ---------------------------------------------------------------------------


def along_z(values: list[float], method: str = "trilinear", **how) -> GridField:
    return fl.reconstruct(torch.tensor(values, dtype=torch.float64)[:, None, None].expand(-1, 6, 6), method, **how)


def parabola() -> list[float]:
    """(z − 6.3)² at 0 … 12."""
    return ((torch.arange(13.0, dtype=torch.float64) - 6.3) ** 2).tolist()


def up_and_down(field: GridField, level: float) -> tuple[Raycast, Tensor, Tensor]:
    o = torch.tensor([[2.3, 1.7, -3.0], [2.3, 1.7, 19.0], [2.3, 1.7, 2.0]], dtype=torch.float64)
    d = torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, 0, 1]], dtype=torch.float64)
    return field._raycast(level, o, d), o, d


def test_a_level_between_two_pieces_is_one_hit():
    given, o, d = rays_through_a_level_between_cells()
    assert raycast.sheets(given, o, d, asked(3), "cpu").tolist() == [
        [5.0, math.inf, math.inf],
        [7.0, math.inf, math.inf],
    ]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.0, 1, 2, 2, 2, 3], [5.0]),
        ([0.0, 2, 0, 2, 3, 2], [4.0, 6.0, 8.0]),
        ([3.0, 2, 2, 3, 0, 3], [4.0, 6 + 1 / 3, 7 + 2 / 3, 8 + 1 / 3]),
    ],
)
def test_stretches_on_the_level_and_corners_at_it(values, expected):
    given, o, d = up_and_down(along_z(values), 2.0)
    every, _ = of_twin(given, o, d)
    found = raycast.sheets(given, o, d, asked(50), "cpu")
    assert_near(found, every, 1e-12)
    assert found[0, : len(expected) + 1].tolist() == pytest.approx([*expected, math.inf], abs=1e-12)


@pytest.mark.parametrize("depth", [0.0, 1e-16, 1e-13, 1e-10, 1e-6, -1e-13, -1e-10, -1e-6])
@pytest.mark.parametrize("method", ["triquadratic", "tricubic"])
def test_two_roots_that_are_nearly_one(method, depth):
    """(z − 6.3)² = depth: two hits, one where rounding hides which, or none, and all of them twice from both sides."""
    given, o, d = up_and_down(along_z(parabola(), method, boundary="border"), depth)
    every, _ = of_twin(given, o, d)
    found = raycast.sheets(given, o, d, asked(50), "cpu")
    assert torch.equal(found < torch.inf, every < torch.inf)
    assert_near(found, every, 1e-6)
    assert_near(raycast.sheets(given, o, d, asked(1), "cpu"), raycast.first(given, o, d, "cpu")[:, None], 0.0)


def test_hits_that_rounding_alone_has_apart_are_one():
    """It is taken for so large here that those 0.6 apart are one, those 1.4 apart are not."""
    given, o, d = up_and_down(along_z([0.0, 1.0] * 4), 0.3)
    how = Sheets(30, False, 0.7 / (32 * 2.0**-52))
    found = raycast.sheets(given, o, d, how, "cpu")
    assert_near(found, raycast.sheets(given, o, d, how, "reference"))
    assert int((found[0] < torch.inf).sum()) == 4
    assert float(found[0, 0]) == pytest.approx(2.7, abs=1e-12)


def test_many_sheets_of_a_ray():
    """Of 101, two of them on faces of the domain, the first, the last, and all; and one less or more than there are."""
    field = along_z([0.0, 1.0] * 50)
    given, o, d = up_and_down(field, LEVEL)
    expected = torch.arange(101, dtype=torch.float64) + 2.5
    for count in (1, 7, 100, 101, 102, 130):
        near, far = (raycast.sheets(given, o, d, asked(count, way), "cpu")[0] for way in (False, True))
        pad = expected.new_full((max(0, count - 101),), math.inf)
        assert torch.allclose(near, torch.cat((expected[:count], pad)), rtol=0, atol=1e-12)
        assert torch.allclose(far, torch.cat((expected.flip(0)[:count], pad)), rtol=0, atol=1e-12)


# --- rays in company --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("farthest", [False, True])
@pytest.mark.parametrize("shape", [(16, 24), (2, 0, 8), (7, 9), (203,)])
def test_rays_of_an_image_are_hit_as_each_alone(shape, farthest, monkeypatch):
    field = fl.reconstruct(samples(), "triquadratic")
    o, d = (x.reshape(*shape, 3) for x in rays(field, math.prod(shape)))
    found = raycast.sheets(described(field), o, d, asked(3, farthest), "cpu")
    assert found.shape == (*shape, 3)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    each = [raycast.sheets(described(field), *x, asked(3, farthest), "cpu") for x in rays_one_by_one(o, d)]
    assert torch.equal(found.reshape(-1, 3), torch.stack(each) if each else found.reshape(-1, 3))


def test_sheets_of_an_image_go_in_packs_of_two_rows_as_first_hits_do(monkeypatch):
    shapes = []
    packed = cpu_raycast._in_packs
    monkeypatch.setattr(cpu_raycast, "_in_packs", lambda shape, dtype: shapes.append(shape) or packed(shape, dtype))
    field = fl.reconstruct(samples(), "triquadratic")
    o, d = (x.reshape(16, 24, 3) for x in rays(field, 384))
    surface = LevelSet(field, LEVEL)
    hits = surface.hits(o, d, 3)
    assert shapes == [(16, 24)]
    assert torch.equal(hits.t[..., 0], surface.hit(o, d).t)
    assert shapes == [(16, 24)] * 2
    each = surface.hits(o.reshape(-1, 3), d.reshape(-1, 3), 3).t.reshape(16, 24, 3)
    assert torch.equal(hits.t, each)


def rays_one_by_one(o: Tensor, d: Tensor) -> list[tuple[Tensor, Tensor]]:
    return list(zip(o.reshape(-1, 3), d.reshape(-1, 3), strict=True))


def test_what_cannot_run_runs_plainly(monkeypatch):
    field = fl.reconstruct(samples(), "triquadratic")
    o, d = rays(field, 40)
    expected = raycast.sheets(described(field), o, d, asked(3), "reference")
    monkeypatch.setattr(cpu, "llvmlite_problem", lambda: "no llvmlite")
    assert torch.equal(raycast.sheets(described(field), o, d, asked(3)), expected)
