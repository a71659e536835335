"""SLIM surfaces: hits against brute force, their order, derivatives, images, files, bad input."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from experiments.covers import distance, torus
from filterlab.io import is_slim, load_slim, save_slim
from filterlab.ops.differentiable import quadrics
from filterlab.render import Light, PerspectiveCamera, Phong, raycast
from filterlab.surfaces import Quadrics, Slim, Spheres, mesh
from tests import slim_oracle

F64 = torch.float64


@pytest.fixture(params=["fused", "plain"])
def either(request, monkeypatch):
    """By the program where it runs, and in plain torch."""
    if request.param == "plain":
        monkeypatch.setattr(quadrics, "missing", lambda *given: "it is not asked for")


def anyhow(count: int = 60, seed: int = 0, planes: int = 0) -> list[Tensor]:
    """Pieces of surface turned anyhow in balls of many sizes, whose sheets are not far apart."""
    rng = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, dtype=F64, generator=rng)  # noqa: E731
    A, centers = 0.3 * draw(count, 3, 3), 0.8 * draw(count, 3)
    radii = 0.3 + 0.9 * torch.rand(count, dtype=F64, generator=rng)
    rows = [centers, radii, A + A.mT, draw(count, 3), 0.2 * draw(count)]
    return [*rows, draw(count, planes, 4)] if planes else rows


def rays(count: int, seed: int = 1) -> tuple[Tensor, Tensor]:
    rng = torch.Generator().manual_seed(seed)
    aim, way = torch.randn(2, count, 3, dtype=F64, generator=rng)
    origins = torch.where(torch.arange(count)[:, None] % 3 > 0, 5 * way, way)  # some begin inside
    return origins, (aim - origins) * 10 ** torch.randn(count, 1, dtype=F64, generator=rng)


# --- hits -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("faces", "planes", "offset"), [("front", 0, 0.5), ("back", 1, 0.6), ("both", 2, 1.0)])
def test_every_sheet_is_found_and_no_other(faces, planes, offset, either):
    cover, (origins, directions) = anyhow(planes=planes), rays(60)
    surface = Slim(*cover[:5], cuts=cover[5] if planes else None, offset=offset, faces=faces)
    hits = surface.hits(origins, directions, 6)
    at = surface.at(origins, directions, hits)
    sides = {"front": [False], "back": [True], "both": [False, True]}[faces]
    counted = 0
    for i, (o, d) in enumerate(zip(origins, directions, strict=True)):
        expected = [s for back in sides for s in slim_oracle.sheets(cover, o, d, offset, back)]
        expected = sorted(expected, key=lambda s: s.t)[:6]
        n = len(expected)
        assert int(hits.valid[i].sum()) == n
        np.testing.assert_allclose(hits.t[i, :n], [s.t for s in expected], rtol=1e-10)
        np.testing.assert_allclose(at.normal[i, :n], np.array([s.normal for s in expected]).reshape(n, 3), atol=1e-9)
        assert all(piece in s.balls for piece, s in zip(hits.piece[i, :n].tolist(), expected, strict=True))
        counted += sum(len(s.balls) > 1 for s in expected)
    assert counted > 5
    assert torch.equal(hits.t[:, 0], surface.hit(origins, directions).t)
    torch.testing.assert_close(
        at.point,
        torch.where(hits.valid, hits.t, 0)[..., None] * directions[:, None]
        + torch.where(hits.valid[..., None], origins[:, None], 0),
    )


def test_a_ball_alone_is_a_quadric(either):
    cover, (origins, directions) = anyhow(1), rays(200)
    alone = Quadrics(*cover[2:], Spheres(*cover[:2]), origins=cover[0], faces="front")
    ours, theirs = (s.hit(origins, directions) for s in (Slim(*cover), alone))
    assert torch.equal(ours.valid, theirs.valid)
    torch.testing.assert_close(ours.t, theirs.t, rtol=1e-12, atol=0)
    at, there = (s.at(origins, directions, h, 2) for s, h in ((Slim(*cover), ours), (alone, theirs)))
    for name in ("point", "normal", "curvatures"):
        torch.testing.assert_close(getattr(at, name), getattr(there, name))


@pytest.mark.parametrize(("count", "rms"), [(1500, 1.2e-4), (6000, 8e-6)])
def test_a_torus(count, rms):
    surface = Slim(*torus(count))
    origins, directions = PerspectiveCamera.framing(surface.domain, (0.3, 1.0, 0.6)).rays(64, 64)
    off = []
    for offset in (0, 0.25, 0.5, 1):
        own = Slim(*surface.tensors, offset=offset)
        hit = own.hit(origins.double(), directions.double())
        off.append(distance(own.at(origins.double(), directions.double(), hit).point)[hit.valid].square().mean().sqrt())
    assert off[2] < rms
    assert off[1] == pytest.approx(float(off[3]), rel=1e-6)
    assert off[0] > 8 * off[2]


def test_normals_and_curvatures_of_a_torus():
    surface = Slim(*torus(6000))
    origins, directions = (x.double() for x in PerspectiveCamera.framing(surface.domain, (0.3, 1.0, 0.6)).rays(48, 48))
    hit = surface.hit(origins, directions)
    at = surface.at(origins, directions, hit, order=2)
    point = at.point[hit.valid].requires_grad_()
    (normal,) = torch.autograd.grad(distance(point).sum(), point)
    assert (at.normal[hit.valid] - normal).norm(dim=1).square().mean().sqrt() < 1e-3
    across = torch.hypot(point[:, 0], point[:, 1]).detach()
    around = (across - 1) / 0.4 / across  # cos v / (R + r cos v)
    off = at.curvatures[hit.valid] - torch.stack((torch.full_like(around, 2.5), around), 1)
    assert off.square().mean().sqrt() < 0.02


def test_fronts_and_backs_of_what_is_closed_go_by_turns():
    surface = Slim(*torus(1500), faces="both")
    rng = torch.Generator().manual_seed(2)
    aim, way = torch.randn(2, 4000, 3, dtype=F64, generator=rng)
    origins = 5 * torch.nn.functional.normalize(way)
    directions = torch.nn.functional.normalize(0.7 * aim - origins)
    hits = surface.hits(origins, directions, 6)
    facing = (surface.at(origins, directions, hits).normal * directions[:, None]).sum(-1)
    sure = (~hits.valid | (facing.abs() > 0.1)).all(-1)  # none grazes
    assert (hits.valid.sum(-1) % 2 == 0)[sure].all()
    assert hits.valid.sum(-1)[sure].unique().tolist() == [0, 2, 4]
    turn = torch.tensor([-1.0, 1, -1, 1, -1, 1], dtype=F64)
    assert (facing * turn >= 0)[sure].all()


def test_the_last_sheets_are_the_first_ones_from_behind(either):
    surface, (origins, directions) = Slim(*torus(800), faces="both"), rays(300)
    near, far = (surface.hits(origins, directions, 5, farthest) for farthest in (False, True))
    count = near.valid.sum(-1)
    assert torch.equal(count, far.valid.sum(-1))
    for t, back, n in zip(near.t, far.t, count, strict=True):
        torch.testing.assert_close(t[:n].flip(0), back[:n], rtol=1e-10, atol=0)
    ours, theirs = (surface.at(origins, directions, h, 2).curvatures.sum() for h in (near, far))
    torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("faces", ["front", "back", "both"])
def test_culling_loses_nothing(faces):
    surface, eye = Slim(*torus(800), faces=faces), torch.tensor([1.0, -4, 2], dtype=F64)
    _, directions = rays(600)
    directions = torch.nn.functional.normalize(directions) - eye
    whole, part = (s.hits(eye, directions, 3) for s in (surface, surface.seen_from(eye)))
    torch.testing.assert_close(whole.t, part.t, rtol=1e-12, atol=0)
    assert torch.equal(whole.piece, part.piece)
    left = sum(len(side.quadrics.tree.order) for side in surface.seen_from(eye).described)
    assert left == 2 * len(surface) if faces == "both" else left < 0.9 * len(surface)


def test_balls_at_one_place_and_hits_at_their_ends(either):
    cover = [x[:1].repeat(600, *[1] * (x.ndim - 1)) for x in torus(200)]
    one = Slim(*(x[:1] for x in cover))
    origins = cover[0][:1] + torch.tensor([[2.0, 0.01, 0.02]])
    direction = torch.tensor([-1.0, 0, 0], dtype=F64)
    many, alone = (s.hit(origins, direction) for s in (Slim(*cover), one))
    torch.testing.assert_close(many.t, alone.t)
    flat = Slim(
        torch.zeros(1, 3, dtype=F64),
        torch.ones(1, dtype=F64),
        torch.zeros(1, 3, 3).double(),
        torch.tensor([[0, 0, 0.5]]).double(),
        torch.zeros(1).double(),
    )
    on_end = torch.tensor([[1.0, 0, 2]], dtype=F64)
    hit = flat.hit(on_end, torch.tensor([0.0, 0, -1], dtype=F64))
    assert hit.t.tolist() == [2.0]
    assert flat.at(on_end, torch.tensor([0.0, 0, -1], dtype=F64), hit).normal.tolist() == [[0, 0, 1]]


# --- derivatives ------------------------------------------------------------------------------------------------------


def overlapping(count: int) -> list[Tensor]:
    """Covers of one place, whose hits from above are all blended."""
    cover = [x[:count].clone() for x in anyhow(3)]
    cover[0] *= 0.3
    cover[1] += 0.5
    cover[3] = torch.tensor([0.0, 0, 1]) + 0.2 * cover[3]
    return cover


ABOVE = torch.tensor([[0.1, 0.05, 3.0], [9, 9, 9]], dtype=F64), torch.tensor([[0.01, 0.02, -1], [1, 0, 0]], dtype=F64)


def test_derivatives_in_places_radii_coefficients_and_rays():
    def shown(*given):
        surface = Slim(*given[:5], offset=2.0)
        hit = surface.hit(*given[5:])
        assert hit.valid.tolist() == [True, False]
        at = surface.at(*given[5:], hit, order=2)
        return hit.t[:1], at.point, at.normal, at.curvatures

    alone = Slim(*overlapping(3), offset=2.0)
    assert len(alone._met(ABOVE[0][:1], ABOVE[1][:1], alone.hit(ABOVE[0][:1], ABOVE[1][:1]).blend, 1, False).row) == 3
    given = [x.clone().requires_grad_() for x in (*overlapping(3), *ABOVE)]
    assert torch.autograd.gradcheck(shown, given)


def test_second_derivatives():
    def shown(*given):
        surface = Slim(*given[:5], offset=2.0)
        hit = surface.hit(*given[5:])
        return hit.t, surface.at(*given[5:], hit).normal

    given = [x.clone().requires_grad_() for x in (*overlapping(2), *(x[:1] for x in ABOVE))]
    assert torch.autograd.gradgradcheck(shown, given, fast_mode=True)


def test_hits_that_come_and_go_change_nothing():
    """A ray crosses the end of a ball: t and its derivatives by radii go on smoothly."""
    cover = [x.requires_grad_() for x in torus(1500)]
    surface = Slim(*cover)
    x = torch.linspace(-0.05, 0.05, 4001, dtype=F64)
    origins = torch.stack((x, torch.full_like(x, 1.05), torch.full_like(x, 3)), 1)
    hit = surface.hit(origins, torch.tensor([0.0, 0, -1], dtype=F64))
    t, steps = hit.t.detach(), 0.1 / 4000
    assert (t[2:] - 2 * t[1:-1] + t[:-2]).abs().amax() < 5 * 4 * steps**2
    (by_radii,) = torch.autograd.grad(hit.t.sum(), cover[1])
    assert by_radii.abs().amax() > 0


def test_derivatives_are_finite_where_there_are_none():
    """Tangents, ends of balls, the very centre, both of a weight's formulas."""
    cover = [x.requires_grad_() for x in anyhow(2)]
    with torch.no_grad():
        for x, value in zip(cover[:2], (0.0, 1.0), strict=True):
            x.fill_(value)
        cover[2].copy_(torch.eye(3).expand(2, 3, 3))
        cover[3].fill_(0)
        cover[4].fill_(-1.0)
    surface = Slim(*cover)
    places = torch.tensor([[0, 0], [1, 0], [1 - 1e-12, 0], [0.5, 0.5], [0.6, -0.8]], dtype=F64)
    origins = torch.cat((places, torch.full((5, 1), 3.0).double()), 1).requires_grad_()
    direction = torch.tensor([0.0, 0, -1], dtype=F64, requires_grad=True)
    hit = surface.hit(origins, direction)
    assert int(hit.valid.sum()) >= 3
    at = surface.at(origins, direction, hit, order=2)
    total = hit.t[hit.valid].sum() + at.normal.sum() + at.curvatures.sum()
    assert all(bool(g.isfinite().all()) for g in torch.autograd.grad(total, (*cover, origins, direction)))


