"""Section of `terrain_error`: curves, table I beside what was printed, and fitted orders beside declared ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from experiments.report import plots
from experiments.report.page import Column, Plot, Section, Table
from experiments.report.style import LOOKS, MISSING, Look, fixed, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.terrain_error import Config

LEAD = (
    "Franke's function is sampled every 1/n on the unit square, and beyond it as far as patches reach; each spline "
    "makes a surface of these heights, which is compared with the function at uniform random points. Errors are parts "
    "of the function's greatest value. A cell of linear and c2 is one step of the data, of c1 three, of c0 four: from "
    "the same data c0 makes the fewest triangles.",
)

TITLES = {"value": "height", "gradient": "gradient", "hessian": "Hessian"}

SPLINES: Mapping[str, Look] = {
    "linear": LOOKS["trilinear"],
    "c0": LOOKS["notch"],
    "c1": LOOKS["triquadratic"],
    "c2": LOOKS["tricubic"],
    "c2 prefiltered": LOOKS["tricubic"],
}

# As printed: rms and largest error by (data, spline); digits that can't be read are left out. Of the row 16·144 the
# errors belong to 48 × 48 steps as here, the numbers of triangles printed beside them to 36 × 36.
PRINTED: Mapping[int, Mapping[str, tuple[str, str]]] = {
    12: {
        "c2": ("7.9e-3", "2.9e-2"),
        "c1": ("3.3e-3", "2.2e-2"),
        "c0": ("2.4e-3", "2.2e-2"),
        "linear": ("5.5e-3", "2.7e-2"),
    },
    24: {
        "c2": ("2.1e-3", "8.7e-3"),
        "c1": ("2.2e-4", "1.9e-3"),
        "c0": ("1.2e-4", "2.5e-3"),
        "linear": ("1.3e-3", "7.1e-3"),
    },
    48: {
        "c2": ("5.4e-4", "2.3e-3"),
        "c1": ("1.9e-5", "1.9e-4"),
        "c0": ("4.3e-6", "8.9e-5"),
        "linear": ("3.1e-4", "1.8e-3"),
    },
}


def draw(config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    errors = {(r["spline"], r["steps"]): r for r in records.values() if r["kind"] == "error"}
    fits = [r for r in records.values() if r["kind"] == "fit"]
    blocks = [_curves(config, errors), _table(config, errors), _derivatives(config, errors), _orders(config, fits)]
    return Section("Errors of quartic splines of heights", LEAD, blocks)


def _curves(config: Config, errors: Mapping[tuple[str, int], Record]) -> Plot:
    with plots.settings():
        figure = plots.canvas(11.0, 4.2)
        panels = figure.subplots(1, 3)
        for axes, (row, title) in zip(panels, TITLES.items(), strict=True):
            _panel(axes, config, errors, row, title)
        plots.legend_right(panels[-1])
        drawn = plots.svg(figure, "terrain-error")
    caption = (
        f"RMS errors at {config.points:,} uniform points; gradients and Hessians per side of the unit square. Dashed "
        "and hollow: c2 of its data as they are; solid: of prefiltered ones."
    )
    return Plot(drawn, caption)


def _panel(axes: Axes, config: Config, errors: Mapping[tuple[str, int], Record], row: str, title: str) -> None:
    for spline in config.splines:
        found = [(n, errors[spline, n][f"{row}_rms"]) for n in config.steps if (spline, n) in errors]
        own, plain = SPLINES[spline], spline != "c2"
        axes.plot(
            *zip(*found, strict=True),
            label=spline,
            color=own.light,
            marker=own.marker,
            linestyle="-" if plain else "--",
            markerfacecolor=own.light if plain else "none",
        )
    plots.logarithmic(axes)
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_locator(FixedLocator(config.steps))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}"))
    axes.set_xlabel("steps along each axis")
    axes.set_title(f"RMS error of the {title}")


def _table(config: Config, errors: Mapping[tuple[str, int], Record]) -> Table:
    columns = [Column("steps"), Column("spline", numeric=False), Column("triangles"), Column("RMS error")]
    columns += [Column("printed"), Column("ratio"), Column("largest error"), Column("printed"), Column("ratio")]
    rows = []
    for n in config.steps:
        for spline in config.splines:
            if record := errors.get((spline, n)):
                rms, largest = PRINTED.get(n, {}).get(spline, (None, None))
                pair = (*_beside(record["value_rms"], rms), *_beside(record["value_max"], largest))
                rows.append([f"{n} × {n}", spline, f"{record['triangles']:,}", *pair])
    caption = (
        "Table I of paper 004. What was printed is smaller by one factor of about 1.66, RMS and largest error alike "
        "(for linear by 1.44 to 1.66, which drifts because its grid spans the square otherwise): another normalisation "
        "of the heights. The row of 16 · 144 data is printed with the numbers of triangles of 9 · 144; its errors are "
        "those of 48 × 48 steps."
    )
    return Table(columns, rows, caption)


def _beside(own: float, printed: str | None) -> tuple[str, str, str]:
    if printed is None:
        return text(own), MISSING, MISSING
    return text(own), text(float(printed), 2), fixed(own / float(printed))


def _derivatives(config: Config, errors: Mapping[tuple[str, int], Record]) -> Table:
    columns = [Column("steps")]
    for spline in config.splines:
        columns += [Column(spline, "gradient"), Column("", "Hessian")]
    rows = []
    for n in config.steps:
        found = [errors.get((spline, n)) for spline in config.splines]
        pairs = [(text(r["gradient_rms"]), text(r["hessian_rms"])) if r else (MISSING, MISSING) for r in found]
        rows.append([f"{n} × {n}", *(cell for pair in pairs for cell in pair)])
    return Table(columns, rows, "RMS errors of gradient and Hessian, as parts of the greatest height, per side.")


def _orders(config: Config, fits: list[Record]) -> Table:
    columns = [Column("spline", numeric=False), Column("declared order"), Column("fitted order", "height")]
    columns += [Column("difference"), Column("fitted order", "gradient"), Column("fitted order", "Hessian")]
    rows = []
    for fit in fits:
        value, declared = fit["value_order"], fit["declared_order"]
        apart = None if value is None else value - declared
        rows.append(
            [
                fit["spline"],
                str(declared),
                fixed(value),
                fixed(apart),
                fixed(fit["gradient_order"]),
                fixed(fit["hessian_order"]),
            ]
        )
    used = ", ".join(map(str, config.fitted))
    return Table(columns, rows, f"Orders fitted by least squares to {used} steps along each axis.")
