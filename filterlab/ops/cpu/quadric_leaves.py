"""Rays and the quadrics in a leaf, eight at a time, as programs write it: what `ops.reference.quadrics` says.

The radicand is taken by fused multiply-add (Kahan's difference of products).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from filterlab.ops.cpu.lanes import DOUBLE, I64, Value
from filterlab.ops.cpu.tree_walk import EPS, Ray, Walk, WalkVariant
from filterlab.ops.quadrics import CENTER, CONSTANT, MATRIX, PLANES, ROUNDINGS, SIZES, SQUARE, VECTOR
from filterlab.ops.tree import WIDTH


class QuadricLeavesVariant(WalkVariant, Protocol):
    """What programs depend on in whose leaves quadrics are.

    Attributes:
        planes: H.
    """

    @property
    def planes(self) -> int: ...


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


class QuadricLeaves(Walk):
    variant: QuadricLeavesVariant

    def quadrics(self, ray: Ray, leaf: Value, take: Take) -> None:
        """Tells of fronts, then of backs, in a leaf."""
        e, b = self.lanes, self.builder
        size = WIDTH * (PLANES + 4 * self.variant.planes)
        base = e.advance(self.job.leaves, b.mul(leaf, I64(size)), DOUBLE)
        q, behind = self.from_center(ray, self.rows(base, range(CENTER.start, CENTER.stop)))
        near, far, valid = self._clipped(ray, base, q, behind)
        valid = b.and_(valid, b.fcmp_ordered("<=", near, far))
        with b.if_then(e.any(valid)):
            front, back, one = self._roots(ray, base, q, far if self.variant.reversed else near)
            for root, counted in zip((front, back), self.counted(one), strict=True):
                within = b.and_(b.fcmp_ordered(">=", root, near), b.fcmp_ordered("<=", root, far))
                take(ray, Met(leaf, base, q, behind), root, b.and_(b.and_(within, counted), valid))

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
        radicand = self.difference(beta, alpha, gamma)
        a, g, h = (e.absolute(x) for x in (alpha, gamma, beta))
        rounding = e.constant(ROUNDINGS * EPS)
        slack = e.multiply_add(e.multiply(e.constant(2), h), size_beta, e.multiply(size_a, g))
        slack = e.multiply(rounding, e.multiply_add(a, size_gamma, slack))
        no_more = lambda x, size: b.fcmp_ordered("<=", x, e.multiply(rounding, size))  # noqa: E731
        on = b.and_(b.and_(no_more(a, size_a), no_more(h, size_beta)), no_more(g, size_gamma))
        touches = b.fcmp_ordered("<=", e.absolute(radicand), slack)
        front, back = self.stable_roots(alpha, beta, gamma, e.square_root(radicand))
        front = e.where(touches, e.divide(e.negate(beta), alpha), front)
        return e.where(on, entry, front), back, b.or_(on, touches)

    def times(self, matrix: Sequence[Value], x: Sequence[Value]) -> list[Value]:
        xx, yy, zz, xy, xz, yz = matrix
        return [self.dot(row, x) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]
