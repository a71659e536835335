"""The programs that cast rays at quadrics, and at blended ones, in Triton (`tree_walk`, `quadric_leaves`)."""

from __future__ import annotations

from dataclasses import dataclass

from filterlab.ops.cuda.quadric_leaves import QuadricInLeaf, times
from filterlab.ops.cuda.source import Source, any_of, number
from filterlab.ops.cuda.tree_walk import ARRAYS, AXES, ROWS, Walk, first_hits
from filterlab.ops.quadrics import Kept
from filterlab.ops.slim import INNER, LEAST_WEIGHT, OUTER, STEEP

OWN = {
    "hits": ROWS,
    "sheets": ("taus", "begin", "end", "normal", "places"),
    "members": ("begin", "end", "count", "taus", "places"),
}
"""Arrays of each program, as of `ops.cpu.quadric_hits` and `ops.cpu.slim_hits`."""

SCALARS = {"hits": ("sheets",), "sheets": ("sheets", "offset"), "members": ("writes",)}


@dataclass(frozen=True)
class QuadricsVariant:
    """Everything a program depends on, see `tree_walk.Variant`.

    Attributes:
        asked: "hits", "sheets" or "members".
        planes: H.
        kept: which hits count.
        reversed: whether rays go the other way round.
    """

    asked: str
    planes: int
    kept: Kept
    reversed: bool

    @property
    def arrays(self) -> tuple[str, ...]:
        return (*ARRAYS, *OWN[self.asked])

    @property
    def scalars(self) -> tuple[str, ...]:
        return SCALARS[self.asked]

    def write(self) -> Source:
        leaf = QuadricInLeaf(self.planes, self.kept, self.reversed)
        walk = Walk(f"quadrics_{self.asked}", OWN[self.asked], self.scalars, leaf)
        walk.begin()
        {"hits": first_hits, "sheets": _sheets, "members": _members}[self.asked](walk)
        return walk.source


def _sheets(walk: Walk) -> None:
    """For each: a walk to where it ends, and one that adds up what comes before."""
    walk.text("""
        offset = tl.load(offset)
        sheet_begin = -infinity
        more = inside
    """)

    def ends() -> None:
        walk.text("""
            hit = hit & (tau >= sheet_begin) & (tau <= limit)
            reached = tau + offset * tl.sqrt(square)
            limit = tl.where(hit & (reached < limit), reached, limit)
        """)

    def add() -> None:
        walk.text("hit = hit & (tau >= sheet_begin) & (tau <= limit)")
        with walk.source.block(f"if {any_of('hit')}"):
            for a in AXES:
                walk.text(f"y_{a} = q_{a} + root * along_{a}")
            times(walk, "y", "gradient")
            walk.text(f"""
                gradient_x = gradient_x + b_x
                gradient_y = gradient_y + b_y
                gradient_z = gradient_z + b_z
                size = tl.sqrt(gradient_x * gradient_x + gradient_y * gradient_y + gradient_z * gradient_z)
                size = tl.where(size > 0.0, size, 1.0)
                ratio = (reach + root * root) / tl.where(square > 0.0, square, 1.0)
                left = 1.0 - tl.sqrt(ratio)
                left = tl.where(left > 0.0, left, 0.0)
                bell = tl.exp({number(-STEEP)} * ratio)
                w = tl.where(ratio <= {number(INNER * INNER)}, bell, {number(OUTER)} * left * left)
                w = tl.where(hit, w + {number(LEAST_WEIGHT)}, 0.0)
                sum_w = sum_w + w
                sum_tau = sum_tau + tl.where(hit, w * tau, 0.0)
                sum_x = sum_x + tl.where(hit, w * gradient_x / size, 0.0)
                sum_y = sum_y + tl.where(hit, w * gradient_y / size, 0.0)
                sum_z = sum_z + tl.where(hit, w * gradient_z / size, 0.0)
                heavier = hit & ((w > most_w) | ((w == most_w) & (place > best)))
                most_w = tl.where(heavier, w, most_w)
                best = tl.where(heavier, place, best)
            """)

    with walk.source.block("for sheet in range(sheets)"):
        walk.text("""
            limit = infinity
            begins = tl.where(sheet_begin > own_first, sheet_begin, own_first)
        """)
        walk.walk("more", ends)
        walk.text("""
            more = more & (limit < infinity)
            sum_w = nothing
            sum_tau = nothing
            sum_x = nothing
            sum_y = nothing
            sum_z = nothing
            most_w = nothing
            best = ray * 0 - 1
        """)
        walk.walk("more", add)
        walk.text("""
            at = ray * sheets + sheet
            tl.store(taus_array + at, sum_tau / tl.where(more, sum_w, 1.0), more)
            tl.store(begin_array + at, sheet_begin, more)
            tl.store(end_array + at, limit, more)
            tl.store(normal_array + 3 * at, sum_x, more)
            tl.store(normal_array + 3 * at + 1, sum_y, more)
            tl.store(normal_array + 3 * at + 2, sum_z, more)
            tl.store(places_array + at, best, more)
            ended = limit + 0.0
            bits = ended.to(tl.int64, bitcast=True)
            bits = bits + tl.where(ended < 0.0, -1, 1)
            sheet_begin = tl.where(more, bits.to(tl.float64, bitcast=True), sheet_begin)
        """)


def _members(walk: Walk) -> None:
    """All hits of a ray between two τ: counted, or written from `count` on."""
    walk.text("""
        sheet_begin = tl.load(begin_array + ray, inside, 0.0)
        limit = tl.load(end_array + ray, inside, 0.0)
        begins = tl.where(sheet_begin > own_first, sheet_begin, own_first)
        slot = tl.load(count_array + ray, inside & (writes != 0), 0)
        going = inside & (sheet_begin <= limit)
    """)

    def take() -> None:
        walk.text("""
            hit = hit & (tau >= sheet_begin) & (tau <= limit)
            tl.store(taus_array + slot, tau, hit & (writes != 0))
            tl.store(places_array + slot, place, hit & (writes != 0))
            slot = slot + hit.to(tl.int64)
        """)

    walk.walk("going", take)
    walk.text("tl.store(count_array + ray, slot, (ray < rays) & (writes == 0))")
