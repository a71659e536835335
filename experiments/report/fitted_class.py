"""What was learned for one class of signals: errors of all filters, their responses, parameters and descents."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from experiments.comparison import QUANTITIES, pooled
from experiments.report import plots
from experiments.report.page import Block, Column, Plot, Table
from experiments.report.style import MISSING, OTHERS, fixed, label, look, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.fit_kernel import Config

KERNELS = {  # a kernel in words, and the method whose colour it has
    "bc": ("B, C", "mitchell"),
    "bspline2": ("quadratic", "triquadratic"),
    "bspline3": ("cubic", "tricubic"),
    "notch": ("notch", "notch"),
}
DASHES = {1: ":", 3: (0, (1, 1.5)), 5: "--"}  # by taps of the prefilter; more: solid
LEARNED = {"color": OTHERS[0].light, "linewidth": 1.1}
SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
FLOOR = 1e-4  # of the error kernels that are drawn


def class_blocks(config: Config, records: Sequence[Record], folder: Path) -> list[Block]:
    """Of the records of a class, as far as they are there."""
    by_kind = {kind: [r for r in records if r["kind"] == kind] for kind in ("named", "fit", "verdict", "spectrum")}
    fits, blocks = by_kind["fit"], []
    if by_kind["named"]:
        choices = by_kind["verdict"][0]["choices"] if by_kind["verdict"] else []
        blocks.append(_errors(config, by_kind["named"][0], fits, [c["candidate"] for c in choices]))
    if by_kind["spectrum"]:
        blocks.append(_spectrum(by_kind["spectrum"][0], folder))
    if fits:
        blocks += [*_parameters(config, fits), _convergence(config, fits)]
    return blocks


def learned_name(record: Record) -> str:
    """A learned filter in words."""
    kernel = KERNELS.get(record["kernel"], (record["kernel"], ""))[0]
    return kernel if record["prefilter"] == 1 else f"{kernel}, {record['prefilter']}-tap prefilter"


def _groups(config: Config, fits: Sequence[Record]) -> list[list[Record]]:
    """The fits of every candidate, over repetitions."""
    return [own for c in config.candidates if (own := [f for f in fits if f["candidate"] == c.key])]


def _spread(values: Sequence[float], decimals: int | None = None) -> str:
    """Mean ± standard deviation over repetitions, both with so many decimals: by default those that the mean shows."""
    if decimals is None:
        decimals = max(2 - math.floor(math.log10(max(abs(mean(values)), 1e-9))), 0)
    return fixed(mean(values), decimals) + (f" ± {fixed(stdev(values), decimals)}" if len(values) > 1 else "")


def _errors(config: Config, named: Record, fits: Sequence[Record], chosen: Sequence[str]) -> Table:
    columns = [
        Column("filter", numeric=False),
        Column("taps"),
        Column("prefilter", "products per voxel"),
        Column("value", "RMS error, %"),
        Column("gradient", "RMS error, %"),
        Column("smoothing"),
        Column("postaliasing"),
        Column("validation", "objective"),
    ]
    rows: list[tuple[int, bool, list[str]]] = []
    scales = named["scales"]
    for m in named["methods"]:
        cells = [text(100 * pooled(m["test"][q]) / scales[q]) for q in QUANTITIES]
        measures = [text(m.get(name)) for name in ("smoothing", "postaliasing")]
        rows.append((m["taps"], False, [label(m), str(m["taps"]), _prefilter(m), *cells, *measures, MISSING]))
    for own in _groups(config, fits):
        first = own[0]
        cells = [_spread([100 * pooled(f["test"][q]) / scales[q] for f in own]) for q in QUANTITIES]
        measures = [text(mean(f[name] for f in own)) for name in ("smoothing", "postaliasing")]
        mark = "▸ " if first["candidate"] in chosen else ""
        objective = text(mean(f["validation"] for f in own))
        listed = [
            f"{mark}learned: {learned_name(first)}",
            str(first["taps"]),
            _prefilter(first),
            *cells,
            *measures,
            objective,
        ]
        rows.append((first["taps"], True, listed))
    rows.sort(key=lambda row: row[:2])
    caption = (
        f"RMS errors on {config.test} test members of {config.test_points:,} points each, relative to the standard "
        f"deviation of the values ({text(scales['value'])}) and to the RMS length of the gradients "
        f"({text(scales['gradient'])}); of learned filters mean ± standard deviation over {config.repetitions} "
        "repetitions. ▸: chosen, among those of equal cost, by the objective on validation members (1 is "
        f"{config.reference.key}). Smoothing and postaliasing along an axis after Marschner & Lobb; 0 is ideal."
    )
    return Table(columns, [row for _, _, row in rows], caption)


def _prefilter(record: Record) -> str:
    """What it costs per voxel, once, and of which kind it is."""
    if "multiplications" not in record:  # of a method that is no tensor product
        return "its own"
    if record["multiplications"] == 0:
        return "none"
    kind = f"{record['prefilter']} taps" if "candidate" in record else "recursive"
    return f"{kind}: {record['multiplications']}"


def _parameters(config: Config, fits: Sequence[Record]) -> list[Table]:
    """Of all candidates: B and C where they are learned, then the prefilters and how the descent ended."""
    groups = _groups(config, fits)
    family = [own for own in groups if "bc" in own[0]["parameters"]]
    return [*([_family(family)] if family else []), _prefilters(groups)]


def _family(groups: Sequence[Sequence[Record]]) -> Table:
    columns = [Column("learned", numeric=False), Column("B"), Column("C"), Column("2C + B")]
    rows = []
    for own in groups:
        pairs = [f["parameters"]["bc"] for f in own]
        numbers = ([b for b, _ in pairs], [c for _, c in pairs], [2 * c + b for b, c in pairs])
        rows.append([learned_name(own[0]), *(_spread(listed, 3) for listed in numbers)])
    caption = (
        "What was learned of the kernel, mean ± standard deviation over repetitions. 2C + B is 1 for kernels that "
        "reproduce quadratics without a prefilter: Mitchell and Catmull-Rom among them."
    )
    return Table(columns, rows, caption)


def _prefilters(groups: Sequence[Sequence[Record]]) -> Table:
    most = max(len(own[0]["parameters"].get("taps", [])) for own in groups)
    columns = [Column("learned", numeric=False), *(Column(f"h{str(k).translate(SUBSCRIPTS)}") for k in range(most + 1))]
    columns += [Column("steps", "mean"), Column("still falling", "by last tenth")]
    rows = []
    for own in groups:
        taps = [f["parameters"].get("taps", []) for f in own]
        symmetric = [[1 - 2 * sum(t), *t] if t else [] for t in taps]
        cells = [_spread(listed, 3) for listed in zip(*symmetric, strict=True)]
        cells += [MISSING] * (most + 1 - len(cells))
        falling = max(f["falling"] or 0 for f in own)
        steps = fixed(mean(f["iteration"] for f in own), 0)
        rows.append([learned_name(own[0]), *cells, steps, f"{fixed(100 * falling, 1)} %"])
    caption = (
        "What was learned of the prefilters, mean ± standard deviation over repetitions: symmetric, of sum 1. Steps: "
        "after how many the validation members were best. Still falling: what the last tenth of the steps took off the "
        "training objective, at most; little means that the descent has arrived."
    )
    return Table(columns, rows, caption)


def _spectrum(record: Record, folder: Path) -> Plot:
    curves = np.load(folder / record["array"])
    omega, pairs = curves[0], curves[1:].reshape(-1, 2, curves.shape[1])
    costs = sorted({c["taps"] for c in record["curves"]})
    with plots.settings():
        figure = plots.canvas(10.4, 0.5 + 3.1 * len(costs))
        for row, taps in zip(figure.subplots(len(costs), 2, squeeze=False), costs, strict=True):
            found = [(c, p) for c, p in zip(record["curves"], pairs, strict=True) if c["taps"] == taps]
            for c, (response, error) in sorted(found, key=lambda item: "candidate" in item[0]):
                style = LEARNED if "candidate" in c else {"color": look(c["method"]).light}
                name = "learned" if "candidate" in c else label(c, gradient=False)
                row[0].plot(omega, response, **style)
                row[1].plot(omega, np.maximum(error, FLOOR / 10), label=name, **style)
            row[0].axvline(math.pi, color=plots.INK, linewidth=0.8, alpha=0.6)
            row[0].set_title(f"{taps} taps: response P(ω)Φ(ω)")
            plots.pi_axis(row[0], omega[-1])
            _error_axis(row[1])
        drawn = plots.svg(figure, f"fit-spectrum-{record['class']}")
    caption = (
        "The chosen filters (all repetitions, thin) and the named methods that cost as much, along an axis. Left: the "
        "response of prefilter and kernel; ideal is 1 up to the Nyquist frequency (line) and 0 above. Right: the error "
        "kernel, the RMS error of a reconstructed wave of that frequency relative to its own (Blu & Unser). A named "
        "prefilter makes its kernel interpolate, or exact at low frequencies; a learned one need do neither, and takes "
        "from frequencies that matter little to the class what it gives to those that matter."
    )
    return Plot(drawn, caption)


def _error_axis(axes: Axes) -> None:
    axes.set_yscale("log")
    axes.set_ylim(FLOOR, 2)
    plots.logarithmic(axes)
    axes.set_xlim(0, math.pi)
    ticks = [k * math.pi / 4 for k in range(5)]
    axes.set_xticks(ticks, ["0", "π/4", "π/2", "3π/4", "π"])
    axes.set_xlabel("ω, radians per voxel")
    axes.set_title("Error kernel")
    handles = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    axes.legend(handles.values(), handles.keys(), loc="center left", bbox_to_anchor=(1.01, 0.5))


def _convergence(config: Config, fits: Sequence[Record]) -> Plot:
    with plots.settings():
        figure = plots.canvas(10.4, 3.4)
        axes = figure.subplots()
        for own in _groups(config, fits):
            first = own[0]
            color = look(KERNELS.get(first["kernel"], ("", first["kernel"]))[1]).light
            style = {"color": color, "linestyle": DASHES.get(first["prefilter"], "-")}
            for f in own:
                axes.plot(range(len(f["training"])), f["training"], linewidth=0.9, **style)
            axes.plot([], [], label=learned_name(first), **style)
        axes.axhline(1, color=plots.INK, linewidth=0.8, alpha=0.6)
        plots.logarithmic(axes)
        axes.set_xlim(left=0)
        axes.set_xlabel("step")
        axes.set_title("Objective on the training members")
        plots.legend_right(axes)
        drawn = plots.svg(figure, f"fit-convergence-{fits[0]['class']}")
    caption = (
        "How the descents went, every repetition: each begins with the kernel alone, or with the given B and C. The "
        f"line at 1 is {config.reference.key} on the same members."
    )
    return Plot(drawn, caption)
