"""Heights on a grid over the plane, as elevation models give them, and where in the world that grid lies.

Letters: sample (i, j) in row i and column j stands at x = x₀ + j Δx, y = y₀ + i Δy. Files count rows from the north, so
that Δy is negative in most of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

METRE, DEGREE = "metre", "degree"
METRES = {METRE: 1.0, "kilometre": 1000.0, "foot": 0.3048, "US survey foot": 1200 / 3937}
"""Units of length, in metres."""

_SEMI_MAJOR, _FLATTENING = 6378137.0, 1 / 298.257223563


def metres_per_degree(latitude: float) -> tuple[float, float]:
    """Metres that a degree of longitude and of latitude are long, on the ellipsoid WGS 84.

    N cos φ π/180 and M π/180,   N = a / √(1 − e² sin² φ),  M = a (1 − e²) / (1 − e² sin² φ)^(3/2)

    Args:
        latitude: φ in degrees.

    Source: Snyder, Map projections: a working manual, 1987, equations 4-18 to 4-20.
    """
    phi, square = math.radians(latitude), _FLATTENING * (2 - _FLATTENING)
    w = 1 - square * math.sin(phi) ** 2
    across = _SEMI_MAJOR / math.sqrt(w) * math.cos(phi)
    along = _SEMI_MAJOR * (1 - square) / w**1.5
    return math.radians(across), math.radians(along)


@dataclass(frozen=True, eq=False)
class Heights:
    """Samples of a height over a grid, and what a file says of them.

    Attributes:
        samples: (H, W), float32 or float64; NaN where there is none.
        spacing: (Δx, Δy), world units from sample to sample along a row and from row to row; either may be negative.
        origin: (x₀, y₀), where samples[0, 0] stands.
        unit: of x and y: "metre", "degree", or another length by its name; None: not declared.
        height_unit: of the samples; None: not declared.
        crs: the coordinate reference system: "EPSG:32718", or its WKT; None: not declared.
        crs_name: what people call it.
        name: of the whole.

    Raises:
        ValueError: samples that are no (H, W) floats, a spacing of 0, numbers that are not finite.
    """

    samples: np.ndarray = field(repr=False)
    spacing: tuple[float, float] = (1.0, 1.0)
    origin: tuple[float, float] = (0.0, 0.0)
    unit: str | None = None
    height_unit: str | None = None
    crs: str | None = field(default=None, repr=False)
    crs_name: str | None = None
    name: str = ""

    def __post_init__(self) -> None:
        s = self.samples
        if not isinstance(s, np.ndarray) or s.ndim != 2 or 0 in s.shape or s.dtype.name not in ("float32", "float64"):
            got = f"{s.dtype} {s.shape}" if isinstance(s, np.ndarray) else type(s).__name__
            raise ValueError(f"samples must be a NumPy array (H, W) of float32 or float64; got {got}")
        for what, pair in (("spacing", self.spacing), ("origin", self.origin)):
            check_pair(what, pair)
        if 0 in self.spacing:
            raise ValueError(f"spacing must not be 0; got {self.spacing}")

    @property
    def size(self) -> tuple[int, int]:
        """Samples along x and y."""
        rows, columns = self.samples.shape
        return columns, rows

    @property
    def missing(self) -> np.ndarray:
        """(H, W) bool: where there is no height."""
        return np.isnan(self.samples)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """(left, bottom, right, top): from the first sample to the last along each axis."""
        ends = [(o, o + (n - 1) * s) for o, n, s in zip(self.origin, self.size, self.spacing, strict=True)]
        (left, right), (bottom, top) = (sorted(pair) for pair in ends)
        return left, bottom, right, top

    @property
    def upward(self) -> Heights:
        """The same with both spacings positive: rows from the south, columns from the west; copied where turned."""
        dx, dy = self.spacing
        if dx > 0 and dy > 0:
            return self
        left, bottom, _, _ = self.extent
        samples = np.ascontiguousarray(self.samples[:: -1 if dy < 0 else 1, :: -1 if dx < 0 else 1])
        return replace(self, samples=samples, spacing=(abs(dx), abs(dy)), origin=(left, bottom))

    @property
    def looks_like_degrees(self) -> bool:
        """Whether nothing is declared, and the numbers are those of longitudes, latitudes and metres.

        All of x and y lie on the globe, less than ½ apart, and the heights vary by more than the whole extent is wide.
        """
        left, bottom, right, top = self.extent
        if self.unit is not None or max(-left, right) > 360 or max(-bottom, top) > 90:
            return False
        if self.missing.all() or max(abs(s) for s in self.spacing) >= 0.5:
            return False
        relief = float(np.nanmax(self.samples) - np.nanmin(self.samples))
        return relief > max(right - left, top - bottom)

    @property
    def height_in_metres(self) -> float:
        """How many metres the unit of the samples is; 1 where none is declared. Raises ValueError: one not known."""
        return _metres(self.height_unit)

    def in_metres(self) -> Heights:
        """The same with x, y and heights in metres.

        Degrees become metres along the parallel and the meridian through the middle: a plane that touches the globe
        there. Over an extent of 1° lengths along x are off by up to 0.9 % at 45° of latitude. An undeclared unit is
        taken as it is.

        Raises:
            ValueError: a unit that is not known; degrees beyond a pole.
        """
        if self.unit == DEGREE:
            _, bottom, _, top = self.extent
            middle = (bottom + top) / 2
            if not -90 < middle < 90:
                raise ValueError(f"expected latitudes between −90° and 90°; got {bottom:g} to {top:g}")
            factors = metres_per_degree(middle)
        else:
            factors = (_metres(self.unit),) * 2
        upward = self.height_in_metres
        moved = replace(
            self,
            spacing=tuple(s * f for s, f in zip(self.spacing, factors, strict=True)),
            origin=tuple(o * f for o, f in zip(self.origin, factors, strict=True)),
            unit=METRE if self.unit else None,
            height_unit=METRE if self.height_unit else None,
            crs=self.crs if factors == (1.0, 1.0) else None,
            crs_name=self.crs_name if factors == (1.0, 1.0) else None,
        )
        return moved if upward == 1.0 else replace(moved, samples=self.samples * self.samples.dtype.type(upward))


def check_pair(what: str, pair: Sequence[float]) -> None:
    """Raises ValueError unless it is two finite numbers."""
    if len(pair) != 2 or not all(math.isfinite(v) for v in pair):
        raise ValueError(f"{what} must be two finite numbers along x and y; got {pair}")


def _metres(unit: str | None) -> float:
    if unit is not None and unit not in METRES:
        raise ValueError(f"expected a unit among {', '.join(METRES)}, {DEGREE}; got {unit!r}")
    return 1.0 if unit is None else METRES[unit]
