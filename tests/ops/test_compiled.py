"""gather, scatter and place under torch.compile, and as operators of torch.library."""

from __future__ import annotations

import pytest
import torch
from torch.library import opcheck

import filterlab as fl
from filterlab import ops
from filterlab.fields.ncrsi import NCRSI_TERMS
from filterlab.fields.tensor_product import Direct
from filterlab.geometry import Geometry
from filterlab.kernels import bspline
from filterlab.ops import Placement, Stencil
from filterlab.ops.differentiable import operators as compiled
from filterlab.ops.differentiable.prefilter import prefilter_samples
from filterlab.ops.prefilter import VOLUME, Filtering
from filterlab.prefilters import QUADRATIC as QUADRATIC_PREFILTER
from filterlab.volume import Boundary
from tests.laws import assert_close

QUADRATIC = Stencil.jet(bspline(2), 1)
PLACE = Placement(Geometry.of(2.0), Boundary.MIRROR, (5, 6, 7), 0, (0.5, 17.0, 0.0))


def some(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, dtype=torch.float64).requires_grad_()


@pytest.mark.parametrize("implementation", ["reference", "cpu"])
def test_operators_keep_the_rules_of_torch_library(implementation: str) -> None:
    text, points = compiled.stencil_text(QUADRATIC), some(2, 9, 3)
    opcheck(compiled.gather, (some(2, 2, 6, 5, 7), points, text, 0, implementation))
    opcheck(compiled.scatter, (some(2, 2, 4, 9), points, text, [6, 5, 7], 0, implementation))
    opcheck(compiled.place, (points, compiled.placement_text(PLACE), implementation))


@pytest.mark.parametrize("implementation", ["reference", "cpu"])
def test_operators_have_the_derivatives_of_the_functions(implementation: str) -> None:
    text, coefficients, points, weights = compiled.stencil_text(QUADRATIC), some(1, 1, 4, 5, 4), some(1, 3, 3), some(4)
    for name, function in {
        "gather": lambda c, p: compiled.gather(c, p, text, 0, implementation),
        "scatter": lambda c, p: compiled.scatter(
            weights[:, None] * c.mean() * p[:, None, None, :, 0], p, text, [4, 5, 4], 0, implementation
        ),
        "place": lambda c, p: compiled.place(9 * p, compiled.placement_text(PLACE), implementation)[0] + c.mean(),
    }.items():
        assert torch.autograd.gradcheck(function, (coefficients, points), fast_mode=implementation == "reference"), name
    ours = ops.gather(coefficients, points, QUADRATIC, 0, implementation)
    assert torch.equal(ours, compiled.gather(coefficients, points, text, 0, implementation))


def test_text_is_exact() -> None:
    for stencil in (QUADRATIC, Direct(NCRSI_TERMS, "fused", "central").stencils[1], QUADRATIC.derivatives[0]):
        assert compiled.stencil_of(compiled.stencil_text(stencil)).lowered == stencil.lowered
    sheared = Geometry.of(affine=[[1, 0.1, 0, 3], [0, -1 / 3, 0, 2], [0, 0, 2, 1], [0, 0, 0, 1]])
    for place in (PLACE, Placement(sheared, Boundary.ZEROS, (1, 2, 3), 7)):
        assert compiled.placement_of(compiled.placement_text(place)) == place


@pytest.mark.parametrize("scheme", ["fused", "direct", "sampled"])
def test_a_field_compiles_whole(scheme: str) -> None:
    torch._dynamo.reset()
    field = fl.reconstruct(fl.Volume(torch.rand(7, 8, 9), spacing=(1, 2, 0.5)), "triquadratic", scheme=scheme)
    points = torch.rand(20, 3) * 9 - 2

    def loss(x: torch.Tensor) -> torch.Tensor:
        value, gradient = field.jet(x, 1)
        return value.sin().sum() + gradient.square().sum()

    whole = torch.compile(loss, fullgraph=True, backend="aot_eager")
    results = []
    for function in (loss, whole):
        x = points.clone().requires_grad_()
        value = function(x)
        results.append((value.detach(), *torch.autograd.grad(value, x)))
    for got, want in zip(*results, strict=True):
        assert_close(got, want, 1e-5, float(want.abs().max()))


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
@pytest.mark.parametrize(("boundary", "tail"), [("mirror", 2), ("border", 3), ("zeros", 1)])
def test_the_prefilter_as_an_operator(boundary: str, tail: int, implementation: str) -> None:
    text = compiled.filtering_text("quadratic", boundary, tail)
    assert compiled.filtering_of(text) == Filtering(VOLUME, QUADRATIC_PREFILTER, Boundary(boundary), tail)
    own = some(2, 5, 4, 6)
    opcheck(compiled.prefilter, (own, text, implementation))
    x = own.detach().clone().requires_grad_()
    values = compiled.prefilter(x, text, implementation)
    want = prefilter_samples(x, "quadratic", boundary, tail)
    assert_close(values.detach(), want.detach(), 1e-14)
    cotangents = torch.rand_like(values)
    (found,), (expected,) = (torch.autograd.grad(v, x, cotangents) for v in (values, want))
    assert_close(found, expected, 1e-13)
