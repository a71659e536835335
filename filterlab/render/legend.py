"""Legends: what colours stand for what values, drawn beside or below a picture by matplotlib.

colours by value ─▶ bar with ticks, and how opaque each value is ─▶ joined to the picture, on its background
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
import torch
from torch import Tensor

from filterlab.io.images import from_srgb, to_srgb
from filterlab.render.colormaps import ColorScale
from filterlab.render.transfer import TransferFunction

Side = Literal["right", "below"]

_DPI = 100
_TEXT = 0.032  # of the shorter side of the picture
_SMALLEST = 12.0  # pixels that letters are high: smaller ones cannot be read
_SPARE = 0.07  # of the side that the bar is along, at either end of it
_BROAD = 0.65  # of its height, that a letter is broad on average
_GRAY = 0.18  # luminance above which a background takes dark letters


@dataclass(frozen=True)
class Legend:
    """What values look like.

    Attributes:
        colors: linear RGB `(n, 3)` of values `(n,)`.
        low, high: the values at the ends of the bar.
        opacities: `(n,)` of values, drawn along the bar as the square root of their part of the largest, so
            that faint ones are seen too; None: all are opaque.
        label: of the values: a quantity, its unit.
    """

    colors: Callable[[Tensor], Tensor]
    low: float
    high: float
    opacities: Callable[[Tensor], Tensor] | None = None
    label: str = ""

    @classmethod
    def of_transfer(cls, transfer: TransferFunction, *, opaque: bool = False, label: str = "") -> Self:
        """That of a transfer function, from its first control point to its last.

        Args:
            opaque: of the colours alone, as pictures of values have them.
        """
        low, high = (float(transfer.positions[k]) for k in (0, -1))
        return cls(lambda v: transfer(v)[0], low, high, None if opaque else lambda v: transfer(v)[1], label)

    @classmethod
    def of_scale(cls, scale: ColorScale, *, label: str = "") -> Self:
        """That of a window."""
        return cls(scale, scale.low, scale.high, None, label)

    def beside(self, image: Tensor, background: Sequence[float] = (0.0, 0.0, 0.0), side: Side = "right") -> Tensor:
        """The picture `(H, W, 3)`, linear RGB, with the legend at a side of it: `(H, W + w, 3)`, or `(H + h, W, 3)`.

        Letters are 3.2 % of the picture's shorter side high, and at least 12 pixels; black or white, whichever is seen
        on the background.
        """
        height, width = image.shape[:2]
        letters = max(_SMALLEST, _TEXT * min(height, width))
        drawn = self._drawn(height if side == "right" else width, letters, background, side)
        strip = from_srgb(torch.from_numpy(drawn.astype(np.float64) / 255)).to(image)
        return torch.cat((image, strip), 1 if side == "right" else 0)

    def _drawn(self, length: int, letters: float, background: Sequence[float], side: Side) -> np.ndarray:
        """Encoded digits (n, m, 3), as long as that side of the picture."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        upright = side == "right"
        behind, ink = _encoded(torch.tensor(background, dtype=torch.float64)), _ink(background)
        across = math.ceil(16 * letters + 0.7 * letters * len(self.label))  # more than is needed: cut off below
        size = (across, length) if upright else (length, across)
        figure = Figure(figsize=(size[0] / _DPI, size[1] / _DPI), dpi=_DPI, facecolor=behind)
        canvas = FigureCanvasAgg(figure)
        bar = figure.add_axes(self._place(length, across, letters, upright, True))
        self._draw_bar(bar, length, letters, ink, behind, upright)
        if self.opacities is not None:
            profile = figure.add_axes(self._place(length, across, letters, upright, False))
            self._draw_opacities(profile, length, ink, upright)
        canvas.draw()
        digits = np.asarray(canvas.buffer_rgba())[..., :3]
        ends = bar.get_tightbbox(canvas.get_renderer())
        assert ends is not None
        if upright:
            return digits[:, : min(math.ceil(ends.x1 + letters), across)]
        return digits[: min(math.ceil(across - ends.y0 + letters), across)]

    def _place(self, length: int, across: int, letters: float, upright: bool, bar: bool) -> tuple:
        """(left, bottom, width, height) of an axes, in parts of the figure; from the picture outwards."""
        profile = 1.8 * letters if self.opacities is not None else 0.0
        near = letters + (profile if bar else 0.0)
        thick = 1.3 * letters if bar else profile
        spare = _spare(length, letters, upright) / length
        if upright:
            return near / across, spare, thick / across, 1 - 2 * spare
        return spare, 1 - (near + thick) / across, 1 - 2 * spare, thick / across

    @property
    def _ends(self) -> tuple[float, float]:
        return (self.low, self.high) if self.low < self.high else (self.low - 0.5, self.low + 0.5)

    def _values(self, length: int) -> Tensor:
        low, high = self._ends
        return low + (high - low) * (torch.arange(length, dtype=torch.float64) + 0.5) / length

    def _draw_bar(self, axes: Any, length: int, letters: float, ink: str, behind: tuple, upright: bool) -> None:
        from matplotlib.ticker import FuncFormatter, MaxNLocator

        values = self._values(length)
        colors = np.array(_encoded(self.colors(values).detach().cpu().double()))
        if self.opacities is not None:
            colors[self.opacities(values).detach().cpu().numpy() <= 0] = behind
        low, high = self._ends
        extent = (0, 1, low, high) if upright else (low, high, 0, 1)
        axes.imshow(colors[:, None] if upright else colors[None], extent=extent, origin="lower", aspect="auto")
        axis, other = (axes.yaxis, axes.xaxis) if upright else (axes.xaxis, axes.yaxis)
        other.set_visible(False)
        broad = _BROAD * max(len(f"{end:.3g}") for end in (low, high)) + 1.5
        free = (length - 2 * _spare(length, letters, upright)) / letters
        most = max(1, int(free / (3 if upright else broad)))
        axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]))
        axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:.10g}".replace("-", "−")))
        axes.yaxis.tick_right()
        axes.yaxis.set_label_position("right")
        points = 72 / _DPI * letters
        style = {"labelsize": points, "labelfontfamily": "DejaVu Sans", "colors": ink}
        axes.tick_params(**style, length=0.35 * points, width=0.08 * points, pad=0.3 * points)
        if self.label:
            lines = textwrap.fill(self.label, max(int(length / (_BROAD * letters)), 4))
            write = axes.set_ylabel if upright else axes.set_xlabel
            write(lines, fontsize=points, family="DejaVu Sans", color=ink, parse_math=False)
        for spine in axes.spines.values():
            spine.set(edgecolor=ink, linewidth=0.08 * points)

    def _draw_opacities(self, axes: Any, length: int, ink: str, upright: bool) -> None:
        """Their course along the bar, towards the picture."""
        assert self.opacities is not None
        values = self._values(length)
        opacities = self.opacities(values).detach().cpu().numpy()
        part = np.sqrt(opacities / max(float(opacities.max()), 1e-12))
        axes.set_axis_off()
        style = {"color": ink, "alpha": 0.55, "linewidth": 0}
        if upright:
            axes.fill_betweenx(values.numpy(), 0, part, **style)
            axes.set(ylim=self._ends, xlim=(1.1, 0))
        else:
            axes.fill_between(values.numpy(), 0, part, **style)
            axes.set(xlim=self._ends, ylim=(0, 1.1))


def _spare(length: int, letters: float, upright: bool) -> float:
    """Pixels at either end of the bar, into which numbers at its ends reach."""
    return min(max(_SPARE * length, (0.6 if upright else 2.6) * letters), 0.3 * length)


def _encoded(linear: Tensor) -> Any:
    """Encoded by sRGB, 0 … 1, as matplotlib takes colours."""
    encoded = to_srgb(linear.clamp(0, 1))
    return tuple(encoded.tolist()) if linear.ndim == 1 else encoded.numpy()


def _ink(background: Sequence[float]) -> str:
    red, green, blue = (min(c, 1.0) for c in background)
    return "black" if 0.2126 * red + 0.7152 * green + 0.0722 * blue > _GRAY else "white"
