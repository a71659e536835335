"""Where Triton programs run."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.ops.interpreter import hasten


@pytest.fixture(params=["interpreter", "gpu"])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory):
    """Where rays are marched; programs run in Triton's interpreter for tensors of the CPU."""
    if request.param == "gpu" and not torch.cuda.is_available():
        pytest.skip("no GPU that torch can use")
    monkeypatch.setenv("TRITON_INTERPRET", str(int(request.param == "interpreter")))
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path_factory.getbasetemp() / "triton"))
    if request.param == "interpreter":
        hasten(monkeypatch)
    with np.errstate(all="ignore"):
        yield "cpu" if request.param == "interpreter" else "cuda"


@pytest.fixture
def compiling(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    """The interpreter takes what the compiler would refuse; machine code needs no GPU to be made."""
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
