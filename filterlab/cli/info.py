"""The command `filterlab info`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from filterlab.cli.loading import reading
from filterlab.cli.options import Channel, Frame
from filterlab.cli.terminal import progress_bar, tell
from filterlab.world import RAS, World

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from filterlab.fields.base import Domain
    from filterlab.io.bounded import VolumeHeader
    from filterlab.io.heights_header import HeightsHeader

BINS = 16
AT_ONCE = 2**17  # numbers


@dataclass(frozen=True)
class Info:
    """Show what is in a file of a volume, of heights, of a SLIM surface or of quadrics: its header, place and values.

    examples:
      filterlab info engine.nrrd
      filterlab info dem.tif
      filterlab info scan.nii.gz --header-only
      filterlab info series.nii.gz --frame 3
      filterlab info bunny.npz
    """

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """The volume: a file, or a folder of numbered TIFF slices; or heights (GeoTIFF, .npy, .npz, PNG of 16 bits); or a
    SLIM surface or quadrics (.npz)."""
    header_only: Annotated[bool, arg(aliases=["-H"])] = False
    """Do not read the voxels."""
    frame: Frame = None
    """Which volume of a time series (or entry of a batch), from 0."""
    channel: Channel = None
    """Which of several values per voxel (or band of a map), from 0."""

    def run(self, overrides: dict[str, str]) -> None:
        from filterlab.io.heights import holds_heights

        if lines := _lines_of_surface(self.file):
            _show_lines(lines)
        elif holds_heights(self.file):
            self._tell_heights()
        else:
            self._tell_volume()

    def _tell_volume(self) -> None:
        from filterlab.io.volumes import MAX_BYTES, describe

        header = describe(self.file, frame=self.frame, channel=self.channel)
        _show_lines(_described(header))
        if not self.header_only and _tell_open_choice(header):
            self._tell_values(lambda: header.read(MAX_BYTES))

    def _tell_heights(self) -> None:
        from filterlab.io.heights import MAX_BYTES, describe_heights

        header = describe_heights(self.file, band=None if self.channel is None else self.channel + 1)
        _show_lines(_described_heights(header))
        if not self.header_only:
            self._tell_values(lambda: header.read(MAX_BYTES).samples)

    def _tell_values(self, read: Callable[[], np.ndarray]) -> None:
        with progress_bar() as progress:
            with reading(progress):
                samples = read()
            found = _distribution(samples, lambda done: progress(done, "counting"))
        _show_lines(found)


def _show_lines(lines: Sequence[tuple[str, str]]) -> None:
    width = max(len(name) for name, _ in lines)
    for name, value in lines:
        print(f" {name:<{width}}  {value}".rstrip())


def _described_heights(header: HeightsHeader) -> list[tuple[str, str]]:
    """Lines about the header of a file of heights."""
    rows, columns = header.shape
    (dx, dy), (x, y) = header.spacing, header.origin
    own = header.dtype.name
    ends = [sorted((o, o + (n - 1) * d)) for o, n, d in ((x, columns, dx), (y, rows, dy))]
    return [
        ("file", f"{header.path} ({header.format}, {header.encoding})"),
        ("size (x, y)", f"{columns} × {rows}"),
        ("type", header.stored if header.stored == own else f"{header.stored}, read as {own}"),
        ("memory", f"{header.nbytes / 2**20:.4g} MiB"),
        ("spacing", f"{dx:.6g} {dy:.6g}" + (" (rows from the north)" if dy < 0 else "")),
        ("x", f"{ends[0][0]:.10g} … {ends[0][1]:.10g}"),
        ("y", f"{ends[1][0]:.10g} … {ends[1][1]:.10g}"),
        ("unit", f"{header.unit or 'not declared'}; of heights: {header.height_unit or 'not declared'}"),
        ("reference system", _reference(header)),
        *header.fields.items(),
    ]


def _reference(header: HeightsHeader) -> str:
    if header.crs is None:
        return "not declared"
    code = header.crs if header.crs.startswith("EPSG:") else None
    return " ".join(filter(None, (header.crs_name, code and f"({code})"))) or "WKT"


def _lines_of_surface(path: Path) -> list[tuple[str, str]]:
    """Lines about the SLIM surface or the quadrics in an .npz file; none about any other."""
    if path.suffix.lower() != ".npz":
        return []
    from filterlab.io.covers import is_slim
    from filterlab.io.quadric_files import is_quadrics

    return _lines_of_slim(path) if is_slim(path) else _lines_of_quadrics(path) if is_quadrics(path) else []


def _lines_of_slim(path: Path) -> list[tuple[str, str]]:
    from filterlab.io.covers import load_slim

    slim = load_slim(path)
    cuts = 0 if slim.cuts is None else slim.cuts.shape[1]
    return [
        ("file", f"{path} (SLIM surface)"),
        ("balls", f"{len(slim):,}, {str(slim.A.dtype).removeprefix('torch.')}"),
        ("radii", _radii(slim.radii)),
        ("planes", f"up to {cuts} for each" if cuts else "none: no ball is cut"),
        ("x, y, z", _box(slim.domain)),
        ("shown", f"{slim.faces} faces, blended over {slim.offset:g} radii"),
    ]


def _lines_of_quadrics(path: Path) -> list[tuple[str, str]]:
    from filterlab.io.quadric_files import load_quadrics

    quadrics = load_quadrics(path)
    planes = quadrics.bounds.planes.shape[1]
    return [
        ("file", f"{path} (quadrics)"),
        ("quadrics", f"{len(quadrics):,}, {str(quadrics.A.dtype).removeprefix('torch.')}"),
        ("radii", f"{_radii(quadrics.bounds.radii)}, of what bounds them"),
        ("planes", f"up to {planes} for each" if planes else "none: balls alone bound them"),
        ("x, y, z", _box(quadrics.domain)),
        ("shown", f"{quadrics.faces} faces"),
    ]


def _radii(radii: Tensor) -> str:
    radii = radii.double()
    return f"{float(radii.min()):.6g} … {float(radii.max()):.6g}, median {float(radii.median()):.6g}"


def _box(domain: Domain) -> str:
    return "; ".join(f"{a:.6g} … {b:.6g}" for a, b in zip(domain.lower, domain.upper, strict=True))


def _described(header: VolumeHeader) -> list[tuple[str, str]]:
    """Lines about a volume's header."""
    import numpy as np

    def numbers(values: Sequence[float]) -> str:
        return " ".join(f"{v:.6g}" for v in values)

    dtype = header.sample_type.name
    extent = [n * s for n, s in zip(header.size, header.spacing, strict=True)]
    lines = [
        ("file", f"{header.path} ({header.format}, {header.encoding})"),
        ("size (x, y, z)", " × ".join(map(str, header.size))),
        ("type", header.stored if header.stored == dtype else f"{header.stored}, read as {dtype}"),
        ("memory", f"{header.nbytes / 2**20:.4g} MiB"),
        ("spacing", numbers(header.spacing)),
        ("origin", numbers(header.origin)),
        ("extent", numbers(extent)),
        ("world axes", _axes(header.world)),
        *([("unit", header.world.unit)] if header.world.unit else []),
        *_forms(header.world),
    ]
    lines[2:2] = _choice(header)
    if np.count_nonzero(header.affine[:3, :3] - np.diag(header.spacing)):
        lines += [("affine" if i == 0 else "", numbers(row)) for i, row in enumerate(header.affine)]
    return lines + list(header.fields.items())


