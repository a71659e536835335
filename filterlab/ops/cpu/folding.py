"""place as a program: world points to coordinates of coefficients, folded under the boundary.

    voxel = matrix · (point − origin)       one product per axis where the axes are the world's
    fold each axis, where some lane of the pack is outside [low, high]:
        reflect   w = |x mod 2(high−low) − low|; the nearer one of w and its mirror image, + low
        wrap      x mod high, made positive
        clamp     low or high
        flat      low, the only place there is
    located = folded − shift

x mod p is exact for any finite x: with |x| < 2^k p, subtract 2^(k−1) p, …, 2p, p wherever that much is left; every
difference is exact. ±inf becomes NaN, but under clamp; what is at NaN is counted, as it may be a point that is finite,
and only its voxel coordinate beyond the range of its type (`ops.place`).
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.lanes import I1, I64, Lanes, Value

TURNED, LOST = 1, 2
"""What a job may have met: a sign that is not 1; a point that is located at NaN."""

FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next
    "points": ctypes.c_void_p,  # (M, 3)
    "located": ctypes.c_void_p,  # (M, 3)
    "signs": ctypes.c_void_p,  # (M, 3); null: they are not written
    "met": ctypes.c_int64,  # TURNED, LOST or both; threads add to it atomically
    "count": ctypes.c_int64,  # M
    "chunk": ctypes.c_int64,  # packs of a chunk
    "chunks": ctypes.c_int64,
    **{f"shift_{a}": ctypes.c_double for a in AXES},
    **{f"origin_{a}": ctypes.c_double for a in AXES},
    **{f"matrix_{a}{b}": ctypes.c_double for a in AXES for b in AXES},  # row a: voxel coordinate a
    **{f"low_{a}": ctypes.c_double for a in AXES},
    **{f"high_{a}": ctypes.c_double for a in AXES},
}


class FoldingJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class FoldingVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        axes: how x, y and z fold: "reflect", "wrap", "clamp" or "flat".
        affine: "identity", "diagonal" or "full".
        arithmetic: "float32" or "float64".
        lanes: P.
    """

    axes: tuple[str, str, str]
    affine: str
    arithmetic: str
    lanes: int

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _Program(self, function).write()


