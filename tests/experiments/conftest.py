"""Tiny configs, written to files, and the command run in a process of its own."""

import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[2]

TINY_RMS = """
experiment: rms_error
description: a tiny one
seed: 3
studies:
  - {signal: {name: gaussian, parameters: {sigma: 0.5}}, resolutions: [4, 8], fit_from: 4}
methods: [trilinear, notch, {name: notch, prefilter: false}]
points: 50
"""


@pytest.fixture
def tiny_rms(tmp_path):
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY_RMS)
    return path


@pytest.fixture
def command():
    """The `python -m experiments` process: arguments -> subprocess.Popen keywords -> Popen."""

    def start(*arguments, code=None, **options):
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        words = [sys.executable, "-c", code] if code else [sys.executable, "-m", "experiments"]
        return subprocess.Popen(
            [*words, *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=ROOT,
            **options,
        )

    return start


@contextmanager
def figures_left_empty():
    """Figures of reports stay empty: it takes half a second to write one, and there are tests of what is said alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda _, file, **__: file.write("<svg></svg>"))
        yield


@pytest.fixture
def undrawn():
    with figures_left_empty():
        yield
