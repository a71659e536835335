"""What the pages of a TIFF stack mean: which slice, channel and frame each is, and how large voxels are.

Told by the description of the first page: OME-XML, the lines of ImageJ, or the JSON of tifffile. Pages of a file that
says nothing are slices, one behind the other.

Source: https://docs.openmicroscopy.org/ome-model/ and, for the other two, tifffile.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from filterlab.io.bounded import VolumeFileError, integer, number
from filterlab.io.tiff_pages import MAX_TEXT, as_text
from filterlab.io.warned import warn

ORDER = ("frames", "channels", "slices")
MAX_OME = 2**22  # bytes of XML that is taken apart
_PLACES = ("FirstZ", "FirstC", "FirstT", "IFD", "PlaneCount")
# Micrometres in the units of lengths that OME knows and people use.
UNITS = {"nm": 1e-3, "µm": 1.0, "um": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6}
_JSON_AXES = {"T": "frames", "C": "channels", "Z": "slices", "Q": "", "I": "", "?": ""}  # the last three: not said


@dataclass(frozen=True)
class Layout:
    """Where the planes of a stack are.

    Attributes:
        pages: (frames, channels of pages, slices): numbers of pages; each may hold several values per pixel, which are
            channels too.
        spacing: of voxels along x, y, z.
        unit: of length; None: not declared.
        fields: more for people to read.
    """

    pages: np.ndarray
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    unit: str | None = None
    fields: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class FirstPage:
    """What the first page of a file says.

    Attributes:
        path: the file.
        content: its description, as far as MAX_OME.
        samples: values per pixel.
        size: width and height of a pixel by its resolution.
        shape: rows and columns.
    """

    path: Path
    content: bytes
    samples: int
    size: tuple[float, float]
    shape: tuple[int, int]

    @cached_property
    def description(self) -> str:
        """The beginning of the description, of which people and programs other than OME need no more."""
        return as_text(self.content[:MAX_TEXT])

    @property
    def imagej(self) -> dict[str, str]:
        """What ImageJ says of a stack: `key=value` lines; empty of other files."""
        if not self.description.startswith("ImageJ="):
            return {}
        return dict(line.split("=", 1) for line in self.description.splitlines() if "=" in line)

    def images(self, default: int) -> int:
        """How many planes ImageJ says that there are."""
        return integer(self.path, "ImageJ images", self.imagej.get("images", str(default)).strip())

    @property
    def _is_ome(self) -> bool:
        """Whether it is OME-XML, cut off or whole."""
        if not self.content[:64].lstrip().startswith(b"<"):
            return False
        cut = len(self.content) >= MAX_OME
        return b"OME" in self.content[:MAX_TEXT] if cut else self.content[-64:].rstrip().endswith(b"OME>")

    def layout(self, pages: int) -> Layout:
        """The layout of so many pages. Raises VolumeFileError where they are not what the description says."""
        text = self.description.strip()
        if self.imagej:
            return self._of_imagej(pages)
        if self._is_ome:
            return self._of_ome(pages)
        if text.startswith(('{"shape":', "shape=(")):
            return self._of_json(text, pages)
        return Layout(np.arange(pages).reshape(1, 1, pages))

    # --- ImageJ -------------------------------------------------------------------------------------------------------

    def _of_imagej(self, pages: int) -> Layout:
        """Hyperstacks run over channels first, then slices, then frames; depth of a voxel is `spacing=`."""
        said = self.imagej
        if self.images(pages) != pages:
            raise VolumeFileError(self.path, f"{said['images']} pages, as ImageJ says"[:100], pages)
        counts = {n: integer(self.path, f"ImageJ {n}", said[n].strip()) for n in ORDER if n in said}
        if "slices" not in counts:
            counts["slices"] = pages // max(math.prod(counts.values()), 1)
        shape = tuple(counts.get(name, 1) for name in ("frames", "slices", "channels"))
        if min(shape) < 1 or math.prod(shape) != pages:
            got = ", ".join(f"{value} {name}" for name, value in counts.items())
            raise VolumeFileError(self.path, f"frames × channels × slices to be its {pages} pages", got)
        depth = number(self.path, "ImageJ spacing", said.get("spacing", "1").strip())
        if said.get("cf", "11").strip() != "11" and {"c0", "c1"} & set(said):
            warn(self.path, "the calibration of its values by ImageJ is not applied: they are as stored")
        unit = _unit(said.get("unit"))
        fields = {k: said[k] for k in ("cf", "c0", "c1", "vunit") if k in said}
        if "unit" in said and unit is None:
            fields["unit"] = said["unit"]
        return Layout(np.arange(pages).reshape(shape).swapaxes(1, 2), (*self.size, depth), unit, fields)

    # --- tifffile -----------------------------------------------------------------------------------------------------

    def _of_json(self, text: str, pages: int) -> Layout:
        """The shape of the array that was written, with the letters of its axes where they were given."""
        said = self._json(text)
        shape, axes = said.get("shape"), said.get("axes")
        if not isinstance(shape, list) or not all(isinstance(n, int) and 0 < n < 2**31 for n in shape):
            raise VolumeFileError(self.path, "a shape of whole numbers in its description", text[:80])
        if axes is not None and (not isinstance(axes, str) or len(axes) != len(shape)):
            raise VolumeFileError(self.path, f"a letter for each axis of {shape}"[:120], repr(axes)[:80])
        inner = self._inner(shape)
        outer = shape[: len(shape) - inner]
        if math.prod(outer) == 1:  # pages that were written one by one
            outer = [pages]
            axes = None
        if math.prod(outer) != pages:
            raise VolumeFileError(self.path, f"the {math.prod(outer)} pages of its shape {shape}", pages)
        names = [_JSON_AXES.get(letter, letter) for letter in (axes or "?" * len(outer)).upper()[: len(outer)]]
        kept = [(name, n) for name, n in zip(names, outer, strict=True) if n > 1]
        if [name for name, _ in kept] == [""]:  # nothing says what it is: slices
            kept = [("slices", kept[0][1])]
        if not set(dict(kept)) <= set(ORDER) or len(dict(kept)) != len(kept):
            got = f"axes {axes!r} of {shape}" if axes else f"no axes of {shape}"
            raise VolumeFileError(self.path, "axes that tell frames (T), channels (C) and slices (Z) apart", got[:120])
        size, unit = (1.0, 1.0, 1.0), None
        if isinstance(depth := said.get("spacing"), int | float) and 0 < depth < math.inf:
            size, unit = (*self.size, float(depth)), _unit(said.get("unit"))
        return Layout(_arranged(kept), size, unit)

    def _json(self, text: str) -> dict[str, Any]:
        try:
            if text.startswith("shape=("):  # as tifffile once wrote it
                return {"shape": [int(n) for n in text[len("shape=(") :].split(")")[0].split(",") if n.strip()]}
            found = json.loads(text)
            return found if isinstance(found, dict) else {}
        except (ValueError, RecursionError):
            raise VolumeFileError(self.path, "JSON in its description", text[:80]) from None

    def _inner(self, shape: list[int]) -> int:
        """How many of the last axes are within a page."""
        if self.samples == 1:
            ends = [list(self.shape), [*self.shape, 1], [1, *self.shape]]
        else:
            ends = [[*self.shape, self.samples], [self.samples, *self.shape]]
        for end in ends:
            if shape[-len(end) :] == end:
                return len(end)
        raise VolumeFileError(self.path, f"a shape that ends in those of its pages, {ends[0]}", shape)

    # --- OME ----------------------------------------------------------------------------------------------------------

    def _of_ome(self, pages: int) -> Layout:
        described = self._described(pages)
        pixels = described.pixels
        counts = {axis: self._count(pixels, f"Size{axis}") for axis in "XYZCT"}
        if (counts["Y"], counts["X"]) != self.shape:
            raise VolumeFileError(self.path, f"pages of {self.shape}, as OME says", (counts["Y"], counts["X"]))
        order = pixels.get("DimensionOrder", "XYZCT")
        if order[:2] != "XY" or sorted(order[2:]) != ["C", "T", "Z"]:
            raise VolumeFileError(self.path, "a DimensionOrder such as XYZCT", repr(order[:20]))
        if counts["C"] % self.samples:
            raise VolumeFileError(self.path, f"channels in pages of {self.samples}", counts["C"])
        counts["C"] //= self.samples
        planes = math.prod(counts[axis] for axis in "TCZ")
        expected = f"all {planes} planes of its OME description in this file"
        if planes > pages:
            raise VolumeFileError(self.path, expected, pages)
        table = np.full(tuple(counts[axis] for axis in order[:1:-1]), -1)  # slowest first
        for entry in described.entries or [{}]:
            self._place(entry, table, order, pages)
        if (missing := int((table < 0).sum())) > 0:
            raise VolumeFileError(self.path, expected, planes - missing)
        if pages > planes:
            warn(self.path, f"passed over {pages - planes} pages that its OME description does not name")
        spacing, unit = self._physical_size(pixels)
        return Layout(np.transpose(table, [order[:1:-1].index(axis) for axis in "TCZ"]), spacing, unit)

    def _described(self, pages: int) -> Description:
        """What OME-XML says. Raises VolumeFileError."""
        if len(self.content) >= MAX_OME:
            raise VolumeFileError(self.path, f"an OME description of at most {MAX_OME} bytes", "more")
        found = Description(pages)
        try:
            found.read(self.content)
        except (expat.ExpatError, ValueError, LookupError) as error:
            found.refused = found.refused or ("well-formed OME-XML", str(error)[:100])
        if found.refused:
            raise VolumeFileError(self.path, *found.refused)
        if found.images != 1:
            raise VolumeFileError(self.path, "one image in its OME description", found.images)
        return found

    def _count(self, pixels: Mapping[str, str], name: str) -> int:
        value = integer(self.path, name, pixels.get(name, "missing").strip())
        if value < 1:
            raise VolumeFileError(self.path, f"{name} of 1 or more", value)
        return value

    def _place(self, entry: Mapping[str, str], table: np.ndarray, order: str, pages: int) -> None:
        """Writes the pages of one element TiffData into the table of planes."""
        name = entry.get("FileName", self.path.name)
        if Path(name).name != self.path.name:
            raise VolumeFileError(self.path, "an OME-TIFF of one file", f"planes in {name!r}"[:120])
        said = {name: integer(self.path, name, entry[name].strip()) for name in _PLACES if name in entry}
        first = {axis: said.get(f"First{axis}", 0) for axis in "ZCT"}
        first["C"] //= self.samples
        at = tuple(first[axis] for axis in order[:1:-1])
        if any(not 0 <= i < n for i, n in zip(at, table.shape, strict=True)):
            raise VolumeFileError(self.path, f"TiffData within {table.shape}", at)
        start = int(np.ravel_multi_index(at, table.shape))
        page = said.get("IFD", 0)
        count = said.get("PlaneCount", 1 if "IFD" in said else table.size - start)
        if min(page, count) < 0 or page + count > pages or start + count > table.size:
            raise VolumeFileError(self.path, f"TiffData within its {pages} pages", f"{count} from page {page}")
        table.flat[start : start + count] = np.arange(page, page + count)

    def _physical_size(self, pixels: Mapping[str, str]) -> tuple[tuple[float, float, float], str | None]:
        """Of a voxel, in the unit of x; 1 where nothing is said."""
        sizes, units = [], []
        for axis in "XYZ":
            said = pixels.get(f"PhysicalSize{axis}")
            unit = str(pixels.get(f"PhysicalSize{axis}Unit", "µm"))
            if said is None:
                continue
            if unit not in UNITS:
                warn(self.path, f"PhysicalSize{axis} in {unit!r} is taken as a number without a unit"[:120])
            sizes.append((axis, number(self.path, f"PhysicalSize{axis}", said.strip())))
            units.append(unit)
        if any(size <= 0 for _, size in sizes):
            raise VolumeFileError(self.path, "positive numbers as PhysicalSize", sizes)
        known = bool(units) and all(unit in UNITS for unit in units)
        if len(set(units)) > 1 and not known:
            raise VolumeFileError(self.path, f"PhysicalSize in units among {', '.join(UNITS)}", ", ".join(units)[:80])
        scale = {axis: UNITS[u] / UNITS[units[0]] if known else 1.0 for (axis, _), u in zip(sizes, units, strict=True)}
        found = {axis: size * scale[axis] for axis, size in sizes}
        if found and len(found) < 3:
            missing = ", ".join(axis for axis in "XYZ" if axis not in found)
            warn(self.path, f"its OME description has no PhysicalSize along {missing}; 1 is taken")
        x, y, z = (found.get(axis, 1.0) for axis in "XYZ")
        return (x, y, z), _unit(units[0]) if known else None


class Description:
    """What OME-XML says of pixels and of the pages that hold them; of all else nothing is kept.

    Attributes:
        images: how many there are.
        pixels: the attributes of the first one's pixels.
        entries: of each element TiffData its numbers, and `FileName`; at most as many as there are pages.
        refused: what is expected and what came, where something is not read.
    """

    def __init__(self, pages: int) -> None:
        self.images, self.pages = 0, pages
        self.pixels: dict[str, str] = {}
        self.entries: list[dict[str, str]] = []
        self.refused: tuple[str, str] | None = None

    def read(self, content: bytes) -> None:
        """Takes it apart. Raises expat's errors where it is no XML."""
        parser = expat.ParserCreate()
        parser.StartElementHandler = self._begin
        parser.StartDoctypeDeclHandler = self._doctype  # no entities, nothing that expands
        parser.Parse(content, True)

    def _doctype(self, *_: Any) -> None:
        self.refused = self.refused or ("OME-XML without a document type", "one")
        raise ValueError("a document type")

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        name = name.rsplit(":", 1)[-1]  # without its namespace
        if name == "Pixels":
            self.images += 1
            self.pixels = self.pixels or attributes
        elif name == "TiffData":
            if len(self.entries) == self.pages:
                raise ValueError(f"more TiffData than its {self.pages} pages")
            self.entries.append({key: attributes[key] for key in _PLACES if key in attributes})
        elif name == "UUID" and self.entries and "FileName" in attributes:
            self.entries[-1]["FileName"] = attributes["FileName"]
        elif name.startswith("ModuloAlong"):
            self.refused = self.refused or ("axes of space, time and channels", "others (ModuloAlong) in its OME-XML")


def _unit(text: object) -> str | None:
    """A unit of length by its usual letters; None for what is none."""
    text = {"micron": "um", "microns": "um", "\\u00B5m": "um"}.get(str(text).strip(), str(text).strip())
    text = text.replace("µ", "u").replace("μ", "u")
    return text if text in UNITS else None


def _arranged(axes: Sequence[tuple[str, int]]) -> np.ndarray:
    """Numbers of pages as (frames, channels, slices), of axes in the order in which pages lie, slowest first."""
    names = [name for name, _ in axes]
    pages = np.arange(math.prod(n for _, n in axes)).reshape([n for _, n in axes])
    pages = pages.reshape(*pages.shape, *(1 for name in ORDER if name not in names))
    names += [name for name in ORDER if name not in names]
    return pages.transpose([names.index(name) for name in ORDER])
