"""Raw samples with a sidecar: `NAME.raw` is described by `NAME.raw.yaml`.

file: engine.raw          # beside the sidecar or below; default: the sidecar's name without .yaml
size: [256, 256, 128]     # x, y, z; x varies fastest
dtype: uint16             # a NumPy name
byte_order: little        # little | big; needed for types of more than one byte
offset: 0                 # bytes before the samples
spacing: [1, 1, 1.5]      # x, y, z
origin: [0, 0, 0]         # world position of the centre of the first voxel
affine: [[…], …]          # 4×4, instead of spacing and origin
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from filterlab.io.bounded import (
    SAMPLE_TYPES,
    Choice,
    Stored,
    VolumeFileError,
    VolumeHeader,
    as_samples,
    beside,
    check_geometry,
    check_size,
    regular_file,
    sample_dtype,
    scaled,
)
from filterlab.io.config import MAX_SIDECAR_BYTES, ConfigError, StrictModel, load_config
from filterlab.names import unknown_name

Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0)]
Row = tuple[float, float, float, float]


class RawSidecar(StrictModel):
    """What a sidecar says; see the head of this file."""

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


def read_header(path: Path, frame: int | None = None, channel: int | None = None) -> VolumeHeader:
    """The checked sidecar of raw samples; `path` is either of the two files. Raises VolumeFileError."""
    sidecar = path if path.name.lower().endswith(".yaml") else path.with_name(path.name + ".yaml")
    if not sidecar.exists():
        raise VolumeFileError(path, f"a sidecar {sidecar.name} with size, dtype, …", "no such file")
    try:
        found = load_config(regular_file(sidecar), RawSidecar, max_bytes=MAX_SIDECAR_BYTES)
    except ConfigError as error:
        raise VolumeFileError(sidecar, "a description of raw samples", str(error)) from None
    if sidecar != path and found.file not in (None, path.name):
        raise VolumeFileError(sidecar, f"file: {path.name}", found.file)
    data = beside(sidecar, found.file or sidecar.name[: -len(".yaml")])
    size = check_size(sidecar, found.size)
    dtype = np.dtype(found.dtype).newbyteorder(">" if found.byte_order == "big" else "<")
    stored = Stored(sidecar, data, "raw", found.offset, 0, size[::-1], dtype)
    stored.check(exact=True)  # nothing else tells a wrong size or type
    affine = np.array(found.affine) if found.affine else scaled(found.spacing or (1, 1, 1), found.origin or (0, 0, 0))
    target = sample_dtype(sidecar, dtype)
    fields = {"file": data.name, "byte order": found.byte_order or "-", "offset": str(found.offset)}
    return VolumeHeader(
        path,
        "raw",
        size[::-1],
        dtype.name,
        check_geometry(sidecar, affine),
        "raw",
        fields,
        target,
        Choice.of(path, 1, 1, frame, channel),
        0,
        lambda: as_samples(path, stored.read(), target),
    )
