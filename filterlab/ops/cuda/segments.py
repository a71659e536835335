"""What the march and its adjoint have in common on a GPU: rays, their segments and empty space.

A program is one warp of BLOCK neighbouring rays, one for each thread, so that no ray waits for those of another warp.
Its rays are cut into segments exactly as `render.rays.segments` does it, in double precision. While one of them goes
on, every ray takes its next segment:

    where       middle and length of the segment; the first tap of the middle
    empty?      a ray in a brick at a distance d from all that is not empty leaps over what lies within d − 1 bricks
    taps        value, and with lights the gradient, from the same taps (`ops.cuda.taps`)
    sample      what is computed from them: the march or its adjoint

What no ray of the warp needs is not computed: taps where all of them leap.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Protocol

from filterlab.ops.cuda.optics import Lights, shade
from filterlab.ops.cuda.source import Source, any_of
from filterlab.ops.cuda.sums import Sums, sums_of
from filterlab.ops.cuda.tape import Node, Tape
from filterlab.ops.cuda.taps import AXES
from filterlab.ops.tetrahedra import LoweredStencil

BLOCK = 32  # rays of a program; a warp

WRITTEN_OUT = 8
"""Taps, see `Taps`. Triton takes its time for programs of many loads: with its planes written out the adjoint by
everything (triquadratic, two lights) took 12.6 s of one core, in loops 4.8 s, with the same loads and atomic additions
in the machine code, where loops over three planes are written out again (Triton 3.7.1, for sm_80)."""

NUMBERS = ("step", "per_unit", "opaque", "slack", "infinity", "low", "scale", "last")
"""float64, in memory: Triton takes a number of Python for a float32."""
SIZES = ("rays", "depth", "height", "width", "start", "halvings", "inner_points", "bricks_y", "bricks_x", "edge")


class RayVariant(Protocol):
    """Everything a program depends on; can be hashed.

    Attributes:
        stencil: value, and gradient when lit.
        lights: K; None: unlit.
        skipping: whether empty bricks are left out.
        even: whether control points stand at equal steps.
        own: names of the arrays that only this program has.
    """

    @property
    def stencil(self) -> LoweredStencil: ...
    @property
    def lights(self) -> int | None: ...
    @property
    def skipping(self) -> bool: ...
    @property
    def even(self) -> bool: ...
    @property
    def own(self) -> tuple[str, ...]: ...
    def write(self) -> Source: ...


def arrays_of(variant: RayVariant) -> tuple[str, ...]:
    """The first parameters of a program; shapes as in `ops.cpu.compositing.FIELDS`."""
    rays = ("entry", "direction", "length", "offset", "count")
    lit = () if variant.lights is None else ("shading", "view", "world")
    bricks = ("bricks",) if variant.skipping else ()
    return ("coefficients", *rays, "inner", "opacities", "colors", *lit, *bricks, "numbers", *variant.own)


class Program:
    """Writes a program. What is done at its begin, with a segment and at its end are lines of the march or its adjoint.

    Those find `near`, the rays that have a segment here which is not known to be empty, and no NaN; `row_0` …;
    `thickness`, the segment's length in units of the opacity; and keep `passed`, the optical depth behind it.
    """

    def __init__(self, name: str, variant: RayVariant) -> None:
        self.source = Source(name, (*arrays_of(variant), *SIZES, "BLOCK: tl.constexpr"))
        self.line = self.source.line
        self.taps = self.taps_of(variant.stencil)
        self.lights, self.skipping, self.even = variant.lights, variant.skipping, variant.even

    def taps_of(self, stencil: LoweredStencil) -> Sums:
        return sums_of(self.source, stencil, WRITTEN_OUT)

    def begin(self) -> None:
        raise NotImplementedError

    def sample(self) -> None:
        raise NotImplementedError

    def end(self) -> None:
        raise NotImplementedError

    def write(self) -> Source:
        self._begin()
        self.begin()
        with self.source.block(f"while {any_of('goes')}"):
            self._segment()
            self.taps.locate("coefficients")
            self.line("near = goes")
            if self.skipping:
                self._look_for_empty_space()
            with self.if_any("near"):
                self.taps.weigh()
                self.taps.contract("first")
                for r in range(len(self.taps.stencil.rows)):
                    self.line(f"near = near & (row_{r} == row_{r})  # nothing is at a NaN")
                self.sample()
            self.line("i += leap" if self.skipping else "i += 1")
            self.line("goes = inside & (i < count) & ((passed <= opaque) | (passed != passed))  # NaN goes on")
        self.end()
        return self.source

    def if_any(self, mask: str) -> AbstractContextManager[None]:
        """The with-block, for all rays of the warp, unless the mask holds for none of them."""
        return self.source.block(f"if {any_of(mask)}")

    # --- rays and segments ---

    def _begin(self) -> None:
        """Rays and everything else that stays the same."""
        for size in SIZES:
            self.line(f"{size} = {size}.to(tl.int64)")
        for k, name in enumerate(NUMBERS):
            self.line(f"{name} = tl.load(numbers + {k})")
        self.line("arithmetic = opacities.dtype.element_ty")
        self.line("ray = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)")
        self.line("inside = ray < rays")
        for k, axis in enumerate(AXES):
            self.line(f"entry_{axis} = tl.load(entry + 3 * ray + {k}, inside, 0.0)")
            self.line(f"direction_{axis} = tl.load(direction + 3 * ray + {k}, inside, 0.0)")
        for name in ("length", "offset", "count"):
            self.line(f"{name} = tl.load({name} + ray, inside, 0)")
        if self.skipping:
            self.line("longest = tl.abs(direction_x)")
            for axis in "yz":
                self.line(f"longest = tl.where(tl.abs(direction_{axis}) > longest, tl.abs(direction_{axis}), longest)")
            self.line("segments_per_voxel = 1.0 / (longest * step)")
        self.line("passed = tl.full((BLOCK,), 0.0, tl.float64)")
        self.line("i = tl.full((BLOCK,), 0, tl.int64)")
        self.line("goes = inside & (i < count)")

    def _segment(self) -> None:
        """Middle, point and thickness of segment i."""
        line = self.line
        line("end = (i.to(tl.float64) + offset) * step")
        line("end = tl.where(end < length, end, length)")
        line("begin = (i.to(tl.float64) - 1.0 + offset) * step")
        line("begin = tl.where(begin > 0.0, begin, 0.0)")
        line("begin = tl.where(begin < length, begin, length)")
        line("middle = (begin + end) * 0.5")
        for axis in AXES:
            line(f"{axis} = (entry_{axis} + middle * direction_{axis}).to(arithmetic)")
        line("thickness = ((end - begin) * per_unit).to(arithmetic)")

    def _look_for_empty_space(self) -> None:
        """`near`: the rays whose point lies in a brick that is not empty; `leap`: segments to the next one.

        From a point in a brick at distance d, steps of together less than d − 1 bricks along every axis stay within
        bricks at a distance of at least 1. The point itself is looked up as it will be sampled: rounded.
        """
        line = self.line
        line("brick = ((iz >> edge) * bricks_y + (iy >> edge)) * bricks_x + (ix >> edge)")
        line("distance = tl.load(bricks + brick).to(tl.int64)")
        line("near = goes & (distance == 0)")
        line("reach = (((distance - 1) << edge).to(tl.float64) - slack) * segments_per_voxel")
        line(f"reach = tl.where(reach < {2.0**40}, reach, {2.0**40})  # a ray may hardly move")
        line("leap = 1 + tl.where((distance > 0) & (reach > 0.0), reach, 0.0).to(tl.int64)")

    # --- samples ---

    def rows(self, active: bool) -> list[Node]:
        return [Node(f"row_{r}", active) for r in range(len(self.taps.stencil.rows))]

    def weights(self) -> None:
        """`transmittance` T in front of a segment of optical depth `tau`; `weight` T (1 − e^{−τ}), 0 if not near."""
        line = self.line
        line("transmittance = tl.exp(-passed.to(arithmetic))")
        line("left = tl.exp(-tau)  # −expm1(−tau), after Kahan")
        line("usual = (left != 1.0) & (left > 0.0)")
        line("ratio = tau / tl.where(usual, -tl.log(tl.where(usual, left, 0.5)), 1.0)")
        line("taken = tl.where(left == 1.0, tau, tl.where(left == 0.0, 1.0, (1.0 - left) * ratio))")
        line("weight = tl.where(near, transmittance * taken, 0.0)")

    def pass_on(self) -> None:
        """`passed` behind the segment."""
        self.line("passed += tl.where(near, tau, 0.0).to(tl.float64)")

    def uniform(self, active: bool) -> dict[str, list[Node]]:
        """What is the same all along a ray, by name of `ops.march_derivatives.gradient_columns`; empty when unlit."""
        if self.lights is None:
            return {}
        widths = {"shading": 2 + 6 * self.lights, "view": 6 * self.lights}
        for i in range(widths["shading"]):
            self.line(f"shading_{i} = tl.load(shading + {i})")
        for i in range(widths["view"]):
            self.line(f"view_{i} = tl.load(view + {widths['view']} * ray + {i}, inside, 0.0)")
        return {name: [Node(f"{name}_{i}", active) for i in range(width)] for name, width in widths.items()}

    def lit(self, tape: Tape, color: list[Node], rows: Sequence[Node], uniform: dict[str, list[Node]]) -> list[Node]:
        """The colour in the light, if there is any."""
        if self.lights is None:
            return color
        return shade(tape, color, self._world_gradient(tape, rows[1:4]), _lights(uniform, self.lights))

    def _world_gradient(self, tape: Tape, gradient: Sequence[Node]) -> list[Node]:
        """Gradients of the grid in the world: Σ_i gradient_i matrix_ij."""
        for i in range(9):
            self.line(f"world_{i} = tl.load(world + {i})")
        return [tape.combine(f"gradient_{k}", gradient, [f"world_{3 * i + k}" for i in range(3)]) for k in range(3)]


def _lights(uniform: dict[str, list[Node]], count: int) -> Lights:
    shading, view = uniform["shading"], uniform["view"]
    tints = [shading[2 + 3 * i : 5 + 3 * i] for i in range(2 * count)]
    vectors = [view[3 * i : 3 * i + 3] for i in range(2 * count)]
    return Lights(shading[0], shading[1], vectors[::2], vectors[1::2], tints[::2], tints[1::2])
