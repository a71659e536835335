"""What the programs have in common that cast rays at things in the leaves of a tree: the walk down, and rows of hits.

For every ray, with a stack of nodes, the nearest on top:

    node    its eight boxes in float32; those that are met before the ray's limit are put on the stack, nearest last
    leaf    the eight things in it, in float64, as who walks says

Rows: the first hits of every ray, in order, of whatever a subclass finds in a leaf.

One ray is alone with its nodes: neighbours that hit different things, as they do where these are as small as pixels, do
not wait for each other.
"""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Protocol

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.lanes import DOUBLE, FLOAT, I1, I8, I32, I64, Lanes, Value
from filterlab.ops.quadrics import SMALLEST, Kept
from filterlab.ops.tree import WIDTH

RAYS_OF_A_CHUNK = 128
EPS = 2.0**-52
_DEEPEST = 12  # levels of nodes, of 8¹² leaves
_MASK = ir.VectorType(I1, WIDTH)

# Arrays are contiguous; R rays, d a double.
FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next; threads add 1 atomically
    "boxes": ctypes.c_void_p,  # (N, 6, 8) floats, see `ops.tree.Tree`
    "children": ctypes.c_void_p,  # (N) int32
    "leaves": ctypes.c_void_p,  # (G, K, 8) d, see `ops.quadrics.InLeaves`
    "start": ctypes.c_void_p,  # (R, 3) d, see `ops.quadrics.Rays`
    "along": ctypes.c_void_p,  # (R, 3) d
    "first": ctypes.c_void_p,  # (R) d
    "last": ctypes.c_void_p,  # (R) d
    "rays": ctypes.c_int64,
    "chunks": ctypes.c_int64,  # `next` stops here
}
ROWS: dict[str, type] = FIELDS | {
    "sheets": ctypes.c_int64,  # k
    "tau": ctypes.c_void_p,  # (R, k) d, written: of the first hits in order; ∞ before
    "place": ctypes.c_void_p,  # (R, k) int64, written: of what is hit; −1 before
}


class RowsJob(job.Job):
    _fields_ = tuple(ROWS.items())


class WalkVariant(Protocol):
    """What the walk depends on.

    Attributes:
        kept: which hits count.
        reversed: whether rays go the other way round.
        fused: whether the machine multiplies and adds with one rounding.
    """

    @property
    def kept(self) -> Kept: ...

    @property
    def reversed(self) -> bool: ...

    @property
    def fused(self) -> bool: ...


def always(flag: bool) -> Value:
    """A mask of lanes that are alike."""
    return ir.Constant(_MASK, [flag] * WIDTH)


@dataclass(frozen=True)
class Ray:
    """One ray.

    Attributes:
        start, along: Q, u in every lane, doubles.
        first, last: in every lane, doubles.
        place, inverse: Q and 1 / u in every lane, floats.
        near, far: rows of a node's boxes that it meets first and last, by axis.
        begins, ends: in every lane, floats.
        number: of the ray.
    """

    start: list[Value]
    along: list[Value]
    first: Value
    last: Value
    place: list[Value]
    inverse: list[Value]
    near: list[Value]
    far: list[Value]
    begins: Value
    ends: Value
    number: Value


InLeaf = Callable[[Ray, Value], None]
"""What is done in a leaf, by its number."""


def greatest(e: Lanes, a: Value) -> Value:
    """Of all lanes."""
    half = WIDTH // 2
    while half:
        a = e.maximum(a, e.shuffle(a, a, [(lane + half) % WIDTH for lane in range(WIDTH)]))
        half //= 2
    return e.lane(a, 0)


