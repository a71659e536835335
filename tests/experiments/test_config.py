"""Configs: what is refused, with the path of the key and the known names; and never with a traceback."""

import pytest

import filterlab as fl
from experiments.__main__ import main, split_overrides
from experiments.config import Recipe
from experiments.headings import known_configs
from experiments.registry import EXPERIMENTS, experiment_of, load
from filterlab.io.config import ConfigError, dump_config, loads_config
from filterlab.scenes.model import find_volume


def refused(path, overrides=None):
    with pytest.raises(ConfigError) as caught:
        load(str(path), overrides)
    return str(caught.value)


@pytest.mark.parametrize("name", known_configs())
def test_every_config_of_the_project_is_valid(name, monkeypatch, tmp_path):
    path = known_configs()[name]
    experiment, heading = experiment_of(path)
    config = fl.io.config.load_config(path, experiment.config, None)
    assert config.description == heading.description
    units = experiment.units(config)
    assert units
    assert len({u.key for u in units}) == len(units)
    assert all(u.seconds > 0 for u in units)


def test_every_experiment_has_a_config():
    assert {experiment_of(path)[0].name for path in known_configs().values()} == set(EXPERIMENTS)


@pytest.mark.parametrize(
    ("overrides", "path", "words"),
    [
        ({"point": "5"}, "point", ["unknown key", "points"]),
        ({"points": "many"}, "points", ["integer", "'many'"]),
        ({"points": "1.5"}, "points", ["integer"]),
        ({"methods.1": "noch"}, "methods[1]", ["unknown method 'noch'", *fl.METHODS]),
        ({"methods.0.filter": "true"}, "methods[0]", []),
        ({"studies.0.signal.name": "sombrero"}, "studies[0].signal.name", ["sombrero", "marschner-lobb"]),
        ({"studies.0.signal.parameters.sigmoid": "1"}, "studies[0].signal", ["sigmoid", "sigma"]),
        ({"studies.0.resolutions": "[8, 4]"}, "studies[0].resolutions", ["increasing"]),
        ({"studies.0.fit_from": "8"}, "studies[0]", ["two resolutions"]),
        ({"studies.0.extra": "1"}, "studies[0].extra", ["unknown key", "fit_from"]),
        ({"boundary": "clamp"}, "boundary", ["mirror", "zeros"]),
        ({"methods": "[notch, notch]"}, "methods", ["notch is listed twice"]),
        ({"methods.0": "{name: ncrsi, prefilter: false}"}, "methods[0]", ["no prefilter"]),
        ({"methods.0": "{name: notch, gradient: central}"}, "methods[0]", ["analytic"]),
        ({"methods.0": "{name: mitchell, scheme: sampled}"}, "methods[0]", ["direct"]),
        ({"methods.0": "{name: notch, sampler: texture_unit}"}, "methods[0]", ["sampled"]),
        ({"methods.0": "{method: notch}"}, "methods[0]", ["called name", "{name: notch"]),
        ({"device": "abacus"}, "device", ["cpu"]),
        ({"device": "meta"}, "device", ["cpu", "'meta'"]),
        ({"studies.0.signal": "{name: sphere, parameters: {radius: [.1, .2, .3]}}"}, "studies[0].signal", ["a number"]),
        ({"studies.0.signal": "{name: gaussian, parameters: {center: 1}}"}, "studies[0].signal", ["three numbers"]),
        (
            {"studies.0.signal": "{name: plane-wave, parameters: {wave_vector: [1, 2]}}"},
            "studies[0].signal",
            ["three numbers", "(1.0, 2.0)"],
        ),
        ({"studies.0.signal": "{name: gaussian, parameters: {sigma: 0}}"}, "studies[0].signal", ["sigma"]),
        ({"studies.0.signal": "{name: gaussian, parameters: {sigma: 1e-200}}"}, "studies[0].signal", ["finite"]),
        ({"experiment": "dvr_signal"}, "experiment", ["rms_error"]),
    ],
)
def test_a_mistake_is_named_with_its_path(tiny_rms, overrides, path, words, capsys):
    message = refused(tiny_rms, overrides)
    assert f": {path}" in message
    for word in words:
        assert word in message
    arguments = [word for key, value in overrides.items() for word in (f"--{key}", value)]
    assert main(["run", str(tiny_rms), *arguments, "--runs", str(tiny_rms.parent / "runs")]) == 2
    assert path in capsys.readouterr().err
    assert not (tiny_rms.parent / "runs").exists()


def test_an_unknown_experiment_or_config_lists_the_known(tmp_path):
    path = tmp_path / "odd.yaml"
    path.write_text("experiment: rms_eror\ndescription: x\n")
    assert "rms_error" in refused(path)
    assert all(name in refused("no-such-config") for name in known_configs())


def test_overrides_reach_the_config(tiny_rms):
    _, _, config = load(str(tiny_rms), {"methods.0": "tricubic", "studies.0.resolutions": "[5, 6, 7]"})
    assert config.methods[0] == Recipe(name="tricubic")
    assert config.studies[0].resolutions == [5, 6, 7]


