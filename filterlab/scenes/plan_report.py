"""A plan as people read it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from filterlab.recommendation.report import duration, percent, size
from filterlab.scenes.plan import (
    AnyPlan,
    MeshPlan,
    OfField,
    OfImage,
    OfSurface,
    PiecesPlan,
    Plan,
    SurfacePlan,
    TerrainPlan,
    ValuePlan,
)


def table(plan: AnyPlan, pictures: int = 1) -> Table:
    """One line for every decision; of so many pictures, all of which take about what the first one does."""
    shown = Table(show_header=False, box=None)
    for name, text in _LINES[type(plan)](plan):
        shown.add_row(name, Text(text))
    if pictures > 1:
        shown.add_row("pictures", Text(f"{pictures} such pictures, about {duration(pictures * plan.seconds.median)}"))
    return shown


def _begin(plan: OfField) -> list[tuple[str, str]]:
    taps = "" if plan.taps is None else f", {plan.taps} taps"
    lines = [("method", f"{plan.method} ({plan.scheme}), coefficients as {plan.storage}{taps}")]
    return lines + [("" if i else "chosen", sentence) for i, sentence in enumerate(plan.chosen)]


def _asked_at_hits(plan: OfSurface) -> str:
    return {1: "gradients at hits", 2: "gradients and Hessians at hits"}[plan.order]


def _lines_of_surface(plan: SurfacePlan) -> list[tuple[str, str]]:
    lines = _begin(plan)
    lines.append(
        ("surface", f"level {plan.level:g}; pieces of degree {plan.degree} along rays, {_asked_at_hits(plan)}")
    )
    lines.append(("relevant", f"{plan.cells:,} cells may hold the level ({plan.pieces:,} pieces)"))
    lines.append(("rays", f"{plan.rays:,}"))
    sizes = (("volume", plan.volume_bytes), ("coefficients", plan.coefficient_bytes), ("image", plan.image_bytes))
    return lines + _end(plan, sizes, "cast")


def _lines_of_pieces(plan: PiecesPlan) -> list[tuple[str, str]]:
    cut = f", cut by up to {plan.planes} planes" if plan.planes else ""
    lines = [("surface", f"{plan.called}{cut}; {_asked_at_hits(plan)}"), ("rays", f"{plan.rays:,}")]
    return lines + _end(plan, (("surface", plan.surface_bytes), ("image", plan.image_bytes)), "cast")


def _lines_of_terrain(plan: TerrainPlan) -> list[tuple[str, str]]:
    sizes = (("heights", plan.height_bytes), ("bounds of them", plan.bound_bytes), ("image", plan.image_bytes))
    return [
        ("heights", f"{plan.size[0]} × {plan.size[1]}"),
        (
            "missing",
            f"{plan.missing}, {'made from those around' if plan.filled else 'holes'}" if plan.missing else "none",
        ),
        ("spacing", f"{plan.spacing[0]:.6g} × {plan.spacing[1]:.6g} m"),
        ("extent", f"{plan.extent[0] / 1000:.4g} × {plan.extent[1] / 1000:.4g} km"),
        ("height", f"{plan.span[0]:.6g} … {plan.span[1]:.6g} {plan.unit}".rstrip() + ", but for ½ % at either end"),
        ("spline", f"{plan.spline}, {plan.cells[0]} × {plan.cells[1]} cells of two quartics, {_asked_at_hits(plan)}"),
        ("exaggeration", f"{plan.exaggeration:g}{', as the relief suggests' if plan.suggested else ''}"),
        ("camera", _looks(plan)),
        ("light", _lit(plan) + (", casts shadows" if plan.shadows else "")),
        ("rays", f"{plan.rays:,}"),
        *_end(plan, sizes, "cast"),
    ]


def _looks(plan: TerrainPlan) -> str:
    if plan.looks is None:
        return "as the scene says"
    return f"looks to {plan.looks[0]:g}° from north, {plan.looks[1]:g}° down"


def _lit(plan: TerrainPlan) -> str:
    return "lights of the scene" if plan.sun is None else f"sun {plan.sun[0]:g}° from north, {plan.sun[1]:g}° high"


def _lines(plan: Plan) -> list[tuple[str, str]]:
    lines = _begin(plan)
    lines.append(("asked of it", plan.derivatives))
    marcher = "fused: one program, compiled for this processor" if plan.marcher == "fused" else "plain: torch"
    lines.append(("marcher", marcher + (f" ({plan.not_fused})" if plan.not_fused else "")))
    lines.append(("rays", f"{plan.rays:,}"))
    lines.append(("samples", f"{plan.samples:,} at a step of {plan.step:g} voxels"))
    lines.append(("empty space", _skipping(plan)))
    sizes = (
        ("volume", plan.volume_bytes),
        ("coefficients", plan.coefficient_bytes),
        ("image", plan.image_bytes),
        ("rays", plan.ray_bytes),
    )
    return lines + _end(plan, sizes, "march")


def _lines_of_values(plan: ValuePlan) -> list[tuple[str, str]]:
    lines = _begin(plan)
    lines.append(("shown", f"{plan.kind}: values alone, without light"))
    lines.append(("rays", f"{plan.rays:,}"))
    at = "" if plan.step is None else f" at a step of {plan.step:g} voxels"
    lines.append(("samples", f"{plan.samples:,}{at}"))
    sizes = (
        ("volume", plan.volume_bytes),
        ("coefficients", plan.coefficient_bytes),
        ("image", plan.image_bytes),
        ("work", plan.work_bytes),
    )
    return lines + _end(plan, sizes, "evaluate")


def _lines_of_mesh(plan: MeshPlan) -> list[tuple[str, str]]:
    lines = _begin(plan)
    lines.append(("grid", " × ".join(map(str, plan.size)) + f" points, a step of {plan.step:g} voxels"))
    where = f"vertices within {plan.residual:.0e} of level {plan.level:g}"
    lines.append(("mesh", f"about {plan.triangles:,} triangles, {where}" if plan.triangles else "no triangles"))
    sizes = (
        ("volume", plan.volume_bytes),
        ("coefficients", plan.coefficient_bytes),
        ("grid", plan.grid_bytes),
        ("mesh", plan.mesh_bytes),
    )
    time = plan.seconds
    spread = f"{duration(time.low)} … {duration(time.high)}"
    lines.append(_memory(sizes))
    return [*lines, ("time", f"at most about {duration(time.median)} ({spread}, from a coarser grid)")]


def _memory(sizes: Sequence[tuple[str, int]]) -> tuple[str, str]:
    return "memory", ", ".join(f"{name} {size(count)}" for name, count in sizes if count)


def _end(plan: OfImage, sizes: Sequence[tuple[str, int]], verb: str) -> list[tuple[str, str]]:
    lines = [_memory(sizes)]
    time = plan.seconds
    spread = f"{duration(time.low)} … {duration(time.high)}"
    lines.append(("time", f"about {duration(time.median)} to {verb} ({spread}, from a small part of the rays)"))
    lines += [("" if i else "not computed", text) for i, text in enumerate(plan.absent)]
    return lines


def _skipping(plan: Plan) -> str:
    if plan.empty_bricks is None or plan.skipped is None:
        return "not looked for: the plain marcher takes every sample"
    if not plan.empty_bricks:
        return "none: every brick of the volume may have some opacity"
    return f"{percent(plan.empty_bricks)} of the bricks; about {percent(plan.skipped)} of the samples lie in them"


_LINES: dict[type, Callable[[Any], list[tuple[str, str]]]] = {
    Plan: _lines,
    SurfacePlan: _lines_of_surface,
    PiecesPlan: _lines_of_pieces,
    TerrainPlan: _lines_of_terrain,
    ValuePlan: _lines_of_values,
    MeshPlan: _lines_of_mesh,
}
