"""jet and splat as vector code for this processor, compiled at their first use.

    kernels ──▶ recipe ──generator──▶ LLVM IR ──compiler──▶ machine code ──▶ cache (disk)
                                                                 │
    tensors ──▶ job ─────────────────────────────threads─────────┴──▶ result

`generator` writes the program (read it first, its head explains how it computes), `lanes` the single instructions;
`job` is what a program is told about the arrays; `compiler` and `cache` make and keep machine code; `threads` runs it.

Same meaning as `ops.reference`, orders 0 … 3. Coefficients are read as they are stored, sums are in the points' dtype.
The result of jet does not depend on the number of threads, bit by bit; that of splat only on their number.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from filterlab.kernels import Kernel, PiecewisePolynomial
from filterlab.ops.reference import multi_indices

if TYPE_CHECKING:
    from filterlab.ops.cpu.job import Job

MAX_ORDER = 3
MAX_SUPPORT = 6
SPLAT_MEMORY = 1 << 30  # bytes that splat may take for partial results beyond the result itself

_ARITHMETIC = {torch.float32: "float32", torch.float64: "float64"}
_STORAGE = {
    torch.float32: "float32",
    torch.float64: "float64",
    torch.float16: "float16",
    torch.bfloat16: "bfloat16",
    torch.uint8: "uint8",
    torch.int8: "int8",
    torch.int16: "int16",
    torch.int32: "int32",
}
_COORDINATES = {torch.float32: 1 << 24, torch.float64: 1 << 28}  # exact in the dtype; 8 times it fits 32 bits
_POINTS_PER_THREAD = 4096  # fewer are not worth waking a thread for
_CHUNKS_PER_THREAD = 16  # so that a thread that is held up leaves its share to the others


def missing(
    coefficients: Tensor,
    points: Tensor,
    kernels: Sequence[PiecewisePolynomial],
    order: int,
    shape: Sequence[int] | None = None,
    start: int = 0,
) -> str | None:
    """What keeps jet (or, with `shape`, splat of cotangents) from running here as asked; None: nothing does.

    Args:
        coefficients: (N, C, D, H, W), or the cotangents (N, C, J, M) of splat.
        points: (N, M, 3).
        kernels: one per axis x, y, z.
        order: of the highest derivative.
        shape: (D, H, W) of the result of splat.
        start: the coordinate of coefficient 0.
    """
    if problem := _llvmlite_problem():
        return problem
    if coefficients.device.type != "cpu" or points.device.type != "cpu":
        return f"it works on tensors of the CPU; got {coefficients.device} and {points.device}"
    if points.dtype not in _ARITHMETIC:
        return f"points must be float32 or float64; got {points.dtype}"
    if shape is None and coefficients.dtype not in _STORAGE:
        return f"coefficients must be stored as {', '.join(_STORAGE.values())}; got {coefficients.dtype}"
    if not all(isinstance(k, Kernel) for k in kernels):
        return f"its kernels are fixed tables; got {', '.join(type(k).__name__ for k in kernels)}"
    if max(k.support for k in kernels) > MAX_SUPPORT:
        return f"supports go up to {MAX_SUPPORT}; got {', '.join(str(k.support) for k in kernels)}"
    if order > MAX_ORDER:
        return f"orders go up to {MAX_ORDER}; got {order}"
    sizes, limit = tuple(coefficients.shape[2:] if shape is None else shape), _COORDINATES[points.dtype]
    if abs(start) + max(sizes) >= limit or sizes[0] * sizes[1] >= 1 << 31:
        return f"indices along an axis must stay below {limit} and rows below {1 << 31}; got {sizes} from {start}"
    return None


@lru_cache
def _llvmlite_problem() -> str | None:
    try:
        import llvmlite.binding  # noqa: F401
    except (ImportError, OSError) as error:
        return f"the package llvmlite can't be loaded ({error}); pip install llvmlite"
    return None


def jet(coefficients: Tensor, points: Tensor, kernels: Sequence[Kernel], order: int, start: int = 0) -> Tensor:
    """`ops.reference.jet`, fused. Nothing is copied but what is not contiguous within a channel or a batch entry."""
    n, c = coefficients.shape[:2]
    rows = len(multi_indices(order))
    out = _fresh((n, c, rows, points.shape[1]), points.dtype, np.empty)
    if out.numel() == 0:
        return out
    coefficients, points = _readable(coefficients, 2), _readable(points, 1)
    _run("jet", [coefficients] * _useful_threads(points), points, out, kernels, order, start)
    return out


def splat(
    cotangents: Tensor, points: Tensor, kernels: Sequence[Kernel], order: int, shape: Sequence[int], start: int = 0
) -> Tensor:
    """`ops.reference.splat`, fused.

    Each thread takes an equal share of the points and adds into a partial result of its own; these are summed at the
    end, in order. Partial results take at most `SPLAT_MEMORY` beyond the result itself: fewer threads work when the
    volume is large, and when there are so few points that adding up would take longer than what is gained.
    """
    n, c = cotangents.shape[:2]
    volume = n * c * shape[0] * shape[1] * shape[2]
    threads = _useful_threads(points)
    parts = min(threads, 1 + SPLAT_MEMORY // (volume * points.element_size() or 1))
    parts = max(1, min(parts, 8 * n * c * points.shape[1] // (volume or 1)))
    out = _fresh((n, c, *shape), points.dtype, np.zeros)
    if not (cotangents.numel() and volume):
        return out
    more = [_fresh(out.shape, out.dtype, np.zeros) for _ in range(parts - 1)]
    cotangents, points = _readable(cotangents.to(points.dtype), 0), _readable(points, 1)
    _run("splat", [out, *more], points, cotangents, kernels, order, start)
    for part in more:
        out += part
    return out


def _fresh(shape: Sequence[int], dtype: torch.dtype, make: Callable[..., np.ndarray]) -> Tensor:
    """A new tensor in memory that numpy allocated: it asks the system for huge pages, torch does not.

    Measured on Linux: the first touch of 8 MB costs 0.4 ms instead of 7, as much as a third of a splat of 10⁶ points.
    """
    return torch.from_numpy(make(tuple(shape), _ARITHMETIC[dtype]))


def _run(
    operation: str,
    volumes: Sequence[Tensor],
    points: Tensor,
    rows: Tensor,
    kernels: Sequence[Kernel],
    order: int,
    start: int,
) -> None:
    """Compile, describe the arrays, and let the threads loose, one for each of `volumes`.

    Args:
        operation: "jet" or "splat".
        volumes: for jet the coefficients, as often as there are threads: all of them share the work, chunk by chunk.
            For splat as many volumes of zeros: each is given an equal share of the points.
        points, kernels, order, start: as for `jet`.
        rows: (N, C, J, M), contiguous; written by jet, read by splat.
    """
    from filterlab.ops.cpu import compiler
    from filterlab.ops.cpu import threads as pool
    from filterlab.ops.cpu.generator import BLOCK, Recipe
    from filterlab.ops.cpu.job import AXES, Job

    coefficients, threads = volumes[0], len(volumes)
    assert all(t.data_ptr() for t in (*volumes, points, rows)), "tensors without memory"
    arithmetic, storage = _ARITHMETIC[points.dtype], _STORAGE[coefficients.dtype]
    lanes = _lanes(compiler.features(), points.element_size())
    tables = tuple(_table(k) for k in kernels)
    function = compiler.compiled(Recipe(operation, tables, order, arithmetic, storage, lanes))  # type: ignore[arg-type]

    entries, count = points.shape[:2]
    packs = -(-count // lanes)
    shared = operation == "jet"
    chunk = -(-packs // (threads * _CHUNKS_PER_THREAD if shared and threads > 1 else threads))
    chunk = -(-chunk // BLOCK) * BLOCK
    parts = -(-packs // chunk)  # of every batch entry
    d, h, w = coefficients.shape[2:]
    job = Job(
        coefficients=coefficients.data_ptr(),
        points=points.data_ptr(),
        rows=rows.data_ptr(),
        channels=coefficients.shape[1],
        count=count,
        width=w,
        height=h,
        start=start,
        coefficients_entry=coefficients.stride(0),
        coefficients_channel=coefficients.stride(1),
        points_entry=points.stride(0),
        chunk=chunk,
        entries=entries,
        next=0,
        chunks=parts * entries,
    )
    for axis, size, kernel in zip(AXES, (w, h, d), kernels, strict=True):
        setattr(job, f"low_{axis}", start)
        setattr(job, f"high_{axis}", start + size - kernel.support)
    pool.run(function, [job] * threads if shared else [_own_share(job, i, v) for i, v in enumerate(volumes[:parts])])


def _own_share(job: Job, part: int, volume: Tensor) -> Job:
    """The job of adding one part of every batch entry's points to a volume of its own."""
    from filterlab.ops.cpu.job import Job

    own = Job.from_buffer_copy(job)
    own.coefficients = volume.data_ptr()
    own.next, own.chunks = part * job.entries, (part + 1) * job.entries
    return own


@lru_cache(maxsize=256)
def _table(kernel: Kernel) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in kernel.taps(torch.float64).tolist())


def _lanes(features: frozenset[str], element_size: int) -> int:
    """P: 8 floats or 4 doubles; twice as many with AVX-512.

    Measured with AVX2 (Zen 3), where 8 floats fill a register: 16 lanes need two, the weights of a 3×3×3 kernel no
    longer fit and jets become 1.0 to 1.5 times, splats 1.3 to 1.9 times as slow.
    """
    return (64 if "avx512f" in features else 32) // element_size


def _useful_threads(points: Tensor) -> int:
    return max(1, min(torch.get_num_threads(), points.shape[0] * points.shape[1] // _POINTS_PER_THREAD))


def _readable(tensor: Tensor, outer: int) -> Tensor:
    """The tensor with everything after its first `outer` dimensions lying together; any strides before (0 too)."""
    tensor = tensor.detach().resolve_neg()
    together = tensor[(0,) * outer].is_contiguous()
    return tensor if together else tensor.contiguous()
