"""Scenes: what they build, that they say what is wrong, and that the example scenes are valid."""

import math
import warnings
from pathlib import Path

import pytest
import torch

from filterlab import signals
from filterlab.fields.base import Field
from filterlab.io import save_image, save_volume
from filterlab.io.config import ConfigError, dump_config, loads_config
from filterlab.methods import reconstruct
from filterlab.notices import Notice
from filterlab.ops.differentiable import march
from filterlab.render import (
    Light,
    OrthographicCamera,
    PerspectiveCamera,
    Phong,
    Shading,
    TransferFunction,
    raycast,
    render,
)
from filterlab.scenes.build import PreparedSurface, build, load_scene, render_scene
from filterlab.scenes.default import default_scene
from filterlab.scenes.model import LevelSetModel, Scene, find_volume
from filterlab.surfaces import LevelSet

SCENES = Path(__file__).resolve().parent.parent / "configs" / "scenes"

MINIMAL = """
signal: {name: marschner-lobb, samples: 12}
transfer:
  peaks: [{center: 0.5, width: 0.2, height: 0.8, color: [1.0, 0.5, 0.2]}]
size: [12, 8]
"""


@pytest.fixture
def scene_file(tmp_path):
    def write(text, name="scene.yaml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def saved_volume(folder, name="volume.nrrd"):
    volume = signals.marschner_lobb().sample(10, dtype=torch.float32)
    save_volume(volume, folder / name)
    return volume


def test_a_scene_is_what_its_parts_render(scene_file):
    text = (
        MINIMAL
        + """
method: {name: notch, boundary: reflect, prefilter: false}
step: 0.7
camera: {projection: orthographic, direction: [0.2, 0.9, -0.3], window: [0.25, 0.0, 0.75, 1.0]}
lighting: {lights: [{direction: [1.0, 2.0, 3.0], color: [1.0, 0.5, 0.5]}, {}], ambient: 0.1, shininess: 9}
background: [0.1, 0.2, 0.3]
region: {lower: [-0.5, -1.0, -1.0], upper: [1.0, 1.0, 1.0]}
jitter: 4
termination: 0.01
precision: float64
"""
    )
    image = render_scene(load_scene(scene_file(text)))
    signal = signals.marschner_lobb()
    field = reconstruct(signal.sample(12), "notch", boundary="reflect", prefilter=False)
    expected = render(
        field,
        OrthographicCamera.framing(field.domain, (0.2, 0.9, -0.3), aspect=3.0, window=(0.25, 0.0, 0.75, 1.0)),
        TransferFunction.triangle_peaks([(0.5, 0.2, 0.8, (1.0, 0.5, 0.2))], unit=2 / 12),
        size=(12, 8),
        step=0.7,
        shading=Shading((Light((1.0, 2.0, 3.0), (1.0, 0.5, 0.5)), Light()), ambient=0.1, shininess=9),
        background=(0.1, 0.2, 0.3),
        region=((-0.5, -1, -1), (1, 1, 1)),
        jitter_seed=4,
        termination=0.01,
        dtype=torch.float64,
    )
    assert image.shape == (8, 12, 3)
    torch.testing.assert_close(image, expected[..., :3], rtol=0, atol=1e-12)
    assert image.std() > 0.05


def test_defaults_cost_nothing_and_overrides_change_what_they_name(scene_file, monkeypatch):
    path = scene_file(MINIMAL)
    scene = load_scene(path)
    prepared = build(scene)
    assert isinstance(prepared.camera, PerspectiveCamera)
    assert prepared.shading is prepared.region is None
    assert prepared.sampling.jitter_seed is prepared.sampling.termination is None
    lit = []
    run = march.run
    monkeypatch.setattr(march, "run", lambda m, *rest: lit.append(m.lighting) or run(m, *rest))
    render_scene(scene)
    assert lit == [None]
    changed = load_scene(path, {"method": "notch", "size": "[4, 6]", "camera.field_of_view": "20"})
    assert changed.method is not None
    assert (changed.method.name, changed.size, changed.camera.field_of_view) == ("notch", (4, 6), 20.0)


def test_an_exact_signal_is_its_own_field_and_normalized_axes_span_the_samples(scene_file):
    exact = load_scene(scene_file(MINIMAL), {"signal.samples": "null"})
    assert isinstance(build(exact).field, signals.Signal)
    text = MINIMAL.replace("peaks:", "axis: normalized\n  peaks:")
    samples = signals.marschner_lobb().sample(12).samples
    low, high = samples.min().item(), samples.max().item()
    transfer = build(load_scene(scene_file(text))).transfer
    half = 0.1 * (high - low)
    middle = (low + high) / 2
    assert transfer.positions.tolist() == pytest.approx([middle - half, middle, middle + half], rel=1e-5)


@pytest.mark.parametrize(
    ("shown", "raw"),
    [
        (
            "transfer: {axis: normalized, peaks: [{center: 1, width: 1, height: 0.9, color: [1, 1, 1]}]}",
            "transfer: {peaks: [{center: 5, width: 4, height: 0.9, color: [1, 1, 1]}]}",
        ),
        ("surface: {axis: normalized, level: 0.4}", "surface: 2.6"),
    ],
    ids=["medium", "surface"],
)
def test_missing_voxels_are_transparent_and_not_in_the_range(shown, raw, scene_file, tmp_path):
    samples = torch.rand(6, 7, 8, generator=torch.Generator().manual_seed(1)) * 4 + 1
    samples[2, 3, 4], samples[4, 5, 6] = 1, 5
    samples[:, :3, :4] = math.nan
    samples[5, 6, 7] = math.inf
    save_volume(samples, tmp_path / "torn.npy")
    head = "volume: torn.npy\nmethod: {name: trilinear, nan: propagate}\nsize: [20, 16]\n"
    image = build(load_scene(scene_file(head + shown))).render()
    assert torch.equal(image, build(load_scene(scene_file(head + raw))).render())
    assert image.isfinite().all()
    filled = build(load_scene(scene_file(head.replace("propagate", "fill") + shown))).render()
    assert ((filled - image)[..., 3] > 0.1).sum() > 10
    assert (image[..., 3] > 0.1).sum() > 10
    save_image(render_scene(load_scene(scene_file(head + shown))), tmp_path / "torn.png")


def test_volume_files_are_found_beside_the_scene_and_by_variables(scene_file, tmp_path, monkeypatch):
    saved_volume(tmp_path)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    saved_volume(elsewhere, "other.nrrd")
    path = scene_file(MINIMAL.replace("signal: {name: marschner-lobb, samples: 12}", "volume: volume.nrrd"))
    scene = load_scene(path)
    field = build(scene).field
    assert isinstance(field, Field)
    assert render_scene(scene).std() > 0.01
    monkeypatch.delenv("FILTERLAB_VOLUMES", raising=False)
    with pytest.raises(ConfigError, match=r"volume.*found none at .*other\.nrrd.*FILTERLAB_VOLUMES"):
        load_scene(path, {"volume": "other.nrrd"})
    monkeypatch.setenv("FILTERLAB_VOLUMES", str(elsewhere))
    assert find_volume("other.nrrd", tmp_path) == elsewhere / "other.nrrd"
    assert find_volume("$FILTERLAB_VOLUMES/other.nrrd", tmp_path) == elsewhere / "other.nrrd"
    with pytest.raises(ValueError, match="environment variables that are set"):
        find_volume("$FILTERLAB_NO_SUCH/other.nrrd", tmp_path)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"method": "noch"}, "method.*did you mean 'notch'.*trilinear"),
        ({"signal.name": "marschner"}, "signal.*known signals.*franke"),
        ({"signal.parameters": "{frequenzy: 3}"}, "frequenzy.*did you mean 'frequency'"),
        (
            {"signal": "{name: plane-wave, samples: 8, parameters: {wave_vector: 3}}"},
            r"signal\.parameters: wave_vector: expected three numbers \[x, y, z\]; got 3",
        ),
        ({"signal.parameters": "{frequency: [1, 2, 3]}"}, r"signal\.parameters: frequency: expected a number; got \(1"),
        ({"signal.parameters": "{voxel_size: -1}"}, r"signal\.parameters: voxel_size.*positive"),
        ({"signal.parameters": "{frequency: 1e308}"}, r"signal: .*marschner-lobb is finite; got .*1e\+308"),
        ({"method": "{name: notch, boundary: periodic}"}, "known boundarys|boundary.*wrap"),
        ({"method": "{name: tricubic, gradient: central}"}, "offers the gradients analytic"),
        ({"signal.samples": "null", "method": "notch"}, "needs no method"),
        ({"transfer.points": "[{value: 0, color: [1, 1, 1], opacity: 0.5}]"}, "transfer.*points and peaks"),
        ({"transfer": "{}"}, "expected points, peaks or a colormap"),
        ({"transfer.peaks[0].height": "2"}, r"transfer.peaks\[0\].height"),
        ({"transfer.peaks[0].centre": "2"}, "centre.*did you mean 'center'"),
        ({"camera": "{position: [0, 0, 0]}"}, "camera.*position and target together"),
        ({"camera": "{direction: [0, 0, 1]}"}, "camera.*up must not lie along"),
        ({"camera": "{height: 3}"}, "camera.*height goes with"),
        ({"camera": "{window: [0, 0, 0, 1]}"}, "camera.*window"),
        ({"camera.projection": "fisheye"}, "camera.projection.*perspective"),
        ({"lighting": "{lights: [{direction: [0, 0, 0]}]}"}, r"lights\[0\].*direction"),
        ({"region": "{lower: [0, 0, 0], upper: [1, 1, 0]}"}, "region.*lower < upper"),
        ({"step": "0"}, "step"),
        ({"size": "[0, 5]"}, "size"),
        ({"termination": "1.5"}, "termination"),
        ({"stepp": "1"}, "did you mean 'step'"),
        ({"volume": "missing.nrrd"}, "found none"),
    ],
)
def test_mistakes_name_the_key_and_the_known_names(scene_file, overrides, message):
    with pytest.raises(ConfigError, match=message):
        load_scene(scene_file(MINIMAL), overrides)