def test_numbers_changed_in_place_are_seen():
    surface, (origins, directions) = Slim(*torus(300)), rays(100)
    before, domain = surface.hit(origins, directions), surface.domain
    surface.centers.add_(0.1)
    after = surface.hit(origins, directions)
    torch.testing.assert_close(after.t, Slim(*surface.tensors).hit(origins, directions).t, rtol=0, atol=0)
    assert not torch.equal(after.t, before.t)
    assert surface.domain.center[0] == pytest.approx(domain.center[0] + 0.1)
    surface.radii[0] = -1
    with pytest.raises(ValueError, match="radii must be positive; 1 of"):
        surface.hit(origins, directions)


def test_steps_of_an_optimiser_stay_finite():
    truth = Slim(*torus(400))
    cover = [x + 0.01 * torch.randn(x.shape, dtype=F64, generator=torch.Generator().manual_seed(3)) for x in torus(150)]
    cover[1] = cover[1].abs()
    given = [x.requires_grad_() for x in cover]
    surface, optimiser = Slim(*given), torch.optim.Adam(given, lr=2e-3)
    losses = []
    for step in range(60):
        o, d = rays(200, seed=step)
        seen, wanted = (s.hit(o, d) for s in (surface, truth))
        both = seen.valid & wanted.valid
        far = ((seen.t - wanted.t)[both] * d.norm(dim=1)[both]).abs()
        normal = (surface.at(o, d, seen).normal - truth.at(o, d, wanted).normal)[both].square().sum(-1)
        loss = far.clamp(max=0.1).mean() + 0.1 * normal.mean()
        optimiser.zero_grad()
        loss.backward()
        assert all(bool(x.grad.isfinite().all()) for x in given)
        optimiser.step()
        losses.append(float(loss.detach()))
    assert np.mean(losses[-10:]) < 0.8 * np.mean(losses[:10])


