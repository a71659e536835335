"""Level sets: every crossing and no other, against an oracle that shares no code; policies; derivatives; bad input."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

import filterlab as fl
from filterlab import surfaces
from filterlab.fields.base import Field
from filterlab.kernels import KERNELS
from filterlab.methods import METHODS, from_kernel
from filterlab.render import PerspectiveCamera
from filterlab.surfaces import LevelSet
from tests import laws, ray_oracle
from tests.level_set_rays import (
    BOUNDARIES,
    CLASSES,
    FAULTS,
    SIZE,
    Case,
    axis_parallel,
    campaign,
    from_far,
    inside_out,
    on_faces,
    one,
    random,
    through_edges_and_corners,
)
from tests.pairs import covering
from tests.ray_oracle import DEGREES
from tests.test_methods import CONTINUOUS

NEAR = (random, axis_parallel, on_faces, through_edges_and_corners, inside_out)


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random(shape))


def grid(n: int = 12) -> tuple[Tensor, Tensor, Tensor]:
    """x, y, z of n³ voxels, measured from their middle."""
    axis = torch.arange(n, dtype=torch.float64) - (n - 1) / 2
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    return x, y, z


def ball(n: int = 12) -> Tensor:
    """−|x|²: greater inside."""
    return -sum(c * c for c in grid(n))


def random_rays(seed: int, count: int) -> tuple[Tensor, Tensor]:
    """At a volume of SIZE, in voxel coordinates."""
    size = Case("trilinear", np.zeros(SIZE[::-1]), "mirror", 0.5)
    origins, directions = random(np.random.default_rng(seed), size, count)
    return torch.from_numpy(origins), torch.from_numpy(directions)


def assert_all_found(method: str, boundary: str, classes, count: int, seed: int, level: float = 0.5) -> dict[str, int]:
    rng = np.random.default_rng(seed)
    case = Case(method, rng.random(SIZE[::-1]), boundary, level)
    rays = [np.concatenate(x) for x in zip(*(make(rng, case, count) for make in classes), strict=True)]
    far = from_far in classes
    truth, surface = case.truth((rays[0], rays[1]), 3e-8 if far else 1e-11), case.surface()
    o, d = map(torch.from_numpy, rays)
    hits, first = surface.hits(o, d, 40), surface.hit(o, d)
    for t in (hits.t, first.t[:, None]):
        verdict = ray_oracle.judged(truth, t.numpy(), 1e-6 if far else 1e-9)
        assert verdict["missed"] == verdict["invented"] == verdict["misplaced"] == 0, (method, boundary, verdict)
    last = surface.hits(o, d, 1, farthest=True).t[:, 0]
    assert torch.equal(last[first.valid], hits.t[first.valid].nan_to_num(posinf=-1).amax(-1))
    values = case.sum(surface.at(o, d, first).point[first.valid].numpy())
    assert np.abs(values - level).max(initial=0) <= 1e-12 * np.ptp(case.samples)
    return verdict


def beyond(boundary: str) -> str:
    """What is outside: copies of what is inside, or one number along each line."""
    return "one number" if boundary in ("border", "zeros") else "copies"


@pytest.mark.parametrize(
    ("method", "boundary"),
    covering(product(CONTINUOUS, BOUNDARIES), lambda method, boundary: (boundary, (method, beyond(boundary)))),
)
def test_every_crossing_is_found_and_no_other(method, boundary):
    counts = [assert_all_found(method, boundary, classes, 6, 0) for classes in (NEAR, (from_far,))]
    assert sum(count["undecided"] for count in counts) <= 3


@pytest.mark.parametrize(("method", "kind"), covering(product(DEGREES, CLASSES), lambda method, kind: (method, kind)))
def test_rays_of_every_class(method, kind):
    """`campaign` takes all of them, and as many rays as there is time."""
    verdict = one(method, kind, BOUNDARIES[len(method + kind) % 5], 40, 2)
    assert not any(verdict[fault] for fault in FAULTS), verdict
    assert verdict["undecided"] <= verdict["rays"] / 4


def test_a_campaign_counts_what_it_did():
    found = campaign(0.3, rays=5)
    assert sum(verdict["rays"] for verdict in found.values()) >= 5


@pytest.mark.parametrize(("method", "boundary", "seed"), [("triquadratic", "border", 1404), ("tricubic", "wrap", 1418)])
def test_nearly_tangent_rays_from_far(method, boundary, seed):
    """Off by 2e-11 once: a slope of 0.03 makes of the rounding of o + t d thirty times as long a way."""
    assert_all_found(method, boundary, (from_far,), 60, seed)


@pytest.mark.parametrize("method", CONTINUOUS)
def test_oblique_geometry_moves_nothing(method):
    samples = noise(5, 6, 7)
    affine = np.array([[1.0, 0.2, 0.0, 3.0], [0.0, 0.5, 0.1, 1.0], [0.1, 0.0, 2.0, -5.0], [0.0, 0.0, 0.0, 1.0]])
    plain, oblique = (LevelSet(fl.reconstruct(v, method), 0.5) for v in (samples, fl.Volume(samples, affine=affine)))
    origins, directions = random_rays(3, 60)
    geometry = oblique.domain.geometry
    moved = geometry.to_world(origins), geometry.to_world(directions) - geometry.to_world(torch.zeros(3).double())
    a, b = (s.hits(*rays, 20).t for s, rays in ((plain, (origins, directions)), (oblique, moved)))
    assert torch.equal(a.isfinite(), b.isfinite())
    assert int(a.isfinite().sum()) > 60
    assert float((a - b)[a.isfinite()].abs().max()) < 1e-9 * 100


QUADRATIC = [m for m in CONTINUOUS if m != "trilinear"]
"""Methods that reproduce quadratics: without prefilter Σ_k k² φ(x − k) = x² + ∫ x² φ."""


def quadratics(method: str, shift: int = 1) -> float:
    """What a kernel adds to each x² that is summed with it."""
    return float(shift * METHODS[method].kernel.moment(2))


@pytest.mark.parametrize("offset", [1e-2, 1e-4, 1e-6, 1e-8])
@pytest.mark.parametrize("method", QUADRATIC)
def test_a_grazed_sphere(method, offset):
    """|x|² is reproduced exactly: rays at distance r(1 − offset) hit twice, at r(1 + offset) never."""
    field = fl.reconstruct(ball() + quadratics(method, 3), method, prefilter=False)
    surface, r = LevelSet(field, -9.0), 3.0
    rng = np.random.default_rng(1)
    side, across = np.linalg.qr(rng.normal(size=(30, 3, 2)))[0].transpose(2, 0, 1)
    centre = np.array(field.domain.center)
    for sign, expected in ((-1, 2), (1, 0)):
        origins = torch.from_numpy(centre + r * (1 + sign * offset) * side - 20 * across)
        t = surface.hits(origins, torch.from_numpy(across.copy()), 4).t
        assert (t.isfinite().sum(-1) == expected).all()
        half = r * math.sqrt(offset * (2 - offset))
        if expected:
            assert np.abs(t[:, :2].numpy() - (20 + np.array([-half, half]))).max() < 1e-14 * 20 * 9 / half + 1e-12


@pytest.mark.parametrize("method", QUADRATIC)
def test_a_thin_shell(method):
    """(x − 6.3)² = δ²: two hits 1e-6 voxels apart, from either side."""
    x, _, _ = grid(13)
    samples = (x + 6 - 6.3) ** 2 - quadratics(method)
    surface = LevelSet(fl.reconstruct(samples, method, prefilter=False), 2.5e-13)
    for sign in (-1.0, 1.0):
        origins = torch.tensor([[6.3 - 20 * sign, 6.2, 5.1], [6.3 - 20 * sign, 5.5, 6.0]], dtype=torch.float64)
        directions = torch.tensor([[sign, 0.0, 0.0]], dtype=torch.float64)
        t = surface.hits(origins, directions, 4).t
        assert (t.isfinite().sum(-1) == 2).all()
        assert float((t[:, :2] - 20 - torch.tensor([-5e-7, 5e-7])).abs().max()) < 5e-8
        assert float((surface.hit(origins, directions).t - 20 + 5e-7).abs().max()) < 5e-8


@pytest.mark.parametrize("method", CONTINUOUS)
def test_closed_level_sets_are_crossed_an_even_number_of_times(method):
    samples = torch.zeros(14, 14, 14, dtype=torch.float64)
    samples[4:-4, 4:-4, 4:-4] = noise(6, 6, 6)
    surface = LevelSet(fl.reconstruct(samples, method), 0.45)
    origins, directions = random_rays(5, 400)
    origins = origins + torch.tensor([3.5, 4, 4.5]) - 60 * torch.nn.functional.normalize(directions, dim=-1)
    count = surface.hits(origins, directions, 60).valid.sum(-1)
    assert int(count.max()) > 2
    assert (count % 2 == 0).all()


@pytest.mark.parametrize(
    ("method", "boundary", "dtype"),
    covering(
        product(CONTINUOUS, BOUNDARIES, (torch.float64, torch.float32)),
        lambda method, boundary, dtype: (method, (boundary, dtype)),
    ),
)
def test_no_ray_slips_through(method, boundary, dtype):
    """A level set that covers the frame: rays between and along all planes of knots."""
    _, _, z = grid(9)
    surface = LevelSet(fl.reconstruct(z + 0.5 * noise(9, 9, 9), method, boundary=boundary, storage="float32"), 0.1)
    steps = torch.arange(4, 28, dtype=torch.float64) / 4
    x, y = torch.meshgrid(steps, steps, indexing="ij")
    origins = torch.stack((x, y, torch.full_like(x, -4.0)), -1)
    for tilt in ([0.0, 0.0, 1.0], [0.01, 0.0, 1.0]):
        directions = torch.tensor(tilt, dtype=dtype)
        assert bool(surface.hit(origins.to(dtype), directions).valid.all())


def test_float32_differs_by_rounding_only():
    for method in CONTINUOUS:
        surface = LevelSet(fl.reconstruct(noise(5, 6, 7), method, storage="float32"), 0.5)
        origins, directions = (x.float() for x in random_rays(2, 300))
        single, double = surface.hit(origins, directions), surface.hit(origins.double(), directions.double())
        assert single.t.dtype == torch.float32
        point, d = surface.at(origins.double(), directions.double(), double), directions.double()
        steep = ((point.gradient * d).sum(-1) / d.norm(dim=-1)).abs() > 1e-3
        assert torch.equal(single.valid[steep | ~double.valid], double.valid[steep | ~double.valid])
        apart = (single.t.double() - double.t)[steep & double.valid] * d.norm(dim=-1)[steep & double.valid]
        assert float(apart.abs().max()) < 2e-3


# ---- policies


def parabola() -> Field:
    """(x − 3.25)², exactly, in the middle of 8 × 6 × 6 voxels."""
    x = torch.arange(8, dtype=torch.float64)
    return fl.reconstruct(((x - 3.25) ** 2).expand(6, 6, 8).contiguous(), "catmull-rom", boundary="border")


def test_a_touch_is_one_hit():
    origins, directions = torch.tensor([[-1.0, 2.5, 2.25]]).double(), torch.tensor([[2.0, 0, 0]]).double()
    for level, expected in ((0.0, [2.125]), (0.25, [1.875, 2.375])):
        hits = LevelSet(parabola(), level).hits(origins, directions, 4).t
        assert hits[hits.isfinite()].tolist() == pytest.approx(expected, abs=1e-7)
    assert float(LevelSet(parabola(), 0.0).hit(origins, directions).t) == pytest.approx(2.125, abs=1e-7)
    assert not bool(LevelSet(parabola(), -1e-9).hit(origins, directions).valid)


def test_a_touch_has_no_derivative():
    origins = torch.tensor([[-1.0, 2.5, 2.25]], dtype=torch.float64, requires_grad=True)
    t = LevelSet(parabola(), 0.0).hit(origins, torch.tensor([[2.0, 0, 0]]).double()).t
    (gradient,) = torch.autograd.grad(t.sum(), origins)
    assert bool(gradient.isfinite().all())


@pytest.mark.parametrize("name", ["linear", "catmull-rom", "bspline2", "bspline3"])
def test_a_crossing_at_a_knot_is_one_hit(name):
    """f = x: levels at knots of either parity, along the axis and through corners of cells."""
    x = torch.arange(8, dtype=torch.float64).expand(8, 8, 8).contiguous()
    field = fl.reconstruct(x, from_kernel(KERNELS[name]), prefilter=False, boundary="border")
    origins = torch.tensor([[-2.0, 3, 3], [-2, 3.5, 3.5], [-2, -2, -2], [-1.5, -2, -2], [-2, 3, 2.5]]).double()
    directions = torch.tensor([[1.0, 0, 0], [1, 0, 0], [1, 1, 1], [1, 1, 1], [1, 0, 0]]).double()
    for level in (3.0, 3.5, 4.0, 4.5):
        t = LevelSet(field, level).hits(origins, directions, 5).t
        assert (t.isfinite().sum(-1) == 1).all()
        assert float((t[:, 0] - (level - origins[:, 0])).abs().max()) < 1e-14 * 8


@pytest.mark.parametrize("method", [m for m in CONTINUOUS if m != "trilinear"])
def test_a_crossing_where_cells_meet_is_one_hit(method):
    """Rays through a corner of cells, not exactly, at its level: pieces no longer than rounding held several roots."""
    rng = np.random.default_rng(0)
    samples = rng.random(SIZE[::-1])
    f = ray_oracle.Sum(method, samples, "mirror")
    aim, directions = np.array([3.0, 2.0, 2.0]) + f.knots, rng.normal(size=(40, 3))
    level = float(f(aim[None])[0])
    truth = ray_oracle.crossings(f, aim - 16 * directions, directions, level)
    surface = LevelSet(fl.reconstruct(torch.from_numpy(samples), method), level)
    hits = surface.hits(torch.from_numpy(aim - 16 * directions), torch.from_numpy(directions), 40).t
    verdict = ray_oracle.judged(truth, hits.numpy(), 1e-9)
    assert verdict["missed"] == verdict["invented"] == verdict["misplaced"] == 0, verdict
    assert verdict["undecided"] < 10 < verdict["hits"]


def test_a_stretch_on_the_level_hits_where_it_begins():
    samples = torch.ones(8, 8, 8, dtype=torch.float64)
    samples[:, :, 3:] = 0
    surface = LevelSet(fl.reconstruct(samples, "trilinear"), 0.0)
    ray = torch.tensor([[-2.0, 3.2, 3.7]]).double(), torch.tensor([[1.0, 0, 0]]).double()
    assert surface.hit(*ray).t.tolist() == [5.0]
    assert surface.hits(*ray, 20).t[0, 0] == 5.0
    inside = torch.tensor([[5.2, 3.2, 3.7]]).double(), ray[1]
    assert surface.hit(*inside).t.tolist() == [0.0]


def test_a_jump_over_the_level_is_a_hit():
    samples = torch.zeros(6, 6, 6, dtype=torch.float64)
    samples[:, :, 3:] = 1
    field = fl.reconstruct(samples, from_kernel(KERNELS["bspline0"]), prefilter=False, scheme="direct")
    t = LevelSet(field, 0.4).hits(torch.tensor([[-2.0, 3.2, 1.7]]).double(), torch.tensor([[1.0, 0, 0]]).double(), 3).t
    assert t.tolist() == [[4.5, math.inf, math.inf]]


def test_nothing_behind_the_origin_is_hit_and_the_surface_at_it_is():
    surface = LevelSet(fl.reconstruct(grid()[0].contiguous(), "triquadratic", boundary="border"), 0.0)
    origins = torch.tensor([[6.5, 5.0, 5.0], [5.5, 5.0, 5.0], [5.0, 5.0, 5.0]]).double()
    assert surface.hit(origins, torch.tensor([1.0, 0, 0]).double()).t.tolist() == pytest.approx([math.inf, 0.0, 0.5])


@pytest.mark.parametrize("level", [-1e9, 50.0, 1e300])
def test_a_level_that_no_value_has_hits_nothing(level):
    surface = LevelSet(fl.reconstruct(noise(6, 6, 6), "tricubic"), level)
    origins, directions = random_rays(0, 50)
    assert not bool(surface.hit(origins, directions).valid.any())
    assert surface.relevant() == (0, 0)


@pytest.mark.parametrize("method", CONTINUOUS)
def test_missing_voxels_are_holes(method):
    """Only where a kernel reaches one; elsewhere every bit stays."""
    samples = ball()
    whole = LevelSet(fl.reconstruct(samples, method), -9.0)
    samples[5, 5, 8] = math.nan
    holed = LevelSet(fl.reconstruct(samples, method, nan="propagate"), -9.0)
    rng = np.random.default_rng(0)
    origins = torch.from_numpy(rng.normal(size=(500, 3)) * 12 + 5.5)
    directions = 5.5 - origins + torch.from_numpy(rng.normal(size=(500, 3)))
    a, b = whole.hit(origins, directions), holed.hit(origins, directions)
    point = whole.at(origins, directions, a).point
    away = a.valid & ((point - torch.tensor([8.0, 5, 5])).abs().amax(-1) > 3.1)
    at_it = a.valid & ((point - torch.tensor([8.0, 5, 5])).abs().amax(-1) < 0.4)
    assert int(away.sum()) > 100
    assert int(at_it.sum()) > 0
    assert float((a.t - b.t)[away].abs().max()) < 1e-2  # prefilters fill what is missing
    assert not bool((b.t == a.t)[at_it].any())
    assert bool(b.t[b.valid].isfinite().all())


@pytest.mark.parametrize("scheme", ["fused", "direct"])
def test_rays_of_any_shape_and_memory_by_parts(scheme, monkeypatch):
    surface = LevelSet(fl.reconstruct(noise(6, 6, 6), "triquadratic", scheme=scheme), 0.5)
    origins, directions = random_rays(4, 60)
    t = surface.hit(origins, directions).t
    sheets = surface.hits(origins, directions, 3)
    monkeypatch.setattr("filterlab.ops.reference.raycast.RAYS_AT_ONCE", 7)
    monkeypatch.setattr("filterlab.ops.reference.raycast.PIECES_AT_ONCE", 100)
    monkeypatch.setattr("filterlab.ops.raycast._NUMBERS_AT_ONCE", 100)
    shaped = origins.reshape(3, 4, 5, 3), directions.reshape(3, 4, 5, 3)
    assert torch.equal(surface.hit(*shaped).t, t.reshape(3, 4, 5))
    several = surface.hits(*shaped, 3)
    assert torch.equal(several.t, sheets.t.reshape(3, 4, 5, 3))
    assert surface.at(*shaped, several).normal.shape == (3, 4, 5, 3, 3)
    assert surface.hit(origins[0], directions[0]).t.shape == ()
    assert surface.hit(origins[:0], directions[:0]).t.shape == (0,)
    assert surface.hit(origins[0], directions).t.shape == (60,)


def test_relevant_cells_are_those_whose_hulls_straddle_the_level():
    surface = LevelSet(fl.reconstruct(noise(4, 5, 6), "trilinear"), 0.5)
    padded = np.pad(noise(4, 5, 6).numpy(), 1, mode="reflect")
    corners = np.stack([padded[z : z + 5, y : y + 6, x : x + 7] for z, y, x in np.ndindex(2, 2, 2)])
    cells = int(((corners.min(0) <= 0.5) & (corners.max(0) >= 0.5)).sum())
    assert surface.relevant() == (cells, cells)


# ---- points, normals, curvatures


def test_curvatures_of_a_torus():
    """Against the closed form: 1/r and cos v / (R + r cos v), of a solid torus whose values are greater inside."""
    x, y, z = grid(33)
    ring, radius, h = 8.0, 4.0, 1.0
    samples = -torch.hypot(torch.hypot(x, y) - ring, z)
    field = fl.reconstruct(fl.Volume(samples, spacing=h, origin=(-16.0, -16.0, -16.0)), "tricubic")
    surface = LevelSet(field, -radius)
    u, v = torch.rand(2, 200, dtype=torch.float64) * 2 * math.pi
    at = torch.stack((u.cos(), u.sin(), torch.zeros_like(u)), -1)
    normal = v.cos()[:, None] * at + v.sin()[:, None] * torch.tensor([0.0, 0, 1]).double()
    expected = ring * at + radius * normal
    found = surface.at(expected + 2 * normal, -normal, surface.hit(expected + 2 * normal, -normal), 2)
    assert float((found.point - expected).abs().max()) < 2e-3
    assert float((found.normal + normal).abs().max()) < 4e-3
    across = v.cos() / (ring + radius * v.cos())
    curvatures = torch.stack((-across, torch.full_like(v, -1 / radius)), -1)
    assert float((found.curvatures - curvatures).abs().max()) < 0.02
    along = torch.stack((-u.sin(), u.cos(), torch.zeros_like(u)), -1)
    assert float((found.principal[:, 0] * along).sum(-1).abs().min()) > 0.99
    frame = torch.cat((found.principal, found.normal[:, None]), 1)
    assert float((frame @ frame.mT - torch.eye(3)).abs().max()) < 1e-12


def test_what_a_field_cannot_give_is_refused():
    surface = LevelSet(fl.reconstruct(ball(), "ncrsi"), -9.0)
    ray = torch.tensor([[-4.0, 5.5, 5.5]]).double(), torch.tensor([[1.0, 0, 0]]).double()
    hit = surface.hit(*ray)
    assert surface.at(*ray, hit, 0).gradient is None
    with pytest.raises(ValueError, match="order must be"):
        surface.at(*ray, hit, 2)
    with pytest.raises(ValueError, match="hits of rays"):
        surface.at(ray[0].expand(2, 3), ray[1], hit)


# ---- derivatives


CAMERA = ([-9.0, 2.2, 3.1], [2.5, 2.4, 2.6], 12.0)  # position, target, field of view


def camera_rays(shift: Tensor, tilt: Tensor, position: Tensor, target: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
    """A pixel's ray, moved and turned."""
    view = PerspectiveCamera(position=position, target=target, field_of_view=angle)
    origins, directions = view.pixel_rays(torch.tensor([1]), 3, 3)
    return origins + shift, 1.5 * directions + 0.1 * tilt


