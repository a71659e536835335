"""Fields on tetrahedra: against the oracle on axes of every length, across every face, and wherever fields are used."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

import filterlab as fl
from filterlab.fields import tetrahedral
from filterlab.fields.octahedral import QUADRATIC_C1
from filterlab.fields.tetrahedral import Shape
from filterlab.fields.type6 import CUBIC_C1, QSS
from filterlab.methods import METHODS, Tetrahedral
from filterlab.render import PerspectiveCamera, TransferFunction
from tests import laws, tetrahedral_oracle
from tests.pairs import in_pairs

SPLINES = [name for name, method in METHODS.items() if isinstance(method, Tetrahedral)]
every_spline = pytest.mark.parametrize("name", SPLINES)


def samples(*shape: int, seed: int = 0) -> Tensor:
    """Random numbers in [−1, 1] that float32 holds exactly."""
    values = np.random.default_rng(seed).uniform(-1, 1, shape or (7, 8, 9))
    return torch.as_tensor(values.astype(np.float32).astype(np.float64))


def around(shape: tuple[int, ...], count: int, seed: int = 1) -> Tensor:
    """Points inside and up to two and a half periods outside that float32 holds exactly."""
    n = np.array(shape[::-1])
    points = np.random.default_rng(seed).uniform(-2.5, 3.5, (count, 3)) * n
    points[::3] = np.random.default_rng(seed).uniform(-0.5, n - 0.5, (count, 3))[::3]
    return torch.as_tensor(points.astype(np.float32).astype(np.float64))


# ---- the oracle


@pytest.mark.parametrize(
    ("name", "scheme", "prefilter", "boundary"),
    in_pairs(product(SPLINES, ("fused", "direct"), (True, False), fl.Boundary)),
)
def test_axes_of_every_length(name, scheme, prefilter, boundary):
    """n = 1 … 9 and 32 along each axis: ≤ 1e-12 in float64, ≤ 5e-6 of the range in float32."""
    for n in (*range(1, 10), 32):
        shape = tuple(int(k) for k in np.roll((n, 3, 2), n % 3))
        f, points = samples(*shape, seed=n), around(shape, 24, seed=n)
        expected = tetrahedral_oracle.reconstruct(name, f.numpy(), points.numpy(), str(boundary), prefilter, 2)
        for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 5e-6)):
            field = fl.reconstruct(f.to(dtype), name, boundary=boundary, prefilter=prefilter, scheme=scheme)
            for actual, exact in zip(field.jet(points.to(dtype), 2), expected, strict=True):
                laws.assert_close(actual, exact, tolerance, 2 * max(1.0, float(np.abs(exact).max()) / 2))


# ---- across faces


def faces(name: str, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points (M, 3) on faces of tetrahedra of all kinds, unit normals, and which of the faces are between cells."""
    spline, rng = tetrahedral_oracle.SPLINES[name], np.random.default_rng(2)
    points, normals, outer = [], [], []
    for index in rng.integers(len(spline.tetrahedra), size=count):
        vertices = np.array(spline.tetrahedra[index].vertices, dtype=float)
        cell = 2 * rng.integers(1, 3, 3) + float(spline.shift)
        for opposite in range(4):
            a, b, c = np.delete(vertices, opposite, 0)
            normal = np.cross(b - a, c - a)
            points.append(cell + rng.dirichlet((2, 2, 2)) @ np.array((a, b, c)))
            normals.append(normal / np.linalg.norm(normal))
            outer.append(opposite == 0)
    return torch.as_tensor(np.array(points)), torch.as_tensor(np.array(normals)), torch.tensor(outer)


def jumps(name: str) -> tuple[list[Tensor], Tensor]:
    """Of value and gradient (M,), each side's polynomial continued to the face, and which faces are between cells."""
    points, normals, outer = faces(name, 200)
    field = fl.reconstruct(samples(), name)
    sides = []
    for step in (-1e-7, 1e-7):
        at = points + step * normals
        off = at - points
        value, gradient, hessian = field.jet(at, 2)
        bend = torch.einsum("mij,mj->mi", hessian, off)
        sides.append((value - (gradient * off).sum(-1) + (bend * off).sum(-1) / 2, gradient - bend))
    return [(a - b).abs().reshape(len(points), -1).amax(-1) for a, b in zip(*sides, strict=True)], outer


@every_spline
def test_values_and_gradients_do_not_jump_where_that_is_promised(name):
    """A continued cubic is exact to 1e-20 in value; its gradient to the third derivative times 1e-14."""
    (value, gradient), outer = jumps(name)
    assert outer.sum() == 200
    assert float(value.max()) <= 1e-13
    if METHODS[name].facts.continuity == 1:
        assert float(gradient.max()) <= 1e-12
    else:
        assert float(gradient[outer].max()) <= 1e-12
        assert float(gradient[~outer].max()) > 0.05


