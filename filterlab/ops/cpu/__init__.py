"""gather and scatter as vector code for this processor, compiled at their first use.

    stencil ──▶ recipe ──generate──▶ LLVM IR ──compiler──▶ machine code ──▶ cache (disk)
                                                                │
    tensors ──▶ job ────────────────────────────threads─────────┴──▶ result

`taps` writes the sums (read it first, its head explains how they are computed), `lanes` the single instructions,
`points` the program around them; `job` is what a program is told about the arrays; `compiler` and `cache` make and keep
machine code; `threads` runs it.

Same meaning as `ops.reference`, orders 0 … 3. Coefficients are read as they are stored, sums are in the points' dtype.
The result of gather does not depend on the number of threads, bit by bit; that of scatter only on their number. Points
that lie all over a large volume are sorted first (`order`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from filterlab import forking
from filterlab.ops.fused import MAX_ORDER as MAX_ORDER
from filterlab.ops.fused import STORAGE, readable, unsupported
from filterlab.ops.stencil import Stencil
from filterlab.volume import Boundary

if TYPE_CHECKING:
    from filterlab.ops.cpu.order import Sorted
    from filterlab.ops.cpu.points import Job
    from filterlab.ops.placement import Placement

FEWEST_SORTED = 1 << 16  # points of a batch entry
SMALLEST_SORTED_IN = 16 << 20  # bytes of one channel
SPLAT_MEMORY = 1 << 30  # bytes that scatter may take for partial results beyond the result itself

_ARITHMETIC = {torch.float32: "float32", torch.float64: "float64"}
_COORDINATES = {torch.float32: 1 << 24, torch.float64: 1 << 28}  # exact in the dtype; 8 times it fits 32 bits
_POINTS_PER_THREAD = 4096  # fewer are not worth waking a thread for
_CHUNKS_PER_THREAD = 16  # so that a thread that is held up leaves its share to the others
_MOST_POINTS = 1 << 16  # of a chunk, times channels: between two of them Ctrl-C is heard


def missing(
    coefficients: Tensor,
    points: Tensor,
    stencil: Stencil,
    shape: Sequence[int] | None = None,
    start: int = 0,
) -> str | None:
    """What keeps gather (or, with `shape`, scatter of cotangents) from running here as asked; None: nothing does.

    Args:
        coefficients: (N, C, D, H, W), or the cotangents (N, C, J, M) of scatter.
        points: (N, M, 3).
        stencil: what is summed.
        shape: (D, H, W) of the result of scatter.
        start: the coordinate of coefficient 0.
    """
    if problem := _llvmlite_problem():
        return problem
    if coefficients.device.type != "cpu" or points.device.type != "cpu":
        return f"it works on tensors of the CPU; got {coefficients.device} and {points.device}"
    if problem := unsupported(coefficients, points, stencil, shape):
        return problem
    sizes, limit = tuple(coefficients.shape[2:] if shape is None else shape), _COORDINATES[points.dtype]
    if abs(start) + max(sizes) >= limit or sizes[0] * sizes[1] >= 1 << 31:
        return f"indices along an axis must stay below {limit} and rows below {1 << 31}; got {sizes} from {start}"
    return None


@lru_cache
def _llvmlite_problem() -> str | None:
    try:
        with forking.lock:  # what the first call needs, whole
            import filterlab.ops.cpu.compiler
            import filterlab.ops.cpu.folding
            import filterlab.ops.cpu.points
            import filterlab.ops.cpu.threads  # noqa: F401
    except (ImportError, OSError) as error:
        return f"the package llvmlite can't be loaded ({error}); pip install llvmlite"
    return None


def gather(coefficients: Tensor, points: Tensor, stencil: Stencil, start: int = 0) -> Tensor:
    """`ops.reference.gather`, fused. Nothing is copied but what is not contiguous within a channel or a batch entry."""
    n, c = coefficients.shape[:2]
    out = _fresh((n, c, len(stencil.rows), points.shape[1]), points.dtype, np.empty)
    if out.numel() == 0:
        return out
    coefficients, points = readable(coefficients, 2), readable(points, 1)
    if not _sorting_pays(points, coefficients.shape, coefficients.element_size()):
        _run("gather", [coefficients] * _useful_threads(points), points, out, stencil, start)
        return out
    for entry, part, ordered in _in_order(points, coefficients.shape, start):
        rows = _fresh((1, c, len(stencil.rows), ordered.count), points.dtype, np.empty)
        threads = _useful_threads(ordered.points[None])
        _run("gather", [coefficients[entry : entry + 1]] * threads, ordered.points[None], rows, stencil, start)
        for channel in range(c):
            ordered.restore(rows[0, channel], out[entry, channel, :, part])
    return out


def scatter(cotangents: Tensor, points: Tensor, stencil: Stencil, shape: Sequence[int], start: int = 0) -> Tensor:
    """`ops.reference.scatter`, fused.

    Each thread takes an equal share of the points and adds into a partial result of its own; these are summed at the
    end, in order. Partial results take at most `SPLAT_MEMORY` beyond the result itself: fewer threads work when the
    volume is large, and when there are so few points that adding up would take longer than what is gained.
    """
    n, c = cotangents.shape[:2]
    volume = n * c * shape[0] * shape[1] * shape[2]
    threads = _useful_threads(points)
    parts = min(threads, 1 + SPLAT_MEMORY // (volume * points.element_size() or 1))
    parts = max(1, min(parts, 8 * n * c * points.shape[1] // (volume or 1)))
    out = _zeros((n, c, *shape), points.dtype)
    if not (cotangents.numel() and volume):
        return out
    more = [_zeros(out.shape, out.dtype) for _ in range(parts - 1)]
    cotangents, points = readable(cotangents.to(points.dtype), 0), readable(points, 1)
    if not _sorting_pays(points, out.shape, points.element_size()):
        _run("scatter", [out, *more], points, cotangents, stencil, start)
    else:
        for entry, part, ordered in _in_order(points, out.shape, start):
            rows = _fresh((1, *cotangents.shape[1:3], ordered.count), points.dtype, np.empty)
            for channel in range(c):
                ordered.arrange(cotangents[entry, channel, :, part], rows[0, channel])
            own = [volume[entry : entry + 1] for volume in (out, *more)]
            _run("scatter", own, ordered.points[None], rows, stencil, start)
    for part in more:
        out += part
    return out.contiguous()


def pull(coefficients: Tensor, points: Tensor, cotangents: Tensor, stencil: Stencil, start: int = 0) -> Tensor:
    """The adjoint of gather to its points, (N, M, 3): Σ over channels and rows of cotangent · gradient of the row."""
    out = _fresh(points.shape, points.dtype, np.zeros)
    if cotangents.numel() == 0 or out.numel() == 0:
        return out
    coefficients, points = readable(coefficients, 2), readable(points, 1)
    cotangents = readable(cotangents.to(points.dtype), 0)
    threads = [coefficients] * _useful_threads(points)
    derivatives, raised = stencil.derivatives
    if not _sorting_pays(points, coefficients.shape, coefficients.element_size()):
        _run("pull", threads, points, cotangents, derivatives, start, raised, out)
        return out
    for entry, part, ordered in _in_order(points, coefficients.shape, start):
        rows = _fresh((1, *cotangents.shape[1:3], ordered.count), points.dtype, np.empty)
        for channel in range(rows.shape[1]):
            ordered.arrange(cotangents[entry, channel, :, part], rows[0, channel])
        own = _fresh((1, ordered.count, 3), points.dtype, np.empty)
        one = [volume[entry : entry + 1] for volume in threads]
        _run("pull", one, ordered.points[None], rows, derivatives, start, raised, own)
        back = _fresh((3, ordered.count), points.dtype, np.empty)
        ordered.restore(own[0].T.contiguous(), back)
        out[entry, part] = back.T
    return out


def _sorting_pays(points: Tensor, shape: Sequence[int], bytes_each: int) -> bool:
    """Whether sorting points (N, M, 3) costs less than it saves (`order`); nothing is imported where it can't."""
    if points.shape[1] < FEWEST_SORTED or math.prod(shape[2:]) * bytes_each < SMALLEST_SORTED_IN:
        return False
    with forking.lock:
        from filterlab.ops.cpu import order

    return order.scattered(points)


