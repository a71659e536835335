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
from filterlab.ops.cuda.polynomials import TINY, FirstRoot
from filterlab.ops.cuda.restriction import Restriction, Section
from filterlab.ops.cuda.source import Source, number
from filterlab.ops.cuda.taps import AXES
from filterlab.ops.cuda.tetrahedral_restriction import TetrahedralRestriction
from filterlab.ops.raycast import JUMP, REPEATED, Written
from filterlab.ops.tetrahedra import LoweredStencil, TetrahedralStencil

ARRAYS = ("coefficients", *cells.ARRAYS)
SIZES = ("width", "height", *cells.SIZES, "capacity")
NUMBERS = (*cells.NUMBERS, "gain", "shift")
"""f − level is gain · sum + shift."""


@dataclass(frozen=True)
class RaycastVariant:
    """Everything a program depends on; can be hashed.

    Attributes:
        asked: "first" or "candidates".
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
        """Arrays that are written: t (R,); or those of `ops.raycast.Written`."""
        return ("t",) if self.asked == "first" else Written._fields

    def write(self) -> Source:
        return (_First if self.asked == "first" else _Candidates)(self).write()


class _Program:
    """What both have in common: rays, cells, pieces."""

    def __init__(self, variant: RaycastVariant) -> None:
        self.variant, self.degree = variant, variant.degree
        parameters = (*ARRAYS, *variant.own, *SIZES, "BLOCK: tl.constexpr")
        self.source = Source(f"raycast_{variant.asked}", parameters)
        self.line = self.source.line
        self.walk = Walk(self.source)
        self.restriction = self._restriction_of(variant.stencil)
        self.search = FirstRoot(self.source, variant.degree, variant.arithmetic)
        self.rows = [f"row_{i}" for i in range(variant.degree + 1)]

    waiting = "(ray < 0)"
    """A mask of rays that need not go on."""

    def _restriction_of(self, stencil: LoweredStencil) -> Restriction | TetrahedralRestriction:
        if isinstance(stencil, TetrahedralStencil):
            return TetrahedralRestriction(self.source, stencil)
        return Restriction(self.source, stencil, self.degree)

    def begin(self) -> None:
        """Before the first cell."""
        raise NotImplementedError

    def take(self, section: Section) -> None:
        """Pieces that may hold a hit: those of rays under the mask `holds`."""
        raise NotImplementedError

    def end(self) -> None:
        """All rays have ended."""
        raise NotImplementedError

    def write(self) -> Source:
        line = self.line
        line(f"arithmetic = tl.{self.variant.arithmetic}")
        for name in ("gain", "shift"):
            line(f"{name} = tl.load(numbers + {NUMBERS.index(name)}).to(arithmetic)")
        line("width, height = width.to(tl.int64), height.to(tl.int64)")
        line("nothing = tl.full((BLOCK,), 0.0, arithmetic)")
        self.walk.begin()
        line("ended_at = start * 0.0 - 1.0")
        line("before = nothing")
        self.begin()
        searching = f"going & ~{self.waiting}"
        with self.walk.while_any(searching):
            self.walk.next_cells(searching)
            with self.walk.if_any("found"):
                self._in_cells()
                with self.restriction.every("row", "found", self.waiting) as section:
                    self._piece(section)
                    with self.walk.if_any("holds"):
                        self.take(section)
        self.end()
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
        line(f"smallest, largest = {rows[0]}, {rows[0]}")
        for row in rows[1:]:
            line(f"smallest = {smaller('smallest', row)}")
            line(f"largest = {larger('largest', row)}")
        line(f"holds = {section.mask} & whole & (((smallest <= 0.0) & (largest >= 0.0)) | jump)")

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


class _First(_Program):
    """Every ray waits at its first hit, and all of a warp are searched together."""

    waiting = "hit"

    def begin(self) -> None:
        self.search.begin()
        self.line("hit = inside & (ray < 0)")
        self.line("at_start, at_end = hit, hit")
        self.line("hit_near, hit_far = s, s")

    def take(self, section: Section) -> None:
        """Keep pieces for the root search, if they have a root."""
        line, rows = self.line, self.rows
        end, tiny = rows[-1], number(TINY[self.variant.arithmetic])
        line(f"begins = {rows[0]} == 0.0")
        line(f"sign = tl.where({rows[0]} < 0.0, nothing - 1.0, nothing + 1.0)")
        for row in rows:
            line(f"{row} = sign * {row}")
        line(f"on_end = {end} == 0.0  # a root for the case that there is no earlier one")
        line(f"{end} = tl.where(on_end, {tiny}, {end})")
        line("begins = holds & (jump | begins)")
        line("inner = holds & ~begins")
        self.search.count_changes(self.search.lower("lowered", rows))
        line(f"simple = inner & (changes == 1) & ({end} < 0.0)")
        self.search.assign("simple", rows, "nothing", "(nothing + 1.0)")
        line("met = begins | simple")
        line("hard = inner & ~simple")
        with self.walk.if_any("hard"):
            self.search.first_part("hard", rows, "met")
        line("ends = hard & on_end & ~met")
        line("met = met | ends")
        line("hit, at_start, at_end = hit | met, at_start | begins, at_end | ends")
        line(f"hit_near = tl.where(met, {section.near}, hit_near)")
        line(f"hit_far = tl.where(met, {section.far}, hit_far)")

    def end(self) -> None:
        line = self.line
        line("inner = hit & ~(at_start | at_end)")
        line("within = nothing")
        with self.walk.if_any("inner"):
            self.search.root("inner")
            line("within = root * part_h + part_a")
        line("within = tl.where(at_start, 0.0, tl.where(at_end, 1.0, within)).to(tl.float64)")
        line("s = (hit_far - hit_near) * within + hit_near")
        line(f"s = {larger('s', 'hit_near')}")
        line(f"s = {smaller('s', 'hit_far')}")
        line("tl.store(t + ray, tl.where(hit, (start + s) * scale, infinity), inside)")


class _Candidates(_Program):
    """Every piece that may hold a hit is written down, as far as there is room; all are counted."""

    def begin(self) -> None:
        self.line("capacity = capacity.to(tl.int64)")
        self.line("many = ray * 0")

    def take(self, section: Section) -> None:
        line = self.line
        line("room = holds & (many < capacity)")
        line("slot = ray * capacity + many")
        for k, name in enumerate(("start", section.near, section.far)):
            line(f"tl.store(places + 3 * slot + {k}, {name} * scale, room)")
        for i, row in enumerate(self.rows):
            line(f"tl.store(pieces + {len(self.rows)} * slot + {i}, {row}, room)")
        line(f"flag_ = tl.where(jump, {JUMP}, 0) + tl.where(repeated, {REPEATED}, 0)")
        line("tl.store(flags + slot, flag_.to(tl.uint8), room)")
        line("many += holds.to(tl.int64)")

    def end(self) -> None:
        self.line("tl.store(count + ray, many, inside)")