# --- images -----------------------------------------------------------------------------------------------------------


def test_an_image():
    surface = Slim(*torus(1500))
    camera = PerspectiveCamera.framing(surface.domain, (0.3, 1.0, 0.6))
    shown = raycast(
        surface, camera, size=(40, 40), channels=("color", "depth", "normal", "position", "sheets"), sheets=4
    )
    seen = shown["depth"][..., 0] < torch.inf
    assert torch.equal(seen, shown["color"][..., 3] > 0)
    assert distance(shown["position"][seen].double()).abs().amax() < 2e-3
    assert 0.15 < float(seen.double().mean()) < 0.5
    assert set(shown["sheets"].unique().tolist()) <= {0, 1, 2}


def test_what_is_seen_through_is_in_order():
    surface = Slim(*torus(1500), faces="both")
    camera = PerspectiveCamera.framing(surface.domain, (0.3, 1.0, 0.6))
    half = raycast(surface, camera, Phong(opacity=0.5), size=(24, 24), sheets=4)[..., 3]
    assert {round(x, 4) for x in half.unique().tolist()} <= {0.0, 0.75, 0.9375}


@pytest.mark.parametrize("faces", ["front", "both"])
def test_shadows_fall_on_others_and_not_on_what_is_lit(faces):
    """A torus, and a small one above it; the light comes from above."""
    low, high = torus(1500), torus(1000)
    high = high._replace(centers=0.3 * high.centers, radii=0.3 * high.radii, A=high.A / 0.3)
    cover = [torch.cat(rows) for rows in zip(low, high, strict=True)]
    cover[0][len(low[0]) :] += torch.tensor([1.0, 0, 1.0], dtype=F64)
    surface, light = Slim(*cover, faces=faces), torch.tensor([0.2, 0.1, 1.0], dtype=F64)
    origins, directions = (
        x.double().reshape(-1, 3) for x in PerspectiveCamera.framing(surface.domain, (0.2, -0.4, -1.0)).rays(64, 64)
    )
    hit = surface.hit(origins, directions)
    at = surface.at(origins, directions, hit)
    lit = hit.valid & ((at.normal * light).sum(-1) > 0.3)
    point, normal = at.point[lit], at.normal[lit]
    found = surface.met(point + surface.clearance(hit)[lit][:, None] * normal, light)
    way = point[:, None] + torch.linspace(0.03, 4, 400, dtype=F64)[:, None] * light
    own = torch.minimum(distance(way), 0.3 * distance((way - torch.tensor([1.0, 0, 1.0], dtype=F64)) / 0.3)).amin(1)
    sure = own.abs() > 0.02
    assert (found[sure] != (own[sure] < 0)).double().mean() < 0.005
    assert int(found.sum()) > 20
    assert int((~found).sum()) > 200
    shown = [raycast(surface, (origins, directions), lights=[Light(light)], shadows=x) for x in (False, True)]
    darker = (shown[0] - shown[1])[..., 0][lit] > 0.05
    assert (darker[sure] != found[sure]).double().mean() < 0.005


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cuts", [False, True])
def test_a_file_keeps_every_bit(tmp_path, cuts):
    planes = torch.randn(len(torus(50)[0]), 2, 4, dtype=F64) if cuts else None
    surface = Slim(*torus(50, dtype=torch.float32), cuts=planes, offset=0.3, faces="both")
    save_slim(surface, tmp_path / "cover.npz")
    again = load_slim(tmp_path / "cover.npz")
    assert is_slim(tmp_path / "cover.npz")
    assert repr(again) == repr(surface)
    for ours, theirs in zip(again.tensors, surface.tensors, strict=True):
        assert torch.equal(ours, theirs)
        assert ours.dtype == theirs.dtype
    assert again.cuts is None if planes is None else torch.equal(again.cuts, planes)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"radii": None}, "expected a SLIM surface with radii; got no such arrays"),
        ({"slim": np.array(2)}, "expected version 1 of SLIM surfaces; got 2"),
        ({"faces": np.array(7)}, "expected faces from 0 to 2; got 7"),
        ({"A": np.zeros((2, 9))}, r"expected numbers of shape \(…, 3, 3\) as A; got float64 of shape \(2, 9\)"),
        ({"b": np.array([object()])}, "expected a valid npy header|numbers of shape"),
        ({"c": np.zeros(50, np.int64)}, "expected float32 or float64 numbers as c; got int64"),
        ({"offset": np.array(math.nan)}, "offset must be a number from 0 on"),
        ({"centers": np.full((3, 3), np.inf)}, "centers must be finite"),
    ],
)
def test_bad_files_are_refused(tmp_path, changed, message):
    surface = Slim(*torus(50))
    arrays = {name: getattr(surface, name).numpy() for name in ("centers", "radii", "A", "b", "c")}
    arrays |= {"slim": np.array(1), "offset": np.array(0.5), "faces": np.array(0)}
    arrays = {name: x for name, x in (arrays | changed).items() if x is not None}
    np.savez(tmp_path / "cover.npz", **arrays)
    with pytest.raises(ValueError, match=message):
        load_slim(tmp_path / "cover.npz")


