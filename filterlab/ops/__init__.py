"""The numerical core: `jet` and its adjoint `splat`. Every evaluation in filterlab goes through these two.

`jet` and `splat` here choose the implementation: `reference` is plain torch, `cpu` fused vector code; `autograd` makes
the pair differentiable, whichever computes it.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from filterlab.kernels import Kernel, PiecewisePolynomial
from filterlab.ops import autograd, cpu, reference
from filterlab.ops.autograd import IMPLEMENTATIONS
from filterlab.ops.reference import multi_indices

__all__ = ["IMPLEMENTATIONS", "jet", "multi_indices", "splat"]


def _per_axis(kernels: PiecewisePolynomial | Sequence[PiecewisePolynomial]) -> tuple[PiecewisePolynomial, ...]:
    return (kernels,) * 3 if isinstance(kernels, PiecewisePolynomial) else tuple(kernels)


def _check(
    batch: Tensor, points: Tensor, kernels: Sequence[PiecewisePolynomial], order: int, shape: Sequence[int]
) -> None:
    if points.ndim != 3 or points.shape[-1] != 3 or not points.is_floating_point():
        raise ValueError(f"points must be floating point of shape (N, M, 3); got {points.dtype} {tuple(points.shape)}")
    if points.shape[0] != batch.shape[0]:
        raise ValueError(f"batch sizes differ: {batch.shape[0]} of the first argument, {points.shape[0]} of points")
    if order < 0:
        raise ValueError(f"order must be ≥ 0; got {order}")
    for axis, kernel, n in zip("xyz", kernels, tuple(shape)[::-1], strict=True):
        if n < kernel.support:
            raise ValueError(f"axis {axis} has {n} coefficients; the kernel {kernel.name} needs {kernel.support}")


def _check_implementation(
    name: str, values: Tensor, points: Tensor, kernels: Sequence[PiecewisePolynomial], order: int, *sizes
) -> None:
    if name not in IMPLEMENTATIONS:
        raise ValueError(f"implementation must be one of {', '.join(IMPLEMENTATIONS)}; got {name!r}")
    if name == "cpu" and (why := cpu.missing(values, points, kernels, order, *sizes)):
        raise ValueError(f"implementation 'cpu' can't run here: {why}; implementation='reference' can")


def jet(
    coefficients: Tensor,
    points: Tensor,
    kernels: PiecewisePolynomial | Sequence[PiecewisePolynomial],
    order: int = 0,
    start: int = 0,
    implementation: str = "reference",
) -> Tensor:
    """All partial derivatives up to `order` of Σ_k c_k φ_x(x−k_x) φ_y(y−k_y) φ_z(z−k_z) at the points.

    Args:
        coefficients: (N, C, D, H, W), any real dtype, each axis at least as long as its kernel's support.
        points: (N, M, 3), x, y, z. Points beyond the coefficients are extrapolated from the outermost polynomial piece;
            nothing is read out of bounds.
        kernels: one kernel, or one per axis x, y, z.
        order: 0 value, 1 + gradient, 2 + Hessian, …; rows as in `multi_indices(order)`.
        start: the coordinate of coefficient 0, the same along every axis (negative for padded coefficients).
        implementation: a key of `IMPLEMENTATIONS`: "reference" (plain torch) or "cpu" (fused; see `cpu.missing` for
            what it needs). Derivatives are computed by the same one, those above order 3 by the reference.

    Returns:
        (N, C, J, M) in the dtype of the points.

    Differentiable any number of times in coefficients and points; in the tables of `TensorKernel`s too.

    Raises:
        ValueError: wrong shapes; an unknown implementation, or one that can't run as asked (the message says why).
    """
    kernels = _per_axis(kernels)
    if coefficients.ndim != 5:
        raise ValueError(f"coefficients must have shape (N, C, D, H, W); got {tuple(coefficients.shape)}")
    _check(coefficients, points, kernels, order, coefficients.shape[2:])
    _check_implementation(implementation, coefficients, points, kernels, order, None, start)
    if all(isinstance(k, Kernel) for k in kernels):
        return autograd.jet(coefficients, points, kernels, order, start, implementation)  # type: ignore[arg-type]
    return reference.jet(coefficients, points, kernels, order, start)


def splat(
    cotangents: Tensor,
    points: Tensor,
    kernels: PiecewisePolynomial | Sequence[PiecewisePolynomial],
    order: int,
    shape: Sequence[int],
    start: int = 0,
    implementation: str = "reference",
) -> Tensor:
    """The adjoint of `jet`: ⟨jet(c), g⟩ = ⟨c, splat(g)⟩.

    Args:
        cotangents: (N, C, J, M), as `jet` returns.
        points, kernels, order, start, implementation: as for `jet`.
        shape: (D, H, W) of the result.

    Returns:
        (N, C, D, H, W) in the dtype of the points. Differentiable any number of times in cotangents and points.
    """
    kernels = _per_axis(kernels)
    rows = len(multi_indices(order))
    if cotangents.ndim != 4 or cotangents.shape[2:] != (rows, points.shape[1]):
        raise ValueError(f"cotangents must have shape (N, C, {rows}, M); got {tuple(cotangents.shape)}")
    _check(cotangents, points, kernels, order, shape)
    _check_implementation(implementation, cotangents, points, kernels, order, shape, start)
    if all(isinstance(k, Kernel) for k in kernels):
        return autograd.splat(
            cotangents,
            points,
            kernels,  # type: ignore[arg-type]
            order,
            tuple(shape),
            start,
            implementation,
        )
    return reference.splat(cotangents, points, kernels, order, shape, start)
