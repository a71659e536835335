"""A walk down the tree of quadrics for every ray, eight boxes or eight quadrics at a time, as programs write it.

For every ray, with a stack of nodes, the nearest on top:

    node    its eight boxes in float32; those that are met before the ray's limit are put on the stack, nearest last
    leaf    its eight quadrics in float64, as `ops.reference.quadrics` says, the radicand by fused multiply-add (Kahan's
            difference of products); who walks takes the hits

One ray is alone with its nodes: neighbours that hit different things, as they do where quadrics are as small as pixels,
do not wait for each other.
"""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Protocol

from llvmlite import ir

from filterlab.ops.cpu import frame
from filterlab.ops.cpu.lanes import DOUBLE, FLOAT, I1, I8, I32, I64, Lanes, Value
from filterlab.ops.quadrics import CENTER, CONSTANT, MATRIX, PLANES, ROUNDINGS, SIZES, SMALLEST, SQUARE, VECTOR, Kept
from filterlab.ops.tree import WIDTH

RAYS_OF_A_CHUNK = 128
_DEEPEST = 12  # levels of nodes, of 8¹² leaves
_EPS = 2.0**-52
_MASK = ir.VectorType(I1, WIDTH)

# Arrays are contiguous; R rays, d a double.
FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next; threads add 1 atomically
    "boxes": ctypes.c_void_p,  # (N, 6, 8) floats, see `ops.tree.Tree`
    "children": ctypes.c_void_p,  # (N) int32
    "leaves": ctypes.c_void_p,  # (G, 16 + 4 H, 8) d, see `ops.quadrics.Quadrics`
    "start": ctypes.c_void_p,  # (R, 3) d, see `ops.quadrics.Rays`
    "along": ctypes.c_void_p,  # (R, 3) d
    "first": ctypes.c_void_p,  # (R) d
    "last": ctypes.c_void_p,  # (R) d
    "rays": ctypes.c_int64,
    "chunks": ctypes.c_int64,  # `next` stops here
}


class WalkVariant(Protocol):
    """What a walk depends on, apart from the machine.

    Attributes:
        planes: H.
        kept: which hits count.
        reversed: whether rays go the other way round.
        fused: whether the machine multiplies and adds with one rounding.
    """

    @property
    def planes(self) -> int: ...
    @property
    def kept(self) -> Kept: ...
    @property
    def reversed(self) -> bool: ...
    @property
    def fused(self) -> bool: ...


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


@dataclass(frozen=True)
class Met:
    """Eight quadrics and a ray.

    Attributes:
        leaf: its number. base: the address of its numbers.
        q: where the ray is nearest to the centres of balls. behind: τ there.
    """

    leaf: Value
    base: Value
    q: list[Value]
    behind: Value


Take = Callable[[Ray, Met, Value, Value], None]
"""(ray, quadrics, ρ, mask): hits ρ behind q in the lanes of the mask."""


def most_of(e: Lanes, a: Value) -> Value:
    """The greatest of all lanes."""
    half = WIDTH // 2
    while half:
        a = e.maximum(a, e.shuffle(a, a, [(lane + half) % WIDTH for lane in range(WIDTH)]))
        half //= 2
    return e.lane(a, 0)


