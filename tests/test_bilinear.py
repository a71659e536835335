"""Bilinear quadrilaterals: what is aimed at is hit, flat or not; meshes of them leave no gap; derivatives; errors."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from filterlab.ops.differentiable import quadrics as ops
from filterlab.render import OrthographicCamera, PerspectiveCamera, raycast
from filterlab.surfaces import BilinearQuads, Quadrics, Tetrahedra

F64 = torch.float64
HEIGHTS = [1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 0.0]
SQUARE = torch.tensor([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=F64)


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def within(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def corners(count: int, height: float) -> Tensor:
    """Quads of size 1 (M, 4, 3), so far from flat, turned anyhow, in a cube of side 40."""
    flat = SQUARE + 0.12 * numbers(count, 4, 3, seed=1)
    flat[..., 2] = height * (within(count, 4, seed=2) - 0.5)
    turn = torch.linalg.qr(numbers(count, 3, 3, seed=3))[0]
    return (flat[..., None, :] * turn[:, None]).sum(-1) + 40 * within(count, 1, 3, seed=4) - 20


def quads_of(own: Tensor, **more) -> BilinearQuads:
    return BilinearQuads(own.reshape(-1, 3), torch.arange(4 * len(own)).view(-1, 4), **more)


def on_patch(own: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """The patch as everyone writes it."""
    a, b, c, d = own.unbind(-2)
    u, v = u[..., None], v[..., None]
    return (1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d


def aimed(own: Tensor, u: Tensor, v: Tensor, distance: float = 9.0, seed: int = 5) -> tuple[Tensor, Tensor]:
    """Rays at points of patches, and unit directions."""
    way = torch.nn.functional.normalize(numbers(len(own), 3, seed=seed), dim=-1)
    return on_patch(own, u, v) - distance * way, way


def at_own(t: Tensor, piece: Tensor, where: float) -> Tensor:
    """(R,) by how much the nearest hit with a ray's own patch is off."""
    own = piece == torch.arange(len(t))[:, None]
    return torch.where(own, (t - where).abs(), torch.inf).amin(1)


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
@pytest.mark.parametrize("height", HEIGHTS)
def test_what_is_aimed_at_is_hit(height, implementation):
    own = corners(800, height)
    u, v = within(2, 800, seed=6)
    u[:200], v[200:300] = (u[:200] > 0.5).double(), (v[200:300] > 0.5).double()  # edges and corners
    v[:50] = (v[:50] > 0.5).double()
    o, d = aimed(own, u, v)
    surface = quads_of(own)
    t, piece = ops.hits(surface.described, o, d, 8, implementation=implementation)
    off = at_own(t, piece, 9.0)
    assert off.max() < 1e-9
    assert off.median() < 1e-14 * 60


@pytest.mark.parametrize("height", HEIGHTS)
def test_every_hit_is_on_its_patch(height):
    """Of rays at anything: parameters within the patch, the point where they say, the normal at right angles to both
    lines, on the side that S_u × S_v points to."""
    own = corners(300, height)
    surface = quads_of(own)
    o = 30 * numbers(500, 3, seed=7)
    d = own[torch.arange(500) % 300].mean(1) + 0.3 * numbers(500, 3, seed=8) - o
    hits = surface.hits(o, d, 4)
    assert int(hits.valid.sum()) > 200
    at, where = surface.at(o, d, hits), surface.parameters(o, d, hits)
    u, v = where[hits.valid].unbind(-1)
    mine = own[hits.piece[hits.valid]]
    assert ((where >= -1e-9) & (where <= 1 + 1e-9)).all()
    torch.testing.assert_close(on_patch(mine, u, v), at.point[hits.valid], rtol=0, atol=1e-11)
    first = on_patch(mine, u + 1, v) - on_patch(mine, u, v)
    second = on_patch(mine, u, v + 1) - on_patch(mine, u, v)
    normal = torch.nn.functional.normalize(torch.linalg.cross(first, second), dim=-1)
    torch.testing.assert_close(at.normal[hits.valid], normal, rtol=0, atol=1e-8)


