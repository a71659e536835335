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
    blocks = (
        [_bounds(config, listed), _truth(config, listed), _images(config, listed), _points(config, listed)]
        if listed
        else []
    )
    return Section("Trilinear where it is as good", _lead(config, listed), blocks)


def _lead(config: Config, records: Sequence[Record]) -> list[str]:
    lead = [
        f"In a brick of {config.brick}³ cells in which trilinear interpolation differs from the method by less than a "
        "budget, by a bound from second differences of the coefficients, it could take the method's place. The budget "
        "is for values, in parts of the volume's range; nothing is bounded for gradients, and so nothing for lighting."
    ]
    if records:
        last = str(len(config.budgets) - 1)
        visible = [r for r in records if r["visible_bricks"]]
        frames = max((projected(r["visible_shares"][-1], r["image"]["cheap"][1]) for r in visible), default=1.0)
        points = max(projected(r["shares"][-1], r["points"]["cheap"][1]) for r in records)
        measured = max(1 / r["points"][last][1] for r in records)
        lead.append(
            f"At the largest budget ({_percent(config.budgets[-1])}), on the volume where it buys most: an unlit frame "
            f"{times(frames)} as fast at best; values at points all over the volume, most of them in empty parts, "
            f"{times(points)} at best, and {times(measured)} when built from torch's selections. Frames "
            f"{_verdict(frames)}, and points as measured {_verdict(measured)}, the {WORTH} × from which on it would be "
            "worth its code."
        )
    return lead


def _verdict(speed: float) -> str:
    return "reach" if speed >= WORTH else "do not reach"


def _percent(part: float | None) -> str:
    return text(None if part is None else 100 * part) + " %"


def _columns(config: Config, *more: Column) -> list[Column]:
    return [Column("volume", numeric=False), Column("method", numeric=False), *more]


def _bounds(config: Config, records: Sequence[Record]) -> Table:
    columns = _columns(config, Column("visible", "of bricks"))
    for title in ("bricks", "visible bricks"):
        columns += [Column(title if i == 0 else "", _percent(b)) for i, b in enumerate(config.budgets)]
    rows = []
    for r in records:
        shares = [_percent(s) for k in ("shares", "visible_shares") for s in r[k]]
        rows.append([r["volume"], r["method"], _percent(r["visible_bricks"] / r["bricks"]), *shares])
    caption = (
        f"Which part of all bricks, and of those with values above {_percent(config.visible)} of the range, qualifies "
        "for each budget."
    )
    return Table(columns, rows, caption)


def _truth(config: Config, records: Sequence[Record]) -> Table:
    columns = _columns(config)
    columns += [Column("truly within" if i == 0 else "", _percent(b)) for i, b in enumerate(config.budgets)]
    columns += [Column("RMS", "of the range"), Column("largest", "of the range"), Column("of the bound", "at most")]
    rows = []
    for r in records:
        ends = [_percent(r["true_rms"]), _percent(r["true_max"]), fixed(r["most_of_bound"])]
        rows.append([r["volume"], r["method"], *map(_percent, r["share_truly_within"]), *ends])
    caption = (
        "At which part of uniform random points, visible or not, the true difference is within each budget: what a "
        "perfect bound of single points would find. Then the true difference, and the largest part of its cell's bound "
        "that it reaches: never above 1."
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
        "telling them apart and reading a second volume took none. Ceiling: if every brick qualified; part of it is "
        "that more bricks are empty for trilinear, whose samples range less than the coefficients do."
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
