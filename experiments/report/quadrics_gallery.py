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

_TITLES = {"materials": "Materials", "culling": "Culling", "edges": "Sharp edges", "triangles": "Beside triangles"}
_CAPTIONS = {
    "materials": "The same cover of a torus. Reflection lines show where normals turn, toon contours where they are at "
    "right angles to the ray.",
    "culling": "Balls that show the eye no front are left out: from there nothing is missing. From another side what "
    "is left has holes.",
    "edges": "A block with a hole. Balls at its edges hold two graphs, each cut by the plane between them; without "
    "those planes, and those at the ends of sides, graphs go on to the ends of their balls.",
    "triangles": "Reflection lines. The mesh is marching cubes with no larger rms distance than the cover's, its "
    "normals interpolated between vertices; the first hits of the cover are what it is without blending.",
}


def draw(_config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    parts = []
    for part, title in _TITLES.items():
        some = [r for r in records.values() if r["part"] == part]
        if some:
            pictures = [picture(folder, r["image"], r["name"].replace("-", " "), _detail(r)) for r in some]
            parts.append(Section(title, (), (Gallery(pictures, _CAPTIONS[part], columns=len(pictures)),)))
    return Section("What covers look like", (), (), parts)


def _detail(r: Record) -> str:
    cells = [f"{r[name]:,} {name}" for name in ("balls", "triangles", "left", "sharp") if name in r]
    if "rms" in r:
        cells.append(f"rms {text(r['rms'])} of the diagonal")
    return ", ".join([*cells, f"{r['seconds']:.1f} s"])
