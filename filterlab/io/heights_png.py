"""Heights in a PNG of 16 bits (or 8), as tools for games and printers have them.

The numbers are the heights, unless a small file `NAME.png.yaml` beside it says what they mean and where they lie.
Without one, samples are 1 apart and rows go down.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from filterlab.heights import Heights
from filterlab.io.bounded import EXPANSION, VolumeFileError, check_size
from filterlab.io.heights_header import HeightsHeader, band_of, blocks_of_rows

if TYPE_CHECKING:
    from filterlab.io.heights_sidecar import HeightsSidecar

MOST = 2**16 - 1
MAX_PIXELS = 178_956_970  # beyond that Pillow opens none
_MODES = {"I;16": "uint16", "L": "uint8"}


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The picture, not yet read; what Pillow makes of damage becomes VolumeFileError."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=["PNG"]) as picture:
                yield picture
    except VolumeFileError:
        raise
    except (Image.DecompressionBombError, SyntaxError, ValueError, OSError) as error:
        raise VolumeFileError(path, "an intact PNG picture", f"{type(error).__name__}: {error}"[:200]) from None


def read_header(path: Path) -> HeightsHeader:
    """The checked header of a picture and of its sidecar. Raises VolumeFileError."""
    from filterlab.io.heights_sidecar import read_sidecar, sidecar_of

    with _opened(path) as picture:
        columns, rows = picture.size
        check_size(path, (rows, columns))
        stored = _MODES.get(picture.mode)
    if stored is None:
        raise VolumeFileError(path, "heights as grey levels of 16 bits (or 8)", f"a picture of mode {picture.mode}")
    claimed, there = rows * columns * np.dtype(stored).itemsize, path.stat().st_size
    if claimed > EXPANSION["deflate"] * there:
        raise VolumeFileError(path, f"{claimed} bytes of heights", f"a file of {there} bytes, which cannot hold that")
    sidecar = read_sidecar(path, (rows, columns))
    place: dict[str, Any] = sidecar.place | ({} if sidecar_of(path).exists() else {"spacing": (1.0, -1.0)})
    return HeightsHeader(
        path,
        "PNG",
        (rows, columns),
        stored,
        **place,
        encoding="deflate",
        fields=_fields(sidecar),
        _read=lambda samples: _read(path, sidecar, samples),
    )


def _fields(sidecar: HeightsSidecar) -> dict[str, str]:
    fields = {} if sidecar.missing is None else {"no data": str(sidecar.missing)}
    if (sidecar.scale, sidecar.offset) != (1.0, 0.0):
        fields["scaling"] = f"{sidecar.scale:g} · number + {sidecar.offset:g}"
    return fields


def _read(path: Path, sidecar: HeightsSidecar, samples: np.ndarray) -> None:
    with _opened(path) as picture:
        stored = np.asarray(picture)
    for rows in blocks_of_rows(samples.shape):  # type: ignore[arg-type]
        missing = None if sidecar.missing is None else stored[rows] == sidecar.missing
        band_of(samples, rows, stored[rows], missing, (sidecar.scale, sidecar.offset))


def write(heights: Heights, path: Path, stored: str | None, final: Path) -> None:
    """In 65,535 steps from the lowest to the highest, of 1 where heights are whole numbers; 0 where there is none.

    Raises VolumeFileError: another type, or no height at all.
    """
    from PIL import Image

    if stored not in (None, "uint16"):
        raise VolumeFileError(path, "uint16 in a PNG", stored)
    samples, missing = heights.samples, heights.missing
    if missing.all():
        raise VolumeFileError(path, "at least one height", "none")
    if math.prod(samples.shape) > MAX_PIXELS:
        raise VolumeFileError(path, f"at most {MAX_PIXELS} heights in a PNG", math.prod(samples.shape))
    scale, offset = _steps(samples[~missing])
    numbers = np.where(missing, 0, np.rint((samples.astype(np.float64) - offset) / scale)).astype(np.uint16)
    from filterlab.io.heights_sidecar import HeightsSidecar, write_sidecar

    write_sidecar(final, HeightsSidecar.of(heights, scale=scale, offset=offset, missing=0))
    Image.fromarray(numbers).save(path, format="PNG")


def _steps(samples: np.ndarray) -> tuple[float, float]:
    """scale and offset with which heights are the numbers from 1 on."""
    low, high = float(samples.min()), float(samples.max())
    if high - low < MOST and (samples == np.rint(samples)).all():
        return 1.0, low - 1
    scale = (high - low) / (MOST - 1) or 1.0
    return scale, low - scale
