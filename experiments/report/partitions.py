"""Section of `partitions`: cells whole, pulled apart and among others; a tetrahedron with its patch; all patches."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb

from experiments.report import plots, solids
from experiments.report.page import Block, Column, Plot, Section, Table
from experiments.report.solids import Eye, Polygons
from experiments.runs import Record, run_file
from filterlab.bernstein import multi_indices

if TYPE_CHECKING:
    from experiments.partitions import Config

LEAD = (
    "Space is cut into cells that are alike, and each cell into tetrahedra that meet in its centre. On a tetrahedron "
    "a spline is one polynomial, whose Bernstein coefficients are weighted sums of the samples around. All of it is "
    "drawn from the tables that the splines are evaluated by.",
)
EYE = Eye((0.75, -1.0, 0.62))
COLORS = ("#5aa9dc", "#e8b23e", "#64b48c")  # of the kinds of tetrahedra, or of the axes that their faces lie across
PATCH = "#d9694f"
ABOVE, BELOW = "#d9694f", "#5b7fb5"  # coefficients
APART, LOOSE = 0.8, 0.35  # how far faces are pulled from the centre, and tetrahedra from each other, of their distance


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    cells = [Cell(records[name], folder) for name in config.splines if name in records]
    sections = [Section(cell.record["spline"], (), _pictures(cell, i)) for i, cell in enumerate(cells)]
    return Section("Partitions", LEAD, [_facts(cells)] if cells else [], sections)


@dataclass(frozen=True)
class Cell:
    """What was recorded of a spline."""

    record: Record
    folder: Path

    @cached_property
    def vertices(self) -> np.ndarray:
        """(T, 4, 3)."""
        return np.load(run_file(self.folder, self.record["vertices"]))

    @cached_property
    def patches(self) -> list[np.ndarray]:
        """Triangles of every tetrahedron, (·, 3, 3)."""
        ends = np.cumsum(self.record["patch_triangles"])
        return np.split(np.load(run_file(self.folder, self.record["patches"])), ends[:-1])

    @cached_property
    def coefficients(self) -> np.ndarray:
        """(T, B), less the level."""
        return np.load(run_file(self.folder, self.record["coefficients"])) - self.record["level"]

    @cached_property
    def faces(self) -> np.ndarray:
        """The face of the cell that each tetrahedron stands on: the point of its plane next to the centre, (T, 3)."""
        corners = self.vertices[:, 1:]
        normals = _normals(corners)
        heights = (normals * corners[:, 0]).sum(-1, keepdims=True)
        return normals * heights / (normals * normals).sum(-1, keepdims=True)

    @property
    def colors(self) -> np.ndarray:
        """Of the tetrahedra, (T, 3): by kind, or where all are alike by the axis that their face lies across."""
        kinds = np.array(self.record["kinds"])
        shown = kinds if kinds.any() else np.abs(self.faces).argmax(-1)
        return np.array([to_rgb(COLORS[n % len(COLORS)]) for n in shown])

    @property
    def skin(self) -> Polygons:
        """The faces of the cell, those that lie opposite to its centre."""
        return Polygons(_outwards(self.vertices[:, 1:]), self.colors)

    @cached_property
    def hull(self) -> np.ndarray:
        """The edges of the cell, (S, 2, 3): between tetrahedra that stand on different faces."""
        found: dict[frozenset[tuple[float, ...]], list[np.ndarray]] = {}
        for face, foot in zip(self.vertices[:, 1:], self.faces, strict=True):
            for a, b in combinations(face, 2):
                found.setdefault(frozenset((tuple(a), tuple(b))), []).append(foot / np.linalg.norm(foot))
        edges = [sorted(edge) for edge, (n, m) in found.items() if n @ m < 1 - 1e-9]
        return np.array(edges)

    @cached_property
    def shown(self) -> int:
        """The tetrahedron whose patch is the largest."""
        areas = [np.linalg.norm(_normals(patch), axis=-1).sum() for patch in self.patches]
        return int(np.argmax(areas))


def _outwards(faces: np.ndarray) -> np.ndarray:
    """Triangles (T, 3, 3) about the origin, turned so that they go round counterclockwise seen from outside."""
    turned = np.linalg.det(faces) < 0
    return np.where(turned[:, None, None], faces[:, [0, 2, 1]], faces)


def _pictures(cell: Cell, index: int) -> list[Block]:
    whole = {
        f"{len(cell.vertices)} tetrahedra": _whole,
        "pulled apart": _apart,
        "among its neighbours": _among,
    }
    inside = {"one tetrahedron, its coefficients and patch": _one, "a level set in the cell": _level_set}
    alike = not any(cell.record["kinds"])
    colored = "Colours: " + ("the axis that a face lies across." if alike else "the kinds of tetrahedra.")
    where = ", with samples on their hexagons" if cell.record["shift"] else "; each has a sample in its middle"
    return [
        Plot(
            _row(cell, whole, 10.4, 3.9, f"cell-{index}"),
            "A cell from outside; its tetrahedra, which meet in its centre; cells that touch it from behind"
            f"{where}. {colored}",
        ),
        Plot(
            _row(cell, inside, 10.4, 4.6, f"patch-{index}"),
            "Left: discs are the domain points, red where the coefficient is above the level, blue where it is below, "
            "the larger the farther from it; v₀ is the centre of the cell. Right: the patches of all tetrahedra, of "
            f"random samples. {colored}",
        ),
    ]


def _row(
    cell: Cell, pictures: Mapping[str, Callable[[Axes, Cell], None]], width: float, height: float, name: str
) -> Markup:
    with plots.settings():
        figure = plots.canvas(width, height)
        for axes, (title, picture) in zip(figure.subplots(1, len(pictures)), pictures.items(), strict=True):
            picture(axes, cell)
            solids.frame(axes, title)
        return plots.svg(figure, name)


def _whole(axes: Axes, cell: Cell) -> None:
    skin = cell.skin
    front = Polygons(skin.corners, skin.colors, edges=0.5).facing(EYE)
    solids.draw(axes, EYE, [front])
    solids.lines(axes, EYE, _front(cell), 1.3, color=solids.EDGE)


def _front(cell: Cell, at: np.ndarray | float = 0.0) -> np.ndarray:
    """The cell's edges that are seen, (S, 2, 3), moved by `at`: those of faces that turn to the eye."""
    seen = {_key(a + b) for face in cell.skin.facing(EYE).corners for a, b in combinations(face, 2)}
    return np.array([edge for edge in cell.hull if _key(edge.sum(0)) in seen]) + at


