"""`fl.nn.Reconstruction`: the field of `reconstruct`, whatever is done to the module that holds its samples."""

from __future__ import annotations

import copy
import io
import pickle

import numpy as np
import pytest
import torch

import filterlab as fl
from filterlab.nn import Reconstruction

AFFINE = ((0.9, -0.4, 0.1, 3.0), (0.3, 1.1, 0.0, -2.0), (0.0, 0.2, 0.7, 5.0), (0.0, 0.0, 0.0, 1.0))


def samples(*shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(1))


def placed(*shape: int) -> fl.Volume:
    return fl.Volume(samples(*shape), affine=AFFINE)


def points(volume: fl.Volume, count: int = 40) -> torch.Tensor:
    """In the volume, and beyond."""
    size = torch.tensor(volume.size, dtype=torch.float64)
    unit = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    return volume.voxel_to_world(unit * (size + 3) - 2)


def same(got: tuple[torch.Tensor, ...], want: tuple[torch.Tensor, ...]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(got, want, strict=True))


@pytest.mark.parametrize("learnable", [True, False])
@pytest.mark.parametrize("boundary", ["mirror", "zeros"])
@pytest.mark.parametrize("method", fl.METHODS)
def test_it_is_the_field_of_its_samples_now_and_after_they_changed(method: str, boundary: str, learnable: bool) -> None:
    volume = placed(5, 6, 7)
    module, where = Reconstruction(volume, method, boundary=boundary, learnable=learnable), points(volume)
    for factor in (1.0, 3.0):
        with torch.no_grad():
            module.samples.mul_(factor) if learnable else setattr(module, "samples", volume.samples * factor)
        now = fl.Volume.with_geometry(module.samples.detach(), volume.geometry)
        want = fl.reconstruct(now, method, boundary=boundary)
        assert torch.equal(module(where), want(where))
        assert same(module.jet(where, 1), want.jet(where, 1))
        assert same(module.value_and_gradient(where), want.value_and_gradient(where))


@pytest.mark.parametrize("method", ["triquadratic", "notch", "qss"])
def test_derivatives_are_those_of_the_field(method: str) -> None:
    volume = placed(5, 6, 7)
    module, where = Reconstruction(volume, method, boundary="border"), points(volume).requires_grad_()
    inputs = volume.samples.clone().requires_grad_()
    want = fl.reconstruct(fl.Volume.with_geometry(inputs, volume.geometry), method, boundary="border")
    found = torch.autograd.grad(module(where).square().sum(), (module.samples, where))
    assert same(found, torch.autograd.grad(want(where).square().sum(), (inputs, where)))


def test_training_recovers_a_signal() -> None:
    truth = fl.reconstruct(placed(5, 5, 5), "triquadratic")
    module = Reconstruction(fl.Volume(torch.zeros(5, 5, 5, dtype=torch.float64), affine=AFFINE))
    where = placed(5, 5, 5).voxel_to_world(4 * samples(600, 3))
    optimizer = torch.optim.LBFGS(module.parameters(), max_iter=200, tolerance_grad=0, tolerance_change=0)

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        value = (module(where) - truth(where)).square().mean()
        value.backward()
        return value

    optimizer.step(loss)  # type: ignore[arg-type]
    assert float((module.samples.detach() - placed(5, 5, 5).samples).abs().max()) < 1e-4


def test_a_field_of_fixed_samples_is_made_once_and_again_when_they_change() -> None:
    module = Reconstruction(placed(4, 5, 6), learnable=False)
    assert module.field() is module.field()
    before = module.field()
    module.samples.add_(1)
    assert module.field() is not before
    learned = Reconstruction(placed(4, 5, 6))
    assert learned.field() is not learned.field()
    learned.requires_grad_(False)
    assert learned.field() is learned.field()


def test_learned_samples_are_a_copy_and_fixed_ones_are_not() -> None:
    given = samples(4, 4, 4)
    learned, fixed = Reconstruction(given), Reconstruction(given, learnable=False)
    given.mul_(2)
    assert torch.equal(learned.samples * 2, given)
    assert torch.equal(fixed.samples, given)
    assert [name for name, _ in learned.named_parameters()] == ["samples"]
    assert [name for name, _ in fixed.named_buffers()] == ["samples"]


def test_integers_are_learned_in_a_type_that_holds_them() -> None:
    assert Reconstruction(torch.ones(3, 3, 3, dtype=torch.uint8)).samples.dtype == torch.float32
    assert Reconstruction(torch.full((3, 3, 3), 16777217)).samples.dtype == torch.float64
    assert Reconstruction(torch.ones(3, 3, 3, dtype=torch.uint8), learnable=False).samples.dtype == torch.uint8


@pytest.mark.parametrize("shape", [(3, 4, 5), [2, 1, 3, 4, 5], torch.Size((3, 4, 5))])
def test_a_shape_begins_as_zeros(shape) -> None:
    module = Reconstruction(shape)
    assert module.samples.shape == torch.Size(shape)
    assert not module.samples.any()


