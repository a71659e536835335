"""The march as one Triton program: rays in, light and optical depth out. `ops.march` says what it means.

A program is one warp of BLOCK neighbouring rays, one for each thread, so that no ray waits for those of another warp.
Its rays are cut into segments exactly as `render.rays.segments` does it, in double precision. While one of them goes
on, every ray takes its next segment:

    where       middle and length of the segment; the first tap of the middle
    empty?      a ray in a brick at a distance d from all that is not empty leaps over what lies within d − 1 bricks
    taps        value, and with lights the gradient, from the same taps (`ops.cuda.taps`)
    optics      opacity α by a binary search among the control points, optical depth τ
    compose     T = exp(−depth), weight w = T (1 − e^{−τ}); light += w · colour, depth += τ

What no ray of the warp needs is not computed: taps where all of them leap, colours and lights where all weights are 0.
τ and w keep their digits for small α and τ, where log and exp alone would lose them.

There is no adjoint: derivatives of an image on a GPU are the plain marcher's, on `ops.cuda`'s gather and scatter. It
was run in Triton's interpreter and compiled for GPUs, but not timed on one; double precision is slow on many.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from filterlab.ops.cuda.source import Source
from filterlab.ops.cuda.taps import Taps
from filterlab.ops.stencil import Lowered

if TYPE_CHECKING:
    from filterlab.ops.march import March

BLOCK = 32  # rays of a program; a warp

NUMBERS = ("step", "per_unit", "opaque", "slack", "infinity")
"""float64, in memory: Triton takes a number of Python for a float32."""
SIZES = ("rays", "depth", "height", "width", "start", "halvings", "inner_points", "bricks_y", "bricks_x", "edge")


@dataclass(frozen=True)
class Recipe:
    """Everything the program depends on.

    Attributes:
        stencil: value, and gradient when lit.
        lights: K; None: unlit.
        skipping: whether empty bricks are left out.
    """

    stencil: Lowered
    lights: int | None
    skipping: bool

    @property
    def arrays(self) -> tuple[str, ...]:
        """What is read; shapes as in `ops.cpu.march.FIELDS`."""
        rays = ("entry", "direction", "length", "offset", "count")
        lit = () if self.lights is None else ("shading", "view", "world")
        return ("coefficients", *rays, "inner", "opacities", "colors", *lit, *(("bricks",) if self.skipping else ()))

    def write(self) -> Source:
        return _Program(self).write()


class _Program:
    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        parameters = (*recipe.arrays, "numbers", "light", "optical_depth", *SIZES, "BLOCK: tl.constexpr")
        self.source = Source("march", parameters)
        self.taps = Taps(self.source, recipe.stencil)

    def write(self) -> Source:
        line = self.source.line
        self._begin()
        with self.source.block("while tl.reduce(goes.to(tl.int32), 0, either) > 0"):
            self._segment()
            self.taps.locate("coefficients")
            line("near = goes")
            if self.recipe.skipping:
                self._look_for_empty_space()
            with self.source.block("if tl.reduce(near.to(tl.int32), 0, either) > 0"):
                self.taps.weigh()
                self.taps.contract("first")
                self._optics()
                self._compose()
            line("i += leap" if self.recipe.skipping else "i += 1")
            line("goes = inside & (i < count) & ((passed <= opaque) | (passed != passed))  # NaN goes on")
        for k in range(3):
            line(f"tl.store(light + 3 * ray + {k}, light_{k}, inside)")
        line("tl.store(optical_depth + ray, passed, inside)")
        return self.source

    # --- rays and segments ---

    def _begin(self) -> None:
        """Rays and everything else that stays the same; the sums at 0."""
        line = self.source.line
        for size in SIZES:
            line(f"{size} = {size}.to(tl.int64)")
        for k, name in enumerate(NUMBERS):
            line(f"{name} = tl.load(numbers + {k})")
        line("arithmetic = opacities.dtype.element_ty")
        line("ray = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)")
        line("inside = ray < rays")
        for k, axis in enumerate("xyz"):
            line(f"entry_{axis} = tl.load(entry + 3 * ray + {k}, inside, 0.0)")
            line(f"direction_{axis} = tl.load(direction + 3 * ray + {k}, inside, 0.0)")
        for name in ("length", "offset", "count"):
            line(f"{name} = tl.load({name} + ray, inside, 0)")
        if self.recipe.skipping:
            line("longest = tl.abs(direction_x)")
            for axis in "yz":
                line(f"longest = tl.where(tl.abs(direction_{axis}) > longest, tl.abs(direction_{axis}), longest)")
            line("segments_per_voxel = 1.0 / (longest * step)")
        line("passed = tl.full((BLOCK,), 0.0, tl.float64)")
        for k in range(3):
            line(f"light_{k} = passed")
        line("i = tl.full((BLOCK,), 0, tl.int64)")
        line("goes = inside & (i < count)")

    def _segment(self) -> None:
        """Middle, point and thickness (length in units of the opacity) of segment i."""
        line = self.source.line
        line("end = (i.to(tl.float64) + offset) * step")
        line("end = tl.where(end < length, end, length)")
        line("begin = (i.to(tl.float64) - 1.0 + offset) * step")
        line("begin = tl.where(begin > 0.0, begin, 0.0)")
        line("begin = tl.where(begin < length, begin, length)")
        line("middle = (begin + end) * 0.5")
        for axis in "xyz":
            line(f"{axis} = (entry_{axis} + middle * direction_{axis}).to(arithmetic)")
        line("thickness = ((end - begin) * per_unit).to(arithmetic)")

    def _look_for_empty_space(self) -> None:
        """`near`: the rays whose point lies in a brick that is not empty; `leap`: segments to the next one.

        From a point in a brick at distance d, steps of together less than d − 1 bricks along every axis stay within
        bricks at a distance of at least 1. The point itself is looked up as it will be sampled: rounded.
        """
        line = self.source.line
        line("brick = ((iz >> edge) * bricks_y + (iy >> edge)) * bricks_x + (ix >> edge)")
        line("distance = tl.load(bricks + brick).to(tl.int64)")
        line("near = goes & (distance == 0)")
        line("reach = (((distance - 1) << edge).to(tl.float64) - slack) * segments_per_voxel")
        line(f"reach = tl.where(reach < {2.0**40}, reach, {2.0**40})  # a ray may hardly move")
        line("leap = 1 + tl.where((distance > 0) & (reach > 0.0), reach, 0.0).to(tl.int64)")

    # --- samples ---

    def _optics(self) -> None:
        """tau, the optical depth of the segment; of the transfer function interval and fraction."""
        line = self.source.line
        line("interval = tl.full((BLOCK,), 0, tl.int64)")
        with self.source.block("for half in range(halvings)"):
            line("further = interval + (tl.full((), 1, tl.int64) << (halvings - 1 - half))")
            line("beyond = further <= inner_points")
            line("control = tl.load(inner + further - 1, beyond, 0.0)")
            line("interval = tl.where(beyond & (row_0 >= control), further, interval)")
        for k, name in enumerate(("low", "high", "alpha_low", "alpha_high")):
            line(f"{name} = tl.load(opacities + 4 * interval + {k})")
        line("fraction = (row_0 - low) / (high - low)")
        line("fraction = tl.where(fraction < 0.0, 0.0, fraction)")
        line("fraction = tl.where(fraction > 1.0, 1.0, fraction)")
        self._blend("alpha", "alpha_low", "alpha_high")
        line("opaque_here = alpha >= 1.0")
        line("minus = tl.where(opaque_here, 0.0, -alpha)")
        line("sum = 1.0 + minus  # log1p(minus), after Kahan")
        line("rest = tl.where(sum == 1.0, 1.0, sum - 1.0)")
        line("density = -tl.where(sum == 1.0, minus, tl.log(sum) * (minus / rest))")
        line("tau = density * thickness")
        line("tau = tl.where(opaque_here & (thickness > 0.0), infinity.to(arithmetic), tau)")

    def _blend(self, name: str, low: str, high: str) -> None:
        """From low to high by `fraction`, exact at both ends."""
        self.source.line(
            f"{name} = tl.where(fraction < 0.5, {low} + fraction * ({high} - {low}), "
            f"{high} - ({high} - {low}) * (1.0 - fraction))"
        )

    def _compose(self) -> None:
        line = self.source.line
        line("transmittance = tl.exp(-passed.to(arithmetic))")
        line("left = tl.exp(-tau)  # −expm1(−tau), after Kahan")
        line("usual = (left != 1.0) & (left > 0.0)")
        line("ratio = tau / tl.where(usual, -tl.log(tl.where(usual, left, 0.5)), 1.0)")
        line("taken = tl.where(left == 1.0, tau, tl.where(left == 0.0, 1.0, (1.0 - left) * ratio))")
        line("weight = tl.where(near, transmittance * taken, 0.0)")
        line("passed += tl.where(near, tau, 0.0).to(tl.float64)")
        line("seen = weight != 0.0")
        with self.source.block("if tl.reduce(seen.to(tl.int32), 0, either) > 0"):
            for k in range(3):
                line(f"color_low = tl.load(colors + 8 * interval + {2 * k})")
                line(f"color_high = tl.load(colors + 8 * interval + {2 * k + 1})")
                self._blend(f"color_{k}", "color_low", "color_high")
            if self.recipe.lights is not None:
                self._shade(self.recipe.lights)
            for k in range(3):
                line(f"light_{k} += tl.where(seen, weight * color_{k}, 0.0).to(tl.float64)")

    def _shade(self, lights: int) -> None:
        """color_k lit: rgb · (ambient + Σ D |n·l|) + Σ S |n·h|^shininess; of a zero gradient only the ambient part."""
        line = self.source.line
        for k, axis in enumerate("xyz"):
            terms = " + ".join(f"row_{i + 1} * tl.load(world + {3 * i + k})" for i in range(3))
            line(f"n{axis} = {terms}")
        line("largest = tl.abs(nx)")
        for axis in "yz":
            line(f"largest = tl.where(tl.abs(n{axis}) > largest, tl.abs(n{axis}), largest)")
        line("largest = tl.where(largest == 0.0, 1.0, largest)")
        for axis in "xyz":
            line(f"n{axis} = n{axis} / largest")
        line("square = nx * nx + ny * ny + nz * nz")
        line("inverse = 1.0 / tl.sqrt(tl.where(square == 0.0, 1.0, square))")
        for k in range(3):
            line(f"matt_{k} = tl.load(shading)")
            line(f"shine_{k} = 0.0 * inverse")
        for light in range(lights):
            for name, first in (("facing", 6 * light), ("half_facing", 6 * light + 3)):
                terms = (
                    f"n{axis} * tl.load(view + {6 * lights} * ray + {first + k}, inside, 0.0)"
                    for k, axis in enumerate("xyz")
                )
                line(f"{name} = tl.abs({' + '.join(terms)}) * inverse")
            line("highlight = tl.exp2(tl.log2(tl.where(half_facing == 0.0, 1.0, half_facing)) * tl.load(shading + 1))")
            line("highlight = tl.where(half_facing == 0.0, 0.0, highlight)")
            for k in range(3):
                line(f"matt_{k} += tl.load(shading + {2 + 6 * light + k}) * facing")
                line(f"shine_{k} += tl.load(shading + {5 + 6 * light + k}) * highlight")
        for k in range(3):
            line(f"color_{k} = color_{k} * matt_{k} + shine_{k}")


@torch.no_grad()
def run(march: March, report: Callable[[int], None] = lambda rays: None) -> tuple[Tensor, Tensor]:
    """`ops.march.March.run` on the device of its tensors: light (R, 3) and optical depth (R,), float64."""
    from filterlab.ops.cuda.launch import interpreting

    rays, device = march.rays.count.shape[0], march.coefficients.device
    light = torch.zeros(rays, 3, dtype=torch.float64, device=device)
    depth = torch.zeros(rays, dtype=torch.float64, device=device)
    if rays:
        lights = None if march.lighting is None else march.lighting.lights
        recipe = Recipe(march.stencil.lowered, lights, march.bricks is not None)
        arrays = _arrays(march)
        inputs = [arrays[name].detach().resolve_neg().contiguous() for name in (*recipe.arrays, "numbers")]
        sizes = _sizes(march, len(arrays["opacities"]) - 1)
        with torch.cuda.device_of(light):
            _program(recipe, interpreting())[(-(-rays // BLOCK),)](
                *inputs, light, depth, *sizes, BLOCK=BLOCK, num_warps=1
            )
        report(rays)
    return light, depth


def _arrays(march: March) -> dict[str, Tensor]:
    from filterlab.ops.march import _tables

    numbers = (march.step, 1 / march.transfer.unit, march.opaque, march.slack, math.inf)
    return {
        "coefficients": march.coefficients,
        **{name: getattr(march.rays, name) for name in ("entry", "direction", "length", "offset", "count")},
        **_tables(march.transfer),
        **(march._lit() if march.lighting else {}),
        **({"bricks": march.bricks.distance} if march.bricks else {}),
        "numbers": torch.tensor(numbers, dtype=torch.float64, device=march.coefficients.device),
    }


def _sizes(march: March, inner: int) -> tuple[int, ...]:
    """In the order of `SIZES`; `inner` control points between the first and the last."""
    bricks = (0, 0, 0) if march.bricks is None else march.bricks.distance.shape
    edge = march.bricks.edge if march.bricks else 0
    shape = march.coefficients.shape
    return march.rays.count.shape[0], *shape, march.start, inner.bit_length(), inner, bricks[1], bricks[2], edge


@lru_cache(maxsize=256)
def _program(recipe: Recipe, interpreted: bool) -> Any:
    from filterlab.ops.cuda.launch import launchable

    return launchable(recipe.write())
