"""Legends: the colours at their values, numbers that can be read, nothing cut off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from filterlab.cli import main
from filterlab.io.config import ConfigError, dump_config, loads_config
from filterlab.io.images import to_srgb
from filterlab.render import ColorScale, TransferFunction
from filterlab.render.legend import Legend
from filterlab.scenes.build import render_scene
from filterlab.scenes.model import Scene

LETTERS = 12.0  # pixels, of small pictures


def digits(image: torch.Tensor) -> np.ndarray:
    return (255 * to_srgb(image.clamp(0, 1))).round().numpy()


@pytest.mark.parametrize("side", ["right", "below"])
@pytest.mark.parametrize("colormap", ["gray", "viridis"])
def test_the_bar_has_the_colour_of_every_value(side: str, colormap: str) -> None:
    """From low to high, upwards or to the right, between its ends, a pixel at a time."""
    scale = ColorScale(-200.0, 1400.0, colormap)
    image = torch.zeros(300, 300, 3, dtype=torch.float64)
    picture = Legend.of_scale(scale).beside(image, side=side)  # type: ignore[arg-type]
    assert torch.equal(picture[:300, :300], image)
    strip = digits(picture[:, 300:] if side == "right" else picture[300:].flip(1).transpose(0, 1))
    assert strip.shape[0] == 300
    bar = strip[:, round(1.65 * LETTERS)]  # its middle; from high to low
    spare = 21 if side == "right" else 31.2
    middles = np.arange(300) + 0.5
    value = -200 + 1600 * (1 - (middles - spare) / (300 - 2 * spare))
    inside = (middles > spare + 3) & (middles < 300 - spare - 3)
    expected = digits(scale(torch.from_numpy(value)))
    assert np.abs(bar - expected)[inside].max() <= 3
    assert bar[:10].max() == bar[-10:].max() == 0


@pytest.mark.parametrize(("background", "ink"), [((0.0, 0.0, 0.02), 255), ((0.9, 0.95, 0.9), 0)])
@pytest.mark.parametrize("side", ["right", "below"])
def test_numbers_are_whole_and_stand_out(background: tuple, ink: int, side: str) -> None:
    image = torch.tensor(background, dtype=torch.float64).expand(120, 90, 3)
    legend = Legend.of_scale(ColorScale(-123456.0, 98765.0), label="something in μm²/$")
    picture = legend.beside(image, background, side)  # type: ignore[arg-type]
    strip = digits(picture[:, 90:] if side == "right" else picture[120:])
    behind = digits(image)[0, 0]
    edges = (strip[:2], strip[-2:], strip[:, :2], strip[:, -2:])
    assert all(np.abs(edge - behind).max() <= 1 for edge in edges)
    written = strip[:, round(3.2 * LETTERS) :] if side == "right" else strip[round(3.2 * LETTERS) :]
    assert (np.abs(written - ink).max(-1) <= 80).sum() > 60
    small = Legend.of_scale(ColorScale(0.0, 1.0)).beside(torch.zeros(16, 16, 3))
    assert small.shape[0] == 16


def test_letters_grow_with_the_picture() -> None:
    widths = [Legend.of_scale(ColorScale(0.0, 1.0)).beside(torch.zeros(n, n, 3)).shape[1] - n for n in (128, 256, 1024)]
    assert widths[0] == widths[1]
    assert 2 < widths[2] / widths[0] < 4


def test_opacities_stand_along_the_bar_and_what_is_transparent_has_no_colour() -> None:
    red, blue = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    transfer = TransferFunction.triangle_peaks([(10, 4, 0.04, red), (20, 4, 0.64, blue)])
    strip = digits(Legend.of_transfer(transfer).beside(torch.zeros(300, 300, 3)))[:, 300:]
    spare, low, high = 21, 8, 22

    def row(value: float) -> int:
        return round(300 - spare - (value - low) / (high - low) * (300 - 2 * spare) - 0.5)

    bar = round((1 + 1.8 + 0.65) * LETTERS)
    assert strip[row(10), bar].tolist() == pytest.approx([255, 0, 0], abs=2)
    assert strip[row(20), bar].tolist() == pytest.approx([0, 0, 255], abs=2)
    assert strip[row(15), bar].tolist() == [0, 0, 0]
    profile = strip[:, round(LETTERS) - 1 : round(2.8 * LETTERS) - 1].max(-1) > 60
    faint, strong, nothing = (int(profile[row(v)].sum()) for v in (10, 20, 15))
    assert nothing == 0
    assert faint / strong == pytest.approx(0.25, abs=0.08)  # √(0.04 / 0.64)
    opaque = Legend.of_transfer(transfer, opaque=True)
    assert opaque.opacities is None


def test_a_constant_volume_and_a_single_control_point_have_a_legend() -> None:
    for legend in (
        Legend.of_scale(ColorScale(5.0, 5.0)),
        Legend.of_transfer(TransferFunction([3.0], [(1.0, 0.0, 0.0)], [0.5])),
        Legend.of_transfer(TransferFunction([0.0, 1.0], [(1.0, 0.0, 0.0)] * 2, [0.0, 0.0])),
    ):
        assert legend.beside(torch.zeros(64, 64, 3)).isfinite().all()


SCENE = "signal: {name: sphere, samples: 6}\nsize: [60, 50]\nstep: 2\nbackground: '#123456'\n"
MEDIUM = SCENE + "transfer: {points: [{value: 0, color: navy, opacity: 0}, {value: 1, color: gold, opacity: 0.7}]}\n"


@pytest.mark.parametrize("more", ["", "mip: true\n"])
def test_a_scene_asks_for_one(more: str, tmp_path: Path) -> None:
    plain = render_scene(loads_config(MEDIUM + more, Scene))
    asked = loads_config(MEDIUM + more + "legend: {side: below, label: part}\n", Scene)
    image = render_scene(asked)
    assert torch.equal(image[:50], plain)
    assert image.shape[0] > 70
    assert loads_config(dump_config(asked), Scene) == asked
    path = tmp_path / "scene.yaml"
    path.write_text(MEDIUM + more)
    for name, arguments in (("a.png", []), ("b.gif", ["--turntable", "2"])):
        assert main(["render", str(path), "--legend", "-o", str(tmp_path / name), *arguments]) == 0
        with Image.open(tmp_path / name) as picture:
            assert picture.width > 80
            assert picture.height == 50


def test_mistakes() -> None:
    with pytest.raises(ConfigError, match="the colours of a surface stand for no values"):
        loads_config(SCENE.replace("step: 2\n", "") + "surface: 0.5\nlegend: true\n", Scene)
    with pytest.raises(ConfigError, match=r"legend.side: .*'left'.*right, below"):
        loads_config(MEDIUM + "legend: {side: left}\n", Scene)
