"""Rays and a quadric in a leaf, as Triton programs write it: what `ops.reference.quadrics` says."""

from __future__ import annotations

from collections.abc import Callable

from filterlab.ops.cuda.source import number
from filterlab.ops.cuda.tree_walk import AXES, InLeaf, Walk, dot
from filterlab.ops.quadrics import CENTER, CONSTANT, MATRIX, PLANES, ROUNDINGS, SIZES, SQUARE, VECTOR, Kept

_ROUNDING = ROUNDINGS * 2.0**-52
_ENTRIES = ("xx", "yy", "zz", "xy", "xz", "yz")
_SYMMETRIC = (("xx", "xy", "xz"), ("xy", "yy", "yz"), ("xz", "yz", "zz"))


class QuadricInLeaf(InLeaf):
    """Of a hit there are `root`, ρ, `q`, `b`, `reach` and `square` too, and `times`.

    Args:
        planes: H.
        kept: which hits count.
        reversed: whether rays go the other way round.
    """

    def __init__(self, planes: int, kept: Kept, reversed: bool) -> None:
        self.planes, self.kept, self.reversed = planes, kept, reversed
        self.rows = PLANES + 4 * planes

    def write(self, walk: Walk, take: Callable[[], None]) -> None:
        walk.from_center(CENTER)
        self._clipped(walk)
        self._roots(walk)
        self._counted(walk, take)

    def _clipped(self, walk: Walk) -> None:
        """`low_end`, `high_end`: between which ρ a hit counts; `valid`."""
        walk.row("square", SQUARE)
        walk.text("""
            valid = at_leaf & (square >= reach)
            half = tl.sqrt(tl.where(valid, square - reach, 0.0))
            from_first = own_first - behind
            to_last = own_last - behind
            low_end = tl.where(-half > from_first, -half, from_first)
            high_end = tl.where(half < to_last, half, to_last)
        """)
        for plane in range(self.planes):
            begin = PLANES + 4 * plane
            walk.rows(("n_x", "n_y", "n_z", "n_d"), slice(begin, begin + 4))
            walk.text(f"""
                speed = {dot("n", "along")}
                height = {dot("n", "q")} + n_d
                at_plane = -height / tl.where(speed == 0.0, 1.0, speed)
                low_end = tl.where((speed < 0.0) & (at_plane > low_end), at_plane, low_end)
                high_end = tl.where((speed > 0.0) & (at_plane < high_end), at_plane, high_end)
                valid = valid & ~((speed == 0.0) & (height > 0.0))
            """)
        walk.text("valid = valid & (low_end <= high_end)")

    def _roots(self, walk: Walk) -> None:
        """`front`, `back`, `single`."""
        walk.rows([f"a_{entry}" for entry in _ENTRIES], MATRIX)
        walk.vector("b", VECTOR)
        walk.row("c", CONSTANT)
        walk.rows(("size_a", "size_b"), SIZES)
        times(walk, "q", "turned")
        times(walk, "along", "ahead")
        entry = "high_end" if self.reversed else "low_end"
        walk.text(f"""
            alpha = {dot("along", "ahead")}
            beta = along_x * (turned_x + b_x) + along_y * (turned_y + b_y) + along_z * (turned_z + b_z)
            gamma = q_x * (turned_x + 2 * b_x) + q_y * (turned_y + 2 * b_y) + q_z * (turned_z + 2 * b_z) + c
            far_off = tl.sqrt(reach)
            size_beta = size_a * far_off + size_b
            size_gamma = far_off * (size_beta + size_b) + tl.abs(c)
            radicand = beta * beta - alpha * gamma
            slack = 2.0 * tl.abs(beta) * size_beta + size_a * tl.abs(gamma) + tl.abs(alpha) * size_gamma
        """)
        walk.stable_roots()
        walk.text(f"""
            touches = tl.abs(radicand) <= {number(_ROUNDING)} * slack
            lies = (tl.abs(alpha) <= {number(_ROUNDING)} * size_a) & (tl.abs(beta) <= {number(_ROUNDING)} * size_beta)
            lies = lies & (tl.abs(gamma) <= {number(_ROUNDING)} * size_gamma)
            touching = tl.where(alpha == 0.0, infinity, -beta / tl.where(alpha == 0.0, 1.0, alpha))
            front = tl.where(lies, {entry}, tl.where(touches, touching, front))
            single = lies | touches
            valid = valid & (single | (radicand > 0.0))
        """)

    def _counted(self, walk: Walk, take: Callable[[], None]) -> None:
        kept = self.kept
        for root, one, other in (("front", kept.touches, kept.falls), ("back", False, kept.rises)):
            if not (one or other):
                continue
            counts = " | ".join(text for text, asked in (("single", one), ("~single", other)) if asked)
            walk.text(f"""
                root = {root}
                hit = valid & ({counts}) & (root >= low_end) & (root <= high_end)
                tau = root + behind
            """)
            take()


def times(walk: Walk, vector: str, name: str) -> None:
    """A times a vector."""
    for a, row in zip(AXES, _SYMMETRIC, strict=True):
        terms = (f"a_{entry} * {vector}_{b}" for entry, b in zip(row, AXES, strict=True))
        walk.text(f"{name}_{a} = {' + '.join(terms)}")