@pytest.mark.parametrize("height", [1.0, 1e-2, 1e-4, 1e-6])
def test_rays_of_float32_see_the_patch(height):
    """From nine sizes away, as of a picture: to 1e-5 of the size, none missed."""
    own = corners(60, height)
    own = (own - own.mean(1, keepdim=True)).float()
    u, v = (0.01 + 0.98 * within(2, 60, seed=6)).float()
    normal = torch.linalg.cross(own[:, 2] - own[:, 0], own[:, 3] - own[:, 1]).double()
    way = torch.nn.functional.normalize(normal + 0.2 * normal.norm(dim=1, keepdim=True) * numbers(60, 3, seed=9), dim=1)
    aim = on_patch(own.double(), u.double(), v.double())
    o, d = (aim - 9 * way).float(), way.float()
    hits = quads_of(own).hits(o, d, 130)
    mine = hits.valid & (hits.piece == torch.arange(60)[:, None])
    point = o[:, None].double() + torch.where(mine, hits.t, 0)[..., None].double() * d[:, None].double()
    off = (point - aim[:, None]).norm(dim=-1)
    assert torch.where(mine, off, torch.inf).amin(1).max() < 1e-5


def test_they_are_quadrics_in_tetrahedra():
    """Stoll, Gumhold & Seidel's: the same picture where corners are not in a plane."""
    own = corners(200, 1.0)
    a, d = own[:, 1] - own[:, 0], own[:, 3] - own[:, 0]
    h = own[:, 0] - own[:, 1] + own[:, 2] - own[:, 3]
    nx, ny, nz = torch.linalg.cross(d, h), torch.linalg.cross(h, a), torch.linalg.cross(a, d)
    det = (nz * h).sum(1)
    outer = nx[:, :, None] * ny[:, None]
    scale = -det.sign() / det.abs() ** 2
    A, b = (outer + outer.mT) / 2 * scale[:, None, None], -(det * scale / 2)[:, None] * nz
    quadrics = Quadrics(A, b, torch.zeros(200, dtype=F64), Tetrahedra(own), origins=own[:, 0])
    surface = quads_of(own)
    o = 30 * numbers(2000, 3, seed=7)
    d = own[torch.arange(2000) % 200].mean(1) + 0.3 * numbers(2000, 3, seed=8) - o
    of = [s.hits(o, d, 6) for s in (surface, quadrics)]
    assert torch.equal(of[0].piece, of[1].piece)
    torch.testing.assert_close(of[0].t, of[1].t, rtol=1e-9, atol=1e-9)
    normals = [s.at(o, d, hits).normal for s, hits in zip((surface, quadrics), of, strict=True)]
    torch.testing.assert_close(*normals, rtol=0, atol=1e-6)


def saddle(**more) -> BilinearQuads:
    """z = x y above [−1, 1]²."""
    vertices = torch.tensor([[-1, -1, 1], [1, -1, -1], [1, 1, 1], [-1, 1, -1]], dtype=F64)
    return BilinearQuads(vertices, torch.tensor([[0, 1, 2, 3]]), **more)


def test_a_saddle():
    x, y = 1.8 * within(2, 50) - 0.9
    o = torch.stack((x, y, torch.full_like(x, 3.0)), -1)
    d = torch.tensor([0, 0, -2.0], dtype=F64)
    surface = saddle()
    hit = surface.hit(o, d)
    torch.testing.assert_close(hit.t, (3 - x * y) / 2)
    at, parameters = surface.at(o, d, hit, order=2), surface.parameters(o, d, hit)
    torch.testing.assert_close(parameters, torch.stack((x + 1, y + 1), -1) / 2)
    size = (1 + x * x + y * y).sqrt()
    torch.testing.assert_close(at.normal, torch.stack((-y, -x, torch.ones_like(x)), -1) / size[:, None])
    torch.testing.assert_close(at.curvatures.prod(-1), -1 / size**4)  # Gauss's
    torch.testing.assert_close(at.curvatures.sum(-1), 2 * x * y / size**3)  # −(f_xx(1+f_y²) − 2 f_x f_y f_xy + …)/W³


def test_faces():
    o, d = (
        torch.tensor([[0.2, 0.3, 3.0], [0.2, 0.3, -3.0]]).double(),
        torch.tensor([[0, 0, -1.0], [0, 0, 1.0]]).double(),
    )
    valid = {faces: saddle(faces=faces).hit(o, d).valid.tolist() for faces in ("front", "back", "both")}
    assert valid == {"front": [True, False], "back": [False, True], "both": [True, True]}


# --- meshes -----------------------------------------------------------------------------------------------------------


def ball(n: int, rough: float) -> tuple[Tensor, Tensor]:
    """A closed mesh: the surface of a cube of n³ cells, blown up, its vertices moved at random."""
    faces, index = [], {}

    def number(*place: int) -> int:
        return index.setdefault(place, len(index))

    for axis in range(3):
        for side in (0, n):
            for i in range(n):
                for j in range(n):
                    ring = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)][:: 1 if side else -1]
                    places = [(side, a, b) for a, b in ring]
                    faces.append([number(*(p[(k - axis) % 3] for k in range(3))) for p in places])
    grid = torch.tensor(list(index), dtype=F64) * 2 / n - 1
    vertices = torch.nn.functional.normalize(grid, dim=-1)
    return vertices * (1 + rough * (within(len(grid), 1, seed=11) - 0.5)) + 3, torch.tensor(faces)


