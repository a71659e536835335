"""The program that casts rays at quadrics: a walk down the tree for each, eight boxes or eight quadrics at a time.

For every ray, with a stack of nodes, the nearest on top:

    node    its eight boxes in float32; those that are met before the ray's last hit are put on the stack, nearest last
    leaf    its eight quadrics in float64, as `ops.reference.quadrics` says, the radicand by fused multiply-add (Kahan's
            difference of products); hits are put in order into the ray's row

One ray is alone with its nodes: neighbours that hit different things, as they do where quadrics are as small as pixels,
do not wait for each other.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.lanes import DOUBLE, FLOAT, I8, I32, I64, Lanes, Value
from filterlab.ops.quadrics import CENTER, CONSTANT, MATRIX, PLANES, ROUNDINGS, SIZES, SMALLEST, SQUARE, VECTOR, Kept
from filterlab.ops.tree import WIDTH

RAYS_OF_A_CHUNK = 128
_DEEPEST = 12  # levels of nodes, of 8¹² leaves
_EPS = 2.0**-52

# Arrays are contiguous; R rays, k sheets, d a double.
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
    "sheets": ctypes.c_int64,
    "tau": ctypes.c_void_p,  # (R, k) d, written: of the first hits in order; ∞ before
    "place": ctypes.c_void_p,  # (R, k) int64, written: of the quadrics; −1 before
    "chunks": ctypes.c_int64,  # `next` stops here
}


class QuadricsJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class QuadricsVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        planes: H.
        kept: which hits count.
        reversed: whether rays go the other way round.
        fused: whether the machine multiplies and adds with one rounding.
    """

    planes: int
    kept: Kept
    reversed: bool
    fused: bool

    def generate(self) -> str:
        """The program as LLVM IR text."""
        module, function = frame.new_module()
        _Program(self, function).write()
        return str(module)


