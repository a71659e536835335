"""Section of `inverse_dvr`: target, start and result of every recovery, how it converged, and what it cannot know."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from experiments.report import plots
from experiments.report.page import Column, Gallery, Plot, Section, Table, picture
from experiments.report.style import MISSING, fixed, label, line_style, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.inverse_dvr import Config

TARGET = {"color": plots.INK, "linewidth": 2.6}
START = {"color": plots.INK, "linestyle": ":", "linewidth": 1.2}
VIEWS = {"held_out": "A held-out view", "training": "A training view"}


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    volumes = [r for r in records.values() if r["kind"] == "volume"]
    transfers = [r for r in records.values() if r["kind"] == "transfer"]
    parts = []
    if config.volume is not None and volumes:
        parts.append(_volume(config, volumes, folder))
    if config.transfer_function is not None and transfers:
        parts.append(_transfer(config, transfers, folder))
    title = f"From images back to their cause: {config.signal.label} at {config.resolution}³"
    return Section(title, _lead(config), (), parts)


def _lead(config: Config) -> list[str]:
    views = config.views
    made_of = {
        "signal": "The images show the signal itself: no volume of this size reproduces them exactly, and how near a "
        "method can come is part of the question.",
        "samples": "The images show what each method makes of the signal's samples, so that a perfect answer exists.",
    }[config.images_of]
    return [
        f"A known signal is rendered in {views.training} training views and {views.held_out} held-out views, spread "
        f"evenly over the sphere ({views.size}² pixels, {views.projection}, a step of "
        f"{views.step:g} voxel{'' if views.step == 1 else 's'}, "
        f"{'lit' if views.lighting else 'unlit'}). Adam changes the unknown until the training views match, in linear "
        "RGB; the derivatives come through the renderer. The held-out views are never matched: they tell whether the "
        "cause was found or only these images.",
        made_of,
    ]


def _name(record: Record, *, positions: bool = True) -> str:
    parts = [label(record), "" if record["scheme"] == "default" else record["scheme"].replace("_", " ")]
    if positions and "positions" in record:
        parts.append(f"{record['positions']} positions")
    return ", ".join(part for part in parts if part)


def _style(record: Record) -> dict:
    """Of a curve: as everywhere, but dashed and hollow for free positions."""
    own = {**line_style(record), "markersize": 4.0}
    return {**own, "linestyle": "--", "markerfacecolor": "none"} if record.get("positions") == "free" else own


# --- the volume -------------------------------------------------------------------------------------------------------


def _volume(config: Config, records: Sequence[Record], folder: Path) -> Section:
    fit = config.volume
    assert fit is not None
    start = (
        f"all voxels {fit.start.value:g}" if fit.start.blur is None else f"samples blurred by σ = {fit.start.blur:g}"
    )
    stages = ", then ".join(f"{s.iterations} steps on {s.resolution}³ (rate {s.learning_rate:g})" for s in fit.stages)
    lead = (
        f"The transfer function is known, the {config.resolution}³ voxels are not. Start: {start}; {stages}; "
        f"{fit.rays} random rays a step; smoothness λ = {fit.smoothness:g}. A method enters twice: it makes the field "
        "that is rendered, and its transpose spreads the derivatives over the voxels. “Samples of the signal” is what "
        "the method makes of them when nothing is fitted: images can be matched better than that, because the voxels "
        "of the best field need not be samples.",
    )
    parts = [Section(title, (), [_views(config, records, view, folder)]) for view, title in VIEWS.items()]
    parts += [
        Section("The voxels", (), [_slices(config, records, folder)]),
        Section("Convergence", (), [_convergence(records), _numbers(records)]),
        Section("What cannot be seen cannot be recovered", (), [_groups(records)]),
    ]
    return Section("The volume", lead, (), parts)


def _views(config: Config, records: Sequence[Record], view: str, folder: Path) -> Gallery:
    pictures = []
    for r in records:
        images, name = r["images"][view], _name(r)
        pictures += [
            picture(folder, images["target"], "target", _of(config, r)),
            picture(folder, images["start"], "start", _decibels(images["psnr_start"])),
            picture(folder, images["result"], f"result, {name}", _decibels(images["psnr_result"])),
            picture(
                folder, images["difference"], "difference of result and target", f"amplified {config.views.amplify:g} ×"
            ),
        ]
    size = config.views.shown
    caption = (
        f"Rendered anew at {size}² pixels; one row for each recovery. PSNR of this image as displayed (sRGB). "
        f"Differences are absolute, as displayed, amplified {config.views.amplify:g} times; black is none."
    )
    return Gallery(pictures, caption, columns=4)


def _of(config: Config, record: Record) -> str:
    return f"the {config.signal.name} signal" if config.images_of == "signal" else f"of samples, {_name(record)}"


def _decibels(psnr: float | None) -> str:
    return MISSING if psnr is None else f"{fixed(psnr, 1)} dB"


def _slices(config: Config, records: Sequence[Record], folder: Path) -> Gallery:
    pictures = []
    for r in records:
        slices, last = r["slices"], r["observations"][-1]
        pictures += [
            picture(folder, slices["target"], "target", "samples of the signal"),
            picture(folder, slices["start"], "start", f"RMS {text(r['observations'][0]['voxel_rms'])}"),
            picture(folder, slices["result"], f"result, {_name(r)}", f"RMS {text(last['voxel_rms'])} (whole volume)"),
            picture(folder, slices["difference"], "difference", f"amplified {config.views.amplify:g} ×"),
            picture(folder, slices["dependence"], "how much images depend on it", "bright: much"),
        ]
    caption = (
        "The voxels themselves, in the slice through the middle of y (x to the right, z up): black is the least sample "
        "of the signal, white the largest. Last column: how much the training images change with each voxel (the norm "
        "of the derivative, estimated with random signs), relative to the brightest. Where it is black, nothing in the "
        "images tells about the voxel."
    )
    return Gallery(pictures, caption, columns=5, pixelated=True)


def _convergence(records: Sequence[Record]) -> Plot:
    panels = (
        ("misfit", "Misfit: mean squared difference"),
        ("psnr", "PSNR of held-out views / dB"),
        ("field_rms", "RMS error of the field"),
    )
    caption = (
        "Left: the misfit of every batch, in linear RGB (faint), and its mean between measurements. Middle: all "
        "held-out views together, as displayed. Right: field against signal at uniform random points of the inner 90 % "
        "of the box. Dotted: what the method makes of the signal's own samples."
    )
    return Plot(_course(records, panels, "inverse-volume", lambda r: r["samples"]), caption)


def _course(
    records: Sequence[Record],
    panels: Sequence[tuple[str, str]],
    name: str,
    reference: Callable[[Record], Mapping[str, float]],
):
    with plots.settings():
        figure = plots.canvas(10.4, 3.5)
        for axes, (quantity, title) in zip(figure.subplots(1, 3), panels, strict=True):
            for r in records:
                _curve(axes, r, quantity, reference(r).get(quantity))
            axes.set_title(title)
            axes.set_xlabel("iteration")
            axes.set_xlim(left=0)
            if quantity != "psnr":
                _logarithmic(axes)
        handles = [Line2D([], [], label=_name(r), **_style(r)) for r in records]
        figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
        return plots.svg(figure, name)


def _logarithmic(axes: Axes) -> None:
    """As `plots.logarithmic`, where there is a positive number: what is exact or never seen may have none."""
    if axes.dataLim.ymax > 0:
        plots.logarithmic(axes)


def _curve(axes: Axes, record: Record, quantity: str, reference: float | None) -> None:
    own = _style(record)
    if quantity == "misfit":
        steps = range(1, len(record["misfits"]) + 1)
        axes.plot(steps, record["misfits"], color=own["color"], linewidth=0.6, alpha=0.3)
    seen = [(o["iteration"], o[quantity]) for o in record["observations"] if o[quantity]]
    if seen:
        axes.plot(*zip(*seen, strict=True), **own)
    if reference:
        axes.axhline(reference, color=own["color"], linestyle=":", linewidth=1.3)


def _numbers(records: Sequence[Record]) -> Table:
    columns = [
        Column("method", numeric=False),
        Column("volume", numeric=False),
        Column("held-out views", "PSNR, dB"),
        Column("field", "RMS error"),
        Column("voxels", "RMS error"),
        Column("time", "s"),
    ]
    rows = []
    for r in records:
        first, last = r["observations"][0], r["observations"][-1]
        for i, (name, o, seconds) in enumerate(
            (("start", first, None), ("result", last, r.get("seconds")), ("samples of the signal", r["samples"], None))
        ):
            cells = (fixed(o["psnr"], 1), text(o["field_rms"]), text(o["voxel_rms"]), fixed(seconds, 0))
            rows.append([_name(r) if i == 0 else "", name, *cells])
    caption = (
        "Errors against the signal: of the held-out views as displayed, of the field at random points, of the voxels "
        "against samples (0 for the samples themselves, but voxels that match the images best need not be samples). "
        "Wall-clock seconds of the whole recovery; they depend on what else ran."
    )
    return Table(columns, rows, caption)


def _groups(records: Sequence[Record]) -> Plot:
    with plots.settings():
        figure = plots.canvas(10.4, 3.4)
        left, right = figure.subplots(1, 2)
        for axes, quantity, title in (
            (left, "dependence", "How much the images depend on a voxel"),
            (right, "rms", "RMS error of the recovered voxels"),
        ):
            for r in records:
                seen = [(i + 1, g[quantity]) for i, g in enumerate(r["groups"]) if g[quantity]]
                if seen:
                    axes.plot(*zip(*seen, strict=True), **{**line_style(r), "label": _name(r)})
            _logarithmic(axes)
            axes.set_title(title)
            axes.set_xlabel("tenth of the voxels, from the least seen to the most seen")
            axes.set_xticks(range(1, len(records[0]["groups"]) + 1))
        plots.legend_right(right)
        drawn = plots.svg(figure, "inverse-groups")
    caption = (
        "All voxels in ten groups of equal size, ordered by how much the training images depend on them: they do not "
        "where the transfer function makes a value transparent, and hardly where other voxels hide one. A voxel there "
        "stops as soon as it is transparent, or keeps what the start and, by the smoothness, its neighbours give it, "
        "however well the images match. Left: RMS over the group of the norm of the derivative, in pixel values per "
        "unit of the voxel; right: RMS difference to the signal's samples."
    )
    return Plot(drawn, caption)


# --- the transfer function --------------------------------------------------------------------------------------------


def _transfer(config: Config, records: Sequence[Record], folder: Path) -> Section:
    fit = config.transfer_function
    assert fit is not None
    lead = (
        f"The volume is known ({config.resolution}³ samples of the signal), opacities and colours at {fit.points} "
        "control points are not; between them both are linear. “Fixed positions” are evenly spaced; “free positions” "
        f"move between the least and the largest sample. {fit.iterations} steps with {fit.rays} random rays each, rate "
        f"{fit.learning_rate:g}, from opacity {fit.opacity:g} and one colour for all values.",
    )
    parts = [
        Section(VIEWS["held_out"], (), [_views(config, records, "held_out", folder)]),
        Section("Convergence", (), [_transfer_convergence(records), _transfer_numbers(records)]),
    ]
    return Section("The transfer function", lead, [_curves(config, records)], parts)


def _curves(config: Config, records: Sequence[Record]) -> Plot:
    kinds = list(dict.fromkeys(r["positions"] for r in records))
    with plots.settings():
        figure = plots.canvas(10.4, 4.9)
        grid = figure.subplots(2, len(kinds), squeeze=False, sharex=True, height_ratios=(3.0, 1.4))
        for (curves, strips), kind in zip(grid.T, kinds, strict=True):
            found = [r for r in records if r["positions"] == kind]
            _opacities(curves, found)
            curves.set_title(f"{kind.capitalize()} positions")
            curves.set_ylabel(f"opacity per {found[0]['unit']:g} world units")
            _strips(strips, found)
            strips.set_xlabel("value")
        figure.legend(handles=_handles(records), loc="outside lower center", ncols=5, frameon=False)
        drawn = plots.svg(figure, "inverse-transfer")
    shares = records[0]["histogram"]["shares"]
    caption = (
        "Target, start and recovered transfer functions; markers are control points. Shaded: how often a value occurs "
        f"in the volume, linear from 0; the highest of {len(shares)} bars is {100 * max(shares):.3g} % of it. "
        "Below: their colours, as high as they are opaque, for what is transparent has no colour that an image could "
        "show. A value that does not occur, or that is always hidden, is not recovered; at the least and the largest "
        "values few samples decide. Of a thin medium an image tells opacity times the contrast to what is behind, and "
        "hardly either by itself: less of the one and more of the other look alike."
    )
    if config.images_of == "signal":
        caption += (
            " The images are those of the signal: where a method's field misses its peaks and valleys, the recovered "
            "function makes up for the field, and is then wrong for any other volume."
        )
    return Plot(drawn, caption)


def _opacities(axes: Axes, records: Sequence[Record]) -> None:
    curves, histogram = records[0]["curves"], records[0]["histogram"]
    width = (histogram["high"] - histogram["low"]) / len(histogram["shares"])
    top = 1.1 * max(max(c["opacities"]) for r in records for c in r["curves"].values())
    scale = 0.9 * top / max(histogram["shares"])
    left = [histogram["low"] + width * i for i in range(len(histogram["shares"]))]
    axes.bar(left, [scale * s for s in histogram["shares"]], width, align="edge", color=plots.RULE, alpha=0.25)
    target = curves["target"]
    axes.plot(target["positions"], target["opacities"], **TARGET)
    axes.plot(curves["start"]["positions"], curves["start"]["opacities"], **START)
    for r in records:
        result = r["curves"]["result"]
        axes.plot(result["positions"], result["opacities"], **{**line_style(r), "markersize": 4.0})
    axes.set_xlim(histogram["low"], histogram["high"])
    axes.set_ylim(0, top)


def _handles(records: Sequence[Record]) -> list[Line2D | Patch]:
    distinct = {_name(r, positions=False): r for r in records}
    return [
        Line2D([], [], label="target", **TARGET),
        Line2D([], [], label="start", **START),
        *(Line2D([], [], label=name, **{**line_style(r), "markersize": 4.0}) for name, r in distinct.items()),
        Patch(color=plots.RULE, alpha=0.25, label="values in the volume"),
    ]


def _strips(axes: Axes, records: Sequence[Record]) -> None:
    """A row of coloured bars for each function, as high as it is opaque."""
    curves, histogram = records[0]["curves"], records[0]["histogram"]
    rows = [("target", curves["target"]), ("start", curves["start"])]
    rows += [(_name(r, positions=False), r["curves"]["result"]) for r in records]
    width = (histogram["high"] - histogram["low"]) / len(histogram["shares"])
    scale = 0.9 / (max(max(curve["bins"]["opacities"]) for _, curve in rows) or 1.0)
    for row, (_, curve) in enumerate(rows):
        bins, foot = curve["bins"], row + 0.45
        boxes = []
        for i, opacity in enumerate(bins["opacities"]):
            left, top = histogram["low"] + i * width, foot - scale * opacity
            right = left + 1.2 * width  # under the next bar, so that no gap shines through
            boxes.append([(left, foot), (right, foot), (right, top), (left, top)])
        axes.add_collection(PolyCollection(boxes, facecolors=bins["displayed"], linewidths=0))
    axes.set_yticks(range(len(rows)), [name for name, _ in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(visible=False)


def _transfer_convergence(records: Sequence[Record]) -> Plot:
    panels = (
        ("misfit", "Misfit: mean squared difference"),
        ("psnr", "PSNR of held-out views / dB"),
        ("opacity_rms", "RMS error of the opacity"),
    )
    caption = (
        "Left: the misfit of every batch, in linear RGB (faint), and its mean between measurements. Middle: all "
        "held-out views together, as displayed; dotted: what the true transfer function gives with the method's field. "
        "Right: over the values that occur in the volume. Solid: fixed positions; dashed and hollow: free ones."
    )
    return Plot(_course(records, panels, "inverse-transfer-course", lambda r: r["exact"]), caption)


def _transfer_numbers(records: Sequence[Record]) -> Table:
    columns = [
        Column("method", numeric=False),
        Column("positions", numeric=False),
        Column("opacity", "RMS error"),
        Column("colour", "RMS error"),
        Column("held-out views", "PSNR, dB"),
        Column("with the true function", "PSNR, dB"),
        Column("time", "s"),
    ]
    rows = []
    for r in records:
        last = r["observations"][-1]
        errors = [text(last["opacity_rms"]), text(last["color_rms"])]
        images = [fixed(last["psnr"], 1), fixed(r["exact"]["psnr"], 1)]
        rows.append([_name(r, positions=False), r["positions"], *errors, *images, fixed(r.get("seconds"), 0)])
    caption = (
        "Errors of the recovered function over the values that occur in the volume: of the opacity (0 … 1 for the unit "
        "of length), and of the linear colour, each value weighted with its true opacity. “With the true function”: "
        "the held-out views as the method's field shows them; what remains is the error of the reconstruction. "
        "Wall-clock seconds; they depend on what else ran."
    )
    return Table(columns, rows, caption)
