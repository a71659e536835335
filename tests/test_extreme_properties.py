"""Properties of fields that hold for any input: points of any bits, samples in any layout, any origin."""

from __future__ import annotations

import math
import struct
from fractions import Fraction
from itertools import permutations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import filterlab as fl
from filterlab.fields.base import Field
from filterlab.volume import Boundary

SHAPE = (6, 5, 7)
SAMPLES = 2 * torch.rand(SHAPE, generator=torch.Generator().manual_seed(7)) - 1
some = settings(deadline=None, max_examples=30)
few = settings(deadline=None, max_examples=12)

bits = st.integers(0, 2**32 - 1).map(lambda i: struct.unpack("<f", struct.pack("<I", i))[0])  # NaN and ±inf too
near = st.floats(-20, 20, width=32) | st.integers(-40, 40).map(lambda i: i / 2)
coordinates = bits | near | st.sampled_from([0.0, -0.0, math.inf, -math.inf, math.nan, 3e38, -(2.0**24)])
batches = st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=1, max_size=12)

methods = st.sampled_from(list(fl.METHODS))
of_scheme = {
    scheme: st.sampled_from([name for name, method in fl.METHODS.items() if scheme in method.schemes])
    for scheme in ("direct", "fused")
}
every_boundary = pytest.mark.parametrize("boundary", list(Boundary))


def repetition(method: str) -> int:
    """Voxels after which the partition that a method's splines lie on repeats itself; 1 also where there is none."""
    return getattr(getattr(fl.METHODS[method], "spline", None), "period", 1)


def folded(x: float, n: int, boundary: str, repeats: int) -> float:
    """The place in the first period, or no further than 100 voxels outside, that x stands for, in exact arithmetic.

    A partition that repeats itself after several voxels is not reflected with the samples, but moved with them.
    """
    if boundary in ("border", "zeros"):
        return x if math.isnan(x) else max(min(x, n + 100.0), -100.0)
    if not math.isfinite(x):
        return math.nan
    low = Fraction(-1, 2) if boundary == "reflect" else Fraction(0)
    period = {"mirror": 2 * n - 2, "reflect": 2 * n, "wrap": n}[boundary]
    place = (Fraction(x) - low) % math.lcm(period, repeats)
    if boundary != "wrap" and repeats == 1 and place > Fraction(period, 2):
        place = period - place
    return float(place + low)


def jets(method: str, boundary: str, scheme: str, points: Tensor, samples: Tensor = SAMPLES) -> tuple[Tensor, ...]:
    return fl.reconstruct(samples, method, boundary=boundary, scheme=scheme).jet(points, 1)


@every_boundary
@some
@given(batch=batches, method=methods)
def test_points_of_any_bits_fold_as_exact_arithmetic_does(boundary: str, batch: list, method: str) -> None:
    points = torch.tensor(batch, dtype=torch.float32)
    repeats = repetition(method)
    places = [[folded(x, n, boundary, repeats) for x, n in zip(p, SHAPE[::-1], strict=True)] for p in points.tolist()]
    expected = jets(method, boundary, "direct", torch.tensor(places, dtype=torch.float64), SAMPLES.double())[0]
    nowhere = expected.isnan()
    gradients = []
    for scheme in ("direct", "fused"):
        if scheme not in fl.METHODS[method].schemes:
            continue
        value, gradient = jets(method, boundary, scheme, points)
        gradients.append(gradient)
        assert torch.equal(value.isnan(), nowhere)
        assert torch.equal(gradient.isnan().any(-1), nowhere)
        torch.testing.assert_close(value[~nowhere].double(), expected[~nowhere], rtol=0, atol=3e-5)
    torch.testing.assert_close(gradients[-1], gradients[0], rtol=0, atol=3e-5, equal_nan=True)


@every_boundary
@pytest.mark.parametrize("scheme", ["direct", "fused"])
@few
@given(batch=batches, data=st.data())
def test_derivatives_at_points_of_any_bits(scheme: str, boundary: str, batch: list, data: st.DataObject) -> None:
    """By the points what the field itself says; by the samples what the other points alone give."""
    method = data.draw(of_scheme[scheme])
    points = torch.tensor(batch, dtype=torch.float32, requires_grad=True)
    samples = SAMPLES.clone().requires_grad_()
    field = fl.reconstruct(samples, method, boundary=boundary, scheme=scheme, gradient="analytic")
    value, gradient = field.jet(points, 1)
    by_points, by_samples = torch.autograd.grad(value.sum(), (points, samples), retain_graph=True)
    assert bool(by_samples.isfinite().all())
    known = ~value.isnan()
    near = known & ((points.detach().abs() < 2.0**60).all(-1) | (repetition(method) == 1))  # farther off all are even
    torch.testing.assert_close(by_points[near], gradient[near], rtol=0, atol=3e-5)
    assert bool(by_points[points.isnan()].isnan().all())
    alone = torch.autograd.grad(field(points.detach()[known]).sum(), samples)[0]
    torch.testing.assert_close(by_samples, alone, rtol=0, atol=2e-5)


