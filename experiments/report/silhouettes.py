"""Section of `silhouettes`: estimates of derivatives beside differences, and how far apart they are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.page import Column, Section, Table
from experiments.report.style import fixed, label, text
from experiments.runs import Record
from experiments.silhouettes import chance

if TYPE_CHECKING:
    from experiments.silhouettes import Config

COLUMNS = [
    *(Column(title, numeric=False) for title in ("method", "volume", "changed", "image")),
    Column("estimate"),
    Column("±"),
    Column("differences"),
    Column("±"),
    Column("t"),
    Column("ν"),
    Column("z"),
    Column("without edges"),
]


def draw(config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    rows = [
        [
            label(r),
            *(str(r[key]) for key in ("volume", "parameter", "quantity")),
            *(text(r[key]) for key in ("mean", "error", "reference", "reference_error")),
            fixed(r["t"], 2),
            fixed(r["degrees"], 0),
            fixed(r["z"], 2),
            text(r["without"]),
        ]
        for r in records.values()
    ]
    total, likely = chance(records.values())
    greatest = max((abs(r["z"]) for r in records.values()), default=0.0)
    lead = (
        "What is differentiated is the integral of an image, weighted by another number in each quarter. Estimates: "
        f"{config.estimates} seeds, {config.size}² pixels of {config.subpixels}² rays and {config.lines} lines each. "
        f"Differences: central ones of integrals along {config.rows} rows, {config.repeats} times, in which jumps are "
        "found by looking closely at depths. t: their distance in standard errors of both, Student's of ν degrees of "
        "freedom; z: the normal number that is as likely. Without edges: one estimate of what the hits' own "
        "derivatives give.",
        f"Of all {len(rows)} derivatives Σ z² is {fixed(total, 1)}, where some {len(rows)} are expected if nothing is "
        f"wrong: that much or more comes by chance with a probability of {fixed(likely, 2)}. The greatest |z| is "
        f"{fixed(greatest, 2)}.",
    )
    return Section("Do edges move as their derivatives say?", lead, [Table(COLUMNS, rows, "Derivatives, one a row.")])
