"""Coefficients in shorter types: rounded once, summed as before."""

from __future__ import annotations

from dataclasses import replace
from itertools import cycle, product

import pytest
import torch

import filterlab as fl
from filterlab.fields.grid import GridField
from filterlab.fields.storage import STORAGE, stored_as
from filterlab.render import Light, PerspectiveCamera, Shading, TransferFunction, fused, render
from tests.pairs import covering
from tests.test_methods import kind_of

INTEGER = ["int16", "int8", "uint8"]
# the largest rounding: half a unit in the last place of a number below 2, or half a step of the range
ROUNDING = {"float64": 0, "float32": 2.0**-24, "float16": 2.0**-11, "bfloat16": 2.0**-8}
STEPS = {"int16": 2**16 - 1, "int8": 2**8 - 1, "uint8": 2**8 - 1}


def samples(*shape: int, dtype=torch.float32) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64).to(dtype) - 0.25


def points(count: int = 200, size: int = 8) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * (size + 3) - 2


def built(volume: torch.Tensor, method: str, **options) -> GridField:
    field = fl.reconstruct(volume, method, **options)
    assert isinstance(field, GridField)
    return field


def scene(field: GridField):
    camera = PerspectiveCamera.framing(field.domain, direction=(0.3, 0.8, -0.5))
    transfer = TransferFunction([0.1, 0.35, 0.6], [(0.9, 0.2, 0.1), (0.3, 0.8, 0.2), (1, 1, 1)], [0.0, 0.3, 0.1])
    return camera, transfer


@pytest.mark.parametrize(
    ("method", "storage", "boundary"),
    covering(product(fl.METHODS, STORAGE, ("mirror", "zeros")), lambda m, s, b: ((m, b), (kind_of(m), s), (s, b))),
)
def test_a_field_is_that_of_its_rounded_coefficients(method, storage, boundary):
    volume = samples(8, 9, 7)
    exact = built(volume, method, boundary=boundary, scheme="direct")
    rounded = built(volume, method, boundary=boundary, scheme="direct", storage=storage)
    fast = built(volume, method, boundary=boundary, scheme=fl.METHODS[method].schemes[0], storage=storage)
    c, r = exact.coefficients.values.double(), rounded.coefficients.decoded(torch.float64)
    half = (c.max() - c.min()) / STEPS[storage] / 2 if storage in STEPS else ROUNDING[storage] * c.abs().max()
    assert rounded.coefficients.values.dtype == fast.coefficients.values.dtype == STORAGE[storage]
    assert float((c - r).abs().max()) <= 1.01 * float(half) * (2 if boundary == "zeros" and storage in STEPS else 1)
    exact = exact.with_coefficients(replace(exact.coefficients, values=r))
    for of_rounded, direct, quick in zip(*(f.jet(points(), 1) for f in (exact, rounded, fast)), strict=True):
        torch.testing.assert_close(direct, of_rounded, rtol=0, atol=1e-11)
        torch.testing.assert_close(quick, of_rounded, rtol=0, atol=1e-11)


@pytest.mark.parametrize("storage", INTEGER)
def test_what_is_zero_stays_zero(storage):
    field = fl.reconstruct(samples(6, 6, 6), "trilinear", boundary="zeros", storage=storage)
    far = torch.tensor([[-40.0, 2, 2], [3, 90, 1]])
    assert float(field(far).abs().max()) < 1e-7


@pytest.mark.parametrize("storage", INTEGER)
@pytest.mark.parametrize("offset", [0.0, 1000.0, -8.0])
def test_integers_use_every_level(storage, offset):
    """As many evenly spaced coefficients as there are levels have one each, and come back as they were."""
    values = offset + 0.25 * torch.arange(STEPS[storage] + 1, dtype=torch.float64).reshape(1, 1, -1)
    stored, quantization = stored_as(values, STORAGE[storage])
    info = torch.iinfo(STORAGE[storage])
    assert stored.flatten().tolist() == list(range(info.min, info.max + 1))
    assert quantization is not None
    assert torch.equal(quantization.decoded(stored, torch.float64), values)


@pytest.mark.parametrize("storage", INTEGER)
def test_a_constant_volume_is_stored_exactly(storage):
    field = fl.reconstruct(torch.full((4, 5, 6), 7.25), "tricubic", storage=storage)
    torch.testing.assert_close(field(points().float()), torch.full((200,), 7.25), rtol=2e-6, atol=0)


