"""Section of `rms_error`: error curves of value and gradient, their numbers, and fitted orders beside declared ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from markupsafe import Markup
from matplotlib.axes import Axes

from experiments.report import plots
from experiments.report.page import Block, Column, Plot, Section, Table
from experiments.report.style import MISSING, fixed, label, line_style, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.rms_error import Config, Study

Errors = Mapping[tuple[str, int], Record]
"""Records by recipe and resolution."""

LEAD = (
    "Each signal is sampled at cell centres on cubic grids, reconstructed, and compared with itself at uniform random "
    "points; gradients are per world unit and compared as vectors. Away from the limit of resolution the error of a "
    "method of order L falls as the L-th power of the voxel size: a straight line with that slope.",
)


def draw(config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    parts = [_study(config, study, i, records) for i, study in enumerate(config.studies)]
    title = "Error of value and gradient against resolution"
    if len(parts) == 1:
        return Section(title, LEAD, parts[0].blocks)
    return Section(title, LEAD, (), parts)


def _study(config: Config, study: Study, index: int, records: Mapping[str, Record]) -> Section:
    errors, fits = of_study(index, records)
    blocks: list[Block] = []
    if errors:
        blocks.append(_curves(study, index, errors, config))
        blocks.append(_numbers(study, errors, "value_rms", "RMS errors of the value at each resolution."))
        blocks.append(_numbers(study, errors, "gradient_rms", "RMS errors of the gradient, per world unit."))
    if fits:
        blocks.append(_orders(fits))
    return Section(study.signal.label, (), blocks)


def _curves(study: Study, index: int, errors: Errors, config: Config) -> Plot:
    titles = {"value_rms": "RMS error of the value", "gradient_rms": "RMS error of the gradient"}
    drawn = curves(study, errors, titles, f"rms-{index}")
    caption = (
        f"Signal {study.signal.label}, {config.points:,} uniform points of the box shrunk to {study.inner:g}, boundary "
        f"{config.boundary}, {config.dtype}. Left: value. Right: gradient, per world unit."
    )
    if any(not r["prefilter"] for r in errors.values()):
        caption += " Dashed and hollow: without the prefilter."
    if any(not r["default_gradient"] for r in errors.values()):
        caption += " Dotted, with wide rings: another kind of gradient than the method's own, with the same value."
    return Plot(drawn, caption)


def of_study(index: int, records: Mapping[str, Record]) -> tuple[Errors, list[Record]]:
    """The errors and the fits of a study."""
    chosen = [r for r in records.values() if r["study"] == index]
    errors = {(r["recipe"], r["resolution"]): r for r in chosen if r["kind"] == "error"}
    return errors, [r for r in chosen if r["kind"] == "fit"]


def curves(study: Study, errors: Errors, titles: Mapping[str, str], name: str) -> Markup:
    """Two quantities against resolution, side by side: {quantity: its title}."""
    with plots.settings():
        figure = plots.canvas(10.4, 4.6)
        panels = figure.subplots(1, 2)
        for axes, (quantity, title) in zip(panels, titles.items(), strict=True):
            _panel(axes, study, errors, quantity, title)
        plots.legend_right(panels[-1])
        return plots.svg(figure, name)


def _panel(axes: Axes, study: Study, errors: Errors, quantity: str, title: str) -> None:
    for recipe in recipes(errors):
        found = [errors[recipe, n] for n in study.resolutions if (recipe, n) in errors]
        found = [r for r in found if r[quantity]]
        if not found:
            continue
        x, y = [r["resolution"] for r in found], [r[quantity] for r in found]
        axes.plot(x, y, label=label(found[0]), **line_style(found[0]))
    plots.logarithmic(axes)
    plots.resolution_axis(axes, study.resolutions)
    axes.set_title(title)


def recipes(errors: Errors) -> list[str]:
    """Those that there are records of, in their order."""
    return list(dict.fromkeys(recipe for recipe, _ in errors))


def _numbers(study: Study, errors: Errors, quantity: str, caption: str) -> Table:
    columns = [Column("method", numeric=False), *(Column(f"{n}³") for n in study.resolutions)]
    rows = []
    for recipe in recipes(errors):
        found = [errors.get((recipe, n)) for n in study.resolutions]
        name = label(next(r for r in found if r))
        rows.append([name, *(text(r[quantity]) if r else MISSING for r in found)])
    return Table(columns, rows, caption)


def _orders(fits: list[Record]) -> Table:
    columns = [
        Column("method", numeric=False),
        Column("declared order"),
        Column("fitted order", "value"),
        Column("difference"),
        Column("fitted order", "gradient"),
        Column("gradient", numeric=False),
    ]
    rows = []
    for fit in fits:
        declared, value = fit["declared_order"], fit["value_order"]
        difference = None if value is None else value - declared
        rows.append(
            [label(fit), str(declared), fixed(value), fixed(difference), fixed(fit["gradient_order"]), fit["gradient"]]
        )
    used = ", ".join(map(str, fits[0]["resolutions"]))
    caption = (
        f"Orders fitted by least squares to the resolutions {used}. An order is a statement about "
        "the limit: it shows where the signal is resolved well, and not before."
    )
    return Table(columns, rows, caption)