@pytest.mark.parametrize("scheme", ["direct", "fused"])
@few
@given(
    data=st.data(),
    order=st.sampled_from(list(permutations(range(3)))),
    steps=st.tuples(*[st.integers(1, 3)] * 3),
    margins=st.tuples(*[st.integers(0, 2)] * 3),
    turned=st.permutations([0, 1, 2]),
)
def test_samples_and_points_in_any_layout_give_the_same_bits(
    scheme: str, data: st.DataObject, order: tuple, steps: tuple, margins: tuple, turned: list
) -> None:
    method = data.draw(of_scheme[scheme])
    sizes = [margin + step * n for margin, step, n in zip(margins, steps, (SHAPE[a] for a in order), strict=True)]
    memory = torch.full(sizes, math.nan)
    view = memory[tuple(slice(margin, None, step) for margin, step in zip(margins, steps, strict=True))]
    view = view.permute([order.index(a) for a in range(3)])
    view.copy_(SAMPLES)
    points = torch.rand(33, 3, generator=torch.Generator().manual_seed(3)) * 8 - 1
    spread = points[:, turned].T.contiguous().T[:, [turned.index(a) for a in range(3)]].T.contiguous().T
    before = memory.clone()
    found, expected = (
        fl.reconstruct(s, method, scheme=scheme).jet(p, 1) for s, p in ((view, spread), (SAMPLES, points))
    )
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    assert torch.equal(memory.nan_to_num(nan=-7), before.nan_to_num(nan=-7))


# --- measured from somewhere nearby -----------------------------------------------------------------------------------


@few
@given(origin=st.tuples(*[st.floats(-1e9, 1e9)] * 3), method=methods, turn=st.booleans())
def test_a_field_measured_from_nearby_is_the_same_function(origin: tuple, method: str, turn: bool) -> None:
    affine = torch.eye(4, dtype=torch.float64)
    affine[:3, :3] = torch.tensor([[0.0, -2, 0], [0.5, 0, 0], [0, 0, 1]]) if turn else torch.diag(torch.ones(3))
    local = fl.reconstruct(fl.Volume(SAMPLES, affine=affine), method)
    affine[:3, 3] = torch.tensor(origin, dtype=torch.float64)
    field = fl.reconstruct(fl.Volume(SAMPLES, affine=affine), method)
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(4)) * 6
    for a, b in zip(field.relative_to(origin).jet(points, 1), local.jet(points, 1), strict=True):
        assert torch.equal(a, b)
    moved = field.relative_to(origin).domain
    assert moved.corners().tolist() == local.domain.corners().tolist()


def test_any_field_can_be_measured_from_nearby() -> None:
    signal = fl.signals.plane_wave((3.0, 1.0, 2.0))
    origin = (1e6, -2e6, 0.5)
    points = torch.rand(20, 3, requires_grad=True)
    value, gradient = signal.relative_to(origin).value_and_gradient(points)
    expected = signal.value_and_gradient(points.double() + torch.tensor(origin, dtype=torch.float64))
    assert value.dtype == gradient.dtype == torch.float32
    torch.testing.assert_close(value, expected[0].float(), rtol=0, atol=1e-6)
    (slope,) = torch.autograd.grad(value.sum(), points)
    torch.testing.assert_close(slope, expected[1].float(), rtol=0, atol=1e-5)
    assert signal.relative_to((0, 0, 0)) is signal


@pytest.mark.parametrize("field", [fl.reconstruct(SAMPLES), fl.signals.gaussian()], ids=["grid", "signal"])
@pytest.mark.parametrize("origin", [(1.0, 2.0), (1.0, 2.0, math.nan), 3.0, "abc"])
def test_an_origin_is_three_numbers(field: Field, origin) -> None:
    with pytest.raises(ValueError, match="origin must be three finite numbers in x, y, z order; got"):
        field.relative_to(origin)
