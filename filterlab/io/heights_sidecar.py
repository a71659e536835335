"""The small file beside heights: where they lie, and what their numbers mean; see `filterlab.io.sidecars`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from filterlab.heights import Heights
from filterlab.io.atomic import atomic_write
from filterlab.io.bounded import VolumeFileError
from filterlab.io.config import StrictModel, dump_config
from filterlab.io.heights_header import MAX_TEXT, Pair, check_place
from filterlab.io.sidecars import Count, load_sidecar


class HeightsSidecar(StrictModel):
    """`NAME.npy.yaml` or `NAME.png.yaml`: where the samples of `NAME.npy` lie, and what their numbers mean.

    height = scale · number + offset; the number `missing` is none.
    """

    size: tuple[Count, Count]
    spacing: Pair = (1.0, 1.0)
    origin: Pair = (0.0, 0.0)
    unit: Annotated[str, Field(max_length=100)] | None = None
    height_unit: Annotated[str, Field(max_length=100)] | None = None
    crs: Annotated[str, Field(max_length=MAX_TEXT)] | None = None
    crs_name: Annotated[str, Field(max_length=200)] | None = None
    scale: float = 1.0
    offset: float = 0.0
    missing: int | None = None

    @classmethod
    def of(cls, heights: Heights, **numbers: float | None) -> HeightsSidecar:
        """That of heights."""
        told = {name: getattr(heights, name) for name in ("unit", "height_unit", "crs", "crs_name")}
        return cls(size=heights.size, spacing=heights.spacing, origin=heights.origin, **told, **numbers)  # type: ignore[arg-type]

    @property
    def place(self) -> dict[str, Any]:
        """What a header takes of it."""
        names = ("spacing", "origin", "unit", "height_unit", "crs", "crs_name")
        return {name: getattr(self, name) for name in names}


def sidecar_of(path: Path) -> Path:
    return path.with_name(path.name + ".yaml")


def read_sidecar(path: Path, shape: tuple[int, int]) -> HeightsSidecar:
    """What stands beside a file of (H, W) samples; without a sidecar, samples at whole numbers.

    Raises VolumeFileError for one that is none, or of another size.
    """
    sidecar, size = sidecar_of(path), (shape[1], shape[0])
    if not sidecar.exists():
        return HeightsSidecar(size=size)
    found = load_sidecar(sidecar, HeightsSidecar, "where the heights lie")
    if found.size != size:
        raise VolumeFileError(sidecar, f"size {list(size)} as in {path.name}", f"size {list(found.size)}")
    check_place(sidecar, found.spacing, found.origin)
    return found


def write_sidecar(path: Path, sidecar: HeightsSidecar) -> None:
    """Writes it beside the file at `path`, which must not have another one's samples then: write that last."""
    with atomic_write(sidecar_of(path)) as temporary:
        temporary.write_text(dump_config(sidecar), encoding="utf-8")