def _axes(world: World) -> str:
    """What the axes of a world are, and what they are called in the file where that is something else."""
    if world.axes is None:
        return "not declared"
    return world.axes if world.space in (world.axes, RAS) else f"{world.axes} (declared {world.space})"


def _forms(world: World) -> list[tuple[str, str]]:
    """What a NIfTI file says of its place."""
    forms = world.nifti
    if forms is None:
        return []
    elsewhere = "; they tell different places" if forms.to_qform else ""
    time = "" if forms.time == "unknown" else f", time in {forms.time}"
    return [("codes", f"NIfTI-{forms.version}, sform {forms.sform}, qform {forms.qform}{elsewhere}{time}")]


def _choice(header: VolumeHeader) -> list[tuple[str, str]]:
    """How many frames and channels there are, where there are several, and which one this is."""
    choice, lines = header.choice, []
    for name, count, index in (
        ("frames", choice.frames, choice.frame),
        ("channels", choice.channels, choice.channel),
    ):
        if count > 1:
            lines.append((name, f"{count}" if index is None else f"{count}; this is {index}"))
    return lines


def _tell_open_choice(header: VolumeHeader) -> bool:
    """Whether the voxels are those of one volume; if not, says on stderr what to choose."""
    try:
        header.check_choice()
    except ValueError as error:
        tell(f"no voxels are read: {error}")
        return False
    return True


def _distribution(samples: np.ndarray, progress: Callable[[float], None]) -> list[tuple[str, str]]:
    """Range, mean and a histogram of the finite values, in two passes of a megabyte of numbers at a time."""
    import numpy as np

    flat, whole = samples.reshape(-1), samples.dtype.kind in "iu"
    first = range(0, flat.size, AT_ONCE)

    def parts(before: float) -> Iterator[np.ndarray]:
        for i in first:
            part = flat[i : i + AT_ONCE]
            yield part if whole else part[np.isfinite(part)]
            progress(before + 0.5 * min((i + AT_ONCE) / flat.size, 1.0))

    count, total, extremes = 0, 0.0, []
    for part in parts(0.0):
        if part.size:
            extremes += [part.min(), part.max()]
            count, total = count + part.size, total + float(part.sum(dtype=np.float64))
    lines = [("not finite", str(flat.size - count))] if count < flat.size else []
    if not count:
        return [*lines, ("range", "no finite values")]
    low, high = float(min(extremes)), float(max(extremes))
    lines += [("range", f"{low:.6g} … {high:.6g}"), ("mean", f"{total / count:.6g}")]
    if high == low:
        return lines
    bins, span = (min(BINS, int(high - low) + 1), high - low + 1) if whole else (BINS, high - low)
    counts = np.zeros(bins, np.int64)
    for part in parts(0.5):
        place = ((part.astype(np.float64) - low) * (bins / span)).astype(np.int64)
        counts += np.bincount(place.clip(0, bins - 1), minlength=bins)
    return lines + _bars(counts.tolist(), low, span)


def _bars(counts: list[int], low: float, span: float) -> list[tuple[str, str]]:
    """One line per bin: where it begins, its share, and a bar on a logarithmic scale (1 voxel to all of them)."""
    total, width = sum(counts), span / len(counts)
    lines = [("values", "share of all; bars are logarithmic")]
    for i, count in enumerate(counts):
        bar = "█" * (1 + round(29 * math.log(count) / max(math.log(total), 1e-9))) if count else ""
        lines.append((f"from {low + i * width:.6g}", f"{100 * count / total:6.2f} %  {bar}"))
    return lines