def test_vectors_of_a_signal(scene_file):
    text = "{name: plane-wave, samples: [4, 5, 6], parameters: {wave_vector: [1, 2, 3.5], phase: 1}}"
    scene = load_scene(scene_file(MINIMAL), {"signal": text})
    assert scene.signal is not None
    assert scene.signal.samples == (4, 5, 6)
    point = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    assert scene.signal.build()(point).item() == pytest.approx(math.cos(0.1 + 0.4 + 1.05 + 1), rel=1e-12)
    assert load_scene(scene_file(dump_config(scene))) == scene


def test_a_signal_that_cannot_be_computed_is_refused(scene_file, monkeypatch):
    def broken(slope: float = 1.0) -> signals.Signal:
        return signals.Signal("broken", lambda p: (p @ p.new_tensor(slope), p))

    monkeypatch.setitem(signals.SIGNALS, "broken", broken)
    with pytest.raises(ConfigError, match=r"signal: expected parameters with which broken is finite; got .*matmul"):
        load_scene(scene_file(MINIMAL), {"signal": "{name: broken, parameters: {slope: 2}}"})


def test_a_scene_shows_one_volume(scene_file, tmp_path, monkeypatch):
    save_volume(torch.rand(1, 2, 3, 4, 5), tmp_path / "batch.npz")
    path = scene_file(MINIMAL.replace("signal: {name: marschner-lobb, samples: 12}", "volume: batch.npz"))
    monkeypatch.setattr(
        "filterlab.scenes.model.sources.load_volume", lambda *_: pytest.fail("the voxels must not be read")
    )
    with pytest.raises(ValueError, match=r"batch\.npz: expected one volume of shape \(D, H, W\).*\(1, 2, 3, 4, 5\)"):
        render_scene(load_scene(path))


