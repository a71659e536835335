"""contract as a differentiable operation: linear in the samples, its adjoint is that of the transposed matrices."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from filterlab.ops.contract import Contraction
from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.differentiable.prefilter import missing
from filterlab.ops.differentiable.recording import plain
from filterlab.ops.reference import contract as reference

IMPLEMENTATIONS: dict[str, Callable[[Tensor, Contraction, torch.dtype], Tensor]] = {
    "reference": reference.contract,
    "cpu": lambda *given: driver("cpu", "contract").contract(*given),
}


def fused(samples: Tensor, contraction: Contraction) -> bool:
    """Whether the fused implementation can run for these samples."""
    return contraction.exact and not torch.compiler.is_compiling() and missing(samples, "cpu") is None


class _Contract(torch.autograd.Function):
    """(samples, contraction, dtype, implementation) -> the result, fused."""

    @staticmethod
    def forward(samples: Tensor, contraction: Contraction, dtype: torch.dtype, implementation: str) -> Tensor:
        return IMPLEMENTATIONS[implementation](samples, contraction, dtype)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        samples, *ctx.rest = inputs
        ctx.dtype = samples.dtype

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        contraction, _, implementation = ctx.rest
        adjoint = contract(gradients[0], contraction.transposed, gradients[0].dtype, implementation)
        return adjoint.to(ctx.dtype), None, None, None

    @staticmethod
    def jvp(ctx, *tangents):
        return contract(tangents[0], *ctx.rest)

    @staticmethod
    def vmap(info, in_dims, samples: Tensor, *rest):
        return contract(samples.movedim(in_dims[0], 0), *rest), 0


def contract(
    samples: Tensor, contraction: Contraction, dtype: torch.dtype, implementation: str | None = None
) -> Tensor:
    """Sums of products of matrices along x, y and z, see `ops.contract`.

    Args:
        samples: (..., D, H, W), any real dtype. Never written to.
        contraction: the matrices.
        dtype: float32 or float64: of the result and of all that is computed.
        implementation: "reference" (plain torch) or "cpu" (fused); None: the fastest one.

    Returns:
        (..., D', H', W'). Differentiable any number of times in the samples; in weights too, by the reference.
    """
    implementation = implementation or ("cpu" if fused(samples, contraction) else "reference")
    if plain(samples) or not contraction.exact:
        return IMPLEMENTATIONS[implementation](samples, contraction, dtype)
    return _Contract.apply(samples, contraction, dtype, implementation)  # type: ignore[return-value]
