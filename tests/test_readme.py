"""The README's Python runs as it is printed, and its commands exist."""

import re
from pathlib import Path

import numpy as np
import torch

import filterlab as fl
from filterlab.cli import main

README = Path(__file__).parents[1] / "README.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


def test_the_python_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fl.save_volume(fl.Volume((255 * torch.rand(8, 9, 10)).to(torch.uint8)), "engine.nrrd")
    fl.save_heights(
        fl.Heights(300 + 90 * np.random.default_rng(1).random((8, 9), np.float32), (30.0, -30.0)), "dem.tif"
    )
    names = {"points": torch.rand(5, 3) * 7, "matrix": torch.eye(4)}
    code = "\n".join(blocks("python")).replace("(512, 512)", "(16, 16)")
    exec(compile(code, str(README), "exec"), names)
    assert names["v"].shape == (5,)
    assert names["h"].shape == (5, 3, 3)
    assert names["samples"].grad.shape == (32, 32, 32)
    assert Path("engine.png").stat().st_size > 0


def test_the_commands_of_the_readme_exist(capsys):
    for command in sorted(set(re.findall(r"^    filterlab (\w+)", README.read_text(encoding="utf-8"), re.MULTILINE))):
        assert main([command, "--help"]) == 0
    assert "usage: filterlab" in capsys.readouterr().out
