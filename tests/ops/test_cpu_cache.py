"""Kernels kept on disk: found again, never trusted blindly, no obstacle where nothing can be written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from filterlab import ops
from filterlab.kernels import bspline
from filterlab.ops.cpu import cache, compiler

PROGRAM = """
import torch
from filterlab import ops
from filterlab.kernels import bspline
c = torch.arange(512.0).sin().reshape(1, 1, 8, 8, 8)
p = torch.linspace(2, 5, 30).reshape(1, 10, 3)
print(ops.jet(c, p, bspline(2), 1, implementation="cpu").double().sum().item())
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """An empty cache, nothing in memory; afterwards as before."""
    monkeypatch.setenv("FILTERLAB_CACHE", str(tmp_path / "kernels"))
    compiler._compiled.cache_clear()
    yield tmp_path / "kernels"
    compiler._compiled.cache_clear()


@pytest.fixture
def compilations(monkeypatch: pytest.MonkeyPatch) -> list:
    done: list = []
    compile = compiler._compile
    monkeypatch.setattr(compiler, "_compile", lambda recipe: (done.append(recipe), compile(recipe))[1])
    return done


def evaluate() -> None:
    """Evaluates as a fresh process would, and compares with the reference."""
    compiler._compiled.cache_clear()
    coefficients, points = torch.randn(1, 1, 4, 4, 4), torch.rand(1, 5, 3) * 3
    expected = ops.jet(coefficients, points, (bspline(2),) * 3, 0)
    assert torch.allclose(ops.jet(coefficients, points, bspline(2), 0, implementation="cpu"), expected, atol=1e-5)


def test_is_compiled_once_and_found_again(folder: Path, compilations: list) -> None:
    evaluate()
    evaluate()
    assert len(compilations) == 1
    (file,) = folder.iterdir()
    assert file.suffix == ".o"


@pytest.mark.parametrize(
    "damage",
    [
        lambda b: b"",
        lambda b: b[:20],
        lambda b: b[:-1],
        lambda b: b[:100] + bytes([b[100] ^ 1]) + b[101:],
        lambda b: b + b"0",
    ],
    ids=["empty", "cut within the checksum", "cut", "one bit", "longer"],
)
def test_a_damaged_file_is_rebuilt(folder: Path, compilations: list, damage) -> None:
    evaluate()
    (file,) = folder.iterdir()
    good = file.read_bytes()
    file.write_bytes(damage(good))
    evaluate()
    assert len(compilations) == 2
    assert cache.read(file.name) is not None
    evaluate()
    assert len(compilations) == 2


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_another_users_file_is_not_run(folder: Path, compilations: list, monkeypatch: pytest.MonkeyPatch) -> None:
    evaluate()
    (file,) = folder.iterdir()
    if os.getuid() == 0:
        os.chown(file, 12345, -1)
    else:
        other = os.getuid() + 1
        monkeypatch.setattr(os, "getuid", lambda: other)
    assert cache.read(file.name) is None


def test_works_where_nothing_can_be_written(tmp_path: Path, compilations: list, monkeypatch) -> None:
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("FILTERLAB_CACHE", str(tmp_path / "file" / "kernels"))
    evaluate()
    assert len(compilations) == 1
    assert (tmp_path / "file").read_text() == "not a folder"
    monkeypatch.setattr(cache, "folder", lambda: None)
    evaluate()
    assert len(compilations) == 2


def test_a_failed_write_leaves_nothing_behind(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", refuse)
    evaluate()
    assert list(folder.iterdir()) == []


def test_the_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("FILTERLAB_CACHE", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.folder() == tmp_path / "filterlab" / "kernels"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache.folder() == tmp_path / ".cache" / "filterlab" / "kernels"

    def homeless() -> Path:
        raise RuntimeError("no home")

    monkeypatch.setattr(Path, "home", homeless)
    assert cache.folder() is None


def test_the_name_depends_on_all_that_the_code_depends_on(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    evaluate()
    for surroundings in (("other source",), ("other LLVM",)):
        monkeypatch.setattr(compiler, "_surroundings", lambda s=surroundings: s)
        evaluate()
    assert len(list(folder.iterdir())) == 3


def test_two_processes_at_once(folder: Path) -> None:
    command = [sys.executable, "-c", PROGRAM]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    (first, errors), (second, other_errors) = (process.communicate() for process in both)
    assert [process.returncode for process in both] == [0, 0], errors + other_errors
    assert first == second != ""
    assert [file.suffix for file in folder.iterdir()] == [".o"]
