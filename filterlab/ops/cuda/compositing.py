"""The march as one Triton program: rays in, light and optical depth out. `ops.march` says what it means.

`segments` tells how rays are cut and go on (read it first). Of every sample then:

    optics      opacity α of the interval between control points, optical depth τ (`ops.cuda.optics`)
    compose     T = exp(−depth), weight w = T (1 − e^{−τ}); light += w · colour, depth += τ

What no ray of the warp needs is not computed: colours and lights where all weights are 0. τ and w keep their digits for
small α and τ, where log and exp alone would lose them.

Rays are in double precision, which is slow on many GPUs that are not made for computing.
"""

from __future__ import annotations

from dataclasses import dataclass

from filterlab.ops.cuda import optics
from filterlab.ops.cuda.optics import RGB
from filterlab.ops.cuda.segments import Program
from filterlab.ops.cuda.source import Source
from filterlab.ops.cuda.tape import Node, Tape
from filterlab.ops.tetrahedra import LoweredStencil


@dataclass(frozen=True)
class MarchVariant:
    """See `ops.cuda.segments.RayVariant`."""

    stencil: LoweredStencil
    lights: int | None
    skipping: bool
    even: bool
    own = ("light", "optical_depth")

    def write(self) -> Source:
        return _March("march", self).write()


class _March(Program):
    def begin(self) -> None:
        for k in RGB:
            self.line(f"light_{k} = tl.full((BLOCK,), 0.0, tl.float64)")

    def sample(self) -> None:
        tape, rows = Tape(self.source), self.rows(active=False)
        located = optics.locate(tape, rows[0], active=False, even=self.even)
        optics.optical_depth(tape, optics.opacity(tape, located), Node("thickness", active=False))
        self.weights()
        self.pass_on()
        self.line("seen = weight != 0.0")
        with self.if_any("seen"):
            color = optics.color(tape, located, optics.color_ends(tape, active=False))
            color = self.lit(tape, color, rows, self.uniform(active=False))
            for k in RGB:
                self.line(f"light_{k} += tl.where(seen, weight * {color[k]}, 0.0).to(tl.float64)")

    def end(self) -> None:
        for k in RGB:
            self.line(f"tl.store(light + 3 * ray + {k}, light_{k}, inside)")
        self.line("tl.store(optical_depth + ray, passed, inside)")