def _key(point: np.ndarray) -> tuple[float, ...]:
    return tuple(np.round(point, 9))


def _apart(axes: Axes, cell: Cell) -> None:
    centres = cell.vertices.mean(1)
    moves = APART * cell.faces + LOOSE * (centres - 0.75 * cell.faces)
    for t in np.argsort(EYE.seen(centres + moves)[:, 2]):
        corners = _sides(cell.vertices[t]) + moves[t]
        solids.draw(axes, EYE, [Polygons(corners, np.tile(cell.colors[t], (4, 1)), edges=0.4).facing(EYE)])


def _sides(vertices: np.ndarray) -> np.ndarray:
    """The faces of a tetrahedron, (4, 3, 3)."""
    middle = vertices.mean(0)
    return _outwards(vertices[[[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]] - middle) + middle


def _among(axes: Axes, cell: Cell) -> None:
    """The cell and those across its faces that lie behind it, farthest first."""
    around = np.unique(np.round(2 * np.concatenate([cell.faces, np.zeros((1, 3))]), 9), axis=0)
    shown = around[EYE.seen(around)[:, 2] <= 0]
    for at in shown[np.argsort(EYE.seen(shown)[:, 2])]:
        home = not at.any()
        skin = cell.skin
        colors = skin.colors if home else np.full_like(skin.colors, 0.82)
        solids.draw(axes, EYE, [Polygons(skin.corners + at, colors).facing(EYE)])
        solids.lines(axes, EYE, _front(cell, at), 1.1 if home else 0.7, color=solids.EDGE)
        solids.dots(axes, EYE, _samples(cell, at), "#ffffff", 12)


def _samples(cell: Cell, at: np.ndarray) -> np.ndarray:
    """Samples on those faces of a cell that turn to the eye."""
    steps = np.arange(-2, 3) + cell.record["shift"]
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 1, 3)
    feet = np.unique(np.round(cell.faces, 9), axis=0)
    beyond = ((grid - feet) * feet).sum(-1)  # of the plane of each face
    on = (np.abs(beyond) < 1e-9) & (EYE.seen(feet)[:, 2] > 0)
    return grid[:, 0][on.any(-1) & (beyond < 1e-9).all(-1)] + at


