"""What a file of heights says of itself, checked, before the heights are read.

A file is untrusted input, as in `filterlab.io.bounded`: what it claims is compared with its length, where that tells
anything, and with the caller's `max_bytes`, before memory of that size is asked for.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from filterlab.heights import DEGREE, Heights, metres_per_degree
from filterlab.io.bounded import VolumeFileError, sample_dtype
from filterlab.io.warned import VolumeFileWarning

AT_ONCE = 2**21  # samples that are turned from how they are stored into heights
MAX_TEXT = 10_000  # of a coordinate reference system, as WKT

Pair = tuple[float, float]


@dataclass(frozen=True)
class HeightsHeader:
    """What a file of heights says about itself.

    Attributes:
        path: the file.
        format: "GeoTIFF", "npy", "npz", "PNG", …
        shape: (H, W).
        stored: the type in the file, a NumPy name: "int16".
        spacing, origin, unit, height_unit, crs, crs_name: as those of `Heights`.
        encoding: "raw", "deflate", … as the format calls it.
        fields: what else it says, for people.
    """

    path: Path
    format: str
    shape: tuple[int, int]
    stored: str
    spacing: Pair = (1.0, 1.0)
    origin: Pair = (0.0, 0.0)
    unit: str | None = None
    height_unit: str | None = None
    crs: str | None = None
    crs_name: str | None = None
    encoding: str = "raw"
    fields: dict[str, str] = field(default_factory=dict)
    _read: Callable[[np.ndarray], None] | None = field(default=None, repr=False, compare=False)

    @property
    def dtype(self) -> np.dtype:
        """Of the heights: float32 holds integers of 16 bits, what is longer needs float64."""
        stored = np.dtype(self.stored)
        return np.dtype("float64" if stored.itemsize > (4 if stored.kind == "f" else 2) else "float32")

    @property
    def nbytes(self) -> int:
        """Bytes of the heights in memory."""
        return math.prod(self.shape) * self.dtype.itemsize

    def read(self, max_bytes: int) -> Heights:
        """The heights. Raises VolumeFileError if they need more than `max_bytes`, or the file is damaged."""
        if self.nbytes > max_bytes:
            raise VolumeFileError(self.path, f"at most {max_bytes} bytes of heights (max_bytes)", self.nbytes)
        assert self._read is not None
        samples = np.empty(self.shape, self.dtype)  # memory is given by the system as it is written to
        self._read(samples)
        told = (self.unit, self.height_unit, self.crs, self.crs_name)
        heights = Heights(samples, self.spacing, self.origin, *told, name=self.path.stem)
        self._warn(heights)
        return heights

    def _warn(self, heights: Heights) -> None:
        """Tells of degrees, whose slopes are nothing that anyone means."""
        if heights.unit == DEGREE:
            _, bottom, _, top = heights.extent
            across, along = metres_per_degree(min(max((bottom + top) / 2, -90), 90))
            told = f"a degree is {across:.0f} m along x and {along:.0f} m along y in its middle"
            tell_degrees(self.path, f"x and y are degrees ({told})", "in_metres() makes them metres")
        elif heights.looks_like_degrees:
            told = "x and y look like degrees, though nothing is declared"
            tell_degrees(self.path, told, "replace(heights, unit='degree') declares them")


class DegreesWarning(VolumeFileWarning):
    """That x and y are degrees, or seem to be; and what to do about it in Python."""

    def __init__(self, told: str, remedy: str) -> None:
        super().__init__(f"{told}: {remedy}")
        self.told = told

    @property
    def on_command_line(self) -> str:
        return self.told


def tell_degrees(path: Path, told: str, remedy: str) -> None:
    """Warns of them."""
    warnings.warn(DegreesWarning(f"{path}: {told}", remedy), stacklevel=2)


def band_of(samples: np.ndarray, rows: slice, stored: np.ndarray, missing: np.ndarray | None, scaling: Pair) -> None:
    """Rows of heights, of numbers as they are stored: slope · number + intercept, NaN where missing or not finite."""
    slope, intercept = scaling
    if scaling != (1.0, 0.0):
        stored = stored.astype(np.float64) * slope + intercept
    target = samples[rows]
    with np.errstate(over="ignore", invalid="ignore"):
        target[...] = stored
    if missing is not None:
        target[missing] = np.nan
    if stored.dtype.kind == "f":
        target[~np.isfinite(target)] = np.nan


def blocks_of_rows(shape: tuple[int, int], multiple: int = 1) -> list[slice]:
    """All rows of (H, W), `AT_ONCE` samples or so at a time, in multiples of so many rows."""
    rows, columns = shape
    step = max(AT_ONCE // columns // multiple, 1) * multiple
    return [slice(first, min(first + step, rows)) for first in range(0, rows, step)]


def check_stored(path: Path, dtype: np.dtype) -> np.dtype:
    """The type in the file. Raises VolumeFileError for what no height is: objects, records, complex numbers, …"""
    sample_dtype(path, dtype)
    return dtype


def check_place(path: Path, spacing: Pair, origin: Pair) -> None:
    """Raises VolumeFileError unless samples stand apart, at finite places."""
    numbers = (*spacing, *origin)
    if not all(math.isfinite(v) and abs(v) < 1e60 for v in numbers) or min(map(abs, spacing)) < 1e-60:
        raise VolumeFileError(path, "a finite origin and a spacing other than 0", f"{origin} and {spacing}")
