"""Laws of prefilters, swept over PREFILTERS, boundaries and lengths, against the oracle's infinite deconvolution."""

from __future__ import annotations

from fractions import Fraction
from itertools import cycle

import numpy as np
import pytest
import torch
from scipy import ndimage

from filterlab.kernels import KERNELS, Kernel, bspline
from filterlab.ops.differentiable.prefilter import prefilter_axis, prefilter_samples
from filterlab.prefilters import PREFILTERS, interpolation
from filterlab.volume import Boundary
from tests import laws, oracles

DECONVOLVES = {
    "identity": (),
    "quadratic": ("bspline2",),
    "cubic": ("bspline3",),
    "quartic": ("bspline4",),
    "quintic": ("bspline5",),
    "notch": ("bspline2", "bspline2"),
}
every_prefilter = pytest.mark.parametrize("name", PREFILTERS)
every_boundary = pytest.mark.parametrize("boundary", Boundary)


def values(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.as_tensor(np.random.default_rng(seed).uniform(-1, 1, shape))


def gain(name: str) -> float:
    """The most a prefilter amplifies: 1 / min q̂ = 1 / q̂(π), the scale that rounding is measured on."""
    return float(np.prod([1 / oracles.sampled_response(k, np.array(np.pi)) for k in DECONVOLVES[name]]))


@every_prefilter
@every_boundary
@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6, 7, 32])
def test_coefficients_are_the_infinite_deconvolution_tails_included(name, boundary, n):
    f, tail = values(n), 9
    expected = oracles.coefficient_matrix(DECONVOLVES[name], boundary, n, np.arange(-tail, n + tail)) @ f.numpy()
    prefilter = PREFILTERS[name]
    laws.assert_close(prefilter_axis(f, 0, prefilter, boundary, tail=tail), expected, 1e-13, gain(name))
    laws.assert_close(prefilter_axis(f, 0, prefilter, boundary), expected[tail:-tail], 1e-13, gain(name))
    single = prefilter_axis(f.float(), 0, prefilter, boundary, tail=tail)
    assert single.dtype == torch.float32
    laws.assert_close(single, expected, 1e-6, gain(name))


@every_prefilter
@every_boundary
@pytest.mark.parametrize("n", [1, 2, 5, 32])
def test_sampling_what_was_prefiltered_returns_the_samples(name, boundary, n):
    """q ∗ (q⁻¹ ∗ f) = f at every sample, the first and last included."""
    f, tail = values(n), 8
    c = prefilter_axis(f, 0, PREFILTERS[name], boundary, tail=tail).numpy()
    for kernel in DECONVOLVES[name]:
        c = np.convolve(c, oracles.kernel(kernel, np.arange(-3, 4)), mode="same")
    laws.assert_close(c[tail:-tail], f, 1e-13, gain(name))


@every_prefilter
@pytest.mark.parametrize("boundary", ["mirror", "reflect", "wrap"])
@pytest.mark.parametrize("n", [1, 2, 3, 8])
def test_prefiltering_what_was_sampled_returns_the_coefficients(name, boundary, n):
    c = values(n)
    f = oracles.extension_matrix(boundary, n, np.arange(-6, n + 6)) @ c.numpy()
    for kernel in DECONVOLVES[name]:
        f = np.convolve(f, oracles.kernel(kernel, np.arange(-3, 4)), mode="same")
    laws.assert_close(prefilter_axis(torch.as_tensor(f[6:-6]), 0, PREFILTERS[name], boundary), c, 1e-12)


@every_prefilter
def test_poles_and_response(name):
    omega = np.linspace(0, 4 * np.pi, 101)
    expected = np.ones_like(omega)
    for kernel in DECONVOLVES[name]:
        expected = expected / oracles.sampled_response(kernel, omega)
    laws.assert_close(PREFILTERS[name].response(torch.as_tensor(omega)), expected, 1e-14, gain(name))


@pytest.mark.parametrize(
    ("name", "poles"),
    [
        ("identity", []),
        ("quadratic", [2 * 2**0.5 - 3]),
        ("cubic", [3**0.5 - 2]),
        ("quartic", [(664 - 438976**0.5) ** 0.5 + 304**0.5 - 19, (664 + 438976**0.5) ** 0.5 - 304**0.5 - 19]),
        ("quintic", [(67.5 - 4436.25**0.5) ** 0.5 + 26.25**0.5 - 6.5, (67.5 + 4436.25**0.5) ** 0.5 - 26.25**0.5 - 6.5]),
        ("notch", [2 * 2**0.5 - 3] * 2),
    ],
)
def test_poles_are_the_published_ones(name, poles):
    """Unser, Aldroubi & Eden 1993, table of poles."""
    assert sorted(PREFILTERS[name].poles) == pytest.approx(sorted(poles), abs=1e-13)


@pytest.mark.parametrize("degree", [2, 3, 4, 5])
@pytest.mark.parametrize(("boundary", "n"), [("mirror", 1), ("mirror", 6), ("wrap", 6), ("reflect", 40)])
def test_agrees_with_scipy(degree, boundary, n):
    """scipy's reflect is exact on long axes only (its start is off by |pole|^2n)."""
    mode = {"wrap": "grid-wrap"}.get(boundary, boundary)
    f = values(n)
    expected = ndimage.spline_filter1d(f.numpy(), degree, mode=mode) if n > 1 else f.numpy()
    laws.assert_close(prefilter_axis(f, 0, interpolation(bspline(degree)), boundary), expected, 1e-12)


