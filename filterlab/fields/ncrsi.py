"""The nonseparable Catmull-Rom spline interpolation (NCRSI; Csébfalvi 2019, described in the paper's introduction).

With T the trilinear interpolant at the point, T± at the point ± one voxel along axis d and α_d the fractional part,

    f = T − Σ_d ½ α_d (1 − α_d) (T₊ − 2T + T₋).

Along a grid line this is the 1-D Catmull-Rom spline CR, and since CR(x) = L(x) + (the correction along that axis), with
L the linear kernel, f is a sum of four separable terms:

    f = CR⊗L⊗L + L⊗CR⊗L + L⊗L⊗CR − 2 L⊗L⊗L.

It reproduces quadratic polynomials and is C⁰. Its published gradient is the central difference (T₊ − T₋)/2 of the same
seven samples, which is not the gradient of f; both are offered.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from filterlab.fields.grid import Coefficients, Term
from filterlab.fields.tensor_product import (
    Sampled,
    along,
    unit_steps,
    with_central_differences,
    with_exact_positions,
)
from filterlab.kernels import CATMULL_ROM, LINEAR

NCRSI_TERMS: tuple[Term, ...] = (
    *(along(axis, CATMULL_ROM) for axis in range(3)),
    Term(-2.0, (LINEAR, LINEAR, LINEAR)),
)


@dataclass(frozen=True)
class SevenSamples(Sampled):
    """NCRSI from seven trilinear samples, and central differences from the same seven."""

    terms: tuple[Term, ...] = NCRSI_TERMS
    gradient: str = "central"

    @with_exact_positions
    def jet(self, coefficients: Coefficients, points: Tensor, order: int) -> Tensor:
        center, ahead, behind = unit_steps(self.sample, coefficients, points)
        alpha = points - points.floor()
        weights = (0.5 * alpha * (1 - alpha)).unbind(-1)
        value = center
        for w, a, b in zip(weights, ahead, behind, strict=True):
            value = value - w[:, None] * (a - 2 * center + b)
        if order == 0:
            return value[:, :, None]
        return with_central_differences(value, ahead, behind)