class Walk(ABC):
    """The program; what is done for a ray, and in a leaf, is a subclass's.

    Args:
        variant: everything it depends on.
        function: what it is written into.
        fields: of its job.
    """

    def __init__(self, variant: WalkVariant, function: ir.Function, fields: Mapping[str, type]) -> None:
        self.variant = variant
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes, self.boxes = (Lanes(self.builder, kind, WIDTH) for kind in ("float64", "float32"))
        self.job: SimpleNamespace = frame.load_job(self.lanes, function.args[0], fields)

    def write(self) -> None:
        e, b, j = self.lanes, self.builder, self.job
        self.nodes, self.nears = e.reserve(I32, WIDTH * _DEEPEST), e.reserve(FLOAT, WIDTH * _DEEPEST)
        self.top, self.limit = e.variable(I64(0)), e.variable(DOUBLE(0.0))
        self.bits = e.variable(I8(0))
        with frame.every_chunk(e, j) as chunk:
            begin = b.mul(chunk, I64(RAYS_OF_A_CHUNK))
            with e.repeat(begin, e.smaller(b.add(begin, I64(RAYS_OF_A_CHUNK)), j.rays)) as number:
                first, last = (self.number(array, number) for array in (j.first, j.last))
                with b.if_then(b.fcmp_ordered("<=", first, last)):
                    self.cast(self._ray(number, first, last))
        b.ret_void()

    @abstractmethod
    def cast(self, ray: Ray) -> None:
        """All that is done for a ray."""

    def walk(self, ray: Ray, leaf: InLeaf) -> None:
        """Down the tree, as far as the limit, which what is done in leaves may lower."""
        e, b = self.lanes, self.builder
        self.top.value = I64(0)
        self._push(I32(0), FLOAT(float("-inf")))
        with e.repeat_while(lambda: b.icmp_signed(">", self.top.value, I64(0))):
            self.top.value = top = b.sub(self.top.value, I64(1))
            node = b.load(e.advance(self.nodes, top, I32), typ=I32)
            near = b.load(e.advance(self.nears, top, FLOAT), typ=FLOAT)
            with (
                b.if_then(b.fcmp_ordered("<=", near, b.fptrunc(self.limit.value, FLOAT))),
                b.if_else(b.icmp_signed("<", node, I32(0))) as (outer, inner),
            ):
                with outer:
                    leaf(ray, b.sext(b.xor(node, I32(-1)), I64))
                with inner:
                    self._node(ray, b.sext(node, I64))

    # --- a ray ---

    def number(self, array: Value, index: Value) -> Value:
        return self.builder.load(self.lanes.advance(array, index, DOUBLE), typ=DOUBLE)

    def _ray(self, number: Value, first: Value, last: Value) -> Ray:
        e, f, b, j = self.lanes, self.boxes, self.builder, self.job
        places = [b.add(b.mul(number, I64(3)), I64(axis)) for axis in range(3)]
        start, along = ([self.number(array, place) for place in places] for array in (j.start, j.along))
        safe = [self._not_small(u) for u in along]
        backward = [b.fcmp_ordered("<", u, DOUBLE(0.0)) for u in safe]
        near = [b.select(back, I64(axis + 3), I64(axis)) for axis, back in enumerate(backward)]
        far = [b.select(back, I64(axis), I64(axis + 3)) for axis, back in enumerate(backward)]
        return Ray(
            [e.everywhere(x) for x in start],
            [e.everywhere(x) for x in along],
            e.everywhere(first),
            e.everywhere(last),
            [f.everywhere(b.fptrunc(x, FLOAT)) for x in start],
            [f.everywhere(b.fptrunc(b.fdiv(DOUBLE(1.0), u), FLOAT)) for u in safe],
            near,
            far,
            f.everywhere(b.fptrunc(first, FLOAT)),
            f.everywhere(b.fptrunc(last, FLOAT)),
            number,
        )

    def _not_small(self, u: Value) -> Value:
        b = self.builder
        large = b.or_(b.fcmp_ordered(">=", u, DOUBLE(SMALLEST)), b.fcmp_ordered("<=", u, DOUBLE(-SMALLEST)))
        return b.select(large, u, DOUBLE(SMALLEST))

    def _push(self, node: Value, near: Value) -> None:
        e, b, top = self.lanes, self.builder, self.top.value
        b.store(node, e.advance(self.nodes, top, I32))
        b.store(near, e.advance(self.nears, top, FLOAT))
        self.top.value = b.add(top, I64(1))

    # --- nodes ---

    def _node(self, ray: Ray, node: Value) -> None:
        """Its children that are met, the nearest on top."""
        f, b = self.boxes, self.builder
        box = f.advance(self.job.boxes, b.mul(node, I64(6 * WIDTH)), FLOAT)
        near, far = ray.begins, ray.ends
        for axis in range(3):
            low, high = (self._slab(ray, box, axis, rows[axis]) for rows in (ray.near, ray.far))
            near, far = f.maximum(low, near), f.minimum(high, far)
        limit = f.everywhere(b.fptrunc(self.limit.value, FLOAT))
        met = b.and_(b.fcmp_ordered("<=", near, far), b.fcmp_ordered("<=", near, limit))
        child = b.load(f.advance(self.job.children, node, I32), typ=I32)
        sign = b.select(b.icmp_signed("<", child, I32(0)), I32(-1), I32(1))
        self.bits.value = b.bitcast(met, I8)
        with f.repeat_while(lambda: b.icmp_unsigned("!=", self.bits.value, I8(0))):
            left = f.where(b.bitcast(self.bits.value, _MASK), near, f.constant(float("-inf")))
            most = greatest(f, left)
            lanes = b.and_(b.bitcast(b.fcmp_ordered("==", left, f.everywhere(most)), I8), self.bits.value)
            lane = b.cttz(lanes, I1(0))
            self._push(b.add(child, b.mul(sign, b.zext(lane, I32))), most)
            self.bits.value = b.xor(self.bits.value, b.shl(I8(1), lane))

    def _slab(self, ray: Ray, box: Value, axis: int, row: Value) -> Value:
        f, b = self.boxes, self.builder
        side = f.load(f.advance(box, b.mul(row, I64(WIDTH)), FLOAT), FLOAT, WIDTH)
        return f.multiply(f.subtract(side, ray.place[axis]), ray.inverse[axis])

    # --- leaves ---

    def rows(self, base: Value, rows: Sequence[int]) -> list[Value]:
        e = self.lanes
        return [e.load(e.advance(base, I64(WIDTH * row), DOUBLE), DOUBLE, WIDTH) for row in rows]

    def dot(self, x: Sequence[Value], y: Sequence[Value]) -> Value:
        total = self.lanes.multiply(x[0], y[0])
        for a, b in zip(x[1:], y[1:], strict=True):
            total = self.lanes.multiply_add(a, b, total)
        return total

    def difference(self, beta: Value, alpha: Value, gamma: Value) -> Value:
        """β² − αγ, right but for two roundings (Kahan)."""
        e = self.lanes
        product = e.multiply(alpha, gamma)
        if not self.variant.fused:
            return e.subtract(e.multiply(beta, beta), product)
        less = e.negate(product)
        return e.subtract(e.fused(beta, beta, less), e.fused(alpha, gamma, less))

    def stable_roots(self, alpha: Value, beta: Value, gamma: Value, s: Value) -> tuple[Value, Value]:
        e = self.lanes
        receding = e.less(e.constant(0), beta)
        sum_ = e.where(receding, e.negate(e.add(beta, s)), e.subtract(s, beta))  # ∓ (|β| + s), in which nothing cancels
        by_alpha, by_sum = e.divide(sum_, alpha), e.divide(gamma, sum_)
        return e.where(receding, by_alpha, by_sum), e.where(receding, by_sum, by_alpha)

    def counted(self, one: Value, turned: Value | None = None) -> tuple[Value, Value]:
        """Which fronts and which backs count, masks; where both are one, fronts; where turned, they change places."""
        b, kept = self.builder, self.variant.kept
        falls, rises = always(kept.falls), always(kept.rises)
        if turned is not None:
            falls, rises = b.select(turned, rises, falls), b.select(turned, falls, rises)
        return b.select(one, always(kept.touches), falls), b.and_(rises, b.not_(one))

    def from_center(self, ray: Ray, center: Sequence[Value]) -> tuple[list[Value], Value]:
        """q, the point of the ray nearest to centres, measured from there, and τ there."""
        e = self.lanes
        p = [e.subtract(x, c) for x, c in zip(ray.start, center, strict=True)]
        behind = e.negate(self.dot(p, ray.along))
        return [e.multiply_add(behind, u, x) for u, x in zip(ray.along, p, strict=True)], behind


