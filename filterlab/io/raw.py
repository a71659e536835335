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
from typing import TYPE_CHECKING

import numpy as np

from filterlab.io.bounded import (
    Choice,
    Stored,
    VolumeFileError,
    VolumeHeader,
    as_samples,
    beside,
    check_geometry,
    check_size,
    sample_dtype,
    scaled,
)

if TYPE_CHECKING:
    from filterlab.io.sidecars import RawSidecar


def read_sidecar(path: Path) -> RawSidecar:
    """The checked sidecar. Raises VolumeFileError."""
    from filterlab.io.sidecars import RawSidecar, load_sidecar

    return load_sidecar(path, RawSidecar, "a description of raw samples")


def read_header(path: Path, frame: int | None = None, channel: int | None = None) -> VolumeHeader:
    """The checked sidecar of raw samples; `path` is either of the two files. Raises VolumeFileError."""
    sidecar = path if path.name.lower().endswith(".yaml") else path.with_name(path.name + ".yaml")
    if not sidecar.exists():
        raise VolumeFileError(path, f"a sidecar {sidecar.name} with size, dtype, …", "no such file")
    found = read_sidecar(sidecar)
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
        lambda: as_samples(path, stored.read((), target), target),
    )