@pytest.mark.parametrize("rough", [0.0, 0.2, 1e-5])
def test_no_ray_slips_through_a_mesh(rough):
    """Rays from inside at points of edges and at vertices, and anywhere: all are stopped."""
    vertices, faces = ball(6, rough)
    surface = BilinearQuads(vertices, faces)
    own = vertices[faces].repeat(20, 1, 1)
    side, along = torch.arange(len(own)) % 4, within(len(own), seed=12)
    along[: len(own) // 4] = along[: len(own) // 4].round()
    rows = torch.arange(len(own))
    edge = torch.lerp(own[rows, side], own[rows, (side + 1) % 4], along[:, None])
    eye = 3 + 0.3 * numbers(len(own), 3, seed=13)
    eye = eye.where(((eye - 3).norm(dim=1) < 0.6)[:, None], torch.tensor(3.0, dtype=F64))
    for aim in (edge, edge + 0.3 * numbers(len(own), 3, seed=14)):
        assert bool(surface.hit(eye, aim - eye).valid.all())


@pytest.mark.parametrize("rough", [0.0, 0.3])
def test_a_closed_mesh_is_crossed_an_even_number_of_times(rough):
    """The mesh has one outside: fronts and backs follow each other."""
    vertices, faces = ball(5, rough)
    o, aim = 3 + 4 * torch.nn.functional.normalize(numbers(4000, 3, seed=15), dim=-1), 3 + 0.6 * numbers(4000, 3)
    both, fronts, backs = (
        BilinearQuads(vertices, faces, faces=side).hits(o, aim - o, 12).t for side in ("both", "front", "back")
    )
    count = both.isfinite().sum(-1)
    assert (count % 2 == 0).all()
    assert int((count > 0).sum()) > 2000
    assert torch.equal(both[:, 0::2], fronts[:, :6])
    assert torch.equal(both[:, 1::2], backs[:, :6])
    last = BilinearQuads(vertices, faces).hits(o, aim - o, 12, farthest=True).t
    for row, back, n in zip(both, last, count, strict=True):
        torch.testing.assert_close(row[:n].flip(0), back[:n], rtol=1e-12, atol=1e-12)


def test_triangles_are_quads_with_two_corners_in_one_place():
    vertices = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=F64)
    x, y = within(2, 400, seed=16)
    o, down = torch.stack((x, y, torch.ones_like(x)), -1), torch.tensor([0, 0, -1.0]).double()
    for row in ([0, 1, 2, 2], [0, 0, 1, 2], [0, 1, 1, 2]):
        surface = BilinearQuads(vertices, torch.tensor([row]))
        hit = surface.hit(o, down)
        assert torch.equal(hit.valid, x + y <= 1)
        assert (surface.at(o, down, hit).normal[hit.valid] == torch.tensor([0, 0, 1.0]).double()).all()


def test_a_ray_in_a_flat_patch_does_not_hit_it():
    surface = BilinearQuads(SQUARE, torch.tensor([[0, 1, 2, 3]]))
    assert not surface.hit(torch.tensor([-1, 0.5, 0]).double(), torch.tensor([1, 0, 0.0]).double()).valid


Cast = tuple[ops.InLeaves, Tensor, Tensor, Tensor]
"""Patches, origins, directions, and whether a ray hits."""


def above_a_square(tilt: float, count: int = 200) -> Cast:
    """And parallel to it but for so much, as of the sides of a box that is seen from the front."""
    turn = torch.linalg.qr(numbers(3, 3, seed=3))[0]
    turned = lambda x: (x[..., None, :] * turn).sum(-1)  # noqa: E731
    above = torch.cat((within(count, 2, seed=21), 0.01 + 0.4 * within(count, 1, seed=22)), 1)
    way = torch.cat((numbers(count, 2, seed=23), tilt * numbers(count, 1, seed=24)), 1)
    way = turned(way / way.norm(dim=1, keepdim=True))
    cast = BilinearQuads(turned(SQUARE), torch.tensor([[0, 1, 2, 3]])).described
    return cast, turned(above) - 5 * way, way, torch.zeros(count, dtype=torch.bool)


