"""A walk down a tree for every ray of a block, as Triton programs write it, and rows of hits; a ray is a thread's.

The plan is that of `ops.cpu.tree_walk`, but that nodes wait on a stack in global memory, and children are not sorted:
they are put on it against the way along the axis in which a ray goes most, for they stand in Morton's order. Boxes are
float32, what stands in leaves float64. What that is tested by is an `InLeaf`'s.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Protocol

from filterlab.ops.cuda.source import Source, any_of, number
from filterlab.ops.quadrics import SMALLEST
from filterlab.ops.tree import WIDTH

BLOCK = 32
DEEPEST = 96  # nodes that wait
ARRAYS = ("boxes", "children", "leaves", "start", "along", "first", "last", "nodes", "nears")
"""As of `ops.cpu.tree_walk`; nodes (R, 96) int32 and nears (R, 96) float32 are the stacks."""

ROWS = ("taus", "places")
"""Arrays of `first_hits`, as of `ops.cpu.tree_walk`; its one number is `sheets`."""

AXES = ("x", "y", "z")


class Variant(Protocol):
    """Everything a program depends on; can be hashed.

    Attributes:
        arrays, scalars: what it is given, in order, but for how many rays there are.
    """

    @property
    def arrays(self) -> tuple[str, ...]: ...

    @property
    def scalars(self) -> tuple[str, ...]: ...

    def write(self) -> Source: ...


class InLeaf(ABC):
    """What stands in leaves: writes how a ray is tested by one of the eight.

    Attributes:
        rows: K, numbers of each.
    """

    rows: int

    @abstractmethod
    def write(self, walk: Walk, take: Callable[[], None]) -> None:
        """Of rays `at_leaf`, by the numbers from `base` on. `take` writes what is done with hits: `tau`, `place`, and a
        mask, `hit`."""


class Walk:
    """Writes a program: rays (`begin`), and walks, in each of which whoever walks takes hits.

    `limit` (BLOCK,) float64, which whoever takes hits may lower, and `begins` are the program's: τ before or behind
    which boxes are left out.
    """

    def __init__(self, name: str, arrays: Sequence[str], sizes: Sequence[str], leaf: InLeaf):
        own = (f"{name}_array" for name in arrays)
        self.source = Source(name, (*ARRAYS, *own, *sizes, "rays", "BLOCK: tl.constexpr"))
        self.text = self.source.lines
        self.leaf = leaf

    def begin(self) -> None:
        """The rays of the block: `ray`, `inside`, and all that stays the same on their walks."""
        self.text(f"""
            ray = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
            inside = ray < rays
            nothing = tl.full((BLOCK,), 0.0, tl.float64)
            infinity = nothing + float("inf")
            own_first = tl.load(first + ray, inside, 0.0)
            own_last = tl.load(last + ray, inside, 0.0)
            inside = inside & (own_first <= own_last)
            stack = ray * {DEEPEST}
            begins = own_first
            limit = infinity
        """)
        for k, a in enumerate(AXES):
            self.text(f"""
                start_{a} = tl.load(start + 3 * ray + {k}, inside, 0.0)
                along_{a} = tl.load(along + 3 * ray + {k}, inside, 1.0)
                safe_{a} = tl.where(tl.abs(along_{a}) < {number(SMALLEST)}, {number(SMALLEST)}, along_{a})
                inverse_{a} = (1.0 / safe_{a}).to(tl.float32)
                place_{a} = start_{a}.to(tl.float32)
                back_{a} = tl.where(safe_{a} < 0.0, 1, 0)
            """)
        self.text("""
            most = tl.maximum(tl.maximum(tl.abs(along_x), tl.abs(along_y)), tl.abs(along_z))
            along_most = tl.where(tl.abs(along_x) == most, along_x, tl.where(tl.abs(along_y) == most, along_y, along_z))
            onward = along_most > 0.0
        """)

    def walk(self, going: str, take: Callable[[], None]) -> None:
        """Of the rays of a mask. `take` writes what is done with hits, see `InLeaf`."""
        source = self.source
        self.text(f"""
            top = tl.where({going}, 1, 0)
            tl.store(nodes + stack, top - 1, {going})
            tl.store(nears + stack, tl.full((BLOCK,), float("-inf"), tl.float32), {going})
        """)
        with source.block(f"while {any_of('top > 0')}"):
            self.text("""
                walking = top > 0
                top = top - walking.to(tl.int32)
                node = tl.load(nodes + stack + top, walking, 0)
                near = tl.load(nears + stack + top, walking, 0.0)
                walking = walking & (near <= limit.to(tl.float32))
                inner = walking & (node >= 0)
                at_leaf = walking & (node < 0)
            """)
            with source.block(f"if {any_of('inner')}"):
                self._children()
            with source.block(f"if {any_of('at_leaf')}"):
                self.text("leaf = tl.where(at_leaf, -1 - node, 0).to(tl.int64)")
                with source.block(f"for lane in range({WIDTH})"):
                    self.text(f"""
                        base = leaves + leaf * {WIDTH * self.leaf.rows} + lane
                        place = leaf * {WIDTH} + lane
                    """)
                    self.leaf.write(self, take)

    def _children(self) -> None:
        """Those that are met are put on the stack."""
        self.text("""
            child = tl.load(children + node, inner, 0)
            sign = tl.where(child < 0, -1, 1)
            box = node.to(tl.int64) * 48
        """)
        with self.source.block(f"for step in range({WIDTH})"):
            self.text("""
                own = tl.where(onward, 7 - step, step)
                enters = begins.to(tl.float32)
                leaves_at = own_last.to(tl.float32)
            """)
            for k, a in enumerate(AXES):
                self.text(f"""
                    low = tl.load(boxes + box + 8 * ({k} + 3 * back_{a}) + own, inner, 0.0)
                    high = tl.load(boxes + box + 8 * ({k + 3} - 3 * back_{a}) + own, inner, 0.0)
                    low = (low - place_{a}) * inverse_{a}
                    high = (high - place_{a}) * inverse_{a}
                    enters = tl.where(low > enters, low, enters)
                    leaves_at = tl.where(high < leaves_at, high, leaves_at)
                """)
            self.text("""
                met = inner & (enters <= leaves_at) & (enters <= limit.to(tl.float32))
                tl.store(nodes + stack + top, child + sign * own, met)
                tl.store(nears + stack + top, enters, met)
                top = top + met.to(tl.int32)
            """)

    # --- what stands in leaves ---

    def row(self, name: str, number: int) -> None:
        self.text(f"{name} = tl.load(base + {WIDTH * number}, at_leaf, 0.0)")

    def rows(self, names: Sequence[str], numbers: slice) -> None:
        for name, k in zip(names, range(numbers.start or 0, numbers.stop), strict=True):
            self.row(name, k)

    def vector(self, name: str, numbers: slice) -> None:
        self.rows([f"{name}_{a}" for a in AXES], numbers)

    def from_center(self, center: slice) -> None:
        """q, the point of the ray nearest to a centre, measured from there, τ there, `behind`, and q², `reach`."""
        self.vector("q", center)
        for a in AXES:
            self.text(f"q_{a} = start_{a} - q_{a}")
        self.text(f"behind = -({dot('q', 'along')})")
        for a in AXES:
            self.text(f"q_{a} = q_{a} + behind * along_{a}")
        self.text(f"reach = {dot('q', 'q')}")

    def stable_roots(self) -> None:
        """`s`, `front`, `back` of `alpha`, `beta`, `gamma` and `radicand`; ∞ where there is none."""
        self.text("""
            s = tl.sqrt(tl.where(radicand > 0.0, radicand, 0.0))
            receding = beta > 0.0
            total = tl.where(receding, -(beta + s), s - beta)
            by_alpha = total / tl.where(alpha == 0.0, 1.0, alpha)
            by_alpha = tl.where(alpha == 0.0, infinity, by_alpha)
            by_total = tl.where(total == 0.0, infinity, gamma / tl.where(total == 0.0, 1.0, total))
            front = tl.where(receding, by_alpha, by_total)
            back = tl.where(receding, by_total, by_alpha)
        """)


def dot(x: str, y: str) -> str:
    """Of two vectors, by their names."""
    return " + ".join(f"{x}_{a} * {y}_{a}" for a in AXES)


def first_hits(walk: Walk) -> None:
    """Of every ray, in order, into its row."""
    walk.text("row = ray * sheets")

    def take() -> None:
        walk.text("hit = hit & (tau < limit)")
        with walk.source.block(f"if {any_of('hit')}"):
            walk.text("""
                carried = tau
                carried_place = place
            """)
            with walk.source.block("for k in range(sheets)"):
                walk.text("""
                    there = tl.load(taus_array + row + k, hit, 0.0)
                    place_there = tl.load(places_array + row + k, hit, 0)
                    sooner = carried < there
                    tl.store(taus_array + row + k, tl.where(sooner, carried, there), hit)
                    tl.store(places_array + row + k, tl.where(sooner, carried_place, place_there), hit)
                    carried = tl.where(sooner, there, carried)
                    carried_place = tl.where(sooner, place_there, carried_place)
                """)
            walk.text("limit = tl.where(hit, tl.load(taus_array + row + sheets - 1, hit, 0.0), limit)")

    walk.walk("inside", take)
