"""Section of `quadrics_gallery`: pictures of surfaces of quadrics, part by part."""

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
    "level-sets": "Level sets in tetrahedra",
    "triangles": "Beside triangles",
}
_CAPTIONS = {
    "materials": "One cover. Reflection lines show where normals turn, toon contours where they are at right angles to "
    "the ray. Figures 1, 7 and 11 of the paper.",
    "culling": "Balls that show the eye no front are left out: from there nothing is missing. From another side what "
    "is left has holes. Figure 3.",
    "edges": "A block with a hole. Balls at its edges hold two graphs, each cut by the plane between them; without "
    "those planes, and those at the ends of sides, graphs go on to the ends of their balls. Below, two paraboloids "
    "that meet at an angle, each in its ball. Figure 8.",
    "quads": "A square column that turns by 75° from storey to storey: each side one bilinear quad, and two triangles. "
    "Triangles leave the patch, and their normals jump along the diagonal. Figure 9.",
    "level-sets": "A quadratic super spline: its quadrics, each clipped by its tetrahedron, and the walk through the "
    "samples, which stores nothing for a level. The pictures are the same. Figure 10.",
    "triangles": "Reflection lines. The mesh is a fine one, simplified by quadric error metrics until its rms distance "
    "from the torus is that of the cover, with normals interpolated between its vertices. The first hits of the cover "
    "are what it is without blending. Figure 12.",
}
_COLUMNS = {"materials": 3, "culling": 3, "triangles": 3}
_COUNTS = ("balls", "quadrics", "quads", "tetrahedra", "triangles", "left", "sharp")


def draw(_config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    parts = []
    for part, title in _TITLES.items():
        some = [r for r in records.values() if r["part"] == part]
        if some:
            pictures = [picture(folder, r["image"], r["name"].replace("-", " "), _detail(r)) for r in some]
            parts.append(Section(title, (), (Gallery(pictures, _CAPTIONS[part], columns=_COLUMNS.get(part, 2)),)))
    return Section("What surfaces of quadrics look like", (), (), parts)


def _detail(r: Record) -> str:
    cells = [r["shown"]] if "shown" in r else []
    cells += [f"{r[name]:,} {name}" for name in _COUNTS if name in r]
    if "bytes" in r:
        cells.append(f"{r['bytes'] / 1e6:.0f} MB, made in {r['stored']:.1f} s")
    if "rms" in r:
        cells.append(f"rms {text(r['rms'])} of the diagonal")
    return ", ".join([*cells, f"{r['seconds']:.1f} s"])
