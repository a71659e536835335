"""What becomes of pieces of rays that may hold a hit, as Triton programs write it: one ray for each thread of a warp.

Names that the source must have: `nothing`, zeros of the arithmetic, and `infinity`; of rays `ray`, `inside`, `s`,
`start` and `scale`, so that t is (start + s) · scale. Pieces come with `holds`, a mask of rays, and `repeated`.
"""

from __future__ import annotations

from collections.abc import Sequence

from filterlab.ops.cuda.cells import larger, smaller
from filterlab.ops.cuda.polynomials import TINY, FirstRoot
from filterlab.ops.cuda.source import Source, any_of, number
from filterlab.ops.raycast import JUMP, REPEATED


def taker(source: Source, asked: str, degree: int, arithmetic: str) -> First | Every:
    """Of "first", "met" or "candidates"."""
    if asked == "candidates":
        return Every(source)
    return First(source, FirstRoot(source, degree, arithmetic), located=asked == "first")


def straddle(source: Source, rows: Sequence[str]) -> None:
    """`straddles`: coefficients lie on both sides of 0, or on it."""
    source.line(f"smallest, largest = {rows[0]}, {rows[0]}")
    for row in rows[1:]:
        source.line(f"smallest = {smaller('smallest', row)}")
        source.line(f"largest = {larger('largest', row)}")
    source.line("straddles = (smallest <= 0.0) & (largest >= 0.0)")


class First:
    """Every ray waits at its first hit, and all of a warp are searched together; t (R,) is written, ∞ where none is.

    Args:
        search: of roots.
        located: whether t is asked for; else it is that of a place in the piece with the hit.
    """

    waiting = "hit"
    """A mask of rays that need not go on."""

    def __init__(self, source: Source, search: FirstRoot, located: bool) -> None:
        self.source, self.line, self.search, self.located = source, source.line, search, located

    def begin(self) -> None:
        """Before the first piece."""
        self.search.begin()
        self.source.lines("""
            hit = inside & (ray < 0)
            at_start, at_end = hit, hit
            hit_near, hit_far = s, s
        """)

    def take(self, rows: Sequence[str], near: str, far: str, jump: str | None = None) -> None:
        """Keep pieces for the root search, if they have a root.

        Args:
            rows: coefficients, which are written to.
            near, far: where on the ray the piece begins and ends.
            jump: a mask of rays that hit where the piece begins, whatever its coefficients are.
        """
        line, end, tiny = self.line, rows[-1], number(TINY[self.search.arithmetic])
        line(f"begins = {rows[0]} == 0.0")
        line(f"sign = tl.where({rows[0]} < 0.0, nothing - 1.0, nothing + 1.0)")
        for row in rows:
            line(f"{row} = sign * {row}")
        line(f"on_end = {end} == 0.0  # a root for the case that there is no earlier one")
        line(f"{end} = tl.where(on_end, {tiny}, {end})")
        line(f"begins = holds & ({jump} | begins)" if jump else "begins = holds & begins")
        line("inner = holds & ~begins")
        self.search.count_changes(self.search.lower("lowered", rows))
        line(f"simple = inner & (changes == 1) & ({end} < 0.0)")
        self.search.assign("simple", rows, "nothing", "(nothing + 1.0)")
        line("met = begins | simple")
        line("hard = inner & ~simple")
        with self.source.block(f"if {any_of('hard')}"):
            self.search.first_part("hard", rows, "met")
        self.source.lines(f"""
            ends = hard & on_end & ~met
            met = met | ends
            hit, at_start, at_end = hit | met, at_start | begins, at_end | ends
            hit_near = tl.where(met, {near}, hit_near)
            hit_far = tl.where(met, {far}, hit_far)
        """)

    def end(self) -> None:
        """All rays have ended."""
        line = self.line
        line("inner = hit & ~(at_start | at_end)")
        line("within = nothing")
        if self.located:
            with self.source.block(f"if {any_of('inner')}"):
                self.search.root("inner")
                line("within = root * part_h + part_a")
        line("within = tl.where(at_start, 0.0, tl.where(at_end, 1.0, within)).to(tl.float64)")
        line("s = (hit_far - hit_near) * within + hit_near")
        line(f"s = {larger('s', 'hit_near')}")
        line(f"s = {smaller('s', 'hit_far')}")
        line("tl.store(t + ray, tl.where(hit, (start + s) * scale, infinity), inside)")


class Every:
    """Every piece that may hold a hit is written to arrays of `ops.raycast.Written`, as far as there is room."""

    waiting = "(ray < 0)"

    def __init__(self, source: Source) -> None:
        self.line = source.line

    def begin(self) -> None:
        """See `First`."""
        self.line("capacity = capacity.to(tl.int64)")
        self.line("many = ray * 0")

    def take(self, rows: Sequence[str], near: str, far: str, jump: str | None = None) -> None:
        """See `First`."""
        line = self.line
        line("room = holds & (many < capacity)")
        line("slot = ray * capacity + many")
        for k, name in enumerate(("start", near, far)):
            line(f"tl.store(places + 3 * slot + {k}, {name} * scale, room)")
        for i, row in enumerate(rows):
            line(f"tl.store(pieces + {len(rows)} * slot + {i}, {row}, room)")
        line(f"flag_ = tl.where(repeated, {REPEATED}, 0)" + (f" + tl.where({jump}, {JUMP}, 0)" if jump else ""))
        line("tl.store(flags + slot, flag_.to(tl.uint8), room)")
        line("many += holds.to(tl.int64)")

    def end(self) -> None:
        """See `First`."""
        self.line("tl.store(count + ray, many, inside)")
