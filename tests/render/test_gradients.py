"""Derivatives of the image, first and second, in everything it is made of."""

import math

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from filterlab import signals
from filterlab.methods import reconstruct
from filterlab.render import Light, OrthographicCamera, PerspectiveCamera, Shading, TransferFunction, render
from filterlab.volume import Volume
from tests import laws

X = [0.0, 0.4, 1.0]
RGB = [[0.2, 0.3, 0.9], [0.8, 0.5, 0.1], [0.4, 0.9, 0.3]]
ALPHA = [0.1, 0.3, 0.8]
SIZE = {"size": (2, 1), "step": 1.3, "dtype": torch.float64}


def parameter(value):
    return torch.tensor(value, dtype=torch.float64, requires_grad=True)


def samples():
    generator = torch.Generator().manual_seed(4)
    return torch.rand(3, 3, 3, generator=generator, dtype=torch.float64).requires_grad_()


def volume(values):
    return Volume(values, spacing=(0.5, 1.0, 0.8), origin=(1.0, 0.0, -1.0))


CAMERA = PerspectiveCamera(position=(-1.0, -3.0, 1.5), target=(1.6, 1.1, -0.3), field_of_view=18.0)
TRANSFER = TransferFunction(X, RGB, ALPHA)
LIT = Shading((Light((1.0, -2.0, 1.0)), Light(None, (0.3, 0.4, 0.5))), ambient=0.3, shininess=4.0)
FIELD = reconstruct(volume(samples().detach()), "tricubic")


def check(function, *inputs, thoroughly=False):
    """First derivatives each by itself; second ones along random directions, or thoroughly each by itself too."""
    image = function(*inputs)
    assert image[..., 3].min() > 0.1  # every ray hits
    for derivative in torch.autograd.grad(image.square().sum(), inputs):
        assert derivative.abs().max() > 1e-4  # a test of zeros would be none
    assert gradcheck(function, inputs)
    assert gradgradcheck(lambda *a: laws.mixed(function(*a)), inputs, fast_mode=not thoroughly)


@pytest.mark.parametrize(("method", "shading"), [("trilinear", None), ("triquadratic", LIT)])
def test_in_the_volume(method, shading):
    def image(v):
        return render(reconstruct(volume(v), method), CAMERA, TRANSFER, shading=shading, **SIZE)

    check(image, samples(), thoroughly=shading is None)


def test_in_a_batch_of_volumes():
    generator = torch.Generator().manual_seed(5)
    batch = torch.rand(2, 2, 2, 2, 2, generator=generator, dtype=torch.float64).requires_grad_()
    camera = PerspectiveCamera(position=(-1.0, -3.0, 1.5), target=(1.2, 0.5, -0.6), field_of_view=18.0)
    dense = TransferFunction(X, RGB, [0.3, 0.5, 0.9])
    two = batch[:1].detach().requires_grad_()
    check(lambda v: render(reconstruct(volume(v), "trilinear"), camera, dense, **SIZE), two)
    (derivative,) = torch.autograd.grad(
        render(reconstruct(volume(batch), "trilinear"), camera, TRANSFER, **SIZE)[1, 0].sum(), batch
    )
    assert derivative[1, 0].any()
    assert not derivative[0].any()
    assert not derivative[1, 1].any()


def test_transforms_of_torch_func_are_refused_and_not_wrong():
    def brightness(v):
        return render(reconstruct(volume(v), "trilinear"), CAMERA, TRANSFER, **SIZE).sum()

    v = samples().detach()
    for transform, inputs in ((torch.func.grad, v), (torch.func.vmap, torch.stack((v, v)))):
        with pytest.raises(RuntimeError, match=r"torch\.func|vmap"):
            transform(brightness)(inputs)


def test_in_the_pose_of_a_pinhole():
    def function(position, target, up, angle):
        camera = PerspectiveCamera(position=position, target=target, up=up, field_of_view=angle)
        return render(FIELD, camera, TRANSFER, shading=LIT, jitter_seed=2, **SIZE)

    check(function, *map(parameter, (CAMERA.position, CAMERA.target, (0.1, 0.0, 1.0), 18.0)))