def test_a_volume_and_a_signal_are_too_much_and_none_too_little(scene_file, tmp_path):
    saved_volume(tmp_path)
    with pytest.raises(ConfigError, match="either a volume or a signal; got both"):
        load_scene(scene_file(MINIMAL + "volume: volume.nrrd\n"))
    with pytest.raises(ConfigError, match="either a volume or a signal"):
        load_scene(scene_file(MINIMAL.replace("signal: {name: marschner-lobb, samples: 12}", "")))


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.yaml")), ids=lambda p: p.stem)
def test_example_scenes_render_and_survive_a_round_trip(path, scene_file, tmp_path):
    saved_volume(tmp_path, "any.npz")
    overrides = {"size": "[6, 4]"}
    if "\nstep:" in path.read_text():
        overrides["step"] = "2"
    if "\nvolume:" in path.read_text():
        overrides["volume.file"] = str(tmp_path / "any.npz")
    scene = load_scene(path, overrides)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Notice)  # of degrees
        assert render_scene(scene).isfinite().all()
    assert load_scene(scene_file(dump_config(scene))) == scene


def test_there_are_example_scenes():
    assert {p.stem for p in SCENES.glob("*.yaml")} >= {
        "engine",
        "marschner_lobb",
        "head_mri",
        "caffeine",
        "tensors",
        "jacksboro",
    }