@pytest.mark.parametrize("method", CONTINUOUS)
def test_gradients_and_second_derivatives(method):
    """t, point and normal in samples, level, rays and the camera that these come from, at the default tolerances.

    Of methods that are put together alike all but one are asked along random directions, once.
    """
    numbers = (-1.1, [[0.1, 0.2, -0.1]], [[0.5, 0.05, -0.05]], *CAMERA)
    assert_differentiable(method, 1, camera_rays, *numbers, thoroughly=method in ("trilinear", "ncrsi", "tricubic"))


@pytest.mark.parametrize("method", [name for name in METHODS if METHODS[name].facts.continuity >= 2])
def test_first_derivatives_of_curvatures(method):
    assert_differentiable(method, 2, lambda *rays: rays, -1.1, [[-3.0, 2.2, 2.9]], [[1.5, 0.1, -0.1]])


def assert_differentiable(method: str, order: int, rays, *numbers, thoroughly: bool = True) -> None:
    """What is known at a hit, in two samples near it, the level and what rays are made of; below order 2 twice."""
    samples, at = ball(6) / 4 + 0.3 * noise(6, 6, 6), (torch.tensor([2, 3]), torch.tensor([2, 3]), torch.arange(2))
    given = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in numbers]

    def seen(values, level, *rest):
        field = fl.reconstruct(samples.index_put(at, values), method)
        surface, (origins, directions) = LevelSet(field, level), rays(*rest)
        hit = surface.hit(origins, directions)
        found = surface.at(origins, directions, hit, order)
        return (hit.t, found.point, found.normal) if order == 1 else (found.curvatures,)

    inputs = (samples[at].clone().requires_grad_(), *given)
    assert bool(seen(*inputs)[0].isfinite().all())
    slopes = torch.autograd.grad(laws.mixed(*seen(*inputs)), inputs)
    assert all(float(slope.abs().max()) > 1e-4 for slope in slopes)  # a test of zeros would be none
    assert torch.autograd.gradcheck(seen, inputs, fast_mode=not thoroughly)
    if order == 1 and thoroughly:
        assert torch.autograd.gradgradcheck(lambda *a: laws.mixed(*seen(*a)), inputs, fast_mode=True)