@every_spline
def test_hessians_are_constant_or_linear_and_jump(name):
    field, (points, normals, _) = fl.reconstruct(samples(), name), faces(name, 60)
    ahead, behind = (field.jet(points + s * normals, 2)[2] for s in (1e-7, -1e-7))
    assert float((ahead - behind).abs().max()) > 0.5
    inner = torch.tensor([4.0, 4.0, 4.0]) + float(METHODS[name].spline.shift)  # type: ignore[attr-defined]
    line = inner + torch.linspace(0.1, 0.3, 5, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.3, 0.1])
    bends = field.jet(line, 2)[2]
    if METHODS[name].spline.degree == 2:  # type: ignore[attr-defined]
        laws.assert_close(bends, bends[:1].expand_as(bends), 1e-12)
    else:
        laws.assert_close(bends[:-2] + bends[2:], 2 * bends[1:-1], 1e-11)
        assert float((bends[1:] - bends[:-1]).abs().max()) > 1e-3


# ---- where octahedra are


@pytest.mark.parametrize(("boundary", "n"), [("mirror", 6), ("reflect", 5), ("wrap", 5), ("wrap", 6)])
def test_octahedra_are_moved_by_whole_periods_and_not_reflected(boundary, n):
    """A reflection about a sample, or an odd period, leads to octahedra that lie otherwise: another value."""
    f, points = samples(4, 4, n), around((4, 4, n), 50) % 1 + 1
    field = fl.reconstruct(f, "quadratic-c1", boundary=boundary)
    period = fl.Boundary.named(boundary).period(n)
    assert period is not None
    along = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    laws.assert_close(field(points + math.lcm(int(period), 2) * along), field(points), 1e-12)
    other = points + period * along if boundary == "wrap" else points * (1 - 2 * along)
    if boundary == "reflect":
        other = other - along
    same = float((field(other) - field(points)).abs().max()) < 1e-12
    assert same == (boundary == "reflect" or (boundary, n) == ("wrap", 6))


# ---- wherever fields are used


@every_spline
def test_resampling_is_pointwise(name):
    volume = fl.Volume(samples(5, 6, 7), spacing=(1.0, 1.5, 2.0))
    for shape in ((7, 5, 9), (5, 6, 7)):
        fine = fl.resample(volume, name, shape=shape)
        z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in shape), indexing="ij")
        points = fine.geometry.to_world(torch.stack((x, y, z), -1))
        laws.assert_close(fine.samples, fl.reconstruct(volume, name)(points), 1e-12)


@every_spline
def test_what_is_lacking_is_said(name):
    with pytest.raises(TypeError, match="measured only"):
        fl.spectrum.axis_response(name, torch.zeros(1))
    with pytest.raises(ValueError, match="offers the schemes fused, direct; got 'sampled'"):
        fl.reconstruct(samples(), name, scheme="sampled")
    with pytest.raises(ValueError, match="takes no samples between voxels"):
        fl.reconstruct(samples(), name, sampler="texture_unit")


@every_spline
def test_images_are_those_of_the_field(name):
    """Rendered through the plain path: a volume that is linear has the image of any method that reproduces it."""
    z, y, x = torch.meshgrid(*(torch.linspace(0, 1, 8, dtype=torch.float64),) * 3, indexing="ij")
    volume = (x + 2 * y + z) / 4
    transfer = TransferFunction([0.2, 0.5, 0.8], [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [0.0, 0.3, 0.1])
    region = ((2.0,) * 3, (5.0,) * 3)
    images = []
    for method in (name, "trilinear"):
        field = fl.reconstruct(volume, method, boundary="border", prefilter=False)
        camera = PerspectiveCamera.framing(field.domain, (0.4, 0.8, -0.45))
        images.append(fl.render.render(field, camera, transfer, size=(12, 10), step=0.5, region=region))
    laws.assert_close(images[0], images[1], 1e-6)
    assert float(images[0][..., 3].max()) > 0.1


@every_spline
def test_it_can_be_recommended(name):
    volume = fl.signals.gaussian().sample(12).samples
    answer = fl.recommend(volume, 0.5, methods=[name], seconds=0.01)
    assert answer.pick is not None
    assert answer.pick.method == name
    assert answer.field(volume)(torch.zeros(2, 3)).shape == (2,)


def test_a_field_compiles_whole():
    torch._dynamo.reset()
    field = fl.reconstruct(fl.Volume(samples(4, 5, 6).float(), spacing=(1, 2, 0.5)), "qss")
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)) * 9 - 2
    whole = torch.compile(field, fullgraph=True, backend="eager")
    laws.assert_close(whole(points), field(points), 1e-6)


# ---- the tables themselves


def test_shapes_that_do_not_belong_together_are_refused():
    incomplete = Shape(QSS.shapes[0].vertices, dict(list(QSS.shapes[0].masks.items())[1:]))
    with pytest.raises(ValueError, match="expected a mask for every coefficient of degree 2"):
        replace(QSS, shapes=(incomplete,))
    with pytest.raises(ValueError, match="need different samples"):
        replace(QSS, shapes=(QSS.shapes[0], QUADRATIC_C1.shapes[0]))


def test_norms_are_the_published_ones():
    assert [str(spline.norm) for spline in (QSS, CUBIC_C1, QUADRATIC_C1)] == ["9/8", "1", "5/4"]


@every_spline
def test_points_in_parts_have_the_same_bits(name, monkeypatch):
    f, points = samples().float(), around((7, 8, 9), 300).float()
    whole = fl.reconstruct(f, name).jet(points, 2)
    monkeypatch.setattr(tetrahedral, "AT_ONCE", 37)
    for a, b in zip(fl.reconstruct(f, name).jet(points, 2), whole, strict=True):
        assert torch.equal(a, b)
