"""filterlab: sampled volumes as continuous functions, in PyTorch.

signal ─┐
        ├─▶ Volume ──prefilter──▶ coefficients ──scheme / op──▶ Field ──rays──▶ image ──▶ records ──▶ report
file  ──┘            └────────────── a Method ─────────────┘     value, gradient
"""

from importlib.metadata import version

from filterlab import io, kernels, metrics, prefilters, render, signals, spectrum
from filterlab.fields.base import Field
from filterlab.io import load_volume, save_volume
from filterlab.kernels import KERNELS
from filterlab.methods import METHODS, Method, reconstruct
from filterlab.prefilters import PREFILTERS
from filterlab.resampling import resample
from filterlab.volume import Boundary, Volume, from_grid_sample, from_zyx

__version__ = version("filterlab")

__all__ = [
    "KERNELS",
    "METHODS",
    "PREFILTERS",
    "Boundary",
    "Field",
    "Method",
    "Volume",
    "from_grid_sample",
    "from_zyx",
    "io",
    "kernels",
    "load_volume",
    "metrics",
    "prefilters",
    "reconstruct",
    "render",
    "resample",
    "save_volume",
    "signals",
    "spectrum",
]