class _Program:
    def __init__(self, variant: FoldingVariant, function: ir.Function) -> None:
        self.variant, self.function = variant, function
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(self.builder, variant.arithmetic, variant.lanes)

    def write(self) -> None:
        e, b = self.lanes, self.builder
        self.job = j = frame.load_job(e, self.function.args[0], FIELDS)
        self.copied = [e.reserve(e.number, 3 * e.count) for _ in range(3)]  # points, located, signs of a partial pack
        self.met = e.variable(I64(0))
        with frame.every_chunk(e, j) as chunk:
            packs = b.udiv(b.add(j.count, I64(e.count - 1)), I64(e.count))
            first = b.mul(chunk, j.chunk)
            with e.repeat(first, e.smaller(b.add(first, j.chunk), packs)) as pack:
                self._write_pack(pack)
        b.atomic_rmw("or", j.met, self.met.value, "monotonic")
        b.ret_void()

    def _write_pack(self, pack: Value) -> None:
        e, b, j = self.lanes, self.builder, self.job
        first = b.mul(pack, I64(e.count))
        left = b.sub(j.count, first)
        partial = b.icmp_signed("<", left, I64(e.count))
        own = [e.advance(array, b.mul(first, I64(3)), e.number) for array in (j.points, j.located, j.signs)]
        size = b.mul(left, I64(3 * e.bits // 8))
        with b.if_then(partial, likely=False):
            e.clear(self.copied[0], 3 * e.count * e.bits // 8)
            e.copy(self.copied[0], own[0], size)
        points, located, signs = (b.select(partial, c, o) for c, o in zip(self.copied, own, strict=True))
        folded = [self._fold(x, axis) for axis, x in enumerate(self._to_voxel(e.load_triples(points)))]
        shifts = [e.everywhere(e.scalar(getattr(j, f"shift_{a}"))) for a in AXES]
        e.store_triples([e.subtract(x, s) for (x, _), s in zip(folded, shifts, strict=True)], located)
        with b.if_then(partial, likely=False):
            e.copy(own[1], self.copied[1], size)
        with b.if_then(e.given(j.signs), likely=False):
            e.store_triples([sign for _, sign in folded], signs)
            with b.if_then(partial, likely=False):
                e.copy(own[2], self.copied[2], size)

    def _to_voxel(self, points: list[Value]) -> list[Value]:
        e, j = self.lanes, self.job
        if self.variant.affine == "identity":
            return points
        number = {name: e.everywhere(e.scalar(value)) for name, value in vars(j).items() if name[:6] in _AFFINE}
        moved = [e.subtract(x, number[f"origin_{a}"]) for a, x in zip(AXES, points, strict=True)]
        if self.variant.affine == "diagonal":
            return [e.multiply(x, number[f"matrix_{a}{a}"]) for a, x in zip(AXES, moved, strict=True)]
        rows = []
        for a in AXES:
            total = None
            for b, x in zip(AXES, moved, strict=True):
                total = e.multiply_add(x, number[f"matrix_{a}{b}"], total)
            rows.append(total)
        return rows

    def _fold(self, x: Value, axis: int) -> tuple[Value, Value]:
        """(folded, sign) of a pack; the work is skipped when every lane is inside."""
        e, b = self.lanes, self.builder
        low, high = (e.everywhere(e.scalar(getattr(self.job, f"{end}_{AXES[axis]}"))) for end in ("low", "high"))
        folded, sign = e.variable(x), e.variable(e.constant(1))
        inside = b.and_(b.fcmp_ordered(">=", x, low), b.fcmp_ordered("<=", x, high))
        if self.variant.axes[axis] == "flat":
            inside = ir.Constant(ir.VectorType(I1, e.count), [False] * e.count)
        with b.if_then(b.not_(e.all(inside)), likely=False):
            outside, turned = getattr(self, f"_{self.variant.axes[axis]}")(x, low, high)
            folded.value = b.select(inside, x, outside)
            sign.value = b.select(inside, e.constant(1), turned)
            if self.variant.axes[axis] != "wrap":
                self.met.value = b.or_(self.met.value, I64(TURNED))
            lost = b.select(e.any(b.fcmp_unordered("uno", outside, outside)), I64(LOST), I64(0))
            self.met.value = b.or_(self.met.value, lost)
        return folded.value, sign.value

    def _reflect(self, x: Value, low: Value, high: Value) -> tuple[Value, Value]:
        e, b = self.lanes, self.builder
        period = e.multiply(e.constant(2), e.subtract(high, low))
        w = e.subtract(self._modulo(x, period), low)
        r = e.absolute(w)
        other = e.absolute(e.subtract(period, r))
        mirrored = b.fcmp_ordered("<", other, r)
        turned = b.xor(b.xor(b.fcmp_ordered("<", w, e.constant(0)), mirrored), b.fcmp_ordered(">", r, period))
        nearer = b.select(mirrored, other, r)
        return e.add(nearer, low), b.select(turned, e.constant(-1), e.constant(1))

    def _wrap(self, x: Value, low: Value, high: Value) -> tuple[Value, Value]:
        e, b = self.lanes, self.builder
        r = self._modulo(x, high)
        return b.select(b.fcmp_ordered("<", r, e.constant(0)), e.add(r, high), r), e.constant(1)

    def _clamp(self, x: Value, low: Value, high: Value) -> tuple[Value, Value]:
        e, b = self.lanes, self.builder
        if self.variant.affine == "full":  # a sum that left the range of its type may have come back: ∞ + (∞ − ∞) = NaN
            x = e.add(x, e.subtract(x, x))
        below, above = b.fcmp_ordered("<", x, low), b.fcmp_ordered(">", x, high)
        constant = b.or_(below, above)
        return b.select(below, low, b.select(above, high, x)), b.select(constant, e.constant(0), e.constant(1))

    def _flat(self, x: Value, low: Value, high: Value) -> tuple[Value, Value]:
        e = self.lanes
        return e.add(e.subtract(x, x), low), e.constant(0)  # x − x is NaN at infinity

    def _modulo(self, x: Value, period: Value) -> Value:
        """The remainder of x / period with the sign of x, exact; NaN for ±inf."""
        e, b = self.lanes, self.builder
        left = e.variable(e.absolute(e.subtract(x, e.subtract(x, x))))  # ∞ − (∞ − ∞) = NaN ends the loops below
        part = e.variable(period)
        with e.repeat_while(lambda: e.any(b.fcmp_ordered(">=", left.value, e.add(part.value, part.value)))):
            part.value = e.add(part.value, part.value)
        with e.repeat_while(lambda: e.any(b.fcmp_ordered(">=", part.value, period))):
            enough = b.fcmp_ordered(">=", left.value, part.value)
            left.value = b.select(enough, e.subtract(left.value, part.value), left.value)
            part.value = e.multiply(part.value, e.constant(0.5))
        negative = b.fcmp_ordered("<", x, e.constant(0))
        return b.select(negative, e.subtract(e.constant(0), left.value), left.value)


_AFFINE = ("origin", "matrix")