def test_derivatives_change_no_bit():
    field = fl.reconstruct(noise(6, 6, 6), "tricubic")
    origins, directions = random_rays(4, 40)
    plain = LevelSet(field, 0.5).hit(origins, directions).t
    assert torch.equal(LevelSet(field, 0.5).hit(origins.requires_grad_(), directions).t.detach(), plain)
    assert not plain.requires_grad


# ---- bad input


def test_bad_rays_are_refused():
    surface = LevelSet(fl.reconstruct(noise(4, 4, 4), "trilinear"), 0.5)
    fine = torch.zeros(2, 3), torch.ones(2, 3)
    for origins, directions, error, message in (
        (fine[0], torch.zeros(2, 3), ValueError, "directions must not be zero; 2 rays"),
        (fine[0] * math.nan, fine[1], ValueError, "origins must be finite; 2 rays"),
        (fine[0], fine[1] * math.inf, ValueError, "directions must be finite"),
        (fine[0][:, :2], fine[1], ValueError, r"origins must have shape \(..., 3\)"),
        (fine[0], torch.ones(3, 3), ValueError, "broadcast"),
        (
            fine[0].long(),
            fine[1],
            TypeError,
            "origins must be a floating-point torch.Tensor or NumPy array; got torch.int64",
        ),
        ([0, 0, 0], fine[1], TypeError, "got list"),
    ):
        with pytest.raises(error, match=message):
            surface.hit(origins, directions)


