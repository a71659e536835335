"""TIFF stacks: one file of many pages, or a folder of numbered slices (`slice2.tif` before `slice10.tif`).

All pages have the same size and type. Uncompressed and deflate data, strips or tiles, with any predictor, are read by
ourselves, other compressions by tifffile (the extra `tiff`). What a page is, slice, channel or frame, and how large a
voxel is, `tiff_layouts` finds in what OME, ImageJ and tifffile write; else pages are slices, and world coordinates are
voxel indices. The values of a pixel (RGB) are channels. Of ImageJ's stacks beyond 4 GB only the first plane has a page;
the others lie behind it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from filterlab.io.bounded import (
    Choice,
    VolumeFileError,
    VolumeHeader,
    as_samples,
    check_geometry,
    check_size,
    regular_file,
    sample_dtype,
    scaled,
)
from filterlab.io.tiff_layouts import MAX_OME, FirstPage, Layout
from filterlab.io.tiff_pages import DESCRIPTION, Page, TiffFile
from filterlab.io.watching import tell_done
from filterlab.world import World

SUFFIXES = (".tif", ".tiff")


def read_header(path: Path, frame: int | None = None, channel: int | None = None) -> VolumeHeader:
    """The checked header of a multi-page file or of a folder of slices. Raises VolumeFileError."""
    files = slices(path) if path.is_dir() else [regular_file(path)]
    first: Page | None = None
    told: FirstPage | None = None
    planes = 0
    for file in files:
        before = planes
        for page in _pages(file):
            if first is None:
                first, told = page, _told(page)
                page.directory.check_vendor()
            if page.plane != first.plane:
                raise VolumeFileError(file, f"pages of {first.plane}", f"page {planes} of {page.plane}")
            planes += 1
        if path.is_dir() and planes != before + 1:
            raise VolumeFileError(file, "one page in every slice of a folder", planes - before)
    if first is None or told is None:
        raise VolumeFileError(path, "a stack of two or more pages", "none")
    layout, plane = _layout(told, planes, len(files)), first.plane
    if planes < 2:
        raise VolumeFileError(path, "a stack of two or more pages", f"{planes} (a 2-D image)")
    frames, groups, depth = layout.pages.shape
    if depth < 2:
        got = f"{frames} frames of {groups * plane.samples} channels of a 2-D image"
        raise VolumeFileError(path, "a stack of two or more slices", got)
    shape = check_size(path, (depth, plane.rows, plane.columns))
    target = sample_dtype(path, plane.dtype)
    choice = Choice.of(path, frames, groups * plane.samples, frame, channel)
    t, c = choice.place
    group, sample = divmod(c, plane.samples)
    wanted = {int(page): z for z, page in enumerate(layout.pages[t, group])}
    return VolumeHeader(
        path,
        "TIFF",
        shape,
        plane.dtype.name,
        check_geometry(path, scaled(layout.spacing, (0, 0, 0)), World(unit=layout.unit)),
        plane.encoding,
        layout.fields | first.directory.remarks() | ({"files": str(len(files))} if path.is_dir() else {}),
        target,
        choice,
        0,
        lambda: _read(files, shape, target, wanted, sample),
    )


def _told(page: Page) -> FirstPage:
    plane, file = page.plane, page.directory.file
    content = page.directory.content(DESCRIPTION, MAX_OME)
    return FirstPage(file.path, content, plane.samples, page.size, (plane.rows, plane.columns))


def _layout(told: FirstPage, planes: int, files: int) -> Layout:
    """That of one file; of a folder, whose slices each have a description of their own, one slice behind the other."""
    if files == 1:
        return told.layout(planes)
    one = told.layout(1)
    return Layout(np.arange(planes).reshape(1, 1, planes), one.spacing, one.unit, one.fields)


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
            if index == 0 and directory.last and directory.text(DESCRIPTION).startswith("ImageJ="):
                yield from page.behind(_told(page).images(1) - 1)


def _read(
    files: list[Path], shape: tuple[int, ...], target: np.dtype, wanted: Mapping[int, int], sample: int
) -> np.ndarray:
    """The slices that are wanted, page -> slice, each of one of the values of its pixels."""
    samples, last = np.empty(shape, target), max(wanted)
    pages = (page for file in files for page in _pages(file))
    for index, page in enumerate(pages):
        if index in wanted:
            samples[wanted[index]] = as_samples(page.directory.file.path, page.read(sample), target)
            tell_done((index + 1) / (last + 1))
    return samples