def at_tips(row: list[int], count: int = 120) -> Cast:
    """Of a triangle: 1e-10 within, and beside."""
    vertices = numbers(3, 3, seed=25)
    corner = vertices.repeat(count // 3 + 1, 1)[:count]
    into = torch.nn.functional.normalize(vertices.mean(0) - corner, dim=1)
    way = torch.nn.functional.normalize(numbers(count, 3, seed=26), dim=1)
    hit = torch.arange(count) % 2 == 0
    o = corner + torch.where(hit, 1e-10, -1e-10)[:, None] * into - 2 * way
    return BilinearQuads(vertices, torch.tensor([row])).described, o, way, hit


def along_lines(count: int = 200) -> Cast:
    """Of a triangle, 1e-9 above them, and falling by 1e-11 to 1e-13 a unit of length only."""
    vertices = numbers(3, 3, seed=25)
    normal = torch.nn.functional.normalize(torch.linalg.cross(*(vertices[1:] - vertices[0])), dim=0)
    foot = torch.lerp(vertices[0], vertices[1], within(count, 1, seed=27))
    way = torch.nn.functional.normalize(vertices[2] - foot, dim=1)
    falls = 10.0 ** -(11 + 2 * within(count, 1, seed=28))
    o = foot + 1e-9 * normal + 1e-7 * numbers(count, 3, seed=29) * way - 3 * way
    cast = BilinearQuads(vertices, torch.tensor([[0, 1, 2, 2]])).described
    return cast, o, way - falls * normal, torch.zeros(count, dtype=torch.bool)


AT_EDGES: dict[str, Cast] = {f"tilt {tilt:g}": above_a_square(tilt) for tilt in (0, 1e-15, 1e-9, 1e-7, 1e-4)}
AT_EDGES |= {f"tips {row}": at_tips(row) for row in ([0, 1, 2, 2], [0, 0, 1, 2], [0, 1, 1, 2], [0, 1, 2, 0])}


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
@pytest.mark.parametrize("cast", AT_EDGES)
def test_flat_patches_end_where_they_do(cast, implementation):
    """Beside them, and at tips of triangles, where α, β, γ are 0 to within rounding, or nearly."""
    given, o, d, expected = AT_EDGES[cast]
    assert torch.equal(ops.hits(given, o, d, 1, implementation=implementation)[1][:, 0] >= 0, expected)


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
def test_lines_of_a_triangle_that_a_ray_follows_are_seldom_hit(implementation):
    """Rounding may move a ray and its line by more than is between them, but not to the ends of the line."""
    given, o, d, _ = along_lines()
    t = ops.hits(given, o, d, 1, implementation=implementation)[0]
    assert 200 - int(t.isinf().sum()) <= 10
    assert ((t > 2.9) & (t < 5) | t.isinf()).all()


def test_the_program_does_what_plain_torch_does():
    vertices, faces = ball(8, 0.3)
    o, d = 3 + 2 * numbers(3000, 3, seed=17), numbers(3000, 3, seed=18)
    for faces_, farthest in (("both", False), ("front", True)):
        cast = BilinearQuads(vertices, faces, faces=faces_).described
        (t, piece), (own_t, own) = (ops.hits(cast, o, d, 4, farthest, i) for i in ("cpu", "reference"))
        assert torch.equal(piece, own)
        torch.testing.assert_close(t, own_t, rtol=1e-10, atol=1e-10)


def test_an_image():
    surface = BilinearQuads(*(x.numpy() for x in ball(6, 0.1)))
    camera = PerspectiveCamera.framing(surface.domain, (0.3, 1.0, -0.4))
    image = raycast(surface, camera, size=(24, 24), channels=("color", "normal", "depth"), shadows=True)
    covered = image["color"][..., 3]
    assert 0.2 < float(covered.mean()) < 0.7
    assert bool(image["color"].isfinite().all())
    assert (image["normal"].norm(dim=-1) - covered).abs().max() < 1e-6


def test_a_box_seen_along_its_faces():
    """Turned anyhow, so that rays along faces are at right angles with their normals to within rounding only."""
    turn = torch.linalg.qr(numbers(3, 3, seed=30))[0]
    ends = torch.tensor([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=F64) - 0.5
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    box = BilinearQuads((ends[..., None, :] * turn).sum(-1), torch.tensor(quads))
    way, up = ([float(x) for x in turn[:, k]] for k in (0, 2))
    camera = OrthographicCamera(position=tuple(-3 * x for x in way), target=(0, 0, 0), up=tuple(up), height=1.6)
    image = raycast(box, camera, size=(32, 32), dtype=F64)
    assert float(image[..., 3].sum()) == 20**2


# --- derivatives ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("height", [1.0, 0.0], ids=["bent", "flat"])
def test_derivatives_in_vertices_and_rays(height):
    vertices = SQUARE + 0.2 * numbers(4, 3, seed=19)
    vertices[:, 2] = height * torch.tensor([0.2, -0.3, 0.4, 0.1])
    o = torch.tensor([[0.3, 0.4, 2.0], [9, 9, 9]]).double()
    d = torch.tensor([[0.1, 0.05, -1.3], [0, 0, 1.0]]).double()

    def surface(given):
        return BilinearQuads(given, torch.tensor([[0, 1, 2, 3]]))

    def t(vertices, o, d):
        hit = surface(vertices).hit(o, d)
        assert hit.valid.tolist() == [True, False]
        return torch.where(hit.valid, hit.t, 0)

    def shown(vertices, o, d):
        own = surface(vertices)
        hit = own.hit(o, d)
        at = own.at(o, d, hit, order=2)
        bent = (at.curvatures,) if height else ()
        return at.point, at.normal, own.parameters(o, d, hit), *bent

    given = [x.clone().requires_grad_() for x in (vertices, o, d)]
    hit = [given[0], *(x.detach()[:1].requires_grad_() for x in given[1:])]
    assert torch.autograd.gradcheck(t, given)
    assert torch.autograd.gradcheck(shown, hit)
    assert torch.autograd.gradgradcheck(lambda *x: t(*x)[0], given, fast_mode=height == 0)
    if height:
        assert torch.autograd.gradgradcheck(lambda x: shown(x, o[:1], d[:1])[1][0, 0], given[:1])


def test_a_mesh_is_fitted_to_depths():
    """Moved vertices find back to where rays say the surface is; a flat mesh to begin with."""
    n = 4
    x, y = torch.meshgrid(*[torch.linspace(0, 1, n + 1, dtype=F64)] * 2, indexing="ij")
    height = 0.1 * (3 * x + 4 * y).sin().flatten()
    number = torch.arange((n + 1) ** 2).view(n + 1, n + 1)
    quads = torch.stack((number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]), -1).view(-1, 4)
    flat = torch.stack((x.flatten(), y.flatten(), torch.zeros_like(height)), -1)
    o = torch.cat((0.01 + 0.98 * within(300, 2, seed=20), torch.ones(300, 1, dtype=F64)), 1)
    down = torch.tensor([0, 0, -1.0]).double()
    wanted = BilinearQuads(flat + height[:, None] * torch.tensor([0, 0, 1.0]).double(), quads).hit(o, down).t
    moved = torch.zeros_like(height, requires_grad=True)
    optimizer = torch.optim.LBFGS([moved], max_iter=40, line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        vertices = flat + moved[:, None] * torch.tensor([0, 0, 1.0]).double()
        off = ((BilinearQuads(vertices, quads).hit(o, down).t - wanted) ** 2).sum()
        off.backward()
        return off

    optimizer.step(loss)
    torch.testing.assert_close(moved.detach(), height, rtol=0, atol=1e-4)


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"vertices": SQUARE[:, :2]}, r"vertices must have shape \(…, 3\); got \(4, 2\)"),
        ({"vertices": SQUARE * math.nan}, "vertices must be finite; 12 of its 12 numbers are not"),
        ({"vertices": SQUARE.long()}, "vertices must be a floating-point torch.Tensor; got torch.int64"),
        ({"quads": torch.tensor([[0.0, 1, 2, 3]])}, "quads must be integers; got torch.float32"),
        ({"quads": torch.tensor([0, 1, 2, 3])}, r"quads must have shape \(Q, 4\), of one quad at least; got \(4,\)"),
        ({"quads": torch.zeros(0, 4).long()}, r"of one quad at least; got \(0, 4\)"),
        ({"quads": torch.tensor([[0, 1, 2, 4], [-1, 0, 1, 2]])}, "from 0 to 3; 2 of them are not"),
        ({"quads": torch.tensor([[0, 1, 0, 1], [0, 1, 2, 3]])}, "the diagonals of 1 of 2 are parallel"),
        ({"faces": "sides"}, "faces must be one of both, front, back; got 'sides'"),
    ],
)
def test_bad_quads_are_refused(changed, message):
    with pytest.raises((TypeError, ValueError), match=message):
        BilinearQuads(**{"vertices": SQUARE, "quads": torch.tensor([[0, 1, 2, 3]]), **changed})


def test_what_they_need_is_said():
    with pytest.raises(ValueError, match="expected which one as piece"):
        saddle().jet(torch.zeros(1, 3), 0)
