"""Section of `texture_precision`: errors of every variant beside the error of the method itself, and image pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from experiments.report import plots
from experiments.report.page import Block, Column, Gallery, Plot, Section, Table, picture
from experiments.report.style import MISSING, fixed, label, look, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.texture_precision import Config

LEAD = (
    "A texture unit rounds the fractions of a trilinear sample to 1/256. Every error here is against the direct sum in "
    "float64 over the same samples, at the same points: of the value relative to the range of the samples, of the "
    "gradient relative to its RMS length. For a signal, the vertical bar is the error of the reconstruction itself: "
    "what lies left of it is lost in it.",
)
MARKERS = {
    "float64 eight samples": ("|", 9.0),
    "float32 direct": ("o", 5.0),
    "float32 eight samples": ("s", 8.0),
    "float32 8-bit fractions": ("D", 6.0),
}
HOLLOW = ("float32 eight samples",)


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    parts = []
    for index, source in enumerate(config.sources):
        points = [records[k] for k in (f"{index}/points/{r.key}" for r in config.methods) if k in records]
        images = [records[k] for k in (f"{index}/image/{r.key}" for r in config.image_methods) if k in records]
        blocks: list[Block] = []
        if points:
            blocks += [_plot(index, points), _numbers(points, config.inner)]
        if images:
            blocks.append(_pairs(config, images, folder))
        parts.append(Section(source.title, (), blocks))
    title = "What 8-bit fractions of a texture unit cost"
    return Section(title, LEAD, parts[0].blocks) if len(parts) == 1 else Section(title, LEAD, (), parts)


def _plot(index: int, records: Sequence[Record]) -> Plot:
    with plots.settings():
        figure = plots.canvas(10.4, 1.4 + 0.42 * len(records))
        left, right = figure.subplots(1, 2, sharey=True)
        _panel(left, records, "value_rms", "RMS error of the value / range")
        _panel(right, records, "gradient_rms", "RMS error of the gradient / RMS length")
        handles = [
            Line2D([], [], linestyle="none", marker=m, markersize=s, color=plots.INK,
                   markerfacecolor="none" if name in HOLLOW else plots.INK, label=name)
            for name, (m, s) in MARKERS.items()
        ]  # fmt: skip
        if any("method_error" in r for r in records):
            handles.append(Line2D([], [], color=plots.INK, linewidth=2.5, label="the reconstruction itself"))
        figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False)
        drawn = plots.svg(figure, f"precision-{index}")
    caption = "Each row is a method, each marker a way of computing it; further left is better. No marker: no error."
    return Plot(drawn, caption)


def _panel(axes: Axes, records: Sequence[Record], quantity: str, title: str) -> None:
    for row, record in enumerate(records):
        color = look(record["method"]).light
        for name, (marker, size) in MARKERS.items():
            value = record["variants"][name][quantity]
            if value:
                face = "none" if name in HOLLOW else color
                axes.plot([value], [row], marker=marker, markersize=size, color=color, markerfacecolor=face)
        own = record.get("method_error")
        if own and own[quantity]:
            axes.plot([own[quantity]] * 2, [row - 0.32, row + 0.32], color=color, linewidth=2.5)
    axes.set_yticks(range(len(records)), [label(r, gradient=False) for r in records])
    axes.set_ylim(len(records) - 0.5, -0.5)
    plots.logarithmic_x(axes)
    axes.set_title(title)


def _numbers(records: Sequence[Record], inner: float) -> Table:
    columns = [
        Column("method", numeric=False),
        Column("computed in", numeric=False),
        Column("value, RMS", "/ range"),
        Column("largest", "/ range"),
        Column("gradient, RMS", "/ RMS length"),
        Column("largest", "/ RMS length"),
        Column("angle, mean", "degrees"),
        Column("largest", "degrees"),
    ]
    rows = []
    for record in records:
        entries = dict(record["variants"])
        if "method_error" in record:
            entries["the reconstruction itself"] = record["method_error"]
        for i, (name, r) in enumerate(entries.items()):
            keys = ("value_rms", "value_max", "gradient_rms", "gradient_max", "angle_mean", "angle_max")
            rows.append([label(record, gradient=False) if i == 0 else "", name, *(text(r[k], 2) for k in keys)])
    caption = (
        f"Against the direct sum in float64, at {records[0]['points']:,} uniform points of the box shrunk to "
        f"{inner:g}. Angles where the gradient is longer than 1 % of the longest. “The reconstruction itself”: "
        "the direct sum in float64 against the signal."
    )
    return Table(columns, rows, caption)


def _pairs(config: Config, records: Sequence[Record], folder: Path) -> Gallery:
    pictures = []
    for r in records:
        name = label(r, gradient=False)
        psnr = MISSING if r["psnr"] is None else f"{fixed(r['psnr'], 1)} dB"
        pictures += [
            picture(folder, r["exact"], f"{name}, exact fractions", "float32"),
            picture(folder, r["rounded"], f"{name}, 8-bit fractions", f"{psnr}, largest {text(r['max'], 2)}"),
            picture(folder, r["difference"], "difference", f"amplified {config.amplify:g} times"),
        ]
    caption = (
        "The same scene with exact and with 8-bit fractions, and the absolute difference as displayed, amplified "
        f"{config.amplify:g} times."
    )
    return Gallery(pictures, caption, columns=3)
