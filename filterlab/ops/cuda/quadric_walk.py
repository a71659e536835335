"""A walk down the tree of quadrics for every ray of a block, as Triton programs write it; a ray is a thread's.

The plan is that of `ops.cpu.quadric_walk`, but that nodes wait on a stack in global memory, and children are not
sorted: they are put on it against the way along the axis in which a ray goes most, for they stand in Morton's order.
Boxes are float32, quadrics float64, both as `ops.reference.quadrics` says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from filterlab.ops.cuda.source import Source, any_of, number
from filterlab.ops.quadrics import CENTER, CONSTANT, MATRIX, PLANES, ROUNDINGS, SIZES, SMALLEST, SQUARE, VECTOR, Kept
from filterlab.ops.tree import WIDTH

BLOCK = 32
DEEPEST = 96  # nodes that wait
ARRAYS = ("boxes", "children", "leaves", "start", "along", "first", "last", "nodes", "nears")
"""As of `ops.cpu.quadric_walk`; nodes (R, 96) int32 and nears (R, 96) float32 are the stacks."""

_AXES = ("x", "y", "z")
_ROUNDING = ROUNDINGS * 2.0**-52
_SYMMETRIC = (("xx", "xy", "xz"), ("xy", "yy", "yz"), ("xz", "yz", "zz"))


class Walk:
    """Writes a program: rays (`begin`), and walks, in each of which whoever walks takes hits.

    `limit` (BLOCK,) float64, which whoever takes hits may lower, and `begins` are the program's: τ before or behind
    which boxes are left out.
    """

    def __init__(self, name: str, arrays: Sequence[str], sizes: Sequence[str], planes: int, kept: Kept, reversed: bool):
        self.source = Source(name, (*ARRAYS, *arrays, *sizes, "rays", "BLOCK: tl.constexpr"))
        self.text = self.source.lines
        self.planes, self.kept, self.reversed = planes, kept, reversed

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
        for k, a in enumerate(_AXES):
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
        """Of the rays of a mask. `take` writes what is done with `tau`, `root`, `place` and `hit`, a mask."""
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
                    self._quadric(take)

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
            for k, a in enumerate(_AXES):
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

    # --- a quadric ---

    def row(self, name: str, number: int) -> None:
        self.text(f"{name} = tl.load(base + {WIDTH * number}, at_leaf, 0.0)")

    def _quadric(self, take: Callable[[], None]) -> None:
        rows = WIDTH * (PLANES + 4 * self.planes)
        self.text(f"base = leaves + leaf * {rows} + lane")
        for a, k in zip(_AXES, range(CENTER.start, CENTER.stop), strict=True):
            self.row(f"q_{a}", k)
            self.text(f"q_{a} = start_{a} - q_{a}")
        self.text("behind = -(q_x * along_x + q_y * along_y + q_z * along_z)")
        for a in _AXES:
            self.text(f"q_{a} = q_{a} + behind * along_{a}")
        self._clipped()
        self._roots()
        self._counted(take)

    def _clipped(self) -> None:
        """`low`, `high`: between which ρ a hit counts; `valid`."""
        self.row("square", SQUARE)
        self.text("""
            reach = q_x * q_x + q_y * q_y + q_z * q_z
            valid = at_leaf & (square >= reach)
            half = tl.sqrt(tl.where(valid, square - reach, 0.0))
            from_first = own_first - behind
            to_last = own_last - behind
            low_end = tl.where(-half > from_first, -half, from_first)
            high_end = tl.where(half < to_last, half, to_last)
        """)
        for plane in range(self.planes):
            for k, name in enumerate(("n_x", "n_y", "n_z", "n_d")):
                self.row(name, PLANES + 4 * plane + k)
            self.text("""
                speed = n_x * along_x + n_y * along_y + n_z * along_z
                height = n_x * q_x + n_y * q_y + n_z * q_z + n_d
                at_plane = -height / tl.where(speed == 0.0, 1.0, speed)
                low_end = tl.where((speed < 0.0) & (at_plane > low_end), at_plane, low_end)
                high_end = tl.where((speed > 0.0) & (at_plane < high_end), at_plane, high_end)
                valid = valid & ~((speed == 0.0) & (height > 0.0))
            """)
        self.text("valid = valid & (low_end <= high_end)")

    def _roots(self) -> None:
        """`front`, `back`, `single`."""
        for name, k in zip(("xx", "yy", "zz", "xy", "xz", "yz"), range(MATRIX.stop), strict=True):
            self.row(f"a_{name}", k)
        for a, k in zip(_AXES, range(VECTOR.start, VECTOR.stop), strict=True):
            self.row(f"b_{a}", k)
        for name, k in (("c", CONSTANT), ("size_a", SIZES.start), ("size_b", SIZES.start + 1)):
            self.row(name, k)
        self.times("q", "turned")
        self.times("along", "ahead")
        entry = "high_end" if self.reversed else "low_end"
        self.text(f"""
            alpha = along_x * ahead_x + along_y * ahead_y + along_z * ahead_z
            beta = along_x * (turned_x + b_x) + along_y * (turned_y + b_y) + along_z * (turned_z + b_z)
            gamma = q_x * (turned_x + 2 * b_x) + q_y * (turned_y + 2 * b_y) + q_z * (turned_z + 2 * b_z) + c
            far_off = tl.sqrt(reach)
            size_beta = size_a * far_off + size_b
            size_gamma = far_off * (size_beta + size_b) + tl.abs(c)
            radicand = beta * beta - alpha * gamma
            slack = 2.0 * tl.abs(beta) * size_beta + size_a * tl.abs(gamma) + tl.abs(alpha) * size_gamma
            s = tl.sqrt(tl.where(radicand > 0.0, radicand, 0.0))
            receding = beta > 0.0
            total = tl.where(receding, -(beta + s), s - beta)
            by_alpha = total / tl.where(alpha == 0.0, 1.0, alpha)
            by_alpha = tl.where(alpha == 0.0, infinity, by_alpha)
            by_total = tl.where(total == 0.0, infinity, gamma / tl.where(total == 0.0, 1.0, total))
            front = tl.where(receding, by_alpha, by_total)
            back = tl.where(receding, by_total, by_alpha)
            touches = tl.abs(radicand) <= {number(_ROUNDING)} * slack
            lies = (tl.abs(alpha) <= {number(_ROUNDING)} * size_a) & (tl.abs(beta) <= {number(_ROUNDING)} * size_beta)
            lies = lies & (tl.abs(gamma) <= {number(_ROUNDING)} * size_gamma)
            touching = tl.where(alpha == 0.0, infinity, -beta / tl.where(alpha == 0.0, 1.0, alpha))
            front = tl.where(lies, {entry}, tl.where(touches, touching, front))
            single = lies | touches
            valid = valid & (single | (radicand > 0.0))
        """)

    def times(self, vector: str, name: str) -> None:
        """A times a vector."""
        for a, row in zip(_AXES, _SYMMETRIC, strict=True):
            terms = (f"a_{entry} * {vector}_{b}" for entry, b in zip(row, _AXES, strict=True))
            self.text(f"{name}_{a} = {' + '.join(terms)}")

    def _counted(self, take: Callable[[], None]) -> None:
        kept = self.kept
        for root, one, other in (("front", kept.touches, kept.falls), ("back", False, kept.rises)):
            if not (one or other):
                continue
            counts = " | ".join(text for text, asked in (("single", one), ("~single", other)) if asked)
            self.text(f"""
                root = {root}
                hit = valid & ({counts}) & (root >= low_end) & (root <= high_end)
                tau = root + behind
                place = leaf * {WIDTH} + lane
            """)
            take()
