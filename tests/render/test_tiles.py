"""The order in which pixels are marched."""

from __future__ import annotations

import pytest
import torch

from filterlab import Volume, reconstruct
from filterlab.render import OrthographicCamera, TransferFunction, render
from filterlab.render.tiles import tiled, tiled_part

CPU = torch.device("cpu")


@pytest.mark.parametrize(("height", "width"), [(1, 1), (5, 37), (16, 16), (33, 17), (0, 3), (2, 0)])
def test_every_pixel_comes_once(height: int, width: int) -> None:
    assert torch.equal(tiled(height, width, CPU).sort().values, torch.arange(height * width))


def test_pixels_near_each_other_follow_each_other() -> None:
    """Whole blocks of 4 × 4, and 16 of them are 16 × 16."""
    y, x = (n.view(-1, 16) for n in (tiled(32, 48, CPU) // 48, tiled(32, 48, CPU) % 48))
    assert bool((y // 4 == y[:, :1] // 4).all())
    assert bool((x // 4 == x[:, :1] // 4).all())
    assert bool((y.view(-1, 256) // 16 == y.view(-1, 256)[:, :1] // 16).all())
    assert bool((x.view(-1, 256) // 16 == x.view(-1, 256)[:, :1] // 16).all())


@pytest.mark.parametrize("scheme", ["fused", "direct"])
def test_the_image_does_not_depend_on_the_order(scheme: str) -> None:
    """Rays one by one, in rows of the image, and as an image: the same pixels; and each pixel its own derivative."""
    volume = torch.rand(6, 7, 8, generator=torch.Generator().manual_seed(1))
    field = reconstruct(Volume(volume), "triquadratic", scheme=scheme)
    camera = OrthographicCamera.framing(field.domain, (0.3, 1, 0.2))
    transfer = TransferFunction([0.0, 1.0], [[1.0, 0.5, 0.1]] * 2, [0.0, 0.6])
    image = render(field, camera, transfer, size=(21, 18))
    o, d = camera.pixel_rays(torch.arange(18 * 21), 21, 18)
    assert torch.equal(render(field, (o, d), transfer).view(18, 21, 4), image)
    assert torch.equal(render(field, (o.view(18, 21, 3), d.view(18, 21, 3)), transfer), image)
    moving = o.view(18, 21, 3).clone().requires_grad_()
    shown = render(field, (moving, d.view(18, 21, 3)), transfer)
    (gradient,) = torch.autograd.grad(shown[9, 10].sum(), moving)
    others = torch.ones(18, 21, dtype=torch.bool)
    others[9, 10] = False
    assert bool((gradient[others] == 0).all())
    assert bool((gradient[9, 10] != 0).any())


@pytest.mark.parametrize(("height", "width"), [(1, 1), (16, 16), (33, 47), (50, 3), (3, 50)])
def test_a_part_is_cut_out_of_the_whole(height, width):
    whole = tiled(height, width, CPU)
    for first in range(0, height * width, 7):
        for last in (first, first + 1, min(first + 300, height * width), height * width):
            assert torch.equal(tiled_part(height, width, first, last, CPU), whole[first:last])