def test_overrides_are_told_from_our_own_options():
    words = ["run", "--points", "-3", "demo", "--fresh", "--a.b=c=d", "--runs", "x"]
    assert split_overrides(words) == (["run", "demo", "--fresh", "--runs", "x"], {"points": "-3", "a.b": "c=d"})


@pytest.mark.parametrize("words", [["--points"], ["--points", "--fresh"], ["--points", "1", "--points", "2"]])
def test_an_override_needs_one_value(words, capsys):
    assert main(["run", "demo", *words]) == 2
    assert "--points" in capsys.readouterr().err


def test_a_recipe_knows_its_defaults():
    assert Recipe.model_validate("ncrsi").gradient_kind == "central"
    assert Recipe(name="triquadratic").declared_order == 3
    assert Recipe(name="triquadratic", prefilter=False).declared_order == 2


def test_what_is_in_plain_torch_is_expected_to_take_longer():
    """A spline on tetrahedra has no fused march, unless its method says so."""
    method = fl.METHODS["qss"]
    assert Recipe(name="qss").first_scheme == method.schemes[0]
    assert Recipe(name="notch").first_scheme == "fused"
    assert Recipe(name="notch", scheme="direct").first_scheme == "direct"
    _, experiment, config = load("tetrahedral_dvr")
    seconds = {unit.key: unit.seconds for unit in experiment.units(config)}
    assert (seconds["qss"] > 5 * seconds["notch"]) == ("fused" not in method.schemes)


def test_the_sampled_scheme_says_which_gradient_it_gives():
    with pytest.raises(ValueError, match="central"):
        Recipe(name="trilinear", scheme="sampled")
    sampled = Recipe(name="trilinear", gradient="central", scheme="sampled")
    assert (sampled.gradient_kind, Recipe(name="ncrsi", scheme="sampled").gradient_kind) == ("central",) * 2
    for name, key in (
        ("texture_precision", "methods"),
        ("texture_precision", "image_methods"),
        ("demo", "sections.4.methods"),
    ):
        with pytest.raises(ConfigError, match="gradient='central'"):
            load(name, {key: "[trilinear]"})
    with pytest.raises(ConfigError, match="leave them out"):
        load("texture_precision", {"methods": "[{name: notch, scheme: sampled}]"})


def test_seed_and_device_hold_for_sections_without_their_own():
    _, _, config = load("demo", {"seed": "7", "sections.3.seed": "0"})
    assert [part.seed for part in config.sections] == [7, 7, 7, 0, 7, 7]
    again = loads_config(dump_config(config), type(config))
    assert again == config
    assert dump_config(again) == dump_config(config)
    sections = loads_config(dump_config(config), type(config), {"device": "meta"}).sections
    assert {part.device for part in sections} == {"cpu"}  # written out: their own


def test_the_device_reaches_every_section():
    text = "experiment: demo\ndescription: d\ndevice: meta\nsections:\n"
    section = "  - {experiment: frequency_response, description: d, methods: [notch]%s}\n"
    demo = loads_config(text + section % "" + section % ", device: cpu", EXPERIMENTS["demo"].config)
    assert [part.device for part in demo.sections] == ["meta", "cpu"]


@pytest.mark.parametrize("device", ["meta", "cuda:97", "abacus"])
def test_the_device_of_every_section_is_checked(device, tmp_path, capsys):
    runs = tmp_path / "runs"
    assert main(["run", "demo", "--sections.2.device", device, "--runs", str(runs)]) == 2
    message = capsys.readouterr().err
    assert "sections[2].device: expected a device that torch can compute on here" in message
    assert len(message.splitlines()) == 1
    assert not runs.exists()


def test_threads_are_for_the_whole_run():
    with pytest.raises(ConfigError, match="section 1 sets 3"):
        load("demo", {"sections.1.threads": "3"})


def test_without_configs_the_command_says_where_it_looked(tmp_path, monkeypatch, capsys, tiny_rms):
    monkeypatch.setattr(known_configs, "__defaults__", (tmp_path / "gone",))
    for words in (["list"], ["run", "demo"]):
        assert main(words) == 2
        out, err = capsys.readouterr()
        assert not out
        assert str(tmp_path / "gone") in err
    assert load(str(tiny_rms))[0] == "tiny"  # a file by its path needs none


def test_volume_files_are_found_by_name(tmp_path, monkeypatch):
    (tmp_path / "scan.nrrd").write_bytes(b"x")
    monkeypatch.setenv("FILTERLAB_VOLUMES", str(tmp_path))
    assert find_volume("scan.nrrd") == tmp_path / "scan.nrrd"
    assert find_volume("pydantic:main.py").is_file()
    with pytest.raises(ValueError, match=r"found none at .*other\.nrrd"):
        find_volume("other.nrrd")
    with pytest.raises(ValueError, match=r"no 'scan\.nrrd'"):
        find_volume("pydantic:scan.nrrd")
    with pytest.raises(ValueError, match="pip install nonesuch"):
        find_volume("nonesuch:scan.nrrd")
