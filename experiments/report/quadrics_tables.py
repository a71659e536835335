"""Section of `quadrics_tables`: rates and frames per second beside the printed tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.page import Column, Gallery, Section, Table, picture
from experiments.report.style import fixed, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.quadrics_tables import Config

LEAD = (
    "What is cast is known: a torus, R = 1, r = 0.4, covered by graphs of second order in balls, every point of it in "
    "six of them, which are blended; and a sphere whose quadrics are clipped by the tetrahedra that it passes through. "
    "Rays walk down a tree, so that pictures depend little on how many quadrics there are; the paper draws each of "
    "them. Culling leaves out, exactly, what shows the eye no front; rays stop at the first sheet anyway.",
)

# As printed: Stoll, Gumhold & Seidel, Incremental raycasting of piecewise quadratic surfaces on the GPU, 2006; frames
# per second on a GeForce 7800 GT: 1280 × 1024 with culling and without, 512² with and without, software at both sizes
PRINTED_COVERS = (
    "Statue|183774|24.9|17.6|32.5|24.0|1.02|5.72",
    "Statue|74285|35.5|23.4|68.4|46.8|1.33|6.02",
    "Lucy|140724|27.8|17.4|41.7|29.5|1.08|5.05",
    "Buddha|49203|27.4|15.8|73.8|46.8|1.06|3.70",
    "Bunny|5064|35.6|21.5|> 120|68.0|1.13|3.22",
)
PRINTED_SETS = (
    "Lobster|1700148|0.5|0.5",
    "Sphere|137232|5.8|5.9",
    "Marschner-Lobb|65844|26.3|40.8",
    "Fuel|36082|56.4|71.2",
)
PRINTED_RATES = ("Brute force|342.8|–", "No clipping|600.0|–", "SLIM|457.1|6.27", "Tetrahedral|400.0|2.16")


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    listed = list(records.values())
    rates = [row for r in listed if r["kind"] == "rates" for row in r["rows"]]
    parts = [Section("Rays and quadrics per second (table 1)", (), [*_rates(config, rates), _printed_rates()])]
    for kind, title, printed in (
        ("cover", "Covers (table 2)", _printed_covers()),
        ("set", "Quadrics in tetrahedra (table 3)", _printed_sets()),
    ):
        own = [r for r in listed if r["kind"] == kind]
        parts.append(Section(title, (), [_frames(config, own), _pictures(own, folder), printed]))
    return Section("What quadrics take", LEAD, (), parts)


def _rates(config: Config, rows: Sequence[Record]) -> list[Table]:
    tables = []
    for row in rows:
        pairs = row["what"] == "pairs"
        unit = "million pairs per second" if pairs else "million quadrics per second"
        columns = [Column("", numeric=False), Column("median", unit), Column("quartiles", unit)]
        cells = [
            [name, text(m / 1e6), f"{text(a / 1e6)} … {text(b / 1e6)}"] for name, (a, m, b) in row["rates"].items()
        ]
        caption = (
            f"{row['rays']} rays with each of {row['quadrics']} quadrics, float64. The program's tree leaves most of "
            "these pairs out; the others are plain torch and try all of them."
            if pairs
            else "Built: whatever rays need, and four of them cast; once for as long as nothing changes. Culled: for "
            "one eye."
        )
        tables.append(Table(columns, cells, f"{caption} Measured: {config.timed_by}."))
    return tables


def _frames(config: Config, records: Sequence[Record]) -> Table:
    sizes = [f"{w} × {h}" for w, h in config.sizes]
    columns = [Column("quadrics"), Column("RMS error", "world units"), Column("built", "s")]
    columns += [Column(size, f"frames per second, {kind}") for size in sizes for kind in ("all", "culled")]
    columns += [Column("left by culling", "%"), Column("culled", "s")]
    rows = []
    for r in records:
        row = [f"{r['quadrics']:,}", text(r["rms"]), text(r["build_seconds"])]
        row += [text(frame[kind][1]) for frame in r["frames"] for kind in ("whole", "culled")]
        rows.append([*row, fixed(100 * r["left"], 0), text(r["cull_seconds"])])
    caption = f"Hits, normals and a headlight, rays included, float32; medians of {config.timed_by}."
    return Table(columns, rows, caption)


def _pictures(records: Sequence[Record], folder: Path) -> Gallery:
    shown = [picture(folder, r["image"], f"{r['quadrics']:,} quadrics", f"RMS {text(r['rms'])}") for r in records]
    return Gallery(shown, "As seen by the headlight, four rays a pixel.", columns=4)


def _printed_rates() -> Table:
    columns = [
        Column("as printed", numeric=False),
        Column("fill rate", "million fragments per second"),
        Column("throughput", "million quadrics per second"),
    ]
    return Table(columns, [row.split("|") for row in PRINTED_RATES], "Table 1 of the paper, GeForce 7800 GT.")


def _printed_covers() -> Table:
    sizes = ("1280 × 1024", "512 × 512")
    columns = [Column("as printed", numeric=False), Column("quadrics")]
    columns += [Column(size, kind) for size in sizes for kind in ("culling", "no culling")]
    columns += [Column(size, "software") for size in sizes]
    return Table(columns, [row.split("|") for row in PRINTED_COVERS], "Table 2 of the paper: frames per second.")


def _printed_sets() -> Table:
    columns = [Column("as printed", numeric=False), Column("tetrahedra"), Column("1280 × 1024"), Column("512 × 512")]
    return Table(columns, [row.split("|") for row in PRINTED_SETS], "Table 3 of the paper: frames per second.")