@pytest.mark.parametrize("shape", [(3, 4), (3, 0, 4), (3, 4.0, 5), ()])
def test_other_shapes_are_refused(shape) -> None:
    with pytest.raises(ValueError, match=r"\(D, H, W\) or \(N, C, D, H, W\), integers ≥ 1; got"):
        Reconstruction(shape)


def test_what_is_no_volume_and_no_shape_is_refused() -> None:
    with pytest.raises(TypeError, match=r"a NumPy array or a shape; got str"):
        Reconstruction("triquadratic")  # type: ignore[arg-type]


# --- states and copies ------------------------------------------------------------------------------------------------


def copies(module: Reconstruction) -> dict[str, Reconstruction]:
    file = io.BytesIO()
    torch.save(module.state_dict(), file)
    file.seek(0)
    blank = fl.Volume.with_geometry(torch.zeros_like(module.samples), module.geometry)
    loaded = Reconstruction(blank, module.method, boundary=module.boundary)
    loaded.load_state_dict(torch.load(file, weights_only=True))
    return {"state": loaded, "copy": copy.deepcopy(module), "pickle": pickle.loads(pickle.dumps(module))}


@pytest.mark.parametrize("kind", ["state", "copy", "pickle"])
def test_copies_are_the_same_and_stand_alone(kind: str) -> None:
    module, where = Reconstruction(placed(4, 5, 6), "notch", boundary="reflect"), points(placed(4, 5, 6))
    module(where)
    other = copies(module)[kind]
    assert torch.equal(other(where), module(where))
    with torch.no_grad():
        other.samples.zero_()
    assert module.samples.any()
    assert torch.equal(other(where), torch.zeros(len(where), dtype=torch.float64))


@pytest.mark.parametrize(
    ("other", "told"),
    [
        (Reconstruction(placed(4, 5, 7), "notch"), r"shape \(4, 5, 7\); the state has \(4, 5, 6\)"),
        (Reconstruction(placed(4, 5, 6), "tricubic"), "method 'tricubic'; it is of 'notch'"),
        (Reconstruction(placed(4, 5, 6), "notch", boundary="wrap"), "boundary 'wrap'; it is of 'mirror'"),
        (Reconstruction(placed(4, 5, 6), "notch", prefilter=False), "prefilter False; it is of True"),
        (Reconstruction(samples(4, 5, 6), "notch"), "affine"),
    ],
)
def test_a_state_that_means_something_else_changes_nothing(other: Reconstruction, told: str) -> None:
    state, before = Reconstruction(placed(4, 5, 6).to(torch.float32), "notch").state_dict(), other.samples.clone()
    for strict in (True, False):
        with pytest.raises(RuntimeError, match=told):
            other.load_state_dict(state, strict=strict)
        assert torch.equal(other.samples, before)


def test_to_converts_what_it_is_made_of() -> None:
    module, where = Reconstruction(placed(4, 5, 6)), points(placed(4, 5, 6))
    single = copy.deepcopy(module).to(torch.float32)
    assert single.samples.dtype == torch.float32
    assert torch.equal(single(where), fl.reconstruct(placed(4, 5, 6).to(torch.float32), "triquadratic")(where))
    frozen = copy.deepcopy(module).requires_grad_(False)
    assert frozen(where.float()).dtype == torch.float32
    assert frozen.field() is not frozen.to(torch.float32).field()
    assert torch.equal(frozen(where), single(where))
    assert Reconstruction(placed(4, 5, 6), learnable=False).to(torch.float32)(where.float()).dtype == torch.float32


# --- transforms -------------------------------------------------------------------------------------------------------


def test_an_ensemble_by_vmap_is_a_loop() -> None:
    module, where = Reconstruction((4, 5, 6)).double(), points(placed(4, 5, 6))
    many = samples(3, 4, 5, 6)
    mapped = torch.func.vmap(lambda s: torch.func.functional_call(module, {"samples": s}, (where,)))(many)
    loop = torch.stack([fl.reconstruct(one, "triquadratic")(where) for one in many])
    assert float((mapped - loop).abs().max()) < 1e-13
    assert not module.samples.any()


@pytest.mark.parametrize(
    ("method", "boundary", "learnable"),
    [("triquadratic", "mirror", True), ("notch", "zeros", False), ("ncrsi", "border", True)],
)
def test_a_step_compiles_whole(method: str, boundary: str, learnable: bool) -> None:
    torch._dynamo.reset()
    volume = placed(4, 5, 6)
    module, where = Reconstruction(volume, method, boundary=boundary, learnable=learnable), points(volume)

    def loss(x: torch.Tensor) -> torch.Tensor:
        value, gradient = module.value_and_gradient(x)
        return value.sin().sum() + gradient.square().sum()

    whole = torch.compile(loss, fullgraph=True, backend="aot_eager")
    for _ in range(2):  # and again after a change
        x = where.clone().requires_grad_()
        inputs = (x, module.samples) if learnable else (x,)
        got, want = (torch.autograd.grad(f(x), inputs) for f in (whole, loss))
        for a, b in zip(got, want, strict=True):
            assert np.allclose(a, b, rtol=1e-12, atol=1e-12)
        with torch.no_grad():
            module.samples.mul_(2)
