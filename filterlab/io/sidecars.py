"""Small files beside samples that say what these are and where they lie: of `.npy` and of raw samples.

They are checked by pydantic, which takes as long to import as a small volume to read: only what reads one imports this.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeVar

import numpy as np
from pydantic import Field, model_validator

from filterlab.io.bounded import SAMPLE_TYPES, VolumeFileError, regular_file
from filterlab.io.config import ConfigError, StrictModel, load_config
from filterlab.names import unknown_name

MAX_BYTES = 2**14  # it is read before anyone trusts it
Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0)]
Row = tuple[float, float, float, float]
Sidecar = TypeVar("Sidecar", bound=StrictModel)


def load_sidecar(path: Path, model: type[Sidecar], what: str) -> Sidecar:
    """The sidecar at a path. Raises VolumeFileError that says what was expected."""
    try:
        return load_config(regular_file(path), model, max_bytes=MAX_BYTES)
    except ConfigError as error:
        raise VolumeFileError(path, what, str(error)) from None


class GeometrySidecar(StrictModel):
    """`NAME.npy.yaml`: where the samples of `NAME.npy` lie."""

    size: tuple[Count, Count, Count]
    affine: tuple[Row, Row, Row, Row]


class RawSidecar(StrictModel):
    """`NAME.raw.yaml`: what the samples of `NAME.raw` are; see the head of `filterlab.io.raw`."""

    size: tuple[Count, Count, Count]
    dtype: str
    file: str | None = None
    byte_order: Literal["little", "big"] | None = None
    offset: Annotated[int, Field(ge=0, lt=2**62)] = 0
    spacing: tuple[Positive, Positive, Positive] | None = None
    origin: tuple[float, float, float] | None = None
    affine: tuple[Row, Row, Row, Row] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> RawSidecar:
        if self.dtype not in SAMPLE_TYPES:
            raise ValueError(unknown_name("dtype", self.dtype, SAMPLE_TYPES))
        if np.dtype(self.dtype).itemsize > 1 and self.byte_order is None:
            raise ValueError(f"expected byte_order: little or big, for {self.dtype}; it is missing")
        if self.affine is not None and (self.spacing is not None or self.origin is not None):
            raise ValueError("expected an affine, or spacing and origin; got both")
        return self
