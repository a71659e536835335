"""Section of `prefilters_on_tetrahedra`: what prefilters do to errors, spectra, noise and surfaces of splines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from experiments.comparison import QUANTITIES
from experiments.report import plots
from experiments.report.page import Block, Column, Gallery, Plot, Section, Table, picture
from experiments.report.style import LOOKS, MISSING, fixed, look, text
from experiments.runs import Record, run_file

if TYPE_CHECKING:
    from experiments.prefilters_on_tetrahedra import Config, Pictures

PUBLISHED, RECURSIVE, FIR = "published", "recursive", "fir"
NAMES = {PUBLISHED: "as published", RECURSIVE: "recursive prefilter"}
DASHES: tuple[Any, ...] = (":", (0, (5, 1.5, 1, 1.5)), "-.", (0, (1, 1)))  # of the learned ones, one after the other
DIRECTIONS = ("along an axis, (ω, 0, 0)", "face diagonal, (ω, ω, 0)", "space diagonal, (ω, ω, ω)")


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    of_kind = {
        kind: [r for r in records.values() if r["kind"] == kind] for kind in ("fit", "spectrum", "errors", "picture")
    }
    parts = [
        ("Errors", _errors(config, of_kind["errors"])),
        ("Noise", _noise(config, of_kind["errors"])),
        ("Spectra", _spectra(config, of_kind["spectrum"], folder)),
        ("Short prefilters", _learned(config, of_kind["fit"])),
        ("Surfaces", _pictures(config, of_kind["picture"], folder)),
    ]
    sections = [Section(title, (), blocks) for title, blocks in parts if blocks]
    return Section("Prefilters for splines on tetrahedra", _lead(config, of_kind), (), sections)


def _name(variant: str) -> str:
    return NAMES.get(variant) or f"{variant.removeprefix(FIR)} taps"


def _lead(config: Config, of_kind: Mapping[str, Sequence[Record]]) -> list[str]:
    lead = [
        "Published, these splines take the samples as they are, and blur: they are of order 2. The recursive prefilter "
        "of the quadratic B-spline undoes that and makes them of order 3; short symmetric ones, learned for each, are "
        "set beside it. Noise is sharpened like all else: where there is much of it the published form gains."
    ]
    if of_kind["errors"]:
        lead.append(" ".join(_gain(r) for r in of_kind["errors"] if r["resolution"] == config.resolutions[-1]))
    if of_kind["fit"]:
        lead.append(_short_in_words(config, of_kind["fit"]))
    return lead


def _gain(record: Record) -> str:
    published, recursive = (_entry(record, v) for v in (PUBLISHED, RECURSIVE))
    ratios = [published[q]["error"] / recursive[q]["error"] for q in QUANTITIES]
    value, gradient = (_from(recursive["equal_noise"][q]) for q in QUANTITIES)
    return (
        f"{record['spline']} at {record['resolution']}³: the recursive prefilter makes the error of the value "
        f"{text(ratios[0], 2)} times smaller and that of the gradient {text(ratios[1], 2)} times; the published form "
        f"has the better value {value}, the better gradient {gradient}."
    )


def _from(noise: float | None) -> str:
    return "at no level of noise" if noise is None else f"from {text(100 * noise, 2)} % of noise on"


def _short_in_words(config: Config, fits: Sequence[Record]) -> str:
    said = []
    for taps in config.learning.taps:
        own = [f["against_recursive"] for f in fits if f["taps"] == taps]
        if own:
            spans = [sorted(100 * (f[q]["ratio"] - 1) for f in own) for q in QUANTITIES]
            value, gradient = (f"{_signed(s[0])} … {_signed(s[-1])}" for s in spans)
            said.append(f"{taps} taps: value {value}, gradient {gradient}")
    title = config.learning.source.title
    return f"Errors of the learned prefilters on {title}, beside the recursive one: {'; '.join(said)}."


def _signed(change: float) -> str:
    shown = fixed(change, 1)
    return f"{'+' if change > 0 and shown != '0.0' else ''}{shown} %"


def _entry(record: Record, variant: str) -> Record:
    return next(v for v in record["variants"] if v["variant"] == variant)


# --- errors and noise -------------------------------------------------------------------------------------------------


def _errors(config: Config, records: Sequence[Record]) -> list[Block]:
    if not records:
        return []
    caption = (
        f"RMS errors of value and gradient (per world unit) without noise: {config.signal.label}, n³ cell-centred "
        f"samples, boundary reflect, {config.points:,} uniform points of the box shrunk to {config.inner:g}."
    )
    return [_by_resolution(config, records, config.variants, lambda entry, q: text(entry[q]["error"]), "", caption)]


def _by_resolution(
    config: Config,
    records: Sequence[Record],
    variants: Sequence[str],
    cell: Callable[[Record, str], str],
    unit: str,
    caption: str,
) -> Table:
    """A row for each spline and prefilter, two columns for each resolution: what a cell says of value and gradient."""
    columns = [Column("spline", numeric=False), Column("prefilter", numeric=False)]
    for n in config.resolutions:
        columns += [Column(f"{n}³", f"value{unit}"), Column("", f"gradient{unit}")]
    found = {(r["spline"], r["resolution"]): r for r in records}
    rows = [
        [
            spline,
            _name(variant),
            *(
                cell(_entry(found[spline, n], variant), q) if (spline, n) in found else MISSING
                for n in config.resolutions
                for q in QUANTITIES
            ),
        ]
        for spline in config.splines
        for variant in variants
    ]
    return Table(columns, rows, caption)


def _noise(config: Config, records: Sequence[Record]) -> list[Block]:
    if not records:
        return []
    n = config.resolutions[len(config.resolutions) // 2]
    shown = [r for r in records if r["resolution"] == n]
    return [*([_noise_plot(config, shown, n)] if shown else []), _equal(config, records), _gains(config, records)]


def _noise_plot(config: Config, records: Sequence[Record], n: int) -> Plot:
    with plots.settings():
        figure = plots.canvas(10.8, 6.4)
        grid = figure.subplots(2, len(records), squeeze=False, sharex=True, sharey="row")
        for column, record in zip(grid.T, records, strict=True):
            for axes, quantity in zip(column, QUANTITIES, strict=True):
                _noise_panel(axes, config, record, quantity)
        for row, quantity in zip(grid, QUANTITIES, strict=True):
            row[0].set_ylabel(f"RMS error of the {quantity}")
        for axes in grid[-1]:
            axes.set_xlabel("noise ÷ range of the samples")
        _legend(figure, config)
        drawn = plots.svg(figure, "noise")
    caption = (
        f"RMS errors of value (above) and gradient (below) against the noise in the samples, at {n}³; independent, "
        "Gaussian, its standard deviation as a share of the range of the samples. Vertical: where the published form "
        "and the recursive prefilter are equally good."
    )
    return Plot(drawn, caption)


def _noise_panel(axes: Axes, config: Config, record: Record, quantity: str) -> None:
    for variant in config.variants:
        y = _entry(record, variant)[quantity]["noisy"]
        axes.plot(config.noise, y, **_line(record["spline"], variant, config))
    if at := _entry(record, RECURSIVE)["equal_noise"][quantity]:
        axes.axvline(at, color=plots.RULE, linewidth=1.0)
    axes.set_title(record["spline"])
    plots.logarithmic(axes)
    plots.logarithmic_x(axes)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g} %"))


def _line(spline: str, variant: str, config: Config) -> dict[str, Any]:
    own, short = look(spline), {"color": LOOKS["trilinear"].light, "linewidth": 1.3}
    if variant == PUBLISHED:
        return {"color": own.light, "linestyle": "--", "linewidth": 1.8}
    if variant == RECURSIVE:
        return {"color": own.light, "linewidth": 1.8}
    return {**short, "linestyle": DASHES[config.variants[2:].index(variant) % len(DASHES)]}


def _legend(figure: Canvas, config: Config) -> None:
    """One for all splines: what has a spline's colour is drawn in the page's."""
    handles = []
    for variant in config.variants:
        style = _line(config.splines[0], variant, config)
        if variant in NAMES:
            style["color"] = plots.INK
        handles.append(Line2D([], [], label=_name(variant), **style))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)


def _equal(config: Config, records: Sequence[Record]) -> Table:
    caption = (
        "From which noise on the published form is better than with that prefilter: standard deviation in percent of "
        "the range of the samples. A dash: one of the two is better at every level."
    )
    return _by_resolution(config, records, config.variants[1:], _percent, ", %", caption)


def _percent(entry: Record, quantity: str) -> str:
    share = entry["equal_noise"][quantity]
    return MISSING if share is None else text(100 * share, 2)


def _gains(config: Config, records: Sequence[Record]) -> Table:
    n = config.resolutions[-1]
    own = {r["spline"]: r for r in records if r["resolution"] == n}
    columns = [Column("spline", numeric=False), *(Column(_name(v)) for v in config.variants)]
    rows = [[s, *(text(_entry(r, v)["value"]["gain"]) for v in config.variants)] for s, r in own.items()]
    caption = (
        f"How much of white noise is left in the value: RMS of the field ÷ standard deviation of the samples, at {n}³."
    )
    return Table(columns, rows, caption)


# --- spectra ----------------------------------------------------------------------------------------------------------


def _spectra(config: Config, records: Sequence[Record], folder: Path) -> list[Block]:
    if not records:
        return []
    with plots.settings():
        figure = plots.canvas(10.8, 2.9 * len(records) + 0.5)
        grid = figure.subplots(len(records), len(DIRECTIONS), squeeze=False, sharex=True, sharey=True)
        for row, record in zip(grid, records, strict=True):
            for i, axes in enumerate(row):
                _spectrum_panel(axes, config, record, i, folder)
            row[0].set_ylabel(record["spline"])
        for axes, direction in zip(grid[0], DIRECTIONS, strict=True):
            axes.set_title(direction)
        for row in grid[:-1]:
            for axes in row:
                axes.set_xlabel("")
        _legend(figure, config)
        drawn = plots.svg(figure, "spectra")
    spread = max(records, key=lambda r: r["spread"])
    alike = max(r["from_bspline"] for r in records)
    far = max(r["largest_difference"] for r in records)
    caption = (
        "Responses: the transform of the field of one sample, as it is implemented, times that of the prefilter. 1 up "
        "to the Nyquist frequency ω = π (vertical line) and 0 above would be ideal. Shaded: between the least and the "
        "greatest of the four positions that a sample has in truncated octahedra; the line is their mean "
        f"({spread['spline']}: up to {text(spread['spread'], 2)} away without prefilter). Dots: measured along an axis "
        f"with the recursive prefilter, at most {text(far, 1)} from the line. Along an axis all of them, at every "
        f"position, respond as the quadratic B-spline does, to {text(alike, 1)}."
    )
    return [Plot(drawn, caption), _measures(config, records, folder)]


def _responses(record: Record, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """(frequencies, (variants, directions, 3, frequencies))."""
    return np.load(run_file(folder, record["omega"])), np.load(run_file(folder, record["responses"]))


def _spectrum_panel(axes: Axes, config: Config, record: Record, direction: int, folder: Path) -> None:
    omega, responses = _responses(record, folder)
    for variant, rows in zip(record["variants"], responses[:, direction], strict=True):
        mean, low, high = rows
        style = _line(record["spline"], variant, config)
        axes.plot(omega, mean, **style)
        if record["positions"] > 1 and variant in (PUBLISHED, RECURSIVE):
            axes.fill_between(omega, low, high, color=style["color"], alpha=0.2, linewidth=0)
    if direction == 0:
        at, measured = (np.load(run_file(folder, record[k])) for k in ("measured_omega", "measured"))
        axes.plot(at, measured, linestyle="none", marker=".", markersize=4, color=look(record["spline"]).light)
    axes.axvline(np.pi, color=plots.RULE, linewidth=0.8)
    plots.pi_axis(axes, omega[-1])


def _measures(config: Config, records: Sequence[Record], folder: Path) -> Table:
    """Responses at half of the Nyquist frequency and at it, in every direction."""
    columns = [Column("spline", numeric=False), Column("prefilter", numeric=False)]
    for short in ("axis", "face diagonal", "space diagonal"):
        columns += [Column(short, "π/2"), Column("", "π")]
    rows = []
    for record in records:
        omega, responses = _responses(record, folder)
        for variant, own in zip(record["variants"], responses, strict=True):
            cells = [fixed(float(np.interp(w, omega, mean)), 3) for mean in own[:, 0] for w in (np.pi / 2, np.pi)]
            rows.append([record["spline"], _name(variant), *cells])
    return Table(
        columns, rows, "Responses at ω = π/2 and π along each of these axes; of octahedra the mean over positions."
    )


# --- what was learned -------------------------------------------------------------------------------------------------


def _learned(config: Config, fits: Sequence[Record]) -> list[Block]:
    if not fits:
        return []
    columns = [
        Column("spline", numeric=False),
        Column("taps"),
        *(Column(f"h{'₁₂₃₄₅₆₇₈₉'[k]}" if k < 9 else f"h{k + 1}") for k in range((config.learning.taps[-1] - 1) // 2)),
        Column("Σ k² h", "−⅛: order 3"),
        Column("value", "÷ recursive"),
        Column("gradient", "÷ recursive"),
        Column("value", "÷ published"),
        Column("gradient", "÷ published"),
    ]
    most = (config.learning.taps[-1] - 1) // 2
    rows = []
    for f in fits:
        taps = f["parameters"]["taps"]
        ratios = [fixed(f[against][q]["ratio"], 3) for against in AGAINST for q in QUANTITIES]
        cells = [fixed(h, 4) for h in taps] + [""] * (most - len(taps))
        rows.append([f["spline"], str(f["taps"]), *cells, fixed(f["second_moment"], 4), *ratios])
    learning = config.learning
    costs = ", ".join(str(f["multiplications"]) for f in fits if f["spline"] == fits[0]["spline"])
    caption = (
        f"Prefilters h₀ = 1 − 2 Σ h along each axis, learned on {learning.training} members of {learning.source.title} "
        f"by descent on the mean of the squared errors of value and gradient (weight {learning.gradient_weight:g}), "
        f"each relative to that of the recursive prefilter; chosen by {learning.validation} others, and judged by the "
        f"RMS errors on {learning.test} more. Multiplications a voxel, once: {costs}; the recursive one: "
        f"{fits[0]['recursive_multiplications']}."
    )
    return [Table(columns, rows, caption)]


AGAINST = ("against_recursive", "against_published")


# --- pictures ---------------------------------------------------------------------------------------------------------


def _pictures(config: Config, records: Sequence[Record], folder: Path) -> list[Block]:
    if config.pictures is None:
        return []
    galleries = []
    for spline in config.splines:
        if own := [r for r in records if r["spline"] == spline]:
            shown = [picture(folder, r["image"], _title(config.pictures, r), _detail(r)) for r in own]
            galleries.append(Gallery(shown, _caption(config.pictures, spline), columns=3))
    return list(galleries)


def _title(pictures: Pictures, record: Record) -> str:
    noise = f", {100 * pictures.noise:g} % noise" if record["samples"] == "noisy" else ""
    return f"{_name(record['variant'])}{noise}"


def _detail(record: Record) -> str:
    return "" if record["distance"] is None else f"off by {text(record['distance'], 2)} voxels (RMS)"


def _caption(pictures: Pictures, spline: str) -> str:
    width, height = pictures.look.size
    return (
        f"{spline}: {pictures.signal.label} at {pictures.resolution}³, level {pictures.level:g}, {width} × {height} "
        "pixels. Below each: the distance of the points that are seen to the signal's own surface."
    )
