"""Figures of `speed_accuracy`: error against time, memory, step; what schemes cost and what precisions change."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from experiments.report import plots
from experiments.report.page import Plot
from experiments.report.style import label, line_style, look
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.speed_accuracy import Config, Variant

Namer = Callable[..., str]
QUANTITIES = (("value_rms", "value-rays", "value"), ("gradient_rms", "gradient-rays", "gradient"))
FRONT = {"color": plots.INK, "linewidth": 1.0, "alpha": 0.55, "zorder": 1}


def _compiled(config: Config, record: Record) -> bool:
    """The default scheme: what the scatter plots show."""
    return record["scheme"] == "default"


def _points(config: Config, records: Mapping[str, Record], index: int, n: int, work: str) -> dict[str, Record]:
    """Candidate -> its cost and errors in one record."""
    costs = records.get(f"cost/{n}/{work}", {}).get("costs", {})
    return {
        key: {**cost, **records[f"error/{index}/{n}/{key}"]}
        for key, cost in costs.items()
        if f"error/{index}/{n}/{key}" in records and _compiled(config, cost)
    }


def _marker(config: Config, record: Record) -> dict[str, Any]:
    """Filled for the first variant; small and hollow for another precision."""
    own = look(str(record["method"]))
    first = record["variant"] == config.variants[0].name
    return {
        "color": own.light,
        "marker": own.marker,
        "markersize": 7.0 if first else 4.0,
        "markerfacecolor": own.light if first and record["prefilter"] else "none",
        "markeredgecolor": own.light,
        "linestyle": "none",
        "alpha": 1.0 if first else 0.7,
    }


def _members(records: Mapping[str, Record], index: int, error: str, cost: str, n: int | None) -> list[str]:
    fronts = records.get(f"front/{index}", {}).get("fronts", ())
    chosen = [f["members"] for f in fronts if (f["error"], f["cost"], f["resolution"]) == (error, cost, n)]
    return chosen[0] if chosen else []


def _legend(config: Config) -> list[Line2D]:
    """One entry for each method."""
    records = list({r.name: r.record() for r in config.methods}.values())
    handles = []
    for record in records:
        own = look(record["method"])
        handles.append(Line2D([], [], color=own.light, marker=own.marker, linestyle="none", label=record["method"]))
    return handles


def fronts_plot(config: Config, records: Mapping[str, Record], index: int, name: Namer) -> Plot:
    """Error against time per sample: a row for each quantity, a column for each resolution."""
    with plots.settings():
        figure = plots.canvas(10.8, 7.6)
        grid = figure.subplots(2, len(config.sizes), squeeze=False, sharex="row")
        for row, (error, work, quantity) in zip(grid, QUANTITIES, strict=True):
            slowest = 0.0
            for axes, n in zip(row, config.sizes, strict=True):
                found = _points(config, records, index, n, work)
                slowest = max([slowest, *(r["ns_per_sample"][1] for r in found.values())])
                _scatter(axes, config, found, error)
                members = [m.partition("/")[2] for m in _members(records, index, error, "time", n)]
                shown = [found[m] for m in members if m in found]
                corners = [(r["ns_per_sample"][1], r[error]) for r in shown]
                _front(axes, corners, [name(config, r, gradient=quantity != "value") for r in shown])
                axes.set_title(f"{quantity}, {n}³")
                axes.set_xlabel(f"ns per {'value' if quantity == 'value' else 'value and gradient'}")
                plots.logarithmic(axes)
            row[0].set_ylabel(f"RMS error of the {quantity}")
            row[0].set_xlim(0, 1.15 * slowest)
        figure.legend(handles=_legend(config), loc="outside lower center", ncols=7, frameon=False)
        drawn = plots.svg(figure, f"fronts-{index}")
    caption = (
        f"Error against time per sample, {config.subjects[index].label}; down and to the left is better. Large "
        f"markers: {config.variants[0].name} (hollow: without prefilter); small hollow ones: other precisions. Bars: "
        "quartiles of time over rounds. The line is the front; its members are numbered and named. Schemes in plain "
        "torch lie far to the right of these plots, see Schemes."
    )
    return Plot(drawn, caption)


def _scatter(axes: Axes, config: Config, found: Mapping[str, Record], error: str) -> None:
    for record in found.values():
        low, median, high = record["ns_per_sample"]
        if record[error]:
            bars = [[median - low], [high - median]]
            axes.errorbar([median], [record[error]], xerr=bars, elinewidth=0.7, **_marker(config, record))


def _front(axes: Axes, corners: Sequence[tuple[float, float]], names: Sequence[str]) -> None:
    """The staircase through the members, numbered, and a list of their names where the plot is empty: top right."""
    if not corners:
        return
    axes.plot(*zip(*corners, strict=True), drawstyle="steps-post", **FRONT)
    for i, corner in enumerate(corners, 1):
        style = {"textcoords": "offset points", "ha": "right", "va": "top", "fontsize": 8.5, "fontweight": "bold"}
        axes.annotate(str(i), corner, xytext=(-4, -2), **style)
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** (0.075 * len(names)))  # room for the list
    listed = "\n".join(f"{i}  {name}" for i, name in enumerate(names, 1))
    axes.text(
        0.98, 0.99, listed, transform=axes.transAxes, ha="right", va="top", fontsize=8.5, linespacing=1.3, ma="left"
    )


def memory_plot(config: Config, records: Mapping[str, Record], index: int, name: Namer) -> Plot:
    """Error against the memory of the coefficients, over all resolutions."""
    with plots.settings():
        figure = plots.canvas(10.8, 5.0)
        for axes, (error, work, quantity) in zip(figure.subplots(1, 2), QUANTITIES, strict=True):
            found: dict[str, Record] = {}
            for n in config.sizes:
                found |= {f"{n}/{k}": r for k, r in _points(config, records, index, n, work).items()}
            for record in found.values():
                axes.plot([record["bytes"] / 2**20], [record[error]], **_marker(config, record))
            members = [m for m in _members(records, index, error, "memory", None) if m in found]
            names = [f"{name(config, found[m], gradient=quantity != 'value')}, {m.partition('/')[0]}³" for m in members]
            _front(axes, [(found[m]["bytes"] / 2**20, found[m][error]) for m in members], names)
            plots.logarithmic(axes)
            plots.logarithmic_x(axes)
            axes.set_title(f"RMS error of the {quantity}")
            axes.set_xlabel("MiB of coefficients")
        figure.legend(handles=_legend(config), loc="outside lower center", ncols=7, frameon=False)
        drawn = plots.svg(figure, f"memory-{index}")
    caption = (
        f"Error against memory at {', '.join(f'{n}³' for n in config.sizes)} together; markers as above. The "
        "line is the front; its members are numbered and named."
    )
    return Plot(drawn, caption)


def images_plot(config: Config, records: Mapping[str, Record], index: int, studies: Sequence[Record]) -> Plot:
    """PSNR against the time of an image: a curve through the steps of every method, a panel for each resolution."""
    several = [r for r in studies if len(config.studies[r["study"]].steps) > 1] or studies
    resolutions = sorted({r["resolution"] for r in several})
    with plots.settings():
        figure = plots.canvas(10.8, 4.2)
        panels = figure.subplots(1, len(resolutions), squeeze=False, sharey=True)[0]
        for axes, n in zip(panels, resolutions, strict=True):
            entries = [e for r in several if r["resolution"] == n for e in r["entries"]]
            for recipe in dict.fromkeys(e["recipe"] for e in entries):
                own = [e for e in entries if e["recipe"] == recipe and e["psnr"] is not None]
                style = {**line_style(own[0]), "linewidth": 1.0, "markersize": 4.5}
                axes.plot([e["milliseconds"][1] for e in own], [e["psnr"] for e in own], label=label(own[0]), **style)
            _image_front(axes, entries, _members(records, index, "image_rms", "time", n))
            axes.set_title(f"{n}³")
            axes.set_xlim(left=0)
            axes.set_xlabel("ms per image")
        panels[0].set_ylabel("PSNR / dB")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
        drawn = plots.svg(figure, f"images-{index}")
    steps = ", ".join(f"{s:g}" for s in config.studies[several[0]["study"]].steps)
    caption = (
        f"PSNR against the time of an image; up and to the left is better. Along each curve from left to right: steps "
        f"of {steps} voxels. Rings: the front."
    )
    return Plot(drawn, caption)


def _image_front(axes: Axes, entries: Iterable[Record], members: Sequence[str]) -> None:
    for e in entries:
        if e["psnr"] is not None and any(m.endswith(f"/{e['recipe']}@{e['step']:g}") for m in members):
            where = [e["milliseconds"][1]], [e["psnr"]]
            axes.plot(*where, marker="o", markersize=10, markerfacecolor="none", color=plots.INK, linestyle="none")


def schemes_plot(config: Config, records: Mapping[str, Record], n: int) -> Plot:
    """Time per value and gradient of every method by its schemes."""
    costs = records[f"cost/{n}/gradient-rays"]["costs"]
    markers = {"default": "o", "fused": "o", "direct": "s", "sampled": "D"}
    words = {"default": "fused", "direct": "sum over taps in plain torch", "sampled": "trilinear samples"}
    methods = [r.record() for r in config.methods]
    with plots.settings():
        figure = plots.canvas(10.4, 0.42 * len(methods) + 1.3)
        axes = figure.subplots()
        for y, recipe in enumerate(methods):
            own = [
                r for r in costs.values() if same_method(r, recipe) and r["storage"] == "default" and _single(config, r)
            ]
            x = [r["ns_per_sample"][1] for r in own]
            axes.plot([min(x), max(x)], [y, y], color=plots.RULE, linewidth=1.0, zorder=1)
            for r in own:
                hollow = r["sampler"] != "exact"
                color = look(recipe["method"]).light
                face = "none" if hollow else color
                axes.plot(
                    r["ns_per_sample"][1],
                    y,
                    marker=markers[r["scheme"]],
                    color=color,
                    markerfacecolor=face,
                    markersize=7,
                )
        axes.set_yticks(range(len(methods)), [label(r) for r in methods])
        axes.invert_yaxis()
        plots.logarithmic_x(axes)
        axes.set_xlabel(f"ns per value and gradient, {n}³")
        shown = [s for s in words if any(r["scheme"] == s for r in costs.values())]
        handles = [Line2D([], [], color=plots.INK, marker=markers[s], linestyle="none", label=words[s]) for s in shown]
        if any(r["sampler"] != "exact" for r in costs.values()):
            hollow = Line2D([], [], color=plots.INK, marker="D", markerfacecolor="none", linestyle="none")
            hollow.set_label("with 8-bit fractions")
            handles.append(hollow)
        figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
        drawn = plots.svg(figure, "schemes")
    return Plot(drawn, f"Time per value and gradient by scheme, float32, at {n}³ (logarithmic).")


def same_method(record: Record, recipe: Record) -> bool:
    """Whether they differ by no more than the variant."""
    return all(record[k] == recipe[k] for k in ("method", "prefilter", "gradient"))


def _single(config: Config, record: Record) -> bool:
    return next(v for v in config.variants if v.name == record["variant"]).dtype == "float32"


def precision_plot(config: Config, records: Mapping[str, Record]) -> Plot | None:
    """What a precision does to errors (a row for each signal) and times, at the finest resolution."""
    n, sources = config.sizes[-1], [i for i in range(len(config.subjects)) if f"front/{i}" in records]
    names = [v.name for v in sorted(config.variants, key=_bits) if v.scheme is None]
    if len(names) < 2 or not sources:
        return None
    first = config.variants[0].name
    with plots.settings():
        figure = plots.canvas(10.8, 3.3 * len(sources) + 0.5)
        for i, row in zip(sources, figure.subplots(len(sources), 3, squeeze=False), strict=True):
            signal = config.subjects[i].name
            for axes, (error, work, quantity) in zip(row, QUANTITIES, strict=False):
                _precisions(axes, config, _points(config, records, i, n, work), error, names)
                axes.set_title(f"{signal}: error of the {quantity} ÷ {first}", fontsize=9)
                plots.logarithmic(axes)
            work, where = TIMES[min(i, len(TIMES) - 1)]
            _precisions(row[-1], config, _points(config, records, i, n, work), "ns_per_sample", names)
            row[-1].set_title(f"time, points {where} ÷ {first}", fontsize=9)
            row[-1].set_ylim(bottom=0)
        handles, labels = row[-1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=7, frameon=False)
        drawn = plots.svg(figure, "precision")
    caption = (
        f"RMS errors, and time per value and gradient, at {n}³ in units of {first}. The better a method, the more it "
        "loses by rounding. Integers are spread over the range of the coefficients, and so have smaller steps than "
        "floating point numbers of as many bits."
    )
    return Plot(drawn, caption)


TIMES = (("gradient-rays", "along rays"), ("gradient-random", "at random"))
BITS = {"float64": 64, "float32": 32, "int16": 16, "float16": 16, "bfloat16": 16, "uint8": 8, "int8": 8}


def _bits(variant: Variant) -> tuple[int, int]:
    """Long before short, and of 16 bits the type with the finest steps first."""
    name = variant.storage or variant.dtype
    return -BITS[name], list(BITS).index(name)


def _precisions(axes: Axes, config: Config, found: Mapping[str, Record], quantity: str, names: Sequence[str]) -> None:
    """A curve over the variants for every prefiltered method with its own gradient, in units of the first variant."""
    for recipe in config.methods:
        own = {r["variant"]: r for r in found.values() if same_method(r, recipe.record())}
        unit = _number(own.get(config.variants[0].name), quantity)
        if unit and recipe.prefilter and recipe.record()["default_gradient"]:
            y = [(_number(own.get(v), quantity) or float("nan")) / unit for v in names]
            axes.plot(range(len(names)), y, label=label(recipe.record()), **line_style(recipe.record()))
    axes.set_xticks(range(len(names)), names, rotation=35, ha="right")


def _number(record: Record | None, quantity: str) -> float | None:
    if record is None:
        return None
    return record[quantity][1] if quantity == "ns_per_sample" else record[quantity]
