"""Section of `brick_economy`: how many bricks a cheaper method would do for, and what that would buy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.brick_economy import projected
from experiments.report.page import Column, Section, Table
from experiments.report.style import fixed, text, times
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.brick_economy import Config

WORTH = 1.3
"""The speed-up from which on it would be worth its code."""


def draw(config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    listed = list(records.values())
    blocks = [_bounds(config, listed), _images(config, listed), _points(config, listed)] if listed else []
    return Section("Trilinear where it is as good", _lead(config, listed), blocks)


def _lead(config: Config, records: Sequence[Record]) -> list[str]:
    lead = [
        f"In a brick of {config.brick}³ cells in which trilinear interpolation differs from the method by less than a "
        "budget, by a bound from second differences of the coefficients, it could take the method's place. The budget "
        "is for values, in parts of the volume's range; nothing is bounded for gradients, and so nothing for lighting."
    ]
    if records:
        frames = max(projected(r["visible_shares"][-1], r["image"]["cheap"][1]) for r in records if r["visible_bricks"])
        points = max(1 / r["points"][str(len(config.budgets) - 1)][1] for r in records)
        verdict = "reaches" if max(frames, points) >= WORTH else "does not reach"
        lead.append(
            f"At the largest budget ({_percent(config.budgets[-1])}) and on the volume where it buys most, an unlit "
            f"frame would be {times(frames)} as fast at best, and values at points are, as measured, {times(points)} "
            f"as fast. That {verdict} the {WORTH} × from which on it would be worth its code."
        )
    return lead


def _percent(part: float | None) -> str:
    return text(None if part is None else 100 * part) + " %"


def _columns(config: Config, *more: Column) -> list[Column]:
    return [Column("volume", numeric=False), Column("method", numeric=False), *more]


def _bounds(config: Config, records: Sequence[Record]) -> Table:
    columns = _columns(config, Column("visible", "of bricks"))
    for title in ("bricks", "visible bricks", "points truly"):
        columns += [Column(title if i == 0 else "", _percent(b)) for i, b in enumerate(config.budgets)]
    columns += [Column("RMS"), Column("largest"), Column("of the bound", "at most")]
    rows = []
    for r in records:
        shares = [_percent(s) for k in ("shares", "visible_shares", "share_truly_within") for s in r[k]]
        ends = [_percent(r["true_rms"]), _percent(r["true_max"]), fixed(r["most_of_bound"])]
        rows.append([r["volume"], r["method"], _percent(r["visible_bricks"] / r["bricks"]), *shares, *ends])
    caption = (
        "Which part of all bricks, and of those with some opacity, qualifies for each budget; and at which part of "
        "uniform random points the true difference is within it, which a perfect bound of single points would find. "
        "Then the true difference, and the largest part of its cell's bound that it reaches: never above 1."
    )
    return Table(columns, rows, caption)


def _images(config: Config, records: Sequence[Record]) -> Table:
    columns = _columns(config, Column("frame", "ms"), Column("trilinear", "÷ method"))
    columns += [Column("projected" if i == 0 else "", _percent(b)) for i, b in enumerate(config.budgets)]
    columns.append(Column("ceiling"))
    rows = []
    for r in records:
        ratio = r["image"]["cheap"][1]
        speeds = [times(projected(s, ratio)) for s in r["visible_shares"]]
        rows.append(
            [r["volume"], r["method"], text(1e3 * r["image"]["seconds"][1]), fixed(ratio), *speeds, times(1 / ratio)]
        )
    caption = (
        f"Unlit frames of {config.size}² pixels, values below {_percent(config.visible)} of the range transparent, "
        f"empty bricks skipped, {config.timed_by}. Projected: if qualifying bricks took the time of trilinear, and "
        "telling them apart and reading a second volume took none. Ceiling: if every brick qualified."
    )
    return Table(columns, rows, caption)


def _points(config: Config, records: Sequence[Record]) -> Table:
    columns = _columns(config, Column("method", "ns a point"), Column("trilinear", "÷ method"))
    for title in ("projected", "measured"):
        columns += [Column(title if i == 0 else "", _percent(b)) for i, b in enumerate(config.budgets)]
    rows = []
    for r in records:
        found = r["points"]
        ratio = found["cheap"][1]
        speeds = [times(projected(s, ratio)) for s in r["shares"]]
        speeds += [times(1 / found[str(i)][1]) for i in range(len(config.budgets))]
        nanoseconds = text(1e9 * found["seconds"][1] / config.timed_points)
        rows.append([r["volume"], r["method"], nanoseconds, fixed(ratio), *speeds])
    caption = (
        f"Values at {config.timed_points:,} points along rays, half a voxel apart. Measured: points are told apart by "
        "brick, sampled by one field or the other, and put together; below 1 × it costs more than it saves."
    )
    return Table(columns, rows, caption)
