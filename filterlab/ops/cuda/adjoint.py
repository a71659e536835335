"""The adjoint of the march as one Triton program: derivatives of light and depth by all that they are made of.

It marches the same way again (`segments`), front to back, and needs nothing but the result: what segment i changes
behind itself is the rest of the light, known from what has passed. With g the cotangent of the light, γ_i = g · c_i:

    τ̄_i = γ_i T_{i+1} − (g · light − Σ_{j≤i} w_j γ_j) + cotangent of the depth        c̄_i = w_i g

From there the tape goes back to value and gradient, and `Taps.spread` to the coefficients. Nothing of a sample is kept.

Where derivatives go:

    coefficients    atomic additions of every tap, where any row has a derivative
    rays, shading   sums of a ray, held in registers; stored at its end
    table           a ray holds the sums of the interval it is in, and adds them to the interval's row atomically when
                    it leaves: values along a ray are alike, and all rays of an image share few rows. There are TABLES
                    tables, so that fewer programs meet at one, summed afterwards
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

from filterlab.ops.cuda import optics
from filterlab.ops.cuda.optics import RGB, OnTable
from filterlab.ops.cuda.segments import Program
from filterlab.ops.cuda.source import Source
from filterlab.ops.cuda.tape import Node, Tape
from filterlab.ops.cuda.taps import AXES
from filterlab.ops.march_derivatives import TABLE_ROW, columns_of_rays, gradient_columns
from filterlab.ops.tetrahedra import LoweredStencil

TABLES = 64
_ENDS = 10  # numbers of a row of the table that mean something


@dataclass(frozen=True)
class AdjointVariant:
    """See `ops.cuda.segments.RayVariant`.

    Attributes:
        gradients: what is asked, of `ops.march_derivatives.GRADIENTS`.
        derivatives: the stencil of its rows' derivatives, and `raised` as in `Stencil.derivatives`; for "rays".
        tables: how many there are.
    """

    gradients: tuple[str, ...]
    stencil: LoweredStencil
    derivatives: tuple[LoweredStencil, tuple[tuple[int, ...], ...]] | None
    lights: int | None
    skipping: bool
    even: bool
    tables: int = TABLES

    @property
    def own(self) -> tuple[str, ...]:
        """Shapes as in `ops.cpu.compositing.FIELDS`, but for the tables, (tables, intervals, 12)."""
        targets = {"coefficients": "coefficient_gradient", "table": "table_gradient"}
        by_ray = ("ray_gradient",) if {"rays", "shading"} & set(self.gradients) else ()
        asked = tuple(target for name, target in targets.items() if name in self.gradients)
        return ("light", "light_cotangent", "depth_cotangent", *asked, *by_ray)

    def write(self) -> Source:
        return _Adjoint(self).write()


class _Adjoint(Program):
    def __init__(self, variant: AdjointVariant) -> None:
        super().__init__("adjoint", variant)
        self.variant = variant
        self.columns = {
            name: columns
            for name, columns in gradient_columns(variant.lights).items()
            if self.wants("shading" if name in ("shading", "view") else "rays")
        }

    def wants(self, name: str) -> bool:
        return name in self.variant.gradients

    def begin(self) -> None:
        """Cotangents; what is behind everything, g · light; the sums of a ray at 0."""
        self.line("behind = tl.full((BLOCK,), 0.0, tl.float64)")
        for k in RGB:
            self.line(f"g_{k} = tl.load(light_cotangent + 3 * ray + {k}, inside, 0.0)")
            self.line(f"behind += g_{k} * tl.load(light + 3 * ray + {k}, inside, 0.0)")
            self.line(f"g_{k} = g_{k}.to(arithmetic)")
        self.line("g_depth = tl.load(depth_cotangent + ray, inside, 0.0).to(arithmetic)")
        for total in self._sums():
            self.line(f"{total} = tl.full((BLOCK,), 0.0, arithmetic)")
        if self.wants("table"):
            self.line("held = tl.full((BLOCK,), 0, tl.int64)")

    def _sums(self) -> list[str]:
        of_ray = [f"{name}_sum_{i}" for name, columns in self.columns.items() for i in range(_width(columns))]
        return of_ray + [f"held_{k}" for k in range(_ENDS) if self.wants("table")]

    def sample(self) -> None:
        tape = Tape(self.source)
        rows = self.rows(active=self.wants("coefficients") or self.wants("rays"))
        located = optics.locate(tape, rows[0], self.wants("table"), self.even)
        with self._if_it_counts(located):
            thickness = Node("thickness", self.wants("rays"))
            tau = optics.optical_depth(tape, optics.opacity(tape, located), thickness)
            ends = optics.color_ends(tape, self.wants("table"))
            uniform = self.uniform(self.wants("shading"))
            color = self.lit(tape, optics.color(tape, located, ends), rows, uniform)
            self._compose_back(tape, tau, color)
            tape.backward()
            for name, nodes in uniform.items():
                self._add(name, [node.adjoint for node in nodes])
            if self.wants("table"):
                self._hold([*located.ends, *ends])
            self._go_back_to_points(rows, thickness)

    def _if_it_counts(self, located: OnTable) -> AbstractContextManager[None]:
        """The with-block, unless the segments have neither opacity nor derivatives."""
        if self.wants("table"):  # a control point's opacity counts where it is 0, too
            return nullcontext()
        return self.if_any(f"near & ({located.colored})")

    def _compose_back(self, tape: Tape, tau: Node, color: Sequence[Node]) -> None:
        """Adjoints of τ and of the colour; depth and rest of the light behind the segment."""
        self.weights()
        self.line("shown = " + " + ".join(f"g_{k} * {color[k]}" for k in RGB))
        self.line("behind -= tl.where(weight != 0.0, weight * shown, 0.0).to(tl.float64)")
        self.pass_on()
        tape.give(tau, "shown * (transmittance - weight) - behind.to(arithmetic) + g_depth")
        for k in RGB:
            tape.give(color[k], f"weight * g_{k}")

    # --- backwards ---

    def _add(self, name: str, adjoints: Sequence[str | None], mask: str = "near") -> None:
        """To the sums of a ray, if they are asked."""
        for i, adjoint in enumerate(adjoints if name in self.columns else ()):
            if adjoint is not None:
                self.line(f"{name}_sum_{i} += tl.where({mask}, {adjoint}, 0.0)")

    def _hold(self, ends: Sequence[Node]) -> None:
        """Derivatives by the ends of the interval: to those held, once others were let go."""
        self.line("leaves = near & (interval != held)")
        with self.if_any("leaves"):
            self._let_go("leaves")
            for k in range(_ENDS):
                self.line(f"held_{k} = tl.where(leaves, 0.0, held_{k})")
            self.line("held = tl.where(leaves, interval, held)")
        for k, end in enumerate(ends):
            self.line(f"held_{k} += tl.where(near, {end.adjoint}, 0.0)")

    def _let_go(self, mask: str) -> None:
        self.line(f"table = tl.program_id(0).to(tl.int64) % {self.variant.tables} * (inner_points + 1) + held")
        for k in range(_ENDS):
            address = f"table_gradient + {TABLE_ROW} * table + {k}"
            self.line(f'tl.atomic_add({address}, held_{k}.to(tl.float64), {mask}, sem="relaxed")')

    def _go_back_to_points(self, rows: Sequence[Node], thickness: Node) -> None:
        """From the rows to the coefficients, and to where the segment is."""
        if not rows[0].active:
            return
        for row in rows:
            if row.adjoint is None:  # a gradient that lights nothing
                self.line(f"to_{row} = tl.full((BLOCK,), 0.0, arithmetic)")
        if self.wants("rays"):
            self.line(f"to_length = {thickness.adjoint} * per_unit.to(arithmetic)")
        self.line("moves = near & (" + " | ".join(f"(to_{row} != 0.0)" for row in rows) + ")")
        with self.if_any("moves"):
            if self.wants("coefficients"):
                self.taps.spread("coefficient_gradient + cell", "moves", "to_row")
            if self.wants("rays"):
                self._go_back_to_rays(rows)
        self._add("length", ["to_length"], "near & (i == count - 1)")

    def _go_back_to_rays(self, rows: Sequence[Node]) -> None:
        """Points are entry + t direction, t the middle of a segment; the last segment ends where the ray does."""
        assert self.variant.derivatives is not None
        stencil, raised = self.variant.derivatives
        taps = self.taps_of(stencil)
        taps.weigh()  # in place of the others, which are needed no more
        taps.contract("first", "slope")
        for k, axis in enumerate(AXES):
            terms = (f"to_{row} * slope_{raised[k][r]}" for r, row in enumerate(rows))
            self.line(f"to_{axis} = tl.where(moves, {' + '.join(terms)}, 0.0)")
            self.line(f"to_length += 0.5 * direction_{axis}.to(arithmetic) * to_{axis}")
        self._add("entry", [f"to_{axis}" for axis in AXES])
        self._add("direction", [f"to_{axis} * middle.to(arithmetic)" for axis in AXES])

    def end(self) -> None:
        if self.wants("table"):
            self._let_go("inside")
        for name, columns in self.columns.items():
            for i in range(_width(columns)):
                address = f"ray_gradient + {columns_of_rays(self.lights)} * ray + {columns.start + i}"
                self.line(f"tl.store({address}, {name}_sum_{i}.to(tl.float64), inside)")


def _width(columns: slice) -> int:
    return columns.stop - columns.start
