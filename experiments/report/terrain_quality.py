"""Section of `terrain_quality`: every look of every spline, of the same data and of equal errors, and the numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.page import Block, Column, Gallery, Section, Table, picture
from experiments.report.style import fixed, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.terrain_quality import Config

TITLES = {
    "normals": "Normals, as colours",
    "illumination": "Lit, matt",
    "reflection lines": "Reflection lines",
}
READ = {
    "normals": "½ + ½ n as red, green, blue: where normals jump, colours do.",
    "illumination": "Light from the left, no shadows: creases are where normals jump.",
    "reflection lines": (
        "Mirrored stripes of light. Where a surface is only continuous they tear, where its normals are they kink, "
        "where its curvature is they are smooth."
    ),
}


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    pictures = [r for r in records.values() if r["kind"] == "picture"]
    parts = [Section(TITLES[look], (READ[look],), _galleries(config, pictures, look, folder)) for look in config.looks]
    numbers = [_numbers(config, records, pictures)]
    lead = (
        f"Franke's function on the unit square, {config.height:g} times as high as it is, and quartic splines of its "
        f"samples, hit exactly. “The same data”: {config.steps} × {config.steps} steps for all. “Equal errors”: as "
        f"few steps as keep the RMS error below that of {config.reference.spline} with {config.reference.steps} × "
        f"{config.reference.steps}. Below each picture: data, and the mean angle between normals and those of the "
        "function.",
    )
    return Section("What smoothness looks like", lead, numbers, parts)


def _galleries(config: Config, records: Sequence[Record], look: str, folder: Path) -> list[Block]:
    blocks: list[Block] = []
    seen = [r for r in records if r["look"] == look]
    for groups, caption in ((("function", "same"), "From the same data."), (("equal",), "From data for equal errors.")):
        shown = [r for r in seen if r["group"] in groups]
        if shown:
            pictures = [picture(folder, r["image"], _name(r), _detail(r)) for r in shown]
            blocks.append(Gallery(pictures, caption, columns=3 if "same" in groups else 2))
    return blocks


def _name(record: Record) -> str:
    return "the function itself" if record["group"] == "function" else record["spline"]


def _detail(record: Record) -> str:
    if record["group"] == "function":
        return ""
    return f"{record['data']:,} data, normals off by {text(record['angle_mean'], 2)}°"


def _numbers(config: Config, records: Mapping[str, Record], pictures: Sequence[Record]) -> Table:
    columns = [
        Column("", numeric=False),
        Column("spline", numeric=False),
        Column("steps"),
        Column("data"),
        Column("RMS error", "of the greatest height"),
        Column("normals", "mean angle, °"),
        Column("", "largest, °"),
    ]
    rows = []
    first = config.looks[0]
    for r in pictures:
        if r["look"] == first and r["group"] != "function":
            short = r["group"] == "equal" and not records[f"data/{r['spline']}"]["reached"]
            rows.append(
                [
                    {"same": "the same data", "equal": "equal errors"}[r["group"]]
                    + (" (not reached)" if short else ""),
                    r["spline"],
                    f"{r['steps']} × {r['steps']}",
                    f"{r['data']:,}",
                    text(r["rms"]),
                    fixed(r["angle_mean"], 3),
                    fixed(r["angle_max"], 2),
                ]
            )
    return Table(columns, rows, f"RMS errors at {config.points:,} uniform points; angles at the pixels that are seen.")
