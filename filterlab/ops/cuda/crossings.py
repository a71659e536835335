"""The programs that cast rays at a level in Triton: rays in, hits out; or the pieces that may hold one.

The plan is that of `ops.cpu.crossings`, with a warp in place of a pack: every ray walks to its next cell that may hold
the level (`cells`), the sum is restricted to the ray's part there (`restriction`; of splines on tetrahedra to one part
after the other, `tetrahedral_restriction`), and where it changes its sign once the ray waits for one root search of the
whole warp (`polynomials`).
"""

from __future__ import annotations

from dataclasses import dataclass

from filterlab.ops.cuda import cells
from filterlab.ops.cuda.cells import Walk, larger, smaller
from filterlab.ops.cuda.hits import straddle, taker
from filterlab.ops.cuda.restriction import Restriction, Section
from filterlab.ops.cuda.source import Source
from filterlab.ops.cuda.taps import AXES
from filterlab.ops.cuda.tetrahedral_restriction import TetrahedralRestriction
from filterlab.ops.raycast import Written
from filterlab.ops.tetrahedra import LoweredStencil, TetrahedralStencil

ARRAYS = ("coefficients", *cells.ARRAYS)
SIZES = ("width", "height", *cells.SIZES, "capacity", "most")
"""capacity: candidates or sheets of a ray that there is room for; most: sheets behind which no more are looked for."""

NUMBERS = (*cells.NUMBERS, "gain", "shift", "extent")
"""f − level is gain · sum + shift; extent: the diagonal of the domain, in the world."""


@dataclass(frozen=True)
class RaycastVariant:
    """Everything a program depends on; can be hashed.

    Attributes:
        asked: "first", "candidates" or "sheets".
        stencil: what is summed, one row.
        degree: n, along a ray.
        continuous: whether polynomials of neighbouring cells agree where they meet.
        arithmetic: "float32" or "float64": of rays and polynomials.
    """

    asked: str
    stencil: LoweredStencil
    degree: int
    continuous: bool
    arithmetic: str

    @property
    def own(self) -> tuple[str, ...]:
        """Arrays that are written: t (R,), or (R, k), and count (R,); or those of `ops.raycast.Written`."""
        return {"first": ("t",), "sheets": ("t", "count"), "candidates": Written._fields}[self.asked]

    def write(self) -> Source:
        return _Program(self).write()


class _Program:
    """Rays, cells, pieces; `hits` has what becomes of these."""

    def __init__(self, variant: RaycastVariant) -> None:
        self.variant, self.degree = variant, variant.degree
        parameters = (*ARRAYS, *variant.own, *SIZES, "BLOCK: tl.constexpr")
        self.source = Source(f"raycast_{variant.asked}", parameters)
        self.line = self.source.line
        self.walk = Walk(self.source)
        self.restriction = self._restriction_of(variant.stencil)
        self.rows = [f"row_{i}" for i in range(variant.degree + 1)]
        self.taker = taker(self.source, variant.asked, variant.degree, variant.arithmetic)

    def _restriction_of(self, stencil: LoweredStencil) -> Restriction | TetrahedralRestriction:
        if isinstance(stencil, TetrahedralStencil):
            return TetrahedralRestriction(self.source, stencil)
        return Restriction(self.source, stencil, self.degree)

    def write(self) -> Source:
        line = self.line
        line(f"arithmetic = tl.{self.variant.arithmetic}")
        for name in ("gain", "shift"):
            line(f"{name} = tl.load(numbers + {NUMBERS.index(name)}).to(arithmetic)")
        line(f"extent = tl.load(numbers + {NUMBERS.index('extent')})")
        line("width, height = width.to(tl.int64), height.to(tl.int64)")
        line("nothing = tl.full((BLOCK,), 0.0, arithmetic)")
        self.walk.begin()
        line("ended_at = start * 0.0 - 1.0")
        line("before = nothing")
        self.taker.begin()
        searching = f"going & ~{self.taker.waiting}"
        with self.taker.rounds(), self.walk.while_any(searching):
            self.walk.next_cells(searching)
            with self.walk.if_any("found"):
                self._in_cells()
                with self.restriction.every("row", "found", self.taker.done) as section:
                    self._piece(section)
                    with self.walk.if_any("holds"):
                        self.taker.take(self.rows, section.near, section.far, "jump")
        self.taker.end()
        return self.source

    # --- pieces ---

    def _in_cells(self) -> None:
        """What `Restriction` finds of rays in their cells."""
        line = self.line
        for end, at in (("u", "near"), ("v", "far")):
            for a in AXES:
                line(f"{end}_{a} = entry_{a} + {at} * direction_{a} - at_{a}.to(tl.float64)")
                line(f"{end}_{a} = {smaller(larger(f'{end}_{a}', '0.0'), '1.0')}")
                line(f"{end}_{a} = {end}_{a}.to(arithmetic)")
        line("first = coefficients + ((at_z * height + at_y) * width + at_x)")

    def _piece(self, section: Section) -> None:
        """`row_0` …, coefficients of f − level; `jump`, `repeated` and `holds`, masks."""
        line, rows = self.line, self.rows
        for row in rows:
            line(f"{row} = {row} * gain + shift")
        line(f"whole = tl.abs({' + '.join(rows)}) < infinity")
        line(f"joined = {section.mask} & ({section.near} == ended_at) & (tl.abs(before) < infinity)")
        line(f"ended_at = tl.where({section.mask}, {section.far}, ended_at)")
        self._join(section)
        straddle(self.source, rows)
        line(f"holds = {section.mask} & whole & (straddles | jump)")

    def _join(self, section: Section) -> None:
        """To the piece before: with its last value, or with a jump; `repeated` where it begins on the level again."""
        line, (begin, *_, end) = self.line, self.rows
        if self.variant.continuous:
            line(f"{begin} = tl.where(joined, before, {begin})")
            line("jump = joined & (ray < 0)")
        else:
            line(f"jump = joined & (((before < 0.0) & ({begin} > 0.0)) | ((before > 0.0) & ({begin} < 0.0)))")
        line(f"repeated = joined & (before == 0.0) & ({begin} == 0.0)")
        line(f"before = tl.where({section.mask}, {end}, before)")
