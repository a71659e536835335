"""The program that casts rays at bilinear quadrilaterals, in Triton: what `ops.reference.bilinear` says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from filterlab.ops.bilinear import ACROSS, CENTER, CORNER, LENGTH, MEETING, PLACE, SQUARE, TWIST, UP
from filterlab.ops.cuda.source import Source, any_of, number
from filterlab.ops.cuda.tree_walk import ARRAYS, AXES, ROWS, InLeaf, Walk, dot, first_hits
from filterlab.ops.quadrics import Kept


@dataclass(frozen=True)
class BilinearVariant:
    """Everything a program depends on, see `tree_walk.Variant`.

    Attributes:
        kept: which hits count.
    """

    kept: Kept

    @property
    def arrays(self) -> tuple[str, ...]:
        return (*ARRAYS, *ROWS)

    @property
    def scalars(self) -> tuple[str, ...]:
        return ("sheets",)

    def write(self) -> Source:
        walk = Walk("bilinear_hits", ROWS, self.scalars, _PatchInLeaf(self.kept))
        walk.begin()
        first_hits(walk)
        return walk.source


class _PatchInLeaf(InLeaf):
    """Q is `corner`, a, d, h are `across`, `up`, `twist`; L, and by what places are off, `length` and `off_place`."""

    rows = PLACE + 1

    def __init__(self, kept: Kept) -> None:
        self.kept = kept

    def write(self, walk: Walk, take: Callable[[], None]) -> None:
        walk.from_center(CENTER)
        walk.row("square", SQUARE)
        walk.text("valid = at_leaf & (square >= reach)")
        with walk.source.block(f"if {any_of('valid')}"):
            _less_parallel(walk)
            _roots(walk)
            with walk.source.block("for side in range(2)"):
                walk.text(f"""
                    u = tl.where(side == 0, front, back)
                    counted = tl.where(side == 0, {self._counts(0)}, {self._counts(1)})
                """)
                _along(walk)
                walk.text("""
                    tau = root + behind
                    hit = valid & counted & within & (root >= own_first - behind) & (root <= own_last - behind)
                """)
                take()

    def _counts(self, side: int) -> str:
        """Which fronts count, side 0, or backs, which change places where `turned`."""
        falls, rises, touches = self.kept
        straight = falls if side == 0 else rises
        counts = "~single" if falls and rises else "~single & ~turned" if straight else "~single & turned"
        return f"single | {counts}" if touches and side == 0 else counts


def _less_parallel(walk: Walk) -> None:
    """a and d in that order in which D is less parallel to d and d + h; where they changed places, `turned`."""
    for name, numbers in (("corner", CORNER), ("across", ACROSS), ("up", UP), ("twist", TWIST)):
        walk.vector(name, numbers)
    walk.row("length", LENGTH)
    walk.row("off_place", PLACE)
    for line in ("across", "up"):
        _line(walk, "edge", line, "1.0", "twist")
        _cross(walk, "begins_off", "along", line)
        _cross(walk, "ends_off", "along", "edge")
        walk.text(f"""
            begins_by = {dot("begins_off", "begins_off")}
            ends_by = {dot("ends_off", "ends_off")}
            {line}_apart = tl.where(ends_by < begins_by, ends_by, begins_by)
        """)
    walk.text("turned = across_apart > up_apart")
    for a in AXES:
        walk.text(f"""
            corner_{a} = q_{a} - corner_{a}
            first_{a} = tl.where(turned, up_{a}, across_{a})
            second_{a} = tl.where(turned, across_{a}, up_{a})
        """)


def _roots(walk: Walk) -> None:
    """`front`, `back`, `single`, and by what they are off, `off`."""
    _cross(walk, "moment", "corner", "along")
    _cross(walk, "aside", "first", "along")
    walk.text(f"""
        gamma = {dot("moment", "second")}
        alpha = -({dot("aside", "twist")})
        beta = ({dot("moment", "twist")} - ({dot("aside", "second")})) / 2.0
        rounding = length * off_place
        radicand = beta * beta - alpha * gamma
        most_size = tl.maximum(tl.maximum(tl.abs(alpha), tl.abs(beta)), tl.abs(gamma))
        slack = rounding * (tl.abs(alpha) + 2.0 * tl.abs(beta) + tl.abs(gamma))
        single = tl.abs(radicand) <= slack
    """)
    walk.stable_roots()
    walk.text("""
        front = tl.where(single, -beta / alpha, front)
        off = tl.where(single, tl.sqrt(slack) / tl.abs(alpha), rounding / (2.0 * s))
    """)
    _clamped(walk, "clamped", "front")
    walk.text(f"""
        meets = tl.abs((alpha * clamped + 2.0 * beta) * clamped + gamma) <= {number(MEETING)} * rounding
        valid = valid & (most_size > rounding) & ((single & meets) | (~single & (radicand > 0.0)))
    """)


def _along(walk: Walk) -> None:
    """`root`, ρ where rays meet the lines at `u`, and `within`: where u and v are in [0, 1]."""
    walk.text("within = (u >= -off) & (u <= 1.0 + off)")
    _clamped(walk, "u", "u")
    _line(walk, "line", "second", "u", "twist")
    for a in AXES:
        walk.text(f"way_{a} = u * first_{a} - corner_{a}")
    _cross(walk, "n", "along", "line")
    _cross(walk, "aside", "way", "along")
    walk.text(f"""
        n_square = {dot("n", "n")}
        v = ({dot("aside", "n")}) / n_square
    """)
    _clamped(walk, "clamped", "v")
    _line(walk, "point", "way", "clamped", "line")
    _line(walk, "edge", "first", "clamped", "twist")
    _cross(walk, "aside", "along", "edge")
    walk.text(f"""
        moved = 3.0 * tl.where(off < 1.0, off, 1.0) * tl.sqrt({dot("edge", "edge")})
        near_edge = tl.abs(v - clamped) * tl.sqrt(n_square) <= off_place + moved
        meets = tl.abs({dot("point", "aside")}) <= {number(MEETING)} * rounding
        within = within & ((v == clamped) | (near_edge & meets))
        root = {dot("point", "along")}
    """)


def _clamped(walk: Walk, name: str, x: str) -> None:
    """To [0, 1]."""
    walk.text(f"""
        {name} = tl.where({x} > 0.0, {x}, 0.0)
        {name} = tl.where({name} < 1.0, {name}, 1.0)
    """)


def _line(walk: Walk, name: str, start: str, at: str, way: str) -> None:
    for a in AXES:
        walk.text(f"{name}_{a} = {start}_{a} + {at} * {way}_{a}")


def _cross(walk: Walk, name: str, x: str, y: str) -> None:
    for a, b, c in zip(AXES, AXES[1:] + AXES[:1], AXES[2:] + AXES[:2], strict=True):
        walk.text(f"{name}_{a} = {x}_{b} * {y}_{c} - {x}_{c} * {y}_{b}")
