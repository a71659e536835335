"""For every test: one thread (the arrays are small), fixed seeds, and nothing written outside temporary folders."""

from __future__ import annotations

import gc
import locale
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from hypothesis import settings

from tests.forks import forks as forks

with warnings.catch_warnings():  # torch's own forward mode compiles these with a deprecated call, once, at first use
    warnings.simplefilter("ignore", DeprecationWarning)
    import torch._decomp.decompositions_for_jvp

torch.set_num_threads(1)
settings.register_profile("tests", derandomize=True, database=None, deadline=None)
settings.load_profile("tests")

_BY_A_WORKER = "PYTEST_XDIST_WORKER" in os.environ


def pytest_configure(config: pytest.Config) -> None:
    """Compiled programs go to a folder of this run, which its workers and the processes of its tests share.

    Python does not search for cycles among what is imported and collected, which is there to stay.
    """
    gc.disable()
    if not _BY_A_WORKER:
        os.environ["FILTERLAB_CACHE"] = tempfile.mkdtemp(prefix="filterlab-tests-")


def pytest_collection_finish() -> None:
    """Half a million objects are there to stay, and what tests import too: to walk them all takes 0.2 to 0.4 s.

    Programs and graphs of derivatives are ten thousands of objects each, which are looked through once, not again and
    again while they grow: 1.7 % of the time of tests.
    """
    gc.freeze()
    gc.enable()
    gc.set_threshold(20_000, 10, 10)


def pytest_unconfigure(config: pytest.Config) -> None:
    if not _BY_A_WORKER:
        shutil.rmtree(os.environ.pop("FILTERLAB_CACHE", ""), ignore_errors=True)


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """`torch.manual_seed` writes down for a GPU that is not in use who asked, in 2 ms and for ever."""
    torch.default_generator.manual_seed(0)
    if torch.cuda.is_initialized():
        torch.cuda.manual_seed_all(0)


@pytest.fixture(autouse=True)
def _locale_kept() -> Iterator[None]:
    """ITK, asked by a test itself, leaves the locale "C" behind: torch's compiler then can't read its own files."""
    before = locale.setlocale(locale.LC_ALL)
    yield
    locale.setlocale(locale.LC_ALL, before)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20230517)
