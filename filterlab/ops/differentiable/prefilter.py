"""From samples to coefficients: the prefilter as an operation that can be differentiated.

`prefilter_axis` filters along one axis, `prefilter_samples` along x, y and z. Three implementations: "reference" is
plain torch, one recursion after the other; "cpu" is fused vector code (`ops.cpu.recursion`), "cuda" a Triton program
(`ops.cuda.recursion`). They agree to rounding.

With E the extension of a line by its boundary's rule, F = Π gain Lᵀ L the recursions (L the causal one as a matrix) and
C, which drops the warm-up at both ends, coefficients are c = C F E f. F is its own adjoint, so that of the whole is

    Eᵀ F Cᵀ        pad with zeros, filter, add what stands beyond the ends to the samples that it was copied from:

F again, under the boundary `zeros`, for which E and C only pad and crop. So derivatives of any order need nothing new.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from filterlab.ops import cpu, cuda
from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.differentiable.recording import plain
from filterlab.ops.gather import STORAGE
from filterlab.ops.prefilter import VOLUME, Filtering
from filterlab.ops.reference import prefilter as reference
from filterlab.prefilters import Prefilter, named
from filterlab.volume import Boundary


def _cpu_problem(samples: Tensor) -> str | None:
    if problem := cpu.llvmlite_problem():
        return problem
    return None if samples.device.type == "cpu" else f"it works on tensors of the CPU; got {samples.device}"


_PLACES: dict[str, Callable[[Tensor], str | None]] = {"cpu": _cpu_problem, "cuda": cuda.device_problem}
"""The fused ones, and what keeps each from running where a tensor is."""

IMPLEMENTATIONS = ("reference", *_PLACES)

FUSED = {"cpu": "cpu", "cuda": "cuda"}
"""Which of them is for a device, by its type."""


def missing(samples: Tensor, implementation: str) -> str | None:
    """What keeps a fused implementation, "cpu" or "cuda", from filtering these samples; None: nothing does."""
    if problem := _PLACES[implementation](samples):
        return problem
    if samples.layout != torch.strided:
        return f"it works on dense tensors; got {samples.layout}"
    if type(samples) not in (Tensor, torch.nn.Parameter):
        return f"it reads memory, which a {type(samples).__name__} may not have"
    if samples.dtype not in STORAGE:
        return f"samples must be stored as {', '.join(STORAGE.values())}; got {samples.dtype}"
    return None


def implementation_for(samples: Tensor) -> str:
    """The fastest implementation for these samples: the fused one of their device where it can run, or "reference"."""
    fused = FUSED.get(samples.device.type)
    if fused is None or missing(samples, fused):
        return "reference"
    return fused


def prefilter_axis(
    samples: Tensor,
    dim: int,
    prefilter: str | Prefilter,
    boundary: str | Boundary = Boundary.MIRROR,
    tail: int = 0,
    implementation: str = "reference",
) -> Tensor:
    """Coefficients along one axis.

    Args:
        samples: any shape, real. Integers, float16 and bfloat16 are filtered in float32. Never written to.
        dim: the axis to filter.
        prefilter: a name from `PREFILTERS` or a `Prefilter`.
        boundary: how the samples go on beyond the ends.
        tail: coefficients to return beyond each end (border and zeros need them; see the head of `prefilters`).
        implementation: "reference" (plain torch), "cpu" or "cuda" (fused; `missing` says what they need).

    Returns:
        the coefficients, `samples.shape` with n + 2·tail along `dim`. Linear in the samples; differentiable any number
        of times.

    Raises:
        ValueError: no such axis, or no samples along it; a negative tail; an unknown name; an implementation that can't
            run here (the message says why).
    """
    if not -samples.ndim <= dim < samples.ndim:
        raise ValueError(f"dim must be an axis of the samples, {-samples.ndim} … {samples.ndim - 1}; got {dim}")
    how = Filtering((dim % samples.ndim - samples.ndim,), named(prefilter), Boundary.named(boundary), tail)
    return _prefiltered(samples, how, implementation)


def prefilter_samples(
    samples: Tensor,
    prefilter: str | Prefilter,
    boundary: str | Boundary = Boundary.MIRROR,
    tail: int = 0,
    implementation: str = "reference",
) -> Tensor:
    """Coefficients of a whole volume: `prefilter_axis` along x, y and z.

    Args:
        samples: (..., D, H, W), real.
        prefilter, boundary, tail, implementation: as for `prefilter_axis`; the tail is kept along all three axes.

    Returns:
        (..., D + 2·tail, H + 2·tail, W + 2·tail), float64 for float64 samples, else float32. Under border and zeros
        and with tail 0 these are the coefficients inside the volume only.

    Raises:
        ValueError: as `prefilter_axis`; fewer than three axes.
    """
    if samples.ndim < 3:
        raise ValueError(f"samples must have shape (..., D, H, W); got {tuple(samples.shape)}")
    how = Filtering(VOLUME, named(prefilter), Boundary.named(boundary), tail)
    return _prefiltered(samples, how, implementation)


def _prefiltered(samples: Tensor, how: Filtering, implementation: str) -> Tensor:
    if any(samples.shape[dim] == 0 for dim in how.dims):
        raise ValueError(f"an axis that is filtered needs at least one sample; got shape {tuple(samples.shape)}")
    if how.tail < 0:
        raise ValueError(f"tail must be ≥ 0; got {how.tail}")
    if implementation not in IMPLEMENTATIONS:
        raise ValueError(f"implementation must be one of {', '.join(IMPLEMENTATIONS)}; got {implementation!r}")
    if implementation == "reference":
        return reference.filter_axes(samples, how)
    if why := missing(samples, implementation):
        raise ValueError(f"implementation {implementation!r} can't run here: {why}; implementation='reference' can")
    return reference.filter_axes(samples, how) if how.prefilter.is_identity else _fused(samples, how, implementation)


def evaluate(samples: Tensor, how: Filtering, implementation: str) -> Tensor:
    """Coefficients, without derivatives."""
    return _prefiltered(samples.detach(), how, implementation)


def adjoint(cotangents: Tensor, shape: torch.Size, how: Filtering, implementation: str) -> Tensor:
    """Its adjoint, without derivatives."""
    return _adjoint(cotangents.detach(), shape, how, implementation)


class _Prefilter(torch.autograd.Function):
    """(samples, how, implementation) -> coefficients, fused."""

    @staticmethod
    def forward(samples: Tensor, how: Filtering, implementation: str) -> Tensor:
        return _compute(samples, how, implementation)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        samples, ctx.how, ctx.implementation = inputs
        ctx.shape = samples.shape

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        return _adjoint(gradients[0], ctx.shape, ctx.how, ctx.implementation), None, None

    @staticmethod
    def jvp(ctx, *tangents):
        return _fused(tangents[0], ctx.how, ctx.implementation)

    @staticmethod
    def vmap(info, in_dims, samples: Tensor, how: Filtering, implementation: str):
        return _fused(samples.movedim(in_dims[0], 0), how, implementation), 0


def _fused(samples: Tensor, how: Filtering, implementation: str) -> Tensor:
    if plain(samples):
        return _compute(samples, how, implementation)
    return _Prefilter.apply(samples, how, implementation)  # type: ignore[return-value]


def _compute(samples: Tensor, how: Filtering, implementation: str) -> Tensor:
    return driver(implementation, "prefilter").filter_axes(samples, how)


def _adjoint(cotangents: Tensor, shape: torch.Size, how: Filtering, implementation: str) -> Tensor:
    """Back to the shape of the samples.

    A periodic boundary goes on in the coefficients as it does in the samples: what was given beyond the ends is folded
    back, and as the filter is symmetric, so is its inverse. Under mirror it is with respect to a product in which the
    two samples on the mirrors count half, for they have no image.

    Memory: under border the cotangents with `prefilter.decay` voxels more on every side.
    """
    dims, boundary, tail = how.dims, how.boundary, how.tail
    if boundary is Boundary.ZEROS:
        return _fused(cotangents, replace(how, tail=-tail), implementation)
    if boundary.periodic:
        mirrored = boundary is Boundary.MIRROR
        out = cotangents.clone() if tail or mirrored else cotangents  # to be written to
        for dim in dims if tail else ():
            out = _fold(out, dim, boundary, shape[dim], tail)
        folded = replace(how, tail=0)
        if not mirrored:
            return _fused(out, folded, implementation)
        return _at_mirrors(_own(_fused(_at_mirrors(out, dims, 2.0), folded, implementation)), dims, 0.5)
    beyond = how.prefilter.decay(cotangents.dtype)
    out = _own(_fused(cotangents, replace(how, boundary=Boundary.ZEROS, tail=beyond), implementation))
    for dim in dims:
        out = _fold(out, dim, boundary, shape[dim], tail + beyond)
    return out


def _own(x: Tensor) -> Tensor:
    """What `_fused` gave, to be written to: torch forbids that where it records derivatives."""
    return x if plain(x) else x.clone()


def _at_mirrors(x: Tensor, dims: tuple[int, ...], factor: float) -> Tensor:
    """Multiply x by a factor at the first and the last place of every axis that has more than one."""
    for dim in dims:
        if (n := x.shape[dim]) > 1:
            for end in (0, n - 1):
                x.narrow(dim, end, 1).mul_(factor)
    return x


def _fold(x: Tensor, dim: int, boundary: Boundary, n: int, beyond: int) -> Tensor:
    """The adjoint of `boundary.extend(·, dim, beyond, beyond)` of n samples: x, added to, but for what is beyond."""
    outside = torch.cat((torch.arange(-beyond, 0, device=x.device), torch.arange(n, n + beyond, device=x.device)))
    ends = torch.cat((x.narrow(dim, 0, beyond), x.narrow(dim, beyond + n, beyond)), dim)
    return x.narrow(dim, beyond, n).index_add_(dim, boundary.source(outside, n), ends)