@pytest.mark.parametrize(
    ("bare", "key", "value", "full"),
    [
        ("method: notch", "method.boundary", "wrap", "method: {name: notch, boundary: wrap}"),
        ("slice: x", "slice.colormap", "magma", "slice: {axis: x, colormap: magma}"),
        ("mip: true", "mip.colormap", "magma", "mip: {colormap: magma}"),
        ("mip: true\nlegend: true", "legend.label", "HU", "mip: true\nlegend: {label: HU}"),
        ("surface: 0.5", "surface.sheets", "2", "surface: {level: 0.5, sheets: 2}"),
        (
            "surface: {level: 0.5, material: toon}",
            "surface.material.bands",
            "4",
            "surface: {level: 0.5, material: {kind: toon, bands: 4}}",
        ),
        (
            "signal: sphere\nmip: true",
            "signal.parameters",
            "{radius: 0.4}",
            "signal: {name: sphere, parameters: {radius: 0.4}}\nmip: true",
        ),
    ],
)
def test_a_section_that_a_bare_value_stands_for_can_be_changed_in_part(scene_file, bare, key, value, full):
    """`--slice x --slice.colormap magma`, whether the bare value stands in the file or before it on the line."""
    base = "" if "signal" in bare else "signal: {name: sphere, samples: 6}\n"
    base += MINIMAL[MINIMAL.index("transfer") :] if bare.startswith("method") else ""
    expected = load_scene(scene_file(base + full))
    assert load_scene(scene_file(base + bare), {key: value}) == expected
    name, _, first = bare.splitlines()[-1 if "legend" in bare else 0].partition(": ")
    rest = "\n".join(line for line in bare.splitlines() if not line.startswith(name))
    assert load_scene(scene_file(base + rest), {name: first, key: value}) == expected


# --- surfaces ---------------------------------------------------------------------------------------------------------

SURFACE = """
signal: {name: marschner-lobb, samples: 12}
surface: {level: 0.5, material: {color: [0.9, 0.5, 0.2], opacity: 0.5}, sheets: 2}
camera: {direction: [1, 2, -1]}
lighting: {lights: [{direction: [1, 0, 2]}]}
size: [9, 7]
"""


def test_a_surface_is_what_its_parts_cast(scene_file):
    image = render_scene(load_scene(scene_file(SURFACE)))
    field = reconstruct(signals.marschner_lobb().sample(12, dtype=torch.float32), "triquadratic")
    camera = PerspectiveCamera.framing(field.domain, (1.0, 2.0, -1.0), aspect=9 / 7)
    material = Phong((0.9, 0.5, 0.2), opacity=0.5)
    expected = raycast(LevelSet(field, 0.5), camera, material, size=(9, 7), lights=[Light((1.0, 0.0, 2.0))], sheets=2)
    assert isinstance(expected, torch.Tensor)
    assert torch.equal(image, expected[..., :3])
    assert image.std() > 0.05


def test_a_level_may_be_a_part_of_the_range(scene_file):
    scenes = [load_scene(scene_file(SURFACE), {"surface": s}) for s in ("{level: 0.25, axis: normalized}", "0.1")]
    samples = signals.marschner_lobb().sample(12, dtype=torch.float32).samples
    low, high = samples.aminmax()
    prepared = build(scenes[0])
    assert isinstance(prepared, PreparedSurface)
    assert prepared.surface.level == pytest.approx(float(low + 0.25 * (high - low)), rel=1e-6)
    assert scenes[1].surface == LevelSetModel(level=0.1)