def _in_order(points: Tensor, shape: Sequence[int], start: int) -> Iterator[tuple[int, slice, Sorted]]:
    """(batch entry, which of its points, those points sorted), part by part, so that copies stay bounded."""
    from filterlab.ops.cpu import compiler, order

    lanes = _lanes(compiler.features(), points.element_size())
    count = points.shape[1]
    parts = -(-count // order.POINTS_AT_ONCE)
    for entry, own in enumerate(points):
        for i in range(parts):
            part = slice(count * i // parts, count * (i + 1) // parts)
            yield entry, part, order.Sorted(own[part], (shape[2], shape[3], shape[4]), start, lanes)


def place(points: Tensor, placement: Placement) -> tuple[Tensor, Tensor | None]:
    """`ops.place`, fused: (located, sign); sign None where it is 1 everywhere."""
    from filterlab.ops.cpu import compiler, folding
    from filterlab.ops.cpu import threads as pool
    from filterlab.ops.cpu.job import AXES

    located = _fresh(points.shape, points.dtype, np.empty)
    if points.numel() == 0:
        return located, None
    points = readable(points, 0)
    lanes, geometry = _lanes(compiler.features(), points.element_size()), placement.geometry
    count = points.numel() // 3
    threads = max(1, min(torch.get_num_threads(), count // _POINTS_PER_THREAD))
    packs = -(-count // lanes)
    chunk = min(-(-packs // (threads * _CHUNKS_PER_THREAD if threads > 1 else 1)), _MOST_POINTS // lanes)
    chunks = -(-packs // chunk)
    turned = np.zeros(chunks, np.int64)
    job = folding.Job(count=count, chunk=chunk, chunks=chunks, shift=placement.shift)
    job.point(points=points, located=located, turned=turned)
    for i, (a, n) in enumerate(zip(AXES, placement.size, strict=True)):
        setattr(job, f"origin_{a}", geometry.origin[i])
        low, high = placement.boundary.interval(n, placement.tail)
        setattr(job, f"low_{a}", low)
        setattr(job, f"high_{a}", high)
        for j, b in enumerate(AXES):
            setattr(job, f"matrix_{a}{b}", geometry.inverse[i][j])
    x, y, z = (_how_it_folds(placement.boundary, n) for n in placement.size)
    affine = "identity" if geometry.is_identity else "full" if geometry.diagonal is None else "diagonal"

    def run(signs: bool) -> None:
        recipe = folding.Recipe((x, y, z), affine, signs, _ARITHMETIC[points.dtype], lanes)
        job.next = 0
        pool.run(compiler.compiled(recipe), [job] * threads)

    run(False)
    if not turned.any():
        return located, None
    sign = _fresh(points.shape, points.dtype, np.empty)
    job.point(signs=sign)
    run(True)
    return located, sign


def _how_it_folds(boundary: Boundary, n: int) -> str:
    if boundary is Boundary.MIRROR and n == 1:
        return "flat"
    return {Boundary.MIRROR: "reflect", Boundary.REFLECT: "reflect", Boundary.WRAP: "wrap"}.get(boundary, "clamp")


def _fresh(shape: Sequence[int], dtype: torch.dtype, make: Callable[..., np.ndarray], room: int = 0) -> Tensor:
    """A new tensor in memory that numpy allocated: it asks the system for huge pages, torch does not.

    Measured on Linux: the first touch of 8 MB costs 0.4 ms instead of 7, as much as a third of a splat of 10⁶ points.

    Args:
        room: numbers that the storage has behind the tensor.
    """
    size = math.prod(shape)
    return torch.from_numpy(make((size + room,), _ARITHMETIC[dtype]))[:size].view(tuple(shape))


def has_room(tensor: Tensor) -> bool:
    """Whether the storage of a contiguous tensor goes on behind it, by a number at least."""
    size = tensor.element_size()
    return tensor.untyped_storage().nbytes() >= (tensor.storage_offset() + tensor.numel() + 1) * size


def _zeros(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """What scatter adds into, (N, ...), with room for one number behind every entry: three taps are added as four.

    Threads may work on two entries of one volume at a time, so that the room of one may not be part of the next.
    """
    size = math.prod(shape[1:])
    memory = np.zeros((shape[0], size + 1), _ARITHMETIC[dtype])
    return torch.from_numpy(memory[:, :size].reshape(tuple(shape)))  # a view: only the last axis is split


def _run(
    operation: str,
    volumes: Sequence[Tensor],
    points: Tensor,
    rows: Tensor,
    stencil: Stencil,
    start: int,
    raised: tuple[tuple[int, ...], ...] = (),
    gradient: Tensor | None = None,
) -> None:
    """Compile, describe the arrays, and let the threads loose, one for each of `volumes`.

    Args:
        operation: "gather", "scatter" or "pull".
        volumes: for gather and pull the coefficients, as often as there are threads: all of them share the work, chunk
            by chunk. For scatter as many volumes of `_zeros`: each is given an equal share of the points.
        points, stencil, start: as for `gather`.
        rows: (N, C, J, M), contiguous; written by gather, read by scatter and pull.
        raised, gradient: for pull, as in its recipe and its result.
    """
    from filterlab.ops.cpu import compiler
    from filterlab.ops.cpu import threads as pool
    from filterlab.ops.cpu.job import AXES
    from filterlab.ops.cpu.points import BLOCK, Job, Recipe

    coefficients, threads = volumes[0], len(volumes)
    assert all(t.data_ptr() for t in (*volumes, points, rows)), "tensors without memory"
    arithmetic, storage = _ARITHMETIC[points.dtype], STORAGE[coefficients.dtype]
    lanes = _lanes(compiler.features(), points.element_size())
    function = compiler.compiled(Recipe(operation, stencil.lowered, arithmetic, storage, lanes, raised))

    entries, count = points.shape[:2]
    packs = -(-count // lanes)
    shared = operation != "scatter"
    blocks = -(-packs // ((threads * _CHUNKS_PER_THREAD if shared and threads > 1 else threads) * BLOCK))
    most = max(1, _MOST_POINTS // (lanes * BLOCK * coefficients.shape[1]))
    cuts = 1 if blocks <= most else -(-blocks // most) if shared else _least_divisor(blocks, -(-blocks // most))
    chunk = -(-blocks // cuts) * BLOCK
    parts = -(-packs // chunk)  # of every batch entry
    d, h, w = coefficients.shape[2:]
    job = Job(
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
    for axis, size, support in zip(AXES, (w, h, d), stencil.supports, strict=True):
        setattr(job, f"low_{axis}", start)
        setattr(job, f"high_{axis}", start + size - support)
    job.point(points=points, rows=rows)
    if gradient is not None:
        job.point(gradient=gradient)
    if shared:
        job.point(coefficients=coefficients)
        pool.run(function, [job] * threads)
    else:
        shares = range(0, parts, cuts)
        pool.run(function, [_own_share(job, first, cuts, v) for first, v in zip(shares, volumes, strict=False)])


def _own_share(job: Job, first: int, parts: int, volume: Tensor) -> Job:
    """The job of adding some parts of every batch entry's points to a volume of its own."""
    own = job.copy()
    own.point(coefficients=volume)
    own.next, own.chunks = first * job.entries, min((first + parts) * job.entries, job.chunks)
    return own


def _least_divisor(number: int, least: int) -> int:
    """The least divisor of a number from `least` on: shares that are cut into equal parts end where they ended."""
    return next(cuts for cuts in range(least, number + 1) if number % cuts == 0)


def _lanes(features: frozenset[str], element_size: int) -> int:
    """P: 8 floats or 4 doubles; twice as many with AVX-512.

    Measured with AVX2 (Zen 3), where 8 floats fill a register: 16 lanes need two, the weights of a 3×3×3 kernel no
    longer fit and jets become 1.0 to 1.5 times, splats 1.3 to 1.9 times as slow.
    """
    return (64 if "avx512f" in features else 32) // element_size


def _useful_threads(points: Tensor) -> int:
    return max(1, min(torch.get_num_threads(), points.shape[0] * points.shape[1] // _POINTS_PER_THREAD))