@pytest.mark.parametrize("sheets", [0, -1, 1_000_000, 2.0, True, None])
def test_bad_numbers_of_sheets_are_refused(sheets):
    surface = LevelSet(fl.reconstruct(noise(4, 4, 4), "trilinear"), 0.5)
    with pytest.raises(ValueError, match="sheets must be an integer from 1 to 4096"):
        surface.hits(torch.zeros(2, 3), torch.ones(2, 3), sheets)


@pytest.mark.parametrize("level", [math.nan, math.inf, "high", None, torch.ones(2), torch.tensor(1)])
def test_bad_levels_are_refused(level):
    with pytest.raises(ValueError, match="level must be"):
        LevelSet(fl.reconstruct(noise(4, 4, 4), "trilinear"), level)


def test_fields_without_a_level_set_are_refused():
    with pytest.raises(TypeError, match="Field"):
        LevelSet(noise(3, 3, 3), 0.5)  # type: ignore[arg-type]
    texture = fl.reconstruct(noise(3, 3, 3), "triquadratic", scheme="eight_trilinear", sampler="texture_unit")
    with pytest.raises(TypeError, match="not piecewise polynomial"):
        LevelSet(texture, 0.5)
    with pytest.raises(ValueError, match="select"):
        LevelSet(fl.reconstruct(noise(1, 1, 3, 3, 3), "trilinear"), 0.5)
    quintic = fl.reconstruct(noise(8, 8, 8), from_kernel(KERNELS["bspline5"]))
    with pytest.raises(ValueError, match="degrees along a ray go up to 9"):
        LevelSet(quintic, 0.5)


