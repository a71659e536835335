"""Section of `tetrahedral_table`: relevant tetrahedra, forms, changes of level and frames beside the printed tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.page import Block, Column, Gallery, Section, Table, picture
from experiments.report.style import MISSING, label, memory, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.tetrahedral_table import Config, Source

LEAD = (
    "A cell or tetrahedron is relevant where its Bernstein coefficients straddle the level. Splines are held by "
    "samples, of which the coefficients of a tetrahedron are made when they are needed, or by numbers of cells that "
    "determine them: D2 (20 of a cube), D3 (56), or value and gradient at the centres of octahedra (jets); of all "
    "cells, or only of those that may hold the level, with a table of where these are. The papers project relevant "
    "tetrahedra and find them anew for every level; here rays walk, and nothing is listed.",
)

# As printed: Kalbe & Zeilfelder, Hardware-accelerated, high-quality rendering based on trivariate splines approximating
# volume data, 2008, table 1; MB; seconds; frames on a G80, of quadratic ones also (on a G70)
_OF_2008 = (
    "level",
    "cubes",
    "tetrahedra",
    "D2",
    "D3",
    "geometry",
    "octree",
    "qss",
    "cubic-c1",
    "fps qss",
    "fps cubic-c1",
)
PRINTED_2008: dict[str, dict[str, str]] = {
    name: dict(zip(_OF_2008, row.split("|"), strict=True))
    for name, row in {
        "neghip": "0.40|1.0E4|1.17E5|0.77|2.16|0.48|0.05|0.2|0.4|40-60 (15-35)|20-34",
        "dragon": "0.50|5.0E4|5.84E5|3.84|10.77|2.41|0.17|1.2|1.5|20-40 (8-12)|14-30",
        "aneurism": "0.40|7.6E4|8.53E5|5.79|16.20|2.95|0.60|2.0|2.5|15-22 (5-12)|10-18",
        "lobbster": "0.14|1.5E5|1.70E6|11.20|31.35|7.00|1.00|3.3|4.1|7-15 (3-5)|4-9",
        "foot": "0.40|3.5E5|4.17E6|27.03|75.70|16.83|1.30|6.6|8.0|4-12 (1-4)|2.7-8",
        "bonsai": "0.14|5.1E5|6.18E6|38.90|108.93|25.27|1.30|13.8|16.0|2.5-12 (0.5-2)|1.5-8",
    }.items()
}

# As printed: Marinc, Kalbe, Rhein & Goesele, Interactive isosurfaces with quadratic C¹ splines on truncated octahedral
# partitions, 2011, table 1: size, then tetrahedra, milliseconds of reconstruction and frames, cubic, then quadratic
PRINTED_2011 = (
    "64³|13 398|16|125|19 224|19|59",
    "128³|711 000|107|25|1 061 000|131|26",
    "128³|2 316 000|123|8|3 388 000|180|9",
    "256³|4 153 000|95|4|5 716 000|192|5",
    "256³|5 371 000|88|3|8 066 000|210|3",
)


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    parts = []
    for i, source in enumerate(config.sources):
        found = [r for r in records.values() if r["source"] == i]
        parts.append(_source(config, source, found, folder))
    return Section("What level sets of splines on tetrahedra take", LEAD, (), [*parts, _printed()])


def _source(config: Config, source: Source, records: Sequence[Record], folder: Path) -> Section:
    if absent := next((r for r in records if r["kind"] == ABSENT), None):
        return Section(source.title, (f"Skipped: there is no file {absent['file']} here.",))
    if not records:
        return Section(source.title)
    printed = PRINTED_2008.get(source.published or "", {})
    blocks: list[Block] = [
        _relevant(source, records, printed),
        _forms(config, records, printed),
        _frames(config, records, printed),
        *_pictures(source, records, folder),
    ]
    return Section(f"{source.title}, level {source.level:g}", (), blocks)


ABSENT = "absent"


def _relevant(source: Source, records: Sequence[Record], printed: Mapping[str, str]) -> Table:
    columns = [
        Column("spline", numeric=False),
        Column("voxels"),
        Column("cells", "relevant"),
        Column("", "% of all"),
        Column("", "printed, 2008"),
        Column("tetrahedra", "relevant"),
        Column("", "% of all"),
        Column("", "printed, 2008"),
        Column("listing", "s"),
        Column("change of level", "ms"),
    ]
    rows = []
    for r in records:
        cubes = printed if r["of_a_cell"] == 24 else {}
        every = r["of_cells"] * r["of_a_cell"]
        rows.append(
            [
                label(r),
                " × ".join(map(str, r["voxels"])),
                f"{r['cells']:,}",
                text(100 * r["cells"] / r["of_cells"]),
                cubes.get("cubes", MISSING),
                f"{r['tetrahedra']:,}",
                text(100 * r["tetrahedra"] / every),
                cubes.get("tetrahedra", MISSING),
                text(r["listing_seconds"]),
                text(1e3 * r["level_seconds"], 2),
            ]
        )
    caption = (
        f"Level {source.level:g}. Listing: finding every relevant tetrahedron, which nothing but this table needs. "
        "Change of level: what one ray takes more where its level was never asked for; less than it differs from time "
        "to time is told with either sign."
    )
    return Table(columns, rows, caption)


def _forms(config: Config, records: Sequence[Record], printed: Mapping[str, str]) -> Table:
    columns = [
        Column("spline", numeric=False),
        Column("held by", numeric=False),
        Column("memory", "all cells"),
        Column("", "relevant cells"),
        Column("", "printed, 2008, MB"),
        Column("", "held for the level"),
        Column("", "and where"),
        Column("set-up", "s"),
        Column("", "printed, 2008"),
        Column("value and gradient", "ns a point"),
        Column("", "÷ samples"),
    ]
    rows = []
    for r in records:
        for form in r["forms"]:
            numbers = form["form"] != "samples"
            rows.append(
                [
                    label(r),
                    form["form"],
                    memory(form["bytes"]),
                    memory(form.get("relevant_bytes")),
                    printed.get(form["form"], MISSING),
                    memory(form.get("held_bytes")),
                    memory(form.get("place_bytes")),
                    text(form["seconds"]),
                    printed.get(r["method"], MISSING) if numbers else MISSING,
                    *_times(form["ns_per_point"], r["forms"][0]["ns_per_point"]),
                ]
            )
    caption = (
        "Memory in float32, numbers of all cells by their count; relevant cells: what the paper counts. Set-up of "
        "samples is that of the field; of numbers that for the level, the field's left out. Points are those of the "
        f"surface that the pictures show, at most {config.points:,}; {config.timed_by}."
    )
    return Table(columns, rows, caption)


def _times(own: Sequence[float] | None, samples: Sequence[float] | None) -> tuple[str, str]:
    if own is None or samples is None:
        return MISSING, MISSING
    return text(own[1]), text(own[1] / samples[1])


def _frames(config: Config, records: Sequence[Record], printed: Mapping[str, str]) -> Table:
    columns = [
        Column("spline", numeric=False),
        Column("view", numeric=False),
        Column("size"),
        Column("measured at"),
        Column("rays that hit", "%"),
        Column("time", "s"),
        Column("full size", "frames per second"),
        Column("", "printed, 2008"),
    ]
    rows = []
    for r in records:
        for frame in r["frames"]:
            compared = frame["view"] == "whole" and frame["size"] == [1280, 1024]
            rows.append(
                [
                    label(r),
                    frame["view"],
                    _size(frame["size"]),
                    _size(frame["measured"]),
                    text(100 * frame["hit"]),
                    text(frame["seconds"]),
                    text(frame["frames_per_second"]),
                    printed.get(f"fps {r['method']}", MISSING) if compared else MISSING,
                ]
            )
    caption = f"First hits, normals and a headlight; {config.timed_by}, on {config.device}."
    if config.scale < 1:
        caption += (
            f" Pictures were measured at {config.scale:g} of their width and height: frames per second at full size "
            "are extrapolated by the number of rays."
        )
    return Table(columns, rows, caption)


def _size(size: Sequence[int]) -> str:
    return f"{size[0]} × {size[1]}"


def _pictures(source: Source, records: Sequence[Record], folder: Path) -> list[Gallery]:
    galleries = []
    for view, window in source.windows.items():
        shown = [(r, next(f for f in r["frames"] if f["view"] == view)) for r in records]
        boxes = [source.zoom.window] if window is None else ()
        pictures = [picture(folder, f["image"], label(r), "", boxes) for r, f in shown]
        caption = "Whole; the frame is the close-up." if window is None else f"{source.zoom.title}."
        galleries.append(Gallery(pictures, caption))
    return galleries


def _printed() -> Section:
    """Both tables, as they were printed."""
    of_2008 = Table(
        [
            Column("dataset", numeric=False),
            Column("level"),
            Column("cubes"),
            Column("tetrahedra"),
            Column("D2", "MB"),
            Column("D3", "MB"),
            Column("geometry", "MB"),
            Column("octree", "s"),
            Column("qss", "s"),
            Column("cubic-c1", "s"),
            Column("qss", "frames per second"),
            Column("cubic-c1", "frames per second"),
        ],
        [[name, *row.values()] for name, row in PRINTED_2008.items()],
        "Kalbe & Zeilfelder 2008, table 1: NVIDIA 8800 Ultra (in brackets: 7600 Go), 1280 × 1024, quasi-interpolants "
        "without a prefilter. The lower of two frame rates is from far, all patches in view.",
    )
    of_2011 = Table(
        [
            Column("size"),
            Column("cubic-c1", "tetrahedra"),
            Column("", "ms"),
            Column("", "frames per second"),
            Column("quadratic-c1", "tetrahedra"),
            Column("", "ms"),
            Column("", "frames per second"),
        ],
        [row.split("|") for row in PRINTED_2011],
        "Marinc, Kalbe, Rhein & Goesele 2011, table 1: NVIDIA GTX 480, 1000 × 1000; milliseconds to list the relevant "
        "tetrahedra.",
    )
    return Section("As they were printed", (), [of_2008, of_2011])