@dataclass(frozen=True)
class _Ray:
    """One ray.

    Attributes:
        start, along: Q, u in every lane, doubles.
        first, last: in every lane, doubles.
        place, inverse: Q and 1 / u in every lane, floats.
        near, far: rows of a node's boxes that it meets first and last, by axis.
        begins, ends: in every lane, floats.
        tau, places: addresses of its rows.
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
    tau: Value
    places: Value


class _Program:
    def __init__(self, variant: QuadricsVariant, function: ir.Function) -> None:
        self.variant = variant
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes, self.boxes = (Lanes(self.builder, kind, WIDTH) for kind in ("float64", "float32"))
        self.job: SimpleNamespace = frame.load_job(self.lanes, function.args[0], FIELDS)

    def write(self) -> None:
        e, b, j = self.lanes, self.builder, self.job
        self.nodes, self.nears = e.reserve(I32, WIDTH * _DEEPEST), e.reserve(FLOAT, WIDTH * _DEEPEST)
        self.top, self.limit = e.variable(I64(0)), e.variable(DOUBLE(0.0))
        self.bits, self.slot = e.variable(I8(0)), e.variable(I64(0))
        with frame.every_chunk(e, j) as chunk:
            begin = b.mul(chunk, I64(RAYS_OF_A_CHUNK))
            with e.repeat(begin, e.smaller(b.add(begin, I64(RAYS_OF_A_CHUNK)), j.rays)) as number:
                first, last = (self._number(array, number) for array in (j.first, j.last))
                with b.if_then(b.fcmp_ordered("<=", first, last)):
                    self._cast(self._ray(number, first, last))
        b.ret_void()

    # --- a ray ---

    def _number(self, array: Value, index: Value) -> Value:
        return self.builder.load(self.lanes.advance(array, index, DOUBLE), typ=DOUBLE)

    def _ray(self, number: Value, first: Value, last: Value) -> _Ray:
        e, f, b, j = self.lanes, self.boxes, self.builder, self.job
        places = [b.add(b.mul(number, I64(3)), I64(axis)) for axis in range(3)]
        start, along = ([self._number(array, place) for place in places] for array in (j.start, j.along))
        safe = [self._not_small(u) for u in along]
        backward = [b.fcmp_ordered("<", u, DOUBLE(0.0)) for u in safe]
        near = [b.select(back, I64(axis + 3), I64(axis)) for axis, back in enumerate(backward)]
        far = [b.select(back, I64(axis), I64(axis + 3)) for axis, back in enumerate(backward)]
        row = b.mul(number, j.sheets)
        return _Ray(
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
            e.advance(j.tau, row, DOUBLE),
            e.advance(j.place, row, I64),
        )

    def _not_small(self, u: Value) -> Value:
        b = self.builder
        large = b.or_(b.fcmp_ordered(">=", u, DOUBLE(SMALLEST)), b.fcmp_ordered("<=", u, DOUBLE(-SMALLEST)))
        return b.select(large, u, DOUBLE(SMALLEST))

    def _cast(self, ray: _Ray) -> None:
        e, b = self.lanes, self.builder
        self.limit.value = DOUBLE(float("inf"))
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
                    self._leaf(ray, b.sext(b.xor(node, I32(-1)), I64))
                with inner:
                    self._node(ray, b.sext(node, I64))

    def _push(self, node: Value, near: Value) -> None:
        e, b, top = self.lanes, self.builder, self.top.value
        b.store(node, e.advance(self.nodes, top, I32))
        b.store(near, e.advance(self.nears, top, FLOAT))
        self.top.value = b.add(top, I64(1))

    # --- nodes ---

    def _node(self, ray: _Ray, node: Value) -> None:
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
            left = f.where(b.bitcast(self.bits.value, met.type), near, f.constant(float("-inf")))
            most = self._greatest(left)
            lanes = b.and_(b.bitcast(b.fcmp_ordered("==", left, f.everywhere(most)), I8), self.bits.value)
            lane = b.cttz(lanes, ir.IntType(1)(0))
            self._push(b.add(child, b.mul(sign, b.zext(lane, I32))), most)
            self.bits.value = b.xor(self.bits.value, b.shl(I8(1), lane))

    def _slab(self, ray: _Ray, box: Value, axis: int, row: Value) -> Value:
        f, b = self.boxes, self.builder
        side = f.load(f.advance(box, b.mul(row, I64(WIDTH)), FLOAT), FLOAT, WIDTH)
        return f.multiply(f.subtract(side, ray.place[axis]), ray.inverse[axis])

    def _greatest(self, a: Value) -> Value:
        """Of all lanes."""
        f, half = self.boxes, WIDTH // 2
        while half:
            a = f.maximum(a, f.shuffle(a, a, [(lane + half) % WIDTH for lane in range(WIDTH)]))
            half //= 2
        return f.lane(a, 0)

    # --- leaves ---

    def _leaf(self, ray: _Ray, leaf: Value) -> None:
        e, b = self.lanes, self.builder
        size = WIDTH * (PLANES + 4 * self.variant.planes)
        base = e.advance(self.job.leaves, b.mul(leaf, I64(size)), DOUBLE)
        center = self._rows(base, range(CENTER.start, CENTER.stop))
        p = [e.subtract(x, c) for x, c in zip(ray.start, center, strict=True)]
        behind = e.negate(self._dot(p, ray.along))
        q = [e.multiply_add(behind, u, x) for u, x in zip(ray.along, p, strict=True)]
        near, far, valid = self._clipped(ray, base, q, behind)
        valid = b.and_(valid, b.fcmp_ordered("<=", near, far))
        with b.if_then(e.any(valid)):
            front, back, one = self._roots(ray, base, q, far if self.variant.reversed else near)
            kept = self.variant.kept
            yes = lambda flag: ir.Constant(one.type, [flag] * WIDTH)  # noqa: E731
            counts = b.select(one, yes(kept.touches), yes(kept.falls)), b.select(one, yes(False), yes(kept.rises))
            for root, counted in zip((front, back), counts, strict=True):
                within = b.and_(b.fcmp_ordered(">=", root, near), b.fcmp_ordered("<=", root, far))
                self._take(ray, leaf, e.add(root, behind), b.and_(b.and_(within, counted), valid))

    def _rows(self, base: Value, rows: Sequence[int]) -> list[Value]:
        e = self.lanes
        return [e.load(e.advance(base, I64(WIDTH * row), DOUBLE), DOUBLE, WIDTH) for row in rows]

    def _dot(self, x: Sequence[Value], y: Sequence[Value]) -> Value:
        total = None
        for a, b in zip(x, y, strict=True):
            total = self.lanes.multiply_add(a, b, total)
        return total

    def _clipped(self, ray: _Ray, base: Value, q: list[Value], behind: Value) -> tuple[Value, Value, Value]:
        """Between which ρ rays are in the ball, between all planes and within their ends, and a mask: if ever."""
        e, b = self.lanes, self.builder
        rest = e.subtract(self._rows(base, [SQUARE])[0], self._dot(q, q))
        zero = e.constant(0)
        valid, half = b.fcmp_ordered(">=", rest, zero), e.square_root(rest)
        near = e.maximum(e.subtract(ray.first, behind), e.negate(half))
        far = e.minimum(e.subtract(ray.last, behind), half)
        for plane in range(self.variant.planes):
            *normal, d = self._rows(base, range(PLANES + 4 * plane, PLANES + 4 * plane + 4))
            speed, height = self._dot(normal, ray.along), e.add(self._dot(normal, q), d)
            at = e.divide(e.negate(height), speed)
            near = e.where(e.less(speed, zero), e.maximum(at, near), near)
            far = e.where(e.less(zero, speed), e.minimum(at, far), far)
            beside = b.and_(b.fcmp_ordered("==", speed, zero), e.less(zero, height))
            valid = b.and_(valid, b.not_(beside))
        return near, far, valid

    def _roots(self, ray: _Ray, base: Value, q: list[Value], entry: Value) -> tuple[Value, Value, Value]:
        """ρ of front and back, and a mask of those that are one; as `ops.reference.quadrics` says."""
        e, b = self.lanes, self.builder
        matrix, vector = self._rows(base, range(MATRIX.stop)), self._rows(base, range(VECTOR.start, VECTOR.stop))
        (c,), (size_a, size_b) = self._rows(base, [CONSTANT]), self._rows(base, range(SIZES.start, SIZES.stop))
        turned = self._times(matrix, q)
        alpha = self._dot(ray.along, self._times(matrix, ray.along))
        force = [e.add(x, y) for x, y in zip(turned, vector, strict=True)]
        beta = self._dot(ray.along, force)
        gamma = e.add(self._dot(q, [e.add(x, y) for x, y in zip(force, vector, strict=True)]), c)
        reach = e.square_root(self._dot(q, q))
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

    def _times(self, matrix: Sequence[Value], x: Sequence[Value]) -> list[Value]:
        xx, yy, zz, xy, xz, yz = matrix
        return [self._dot(row, x) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]

    # --- hits ---

    def _take(self, ray: _Ray, leaf: Value, tau: Value, hit: Value) -> None:
        """Those of a mask that come before the ray's last hit."""
        e, b = self.lanes, self.builder
        sooner = b.and_(hit, b.fcmp_ordered("<", tau, e.everywhere(self.limit.value)))
        self.bits.value = b.bitcast(sooner, I8)
        with e.repeat_while(lambda: b.icmp_unsigned("!=", self.bits.value, I8(0))):
            lane = b.cttz(self.bits.value, ir.IntType(1)(0))
            self.bits.value = b.xor(self.bits.value, b.shl(I8(1), lane))
            place = b.add(b.mul(leaf, I64(WIDTH)), b.zext(lane, I64))
            self._insert(ray, b.extract_element(tau, b.zext(lane, I32)), place)

    def _insert(self, ray: _Ray, tau: Value, place: Value) -> None:
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
                return b.and_(some, b.fcmp_ordered("<", tau, self._number(ray.tau, safe)))

            with e.repeat_while(goes_before):
                slot, before = self.slot.value, b.sub(self.slot.value, I64(1))
                b.store(self._number(ray.tau, before), e.advance(ray.tau, slot, DOUBLE))
                moved = b.load(e.advance(ray.places, before, I64), typ=I64)
                b.store(moved, e.advance(ray.places, slot, I64))
                self.slot.value = before
            b.store(tau, e.advance(ray.tau, self.slot.value, DOUBLE))
            b.store(place, e.advance(ray.places, self.slot.value, I64))
            self.limit.value = self._number(ray.tau, last)