class Walk(ABC):
    """Writes the program; `cast` is what is done for a ray."""

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

    def walk(self, ray: Ray, take: Take) -> None:
        """Down the tree, as far as the limit, which whoever takes hits may lower."""
        e, b = self.lanes, self.builder
        self.top.value = I64(0)
        self._push(I32(0), FLOAT(float("-inf")))
        with e.repeat_while(lambda: b.icmp_signed(">", self.top.value, I64(0))):
            self.top.value = top = b.sub(self.top.value, I64(1))
            node = b.load(e.advance(self.nodes, top, I32), typ=I32)
            near = b.load(e.advance(self.nears, top, FLOAT), typ=FLOAT)
            with (
                b.if_then(b.fcmp_ordered("<=", near, b.fptrunc(self.limit.value, FLOAT))),
                b.if_else(b.icmp_signed("<", node, I32(0))) as (leaf, inner),
            ):
                with leaf:
                    self.leaf(ray, b.sext(b.xor(node, I32(-1)), I64), take)
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
            most = most_of(f, left)
            lanes = b.and_(b.bitcast(b.fcmp_ordered("==", left, f.everywhere(most)), I8), self.bits.value)
            lane = b.cttz(lanes, I1(0))
            self._push(b.add(child, b.mul(sign, b.zext(lane, I32))), most)
            self.bits.value = b.xor(self.bits.value, b.shl(I8(1), lane))

    def _slab(self, ray: Ray, box: Value, axis: int, row: Value) -> Value:
        f, b = self.boxes, self.builder
        side = f.load(f.advance(box, b.mul(row, I64(WIDTH)), FLOAT), FLOAT, WIDTH)
        return f.multiply(f.subtract(side, ray.place[axis]), ray.inverse[axis])

    # --- leaves ---

    def leaf(self, ray: Ray, leaf: Value, take: Take) -> None:
        e, b = self.lanes, self.builder
        size = WIDTH * (PLANES + 4 * self.variant.planes)
        base = e.advance(self.job.leaves, b.mul(leaf, I64(size)), DOUBLE)
        center = self.rows(base, range(CENTER.start, CENTER.stop))
        p = [e.subtract(x, c) for x, c in zip(ray.start, center, strict=True)]
        behind = e.negate(self.dot(p, ray.along))
        q = [e.multiply_add(behind, u, x) for u, x in zip(ray.along, p, strict=True)]
        near, far, valid = self._clipped(ray, base, q, behind)
        valid = b.and_(valid, b.fcmp_ordered("<=", near, far))
        with b.if_then(e.any(valid)):
            front, back, one = self._roots(ray, base, q, far if self.variant.reversed else near)
            kept = self.variant.kept
            yes = lambda flag: ir.Constant(_MASK, [flag] * WIDTH)  # noqa: E731
            counts = b.select(one, yes(kept.touches), yes(kept.falls)), b.select(one, yes(False), yes(kept.rises))
            for root, counted in zip((front, back), counts, strict=True):
                within = b.and_(b.fcmp_ordered(">=", root, near), b.fcmp_ordered("<=", root, far))
                take(ray, Met(leaf, base, q, behind), root, b.and_(b.and_(within, counted), valid))

    def rows(self, base: Value, rows: Sequence[int]) -> list[Value]:
        e = self.lanes
        return [e.load(e.advance(base, I64(WIDTH * row), DOUBLE), DOUBLE, WIDTH) for row in rows]

    def dot(self, x: Sequence[Value], y: Sequence[Value]) -> Value:
        total = self.lanes.multiply(x[0], y[0])
        for a, b in zip(x[1:], y[1:], strict=True):
            total = self.lanes.multiply_add(a, b, total)
        return total

    def _clipped(self, ray: Ray, base: Value, q: list[Value], behind: Value) -> tuple[Value, Value, Value]:
        """Between which ρ rays are in the ball, between all planes and within their ends, and a mask: if ever."""
        e, b = self.lanes, self.builder
        rest = e.subtract(self.rows(base, [SQUARE])[0], self.dot(q, q))
        zero = e.constant(0)
        valid, half = b.fcmp_ordered(">=", rest, zero), e.square_root(rest)
        near = e.maximum(e.subtract(ray.first, behind), e.negate(half))
        far = e.minimum(e.subtract(ray.last, behind), half)
        for plane in range(self.variant.planes):
            *normal, d = self.rows(base, range(PLANES + 4 * plane, PLANES + 4 * plane + 4))
            speed, height = self.dot(normal, ray.along), e.add(self.dot(normal, q), d)
            at = e.divide(e.negate(height), speed)
            near = e.where(e.less(speed, zero), e.maximum(at, near), near)
            far = e.where(e.less(zero, speed), e.minimum(at, far), far)
            beside = b.and_(b.fcmp_ordered("==", speed, zero), e.less(zero, height))
            valid = b.and_(valid, b.not_(beside))
        return near, far, valid

    def _roots(self, ray: Ray, base: Value, q: list[Value], entry: Value) -> tuple[Value, Value, Value]:
        """ρ of front and back, and a mask of those that are one; as `ops.reference.quadrics` says."""
        e, b = self.lanes, self.builder
        matrix, vector = self.rows(base, range(MATRIX.stop)), self.rows(base, range(VECTOR.start, VECTOR.stop))
        (c,), (size_a, size_b) = self.rows(base, [CONSTANT]), self.rows(base, range(SIZES.start, SIZES.stop))
        turned = self.times(matrix, q)
        alpha = self.dot(ray.along, self.times(matrix, ray.along))
        force = [e.add(x, y) for x, y in zip(turned, vector, strict=True)]
        beta = self.dot(ray.along, force)
        gamma = e.add(self.dot(q, [e.add(x, y) for x, y in zip(force, vector, strict=True)]), c)
        reach = e.square_root(self.dot(q, q))
        size_beta = e.multiply_add(size_a, reach, size_b)
        size_gamma = e.multiply_add(reach, e.add(size_beta, size_b), e.absolute(c))
        radicand = self._difference(beta, alpha, gamma)
        a, g, h = (e.absolute(x) for x in (alpha, gamma, beta))
        rounding = e.constant(ROUNDINGS * _EPS)
        slack = e.multiply_add(e.multiply(e.constant(2), h), size_beta, e.multiply(size_a, g))
        slack = e.multiply(rounding, e.multiply_add(a, size_gamma, slack))
        no_more = lambda x, size: b.fcmp_ordered("<=", x, e.multiply(rounding, size))  # noqa: E731
        on = b.and_(b.and_(no_more(a, size_a), no_more(h, size_beta)), no_more(g, size_gamma))
        touches = b.fcmp_ordered("<=", e.absolute(radicand), slack)
        front, back = self._stable(alpha, beta, gamma, e.square_root(radicand))
        front = e.where(touches, e.divide(e.negate(beta), alpha), front)
        return e.where(on, entry, front), back, b.or_(on, touches)

    def _stable(self, alpha: Value, beta: Value, gamma: Value, s: Value) -> tuple[Value, Value]:
        e = self.lanes
        receding = e.less(e.constant(0), beta)
        sum_ = e.where(receding, e.negate(e.add(beta, s)), e.subtract(s, beta))  # ∓ (|β| + s), in which nothing cancels
        by_alpha, by_sum = e.divide(sum_, alpha), e.divide(gamma, sum_)
        return e.where(receding, by_alpha, by_sum), e.where(receding, by_sum, by_alpha)

    def _difference(self, beta: Value, alpha: Value, gamma: Value) -> Value:
        """β² − αγ, right but for two roundings (Kahan)."""
        e = self.lanes
        product = e.multiply(alpha, gamma)
        if not self.variant.fused:
            return e.subtract(e.multiply(beta, beta), product)
        less = e.negate(product)
        return e.subtract(e.fused(beta, beta, less), e.fused(alpha, gamma, less))

    def times(self, matrix: Sequence[Value], x: Sequence[Value]) -> list[Value]:
        xx, yy, zz, xy, xz, yz = matrix
        return [self.dot(row, x) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]
