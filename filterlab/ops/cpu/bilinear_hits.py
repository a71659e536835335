"""The program that casts rays at bilinear quadrilaterals, eight at a time: what `ops.reference.bilinear` says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from llvmlite import ir

from filterlab.ops.bilinear import ACROSS, CENTER, CORNER, LENGTH, MEETING, PLACE, SQUARE, TWIST, UP
from filterlab.ops.cpu.lanes import DOUBLE, I64, Value
from filterlab.ops.cpu.tree_walk import Ray, Rows, RowsVariant
from filterlab.ops.tree import WIDTH

_ROWS = PLACE + 1


class BilinearVariant(RowsVariant):
    """See `ops.cpu.tree_walk.RowsVariant`."""

    def program(self, function: ir.Function) -> Rows:
        return _Program(self, function)


class _Line(NamedTuple):
    """Eight vectors x, and D × x."""

    x: list[Value]
    crossed: list[Value]


class _Patch(NamedTuple):
    """Eight patches and a ray: Q, D; a, d, h; L; what places are off by."""

    from_corner: list[Value]
    along: list[Value]
    across: _Line
    up: _Line
    twist: _Line
    length: Value
    place: Value


class _Program(Rows):
    def leaf(self, ray: Ray, leaf: Value) -> None:
        e, b = self.lanes, self.builder
        base = e.advance(self.job.leaves, b.mul(leaf, I64(WIDTH * _ROWS)), DOUBLE)
        q, behind = self.from_center(ray, self._vector(base, CENTER))
        near, far = e.subtract(ray.first, behind), e.subtract(ray.last, behind)
        valid = b.fcmp_ordered("<=", self.dot(q, q), self.rows(base, [SQUARE])[0])
        with b.if_then(e.any(valid)):
            patch, turned = self._less_parallel(base, ray, q)
            front, back, one, off, met = self._roots(patch)
            for root, counted in zip((front, back), self.counted(one, turned), strict=True):
                rho, within = self._along(patch, root, off)
                within = b.and_(within, b.and_(b.fcmp_ordered(">=", rho, near), b.fcmp_ordered("<=", rho, far)))
                self.take(leaf, e.add(rho, behind), b.and_(b.and_(within, counted), b.and_(valid, met)))

    def _vector(self, base: Value, rows: slice) -> list[Value]:
        return self.rows(base, range(rows.start, rows.stop))

    def _less_parallel(self, base: Value, ray: Ray, q: list[Value]) -> tuple[_Patch, Value]:
        """Patches with a and d in that order in which D is less parallel to d and d + h; where they changed places."""
        e, b = self.lanes, self.builder
        vectors = (self._vector(base, rows) for rows in (ACROSS, UP, TWIST))
        across, up, twist = (_Line(x, self._cross(ray.along, x)) for x in vectors)
        apart = [self._apart(line, twist) for line in (across, up)]
        turned = b.fcmp_ordered(">", apart[0], apart[1])
        first, second = (self._either(turned, *pair) for pair in ((up, across), (across, up)))
        corner = self._vector(base, CORNER)
        from_corner = [e.subtract(x, c) for x, c in zip(q, corner, strict=True)]
        length, place = self.rows(base, [LENGTH, PLACE])
        return _Patch(from_corner, ray.along, first, second, twist, length, place), turned

    def _apart(self, line: _Line, twist: _Line) -> Value:
        """|D × x|² of that of the edges x and x + h which D is more parallel to."""
        e = self.lanes
        other = [e.add(x, t) for x, t in zip(line.crossed, twist.crossed, strict=True)]
        return e.minimum(self._square(line.crossed), self._square(other))

    def _either(self, mask: Value, one: _Line, other: _Line) -> _Line:
        return _Line(
            *([self.lanes.where(mask, x, y) for x, y in zip(*p, strict=True)] for p in zip(one, other, strict=True))
        )

    def _roots(self, patch: _Patch) -> tuple[Value, Value, Value, Value, Value]:
        """u of front and back; masks of those that are one, and by what they are off; a mask of rays that meet any."""
        e, b = self.lanes, self.builder
        moment = self._cross(patch.from_corner, patch.along)
        gamma, alpha = self.dot(moment, patch.up.x), self.dot(patch.across.crossed, patch.twist.x)
        twice = e.add(self.dot(moment, patch.twist.x), self.dot(patch.across.crossed, patch.up.x))
        beta = e.multiply(e.constant(0.5), twice)
        rounding = e.multiply(patch.length, patch.place)
        radicand = self.difference(beta, alpha, gamma)
        a, h, g = (e.absolute(x) for x in (alpha, beta, gamma))
        slack = e.multiply(rounding, e.multiply_add(e.constant(2), h, e.add(a, g)))
        s, touches = e.square_root(radicand), b.fcmp_ordered("<=", e.absolute(radicand), slack)
        front, back = self.stable_roots(alpha, beta, gamma, s)
        front = e.where(touches, e.divide(e.negate(beta), alpha), front)
        by_root = e.divide(rounding, e.multiply(e.constant(2), s))
        off = e.where(touches, e.divide(e.square_root(slack), a), by_root)
        met = b.fcmp_ordered(">", e.maximum(e.maximum(a, h), g), rounding)
        u = e.clamp(front, e.constant(0), e.constant(1))
        rest = e.multiply_add(e.multiply_add(alpha, u, e.multiply(e.constant(2), beta)), u, gamma)
        beside = b.fcmp_ordered(">", e.absolute(rest), e.multiply(e.constant(MEETING), rounding))
        return front, back, touches, off, b.and_(met, b.not_(b.and_(touches, beside)))

    def _along(self, patch: _Patch, u: Value, off: Value) -> tuple[Value, Value]:
        """ρ where rays meet the lines at u, and a mask: where u and v are in [0, 1]."""
        e, b = self.lanes, self.builder
        within = self._in_unit(u, off)
        u = e.clamp(u, e.constant(0), e.constant(1))
        line, n = self._line(patch.up, u, patch.twist)
        way = [e.subtract(e.multiply(u, x), c) for x, c in zip(patch.across.x, patch.from_corner, strict=True)]
        square = self._square(n)
        v = e.divide(self.dot(self._cross(way, patch.along), n), square)
        inner = e.clamp(v, e.constant(0), e.constant(1))
        point = [e.multiply_add(inner, x, w) for x, w in zip(line, way, strict=True)]
        by = e.multiply(e.absolute(e.subtract(v, inner)), e.square_root(square))
        at_edge = self._at_edge(patch, point, self._line(patch.across, inner, patch.twist), off, by)
        return self.dot(point, patch.along), b.and_(within, b.or_(b.fcmp_ordered("==", v, inner), at_edge))

    def _at_edge(self, patch: _Patch, point: list[Value], edge: _Line, off: Value, by: Value) -> Value:
        """Where rays that pass by S(u, v), at the edge of a patch, meet the edge, u and places being so far off."""
        e, b = self.lanes, self.builder
        length = e.square_root(self._square(edge.x))
        reach = e.multiply_add(e.multiply(e.constant(3), e.minimum(off, e.constant(1))), length, patch.place)
        apart = e.absolute(self.dot(point, edge.crossed))
        rounding = e.multiply(e.constant(MEETING), e.multiply(patch.length, patch.place))
        return b.and_(b.fcmp_ordered("<=", by, reach), b.fcmp_ordered("<=", apart, rounding))

    def _line(self, start: _Line, at: Value, way: _Line) -> _Line:
        e = self.lanes
        return _Line(
            *([e.multiply_add(at, w, s) for s, w in zip(*p, strict=True)] for p in zip(start, way, strict=True))
        )

    def _in_unit(self, x: Value, off: Value) -> Value:
        e, b = self.lanes, self.builder
        low, high = e.negate(off), e.add(e.constant(1), off)
        return b.and_(b.fcmp_ordered(">=", x, low), b.fcmp_ordered("<=", x, high))

    def _square(self, x: Sequence[Value]) -> Value:
        return self.dot(x, x)

    def _cross(self, x: Sequence[Value], y: Sequence[Value]) -> list[Value]:
        e = self.lanes
        pairs = ((1, 2), (2, 0), (0, 1))
        return [e.multiply_add(x[i], y[j], e.negate(e.multiply(x[j], y[i]))) for i, j in pairs]
