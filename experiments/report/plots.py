"""matplotlib figures as inline SVG: transparent, with text in the page's own colour, in light and in dark."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MultipleLocator, NullLocator

from experiments.report.style import LOOKS, OTHERS, SUPERSCRIPTS

INK, RULE = "#010203", "#040506"  # stand for the page's text and hairline colours until the SVG is written
SETTINGS: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": RULE,
    "axes.grid": True,
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "grid.alpha": 0.5,
    "axes.axisbelow": True,
    "text.color": INK,
    "axes.labelcolor": INK,
    "xtick.color": RULE,
    "ytick.color": RULE,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.6,
    "lines.markersize": 5.0,
    "legend.frameon": False,
    "legend.handlelength": 2.8,
    "svg.fonttype": "path",
}


@contextmanager
def settings() -> Iterator[None]:
    """matplotlib with the look of the reports; draw and write a figure inside."""
    with matplotlib.rc_context(SETTINGS):
        yield


def canvas(width: float = 9.0, height: float = 4.2) -> Canvas:
    """An empty figure, size in inches."""
    figure = Canvas(figsize=(width, height), layout="constrained")
    FigureCanvasSVG(figure)
    return figure


def svg(figure: Canvas, name: str) -> Markup:
    """The figure as an inline SVG element; `name` keeps its ids apart from other figures of the page."""
    buffer = io.StringIO()
    with matplotlib.rc_context({**SETTINGS, "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'(href="#|url\(#)', rf"\g<1>{name}-", text)
    text = text.replace(INK, "currentColor").replace(RULE, "var(--rule)")
    for variable, color in method_colors():
        text = text.replace(color, f"var({variable})")
    text = re.sub(r' (width|height)="[\d.]+pt"', "", text, count=2)  # the viewBox alone gives the shape
    return Markup(text.replace("<svg", '<svg role="img"', 1))


def method_colors() -> Iterable[tuple[str, str]]:
    """(CSS variable, its colour on a light page) of every method."""
    return [(variable, light) for variable, light, _ in themed_colors()]


def themed_colors() -> list[tuple[str, str, str]]:
    """(CSS variable, colour on a light page, on a dark page) of every method."""
    named = [(f"--c-{name}", own.light, own.dark) for name, own in LOOKS.items()]
    return named + [(f"--c-other-{i}", own.light, own.dark) for i, own in enumerate(OTHERS)]


def legend_right(axes: Axes, **options) -> None:
    """The legend beside the plot, where it hides nothing."""
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), **options)


def resolution_axis(axes: Axes, resolutions: Iterable[int]) -> None:
    """A logarithmic axis with one tick per resolution."""
    axes.set_xscale("log", base=2)
    ticks = sorted(set(resolutions))
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}"))
    axes.set_xlabel("voxels along each axis")


def logarithmic(axes: Axes) -> None:
    """A logarithmic y axis with ticks at powers of ten, and at 2 and 5 too where it spans less than two decades."""
    axes.set_yscale("log")
    _ticks(axes.yaxis, *axes.get_ylim())


def logarithmic_x(axes: Axes) -> None:
    """A logarithmic x axis, ticks as for `logarithmic`."""
    axes.set_xscale("log")
    _ticks(axes.xaxis, *axes.get_xlim())


def _ticks(axis: Axis, low: float, high: float) -> None:
    axis.set_major_locator(LogLocator(base=10, subs=(1, 2, 5) if high / low < 100 else (1,), numticks=10))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: _tick(value)))


def _tick(value: float) -> str:
    if 0.005 < value < 2000:
        return f"{value:g}"
    exponent = math.floor(math.log10(value * 1.0000001))
    leading = round(value / 10**exponent)
    power = "10" + str(exponent).translate(SUPERSCRIPTS)
    return power if leading == 1 else f"{leading}×{power}"


def pi_axis(axes: Axes, upper: float) -> None:
    """An x axis from 0 to `upper` radians per voxel with ticks at whole multiples of π."""
    axes.set_xlim(0, upper)
    axes.xaxis.set_major_locator(MultipleLocator(math.pi))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: _multiple_of_pi(round(v / math.pi))))
    axes.set_xlabel("ω, radians per voxel")


def _multiple_of_pi(k: int) -> str:
    return "0" if k == 0 else "π" if k == 1 else f"{k}π"
