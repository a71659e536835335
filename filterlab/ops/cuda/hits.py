"""What becomes of pieces of rays that may hold a hit, as Triton programs write it: one ray for each thread of a warp.

Names that the source must have: `nothing`, zeros of the arithmetic, and `infinity`; of rays `ray`, `inside`, `s`,
`start` and `scale`, so that t is (start + s) · scale. Pieces come with `holds`, a mask of rays, and `repeated`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

from filterlab.ops.cuda.cells import larger, smaller
from filterlab.ops.cuda.polynomials import TINY, FirstRoot, NextRoots
from filterlab.ops.cuda.source import Source, any_of, number
from filterlab.ops.raycast import JUMP, PLACES_APART, REPEATED


def taker(source: Source, asked: str, degree: int, arithmetic: str) -> First | Sheets | Every:
    """Of "first", "met", "sheets" or "candidates"."""
    if asked == "candidates":
        return Every(source)
    if asked == "sheets":
        return Sheets(source, NextRoots(source, degree, arithmetic))
    return First(source, FirstRoot(source, degree, arithmetic), located=asked == "first")


def straddle(source: Source, rows: Sequence[str]) -> None:
    """`straddles`: coefficients lie on both sides of 0, or on it."""
    source.line(f"smallest, largest = {rows[0]}, {rows[0]}")
    for row in rows[1:]:
        source.line(f"smallest = {smaller('smallest', row)}")
        source.line(f"largest = {larger('largest', row)}")
    source.line("straddles = (smallest <= 0.0) & (largest >= 0.0)")


class Located:
    """Rays keep the part of a piece that has their root, and those of a warp are searched together.

    Args:
        search: of roots.
        located: whether t is asked for; else it is that of a place in the piece with the hit.
    """

    waiting: str
    """A mask of rays that need not go on."""

    done: str
    """A mask of those that need not even see the other parts of a cell."""

    def __init__(self, source: Source, search: FirstRoot, located: bool = True) -> None:
        self.source, self.line, self.search, self.located = source, source.line, search, located

    def begin(self) -> None:
        """Before the first piece."""
        self.search.begin()
        self.source.lines("""
            hit = inside & (ray < 0)
            at_start, at_end = hit, hit
            hit_near, hit_far = s, s
        """)

    def rounds(self) -> AbstractContextManager[None]:
        """Around the walk."""
        return nullcontext()

    def signs(self, rows: Sequence[str], jump: str | None) -> None:
        """`begins`, `simple`, `hard` and `on_end`, masks (`ops.cpu.crossings.Signs`), of pieces made positive."""
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
        line("hard = holds & ~simple")

    def place(self) -> None:
        """`s_hit`, where rays hit that have."""
        line = self.line
        line("inner = hit & ~(at_start | at_end)")
        line("of_part = nothing")
        if self.located:
            with self.source.block(f"if {any_of('inner')}"):
                self.search.root("inner")
                line("of_part = root * part_h + part_a")
        line("within = tl.where(at_start, 0.0, tl.where(at_end, 1.0, of_part)).to(tl.float64)")
        line("s_hit = (hit_far - hit_near) * within + hit_near")
        line(f"s_hit = {larger('s_hit', 'hit_near')}")
        line(f"s_hit = {smaller('s_hit', 'hit_far')}")


class First(Located):
    """Every ray waits at its first hit; t (R,) is written, ∞ where none is."""

    waiting = done = "hit"

    def take(self, rows: Sequence[str], near: str, far: str, jump: str | None = None) -> None:
        """Keep pieces for the root search, if they have a root.

        Args:
            rows: coefficients, which are written to.
            near, far: where on the ray the piece begins and ends.
            jump: a mask of rays that hit where the piece begins, whatever its coefficients are.
        """
        line = self.line
        self.signs(rows, jump)
        self.search.assign("simple", rows, "nothing", "(nothing + 1.0)")
        line("met = begins | simple")
        line("hard = hard & ~begins")
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
        self.place()
        self.line("tl.store(t + ray, tl.where(hit, (start + s_hit) * scale, infinity), inside)")


class Sheets(Located):
    """Every ray keeps one root until it comes to the next (`ops.cpu.crossings`); t (R, k) is written, in a ring.

    Names that the source must have beside the others: `way_x` …, directions in the world, and `extent`.
    """

    waiting = "((sheets + hit.to(tl.int64)) >= most)"
    done = "(sheets >= most)"
    search: NextRoots

    def begin(self) -> None:
        """See `First`."""
        super().begin()
        self.line("capacity, most = capacity.to(tl.int64), most.to(tl.int64)")
        self.line("longest_way = tl.abs(way_x)")
        for a in "yz":
            self.line(f"longest_way = {larger('longest_way', f'tl.abs(way_{a})')}")
        self.source.lines("""
            extent = extent / tl.where(inside, longest_way, 1.0)
            sheets, t_before = ray * 0, s - infinity
        """)

    @contextmanager
    def rounds(self) -> Iterator[None]:
        with self.source.block(f"while {any_of(f'going & ~{self.done}')}"):
            yield
            self._write()

    def take(self, rows: Sequence[str], near: str, far: str, jump: str | None = None) -> None:
        """See `First`; until every ray has no more roots in its piece, but for one that it keeps."""
        line, block = self.line, self.source.block
        line(f"some = {rows[0]} != 0.0")
        for row in rows[1:]:
            line(f"some = some | ({row} != 0.0)")
        line(f"at_zero = {rows[0]} == 0.0")
        line(f"holds = holds & ~{self.done}")
        self.signs(rows, jump)
        self.source.lines("""
            begins = begins & ~(at_zero & repeated)
            on_end = on_end & some
            taken = holds
        """)
        with block(f"if {any_of('hard')}"):
            self.search.start("tl.where(at_zero, nothing, nothing + 1.0)", "on_end")
        with block(f"while {any_of('taken')}"):
            with block(f"if {any_of('hit & taken')}"):
                self._write()
            line(f"taken = taken & ~{self.done}")
            line("simple, begins = taken & simple, taken & begins")
            self.search.assign("simple", rows, "nothing", "(nothing + 1.0)")
            line("at_start = at_start | begins")
            self._note("(simple | begins)", near, far)
            line("taken = taken & ~simple")
            line("hard = taken & ~begins")
            line("simple, begins = simple & (ray < 0), begins & (ray < 0)")
            with block(f"if {any_of('hard')}"):
                self.search.next_part("hard", rows)
                line("ends = over_ & (side > 0.0) & on_end & ~met")
                line("at_end = at_end | ends")
                self._note("(met | ends)", near, far)
                line("taken = taken & ~over_")

    def _note(self, mask: str, near: str, far: str) -> None:
        self.line(f"hit_near = tl.where({mask}, {near}, hit_near)")
        self.line(f"hit_far = tl.where({mask}, {far}, hit_far)")
        self.line(f"hit = hit | {mask}")

    def _write(self) -> None:
        """Search the roots that are kept, and write them over those that are k before."""
        self.place()
        self.source.lines(f"""
            t_hit = (start + s_hit) * scale
            fresh = hit & (t_hit - t_before > (t_hit + extent) * {number(PLACES_APART * 2.0**-52)})
            tl.store(t + (ray * capacity + sheets % capacity), t_hit, fresh)
            sheets += fresh.to(tl.int64)
            t_before = tl.where(hit, t_hit, t_before)
            hit = hit & (ray < 0)
            at_start, at_end = hit, hit
        """)

    def end(self) -> None:
        """See `First`."""
        self.line("tl.store(count + ray, sheets, inside)")


class Every:
    """Every piece that may hold a hit is written to arrays of `ops.raycast.Written`, as far as there is room."""

    waiting = done = "(ray < 0)"

    def __init__(self, source: Source) -> None:
        self.line = source.line

    def rounds(self) -> AbstractContextManager[None]:
        """See `First`."""
        return nullcontext()

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
