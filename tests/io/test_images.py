"""PNG in and out: the sRGB curve, clipping, shapes, refusals."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from skimage.color import rgb2xyz

from filterlab.io import load_image, save_image
from filterlab.io.images import from_srgb, to_srgb


def test_the_curve_is_srgb() -> None:
    """Known pairs of IEC 61966-2-1, both pieces, and the inverse."""
    linear = torch.tensor([0.0, 0.001, 0.0031308, 0.2140411, 0.5, 1.0], dtype=torch.float64)
    encoded = torch.tensor([0.0, 0.01292, 0.04045, 0.5, 0.7353570, 1.0], dtype=torch.float64)
    torch.testing.assert_close(to_srgb(linear), encoded, atol=1e-6, rtol=0)
    x = torch.linspace(0, 1, 1001, dtype=torch.float64)
    torch.testing.assert_close(from_srgb(to_srgb(x)), x, atol=1e-6, rtol=0)
    grey = np.linspace(0, 1, 256)[:, None].repeat(3, 1)  # scikit-image's own decoding: Y of a grey is its linear value
    luminance = torch.tensor(rgb2xyz(grey)[:, 1])
    torch.testing.assert_close(from_srgb(torch.tensor(grey[:, 0])), luminance, atol=1e-4, rtol=0)


def test_the_curve_is_differentiable() -> None:
    x = torch.tensor([0.0, 0.001, 0.3, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(to_srgb, x)
    assert torch.autograd.gradcheck(from_srgb, x)


@pytest.mark.parametrize("srgb", [True, False])
def test_round_trip_within_half_a_step(tmp_path: Path, srgb: bool) -> None:
    image = torch.rand(5, 7, 3)
    save_image(image, tmp_path / "a.png", srgb=srgb)
    found = load_image(tmp_path / "a.png", srgb=srgb)
    assert (found.shape, found.dtype) == (image.shape, torch.float32)
    encode = to_srgb if srgb else torch.Tensor
    assert (encode(found) - encode(image)).abs().max() <= 0.5 / 255 + 1e-6
    assert os.listdir(tmp_path) == ["a.png"]


def test_shapes_alpha_and_clipping(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    save_image(torch.tensor([[-1.0, 0.2158605, 7.0]]), path)  # grey
    assert np.asarray(Image.open(path)).tolist() == [[0, 128, 255]]
    assert load_image(path).shape == (1, 3, 3)
    save_image(torch.tensor([[[0.5, 0.0, 1.0, 0.5]]]), path)
    assert np.asarray(Image.open(path)).tolist() == [[[188, 0, 255, 128]]]  # alpha is not encoded
    save_image(torch.rand(2, 3, 3, dtype=torch.float64, requires_grad=True), path)
    assert load_image(path).shape == (2, 3, 3)


def test_sixteen_bits(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 32768, 65535]], np.uint16)).save(tmp_path / "a.png")
    found = load_image(tmp_path / "a.png", srgb=False)
    torch.testing.assert_close(found[0, :, 0], torch.tensor([0.0, 32768 / 65535, 1.0]))


@pytest.mark.parametrize(
    ("image", "name", "words"),
    [
        (torch.zeros(2, 2, 3), "a.jpg", "ends in .png"),
        (torch.zeros(2, 2, 2), "a.png", "(H, W, 3)"),
        (torch.zeros(2, 2, 2, 3), "a.png", "(H, W, 3)"),
        (torch.zeros(0, 2, 3), "a.png", "not empty"),
        (torch.zeros(2, 2, 3, dtype=torch.uint8), "a.png", "floating"),
        (torch.full((2, 2, 3), torch.nan), "a.png", "12 values that are not"),
    ],
)
def test_refusals(tmp_path: Path, image: torch.Tensor, name: str, words: str) -> None:
    with pytest.raises(ValueError, match="got") as caught:
        save_image(image, tmp_path / name)
    assert words in str(caught.value)
    assert os.listdir(tmp_path) == []


def test_not_an_image(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    save_image(torch.rand(8, 8, 3), path)
    whole = path.read_bytes()
    for content in (b"", b"nothing", whole[:40], whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises((ValueError, OSError)):
            load_image(path)
    with pytest.raises(FileNotFoundError):
        load_image(tmp_path / "b.png")
