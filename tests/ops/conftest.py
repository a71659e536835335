"""Compiled kernels of a test run go to a folder of its own, never to the user's cache."""

from __future__ import annotations

import os

import pytest


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory):
    before = os.environ.get("FILTERLAB_CACHE")
    os.environ["FILTERLAB_CACHE"] = str(tmp_path_factory.mktemp("kernels"))
    yield
    if before is None:
        del os.environ["FILTERLAB_CACHE"]
    else:
        os.environ["FILTERLAB_CACHE"] = before
