"""Schemes: sums of trilinear samples equal the direct sum, take as many samples as the paper says, round as told."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from filterlab.fields import tensor_product
from filterlab.fields.base import Field
from filterlab.fields.tensor_product import SAMPLERS, exact_sample
from filterlab.kernels import bc
from filterlab.methods import METHODS, reconstruct
from filterlab.ops import Evaluation
from filterlab.ops.cpu import compiler
from filterlab.ops.differentiable.gather import IMPLEMENTATIONS
from filterlab.scenes.model import Reconstruction
from filterlab.volume import Boundary, Volume
from tests import laws, oracles
from tests.test_methods import TENSOR_PRODUCTS

SAMPLED = [name for name, method in METHODS.items() if "sampled" in method.facts.schemes]
SHAPE = (5, 7, 6)
every_sampled = pytest.mark.parametrize("method", SAMPLED)
every_boundary = pytest.mark.parametrize("boundary", Boundary)


def sampled(samples: torch.Tensor, method: str, **options) -> Field:
    """The method by trilinear samples, with the kind of gradient they give it."""
    return reconstruct(samples, method, scheme="sampled", gradient=METHODS[method].sampled_gradient, **options)


def volume() -> torch.Tensor:
    return torch.as_tensor(np.random.default_rng(0).uniform(-1, 1, SHAPE))


def points(count: int = 60, beyond: float = 1.5) -> torch.Tensor:
    n = np.array(SHAPE[::-1])
    return torch.as_tensor(np.random.default_rng(1).uniform(-beyond, 1 + beyond, (count, 3)) * n)


def ties() -> torch.Tensor:
    """Every combination of integers, half-integers and quarters of one cell, and of its ends."""
    t = torch.tensor([1.0, 1.25, 1.5, 1.75, 2.0, 2.5], dtype=torch.float64)
    return torch.cartesian_prod(t, t, t)


def pair(method: str, boundary: str = "mirror", prefilter: bool = True):
    gradient = METHODS[method].sampled_gradient
    return [
        reconstruct(volume(), method, boundary=boundary, prefilter=prefilter, gradient=gradient, scheme=scheme)
        for scheme in ("direct", "sampled")
    ]


@every_sampled
@every_boundary
@pytest.mark.parametrize("prefilter", [True, False])
def test_sampled_agrees_with_direct_to_rounding_ties_included(method, boundary, prefilter):
    direct, sampled = pair(method, str(boundary), prefilter)
    for at in (points(), ties()):
        for a, b in zip(sampled.value_and_gradient(at), direct.value_and_gradient(at), strict=True):
            laws.assert_close(a, b, 1e-12)


@pytest.mark.parametrize(
    ("method", "value", "value_and_gradient"),
    [("triquadratic", 8, 8), ("notch", 8, 8), ("tricubic", 8, 32), ("ncrsi", 7, 7), ("trilinear", 1, 7)],
)
def test_the_number_of_samples_is_the_paper_s(method, value, value_and_gradient):
    counted = []

    def counting(coefficients, at):
        counted.append(at.shape[1])
        return exact_sample(coefficients, at)

    field = sampled(volume(), method, sampler=counting)
    for order, expected in ((0, value), (1, value_and_gradient)):
        counted.clear()
        field.jet(points(), order)
        assert sum(counted) == expected * 60


@every_sampled
def test_few_samples_are_taken_in_one_call_and_have_the_bits_of_many(method, monkeypatch):
    calls = []

    def counting(coefficients, at):
        calls.append(at.shape[1])
        return exact_sample(coefficients, at)

    field, at, jets = sampled(volume(), method, sampler=counting), points().float(), []
    for few, each in ((0, 1), (tensor_product._FEW, 7 if METHODS[method].sampled_gradient == "central" else 8)):
        calls.clear()
        monkeypatch.setattr(tensor_product, "_FEW", few)
        jets.append(field.jet(at, 1))
        assert set(calls) == {each * len(at)}
    for one_by_one, together in zip(*jets, strict=True):
        assert torch.equal(one_by_one, together)


@every_sampled
@every_boundary
@pytest.mark.parametrize("prefilter", [True, False])
def test_a_texture_unit_rounds_fractions_to_1_256(method, boundary, prefilter):
    """Sample by sample as the oracle does it."""
    field = sampled(volume(), method, boundary=boundary, prefilter=prefilter, sampler="texture_unit")
    at = points(beyond=0.8)
    expected = oracles.trilinear_scheme(method, volume().numpy(), at.numpy(), str(boundary), prefilter, steps=256)
    for actual, exact in zip(field.value_and_gradient(at), expected, strict=True):
        laws.assert_close(actual, exact, 1e-12)


@every_sampled
def test_what_a_texture_unit_costs_is_bounded_and_not_nothing(method):
    """A rounded fraction moves a sample by at most 1/512 of a step along each axis; a slope by four times that."""
    exact = sampled(volume(), method)
    rounded = sampled(volume(), method, sampler="texture_unit")
    deconvolve = oracles.RECIPES[method].deconvolve if method in oracles.RECIPES else ()
    c = oracles.coefficients(volume().numpy(), deconvolve, "mirror", np.arange(-8, 16))
    sample_error = 3 / 512 * np.ptp(c)
    (v, g), (w, h) = (field.value_and_gradient(points(400)) for field in (exact, rounded))
    bound = {"ncrsi": 2.5}.get(method, 1) * sample_error  # the weights of ncrsi add up to 2.5 in absolute value at most
    assert 1e-4 < float((v - w).abs().max()) <= bound
    assert 1e-4 < float((g - h).abs().max()) <= 4 * sample_error


def test_texture_unit_is_exact_at_multiples_of_1_256():
    exact, rounded = (
        reconstruct(volume(), "trilinear", scheme="sampled", gradient="central", sampler=sampler)
        for sampler in ("exact", "texture_unit")
    )
    at = torch.randint(0, 256 * 4, (50, 3)).double() / 256
    laws.assert_close(rounded(at), exact(at), 1e-14)
    laws.assert_close(rounded(at + 0.3 / 256), exact(at), 1e-14)
    laws.assert_close(rounded(at - 0.3 / 256), exact(at), 1e-14)


def test_the_rounding_is_invisible_to_derivatives():
    """Straight-through: autograd through the texture unit gives the slope of the sample it took, not zero."""
    at = points(beyond=0).requires_grad_()
    fields = [
        reconstruct(volume(), "triquadratic", scheme="sampled", sampler=sampler)
        for sampler in ("exact", "texture_unit")
    ]
    slopes = [torch.autograd.grad(field(at).sum(), at)[0] for field in fields]
    assert float((slopes[0] - slopes[1]).abs().max()) < 0.2
    assert float(slopes[1].abs().mean()) > 0.1


def test_a_callable_is_a_sampler():
    def nearest(coefficients, at):
        return exact_sample(coefficients, at.round())

    f = volume()
    field = reconstruct(f, "trilinear", scheme="sampled", gradient="central", sampler=nearest)
    laws.assert_close(field(torch.tensor([[1.2, 3.4, 2.6]], dtype=torch.float64)), f[3, 3, 1][None], 1e-15)
    assert set(SAMPLERS) >= {"exact", "texture_unit"}


@every_sampled
def test_a_field_tells_how_it_is_evaluated(method):
    direct, sampled = pair(method)
    assert direct.scheme.name == "direct"
    assert sampled.scheme.name == "sampled"
    assert sampled.scheme.gradient == METHODS[method].sampled_gradient
    assert sampled.max_order == 1
    assert reconstruct(volume(), method).scheme.name == "fused"


@pytest.mark.parametrize("method", ["trilinear", "ncrsi", "triquadratic", "notch", "tricubic"])
def test_float32_keeps_its_digits_on_a_long_axis(method):
    """Positions x ± δ rounded to float32 would cost 2e-6 (trilinear) to 1e-4 (triquadratic) of the range here."""
    samples, points = torch.rand(3, 3, 512), torch.rand(2000, 3) * torch.tensor([511.0, 2.0, 2.0])
    gradient = "central" if method == "trilinear" else None
    expected = reconstruct(samples.double(), method, gradient=gradient).jet(points.double(), 1)
    for scheme in ("direct", "sampled"):
        for got, want in zip(
            reconstruct(samples, method, gradient=gradient, scheme=scheme).jet(points, 1), expected, strict=True
        ):
            assert (got - want).abs().max() < 2e-6


def test_a_scheme_does_not_change_the_kind_of_gradient_silently():
    with pytest.raises(ValueError, match="ask for gradient='central'"):
        reconstruct(volume(), "trilinear", scheme="sampled")


def test_a_field_says_what_it_is():
    field = reconstruct(volume(), "notch", scheme="sampled", boundary="wrap")
    for word in ("notch", "sampled", "analytic", "wrap", "float64"):
        assert word in repr(field)


def test_a_fused_scheme_that_cannot_run_says_what_is_missing():
    kernel = bc(torch.tensor(0.3), torch.tensor(0.3))
    with pytest.raises(ValueError, match=r"can't run here: .*TensorKernel.*; scheme='direct' can"):
        reconstruct(volume(), kernel, prefilter=False, scheme="fused")


def test_the_default_is_fused_where_it_can_run(monkeypatch):
    kernel = bc(torch.tensor(0.3), torch.tensor(0.3))
    assert reconstruct(volume(), kernel, prefilter=False).scheme.name == "direct"
    assert reconstruct(volume(), "notch").scheme.name == "fused"
    monkeypatch.setitem(IMPLEMENTATIONS, "cpu", replace(IMPLEMENTATIONS["cpu"], missing=lambda *_: "no such thing"))
    assert reconstruct(volume(), "notch").scheme.name == "direct"
    with pytest.raises(ValueError, match="no such thing"):
        reconstruct(volume(), "notch", scheme="fused")


@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_fused_differentiates_like_direct(method):
    for boundary in ("mirror", "zeros"):
        results = []
        for scheme in ("direct", "fused"):
            samples, at = volume().requires_grad_(), points(beyond=0.8).requires_grad_()
            value, gradient = reconstruct(samples, method, boundary=boundary, scheme=scheme).jet(at, 1)
            loss = value.square().sum() + gradient.square().sum()
            results.append(torch.autograd.grad(loss, (samples, at)))
        for got, want in zip(*results, strict=True):
            laws.assert_close(got, want, 1e-12)


@pytest.mark.parametrize("turned", [False, True])
def test_coefficients_that_are_changed_in_place_are_seen(turned):
    """However they lie in memory: what is kept from call to call is never a copy of them."""
    field, at = reconstruct(volume(), "triquadratic", scheme="fused"), points()
    values = field.coefficients.values.clone()
    values = values.transpose(0, 2).contiguous().transpose(0, 2) if turned else values
    other = field.with_coefficients(replace(field.coefficients, values=values))
    before = other(at)
    values.mul_(2)
    assert torch.equal(other(at), 2 * before)


@pytest.mark.parametrize(("count", "threads", "beyond"), [(1, 1, 0.0), (1, 1, 0.8), (20_000, 2, 0.0)])
def test_six_frames_at_most_from_a_field_to_its_programs(count, threads, beyond, monkeypatch):
    """`value_and_gradient` and what it calls, one within the other, until machine code runs."""
    depths, compiled, before = [], compiler.compiled, torch.get_num_threads()

    def watched(variant):
        program = compiled(variant)

        def run(*told):
            depths.append(frames_since("value_and_gradient"))
            program(*told)

        return compiler._signature(run)  # it has an address, as programs have

    monkeypatch.setattr(compiler, "compiled", watched)
    field, at = reconstruct(volume(), "triquadratic", scheme="fused"), points(beyond=beyond)[0].expand(count, 3)
    torch.set_num_threads(threads)
    try:
        field.value_and_gradient(at)
    finally:
        torch.set_num_threads(before)
    assert 0 < max(depths) <= 6


def frames_since(name: str) -> int:
    """Frames of this thread but those of this file, out to the function of that name; 0 where there is none."""
    names, frame = [], sys._getframe()
    while frame is not None:
        if frame.f_code.co_filename != __file__:  # one program calls another
            names.append(frame.f_code.co_name)
        frame = frame.f_back
    return names.index(name) + 1 if name in names else 0


TURNED = torch.tensor([[1.0, 0.2, 0.1, 3.0], [0.3, 1.2, -0.2, -2.0], [-0.1, 0.4, 0.9, 5.0], [0, 0, 0, 1]])


@pytest.mark.parametrize("method", ["triquadratic", "qss"])
@pytest.mark.parametrize("batch", [(), (2, 3)])
@pytest.mark.parametrize("affine", [None, torch.diag(torch.tensor([0.7, -1.1, 2.0, 1])), TURNED], ids=range(3))
def test_jets_in_one_pass_are_those_of_rows(method, batch, affine):
    samples = torch.as_tensor(np.random.default_rng(0).uniform(-1, 1, (*batch, *SHAPE)), dtype=torch.float32)
    within, beyond = 0.9 * points(700, 0.0).float(), points(333).float()  # some of many blocks are turned
    for boundary in ("mirror", "wrap", "border"):
        field = reconstruct(Volume(samples, affine=affine), method, boundary=boundary)
        for voxels in (within[:1], within, torch.cat([within, beyond])):
            x = field.domain.geometry.to_world(voxels)
            x = x.expand(*batch[:1], *x.shape)
            rows = field.jet(x.clone().requires_grad_(), 1)
            for own, other in zip(field.jet(x, 1), rows, strict=True):
                assert torch.equal(own, other.detach())


def test_a_jet_asks_for_rows_only_where_it_must(monkeypatch):
    field = reconstruct(volume().float(), "triquadratic")
    x = points(50).float()
    monkeypatch.setattr(Evaluation, "__call__", lambda *_: pytest.fail("rows were asked for"))
    field.jet(x, 1)
    with pytest.raises(pytest.fail.Exception, match="rows"):
        field.jet(x.requires_grad_(), 1)


def test_a_former_name_of_the_sampled_scheme_is_understood() -> None:
    """Also in files: scenes and experiments that were written before it was called so."""
    volume = torch.rand(4, 5, 6)
    assert reconstruct(volume, "triquadratic", scheme="eight_trilinear").scheme.name == "sampled"
    assert Reconstruction.model_validate({"name": "notch", "scheme": "eight_trilinear"}).scheme == "sampled"