def _one(axes: Axes, cell: Cell) -> None:
    t = cell.shown
    vertices, b = cell.vertices[t], cell.coefficients[t]
    eye = _eye_on(vertices, cell.patches[t])
    glass = Polygons.of(_sides(vertices), "#9aa4ae", edges=0.9, opacity=0.12)
    solids.draw(axes, eye, [glass.facing(eye, away=True), Polygons.of(cell.patches[t], PATCH), glass.facing(eye)])
    indices = multi_indices(cell.record["degree"], 3)
    points = np.array(indices) @ vertices / cell.record["degree"]
    near = [(p, q) for (p, a), (q, c) in combinations(list(zip(points, indices, strict=True)), 2) if _adjacent(a, c)]
    solids.lines(axes, eye, np.array(near), 0.5, ":")
    sizes = 18 + 60 * np.abs(b) / np.abs(b).max()
    solids.dots(axes, eye, points, np.where(b > 0, ABOVE, BELOW), sizes)
    middle = eye.seen(vertices.mean(0))[:2]
    for k, v in enumerate(vertices):
        place = eye.seen(v)[:2]
        x, y = place + 0.07 * (place - middle) / np.linalg.norm(place - middle)
        axes.text(x, y, f"v{'₀₁₂₃'[k]}", ha="center", va="center")


def _adjacent(a: tuple[int, ...], b: tuple[int, ...]) -> bool:
    return sum(abs(x - y) for x, y in zip(a, b, strict=True)) == 2


def _eye_on(vertices: np.ndarray, patch: np.ndarray) -> Eye:
    """Of many directions the one in which both the smallest face of a tetrahedron and its patch look large."""
    k = np.arange(1, 200)
    z, turn = 1 - k / 100, k * np.pi * (3 - np.sqrt(5))
    towards = np.column_stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    faces, parts = (np.abs(_normals(triangles) @ towards.T) for triangles in (_sides(vertices), patch))
    x, y, height = towards[(faces.min(0) * parts.sum(0)).argmax()]
    return Eye((x, y, height))


def _normals(triangles: np.ndarray) -> np.ndarray:
    """Of triangles (T, 3, 3), as long as twice their areas."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _level_set(axes: Axes, cell: Cell) -> None:
    colors = cell.colors
    triangles = np.concatenate(cell.patches)
    owners = np.repeat(np.arange(len(cell.patches)), [len(p) for p in cell.patches])
    skin = Polygons.of(cell.skin.corners, "#9aa4ae", opacity=0.08)
    solids.draw(axes, EYE, [skin.facing(EYE, away=True)])
    solids.draw(axes, EYE, [Polygons(triangles, colors[owners]), skin.facing(EYE)])
    solids.lines(axes, EYE, cell.hull, 0.5, ":")
    solids.lines(axes, EYE, _front(cell), 1.1)


def _facts(cells: list[Cell]) -> Table:
    columns = [Column("spline", numeric=False), Column("degree"), Column("tetrahedra", "a cell"), Column("kinds")]
    columns += [Column("their volumes", "voxels", False), Column("domain points", "a cell")]
    columns += [Column("samples", "a tetrahedron"), Column("samples", "a cell")]
    rows = [
        [
            r["spline"],
            str(r["degree"]),
            str(len(r["kinds"])),
            str(len(r["volumes"])),
            ", ".join(r["volumes"]),
            str(r["domain_points"]),
            str(r["samples_of_one"]),
            str(r["samples_of_all"]),
        ]
        for r in (cell.record for cell in cells)
    ]
    return Table(columns, rows, "What a cell is made of, and what its polynomials need.")