@pytest.mark.parametrize("material", ["phong", "toon", "reflection_lines", "environment", "{kind: toon, contour: 0.1}"])
def test_every_material_can_be_named(material, scene_file):
    scene = load_scene(scene_file(SURFACE), {"surface": f"{{level: 0.5, material: {material}, shadows: true}}"})
    assert render_scene(scene).isfinite().all()
    assert load_scene(scene_file(dump_config(scene))) == scene


def test_an_environment_may_be_a_picture(scene_file, tmp_path):
    save_image(torch.full((4, 8, 3), 0.5), tmp_path / "around.png")
    mirror = "{level: 0.5, material: {kind: environment, picture: around.png, reflectivity: 1}}"  # beside the scene
    image = render_scene(load_scene(scene_file(SURFACE), {"surface": mirror}))
    hit = image.amax(-1) > 0
    assert 4 < hit.sum() < 63
    torch.testing.assert_close(image[hit], torch.full_like(image[hit], 0.5), rtol=0, atol=0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transfer": "{peaks: [{center: 1, width: 1, height: 0.5, color: [1, 1, 1]}]}"}, "got both"),
        ({"surface": "null"}, "a transfer function .*, a surface, a terrain, a mip or a slice; got none"),
        ({"step": "0.5"}, "step: a surface is hit exactly"),
        ({"termination": "0.5"}, "termination: a surface is hit exactly"),
        ({"signal.samples": "null"}, "no exact pieces"),
        ({"surface.material": "gold"}, "known names: phong, toon, reflection_lines, environment"),
        ({"surface.material.colour": "[1, 1, 1]"}, "did you mean 'color'"),
        ({"surface.material.opacity": "2"}, "opacity"),
        ({"surface.level": "high"}, "surface.level: expected a valid number"),
        ({"surface.sheets": "0"}, "surface.sheets"),
        ({"surface": "{level: 0.5, material: {kind: environment, picture: no.png}}"}, "found none at .*no.png"),
    ],
)
def test_mistakes_of_surfaces_are_named(change, message, scene_file):
    with pytest.raises((ConfigError, ValueError), match=message):
        render_scene(load_scene(scene_file(SURFACE), change))


# --- a volume alone ---------------------------------------------------------------------------------------------------


def scan(folder):
    """A ball with a dense core in air, with noise; a corner is missing."""
    z, y, x = torch.meshgrid(*(torch.arange(float(n)) - n / 2 for n in (18, 20, 22)), indexing="ij")
    radius = (x * x + y * y + z * z).sqrt()
    samples = 100.0 * (radius < 8) + 300.0 * (radius < 3)
    samples += 3 * torch.randn(samples.shape, generator=torch.Generator().manual_seed(1))
    samples[:5, :5, :5] = math.nan
    save_volume(samples, folder / "scan.npy")
    return folder / "scan.npy"


def test_a_volume_alone_is_just_shown(tmp_path):
    scene = default_scene(scan(tmp_path), {"size": "[20, 16]"})
    image = build(scene).render()
    assert image.shape == (16, 20, 4)
    assert image.isfinite().all()
    assert 0.1 < (image[..., 3] > 0.5).double().mean() < 0.9
    assert image[0, 0, 3] == 0
    assert scene.method.nan == "propagate"
    again = loads_config(dump_config(scene), Scene, name="written")
    assert torch.equal(build(again).render(), image)


def test_what_is_said_of_a_volume_alone_is_kept(tmp_path):
    path = scan(tmp_path)
    said = {"method": "{name: notch, nan: fill}", "transfer.unit": "3", "camera.up": "[0, 1, 0]", "step": "2"}
    scene = default_scene(path, said)
    assert (scene.method.name, scene.method.nan, scene.transfer.unit, scene.step) == ("notch", "fill", 3, 2)
    assert scene.camera.up == (0, 1, 0)
    with pytest.raises(ConfigError, match="unknown key"):
        default_scene(path, {"colour": "red"})
    with pytest.raises(ConfigError, match="found none"):
        default_scene(tmp_path / "none.nrrd")
    with pytest.raises(ValueError, match="got 125 NaN of"):
        default_scene(path, {"method": "{name: notch, nan: refuse}"})
