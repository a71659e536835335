"""Volumes of one voxel along an axis: one coefficient there, or as many as are read; the field of the same samples
repeated along it."""

from __future__ import annotations

from itertools import product

import pytest
import torch

import filterlab as fl
from filterlab.fields.grid import GridField
from filterlab.kernels import CENTRAL_DIFFERENCE, KERNELS, Kernel, bc, bspline
from filterlab.methods import METHODS, TensorProduct, from_kernel
from filterlab.prefilters import IDENTITY
from filterlab.render import PerspectiveCamera, TransferFunction, render
from filterlab.render.shading import Light, Shading

SHAPES = ((1, 6, 7), (6, 1, 7), (6, 7, 1), (1, 1, 7))
SEPARABLE = [name for name, method in METHODS.items() if isinstance(method, TensorProduct)]
KEPT = ("mirror", "reflect", "wrap", "border")


def built(samples, method, boundary: str, **options) -> GridField:
    field = fl.reconstruct(samples, method, boundary=boundary, **options)
    assert isinstance(field, GridField)
    return field


def repeated(samples: torch.Tensor) -> torch.Tensor:
    """Five voxels along every axis of one: constant there, as the other is said to be."""
    return samples.repeat(*(5 if n == 1 else 1 for n in samples.shape))


@pytest.mark.parametrize(
    ("method", "scheme"),
    [
        *((m, "direct") for m in SEPARABLE),
        *((m, "fused") for m in ("nearest", "ncrsi", "triquadratic", "tricubic", "qss", "quadratic-c1")),
        *((m, "sampled") for m in ("ncrsi", "triquadratic", "tricubic")),
    ],
)
def test_the_field_is_that_of_samples_repeated_along_the_axis(method, scheme):
    gradient = METHODS[method].gradient_of(scheme)
    whole = scheme == "direct" and method in ("trilinear", "ncrsi", "tricubic")
    every = product(SHAPES, KEPT) if whole else zip(SHAPES, KEPT, strict=True)
    for number, (shape, boundary) in enumerate(every):
        draw = torch.Generator().manual_seed(number)
        samples = torch.randn(shape, generator=draw, dtype=torch.float64).requires_grad_()
        points = ((torch.rand(40, 3, generator=draw, dtype=torch.float64) - 0.3) * 12).requires_grad_()
        one, five = (built(x, method, boundary, scheme=scheme, gradient=gradient) for x in (samples, repeated(samples)))
        order = min(one.max_order, 2)
        shifted = points + torch.tensor([2.0 * (n == 1) for n in reversed(shape)])  # the middle of the five
        cotangents = None
        results = []
        for field, at in ((one, points), (five, shifted)):
            rows = field.jet(at, order)
            if cotangents is None:
                cotangents = [torch.randn(row.shape, generator=draw, dtype=row.dtype) for row in rows]
            loss = torch.stack([(row * c).sum() for row, c in zip(rows, cotangents, strict=True)]).sum()
            results.append((*rows, *torch.autograd.grad(loss, (samples, points))))
        for found, expected in zip(*results, strict=True):
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("boundary", KEPT)
def test_one_coefficient_along_an_axis_of_one_voxel(boundary):
    for method, reach, beyond in (("triquadratic", 2, 17), ("tricubic", 3, 23)):  # with float32's decay
        pad = 2 * (beyond if boundary == "border" else reach)
        values = built(torch.rand(1, 512, 512), method, boundary).coefficients.values
        assert values.shape == (1, 512 + pad, 512 + pad)
        spare = values.untyped_storage().nbytes() - 4 * (512 + pad) ** 2  # 1.14 or 1.19 volumes; they were 40 and 56
        assert 0 <= spare < 64
    assert built(torch.rand(40, 1, 1), "notch", boundary).coefficients.values.shape[-2:] == (1, 1)


@pytest.mark.parametrize(
    ("method", "scheme", "kept"),
    [
        ("qss", "fused", {"mirror": 5, "border": 5}),  # of border they were 35, 43, 35 and 47
        ("quadratic-c1", "fused", {"mirror": 9, "border": 10}),  # octahedra repeat after two
        ("triquadratic", "sampled", {"mirror": 1, "border": 1}),
        ("tricubic", "sampled", {"mirror": 1, "border": 1}),
    ],
)
def test_schemes_that_read_more_keep_as_many_and_no_tail(method, scheme, kept):
    samples = torch.rand(1, 20, 30)
    shapes = {b: built(samples, method, b, scheme=scheme).coefficients.values.shape for b in kept}
    assert {b: shape[0] for b, shape in shapes.items()} == kept
    assert shapes["border"][1] > 50


