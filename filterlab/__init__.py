"""filterlab: sampled volumes as continuous functions, in PyTorch.

    signal ─┐
            ├─▶ Volume ──prefilter──▶ coefficients ──scheme / op──▶ Field ──rays──▶ image ──▶ records ──▶ report
    file  ──┘            └────────────── a Method ─────────────┘     value, gradient
"""

from filterlab import kernels, prefilters, signals
from filterlab.fields.base import Field
from filterlab.kernels import KERNELS
from filterlab.methods import METHODS, Method, reconstruct
from filterlab.prefilters import PREFILTERS
from filterlab.volume import Boundary, Volume, from_grid_sample, from_zyx

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
    "kernels",
    "prefilters",
    "reconstruct",
    "signals",
]
