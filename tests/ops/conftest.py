"""Compiled kernels of a test run go to a folder of its own, never to the user's cache; where Triton programs run."""

from __future__ import annotations

import os

import numpy as np
import pytest
import torch


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory):
    before = os.environ.get("FILTERLAB_CACHE")
    os.environ["FILTERLAB_CACHE"] = str(tmp_path_factory.mktemp("kernels"))
    yield
    if before is None:
        del os.environ["FILTERLAB_CACHE"]
    else:
        os.environ["FILTERLAB_CACHE"] = before


@pytest.fixture(params=["interpreter", "gpu"])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory):
    """Where rays are marched; programs run in Triton's interpreter for tensors of the CPU."""
    if request.param == "gpu" and not torch.cuda.is_available():
        pytest.skip("no GPU that torch can use")
    monkeypatch.setenv("TRITON_INTERPRET", str(int(request.param == "interpreter")))
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path_factory.getbasetemp() / "triton"))
    with np.errstate(all="ignore"):
        yield "cpu" if request.param == "interpreter" else "cuda"