class Rows(Walk):
    """The first hits of every ray, in order."""

    def __init__(self, variant: WalkVariant, function: ir.Function) -> None:
        super().__init__(variant, function, ROWS)

    @abstractmethod
    def leaf(self, ray: Ray, leaf: Value) -> None:
        """Take the hits with what stands in that leaf."""

    def cast(self, ray: Ray) -> None:
        e, row = self.lanes, self.builder.mul(ray.number, self.job.sheets)
        self.taus, self.places = e.advance(self.job.tau, row, DOUBLE), e.advance(self.job.place, row, I64)
        self.slot = e.variable(I64(0))
        self.limit.value = DOUBLE(float("inf"))
        self.walk(ray, self.leaf)

    def take(self, leaf: Value, tau: Value, hit: Value) -> None:
        """Those of a mask that come before the ray's last hit."""
        e, b = self.lanes, self.builder
        sooner = b.and_(hit, b.fcmp_ordered("<", tau, e.everywhere(self.limit.value)))
        self.bits.value = b.bitcast(sooner, I8)
        with e.repeat_while(lambda: b.icmp_unsigned("!=", self.bits.value, I8(0))):
            lane = b.cttz(self.bits.value, I1(0))
            self.bits.value = b.xor(self.bits.value, b.shl(I8(1), lane))
            place = b.add(b.mul(leaf, I64(WIDTH)), b.zext(lane, I64))
            self._insert(b.extract_element(tau, b.zext(lane, I32)), place)

    def _insert(self, tau: Value, place: Value) -> None:
        """Into the rows, in order, if it comes before the last one there."""
        e, b = self.lanes, self.builder
        last = b.sub(self.job.sheets, I64(1))
        with b.if_then(b.fcmp_ordered("<", tau, self.limit.value)):
            self.slot.value = last

            def goes_before() -> Value:
                """Whether the hit before the slot comes later."""
                before = b.sub(self.slot.value, I64(1))
                some = b.icmp_signed(">=", before, I64(0))
                safe = b.select(some, before, I64(0))
                return b.and_(some, b.fcmp_ordered("<", tau, self.number(self.taus, safe)))

            with e.repeat_while(goes_before):
                slot, before = self.slot.value, b.sub(self.slot.value, I64(1))
                b.store(self.number(self.taus, before), e.advance(self.taus, slot, DOUBLE))
                moved = b.load(e.advance(self.places, before, I64), typ=I64)
                b.store(moved, e.advance(self.places, slot, I64))
                self.slot.value = before
            b.store(tau, e.advance(self.taus, self.slot.value, DOUBLE))
            b.store(place, e.advance(self.places, self.slot.value, I64))
            self.limit.value = self.number(self.taus, last)


@dataclass(frozen=True)
class RowsVariant(ABC):
    """Everything a program of rows depends on, apart from the machine; attributes as of `WalkVariant`."""

    kept: Kept
    reversed: bool
    fused: bool

    @abstractmethod
    def program(self, function: ir.Function) -> Rows:
        """What is to be written."""

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        self.program(function).write()
