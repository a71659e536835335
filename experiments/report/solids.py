"""Solids in a matplotlib figure: seen from far away, lit, the farther polygons behind the nearer ones.

Letters: points are (..., 3) in space; an eye looks along −`towards`, z is up on the page.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb

from experiments.report.plots import INK

LIGHT = (0.35, 0.25, 0.9)  # along the page's right and up, and towards the eye
EDGE = "#20272e"  # on what is opaque, whatever the page
_DARKEST = 0.55
_ORDER = 1  # of whatever is drawn: what comes later covers what came before


@dataclass(frozen=True)
class Eye:
    """Where a picture is seen from.

    Attributes:
        towards: a direction from the solid to the eye.
    """

    towards: tuple[float, float, float]

    @cached_property
    def axes(self) -> np.ndarray:
        """Rows: the page's right, the page's up, towards the eye."""
        back = np.array(self.towards) / np.linalg.norm(self.towards)
        right = np.cross([0, 0, 1], back)
        right /= np.linalg.norm(right)
        return np.array([right, np.cross(back, right), back])

    def seen(self, points: np.ndarray) -> np.ndarray:
        """(..., 3): places on the page, and how near to the eye."""
        return np.asarray(points) @ self.axes.T


@dataclass(frozen=True)
class Polygons:
    """Polygons of the same number of corners.

    Attributes:
        corners: (P, K, 3).
        colors: (P, 3).
        edges: width of their outlines in points; 0: none, polygons touch without a seam.
        opacity: of what is between.
        lit: shaded by the angle to the light; else their colours are taken as they are.
    """

    corners: np.ndarray
    colors: np.ndarray
    edges: float = 0.0
    opacity: float = 1.0
    lit: bool = True

    @classmethod
    def of(
        cls, corners: np.ndarray, color: str, edges: float = 0.0, opacity: float = 1.0, lit: bool = True
    ) -> Polygons:
        """All of one colour."""
        return cls(np.asarray(corners), np.tile(to_rgb(color), (len(corners), 1)), edges, opacity, lit)

    def facing(self, eye: Eye, away: bool = False) -> Polygons:
        """Those that turn their front to the eye, where corners go round counterclockwise, or their back."""
        chosen = (self._normals() @ eye.axes[2] > 0) != away
        return Polygons(self.corners[chosen], self.colors[chosen], self.edges, self.opacity, self.lit)

    def shaded(self, eye: Eye) -> np.ndarray:
        if not self.lit or not len(self.corners):
            return self.colors
        normals = self._normals() @ eye.axes.T
        cosine = np.abs(normals @ (np.array(LIGHT) / np.linalg.norm(LIGHT)))
        return self.colors * (_DARKEST + (1 - _DARKEST) * cosine[:, None])

    def _normals(self) -> np.ndarray:
        """(P, 3), of length 1; 0 where a polygon is a line."""
        a, b, c = self.corners[:, 0], self.corners[:, 1], self.corners[:, 2]
        normals = np.cross(b - a, c - a)
        return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-300)


def draw(axes: Axes, eye: Eye, polygons: Sequence[Polygons]) -> None:
    """Draws polygons, one after the other within each of the groups and over the groups before, farthest first."""
    for group in polygons:
        if not len(group.corners):
            continue
        seen = eye.seen(group.corners)
        order = np.argsort(seen[..., 2].mean(-1))
        faces = np.column_stack([group.shaded(eye), np.full(len(order), group.opacity)])[order]
        outlines = (EDGE if group.opacity == 1 else INK) if group.edges else faces
        width = group.edges or (0.3 if group.opacity == 1 else 0.0)
        axes.add_collection(
            PolyCollection(
                list(seen[order][..., :2]), facecolors=faces, edgecolors=outlines, linewidths=width, zorder=_ORDER
            )
        )


def lines(axes: Axes, eye: Eye, segments: np.ndarray, width: float = 0.8, style: str = "-", color: str = INK) -> None:
    """Draws segments (S, 2, 3)."""
    if len(segments):
        seen = eye.seen(segments)[..., :2]
        axes.add_collection(LineCollection(list(seen), colors=color, linewidths=width, linestyles=style, zorder=_ORDER))


def dots(axes: Axes, eye: Eye, points: np.ndarray, color: str | np.ndarray, size: float) -> None:
    """Draws points (P, 3) as discs."""
    seen = eye.seen(points)
    axes.scatter(seen[:, 0], seen[:, 1], s=size, c=color, edgecolors=EDGE, linewidths=0.6, zorder=_ORDER)


def frame(axes: Axes, title: str) -> None:
    """A picture without axes, as large as what is in it."""
    axes.set_axis_off()
    axes.grid(False)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.1)
    axes.autoscale_view()
    axes.set_title(title)