def test_samplers_of_somebody_else_have_two_coefficients_along_every_axis():
    def nearest(coefficients, points):
        d, h, w = coefficients.values.shape[-3:]
        assert min(d, h, w) > 1
        x, y, z = (points - coefficients.start).round().long().unbind(-1)
        return coefficients.values[..., z[0], y[0], x[0]]

    samples = torch.rand(1, 5, 6, generator=torch.Generator().manual_seed(1))
    field = built(samples, "trilinear", "border", scheme="sampled", gradient="central", sampler=nearest)
    assert float(field(torch.tensor([4.2, 3.1, 0.4]))) == float(samples[0, 3, 4])


def test_zeros_go_on_beyond_one_voxel_too():
    values = built(torch.rand(1, 8, 8), "triquadratic", "zeros").coefficients.values
    assert values.shape[0] == values.shape[1] - 7


def test_kernels_whose_translates_do_not_sum_to_a_constant_keep_their_taps():
    double_width = Kernel("sawtooth", bspline(1).pieces[:1] * 2)
    assert double_width.sum_over_translates is None
    field = built(torch.rand(1, 5, 5), from_kernel(double_width, IDENTITY), "border")
    assert field.coefficients.values.shape[0] > 1


@pytest.mark.parametrize("kernel", [*KERNELS.values(), bc(0.4, 0.2)], ids=lambda k: k.name)
def test_sum_over_translates(kernel):
    x = torch.linspace(0, 1, 17, dtype=torch.float64)
    total = torch.stack([kernel(x - k) for k in range(-4, 5)]).sum(0)
    assert kernel.sum_over_translates == 1
    torch.testing.assert_close(total[:-1], torch.ones(16, dtype=torch.float64), rtol=0, atol=1e-14)
    assert CENTRAL_DIFFERENCE.sum_over_translates == 0


@pytest.mark.parametrize("boundary", ["mirror", "border"])
@pytest.mark.parametrize("storage", ["float16", "uint8"])
def test_short_storage_of_one_plane(storage, boundary):
    samples = torch.rand(1, 9, 8, generator=torch.Generator().manual_seed(5))
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(6)) * 8
    short, exact = (built(samples, "triquadratic", boundary, storage=s) for s in (storage, None))
    assert short.coefficients.values.shape == exact.coefficients.values.shape
    torch.testing.assert_close(short(points), exact(points), rtol=0, atol=6e-3)


@pytest.mark.parametrize("boundary", ["mirror", "border"])
@pytest.mark.parametrize("method", ["trilinear", "triquadratic", "notch", "tricubic", "quadratic-c1"])
def test_surfaces_of_one_plane(method, boundary):
    samples = torch.rand(1, 12, 12, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    one, five = built(samples, method, boundary), built(repeated(samples), method, boundary)
    origins = torch.tensor([[x, y, -0.3] for x, y in product((-0.4, 2.1, 5.2, 8.7), (1.3, 6.6, 9.9))]).double()
    directions = torch.tensor([1.0, 0.4, 0.05]).double().expand_as(origins)
    t = one.first_crossing(origins, directions, 0.5)
    hit = t.isfinite()
    assert hit.any()
    assert not hit.all()
    at, middle = (origins + directions * t[:, None])[hit], torch.tensor([0.0, 0.0, 2.0]).double()
    torch.testing.assert_close(five(at + middle), torch.full_like(t[hit], 0.5), rtol=0, atol=1e-9)
    plain = built(samples, method, boundary, scheme="direct").first_crossing(origins, directions, 0.5)
    torch.testing.assert_close(plain, t, rtol=0, atol=1e-9)
    assert one.lattice.continuous
    assert one.lattice.cells[2] == 1


@pytest.mark.parametrize(
    ("method", "boundary"),
    [
        ("trilinear", "border"),
        ("triquadratic", "mirror"),
        ("tricubic", "border"),
        ("ncrsi", "mirror"),
        ("quadratic-c1", "border"),
    ],
)
def test_images_of_one_plane(method, boundary):
    samples = torch.rand(1, 16, 16, generator=torch.Generator().manual_seed(4))
    transfer = TransferFunction([0.2, 0.5, 0.9], [[0, 0, 1.0], [0, 1, 0], [1, 0, 0]], [0.0, 0.4, 0.9])
    camera = PerspectiveCamera(position=(7.5, 9.0, -30.0), target=(7.5, 7.5, 0.0))
    shading = Shading(lights=[Light()])
    fused, plain = (
        render(built(samples, method, boundary, scheme=s), camera, transfer, size=(24, 20), step=0.05, shading=shading)
        for s in ("fused", "direct")
    )
    assert float(fused.max()) > 0.05
    torch.testing.assert_close(fused, plain, rtol=0, atol=2e-5)
