"""Experiments of terrains: equal errors are equal, smoother splines have better normals, descent finds the surface."""

import math

import pytest
import torch

from experiments import inverse_terrain, terrain_quality
from experiments.registry import EXPERIMENTS
from experiments.runs import Run, Unit
from experiments.terrain_error import franke, sampled
from filterlab.io.config import ConfigError


@pytest.fixture
def run(tmp_path):
    (tmp_path / "files").mkdir()
    return Run(tmp_path, {})


def quality(**changes):
    content = {
        "experiment": "terrain_quality",
        "description": "x",
        "splines": ["linear", "c0", "c1", "c2"],
        "points": 2000,
    }
    return terrain_quality.Config.model_validate({**content, "size": [40, 30], "subpixels": 1, **changes})


def test_equal_errors_are_the_fewest_that_do(run):
    config = quality(reference={"spline": "linear", "steps": 30})
    goal = terrain_quality._rms(sampled(franke, "linear", 30), terrain_quality._truth(config, run))
    for kind, cell in (("linear", 1), ("c0", 4), ("c1", 3), ("c2", 1)):
        found = terrain_quality._enough(config, kind, run)
        steps = found["steps"]
        assert found["reached"]
        assert steps % cell == 0
        for n, below in ((steps, True), (steps - cell, False)):
            rms = terrain_quality._rms(sampled(franke, kind, n), terrain_quality._truth(config, run)) if n else math.inf
            assert (rms <= goal * (1 + 1e-9)) == below
    assert terrain_quality._enough(config, "linear", run)["steps"] == 30


def test_normals_are_nearer_to_the_function_s_where_splines_are_smoother(run):
    """Of the same 12 × 12 steps; the function itself has them."""
    config = quality()
    found = {}
    for group, kind in (("function", "function"), ("same", "linear"), ("same", "c1")):
        unit = Unit(f"{group}/{kind}/normals", "")
        found[kind] = terrain_quality.compute(config, unit, run)["angle_mean"]
    assert found["function"] < 1e-4
    assert found["c1"] < 0.5 * found["linear"]


def test_descent_finds_the_surface_by_depths_and_shades(run):
    """From half of the relief everywhere to a fifth of where it began."""
    weights = {"both": {}}
    content = {
        "experiment": "inverse_terrain",
        "description": "x",
        "samples": 10,
        "weights": weights,
        "record_every": 30,
    }
    views, descent = {"count": 2, "size": 16, "shown": 8}, {"iterations": 30, "learning_rate": 0.1}
    config = inverse_terrain.Config.model_validate({**content, "views": views, "descent": descent})
    record = inverse_terrain.compute(config, inverse_terrain.units(config)[0], run)
    first, last = (record["observations"][k] for k in (0, -1))
    assert last["height_rms"] < 0.2 * first["height_rms"]
    assert last["depth_rms"] < 0.2 * first["depth_rms"]
    assert last["shade_rms"] < 0.4 * first["shade_rms"]
    with pytest.raises(ValueError, match="a weight above 0 of depth, of shade, or of both"):
        inverse_terrain.Weights(depth=0, shade=0)


def test_the_patches_of_a_cell_of_c1_depend_on_five_combinations_of_its_nine_data():
    """As the report of `inverse_terrain` says; on 4 × 4 cells of a periodic grid, by the rank of the map."""
    from filterlab.surfaces import HeightField

    cells = torch.cartesian_prod(torch.arange(4), torch.arange(4))
    unit = torch.eye(144, dtype=torch.float64).reshape(144, 12, 12)  # a grid for every datum that is 1
    patches = HeightField(unit, "c1", boundary="wrap").patches(cells)
    assert int(torch.linalg.matrix_rank(patches.reshape(144, -1))) == 5 * 16


def test_files_that_hold_no_heights_are_refused(tmp_path):
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    experiment = EXPERIMENTS["terrain_views"]
    place = {"title": "bad", "heights": str(tmp_path / "bad.npz"), "views": [{"title": "x"}]}
    config = experiment.config.model_validate({"experiment": "terrain_views", "description": "x", "places": [place]})
    with pytest.raises(ConfigError, match=r"places\[0\].heights: .*an intact npz archive"):
        experiment.check(config, "")
