"""Hits of splines of heights, every class of rays: all that the oracle finds, and no other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from filterlab.ops.differentiable import height_hits as ops
from filterlab.ops.raycast import Sheets
from filterlab.ops.reference import height_hits as reference
from filterlab.surfaces import HeightField
from tests import laws
from tests.height_ray_oracle import NAMES, STEPS, Ground, crossings
from tests.height_rays import BOUNDARIES, CLASSES, FAULTS, campaign, case_of, one, random

F64 = torch.float64
every_spline = pytest.mark.parametrize("name", NAMES)
every_kind = pytest.mark.parametrize("kind", CLASSES)


def turn(name: str, kind: str) -> tuple[str, str, int]:
    """A boundary, a diagonal and a seed of its own."""
    number = len(CLASSES) * NAMES.index(name) + list(CLASSES).index(kind)
    return BOUNDARIES[number % 5], ("main", "anti")[NAMES.index(name) % 2], number


# ---- the oracle


@every_spline
def test_crossings_of_the_oracle_are_those_that_a_scan_sees(name):
    case, rng = case_of(name, "random", "mirror", "main", 3)
    o, d = random(rng, case, 20)
    seen = 0
    for own_o, own_d, crossed in zip(o, d, crossings(case.ground, o, d).t, strict=True):
        crossed = crossed[crossed < np.inf]
        ends = np.sort(np.stack([-own_o / own_d, (np.append(case.span, 0) - own_o) / own_d])[:, :2], 0)
        near, far = max(ends[0].max(), 0), ends[1].min()
        if near >= far:
            assert len(crossed) == 0
            continue
        t = np.linspace(near, far, 800)[1:-1]
        points = own_o + t[:, None] * own_d
        above = points[:, 2] > case.ground.at(points[:, :2])
        assert ((np.histogram(crossed, t)[0] % 2 == 1) == (above[1:] ^ above[:-1])).all()
        seen += len(crossed)
    assert seen > 10


# ---- hits


@every_kind
@pytest.mark.parametrize("shift", [0, 2])
def test_every_hit_is_found_and_no_other(kind, shift):
    """Splines in turn: `campaign` takes them all, and as many rays as there is time."""
    name = NAMES[(list(CLASSES).index(kind) + shift) % len(NAMES)]
    boundary, diagonal, seed = turn(name, kind)
    verdict = one(name, kind, boundary, diagonal, 24, seed)
    assert not any(verdict[fault] for fault in FAULTS), verdict
    assert verdict["rays"] > verdict["undecided"]


def test_a_campaign_counts_what_it_did():
    found = campaign(0.3, rays=5)
    assert found
    assert all(verdict["rays"] > 0 and not any(verdict[fault] for fault in FAULTS) for verdict in found.values())


@every_kind
def test_the_program_finds_what_plain_torch_finds(kind):
    name = NAMES[list(CLASSES).index(kind) % len(NAMES)]
    boundary, diagonal, seed = turn(name, kind)
    case, rng = case_of(name, kind, boundary, diagonal, seed)
    rays = [torch.from_numpy(x) for x in CLASSES[kind][1](rng, case, 200)]
    given = case.surface.cast
    plain, fused = (ops.first(given, *rays, how) for how in ("reference", "cpu"))
    differ = (plain < torch.inf) != (fused < torch.inf)
    assert int(differ.sum()) <= (10 if kind == "at heights of vertices" else 2)  # rays that touch within rounding
    both = (plain < torch.inf) & (fused < torch.inf)
    far = 1e-6 if kind == "from far away" else 1e-9
    apart = (plain - fused)[both].abs() * rays[1][both].norm(dim=1)
    assert int((apart > far).sum()) <= (10 if kind == "at heights of vertices" else 2)
    assert torch.equal(ops.met(given, *rays, "cpu"), fused < torch.inf)
    ones, others = (ops.candidates(given, *rays, how).ray.bincount(minlength=200) for how in ("reference", "cpu"))
    assert int((ones != others).sum()) <= (0.2 * 200 if kind in ("at heights of vertices", "stairs") else 4)


@pytest.mark.parametrize(("name", "turned"), [("c1", False), ("linear", True)])
def test_rays_that_rest_on_their_way_find_the_same(name, turned):
    """Of so many blocks along an axis that rays wait for bounds, on their way down the pyramid."""
    length, generator = 2100, torch.Generator().manual_seed(3)
    heights = 20 * torch.rand(9, length, generator=generator, dtype=F64) + 40 * (torch.arange(length) / 90.0).sin()
    surface = HeightField(heights.T.contiguous() if turned else heights, name)
    assert surface.cast.pyramid.top - surface.cast.cell.finest >= 10
    ends = torch.rand(2, 40, 3, generator=generator, dtype=F64)
    ends[:] *= torch.tensor([length - 1.0, 8, 1], dtype=F64)
    ends[0, :, 2] += 100
    origins, targets = ends[..., [1, 0, 2]] if turned else ends
    plain, fused = (ops.first(surface.cast, origins, targets - origins, how) for how in ("reference", "cpu"))
    assert int((plain < torch.inf).sum()) > 15
    torch.testing.assert_close(fused, plain, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", ["horizontal", "vertical", "at heights of vertices", "stairs", "holes"])
def test_the_program_finds_the_sheets_that_plain_torch_finds(kind):
    """As many, in the same places, in the same order, however many are asked for; the first one is the first hit."""
    name = NAMES[list(CLASSES).index(kind) % len(NAMES)]
    boundary, diagonal, seed = turn(name, kind)
    case, rng = case_of(name, kind, boundary, diagonal, seed)
    rays = [torch.from_numpy(x) for x in CLASSES[kind][1](rng, case, 60)]
    given, extent = case.surface.cast, case.surface.domain.diagonal
    plain, fused = (ops.sheets(given, *rays, Sheets(40, False, extent), how) for how in ("reference", "cpu"))
    same = ((plain < torch.inf) == (fused < torch.inf)).all(1)
    apart = torch.where(plain == fused, 0, (plain - fused).abs())[same].amax(1) * rays[1][same].norm(dim=1)
    touching = 10 if kind == "at heights of vertices" else 2  # rays that touch within rounding
    assert int((~same).sum()) + int((apart > 1e-9).sum()) <= touching
    assert bool((fused[:, -1] == torch.inf).all())
    assert torch.equal(fused[:, 0], ops.first(given, *rays, "cpu"))
    last = [torch.cat((t[t < torch.inf].flip(0), t[t == torch.inf])) for t in fused]
    for count in (1, 2, 5):
        near, far = (ops.sheets(given, *rays, Sheets(count, way, extent), "cpu") for way in (False, True))
        assert torch.equal(near, fused[:, :count])
        assert torch.equal(far, torch.stack(last)[:, :count])


def test_sheets_of_float32_rays_on_threads_are_those_of_each_ray_alone(monkeypatch):
    case, rng = case_of("c1", "horizontal", "mirror", "main", 5)
    o, d = (torch.from_numpy(x).float() for x in CLASSES["horizontal"][1](rng, case, 23))
    given, asked = case.surface.cast, Sheets(3, False, 40.0)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    found = ops.sheets(given, o, d, asked, "cpu")
    assert int((found < torch.inf).sum()) > 23
    alone = [ops.sheets(given, *rays, asked, "cpu") for rays in zip(o.split(1), d.split(1), strict=True)]
    assert torch.equal(found, torch.cat(alone))
    assert torch.equal(found, ops.sheets(given, o.double(), d.double(), asked, "cpu"))


def test_hits_that_rounding_alone_has_apart_are_one():
    """It is taken for so large here that those 0.7 apart are one, those 1.3 apart are not."""
    ridges = HeightField(torch.tensor([0.0, 1.0] * 5, dtype=F64).expand(6, -1).clone(), "linear")
    o, d = torch.tensor([[-1.0, 2.3, 0.35]], dtype=F64), torch.tensor([[1.0, 0, 0]], dtype=F64)
    every = ops.sheets(ridges.cast, o, d, Sheets(12, False, 10.0), "cpu")
    expected = 1.35 + torch.tensor([0, 1.3, 2, 3.3, 4, 5.3, 6, 7.3, 8], dtype=F64)
    assert torch.allclose(every[0, :9], expected, rtol=0, atol=1e-12)
    for how in ("cpu", "reference"):
        found = ops.sheets(ridges.cast, o, d, Sheets(12, False, 1 / (32 * 2.0**-52)), how)
        assert torch.allclose(found[0, :5], expected[[0, 1, 3, 5, 7]], rtol=0, atol=1e-12)
        assert bool((found[0, 5:] == torch.inf).all())


@every_spline
def test_a_picture_has_no_cracks(name):
    """Rays of an eye above a rough square that is seen from edge to edge."""
    heights = torch.rand(46, 46, dtype=F64, generator=torch.Generator().manual_seed(1))
    x, y = torch.meshgrid(*(torch.linspace(0.01, 44.99, 150, dtype=F64),) * 2, indexing="xy")
    aim = torch.stack((x, y, torch.full_like(x, -30.0)), -1)
    eye = torch.tensor([22.5, 22.5, 300.0], dtype=F64)
    surface = HeightField(heights, name.split(",")[0], prefilter="pre" in name)
    inner = (eye + (aim - eye) * 0.92)[..., :2]  # where rays are below all of it
    seen = ((inner > 0) & (inner < 45)).all(-1)
    assert bool((surface.hit(eye, aim - eye).t < torch.inf)[seen].all())
    assert bool((surface.hit(eye.float(), (aim - eye).float()).t < torch.inf)[seen].all())


@pytest.mark.parametrize("name", ["linear", "c0", "c2"])
def test_a_ray_leaves_cells_for_blocks_again(name, monkeypatch):
    """Past the foot of a hill, over a plain of 480 data: not cell by cell, whatever the smallest blocks are."""
    heights = torch.zeros(501, 501, dtype=F64)
    heights[240:260, 10:20] = 1.0
    heights[240:260, 480:490] = 1.0
    steps, relevant = [], reference._relevant
    monkeypatch.setattr(reference, "_relevant", lambda *given: steps.append(given) or relevant(*given))
    o, d = torch.tensor([[19.5, 250.3, 0.9]], dtype=F64), torch.tensor([[1.0, 0.01, 0.0]], dtype=F64)
    t = ops.first(HeightField(heights, name).cast, o, d, "reference")
    assert 450 < float(t) < 475
    assert len(steps) < 90


@pytest.mark.parametrize("name", ["linear", "c1"])
def test_holes_are_the_patches_that_use_what_is_missing_and_no_more(name):
    heights = torch.rand(25, 25, dtype=F64, generator=torch.Generator().manual_seed(2))
    heights[12, 12], heights[3, 20] = torch.nan, torch.inf
    surface = HeightField(heights, name, nan="propagate")
    step = STEPS[name]
    corner = step * torch.arange(24 // step)
    x, y = torch.meshgrid(
        *(torch.cat([corner + step * part for part in own]) for own in ((0.2, 0.7), (0.3, 0.6))), indexing="xy"
    )
    down = torch.tensor([0.0, 0.0, -1.0], dtype=F64)
    hit = surface.hit(torch.stack((x, y, torch.full_like(x, 9.0)), -1).to(F64), down).valid
    known = surface.jet(torch.stack((x, y), -1).to(F64), 0)[0].isfinite()
    assert torch.equal(hit, known)
    assert 0 < int((~hit).sum()) < hit.numel() / 3


def test_all_holes_are_never_hit():
    surface = HeightField(torch.full((7, 9), torch.nan), "c1", nan="propagate")
    origins = torch.rand(50, 3) * 9
    assert not bool(surface.hit(origins, torch.randn(50, 3)).valid.any())


@every_spline
@pytest.mark.parametrize("how", ["reference", "cpu"])
def test_bounds_hold_all_coefficients_and_little_more(name, how):
    case, _ = case_of(name, "holes", "reflect", "anti", 7)
    given = ops.described(case.surface._described, how)
    found = case.surface.patches(torch.cartesian_prod(*(torch.arange(n) for n in given.heights.cells)))
    x, y = torch.cartesian_prod(*(torch.arange(n) for n in given.heights.cells)).T
    finest = given.pyramid.finest
    low, high = given.pyramid.level(0)[y >> finest, x >> finest].double().unbind(-1)
    known = ~found.isnan()
    least, most = (torch.where(known, found, none).flatten(1) for none in (torch.inf, -torch.inf))
    least, most = least.amin(1), most.amax(1)
    assert bool((low <= least).all())
    assert bool((most <= high).all())
    if finest == 0:
        whole = least < torch.inf
        laws.assert_close(low[whole], least[whole], 1e-6)
        laws.assert_close(high[whole], most[whole], 1e-6)
    for number in range(1, len(given.pyramid.sizes)):
        below, own = given.pyramid.level(number - 1), given.pyramid.level(number)
        rows, columns = (torch.arange(n) // 2 for n in below.shape[:2])
        around = own[rows[:, None], columns]
        assert bool((around[..., 0] <= below[..., 0]).all())
        assert bool((around[..., 1] >= below[..., 1]).all())
    assert given.pyramid.numbers.shape[0] < 1.4 * given.pyramid.sizes[0][0] * given.pyramid.sizes[0][1] + 8


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16, torch.uint8, torch.int16, torch.int32])
def test_heights_are_read_as_they_are_stored(dtype):
    heights = (20 * torch.rand(40, 33, generator=torch.Generator().manual_seed(3))).to(dtype)
    origins = torch.rand(300, 3, dtype=F64) * torch.tensor([32.0, 39.0, 5.0]) + torch.tensor([0.0, 0.0, 40.0])
    directions = torch.randn(300, 3, dtype=F64) - torch.tensor([0.0, 0.0, 2.0])
    own, exact = (HeightField(h, "c1").hit(origins, directions).t for h in (heights, heights.double()))
    assert torch.equal(own, exact)
    every_second = heights.repeat_interleave(2, 1)[:, ::2]
    assert torch.equal(HeightField(every_second, "c1").hit(origins, directions).t, exact)


def test_float32_rays_differ_by_their_rounding():
    case, rng = case_of("c1", "random, hills", "mirror", "main", 11)
    origins, directions = (torch.from_numpy(x).float() for x in random(rng, case, 500))
    narrow, wide = case.surface.hit(origins, directions).t, case.surface.hit(origins.double(), directions.double()).t
    assert narrow.dtype == torch.float32
    assert torch.equal(narrow, wide.float())


def test_policies():
    flat = HeightField(torch.full((9, 9), 2.0, dtype=F64), "c1")
    o, d = torch.tensor([[-5.0, 4.0, 2.0], [4.0, 4.0, 2.0], [4.0, 4.0, 2.5]], dtype=F64), torch.eye(3, dtype=F64)[0]
    assert flat.hit(o, d).t.tolist() == [5.0, 0.0, torch.inf]  # in the surface: where it begins; beside it: never
    down = -torch.eye(3, dtype=F64)[2]
    corners = torch.tensor([[0.0, 0, 9], [8, 8, 9], [0, 8, 9], [8, 0, 9], [3, 3, 9], [8.01, 4, 9]], dtype=F64)
    assert flat.hit(corners, down).t.tolist() == [7.0] * 5 + [torch.inf]
    assert flat.hit(corners[:5], -down).t.tolist() == [torch.inf] * 5


def test_sheets_are_in_order_and_the_farthest_come_first():
    case, rng = case_of("c2", "horizontal", "wrap", "anti", 5)
    o, d = (torch.from_numpy(x) for x in CLASSES["horizontal"][1](rng, case, 100))
    near, far = case.surface.hits(o, d, 5).t, case.surface.hits(o, d, 64, farthest=True).t
    every = case.surface.hits(o, d, 64).t
    assert torch.equal(near, every[:, :5])
    count = (every < torch.inf).sum(1)
    assert int(count.max()) > 3
    for own, other, n in zip(every, far, count.tolist(), strict=True):
        assert torch.equal(own[:n].flip(0), other[:n])


# ---- derivatives


@pytest.mark.parametrize("name", ["c0", "c1", "c2"])
def test_hits_are_differentiable_twice_in_heights_and_rays(name):
    heights = torch.rand(3, 4, dtype=F64, generator=torch.Generator().manual_seed(4)).requires_grad_()
    origins = torch.tensor([1.3, 1.1, 9.0], dtype=F64, requires_grad=True)
    directions = torch.tensor([0.2, 0.1, -3.0], dtype=F64, requires_grad=True)

    def t(h: torch.Tensor, o: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
        return HeightField(h, name).hit(o, d).t

    assert bool((t(heights, origins, directions) < torch.inf).all())
    assert torch.autograd.gradcheck(t, (heights, origins, directions))
    assert torch.autograd.gradgradcheck(t, (heights, origins, directions), fast_mode=name != "c0")


# ---- what changes, what is refused


def test_heights_that_change_in_place_are_cast_anew():
    heights = torch.zeros(9, 9, dtype=F64)
    surface = HeightField(heights, "c1")
    o, d = torch.tensor([4.0, 4.0, 9.0], dtype=F64), torch.tensor([0.0, 0.0, -1.0], dtype=F64)
    assert float(surface.hit(o, d).t) == 9
    heights += 3
    assert float(surface.hit(o, d).t) == 6


def test_rays_at_many_grids_are_refused():
    surface = HeightField(torch.zeros(2, 5, 5), "c1")
    with pytest.raises(ValueError, match="one grid; got 2"):
        surface.hit(torch.zeros(3), torch.ones(3))


def test_verdicts_see_a_surface_that_is_off():
    """The campaign is not blind."""
    case, rng = case_of("c1", "random", "mirror", "main", 0)
    rays = random(rng, case, 50)
    truth = crossings(Ground("c1", case.heights, "mirror", "main"), *rays)
    other = replace(case, heights=case.heights + 0.01).surface
    t = other.hit(*map(torch.from_numpy, rays)).t.numpy()
    both = (truth.first < np.inf) & np.isfinite(t)
    wrong = np.abs(t - truth.first)[both] > 1e-6
    assert wrong.sum() > 0.9 * len(wrong) > 10
