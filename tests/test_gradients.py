"""Derivatives: analytic = autograd = finite difference, to every order, in volume, points and kernel parameters."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pytest
import torch

from filterlab import ops, signals
from filterlab.kernels import KERNELS, bc
from filterlab.methods import METHODS, reconstruct
from filterlab.volume import Boundary, Volume
from tests import laws
from tests.pairs import covering
from tests.test_methods import every_way, every_way_and_boundary, in_ways, kind_of, ways
from tests.test_volume import rotated

every_method = pytest.mark.parametrize("method", METHODS)
every_boundary = pytest.mark.parametrize("boundary", Boundary)
SHAPE = (4, 3, 5)
FRACTIONS = [*permutations((0.13, 0.29, 0.34)), *permutations((0.12, 0.35, 0.4))]


def volume(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.as_tensor(np.random.default_rng(seed).uniform(-1, 1, shape or SHAPE))


def off_knots(*lead: int, shape: tuple[int, ...] = SHAPE, seed: int = 1) -> torch.Tensor:
    """Points up to a period outside whose fractions stay 0.1 and more away from 0, ½ and 1.

    Those of one point are so different that it keeps 0.03 away from the faces of tetrahedra too.
    """
    rng, n = np.random.default_rng(seed), np.array(shape[::-1])
    cells = np.floor(rng.uniform(-n, 2 * n, (*lead, 3)))
    fractions = np.array(FRACTIONS)[rng.integers(len(FRACTIONS), size=lead)]
    return torch.as_tensor(cells + np.where(rng.random((*lead, 3)) < 0.5, fractions, 1 - fractions))


# ---- analytic, automatic and finite differences


@every_way_and_boundary
def test_analytic_derivatives_equal_autograd_and_finite_differences(method, scheme, gradient, prefilter, boundary):
    field = reconstruct(volume(), method, boundary=boundary, prefilter=prefilter, scheme=scheme, gradient=gradient)
    points = off_knots(25).requires_grad_()
    jet = field.jet(points, field.max_order)
    (automatic,) = torch.autograd.grad(jet[0].sum(), points, retain_graph=True)
    differences = laws.finite_difference(field, points.detach())
    laws.assert_close(automatic, differences, 1e-8)
    if gradient == "central":  # not the gradient of the value, but it has to have derivatives of its own
        assert float((automatic - jet[1]).detach().abs().max()) > 1e-2
        return
    laws.assert_close(jet[1], automatic, 1e-12, 10)
    if field.max_order > 1:
        rows = [torch.autograd.grad(jet[1][..., d].sum(), points, retain_graph=True)[0] for d in range(3)]
        laws.assert_close(jet[2], torch.stack(rows, -2), 1e-12, 10)
        laws.assert_close(jet[2], jet[2].mT, 1e-13)


@pytest.mark.parametrize(
    ("method", "scheme", "gradient", "prefilter", "boundary"),
    covering(
        ((*way, boundary) for way in ways() for boundary in Boundary),
        lambda m, s, g, p, b: (m, (kind_of(m), s, g), (s, p), (s, b), (m, s == "sampled")),
    ),
)
def test_gradcheck_and_gradgradcheck_in_volume_and_points(method, scheme, gradient, prefilter, boundary):
    """Default tolerances; second derivatives along random directions, in `test_gradcheck_of_a_batch` each of them."""
    options = {"boundary": boundary, "scheme": scheme, "gradient": gradient, "prefilter": prefilter}

    def jet(samples, points, order=None):
        field = reconstruct(samples, method, **options)
        return field.jet(points, field.max_order if order is None else order)

    shape = (2, 1, 2) if scheme == "direct" else (1, 1, 2)
    inputs = (volume(*shape).requires_grad_(), off_knots(1, shape=shape).requires_grad_())
    assert torch.autograd.gradcheck(lambda *a: laws.mixed(*jet(*a)), inputs)
    assert torch.autograd.gradgradcheck(lambda *a: laws.mixed(*jet(*a, order=1)), inputs, fast_mode=True)


def test_gradcheck_of_a_batch():
    def function(samples, points):
        return reconstruct(samples, "triquadratic").value_and_gradient(points)

    samples = volume(2, 2, 2, 1, 2).requires_grad_()
    for lead in ((2, 1), (1, 1)):
        points = off_knots(*lead, shape=(2, 1, 2)).requires_grad_()
        assert torch.autograd.gradcheck(function, (samples, points))
        assert torch.autograd.gradgradcheck(lambda *a: laws.mixed(*function(*a)), (samples, points))


def test_kernels_can_be_fitted():
    """Differentiable twice in B and C together with volume and points."""

    def function(b, c, samples, points):
        return reconstruct(samples, bc(b, c), prefilter=False).jet(points, 2)

    b, c = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.4, 0.25))
    samples, points = volume(2, 1, 2).requires_grad_(), off_knots(1, shape=(2, 1, 2)).requires_grad_()
    assert torch.autograd.gradcheck(function, (b, c, samples, points))
    assert torch.autograd.gradgradcheck(lambda *a: laws.mixed(*function(*a)), (b, c, samples, points), fast_mode=True)
    exact = reconstruct(samples, KERNELS["mitchell"], prefilter=False).jet(points, 2)
    third = torch.tensor(1 / 3, dtype=torch.float64)
    for actual, expected in zip(function(third, third, samples, points), exact, strict=True):
        laws.assert_close(actual, expected, 1e-14)


def test_fitting_finds_the_kernel_that_made_the_data():
    samples, points = volume(5, 5, 5), 4 * torch.rand(200, 3, dtype=torch.float64)
    target = reconstruct(samples, bc(0.2, 0.4), prefilter=False)(points)
    b, c = (torch.tensor(1 / 3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    optimizer = torch.optim.LBFGS([b, c], max_iter=60, tolerance_change=0.0, line_search_fn="strong_wolfe")

    def closure():
        optimizer.zero_grad()
        loss = (reconstruct(samples, bc(b, c), prefilter=False)(points) - target).square().sum()
        loss.backward()
        return loss

    optimizer.step(closure)
    assert (float(b.detach()), float(c.detach())) == pytest.approx((0.2, 0.4), abs=1e-6)


# ---- torch.func


@every_way
def test_vmap_over_volumes_points_and_both_equals_a_loop(method, scheme, gradient, prefilter):
    def function(samples, points):
        return reconstruct(samples, method, scheme=scheme, gradient=gradient, prefilter=prefilter).value_and_gradient(
            points
        )

    volumes, points = volume(3, *SHAPE), off_knots(3, 4)
    for in_dims in ((0, None), (None, 0), (0, 0)):
        mapped = torch.func.vmap(function, in_dims=in_dims)(
            volumes if in_dims[0] == 0 else volumes[0], points if in_dims[1] == 0 else points[0]
        )
        for i in range(3):
            loop = function(volumes[i if in_dims[0] == 0 else 0], points[i if in_dims[1] == 0 else 0])
            for a, b in zip(mapped, loop, strict=True):
                laws.assert_close(a[i], b, 1e-13)


@every_method
def test_vmap_over_a_batched_field_and_nested(method):
    volumes, points = volume(2, 1, 2, *SHAPE), off_knots(2, 1, 4)
    mapped = torch.func.vmap(lambda f, p: reconstruct(f, method).value_and_gradient(p))(volumes, points)
    for i in range(2):
        for a, b in zip(mapped, reconstruct(volumes[i], method).value_and_gradient(points[i]), strict=True):
            laws.assert_close(a[i], b, 1e-13)
    nested = torch.func.vmap(torch.func.vmap(lambda f, p: reconstruct(f, method)(p), (0, None)), (None, 0))
    grid = nested(volume(3, *SHAPE), off_knots(2, 4))
    for i, j in product(range(2), range(3)):
        expected = reconstruct(volume(3, *SHAPE)[j], method)(off_knots(2, 4)[i])
        laws.assert_close(grid[i, j], expected, 1e-13)


@pytest.mark.parametrize(
    ("method", "scheme", "gradient", "prefilter", "boundary"), in_ways((Boundary.MIRROR, Boundary.BORDER))
)
def test_forward_mode_equals_differences(method, scheme, gradient, prefilter, boundary):
    options = {"boundary": boundary, "scheme": scheme, "gradient": gradient, "prefilter": prefilter}

    def function(samples, points):
        return reconstruct(samples, method, **options).value_and_gradient(points)

    samples, points = volume(), off_knots(8)
    directions = volume(seed=7), torch.as_tensor(np.random.default_rng(8).uniform(-1, 1, (8, 3)))
    out, tangent = torch.func.jvp(function, (samples, points), directions)
    h = 1e-5
    ahead, behind = (function(samples + s * directions[0], points + s * directions[1]) for s in (h, -h))
    for o, t, a, b, e in zip(out, tangent, ahead, behind, function(samples, points), strict=True):
        laws.assert_close(o, e, 1e-14)
        laws.assert_close(t, (a - b) / (2 * h), 1e-7)


@pytest.mark.parametrize("method", ["triquadratic", "tricubic", "notch", "catmull-rom"])
def test_functional_hessian_and_per_point_gradients(method):
    field, points = reconstruct(volume(), method), off_knots(5)
    value, gradient, hessian = field.jet(points, 2)

    def single(p):
        return field(p[None])[0]

    laws.assert_close(torch.func.vmap(torch.func.grad(single))(points), gradient, 1e-12)
    laws.assert_close(torch.func.vmap(torch.func.hessian(single))(points), hessian, 1e-12, 10)
    jacobian = torch.func.jacrev(lambda f: reconstruct(f, method)(points))(volume())
    laws.assert_close((jacobian * volume()).sum((-1, -2, -3)), value, 1e-12)  # linear in the samples


# ---- the pair of operations


@pytest.mark.parametrize("name", [n for n in KERNELS if n != "bspline0"])
@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_splat_is_the_transpose_of_jet(name, order):
    rng, kernel = np.random.default_rng(3), KERNELS[name]
    rows = len(ops.multi_indices(order))
    c = torch.as_tensor(rng.uniform(-1, 1, (2, 3, 7, 8, 9)))
    points = torch.as_tensor(rng.uniform(1, 6, (2, 20, 3)))
    g = torch.as_tensor(rng.uniform(-1, 1, (2, 3, rows, 20)))
    out, back = ops.jet(c, points, kernel, order), ops.splat(g, points, kernel, order, (7, 8, 9))
    left, right = float((out * g).sum()), float((c * back).sum())
    assert abs(left - right) <= 1e-12 * float(out.norm() * g.norm())
    leaf = c.clone().requires_grad_()
    (automatic,) = torch.autograd.grad(ops.jet(leaf, points, kernel, order), leaf, g)
    laws.assert_close(automatic, back, 1e-12, 10)


def test_gradcheck_of_splat():
    points = torch.as_tensor(np.random.default_rng(5).choice([0.7, 0.8, 1.2, 1.3], (1, 1, 3))).requires_grad_()
    cotangents = volume(1, 2, 4, 1).requires_grad_()

    def function(g, p):
        return ops.splat(g, p, KERNELS["bspline2"], 1, (3, 4, 3))

    assert torch.autograd.gradcheck(function, (cotangents, points), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(function, (cotangents, points), fast_mode=True)


def test_a_different_kernel_along_each_axis():
    kernels = [KERNELS[n] for n in ("linear", "bspline3", "catmull-rom")]
    c, points = volume(1, 1, 6, 6, 6), 2 + torch.rand(1, 9, 3, dtype=torch.float64)
    k = torch.arange(6.0, dtype=torch.float64)
    wx, wy, wz = (kernel(points[0, :, d, None] - k) for d, kernel in enumerate(kernels))
    expected = torch.einsum("px,py,pz,zyx->p", wx, wy, wz, c[0, 0])
    laws.assert_close(ops.jet(c, points, kernels, 0)[0, 0, 0], expected, 1e-13)


def test_operations_refuse_what_they_cannot_do():
    c, p, kernel = torch.zeros(1, 1, 4, 4, 4), torch.zeros(1, 5, 3), KERNELS["bspline3"]
    for call, match in (
        (lambda: ops.jet(c[0], p, kernel), "N, C, D, H, W"),
        (lambda: ops.jet(c, p[0], kernel), "N, M, 3"),
        (lambda: ops.jet(c, p.long(), kernel), "floating"),
        (lambda: ops.jet(c, p.expand(2, -1, -1), kernel), "batch"),
        (lambda: ops.jet(c, p, kernel, -1), "order"),
        (lambda: ops.jet(c[..., :3], p, kernel), "axis x"),
        (lambda: ops.splat(torch.zeros(1, 1, 3, 5), p, kernel, 1, (4, 4, 4)), "cotangents"),
    ):
        with pytest.raises(ValueError, match=match):
            call()


# ---- what gradients flow to


def squared_values(method: str, samples: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """The derivative of Σ value² by the samples."""
    leaf = samples.clone().requires_grad_()
    return torch.autograd.grad(reconstruct(leaf, method)(points).square().sum(), leaf)[0]


@pytest.mark.parametrize(
    ("method", "storage"),
    covering(
        product(METHODS, (torch.float32, torch.float64, torch.float16, torch.bfloat16)),
        lambda m, s: (m, (kind_of(m), s)),
    ),
)
def test_gradients_reach_a_volume_of_any_floating_type(method, storage):
    """Those of numbers a few roundings off (8; the worst of 8 seeds took 4.5), rounded once more as they are kept."""
    points, stored = off_knots(30), volume().to(storage)
    points = points if storage == torch.float64 else points.float()
    found = squared_values(method, stored, points)
    assert found.dtype == storage
    exact = [stored.double(), points.double()]
    draws = 3 if storage == torch.float32 else 0  # beside what halves are rounded by nothing counts
    ((expected, moved),) = laws.moved_by_rounding(lambda *given: [squared_values(method, *given)], exact, draws=draws)
    scale = float(expected.abs().max())
    assert moved < 1e-5 * scale
    laws.assert_close(
        found.double(), expected, 8 * moved if storage == torch.float32 else torch.finfo(storage).eps * scale
    )


@every_method
def test_inputs_are_not_modified(method):
    samples, points = volume().requires_grad_(), off_knots(10).requires_grad_()
    kept = samples.detach().clone(), points.detach().clone()
    value, gradient = reconstruct(samples, method).value_and_gradient(points)
    (value.sum() + gradient.square().sum()).backward()
    assert torch.equal(samples, kept[0])
    assert torch.equal(points, kept[1])


# ---- geometry


@every_method
@pytest.mark.parametrize("stretched", [True, False], ids=["spacing", "rotated"])
def test_gradients_and_hessians_are_per_world_unit(method, stretched):
    """World derivatives are the voxel ones turned by the inverse transpose, and the differences of the field itself."""
    geometry = {"spacing": (0.5, 2.0, 3.0), "origin": (5.0, -7.0, 1.0)} if stretched else {"affine": rotated()}
    unit = reconstruct(volume(), method, gradient="analytic")
    field = reconstruct(Volume(volume(), **geometry), method, gradient="analytic")
    affine = Volume(volume(), **geometry).affine
    voxels = off_knots(20)
    world = torch.as_tensor(voxels.numpy() @ affine[:3, :3].T + affine[:3, 3])
    inverse = np.linalg.inv(affine[:3, :3])
    value, gradient, hessian = unit.jet(voxels, 2)
    actual = field.jet(world, 2)
    laws.assert_close(actual[0], value, 1e-12)
    laws.assert_close(actual[1], gradient.numpy() @ inverse, 1e-11, 10)
    laws.assert_close(actual[2], inverse.T @ hessian.numpy() @ inverse, 1e-11, 10)
    laws.assert_close(actual[1], laws.finite_difference(field, world, 2e-4), 1e-6)
    if "central" in METHODS[method].facts.gradients:
        kind = {"gradient": "central"}
        central = reconstruct(volume(), method, **kind).value_and_gradient(voxels)[1].numpy() @ inverse
        turned = reconstruct(Volume(volume(), **geometry), method, **kind).value_and_gradient(world)[1]
        laws.assert_close(turned, central, 1e-11, 10)


@pytest.mark.parametrize("method", ["catmull-rom", "triquadratic", "notch", "tricubic"])
@pytest.mark.parametrize("tilted", [False, True], ids=["stretched", "rotated"])
def test_a_sphere_on_anisotropic_voxels_has_the_analytic_gradient(method, tilted):
    """Direction and length: a factor 1/spacing forgotten along one axis turns the gradient by tens of degrees."""
    signal = signals.sphere(radius=0.5, edge=0.4)
    size, spacing = np.array([40, 20, 28]), np.array([2.4 / 40, 2.4 / 20, 2.4 / 28])
    turn = rotated((1, 1, 1))[:3, :3] if tilted else np.eye(3)
    affine = np.eye(4)
    affine[:3, :3] = turn @ np.diag(spacing)
    affine[:3, 3] = -affine[:3, :3] @ ((size - 1) / 2)
    grid = Volume(torch.zeros(*size[::-1].tolist(), dtype=torch.float64), affine=affine)
    z, y, x = np.indices(grid.shape)
    samples = signal(grid.voxel_to_world(torch.as_tensor(np.stack([x, y, z], -1).astype(float))))
    directions = torch.randn(300, 3, dtype=torch.float64)
    points = (
        directions
        / directions.norm(dim=-1, keepdim=True)
        * torch.empty(300, 1, dtype=torch.float64).uniform_(0.35, 0.65)
    )
    value, gradient = reconstruct(Volume(samples, affine=affine), method).value_and_gradient(points)
    exact_value, exact = signal.value_and_gradient(points)
    laws.assert_close(value, exact_value, 3e-3)
    laws.assert_close(gradient, exact, 0.03, float(exact.norm(dim=-1).max()))
    angle = torch.rad2deg(torch.acos(torch.nn.functional.cosine_similarity(gradient, exact, dim=-1).clamp(max=1)))
    assert float(angle.max()) < 2.0
    if method == "tricubic":
        hessian, exact_hessian = (
            f.jet(points, 2)[2] for f in (reconstruct(Volume(samples, affine=affine), method), signal)
        )
        laws.assert_close(hessian, exact_hessian, 0.08, float(exact_hessian.abs().max()))


def test_a_field_of_one_period_repeats_with_its_gradient():
    """Autograd through folded points: the sign of a reflected axis reaches reverse mode too."""
    for boundary, period in (("mirror", 2 * 4), ("reflect", 2 * 5), ("wrap", 5)):
        field = reconstruct(volume(3, 4, 5), "triquadratic", boundary=boundary)
        near = torch.tensor([[1.3, 0.7, 1.2]], dtype=torch.float64, requires_grad=True)
        far = (near.detach() + torch.tensor([3.0 * period, 0, 0])).requires_grad_()
        slopes = [torch.autograd.grad(field(p).sum(), p)[0] for p in (near, far)]
        laws.assert_close(slopes[0], slopes[1], 1e-12)
        if boundary != "wrap":
            axis = 0.0 if boundary == "mirror" else -0.5
            mirrored = near.detach() * torch.tensor([-1.0, 1, 1]) + torch.tensor([2 * axis, 0, 0])
            mirrored.requires_grad_()
            (slope,) = torch.autograd.grad(field(mirrored).sum(), mirrored)
            laws.assert_close(slope * torch.tensor([-1.0, 1, 1]), slopes[0], 1e-12)


@pytest.mark.parametrize("boundary", list(Boundary))
@pytest.mark.parametrize("method", ["trilinear", "triquadratic", "tricubic"])
def test_derivatives_on_the_planes_of_reflection(method, boundary):
    """Integers and half-integers far outside, where a fold made of |·| and min would have derivative 0."""
    field = reconstruct(volume(8, 8, 8), method, boundary=boundary)
    planes = [[14.0, 2.3, 2.3], [-8.5, 3.1, 22.2], [-7.0, 2.2, 0.3], [7.0, -3.2, 7.5], [21.0, -14.0, -0.5]]
    points = torch.tensor(planes, dtype=torch.float64, requires_grad=True)
    value, gradient, hessian = field.jet(points, 2)
    (first,) = torch.autograd.grad(value.sum(), points, retain_graph=True)
    laws.assert_close(first, gradient, 1e-12)
    second = [torch.autograd.grad(gradient[:, i].sum(), points, retain_graph=True)[0] for i in range(3)]
    laws.assert_close(torch.stack(second, 1), hessian, 1e-12)
