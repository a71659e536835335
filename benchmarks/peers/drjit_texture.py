"""Dr.Jit's Texture3f.eval_cubic_grad (LLVM backend): tricubic value and gradient in one compiled kernel."""

# pyright: reportMissingImports=false

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from torch import Tensor

from benchmarks.harness import Contestant
from benchmarks.peers.task import Sampling, without

NAME = "Dr.Jit eval_cubic_grad"


@cache
def missing() -> str | None:
    """Without the package, or without libLLVM, which the package does not bring."""
    if why := without("drjit"):
        return why
    import drjit

    if not drjit.has_backend(drjit.JitBackend.LLVM):
        return "its LLVM backend finds no libLLVM: install one (Debian: libllvm15) or set DRJIT_LIBLLVM_PATH"
    return None


def llvm_version() -> str:
    """Of the libLLVM that Dr.Jit found."""
    import drjit

    drjit.eval(drjit.arange(drjit.llvm.Float, 1))  # it is loaded at the first use
    return ".".join(map(str, drjit.detail.llvm_version()))


def offers(kernel: str, gradient: bool) -> bool:
    return kernel == "bspline3" and gradient


def sampling(task: Sampling) -> Contestant:
    drjit = started(task.threads)
    texture = texture_of(task.coefficients)
    n = task.coefficients.shape[-1]
    where = positions((task.points + 0.5) / n)

    def call() -> tuple[Any, ...]:
        (value,), (gradient,) = texture.eval_cubic_grad(where)
        result = value, gradient / n
        drjit.eval(*result)
        drjit.sync_thread()
        return result

    return Contestant(NAME, call, task.computes, arrays, len(task.points))


def started(threads: int) -> Any:
    """Dr.Jit with that many threads: the calling one works too."""
    import drjit

    drjit.set_thread_count(threads - 1)
    return drjit


def texture_of(coefficients: Tensor) -> Any:
    """A cubic-ready texture of (n, n, n) coefficients; beyond its ends it goes on as the boundary `reflect` does."""
    import drjit
    from drjit.llvm import TensorXf, Texture3f

    texels = TensorXf(np.ascontiguousarray(coefficients.numpy()[..., None]))
    return Texture3f(texels, wrap_mode=drjit.WrapMode.Mirror)


def positions(points: Tensor) -> Any:
    """(M, 3) as three evaluated arrays."""
    import drjit
    from drjit.llvm import Array3f, Float

    out = Array3f(*(Float(np.ascontiguousarray(x)) for x in points.float().numpy().T))
    drjit.eval(out)
    return out


def arrays(result: tuple[Any, ...]) -> list[np.ndarray]:
    """Dr.Jit's arrays as numpy's."""
    return [np.array(part) for part in result]
