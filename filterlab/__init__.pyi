from . import costs, io, kernels, metrics, nn, prefilters, render, signals, spectrum
from .fields.base import Field
from .heights import Heights
from .io.heights import load_heights, save_heights
from .io.volumes import load_volume, save_volume
from .kernels import KERNELS
from .methods import METHODS, Method, reconstruct
from .prefilters import PREFILTERS
from .recommendation import Recommendation, recommend
from .resampling import resample
from .volume import Boundary, Volume, from_grid_sample, from_zyx

__version__: str

__all__ = [
    "KERNELS",
    "METHODS",
    "PREFILTERS",
    "Boundary",
    "Field",
    "Heights",
    "Method",
    "Recommendation",
    "Volume",
    "costs",
    "from_grid_sample",
    "from_zyx",
    "io",
    "kernels",
    "load_heights",
    "load_volume",
    "metrics",
    "nn",
    "prefilters",
    "recommend",
    "reconstruct",
    "render",
    "resample",
    "save_heights",
    "save_volume",
    "signals",
    "spectrum",
]
