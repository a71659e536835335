"""Section of `quadrics_gallery`: pictures of covers, part by part."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.page import Gallery, Section, picture
from experiments.report.style import text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.quadrics_gallery import Config

_TITLES = {
    "materials": "Materials",
    "culling": "Culling",
    "edges": "Sharp edges",
    "quads": "Bilinear quads",
    "levels": "Level sets of splines",
    "scan": "A scan",
    "triangles": "Beside triangles",
}
_COUNTS = ("balls", "triangles", "left", "sharp", "bilinear", "tetrahedra")
_CAPTIONS = {
    "materials": "The same cover of a torus. Reflection lines show where normals turn, toon contours where they are at "
    "right angles to the ray.",
    "culling": "Balls that show the eye no front are left out: from there nothing is missing. From another side what "
    "is left has holes.",
    "edges": "A block with a hole. Balls at its edges hold two graphs, each cut by the plane between them; without "
    "those planes, and those at the ends of sides, graphs go on to the ends of their balls. Two paraboloids meet at "
    "such a plane.",
    "quads": "A net of bilinear quads, and the same with two triangles for each; lines are the edges of quads.",
    "levels": "Level sets of quadratic super splines, stored as quadrics in the tetrahedra that hold them, and walked "
    "through without anything stored. Pixels differ that see one of both alone, or at other depths.",
    "scan": "A cover of the points of a scan.",
    "triangles": "Reflection lines, a close-up. The simplified mesh and marching cubes have no larger rms distance "
    "than the cover, and normals that are interpolated between vertices; first hits of the cover are what it is "
    "without blending.",
}


def draw(_config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    parts = []
    for part, title in _TITLES.items():
        some = [r for r in records.values() if r["part"] == part]
        if some:
            pictures = [picture(folder, r["image"], r["name"].replace("-", " "), _detail(r)) for r in some]
            parts.append(Section(title, (), (Gallery(pictures, _CAPTIONS[part], columns=min(len(pictures), 4)),)))
    return Section("What covers look like", (), (), parts)


def _detail(r: Record) -> str:
    cells = [f"{r[name]:,} {name}" for name in _COUNTS if name in r]
    if "rms" in r:
        cells.append(f"rms {text(r['rms'])} of the diagonal")
    if "differ" in r:
        cells.append(f"stored in {r['stored_seconds']:.1f} s, {r['differ']} pixels differ")
    return ", ".join([*cells, f"{r['seconds']:.2f} s"])