@every_prefilter
@every_boundary
def test_linear_with_an_exact_adjoint(name, boundary):
    for shape in ((1, 2, 3), (4, 5, 3)):

        def forward(x):
            return prefilter_samples(x, PREFILTERS[name], boundary)

        laws.assert_adjoint(forward, values(*shape))
        laws.assert_linear(forward, values(*shape), values(*shape, seed=1))


@pytest.mark.parametrize(("name", "boundary"), list(zip(cycle(("notch", "cubic")), Boundary, strict=False)))
def test_gradcheck_twice_forward_and_reverse(name, boundary):
    x = values(2, 1, 3).requires_grad_()

    def squared(x):
        return prefilter_samples(x, PREFILTERS[name], boundary) ** 2

    assert torch.autograd.gradcheck(squared, (x,), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(squared, (x,), fast_mode=True)


@every_prefilter
@every_boundary
def test_batch_equals_loop_and_vmap(name, boundary):
    x, prefilter = values(3, 2, 4, 3, 5), PREFILTERS[name]
    whole = prefilter_samples(x, prefilter, boundary)
    assert whole.shape == x.shape
    loop = torch.stack([torch.stack([prefilter_samples(c, prefilter, boundary) for c in n]) for n in x])
    laws.assert_close(whole, loop, 1e-15)
    mapped = torch.func.vmap(lambda v: prefilter_samples(v, prefilter, boundary), in_dims=2, out_dims=2)(
        x.movedim(0, 2)
    )
    laws.assert_close(mapped.movedim(2, 0), loop, 1e-15)


@every_boundary
def test_separable_in_three_dimensions(boundary):
    x = values(3, 4, 5)
    expected = x.numpy()
    for axis, n in enumerate(x.shape):
        matrix = oracles.coefficient_matrix(("bspline3",), boundary, n, np.arange(n))
        expected = np.moveaxis(np.tensordot(matrix, expected, (1, axis)), 0, axis)
    laws.assert_close(prefilter_samples(x, PREFILTERS["cubic"], boundary), expected, 1e-12)


@every_prefilter
@pytest.mark.parametrize("boundary", ["mirror", "reflect", "wrap", "border"])
def test_a_constant_stays_what_it_was(name, boundary):
    for n in (1, 2, 9):
        filtered = prefilter_axis(torch.full((n,), 3.0, dtype=torch.float64), 0, PREFILTERS[name], boundary, tail=3)
        laws.assert_close(filtered, np.full(n + 6, 3.0), 1e-14, gain(name))


@pytest.mark.parametrize(
    "dtype", [torch.uint8, torch.int16, torch.float16, torch.bfloat16, torch.float32, torch.float64]
)
def test_storage_types_are_promoted_and_the_input_is_left_alone(dtype):
    x = (values(4, 5, 3) * 50 + 60).to(dtype)
    kept = x.clone()
    out = prefilter_samples(x, PREFILTERS["quadratic"])
    assert out.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    assert torch.equal(x, kept)
    laws.assert_close(out, prefilter_samples(x.double(), PREFILTERS["quadratic"]), 1e-6, 256)
    identity = prefilter_samples(x, PREFILTERS["identity"])
    assert torch.equal(identity, x.to(identity.dtype))


def test_strides_do_not_matter():
    x = values(6, 10, 4)[::2, ::3].transpose(0, 2)
    assert not x.is_contiguous()
    for name, prefilter in PREFILTERS.items():
        laws.assert_close(
            prefilter_samples(x, prefilter), prefilter_samples(x.contiguous(), prefilter), 0.0, gain(name)
        )


def test_interpolation_of_a_kernel():
    assert interpolation(KERNELS["catmull-rom"]).is_identity
    assert interpolation(bspline(3)).poles == PREFILTERS["cubic"].poles
    with pytest.raises(ValueError, match="no inverse"):
        _ = interpolation(KERNELS["notch"]).poles  # its samples (1/4, 1/2, 1/4) vanish at the Nyquist frequency


def test_callers_mistakes():
    with pytest.raises(ValueError, match="boundary"):
        prefilter_samples(values(2, 2, 2), PREFILTERS["cubic"], "mirrored")
    with pytest.raises(ValueError, match="shape"):
        prefilter_samples(values(2, 2), PREFILTERS["cubic"])


def test_interpolation_keeps_a_zero_between_the_samples_of_a_kernel():
    """A box kernel with samples −1/8, 0, 5/4, 0, −1/8: q̂(ω) = 5/4 − ¼ cos 2ω."""
    heights = (Fraction(-1, 8), Fraction(0), Fraction(5, 4), Fraction(0), Fraction(-1, 8))
    prefilter = interpolation(Kernel("boxes", tuple((h,) for h in heights)))
    omega = torch.linspace(0, 7, 50, dtype=torch.float64)
    laws.assert_close(prefilter.response(omega), 1 / (1.25 - 0.25 * torch.cos(2 * omega)), 1e-14)


def test_only_symmetric_kernels_that_sum_to_one_get_a_prefilter():
    twice = Kernel("twice", tuple(tuple(2 * c for c in p) for p in bspline(3).pieces))
    lopsided = Kernel("lopsided", tuple((Fraction(c, 8),) for c in (1, 5, 2)))
    for kernel in (twice, lopsided):
        with pytest.raises(ValueError, match="symmetric kernels whose integer samples sum to 1"):
            interpolation(kernel)


def test_prefilters_go_by_name():
    x = torch.rand(4, 4, 4)
    assert torch.equal(prefilter_samples(x, "cubic"), prefilter_samples(x, PREFILTERS["cubic"]))
    with pytest.raises(ValueError, match="known prefilters: identity, quadratic"):
        prefilter_samples(x, "cubik")