@pytest.mark.parametrize("storage", INTEGER)
def test_every_volume_of_a_batch_has_its_own_range(storage):
    batch = samples(2, 3, 6, 7, 8) * torch.logspace(-3, 4, 6).reshape(2, 3, 1, 1, 1)
    field = built(batch, "triquadratic", storage=storage)
    values, gradients = field.value_and_gradient(points()[None].float())
    for n in range(2):
        for c in range(3):
            alone = fl.reconstruct(batch[n, c], "triquadratic", storage=storage)
            for one in (alone, field.select(n, c)):
                v, g = one.value_and_gradient(points().float())
                assert torch.equal(v, values[n, c])
                assert torch.equal(g, gradients[n, c])


@pytest.mark.parametrize(("storage", "lit"), list(zip((None, *STORAGE), cycle((True, False)), strict=False)))
def test_the_fused_march_shows_what_the_plain_one_shows(storage, lit, monkeypatch):
    shading = Shading(lights=[Light((0.3, -1, 0.5))]) if lit else None
    field = built(10 * samples(12, 12, 12), "tricubic", storage=storage)
    camera, transfer = scene(field)
    transfer = TransferFunction(10 * transfer.positions, transfer.colors, transfer.opacities)
    options = {"size": (24, 20), "shading": shading}
    assert fused.why_not_fused(medium_of(field, transfer, shading)) is None
    image = render(field, camera, transfer, **options)
    monkeypatch.setattr("filterlab.render.dvr.why_not_fused", lambda medium: "told so")
    plain = render(field, camera, transfer, **options)
    assert float(image[..., 3].max()) > 0.5
    torch.testing.assert_close(image, plain, rtol=0, atol=2e-5)


def medium_of(field, transfer, shading):
    from filterlab.render.plain import Medium

    return Medium(field, transfer.to(torch.float32, torch.device("cpu")), shading, 0.5, 0.0, False)


@pytest.mark.parametrize("storage", INTEGER)
def test_an_image_of_integers_is_differentiable_in_the_transfer_function(storage, monkeypatch):
    field = built(samples(8, 8, 8), "triquadratic", storage=storage)
    camera, transfer = scene(field)
    found = []
    for allowed in (True, False):
        tables = [t.clone().requires_grad_() for t in (transfer.positions, transfer.colors, transfer.opacities)]
        if not allowed:
            monkeypatch.setattr("filterlab.render.dvr.why_not_fused", lambda medium: "told so")
        image = render(field, camera, TransferFunction(*tables), size=(10, 9), dtype=torch.float64)
        image.square().sum().backward()
        found.append([t.grad for t in tables])
    for fast, plain in zip(*found, strict=True):
        assert float(plain.abs().max()) > 1e-3
        torch.testing.assert_close(fast, plain, rtol=1e-7, atol=1e-9)


def test_control_points_that_rounding_would_join_are_not_joined():
    field = built(samples(8, 8, 8) * 1e4, "trilinear", storage="uint8")
    near = TransferFunction([0.0, 1e-6, 5.0], torch.ones(3, 3), [0.0, 0.5, 0.1])
    assert "fall together" in str(fused.why_not_fused(medium_of(field, near, None)))


@pytest.mark.parametrize("storage", ["float32", "float16", "bfloat16"])
def test_floating_storage_passes_derivatives_to_the_samples(storage):
    volume = samples(5, 6, 7).requires_grad_()
    fl.reconstruct(volume, "triquadratic", storage=storage)(points().float()).sum().backward()
    exact = samples(5, 6, 7).requires_grad_()
    fl.reconstruct(exact, "triquadratic")(points().float()).sum().backward()
    assert volume.grad is not None
    assert exact.grad is not None
    torch.testing.assert_close(volume.grad, exact.grad, rtol=0.02, atol=0.05)


def test_mistakes_are_told_before_anything_is_stored():
    with pytest.raises(ValueError, match=r"storage must be one of float64, .*uint8, or None; got 'int4'"):
        fl.reconstruct(samples(4, 4, 4), storage="int4")
    with pytest.raises(ValueError, match=r"storage must be one of .*; got torch.int32"):
        fl.reconstruct(samples(4, 4, 4), storage=torch.int32)
    with pytest.raises(ValueError, match=r"float16 holds numbers up to 65504; coefficients reach 1e\+06"):
        fl.reconstruct(torch.full((4, 4, 4), 1e6), "trilinear", storage="float16")
    with pytest.raises(ValueError, match=r"storage=uint8 can't be differentiated"):
        fl.reconstruct(samples(4, 4, 4).requires_grad_(), storage="uint8")
    kernel = fl.kernels.bc(torch.tensor(0.3), torch.tensor(0.3))
    with pytest.raises(ValueError, match=r"weights sum to 1"):
        fl.reconstruct(samples(4, 4, 4), kernel, prefilter=False, storage="uint8")
    with pytest.raises(ValueError, match=r"finite numbers only"):
        stored_as(torch.tensor([[[0.0, torch.inf]]]), torch.int16)
