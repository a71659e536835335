"""The march as one Triton program: rays in, light and optical depth out. `ops.march` says what it means.

`program` tells how rays are cut and go on (read it first). Of every sample then:

    optics      opacity α by a binary search among the control points, optical depth τ (`ops.cuda.optics`)
    compose     T = exp(−depth), weight w = T (1 − e^{−τ}); light += w · colour, depth += τ

What no ray of the warp needs is not computed: colours and lights where all weights are 0. τ and w keep their digits for
small α and τ, where log and exp alone would lose them.

It was run in Triton's interpreter and compiled for GPUs, but not timed on one; double precision is slow on many.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from filterlab.ops.autograd import differentiating
from filterlab.ops.cuda import optics
from filterlab.ops.cuda.optics import RGB
from filterlab.ops.cuda.program import Program, launch
from filterlab.ops.cuda.source import Source
from filterlab.ops.cuda.tape import Node, Tape
from filterlab.ops.stencil import Lowered

if TYPE_CHECKING:
    from filterlab.ops.march import March


@dataclass(frozen=True)
class Recipe:
    """See `ops.cuda.program.Recipe`."""

    stencil: Lowered
    lights: int | None
    skipping: bool
    own = ("light", "optical_depth")

    def write(self) -> Source:
        return _March("march", self).write()


class _March(Program):
    def begin(self) -> None:
        for k in RGB:
            self.line(f"light_{k} = tl.full((BLOCK,), 0.0, tl.float64)")

    def sample(self) -> None:
        tape, rows = Tape(self.source), self.rows(active=False)
        located = optics.locate(tape, rows[0], active=False)
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


@differentiating(False)
def run(march: March, report: Callable[[int], None] = lambda rays: None) -> tuple[Tensor, Tensor]:
    """`ops.march.March.run` on the device of its tensors: light (R, 3) and optical depth (R,), float64."""
    rays, device = march.rays.count.shape[0], march.coefficients.device
    light = torch.zeros(rays, 3, dtype=torch.float64, device=device)
    depth = torch.zeros(rays, dtype=torch.float64, device=device)
    if rays:
        lights = None if march.lighting is None else march.lighting.lights
        recipe = Recipe(march.stencil.lowered, lights, march.bricks is not None)
        launch(recipe, march, {"light": light, "optical_depth": depth})
        report(rays)
    return light, depth