def test_what_is_no_file_of_a_cover_is_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(ValueError, match="expected an intact npz archive"):
        load_slim(tmp_path / "a.npz")
    with pytest.raises(FileNotFoundError):
        load_slim(tmp_path / "b.npz")
    with pytest.raises(ValueError, match=r"expected a name that ends in \.npz"):
        save_slim(Slim(*torus(50)), tmp_path / "c.ply")
    np.savez(tmp_path / "d.npz", samples=np.zeros((3, 3, 3)))
    assert not is_slim(tmp_path / "d.npz")


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"centers": torch.zeros(3)}, r"centers must have shape \(…, 3\); got \(3,\)"),
        ({"centers": torch.zeros(0, 3).double()}, r"radii must have shape \(0\)"),
        ({"radii": torch.ones(2).double()}, r"radii must have shape \(1\); got \(2,\)"),
        ({"radii": torch.zeros(1).double()}, "radii must be positive; 1 of 1 are not"),
        ({"A": torch.full((1, 3, 3), math.nan)}, "A must be finite; 9 of its 9 numbers are not"),
        ({"A": torch.zeros(1, 3, 3), "b": torch.zeros(1, 3)}, "A and b must not both be 0"),
        ({"c": None}, "c must be a floating-point torch.Tensor; got NoneType"),
        ({"offset": -0.5}, "offset must be a number from 0 on, of a ball's radius; got -0.5"),
        ({"faces": "sides"}, "faces must be one of front, back, both; got 'sides'"),
        ({"cuts": torch.zeros(1, 4).double()}, "normals of cuts must not be 0; 1 are"),
    ],
)
def test_bad_covers_are_refused(changed, message):
    names = ("centers", "radii", "A", "b", "c")
    good = {name: x[:1] for name, x in zip(names, torus(50), strict=True)}
    with pytest.raises((TypeError, ValueError), match=message):
        Slim(**{**good, **changed})


def test_what_needs_one_function_says_so():
    surface = Slim(*torus(50))
    with pytest.raises(TypeError, match="a mesh is that of one function, as a level set has; got Slim"):
        mesh(surface)