def test_directions_may_have_any_length():
    surface = LevelSet(fl.reconstruct(ball(), "triquadratic"), -9.0)
    origin, direction = torch.tensor([-4.0, 5.5, 5.2]).double(), torch.tensor([1.0, 0.1, 0.05]).double()
    t = surface.hit(origin, direction).t
    for length in (1e-200, 1e-20, 1e20, 1e200):
        assert float(surface.hit(origin, direction * length).t * length) == pytest.approx(float(t), rel=1e-14)


def test_surfaces_are_public():
    level_sets = {"Hits", "LevelSet", "Mesh", "Surface", "SurfacePoints", "mesh"}
    quadrics = {"BilinearQuads", "Bounds", "Planes", "Quadrics", "Spheres", "Tetrahedra", "molecular_skin"}
    covers, terrains = {"Fit", "Slim", "fit_slim"}, {"HeightField", "Relief"}
    assert set(surfaces.__all__) == level_sets | quadrics | covers | terrains


def test_a_level_and_samples_that_change_in_place_are_seen() -> None:
    """As an optimizer changes them: nothing that is kept from call to call may be of before."""
    samples = torch.rand(6, 6, 6, dtype=torch.float64).requires_grad_()
    level = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    field = fl.reconstruct(samples, "trilinear")
    surface = LevelSet(field, level)
    origins = torch.rand(200, 3, dtype=torch.float64) * 5 - torch.tensor([0.0, 0.0, 9.0])
    directions = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(200, 3)
    before = surface.hit(origins, directions).t.detach()
    assert torch.equal(surface.met(origins, directions), before < torch.inf)
    with torch.no_grad():
        level.fill_(0.6)
    changed = surface.hit(origins, directions).t.detach()
    assert torch.equal(changed, LevelSet(field, 0.6).hit(origins, directions).t.detach())
    assert not torch.equal(changed, before)
