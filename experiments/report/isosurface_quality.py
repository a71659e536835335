"""Section of `isosurface_quality`: every surface with every method, whole and magnified, beside the signal's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.page import Block, Column, Gallery, Section, Table, picture
from experiments.report.style import MISSING, fixed, label, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.dvr_volume import Zoom
    from experiments.isosurface_quality import Config, Figure

LEAD = (
    "All surfaces are hit exactly, each ray at its first crossing of the level, with the method's own normals; nothing "
    "is stepped. marching-cubes is the exception: the triangle mesh of the same samples, its normals interpolated "
    "between vertices. Pictures of one figure share camera, lights and material: what differs is the surface.",
)
ABSENT, TRUTH, WHOLE = "absent", "signal", "whole"


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    parts = []
    for i, figure in enumerate(config.figures):
        found = [r for r in records.values() if r["figure"] == i]
        parts.append(_figure(figure, found, folder))
    return Section("Surfaces by every method", LEAD, (), parts)


def _figure(figure: Figure, records: Sequence[Record], folder: Path) -> Section:
    title = figure.title
    if absent := next((r for r in records if r["kind"] == ABSENT), None):
        return Section(title, (f"Skipped: there is no file {absent['file']} here.",))
    views: dict[str, Zoom | None] = {WHOLE: None, **{f"zoom-{i + 1}": zoom for i, zoom in enumerate(figure.zooms)}}
    blocks: list[Block] = []
    for view, zoom in views.items():
        if seen := [r for r in records if r["view"] == view]:
            blocks.append(_gallery(figure, zoom, seen, folder))
    if whole := [r for r in records if r["view"] == WHOLE]:
        blocks.append(_numbers(figure, whole))
    return Section(title, (), blocks)


def _gallery(figure: Figure, zoom: Zoom | None, records: Sequence[Record], folder: Path) -> Gallery:
    boxes = [z.window for z in figure.zooms] if zoom is None else ()
    pictures = [picture(folder, r["image"], _name(figure, r), _detail(r), boxes) for r in records]
    caption = _whole_caption(figure) if zoom is None else _zoom_caption(zoom)
    return Gallery(pictures, caption, columns=4 if len(pictures) > 6 else 3)


def _name(figure: Figure, record: Record) -> str:
    if record["recipe"] != TRUTH:
        return label(record, gradient=False)
    assert figure.signal is not None
    return f"{figure.signal.name} itself"


def _detail(record: Record) -> str:
    if record["recipe"] == TRUTH:
        return "ground truth"
    if record.get("distance_median") is None:
        return f"{record['render_seconds']:.1f} s"
    return f"off by {text(record['distance_median'], 2)} voxels, 95 %: {text(record['distance_most'], 2)}"


def _whole_caption(figure: Figure) -> str:
    width, height = figure.look.size
    if figure.signal is not None:
        what = f"{figure.signal.label}, sampled at {figure.resolution}³ cell centres{_noise(figure)}"
    else:
        assert figure.volume is not None
        what = figure.volume.file.rpartition("/")[2].rpartition(":")[2]
    caption = f"{what}, level {figure.level:g}, boundary {figure.boundary}; {width} × {height} pixels."
    if figure.look.error is not None:
        caption += f" Colour: distance to the signal's surface, from blue, none, to red, {figure.look.error:g} voxels."
    if figure.signal is not None:
        caption += " Below each: how far points seen are from the signal's surface, median and what 95 % stay below."
    return caption + (" Frames mark what is magnified below." if figure.zooms else "")


def _noise(figure: Figure) -> str:
    return f", with noise of standard deviation {figure.noise:g} in them" if figure.noise else ""


def _zoom_caption(zoom: Zoom) -> str:
    factor = 1 / (zoom.window[2] - zoom.window[0])
    return f"{zoom.title}, magnified {factor:.3g} times by casting rays (not by enlarging a picture)."


def _numbers(figure: Figure, records: Sequence[Record]) -> Table:
    """Of a scan no distances: it has no surface of its own."""
    known = figure.signal is not None
    distances = [Column("distance", "median, voxels"), Column("", "95 %, voxels")] if known else []
    columns = [
        Column("method", numeric=False),
        Column("pixels hit", "%"),
        *distances,
        Column("build", "s"),
        Column("picture", "s"),
    ]
    rows = []
    for r in records:
        off = [text(r.get("distance_median")), text(r.get("distance_most"))] if known else []
        hit = MISSING if r.get("hit") is None else fixed(100 * r["hit"])
        rows.append([_name(figure, r), hit, *off, fixed(r["build_seconds"]), fixed(r["render_seconds"], 1)])
    return Table(columns, rows, "The whole view. Wall-clock seconds on the CPU depend on what else ran.")
