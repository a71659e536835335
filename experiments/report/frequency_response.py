"""Section of `frequency_response`: curves with measured markers, their tails, and the measures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from experiments.report import plots
from experiments.report.page import Block, Column, Plot, Section, Table
from experiments.report.style import label, line_style, text
from experiments.runs import Record, run_file

if TYPE_CHECKING:
    from experiments.frequency_response import Config

LEAD = (
    "Lines are the closed form P(ω)Φ(ω) of prefilter and kernel along an axis; markers are measured, by transforming "
    "the impulse response of the method as it is implemented (every fourth is drawn). The ideal is 1 up to the "
    "Nyquist frequency ω = π (vertical line) and 0 above: what is missing below smooths, what is left above aliases.",
)
FLOOR = 1e-7
STAGGER = 4  # every fourth marker is drawn, each method from another one, so that curves stay visible


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    blocks: list[Block] = []
    for index, figure in enumerate(config.figures):
        chosen = [records[r.key] for r in figure.methods if r.key in records]
        if chosen:
            blocks.append(_curves(config, index, figure.title, figure.caption, chosen, folder))
    found = [records[r.key] for r in config.methods if r.key in records]
    if found:
        blocks.append(_measures(found, config.dimensions))
    return Section("Frequency responses", LEAD, blocks)


def _curves(config: Config, index: int, title: str, caption: str, records: Sequence[Record], folder: Path) -> Plot:
    with plots.settings():
        figure = plots.canvas(10.4, 4.0)
        left, right = figure.subplots(1, 2)
        for position, record in enumerate(records):
            every = (position * STAGGER // len(records), STAGGER)
            _response(left, record, folder, every, magnitude=False)
            _response(right, record, folder, every, magnitude=True)
        _linear(left, title, config.upper)
        _logarithmic(right, config.upper)
        plots.legend_right(right)
        drawn = plots.svg(figure, f"response-{index}")
    return Plot(drawn, f"{caption} Left: linear scale. Right: magnitude on a logarithmic scale, cut off at 10⁻⁷.")


def _response(axes: Axes, record: Record, folder: Path, every: tuple[int, int], *, magnitude: bool) -> None:
    style = line_style(record)
    at, measured = np.load(run_file(folder, record["measured_omega"])), np.load(run_file(folder, record["measured"]))
    if magnitude:
        measured = np.abs(measured)
        shown = measured > FLOOR
        at, measured = at[shown], measured[shown]
    if "closed" in record:
        omega, closed = np.load(run_file(folder, record["omega"])), np.load(run_file(folder, record["closed"]))
        drawn = np.maximum(np.abs(closed), FLOOR / 100) if magnitude else closed
        axes.plot(omega, drawn, color=style["color"], linestyle=style["linestyle"])
    axes.plot(at, measured, markevery=every, **{**style, "linestyle": "none"})
    axes.plot([], [], label=label(record, gradient=False), **style)


def _linear(axes: Axes, title: str, upper: float) -> None:
    axes.axvline(math.pi, color=plots.INK, linewidth=0.8, alpha=0.6)
    axes.set_ylim(-0.15, 1.1)
    plots.pi_axis(axes, upper * math.pi)
    axes.set_title(f"{title}: P(ω)Φ(ω)")


def _logarithmic(axes: Axes, upper: float) -> None:
    axes.axvline(math.pi, color=plots.INK, linewidth=0.8, alpha=0.6)
    plots.logarithmic(axes)
    axes.set_ylim(FLOOR, 2)
    plots.pi_axis(axes, upper * math.pi)
    axes.set_title("|P(ω)Φ(ω)|")


def _measures(records: Sequence[Record], dimensions: Sequence[int]) -> Table:
    measures = [(name, d) for d in dimensions for name in ("smoothing", "postaliasing")]
    columns = [
        Column("method", numeric=False),
        *(Column(name, f"{d}-D") for name, d in measures),
        Column("response at π"),
        Column("largest difference", "closed − measured"),
    ]
    rows = [
        [
            label(r, gradient=False),
            *(text(r[f"{name}_{d}d"]) for name, d in measures),
            text(0.0 if abs(r["at_nyquist"]) < 1e-12 else r["at_nyquist"]),
            text(r["largest_difference"], 2),
        ]
        for r in records
    ]
    caption = (
        "Smoothing and postaliasing after Marschner & Lobb (0 is ideal; smaller is better in both). Last column: the "
        "largest difference between the closed form and the measured markers. A dash: measured only, as the method has "
        "no closed form."
    )
    return Table(columns, rows, caption)
