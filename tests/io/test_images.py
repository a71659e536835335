"""Images in and out: the sRGB curve, clipping, shapes, refusals."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from skimage.color import rgb2xyz

from filterlab.io import load_image, save_image
from filterlab.io.images import from_srgb, save_animation, to_srgb


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
        (torch.zeros(2, 2, 3), "a.tif", "ends in .png or .jpg"),
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


@pytest.mark.parametrize("ending", [".jpg", ".jpeg", ".JPG"])
def test_jpeg_is_near_its_image_in_every_colour(tmp_path: Path, ending: str) -> None:
    """Thin coloured lines too, which subsampled colours would blur."""
    image = torch.zeros(32, 32, 3, dtype=torch.float64)
    image[:, ::8] = torch.tensor([1.0, 0.2, 0.05], dtype=torch.float64)
    path = tmp_path / f"a{ending}"
    save_image(image, path)
    with Image.open(path) as picture:
        assert picture.format == "JPEG"
        assert picture.mode == "RGB"
        difference = np.abs(np.asarray(picture).astype(float) - 255 * to_srgb(image).numpy())
    assert difference.max() < 40
    assert difference.mean() < 4


def test_alpha_is_laid_over_the_background_in_linear_light(tmp_path: Path) -> None:
    image = torch.tensor([0.8, 0.4, 0.2, 0.25], dtype=torch.float64).expand(16, 16, 4)
    background = (0.1, 0.5, 0.9)
    expected = to_srgb(0.25 * image[0, 0, :3] + 0.75 * torch.tensor(background, dtype=torch.float64))
    for name, allowed in (("a.png", 0.5), ("a.jpg", 2)):
        save_image(image, tmp_path / name, background=background)
        with Image.open(tmp_path / name) as picture:
            assert picture.mode == "RGB"
            assert np.abs(np.asarray(picture) - 255 * expected.numpy()).max() <= allowed


def _frames(count: int = 3) -> list[torch.Tensor]:
    return [torch.full((6, 8, 3), 0.2 * k + 0.1, dtype=torch.float64) for k in range(count)]


@pytest.mark.parametrize(("name", "allowed"), [("a.png", 0.5), ("a.gif", 4)])
def test_an_animation_has_its_frames_and_goes_round(tmp_path: Path, name: str, allowed: float) -> None:
    frames = _frames()
    save_animation(iter(frames), tmp_path / name, seconds=0.25)
    with Image.open(tmp_path / name) as picture:
        assert picture.n_frames == 3  # type: ignore[attr-defined]
        assert picture.info["loop"] == 0
        for k, frame in enumerate(frames):
            picture.seek(k)
            assert picture.info["duration"] == 250
            found = np.asarray(picture.convert("RGB"))
            assert np.abs(found - 255 * to_srgb(frame).numpy()).max() <= allowed


@pytest.mark.parametrize("name", ["a.png", "a.gif"])
def test_an_animation_that_is_interrupted_leaves_what_was_there(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"before")

    def frames():
        yield from _frames(2)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save_animation(frames(), tmp_path / name, seconds=0.1)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [(name, b"before")]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda p: save_image(torch.zeros(2, 2, 4), p / "a.jpg"), "a JPEG has no alpha"),
        (lambda p: save_image(torch.zeros(2, 2, 3), p / "a.png", background=(0, 0, 0)), "a background goes with alpha"),
        (lambda p: save_image(torch.zeros(2, 2, 4), p / "a.png", background=(0, 0)), "three numbers"),
        (lambda p: save_animation(_frames(), p / "a.jpg", seconds=1), "ends in .gif or .png"),
        (lambda p: save_animation([], p / "a.gif", seconds=1), "frames of one size"),
        (lambda p: save_animation([*_frames(1), torch.zeros(2, 2, 3)], p / "a.gif", seconds=1), "frames of one size"),
    ],
)
def test_refusals_of_pictures(tmp_path: Path, call, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        call(tmp_path)
    assert not list(tmp_path.iterdir())
