"""The program of the prefilter in Triton: lines of samples in, lines of coefficients out.

Along every line, with the poles z of the prefilter and any boundary, `prefilters` asks for

    forwards    a_i = f_i + z a_{i−1}        from zero, far enough before the line
    backwards   c_i = a_i + z c_{i+1}        from zero, far enough behind it

for one pole after the other, and a gain. A program takes a line for each of its threads. All poles go forwards
together, then all of them backwards; a is kept in the result, which c then replaces. A line is *extended* by reading it
through a table: `places` says which of its samples stands at each place of the extended line (−1: a zero). So there is
no code for boundaries here.

Behind the line nothing can be kept. What goes backwards has a state b (a number per pole) when it comes back to the
last coefficient, and b is linear in the state a in which the line was left and in the samples behind it:

    b = T a + Σ_k w_k f_{N+k},        T and w found once, in double precision (`ops.cuda.prefilter`).

`steps_of` places are read before the first of them is used, as a thread waits for nothing so long as for memory. There
are two ways to read and write them, and one recursion:

    lines that are neighbours in memory (along y and z)       a place is neighbouring numbers, one for each thread
    lines along x                                             a tile of lines × places, dealt out to the threads
"""

from __future__ import annotations

from collections.abc import Sequence

from filterlab.ops.cuda.source import Source

BLOCK = 32  # lines of a program; a warp
SIZES = (
    "lines",
    "inner",  # lines that are neighbours in memory; the next ones lie a whole block of them further
    "count",  # coefficients of a line
    "before",  # places before the first coefficient; with `count` a multiple of `steps_of`
    "behind",  # places behind the last; a multiple of `steps_of`
    "source_outer",  # strides of the samples (lines / inner, length, inner); the result is contiguous
    "source_step",
    "source_inner",
)
PARAMETERS = ("source", "target", "places", "numbers", *SIZES, "BLOCK: tl.constexpr")
"""places: before + count + behind, int64. numbers, in the type of the result: poles, gain, T by rows, w_0, w_1, …"""


def steps_of(poles: int) -> int:
    """Places of a line that are under way at a time; a power of two.

    Of 256³ float32 with one pole 16 of them take 1.2 times as long on an H100 along y and z, and 1.5 times along x.
    With more poles twice as many take Triton three times as long to compile: 12 s of one core for four poles.
    """
    return 32 if poles == 1 else 16


class Program:
    """Writes a program for so many poles."""

    name: str

    def __init__(self, poles: int) -> None:
        self.poles, self.steps = range(poles), steps_of(poles)
        self.source = Source(self.name, PARAMETERS)
        self.line = self.source.line

    def samples(self, first: str) -> None:
        """f_0 …: the samples at `steps` places of the extended line."""
        raise NotImplementedError

    def load(self, first: str) -> None:
        """f_0 …: what the result holds there; anything before its begin."""
        raise NotImplementedError

    def store(self, first: str) -> None:
        """f_0 … into the result; what is before its begin is dropped."""
        raise NotImplementedError

    def write(self) -> Source:
        self._begin()
        self._forwards()
        self._turn()
        self._backwards()
        return self.source

    def _begin(self) -> None:
        """Where the lines lie, and what is the same for all of them."""
        line, count = self.line, len(self.poles)
        line("arithmetic = target.dtype.element_ty")
        for size in SIZES:
            line(f"{size} = {size}.to(tl.int64)")
        line("line = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)")
        line("inside = line < lines")
        line("outer = line // inner")
        line("lane = line - outer * inner")
        line("here = source + (outer * source_outer + lane * source_inner)")
        line("there = target + (outer * count * inner + lane)")
        for j in self.poles:
            line(f"pole_{j} = tl.load(numbers + {j})")
            for i in self.poles:
                line(f"turn_{j}_{i} = tl.load(numbers + {count + 1 + j * count + i})")
            line(f"a_{j} = tl.full((BLOCK,), 0.0, arithmetic)")
        line(f"gain = tl.load(numbers + {count})")
        line(f"weights = numbers + {count + 1 + count**2}")

    def _forwards(self) -> None:
        with self.source.block(f"for first in range(0, before + count, {self.steps})"):
            self.samples("first")
            for k in range(self.steps):
                self.line(f"f_{k} = {self._advance('a', f'f_{k}')}")
            self.store("first - before")

    def _turn(self) -> None:
        for j in self.poles:
            self.line(f"b_{j} = {' + '.join(f'turn_{j}_{i} * a_{i}' for i in self.poles)}")
        with self.source.block(f"for first in range(0, behind, {self.steps})"):
            self.samples("before + count + first")
            for k in range(self.steps):
                for j in self.poles:
                    weight = f"tl.load(weights + (first + {k}) * {len(self.poles)} + {j})"
                    self.line(f"b_{j} += {weight} * f_{k}")

    def _backwards(self) -> None:
        self.line("tl.debug_barrier()  # what one thread has stored, another may load")
        with self.source.block(f"for done in range(0, count, {self.steps})"):
            self.line(f"first = count - {self.steps} - done")
            self.load("first")
            for k in reversed(range(self.steps)):
                self.line(f"f_{k} = {self._advance('b', f'f_{k}')} * gain")
            self.store("first")

    def _advance(self, state: str, value: str) -> str:
        """One step of all poles, each of what the one before it has just made; what the last one has made."""
        for j in self.poles:
            self.line(f"{state}_{j} = {value} + pole_{j} * {state}_{j}")
            value = f"{state}_{j}"
        return value


