"""What the adjoint of a march gives: which derivatives there are, how programs lay them out, and their names.

Letters: R rays, K lights, M control points with M − 1 intervals between them (1 of a single control point).
"""

from __future__ import annotations

from collections.abc import Collection

from torch import Tensor

MEMBERS = {
    "coefficients": ("coefficients",),
    "rays": ("entry", "direction", "length"),
    "table": ("positions", "opacities", "colors"),
    "shading": ("ambient", "shininess", "diffuse", "specular", "toward", "halfway"),
}
"""What the adjoint can compute: groups of derivatives, each with the tensors of `March.tensors` that it is by."""

GRADIENTS = tuple(MEMBERS)
"""The groups. The march itself has none of them."""

TABLE_ROW = 12
"""Of every interval the derivatives by x₀ x₁ α₀ α₁ r₀ r₁ g₀ g₁ b₀ b₁, and two that mean nothing."""


def gradient_columns(lights: int | None) -> dict[str, slice]:
    """Where a ray's derivatives stand in its row, of 7 numbers or (lit) 9 + 12 K.

    Args:
        lights: K; None: unlit.
    """
    widths = {"entry": 3, "direction": 3, "length": 1}
    if lights is not None:
        widths |= {"shading": 2 + 6 * lights, "view": 6 * lights}
    columns, first = {}, 0
    for name, width in widths.items():
        columns[name] = slice(first, first + width)
        first += width
    return columns


def columns_of_rays(lights: int | None) -> int:
    """Their number."""
    return max(columns.stop for columns in gradient_columns(lights).values())


def by_name(
    gradients: Collection[str], volume: Tensor | None, by_ray: Tensor, table: Tensor, points: int, lights: int | None
) -> dict[str, Tensor]:
    """What the adjoint of a march returns.

    Args:
        gradients: what was asked.
        volume: the derivatives by the coefficients; None: not asked.
        by_ray: (R, columns).
        table: (intervals, 12).
        points: M.
        lights: K; None: unlit.
    """
    columns = gradient_columns(lights)
    found = {} if volume is None else {"coefficients": volume}
    if "rays" in gradients:
        found |= {name: by_ray[:, columns[name]] for name in ("entry", "direction")}
        found["length"] = by_ray[:, columns["length"]][:, 0]
    if "table" in gradients:
        found |= _of_table(table, points)
    if "shading" in gradients and lights is not None:
        found |= _of_shading(by_ray[:, columns["shading"]].sum(0), by_ray[:, columns["view"]], lights)
    return found


def _of_table(rows: Tensor, points: int) -> dict[str, Tensor]:
    """Derivatives by both ends of every interval as derivatives by the control points."""
    by_point = rows.new_zeros(len(rows) + 1, 5)
    by_point[:-1] += rows[:, 0:10:2]
    by_point[1:] += rows[:, 1:10:2]
    if points == 1:
        by_point = by_point.sum(0, keepdim=True)
        by_point[:, 0] = 0
    return {"positions": by_point[:, 0], "opacities": by_point[:, 1], "colors": by_point[:, 2:]}


def _of_shading(shading: Tensor, view: Tensor, lights: int) -> dict[str, Tensor]:
    tints, vectors = shading[2:].reshape(lights, 2, 3), view.reshape(len(view), lights, 2, 3)
    return {
        "ambient": shading[0],
        "shininess": shading[1],
        "diffuse": tints[:, 0],
        "specular": tints[:, 1],
        "toward": vectors[:, :, 0],
        "halfway": vectors[:, :, 1],
    }
