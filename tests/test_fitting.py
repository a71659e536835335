"""Covers of points: how near they are to what was scanned, which side is outside, what is left out and what is cut."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from filterlab.surfaces import Slim, fit_slim

SEMI = np.array([1.0, 0.7, 0.5])


def sphere(count: int, seed: int = 0) -> np.ndarray:
    drawn = np.random.default_rng(seed).standard_normal((count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def torus(count: int, seed: int = 0, minor: float = 0.4) -> np.ndarray:
    """Evenly over its area."""
    random = np.random.default_rng(seed)
    a, b = random.uniform(0, 2 * np.pi, (2, 3 * count))
    a, b = (x[random.uniform(size=len(x)) < (1 + minor * np.cos(b)) / (1 + minor)][:count] for x in (a, b))
    ring = 1 + minor * np.cos(b)
    return np.stack((ring * np.cos(a), ring * np.sin(a), minor * np.sin(b)), 1)


def off_torus(x: np.ndarray, minor: float = 0.4) -> np.ndarray:
    return np.hypot(np.hypot(x[:, 0], x[:, 1]) - 1, x[:, 2]) - minor


def torus_normals(x: np.ndarray) -> np.ndarray:
    ring = x * [1, 1, 0]
    ring /= np.linalg.norm(ring, axis=1, keepdims=True)
    return (x - ring) / np.linalg.norm(x - ring, axis=1, keepdims=True)


def cube(count: int, seed: int = 0) -> np.ndarray:
    """The sides of −1 … 1, evenly."""
    random = np.random.default_rng(seed)
    x = random.uniform(-1, 1, (count, 3))
    x[np.arange(count), random.integers(0, 3, count)] = random.choice([-1.0, 1.0], count)
    return x


@cache
def cube_cover() -> Slim:
    return fit_slim(cube(4000))


def diagonal(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(points, 0)))


def met(slim: Slim, points: np.ndarray, normals: np.ndarray, lift: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """The points that rays down normals meet, and whether they do."""
    o, d = (torch.from_numpy(np.ascontiguousarray(x)) for x in (points + lift * normals, -normals))
    hit = slim.hit(o, d)
    t = torch.where(hit.valid, hit.t, 0.0)
    return (o + t[:, None] * d).numpy(), hit.valid.numpy()


@cache
def torus_cover(tolerance: float = 1e-4, count: int = 6000) -> Slim:
    return fit_slim(torus(count), tolerance=tolerance)


# --- how near ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4])
def test_a_cover_is_as_near_to_the_torus_as_it_is_asked_to_be_and_as_it_says(tolerance):
    slim, scanned, others = torus_cover(tolerance), torus(6000)[::3], torus(2000, seed=7)
    assert slim.fit is not None
    for points, most in ((scanned, 1.3), (others, 3.0)):
        found, valid = met(slim, points, torus_normals(points))
        rms = np.sqrt(np.mean(off_torus(found) ** 2))
        assert valid.all()
        assert rms < tolerance * diagonal(torus(6000))
        assert slim.fit.rms / 1.3 < rms < most * slim.fit.rms
    assert slim.fit.tolerance == pytest.approx(tolerance * diagonal(torus(6000)))
    assert slim.fit.balls == len(slim)


def test_fewer_balls_do_for_less():
    assert len(torus_cover(1e-3)) < 0.4 * len(torus_cover(1e-4))
    assert len(torus_cover(1e-4)) < 2000


def test_order_of_the_misfit_is_that_of_a_fit_of_second_order():
    """h³ with the radius h of balls, of which there are 1 / h²: rms falls by 1.5 powers of their number, or faster."""
    few, many = torus_cover(1e-3), torus_cover(1e-4)
    assert few.fit is not None
    assert many.fit is not None
    assert np.log(few.fit.rms / many.fit.rms) / np.log(len(many) / len(few)) > 1.3


def test_planes_need_more_balls():
    planes = fit_slim(torus(6000), tolerance=3e-3, order=1)
    assert (planes.A == 0).all()
    assert len(planes) > 2 * len(torus_cover(1e-3))


def test_ellipsoids_outside_is_found_without_normals():
    points = sphere(5000) * SEMI
    slim = fit_slim(points.astype(np.float32), tolerance=3e-4)
    found, valid = met(slim, sphere(500, 3) * SEMI, sphere(500, 3) / SEMI / 3)
    assert valid.all()  # faces="front": rays from outside meet F > 0 first
    assert np.abs((found / SEMI**1) ** 2 @ np.ones(3) - 1).max() < 0.02
    inside = slim.hit(torch.zeros(500, 3, dtype=torch.float64), torch.from_numpy(sphere(500, 3)))
    assert not inside.valid.any()


def test_given_normals_say_where_outside_is():
    points = sphere(2000)
    slim = fit_slim(points, -3 * points, tolerance=1e-3)
    assert slim.hit(torch.zeros(50, 3, dtype=torch.float64), torch.from_numpy(sphere(50, 3))).valid.all()


def test_where_it_lies_and_how_large_it_is_changes_nothing():
    one = fit_slim(sphere(1500), tolerance=1e-3)
    far = fit_slim(sphere(1500) * 1e3 + [4e5, -2e6, 7e4], tolerance=1e-3)
    assert one.fit is not None
    assert far.fit is not None
    assert far.fit.rms == pytest.approx(1e3 * one.fit.rms, rel=1e-3)
    assert (one.fit.balls, one.fit.points) == (far.fit.balls, far.fit.points)


def test_the_same_points_give_the_same_cover():
    array, tensor = (fit_slim(points, tolerance=1e-3) for points in (torus(600), torch.from_numpy(torus(600))))
    assert all(torch.equal(a, b) for a, b in zip(array.tensors, tensor.tensors, strict=True))


# --- what scans are like ----------------------------------------------------------------------------------------------


def test_noise_above_the_tolerance_is_smoothed_not_followed():
    points = torus(4000)
    noise = 1e-3 * diagonal(points)
    noisy = points + noise * np.random.default_rng(5).standard_normal(points.shape)
    slims = [fit_slim(noisy, tolerance=1e-5, least=least) for least in (12, 60)]
    rms = []
    for slim in slims:
        found, valid = met(slim, points[::5], torus_normals(points[::5]))
        assert valid.all()
        rms.append(np.sqrt(np.mean(off_torus(found) ** 2)))
        assert slim.fit is not None
        assert slim.fit.smallest > 0.9 * len(slim)
    assert rms[0] < 0.8 * noise
    assert rms[1] < 0.5 * noise
    assert len(slims[1]) < len(slims[0]) / 2


def test_strays_are_left_out():
    points, random = torus(6000), np.random.default_rng(2)
    strays = random.uniform(-1.4, 1.4, (60, 3))
    strays = strays[np.abs(off_torus(strays)) > 0.1]
    slim = fit_slim(np.concatenate((points, strays, points[:10])), tolerance=3e-4)
    assert slim.fit is not None
    assert slim.fit.duplicates == 10
    assert len(strays) <= slim.fit.strays < len(strays) + 30
    found, valid = met(slim, points[::7], torus_normals(points[::7]), lift=0.05)
    assert valid.all()
    assert np.abs(off_torus(found)).max() < 5e-3 * diagonal(points)


def test_holes_stay_open_and_all_else_is_closed():
    points = sphere(8000)
    open_ = points[points[:, 2] < 0.8]  # a hole of 37° about the z axis
    slim = fit_slim(open_, tolerance=3e-4)
    seen = sphere(6000, seed=4)
    _, valid = met(slim, seen, seen)
    spacing = np.sqrt(4 * np.pi / 8000)
    assert valid[seen[:, 2] < 0.8].all()
    beyond = seen[:, 2] > np.cos(np.arccos(0.8) - 3.5 * spacing)
    assert beyond.sum() > 300
    assert not valid[beyond].any()


def test_thin_walls_have_two_sides():
    random = np.random.default_rng(0)
    flat = random.uniform(-1, 1, (6000, 2))
    points = np.column_stack((flat, np.where(np.arange(6000) % 2, 0.02, -0.02)))
    slim = fit_slim(points, points * [0, 0, 1], tolerance=1e-4)
    for side in (-1.0, 1.0):
        o = torch.tensor([[0.1, 0.2, side], [-0.5, 0.3, side], [0.7, -0.6, side]], dtype=torch.float64)
        hit = slim.hit(o, torch.tensor([0.0, 0, -side], dtype=torch.float64).expand(3, 3))
        assert np.allclose(hit.t.numpy(), 0.98, atol=1e-9)


def test_a_plane_is_a_few_balls_and_ends_where_it_ends():
    points = np.column_stack((np.random.default_rng(0).uniform(-1, 1, (3000, 2)), np.zeros(3000)))
    slim = fit_slim(points)
    assert slim.fit is not None
    assert slim.fit.rms < 1e-12
    assert len(slim) < 200
    x = torch.tensor([0.0, 0.9, 1.15, -1.15, 0.0], dtype=torch.float64)
    y = torch.tensor([0.0, -0.9, 0.0, 0.3, 1.2], dtype=torch.float64)
    o = torch.stack((x, y, torch.ones(5).double()), 1)
    down = torch.tensor([0.0, 0, -1], dtype=torch.float64).expand(5, 3)
    assert (slim.hit(o, down).valid | slim.hit(-o * torch.tensor([-1.0, -1, 1]), -down).valid).tolist() == [
        *(True, True),
        *(False, False, False),
    ]


def test_sharp_edges_stay_sharp():
    """Rays at a cube, next to an edge: a cover without cuts is rounder by several times."""
    points = cube(5000)
    normals = np.where(np.abs(points) == 1, points, 0.0)
    slim = fit_slim(points, normals, tolerance=3e-4)
    assert slim.fit is not None
    assert slim.fit.sharp > 100
    near = np.random.default_rng(1).uniform(-0.8, 0.8, (400, 3))
    near[:, 0], near[:, 1] = 1, 1 - np.random.default_rng(2).uniform(0.002, 0.05, 400)
    along = np.broadcast_to([1.0, 0, 0], near.shape)
    found, valid = met(slim, near, along)
    assert valid.mean() > 0.99
    assert np.quantile(np.abs(found[valid, 0] - 1), 0.9) < 1e-3
    beside = near + np.array([0, 0.06, 0])  # there is nothing
    beside = beside[beside[:, 1] > 1.01]
    cut, whole = (met(x, beside, along[: len(beside)])[1].mean() for x in (slim, Slim(*slim.tensors)))
    assert cut < 0.1
    assert whole > 0.5


# --- what is refused --------------------------------------------------------------------------------------------------

GOOD = sphere(200)


@pytest.mark.parametrize(
    ("points", "told", "more"),
    [
        (np.full((100, 3), np.nan), "points must be finite", {}),
        (GOOD[:1], "at least 17 points at different places; got 1", {}),
        (np.repeat(GOOD[:1], 100, 0), "at different places; got 1", {}),
        (np.linspace(0, 1, 100)[:, None] * [1, 2, 3], "lie on one line", {}),
        (GOOD[:, :2], r"points must have shape \(…, 3\)", {}),
        (GOOD, "tolerance must be", {"tolerance": 0}),
        (GOOD, "tolerance must be", {"tolerance": 0.5}),
        (GOOD, "tolerance must be", {"tolerance": float("nan")}),
        (GOOD, "least must be", {"least": 3}),
        (GOOD, "order must be 1 or 2; got 3", {"order": 3}),
        (GOOD, "at least 300 points", {"least": 300}),
        (GOOD, r"normals must have shape \(200, 3\)", {"normals": GOOD[:5]}),
        (GOOD, "normals must not be 0; 200 of 200", {"normals": 0 * GOOD}),
    ],
)
def test_what_is_no_surface_is_refused(points, told, more):
    with pytest.raises(ValueError, match=told):
        fit_slim(points, **more)


def test_integers_are_no_points():
    with pytest.raises(TypeError, match="points must be a floating-point"):
        fit_slim(np.arange(300).reshape(100, 3))


def test_progress_goes_up_to_the_end():
    told: list[float] = []
    fit_slim(sphere(500), tolerance=1e-2, progress=told.append)
    assert told[0] > 0
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_the_report_cannot_be_changed():
    fit = torus_cover(1e-3).fit
    assert fit is not None
    with pytest.raises(AttributeError):
        fit.rms = 0.0  # type: ignore[misc]
    assert replace(fit, rms=0.0) != fit


# --- corners ----------------------------------------------------------------------------------------------------------


def test_corners_of_a_cube_are_sharp():
    """Three planes in each ball there: no ball is left that rounds a corner off, and no point is off it."""
    slim = cube_cover()
    assert slim.fit is not None
    assert slim.fit.smallest == 0
    assert slim.fit.worst < 1e-6
    assert slim.cuts is not None
    rays = torch.tensor(np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3))
    hit = slim.hit(3 * rays, -rays)  # down the diagonals
    assert hit.valid.all()
    assert hit.t.numpy() == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_nothing_of_a_cube_reaches_beyond_its_edges(axis):
    random = np.random.default_rng(axis)
    o = random.uniform(-1.1, 1.1, (4000, 3))
    across, other = (axis + 1) % 3, (axis + 2) % 3
    o[:, axis], o[:, across] = 3, np.sign(o[:, other]) * random.uniform(1 + 1e-3, 1.1, 4000)
    origins = torch.from_numpy(o)
    direction = torch.zeros_like(origins)
    direction[:, axis] = -1
    assert not cube_cover().hit(origins, direction).valid.any()


def test_normals_near_an_edge_are_of_one_of_its_sides():
    from filterlab.surfaces.fitting.scans import scan_of

    points = torch.from_numpy(cube(4000)) / 12**0.5
    scan, _ = scan_of(points, points, 0, lambda part: None)
    assert float((scan.normals.abs().amax(1) > 0.999).double().mean()) > 0.9


# a cube [-1, 1]³ without its octant x, y, z > 0: three corners of its notch have two convex edges and a concave one


def notched(count: int) -> np.ndarray:
    """Points of the surface: those of the cube that are not at the octant, and of the octant's three walls."""
    outer = cube(count)
    wall = np.random.default_rng(1).uniform(0, 1, (count // 8, 3))
    wall[np.arange(len(wall)), np.arange(len(wall)) % 3] = 0
    return np.concatenate((outer[~(outer > 0).all(1)], wall))


@cache
def notched_cover() -> Slim:
    return fit_slim(notched(4000))


def test_corners_of_mixed_edges_are_sharp():
    fit = notched_cover().fit
    assert fit is not None
    assert fit.smallest == 0
    assert fit.rms < 0.1 * fit.tolerance


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rays_beside_corners_of_mixed_edges_meet_the_wall_that_is_there(axis):
    """Along the axis at the walls, the two faces beside the notch; 2 % of the notch off its edges."""
    o = np.random.default_rng(axis).uniform(-0.5, 0.98, (2000, 3))
    o = o[(np.abs(np.delete(o, axis, 1)) > 0.02).all(1)]
    o[:, axis] = 3
    direction = np.zeros_like(o)
    direction[:, axis] = -1
    hit = notched_cover().hit(torch.from_numpy(o), torch.from_numpy(direction))
    within = (np.delete(o, axis, 1) > 0).all(1)
    off = np.abs(hit.t.numpy() - np.where(within, 3.0, 2.0))
    assert (off > 1e-3).mean() < 2e-3