class Columns(Program):
    """Lines that are neighbours in memory."""

    name = "columns"

    def samples(self, first: str) -> None:
        for k in range(self.steps):
            self.line(f"place_{k} = tl.load(places + ({first} + {k}))")
        for k in range(self.steps):
            there = f"here + place_{k} * source_step, inside & (place_{k} >= 0), 0"
            self.line(f"f_{k} = tl.load({there}).to(arithmetic)")

    def load(self, first: str) -> None:
        for k in range(self.steps):
            self.line(f"f_{k} = tl.load({self._coefficient(first, k)}, {self._kept(first, k)}, 0.0)")

    def store(self, first: str) -> None:
        for k in range(self.steps):
            self.line(f"tl.store({self._coefficient(first, k)}, f_{k}, {self._kept(first, k)})")

    def _coefficient(self, first: str, k: int) -> str:
        return f"there + ({first} + {k}) * inner"

    def _kept(self, first: str, k: int) -> str:
        return f"inside & ({first} + {k} >= 0)"


class Rows(Program):
    """Lines whose numbers lie together; `inner` is 1. Threads share the rows of a tile, and then take a row each."""

    name = "rows"

    def samples(self, first: str) -> None:
        self.line(f"place = tl.load(places + ({first} + tl.arange(0, {self.steps})))")
        mask = "inside[:, None] & (place >= 0)[None, :]"
        self.line(f"tile = tl.load(here[:, None] + (place * source_step)[None, :], {mask}, 0).to(arithmetic)")
        self._deal("tile", self._all())

    def load(self, first: str) -> None:
        self._locate(first)
        self.line("tile = tl.load(tile_there, tile_kept, 0.0)")
        self._deal("tile", self._all())

    def store(self, first: str) -> None:
        self._locate(first)
        self.line(f"tl.store(tile_there, {self._collect(self._all())}, tile_kept)")

    def _all(self) -> list[str]:
        return [f"f_{k}" for k in range(self.steps)]

    def _locate(self, first: str) -> None:
        self.line(f"column = {first} + tl.arange(0, {self.steps})")
        self.line("tile_there = there[:, None] + column[None, :]")
        self.line("tile_kept = inside[:, None] & (column >= 0)[None, :]")

    def _deal(self, tile: str, names: Sequence[str]) -> None:
        """The columns of a tile by their names: those of even places, those of odd places, and again."""
        if len(names) == 2:
            self.line(f"{names[0]}, {names[1]} = tl.split({tile})")
            return
        even, odd = f"{tile}e", f"{tile}o"
        self.line(f"{even}, {odd} = tl.split(tl.reshape({tile}, (BLOCK, {len(names) // 2}, 2)))")
        self._deal(even, names[::2])
        self._deal(odd, names[1::2])

    def _collect(self, names: Sequence[str]) -> str:
        """The tile of these columns."""
        if len(names) == 2:
            return f"tl.join({names[0]}, {names[1]})"
        even, odd = self._collect(names[::2]), self._collect(names[1::2])
        return f"tl.reshape(tl.join({even}, {odd}), (BLOCK, {len(names)}))"
