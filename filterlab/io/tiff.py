"""TIFF stacks: one file of many pages, or a folder of numbered slices (`slice2.tif` before `slice10.tif`).

Every page is one z-plane of one value per pixel; all have the same size and type. Uncompressed and deflate data, strips
or tiles, with any predictor. World coordinates are voxel indices; a file by ImageJ or Fiji also tells voxel sizes, and
they are used. Of its stacks beyond 4 GB only the first plane has a page; the others lie behind it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import torch

from filterlab.io.bounded import (
    VolumeFileError,
    VolumeHeader,
    check_geometry,
    check_size,
    integer,
    number,
    regular_file,
    sample_dtype,
    scaled,
)
from filterlab.io.tiff_pages import DESCRIPTION, Page, TiffFile

SUFFIXES = (".tif", ".tiff")


def read_header(path: Path) -> VolumeHeader:
    """The checked header of a multi-page file or of a folder of slices. Raises VolumeFileError."""
    files = slices(path) if path.is_dir() else [regular_file(path)]
    first: Page | None = None
    planes, entries, size = 0, {}, (1.0, 1.0)
    for file in files:
        before = planes
        for page in _pages(file):
            if first is None:
                first, entries, size = page, _entries(page), page.size
            if page.plane != first.plane:
                raise VolumeFileError(file, f"pages of {first.plane}", f"page {planes} of {page.plane}")
            planes += 1
        if path.is_dir() and planes != before + 1:
            raise VolumeFileError(file, "one page in every slice of a folder", planes - before)
    fields, spacing = _imagej(path, entries, size, planes)
    if first is None or planes < 2:
        raise VolumeFileError(path, "a stack of two or more pages", f"{planes} (a 2-D image)")
    plane = first.plane
    shape = check_size(path, (planes, plane.rows, plane.columns))
    target = sample_dtype(path, plane.dtype)
    return VolumeHeader(
        path,
        "TIFF",
        shape,
        plane.dtype.name,
        check_geometry(path, scaled(spacing, (0, 0, 0))),
        plane.encoding,
        None,
        fields | ({"files": str(len(files))} if path.is_dir() else {}),
        target,
        lambda: _read(files, shape, target),
    )


def slices(folder: Path) -> list[Path]:
    """The TIFF files of a folder in natural order of their names. Raises VolumeFileError if there are none."""
    files = [f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES and not f.name.startswith(".")]
    if not files:
        raise VolumeFileError(folder, f"a folder of {' or '.join(SUFFIXES)} slices", "none")
    return [regular_file(f) for f in sorted(files, key=natural_key)]


def natural_key(path: Path) -> tuple[list[tuple[int, int | str]], str]:
    """Sorts digits by value: a2 < a10."""
    parts = re.findall(r"[0-9]+|[^0-9]+", path.name)
    return [(0, int(p)) if p[0] in "0123456789" else (1, p.lower()) for p in parts], path.name


def _pages(path: Path) -> Iterator[Page]:
    """The pages of a file, checked one after the other; they are read before the next one is asked for."""
    with path.open("rb") as stream:
        for index, directory in enumerate(TiffFile(path, stream)):
            page = directory.page()
            yield page
            if index == 0 and directory.last:
                yield from page.behind(_images(path, _entries(page), 1) - 1)


def _read(files: list[Path], shape: tuple[int, ...], target: torch.dtype) -> torch.Tensor:
    samples = torch.empty(shape, dtype=target)
    pages = (page for file in files for page in _pages(file))
    for plane, page in zip(samples.numpy(), pages, strict=True):
        plane[...] = page.read()
    return samples


# --- ImageJ -----------------------------------------------------------------------------------------------------------


def _entries(page: Page) -> dict[str, str]:
    """What ImageJ says of a stack in the description of its first page: `key=value` lines; empty of other files."""
    description = page.directory.text(DESCRIPTION)
    if not description.startswith("ImageJ="):
        return {}
    return dict(line.split("=", 1) for line in description.splitlines() if "=" in line)


def _images(path: Path, entries: dict[str, str], default: int) -> int:
    return integer(path, "ImageJ images", entries.get("images", str(default)).strip())


def _imagej(
    path: Path, entries: dict[str, str], size: tuple[float, float], planes: int
) -> tuple[dict[str, str], tuple[float, float, float]]:
    """Unit and voxel sizes of an ImageJ stack: width and height from the resolution, depth from `spacing=`."""
    if not entries:
        return {}, (1.0, 1.0, 1.0)
    if _images(path, entries, planes) != planes:
        raise VolumeFileError(path, f"{entries['images']} pages, as ImageJ says"[:100], planes)
    if any(entries.get(key, "1") != "1" for key in ("channels", "frames")):
        raise VolumeFileError(path, "one channel and one frame", f"{entries}"[:100])
    depth = number(path, "ImageJ spacing", entries.get("spacing", "1").strip())
    return {"unit": entries["unit"]} if "unit" in entries else {}, (*size, depth)
