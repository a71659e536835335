"""Colours of scenes: by name, hexadecimal and colormap they are in a picture what they are elsewhere."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import pytest
import torch
from matplotlib.colors import CSS4_COLORS, to_rgb
from PIL import Image

from filterlab import signals
from filterlab.cli import main
from filterlab.io.config import ConfigError, dump_config, loads_config
from filterlab.io.images import to_srgb
from filterlab.render import TransferFunction
from filterlab.render.colormaps import ColorScale
from filterlab.scenes.build import Prepared, build, render_scene
from filterlab.scenes.model import Scene
from filterlab.scenes.model.colors import linear_rgb, parsed

SCENE = """
signal: {name: sphere, samples: 6}
transfer: {points: [{value: 0, color: COLOR, opacity: 1}]}
size: [5, 4]
"""


def scene(color: str, more: str = "") -> Scene:
    return loads_config(SCENE.replace("COLOR", color) + more, Scene)


def test_every_css_name_has_its_digits_in_the_picture() -> None:
    for name, digits in CSS4_COLORS.items():
        encoded = 255 * to_srgb(torch.tensor(linear_rgb(name), dtype=torch.float64))
        assert encoded.tolist() == pytest.approx([255 * x for x in to_rgb(digits)], abs=1e-9), name


@pytest.mark.parametrize("color", ["'#f80'", "'#ff8800'", "'#FF8800ff'", "'#f80f'"])
def test_hexadecimal_digits_are_those_of_the_file(color: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    text = SCENE.replace("COLOR", color).replace(", opacity: 1", "" if "f'" in color else ", opacity: 1")
    path.write_text(text + "background: white\n")
    assert main(["render", str(path), "-o", str(tmp_path / "image.png")]) == 0
    pixels = _digits(tmp_path / "image.png")
    assert {tuple(p) for p in pixels.reshape(-1, 3).tolist()} == {(255, 136, 0), (255, 255, 255)}


def _digits(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture)


def test_colours_are_taken_wherever_a_scene_has_some() -> None:
    """Transfer functions, background, lights and all materials; and they survive a round trip."""
    expected = linear_rgb("tomato")
    medium = scene("tomato", "background: '#ff6347'\nlighting: {lights: [{color: Tomato}]}\n")
    assert medium.transfer is not None
    assert medium.transfer.points is not None
    assert medium.lighting is not None
    assert medium.transfer.points[0].color == medium.background == medium.lighting.lights[0].color == expected
    peak = loads_config("signal: sphere\ntransfer: {peaks: [{center: 1, width: 1, height: 1, color: tomato}]}\n", Scene)
    assert peak.transfer.peaks[0].color == expected  # type: ignore[union-attr, index]
    for material, key in (("phong", "color"), ("toon", "ink"), ("reflection_lines", "dark"), ("environment", "color")):
        made_of = f"{{kind: {material}, {key}: tomato}}"
        text = f"signal: {{name: sphere, samples: 4}}\nsurface: {{level: 0.5, material: {made_of}}}"
        found = loads_config(text, Scene)
        assert getattr(found.surface.material, key) == expected  # type: ignore[union-attr]
        assert loads_config(dump_config(found), Scene) == found
    assert loads_config(dump_config(medium), Scene) == medium


def test_the_last_digits_are_the_opacity_beside_the_colour() -> None:
    point = loads_config("signal: sphere\ntransfer: {points: [{value: 0, color: '#ff000080'}]}\n", Scene)
    assert point.transfer.points[0].opacity == 128 / 255  # type: ignore[union-attr, index]
    assert point.transfer.points[0].color == (1.0, 0.0, 0.0)  # type: ignore[union-attr, index]
    peak = loads_config("signal: sphere\ntransfer: {peaks: [{center: 1, width: 1, color: '#0f08'}]}\n", Scene)
    assert peak.transfer.peaks[0].height == 136 / 255  # type: ignore[union-attr, index]
    text = "signal: {name: sphere, samples: 4}\nsurface: {level: 0.5, material: {kind: toon, color: '#0000ff40'}}\n"
    assert loads_config(text, Scene).surface.material.opacity == 64 / 255  # type: ignore[union-attr]


def test_numbers_are_linear_light() -> None:
    assert scene("[0.5, 0.25, 2]").transfer.points[0].color == (0.5, 0.25, 2.0)  # type: ignore[union-attr, index]
    assert parsed("black") == ((0.0, 0.0, 0.0), 1.0)
    assert parsed("white") == ((1.0, 1.0, 1.0), 1.0)
    assert parsed("gray")[0][0] == pytest.approx(((128 / 255 + 0.055) / 1.055) ** 2.4, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SCENE.replace("COLOR", "tomatoe"), r"points\[0\].color: expected a colour.*'tomatoe'; did you mean 'tomato'"),
        (SCENE.replace("COLOR", "'#ff88'") + "x: 1", "opacity once; got '#ff88' and opacity: 1"),
        (SCENE.replace("COLOR", "'#ff'"), "expected a colour.*got '#ff'"),
        (SCENE.replace("COLOR", "'#gg8800'"), "expected a colour.*got '#gg8800'"),
        (SCENE.replace("COLOR", "'rgb(1,2,3)'"), r"expected a colour.*got 'rgb\(1,2,3\)'"),
        (SCENE.replace("COLOR", "[1, 2]"), r"points\[0\].color"),
        (SCENE.replace("COLOR", "[1, -2, 0]"), r"color\[1\]: expected greater than or equal to 0"),
        (
            SCENE.replace("COLOR", "red") + "background: '#00000080'\n",
            "background: expected a colour without an opacity",
        ),
        (SCENE.replace("COLOR", "red") + "background: #000000\n", "background: .*got nothing.*# begins a comment"),
    ],
)
def test_mistakes_say_how_a_colour_is_written(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        loads_config(text, Scene)


def test_a_hexadecimal_colour_on_the_command_line_is_no_comment() -> None:
    text = SCENE.replace("COLOR", "red")
    found = loads_config(text, Scene, {"background": "#ff6347", "transfer.points[0].color": "#ff6347"})
    assert found.background == found.transfer.points[0].color == linear_rgb("tomato")  # type: ignore[union-attr, index]


# --- colormaps --------------------------------------------------------------------------------------------------------

RAMP = """
signal: {name: sphere, samples: 6}
transfer: {colormap: viridis, ramp: [{value: 0.2, opacity: 0}, {value: 0.6, opacity: 0.5}]}
"""


@pytest.mark.parametrize("name", ["viridis", "gray", "coolwarm", "tab10", "magma_r"])
@pytest.mark.parametrize("ends", [None, (-1.0, 3.0)])
def test_a_colormap_has_its_own_entries_and_the_opacities_of_its_ramp(name: str, ends: tuple | None) -> None:
    colormap = matplotlib.colormaps[name]
    ramp = [(0.2, 0.0), (0.5, 0.75), (0.6, 0.25)]
    transfer = TransferFunction.from_colormap(name, ramp, ends, unit=2.0)
    low, high = ends or (0.2, 0.6)
    count = 2 if name == "gray" else colormap.N
    x = torch.linspace(low, high, count, dtype=torch.float64)
    color, opacity = transfer(x)
    expected = torch.as_tensor(colormap(np.linspace(0, 1, count))[:, :3])
    torch.testing.assert_close(to_srgb(color), expected, rtol=0, atol=1e-12)
    assert opacity.tolist() == pytest.approx(np.interp(x, *zip(*ramp, strict=True)).tolist(), abs=1e-12)
    assert transfer(torch.tensor([0.5], dtype=torch.float64))[1].item() == pytest.approx(0.75, abs=1e-12)
    assert transfer.unit == 2.0


def test_a_colormap_in_a_scene() -> None:
    text = RAMP.replace("0.5}]", "0.5}], axis: normalized, range: [0, 2]")
    prepared = build(loads_config(text, Scene))
    assert isinstance(prepared, Prepared)
    low, high = signals.sphere().sample(6, dtype=torch.float32).samples.aminmax()
    ends = [float(low + part * (high - low)) for part in (0, 2)]
    assert prepared.transfer.positions[[0, -1]].tolist() == pytest.approx(ends, abs=1e-6)
    assert render_scene(prepared.scene).std() > 0.01


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transfer.colormap": "viridi"}, "unknown colormap 'viridi'; did you mean 'viridis'.*those of matplotlib"),
        ({"transfer.ramp": "null"}, "a colormap and a ramp .* together"),
        ({"transfer.colormap": "null"}, "expected points, peaks or a colormap"),
        ({"transfer.range": "[1, 1]"}, "first colour below that of its last; got 1, 1"),
        ({"transfer.ramp[1].value": "0.1"}, "must increase"),
        ({"transfer.ramp": "[{value: 1, opacity: 0.5}]"}, "first colour below"),
        ({"transfer": "{range: [0, 1], points: [{value: 1, color: red, opacity: 1}]}"}, "range goes with a colormap"),
    ],
)
def test_mistakes_of_colormaps(change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        loads_config(RAMP, Scene, change)


def test_a_grey_window_is_linear_in_the_pixels() -> None:
    """As viewers of scans show it: 255 w."""
    scale = ColorScale(-100.0, 300.0)
    v = torch.tensor([-500.0, -100, 0, 100, 299, 300, 1e9], dtype=torch.float64)
    encoded = to_srgb(scale(v))
    expected = ((v + 100) / 400).clamp(0, 1)
    torch.testing.assert_close(encoded, expected[:, None].expand(-1, 3), rtol=0, atol=1e-12)


def test_a_scale_of_a_colormap_is_linear_between_its_entries_and_differentiable() -> None:
    entries = matplotlib.colormaps["magma"](range(256))[:, :3]
    v = torch.rand(50, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 12 - 1
    encoded = to_srgb(ColorScale(0.0, 10.0, "magma")(v))
    expected = np.stack([np.interp(v / 10 * 255, np.arange(256), entries[:, c]) for c in range(3)], -1)
    np.testing.assert_allclose(encoded.numpy(), expected, atol=1e-12)
    inside = torch.tensor([0.31, 4.77, 9.99], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(ColorScale(0.0, 10.0, "magma"), inside)
    assert ColorScale(2.0, 2.0)(torch.tensor([2.0])).tolist() == [[0.0] * 3]
    with pytest.raises(ValueError, match="lower end of a window first; got 2 and 1"):
        ColorScale(2.0, 1.0)
