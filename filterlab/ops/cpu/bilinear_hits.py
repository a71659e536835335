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


class _Patch(NamedTuple):
    """Eight patches and a ray: Q, a, d, h, D; L; what places are off by."""

    from_corner: list[Value]
    across: list[Value]
    up: list[Value]
    twist: list[Value]
    along: list[Value]
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
        across, up, twist = (self._vector(base, rows) for rows in (ACROSS, UP, TWIST))
        edges = (self._edges(line, twist) for line in (across, up))
        apart = [e.minimum(*(self._square(self._cross(ray.along, x)) for x in pair)) for pair in edges]
        turned = b.fcmp_ordered(">", apart[0], apart[1])
        first, second = ([e.where(turned, x, y) for x, y in zip(*p, strict=True)] for p in ((up, across), (across, up)))
        corner = self._vector(base, CORNER)
        from_corner = [e.subtract(x, c) for x, c in zip(q, corner, strict=True)]
        length, place = self.rows(base, [LENGTH, PLACE])
        return _Patch(from_corner, first, second, twist, ray.along, length, place), turned

    def _edges(self, line: list[Value], twist: list[Value]) -> tuple[list[Value], list[Value]]:
        """The two that lines of a family begin and end with."""
        return line, [self.lanes.add(x, t) for x, t in zip(line, twist, strict=True)]

    def _roots(self, patch: _Patch) -> tuple[Value, Value, Value, Value, Value]:
        """u of front and back; masks of those that are one, and by what they are off; a mask of rays that meet any."""
        e, b = self.lanes, self.builder
        moment, side = self._cross(patch.from_corner, patch.along), self._cross(patch.across, patch.along)
        gamma, alpha = self.dot(moment, patch.up), e.negate(self.dot(side, patch.twist))
        beta = e.multiply(e.constant(0.5), e.subtract(self.dot(moment, patch.twist), self.dot(side, patch.up)))
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
        line = self._line(patch.up, u, patch.twist)
        way = [e.subtract(e.multiply(u, x), c) for x, c in zip(patch.across, patch.from_corner, strict=True)]
        n = self._cross(patch.along, line)
        square = self._square(n)
        v = e.divide(self.dot(self._cross(way, patch.along), n), square)
        inner = e.clamp(v, e.constant(0), e.constant(1))
        point, edge = self._line(way, inner, line), self._line(patch.across, inner, patch.twist)
        by = e.multiply(e.absolute(e.subtract(v, inner)), e.square_root(square))
        on_line = b.or_(b.fcmp_ordered("==", v, inner), self._at_edge(patch, point, edge, off, by))
        return self.dot(point, patch.along), b.and_(within, on_line)

    def _at_edge(self, patch: _Patch, point: list[Value], edge: list[Value], off: Value, by: Value) -> Value:
        """Where rays that pass by S(u, v), at the edge of a patch, meet the edge, u and places being so far off."""
        e, b = self.lanes, self.builder
        length = e.square_root(self._square(edge))
        reach = e.multiply_add(e.multiply(e.constant(3), e.minimum(off, e.constant(1))), length, patch.place)
        apart = e.absolute(self.dot(point, self._cross(patch.along, edge)))
        rounding = e.multiply(e.constant(MEETING), e.multiply(patch.length, patch.place))
        return b.and_(b.fcmp_ordered("<=", by, reach), b.fcmp_ordered("<=", apart, rounding))

    def _line(self, start: list[Value], at: Value, way: list[Value]) -> list[Value]:
        return [self.lanes.multiply_add(at, w, s) for s, w in zip(start, way, strict=True)]

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
