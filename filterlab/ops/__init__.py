"""The numerical core: fused operations, their adjoints, and what they are checked against.

    stencil ──▶ gather place prefilter contract march raycast bounds ─▶ reference ─▶ cpu, cuda ─▶ differentiable ─▶ here
    what is summed    descriptions of every op              plain twins    programs     choice, adjoint
    tree    ──▶ quadrics
    masks   ──▶ heights (jet, splat) ─▶ height_hits

Every op has the same five parts in the same places: what it is (`<op>`: frozen data, shapes, limits), the plain twin
(`reference`), vector code (`cpu`), code for a GPU (`cuda`), and what makes it differentiable and chooses
(`differentiable`). `gather` and its adjoint `scatter` are what every evaluation goes through; `jet` and `splat` are the
pair for all partial derivatives of one tensor-product kernel.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from filterlab.kernels import PiecewisePolynomial
from filterlab.ops.differentiable import gather as sums
from filterlab.ops.differentiable import operators
from filterlab.ops.differentiable import place as placement
from filterlab.ops.differentiable import prefilter as filtering
from filterlab.ops.differentiable.evaluation import Evaluation
from filterlab.ops.differentiable.gather import IMPLEMENTATIONS
from filterlab.ops.place import Placed, Placement
from filterlab.ops.stencil import Product, Stencil, multi_indices
from filterlab.ops.tetrahedra import AnyStencil, TetrahedralStencil
from filterlab.prefilters import Prefilter
from filterlab.volume import Boundary

__all__ = [
    "IMPLEMENTATIONS",
    "Evaluation",
    "Placement",
    "Product",
    "Stencil",
    "TetrahedralStencil",
    "gather",
    "jet",
    "multi_indices",
    "place",
    "prefilter_axis",
    "prefilter_samples",
    "scatter",
    "splat",
]


def _check(batch: Tensor, points: Tensor, stencil: AnyStencil, shape: Sequence[int]) -> None:
    if points.ndim != 3 or points.shape[-1] != 3 or not points.is_floating_point():
        raise ValueError(f"points must be floating point of shape (N, M, 3); got {points.dtype} {tuple(points.shape)}")
    if points.shape[0] != batch.shape[0]:
        raise ValueError(f"batch sizes differ: {batch.shape[0]} of the first argument, {points.shape[0]} of points")
    for axis, support, n in zip("xyz", stencil.supports, tuple(shape)[::-1], strict=True):
        if n < support:
            raise ValueError(f"axis {axis} has {n} coefficients; the stencil needs {support}")


def _check_implementation(name: str, values: Tensor, points: Tensor, stencil: AnyStencil, *sizes) -> None:
    if name not in IMPLEMENTATIONS:
        raise ValueError(f"implementation must be one of {', '.join(IMPLEMENTATIONS)}; got {name!r}")
    if why := sums.missing(name, values, points, stencil, *sizes):
        raise ValueError(f"implementation {name!r} can't run here: {why}; implementation='reference' can")


def gather(
    coefficients: Tensor, points: Tensor, stencil: AnyStencil, start: int = 0, implementation: str = "reference"
) -> Tensor:
    """The rows of a stencil at the points: row = Σ_i weight_i Σ_k c_k φ_x^(m_x)(x−k_x) φ_y^(m_y) φ_z^(m_z).

    Args:
        coefficients: (N, C, D, H, W), any real dtype, each axis at least as long as the stencil's support.
        points: (N, M, 3), x, y, z. Points beyond the coefficients are extrapolated from the outermost polynomial piece;
            nothing is read out of bounds.
        stencil: what is summed.
        start: the coordinate of coefficient 0, the same along every axis (negative for padded coefficients).
        implementation: a key of `IMPLEMENTATIONS`: "reference" (plain torch), "cpu" or "cuda" (fused; what they need
            is told by `cpu.missing` and `cuda.missing`). Derivatives are computed by the same one, those above order 3
            by the reference.

    Returns:
        (N, C, J, M) in the dtype of the points, J rows.

    Differentiable any number of times in coefficients and points; in the tables of `TensorKernel`s too.

    Raises:
        ValueError: wrong shapes; an unknown implementation, or one that can't run as asked (the message says why).
    """
    if torch.compiler.is_compiling():
        return operators.gather(coefficients, points, operators.stencil_text(stencil), start, implementation)
    if coefficients.ndim != 5:
        raise ValueError(f"coefficients must have shape (N, C, D, H, W); got {tuple(coefficients.shape)}")
    _check(coefficients, points, stencil, coefficients.shape[2:])
    _check_implementation(implementation, coefficients, points, stencil, None, start)
    return sums.gather(coefficients, points, stencil, start, implementation)


def scatter(
    cotangents: Tensor,
    points: Tensor,
    stencil: AnyStencil,
    shape: Sequence[int],
    start: int = 0,
    implementation: str = "reference",
) -> Tensor:
    """The adjoint of `gather`: ⟨gather(c), g⟩ = ⟨c, scatter(g)⟩.

    Args:
        cotangents: (N, C, J, M), as `gather` returns.
        points, stencil, start, implementation: as for `gather`.
        shape: (D, H, W) of the result.

    Returns:
        (N, C, D, H, W) in the dtype of the points. A point that is not finite adds nothing. Differentiable any number
        of times in cotangents and points.
    """
    if torch.compiler.is_compiling():
        return operators.scatter(cotangents, points, operators.stencil_text(stencil), shape, start, implementation)
    rows = len(stencil.rows)
    if cotangents.ndim != 4 or cotangents.shape[2:] != (rows, points.shape[1]):
        raise ValueError(f"cotangents must have shape (N, C, {rows}, M); got {tuple(cotangents.shape)}")
    _check(cotangents, points, stencil, shape)
    _check_implementation(implementation, cotangents, points, stencil, shape, start)
    return sums.scatter(cotangents, points, stencil, tuple(shape), start, implementation)


def place(points: Tensor, where: Placement, implementation: str = "reference") -> Placed:
    """World points `(..., 3)` to coordinates of coefficients: (located, sign).

    located = fold(matrix · (point − origin)) − shift, sign = d fold / d voxel along each axis: 1, −1 where a reflection
    turned the axis round, 0 where the extension is constant. Any finite coordinate folds exactly; ±inf gives NaN under
    the periodic boundaries and clamps under border and zeros; NaN stays NaN.

    Returns:
        both `(..., 3)` in the dtype of the points; sign None where it is 1 everywhere and no derivative is asked.
        Differentiable in the points, any number of times: d located_i / d point_j = sign_i · matrix_ij.
    """
    if torch.compiler.is_compiling():
        return operators.place(points, operators.placement_text(where), implementation)
    return placement.place(points, where, implementation)


def prefilter_axis(
    samples: Tensor,
    dim: int,
    prefilter: str | Prefilter,
    boundary: str | Boundary = Boundary.MIRROR,
    tail: int = 0,
    implementation: str = "reference",
) -> Tensor:
    """Coefficients along one axis; see `ops.differentiable.prefilter.prefilter_axis`."""
    if torch.compiler.is_compiling() and implementation != "reference":
        text = operators.filtering_text(prefilter, boundary, tail, (dim % samples.ndim - samples.ndim,))
        return operators.prefilter(samples, text, implementation)
    return filtering.prefilter_axis(samples, dim, prefilter, boundary, tail, implementation)


def prefilter_samples(
    samples: Tensor,
    prefilter: str | Prefilter,
    boundary: str | Boundary = Boundary.MIRROR,
    tail: int = 0,
    implementation: str = "reference",
) -> Tensor:
    """Coefficients of a whole volume: `prefilter_axis` along x, y and z.

    Args:
        samples: (..., D, H, W); the rest as for `prefilter_axis`.

    Returns:
        (..., D + 2·tail, H + 2·tail, W + 2·tail).
    """
    if torch.compiler.is_compiling() and implementation != "reference":
        return operators.prefilter(samples, operators.filtering_text(prefilter, boundary, tail), implementation)
    return filtering.prefilter_samples(samples, prefilter, boundary, tail, implementation)


def jet(
    coefficients: Tensor,
    points: Tensor,
    kernels: PiecewisePolynomial | Sequence[PiecewisePolynomial],
    order: int = 0,
    start: int = 0,
    implementation: str = "reference",
) -> Tensor:
    """All partial derivatives up to `order` of Σ_k c_k φ_x(x−k_x) φ_y(y−k_y) φ_z(z−k_z) at the points.

    `gather` of `Stencil.jet(kernels, order)`: one kernel, or one per axis x, y, z; order 0 value, 1 + gradient,
    2 + Hessian, …; rows as in `multi_indices(order)`.
    """
    return gather(coefficients, points, Stencil.jet(kernels, order), start, implementation)


def splat(
    cotangents: Tensor,
    points: Tensor,
    kernels: PiecewisePolynomial | Sequence[PiecewisePolynomial],
    order: int,
    shape: Sequence[int],
    start: int = 0,
    implementation: str = "reference",
) -> Tensor:
    """The adjoint of `jet`: `scatter` of `Stencil.jet(kernels, order)`."""
    return scatter(cotangents, points, Stencil.jet(kernels, order), shape, start, implementation)
