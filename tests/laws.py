"""Laws as assertions, and measurements of the facts that kernels and methods declare. No filterlab here either."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

Function1D = Callable[[np.ndarray], np.ndarray]


def assert_close(
    actual: Tensor | np.ndarray, expected: Tensor | np.ndarray, tolerance: float, scale: float = 1.0
) -> None:
    """|actual − expected| ≤ tolerance · scale everywhere, same shape, nothing NaN; else says where and how much."""
    a, e = (np.asarray(t.detach().cpu() if isinstance(t, Tensor) else t, dtype=np.float64) for t in (actual, expected))
    assert a.shape == e.shape, f"shape {a.shape}, expected {e.shape}"
    if a.size == 0:
        return
    error = np.abs(a - e)
    worst = np.unravel_index(np.argmax(np.where(np.isnan(error), np.inf, error)), error.shape)
    assert error[worst] <= tolerance * scale, (
        f"off by {error[worst]:.3e} = {error[worst] / scale:.3e} of the scale {scale:g} (allowed {tolerance:g}) at "
        f"{tuple(map(int, worst))}: got {a[worst]!r}, expected {e[worst]!r}"
    )


def fractions_of_a_cell(count: int = 33) -> np.ndarray:
    """Points of one cell, none of them at a knot."""
    return (np.arange(count) + 0.37) / count


def assert_partition_of_unity(kernel: Function1D, radius: float, tolerance: float = 1e-12) -> None:
    """Σ_k φ(x−k) = 1 for every x."""
    x = fractions_of_a_cell()
    k = np.arange(-int(np.ceil(radius)) - 1, int(np.ceil(radius)) + 3)
    assert_close(kernel(x[:, None] - k).sum(1), np.ones_like(x), tolerance)


def assert_symmetric(kernel: Function1D, radius: float, tolerance: float = 1e-13) -> None:
    """φ(−x) = φ(x), and φ = 0 from the radius on."""
    x = np.arange(1, 64) * (radius + 1) / 64 + 1e-3  # off the knots: there one side may be excluded
    assert_close(kernel(-x), kernel(x), tolerance)
    assert_close(kernel(radius + x), np.zeros_like(x), 0.0)


def strang_fix_order(kernel: Function1D, radius: float, highest: int = 7, tolerance: float = 1e-10) -> int:
    """The largest L with Σ_k (x−k)^j φ(x−k) constant in x for all j < L: what φ can reproduce is degree L − 1."""
    x = fractions_of_a_cell()
    t = x[:, None] - np.arange(-int(np.ceil(radius)) - 1, int(np.ceil(radius)) + 3)
    values = kernel(t)
    for j in range(highest + 1):
        if np.ptp((t**j * values).sum(1)) > tolerance:
            return j
    return highest + 1


def continuity_order(
    function: Callable[[np.ndarray, int], np.ndarray], knots: np.ndarray, highest: int, tolerance: float = 1e-6
) -> int:
    """The largest k whose derivatives 0 … k of `function(x, derivative)` do not jump at the knots; −1: it jumps.

    The derivatives are bounded, so a difference over 2e-9 that exceeds the tolerance is a jump.
    """
    for k in range(highest + 1):
        if np.max(np.abs(function(knots + 1e-9, k) - function(knots - 1e-9, k))) > tolerance:
            return k - 1
    return highest


def assert_adjoint(forward: Callable[[Tensor], Tensor], x: Tensor, tolerance: float = 1e-12) -> None:
    """⟨A x, y⟩ = ⟨x, Aᵀ y⟩ with Aᵀ from reverse mode, for a linear map A."""
    x = x.detach().requires_grad_()
    ax = forward(x)
    y = torch.linspace(-1, 1, ax.numel(), dtype=ax.dtype).cos().mul(torch.arange(ax.numel()).remainder(7) - 2.5)
    y = y.reshape(ax.shape)
    (transposed,) = torch.autograd.grad(ax, x, y)
    scale = float(ax.detach().norm() * y.norm()) + 1e-300
    left, right = float((ax.detach() * y).sum()), float((x.detach() * transposed).sum())
    assert abs(left - right) <= tolerance * scale, f"<Ax, y> = {left!r}, <x, A*y> = {right!r}"


def assert_linear(forward: Callable[[Tensor], Tensor], x: Tensor, y: Tensor, tolerance: float = 1e-12) -> None:
    """A(2x − 3y) = 2 A x − 3 A y."""
    expected = 2 * forward(x) - 3 * forward(y)
    assert_close(forward(2 * x - 3 * y), expected, tolerance, 1 + float(expected.abs().max()))


def assert_a_nan_stays_on_its_lines(along: Callable[[Tensor, int], Tensor], x: Tensor) -> None:
    """One NaN in x (D, H, W): NaN all along its lines through `along(x, axis)`, and the rest bit by bit what it was."""
    place = tuple(n // 2 for n in x.shape)
    spoilt = x.clone()
    spoilt[place] = torch.nan
    for axis in range(3):
        line = tuple(slice(None) if a == axis else i for a, i in enumerate(place))
        found, expected = along(spoilt, axis), along(x, axis)
        assert found[line].isnan().all()
        found[line] = expected[line]
        assert torch.equal(found, expected)


def mixed(*parts: Tensor) -> Tensor:
    """One number that depends on every entry with a weight of its own, between 1 and 3."""
    entries = torch.cat([part.reshape(-1) for part in parts])
    return (entries * (2 + torch.cos(torch.arange(len(entries), dtype=entries.dtype)))).sum()


def finite_difference(function: Callable[[Tensor], Tensor], points: Tensor, step: float = 1e-3) -> Tensor:
    """d function / d point by the fourth-order difference (8 (f₁ − f₋₁) − (f₂ − f₋₂)) / 12h: `(..., 3)`."""
    columns = []
    for d in range(points.shape[-1]):
        e = torch.zeros_like(points)
        e[..., d] = step
        near, far = function(points + e) - function(points - e), function(points + 2 * e) - function(points - 2 * e)
        columns.append((8 * near - far) / (12 * step))
    return torch.stack(columns, -1)


def moved_by_rounding(
    function: Callable[..., Sequence[Tensor]], inputs: Sequence[Tensor], unit: float = 2.0**-24, draws: int = 3
) -> list[tuple[Tensor, float]]:
    """Results in float64, and how far each moves, at most, when every number that goes in is off by a rounding.

    Backward analysis: what computes with float32 gives the exact result of numbers that are a few roundings off, and is
    as far from it as those move it, and by the rounding of the result. `unit` is half of the distance of numbers at 1.
    """
    exact = [part.detach() for part in function(*inputs)]
    generator = torch.Generator().manual_seed(0)
    moved = [0.0 for _ in exact]
    for _ in range(draws):
        off = [x * (1 + unit * (2 * torch.rand(x.shape, generator=generator, dtype=x.dtype) - 1)) for x in inputs]
        for i, part in enumerate(function(*off)):
            moved[i] = max(moved[i], float((part.detach() - exact[i]).abs().max()))
    return [(part, far + unit * float(part.abs().max())) for part, far in zip(exact, moved, strict=True)]


def fitted_order(spacings: np.ndarray, errors: np.ndarray) -> float:
    """The slope of log error against log spacing."""
    return float(np.polyfit(np.log(spacings), np.log(errors), 1)[0])
