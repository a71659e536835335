"""The first root in [0, 1] of polynomials in Bernstein form, in Triton: one for each thread of a warp.

What is searched, and the tolerances, are those of `ops.cpu.polynomials` (read it first). Coefficients are names of_0 …
of_n; where roots are is kept in part_0 … part_n, on [part_a, part_a + part_h], positive at part_a.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from math import comb

from filterlab.ops.cuda.source import Source, any_of, number
from filterlab.ops.raycast import PASSES, USUAL
from filterlab.roots import ROUNDINGS

EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
TINY = {"float32": 2.0**-126, "float64": 2.0**-1022}


class FirstRoot:
    """Writes the search at the end of a source that has `nothing`, zeros of the arithmetic.

    Args:
        degree: n.
        arithmetic: "float32" or "float64".
    """

    def __init__(self, source: Source, degree: int, arithmetic: str) -> None:
        self.source, self.line, self.degree, self.arithmetic = source, source.line, degree, arithmetic
        self.eps = EPS[arithmetic]
        self.tolerance = ROUNDINGS * degree * self.eps
        self.indices = range(degree + 1)

    def names(self, of: str) -> list[str]:
        return [f"{of}_{i}" for i in self.indices]

    def begin(self) -> None:
        """The part of every ray, of a polynomial that stays 1."""
        for name in (*self.names("part"), "part_h"):
            self.line(f"{name} = nothing + 1.0")
        self.line("part_a = nothing")

    def assign(self, mask: str, rows: Sequence[str], a: str, h: str) -> None:
        for name, value in zip((*self.names("part"), "part_a", "part_h"), (*rows, a, h), strict=True):
            self.line(f"{name} = tl.where({mask}, {value}, {name})")

    # --- signs ---

    def lower(self, into: str, rows: Sequence[str], times: float = 1.0) -> list[str]:
        """p − times τ p̃."""
        for name, row in zip(self.names(into), rows, strict=True):
            self.line(f"{name} = {row} - {number(times * self.tolerance)} * tl.abs({row})")
        return self.names(into)

    def count_changes(self, rows: Sequence[str]) -> None:
        """`changes`: how often neighbours lie on different sides of 0; `below` whether the last is not positive."""
        for left, right in zip(("flag", "below"), rows[:2], strict=True):
            self.line(f"{left} = {right} <= 0.0")
        self.line("changes = (flag != below).to(tl.int32)")
        for row in rows[2:]:
            self.line("flag = below")
            self.line(f"below = {row} <= 0.0")
            self.line("changes += (flag != below).to(tl.int32)")

    # --- the part that holds the first root ---

    def first_part(self, mask: str, rows: Sequence[str], met: str) -> None:
        """Halve [0, 1] of the polynomials under the mask (c_0 > 0), from left to right; `met` gains those with a part.

        h is a power of two and so is 1 / h, which is kept beside it: quotients are exact without a division.
        """
        line = self.line
        lowered = self.lower("low", rows)
        line(f"left = {mask}")
        line("a, h, parts = nothing, nothing + 1.0, nothing + 1.0")
        with self._while("left"):
            line("end_ = a + h")
            self.count_changes(self._between("here", lowered, "a", "end_"))
            line(f"narrow = h <= {number(self.eps)}")
            line("several = changes > 1")
            line("holds = left & tl.where(several, narrow, below)")
            with self.source.block(f"if {any_of('holds')}"):
                self.assign("holds", self._between("here", rows, "a", "end_"), "a", "h")
                line(f"{met} = {met} | holds")
            line("halves = left & several & ~narrow")
            line("moves = left & ~holds & ~halves")
            self._move("a", "h", "parts")
            line("left = left & ~(holds | (moves & (a >= 1.0)))")

    def _move(self, a: str, h: str, parts: str) -> None:
        """To the next part, as wide as its place allows, or to the first half of this one."""
        self.source.lines(f"""
            {a} = tl.where(moves, end_, {a})
            doubled = {a} * ({parts} * 0.5)
            wider = moves & (tl.floor(doubled) == doubled)
            {h} = tl.where(halves, {h} * 0.5, tl.where(wider, {h} * 2.0, {h}))
            {parts} = tl.where(halves, {parts} * 2.0, tl.where(wider, {parts} * 0.5, {parts}))
        """)

    def _between(self, into: str, rows: Sequence[str], start: str, end: str) -> list[str]:
        """Coefficients on [start, end], by de Casteljau's algorithm at the end and, from there, at start / end."""
        self.line(f"by, rest = {end}, 1.0 - {end}")
        first = self._split(into, rows, backward=False)
        self.line(f"by = {self.quotient(start, end)}")
        self.line("rest = 1.0 - by")
        return self._split(into, first, backward=True)

    def _split(self, into: str, rows: Sequence[str], backward: bool) -> list[str]:
        """Of what lies before `by`; or behind it."""
        own = self.names(into)
        for name, row in zip(own, rows, strict=True):
            if name != row:
                self.line(f"{name} = {row}")
        for step in range(1, self.degree + 1):
            kept = range(self.degree, step - 1, -1) if not backward else range(self.degree + 1 - step)
            for i in kept:
                left, right = (own[i - 1], own[i]) if not backward else (own[i], own[i + 1])
                self.line(f"{own[i]} = {left} * rest + {right} * by")
        return own

    def quotient(self, a: str, b: str) -> str:
        """Rounded to the nearest: `/` of float32 is not."""
        return f"tl.div_rn({a}, {b})" if self.arithmetic == "float32" else f"{a} / {b}"

    # --- one root in a part ---

    def root(self, mask: str) -> None:
        """`root` in [0, 1] where the part under the mask vanishes; any number elsewhere.

        By Newton's method in the half where the root is, in u = t / (1 − t), or (1 − t) / t in the right half, of
        p − 1.5 τ p̃, which changes its sign for certain; the last step is p's own.
        """
        line, n = self.line, self.degree
        for i in self.indices:
            line(f"here_{i} = part_{i} * {number(comb(n, i))}")
        self.lower("low", self.names("here"), 1.5)
        line(f"right = {' + '.join(self.names('low'))} > 0.0")
        line(
            "turn = tl.where(right, nothing - 1.0, nothing + 1.0)  # positive at the low end of u, not at the high end"
        )
        for into, of in (("search", "low"), ("own", "here")):
            for i in self.indices:
                line(f"{into}_{i} = turn * tl.where(right, {of}_{n - i}, {of}_{i})")
        self._newton(mask)
        self._polish()
        line(f"share = {self.quotient('(nothing + 1.0)', '(1.0 + u)')}")
        line("root = tl.where(right, share, u * share)")

    def _newton(self, mask: str) -> None:
        """u in [0, 1] where Σ search_i u^i, positive at 0 and not at 1, vanishes."""
        line, rows = self.line, self.names("search")
        line(f"bottom, top = nothing + {number(1e-300 if self.arithmetic == 'float64' else 1e-37)}, nothing + 1.0")
        line(f"ahead = {' + '.join(rows)}")
        line(f"u = {self.quotient(rows[0], f'({rows[0]} - ahead)')}")
        line("u = tl.where(u < 0.98, u, 0.98)")
        line("u = tl.where(u > 0.02, u, 0.02)")
        line("last = nothing + 1.0")
        line(f"active = {mask}")
        line("k = 0")
        with self._while("active", f"k < {PASSES}"):
            self._horner(rows, "u")
            line(f"size = {self._plain_horner([f'tl.abs({row})' for row in rows], 'u')}")
            line(f"clear_ = tl.abs(value) > size * {number(0.5 * len(rows) * self.eps)}")
            line(f"arrived = ~clear_ & (slope < 0.0) & (k >= {USUAL})")
            line("positive = tl.where(clear_, value > 0.0, u < 0.5)")
            line("bottom = tl.where(positive, u, bottom)")
            line("top = tl.where(positive, top, u)")
            line("step = value / slope")
            line("new = u - step")
            line("good = (new >= bottom) & (new <= top) & (tl.abs(step) <= 0.5 * last)")
            line("new = tl.where(good, new, 0.5 * (bottom + top))")
            line("active = active & ~arrived")
            line("last = tl.abs(new - u)")
            line("u = tl.where(active, new, u)")
            line(f"active = active & (last > new * {number(2 * self.eps)})")
            line("k += 1")

    def _polish(self) -> None:
        """One step of Newton's method, where p falls and it leads nearer to a root with nothing between."""
        line, rows = self.line, self.names("own")
        self._horner(rows, "u")
        line("value_there, steep = value, slope")
        line("new = u - value_there / steep")
        self._horner(rows, "new")
        line("change = slope / steep")
        line("good = (tl.abs(value) <= 0.5 * tl.abs(value_there)) & (change > 0.5) & (change < 2.0)")
        line("u = tl.where(good & (steep < 0.0) & (new >= 0.0) & (new <= 1.0), new, u)")

    def _horner(self, rows: Sequence[str], u: str) -> None:
        """`value` = Σ rows[i] u^i and `slope`, its derivative."""
        self.line(f"slope = {rows[-1]}")
        self.line(f"value = {rows[-1]} * {u} + {rows[-2]}")
        for row in reversed(rows[:-2]):
            self.line(f"slope = slope * {u} + value")
            self.line(f"value = value * {u} + {row}")

    def _plain_horner(self, rows: Sequence[str], u: str) -> str:
        text = rows[-1]
        for row in reversed(rows[:-1]):
            text = f"({text} * {u} + {row})"
        return text

    def _while(self, mask: str, also: str = "") -> AbstractContextManager[None]:
        return self.source.block(f"while ({any_of(mask)})" + (f" & ({also})" if also else ""))