def test_in_the_pose_of_parallel_rays_and_in_rays():
    def function(position, target, height):
        camera = OrthographicCamera(position=position, target=target, height=height)
        return render(FIELD, camera, TRANSFER, **SIZE)

    check(function, *map(parameter, (CAMERA.position, CAMERA.target, 0.6)))
    rays = [r.clone().requires_grad_() for r in CAMERA.rays(2, 1)]
    check(lambda o, d: render(FIELD, (o, d), TRANSFER, step=1.3, dtype=torch.float64), *rays)


def test_in_the_transfer_function():
    def function(x, rgb, alpha):
        return render(FIELD, CAMERA, TransferFunction(x, rgb, alpha), shading=LIT, **SIZE)

    check(function, *map(parameter, (X, RGB, ALPHA)), thoroughly=True)


def test_in_the_lights_and_the_background():
    def function(direction, tint, weights, background):
        light = Shading((Light(direction, tint), Light()), weights[0], weights[1], weights[2], 6 * weights[3])
        return render(FIELD, CAMERA, TRANSFER, shading=light, background=background, **SIZE)

    check(
        function,
        *map(parameter, ([1.0, -2.0, 1.0], [1.0, 0.8, 0.6], [0.2, 0.7, 0.3, 0.9], [0.3, 0.6, 0.9])),
    )


def test_a_volume_can_be_fitted_to_an_image_and_termination_is_ignored_then():
    v = samples()
    full = render(reconstruct(volume(v), "triquadratic"), CAMERA, TRANSFER, **SIZE)
    short = render(reconstruct(volume(v), "triquadratic"), CAMERA, TRANSFER, **SIZE, termination=0.5)
    assert torch.equal(full, short)
    assert full.requires_grad
    with torch.no_grad():
        assert not render(reconstruct(volume(v), "triquadratic"), CAMERA, TRANSFER, **SIZE).requires_grad
    assert not render(FIELD, CAMERA, TRANSFER, **SIZE).requires_grad


def test_derivatives_do_not_depend_on_the_memory():
    """Blocks are recomputed in the backward pass: the same numbers from many small pieces."""
    field = signals.gaussian()
    results = []
    for memory in (2**28, 2**20):
        position, alpha = parameter([-3.0, -4.0, 2.0]), parameter(ALPHA)
        camera = PerspectiveCamera(position=position, target=(0, 0, 0))
        transfer = TransferFunction(X, RGB, alpha, unit=0.5)
        image = render(field, camera, transfer, size=(6, 5), step=0.5, shading=LIT, memory=memory, dtype=torch.float64)
        results.append((image.detach(), *torch.autograd.grad(image.square().sum(), (position, alpha))))
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)


def test_opaque_control_points_missing_rays_and_flat_fields_have_finite_derivatives():
    flat = torch.full((3, 3, 3), 0.5, dtype=torch.float64, requires_grad=True)
    alpha = parameter([0.0, 1.0, 1.0])
    position = parameter([-1.0, -3.0, 1.5])
    camera = PerspectiveCamera(position=position, target=(1.6, 1.1, -0.3), field_of_view=90.0)
    image = render(
        reconstruct(volume(flat), "triquadratic"), camera, TransferFunction(X, RGB, alpha), shading=LIT, size=(8, 8)
    )
    assert (image[..., 3] == 1).any()
    assert (image[..., 3] == 0).any()
    first = torch.autograd.grad(image.square().sum(), (flat, alpha, position), create_graph=True)
    assert all(g.isfinite().all() for g in first)
    second = torch.autograd.grad(sum(g.square().sum() for g in first), (flat, alpha, position), allow_unused=True)
    assert all(g is None or g.isfinite().all() for g in second)


def test_memory_of_the_backward_pass_is_bounded():
    """What autograd keeps between the passes grows with rays and blocks, not with samples."""
    kept = 0

    def pack(x):
        nonlocal kept
        kept += x.numel() * x.element_size()
        return x

    alpha = parameter(ALPHA)
    field = signals.gaussian()
    camera = PerspectiveCamera.framing(field.domain, (0.4, 0.8, -0.4))
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        render(field, camera, TransferFunction(X, RGB, alpha), size=(16, 16), step=0.1, shading=LIT)
    samples = 256 * 2 / (0.1 * field.domain.voxel_size)  # at least half of the rays are longer than this
    assert 0 < kept < 20 * samples
    assert math.isfinite(kept)