class NextRoots(FirstRoot):
    """Writes the search of one root after the other (`ops.cpu.polynomials.NextRoots`).

    Between roots `sweep_a`, `sweep_h` and `sweep_parts` tell the part, `side` the side there, `counted` and `until`
    whether the root where it is left was told of, and where it is left at the latest.
    """

    def begin(self) -> None:
        super().begin()
        self.start("nothing", "(ray < 0)")

    def start(self, side: str, ends: str) -> None:
        """Of other polynomials, which begin on a side; `ends`: p(1) is 0, and stands as the smallest number."""
        self.source.lines(f"""
            sweep_a, sweep_h, sweep_parts, until = nothing, nothing + 1.0, nothing + 1.0, nothing
            side = {side}
            sweep_ends = {ends}
            counted = inside & (ray < 0)
        """)

    def next_part(self, mask: str, rows: Sequence[str]) -> None:
        """Go on with the polynomials under the mask, each until its root is `met`, or it is `over`."""
        self.source.lines(f"""
            left = {mask}
            met, over_ = left & (ray < 0), left & (ray < 0)
        """)
        with self._while("left"):
            self._signs(rows)
            self.line("told = left & (side != 0.0) & ~counted & tl.where(several, narrow, leaves)")
            with self.source.block(f"if {any_of('told')}"):
                here = self._between("here", rows, "sweep_a", "end_")
                self.assign("told", [f"side * {row}" for row in here], "sweep_a", "sweep_h")
            self.line("until = tl.where(told, end_, until)")
            self._onward()

    def _signs(self, rows: Sequence[str]) -> None:
        """Of one part: `several`, changes of the side's own sign, and whether it `leaves` that; `many`, of either."""
        self.line("end_ = sweep_a + sweep_h")
        for name, times in (("above", 1.0), ("below_", -1.0)):
            own = self.lower("low", rows, times)
            if times < 0:
                for row in own:
                    self.line(f"{row} = -{row}")
            self.count_changes(self._between("here", own, "sweep_a", "end_"))
            self.line(f"often_{name}, not_{name} = changes > 1, below")
        self.source.lines(f"""
            rises = (here_0 > 0.0) & (here_{self.degree - 1} <= 0.0)  # before the end, at which it is from above
            often_below_ = often_below_ | (rises & sweep_ends & (end_ >= 1.0))
            narrow = sweep_h <= {number(self.eps)}
            several = tl.where(side > 0.0, often_above, often_below_)
            leaves = tl.where(side > 0.0, not_above, not_below_)
            often = often_above | often_below_
        """)

    def _onward(self) -> None:
        """To the next part, or to the first half of this one."""
        self.source.lines("""
            counted = counted | told
            moves = left & (narrow | ~often)
            halves = left & ~moves
            behind = counted & (leaves | several)
            late = counted & (end_ >= until)  # left within rounding
            there = tl.where(not_above, tl.where(not_below_, nothing, nothing - 1.0), nothing + 1.0)
            moved = tl.where((side == 0.0) | behind, there, tl.where(late, 0.0, side))
            side = tl.where(moves, moved, side)
            counted = counted & ~(moves & (behind | late))
        """)
        self._move("sweep_a", "sweep_h", "sweep_parts")
        self.source.lines("""
            past = moves & (end_ >= 1.0)
            met, over_ = met | told, over_ | past
            left = left & ~(told | past)
        """)
