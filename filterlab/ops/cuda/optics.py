"""What a sample looks like: transfer function and shading, with their derivatives; the twin of `ops.cpu.optics`.

Same letters and tables. The interval of a value is a step of an even table, as `Transfer.steps` says, or found by a
binary search among the inner control points, each of whose loads waits for the one before. All functions write lines
into the source of a tape; names that it must have: `inner`, `opacities`, `colors`, the tables; `inner_points`,
`halvings`, integers; `low`, `scale`, `last` of the steps; `infinity`; `arithmetic`, the dtype.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from filterlab.ops.cuda.source import Source, number
from filterlab.ops.cuda.tape import Node, Tape

RGB = range(3)


@dataclass(frozen=True)
class OnTable:
    """Where values fall between control points; the number of the row is `interval`.

    Attributes:
        ends: x₀ x₁ α₀ α₁.
        fraction: w.
    """

    ends: list[Node]
    fraction: Node

    @property
    def colored(self) -> str:
        """Whether the interval has an opacity other than 0 at one of its ends."""
        return " | ".join(f"({end} != 0.0)" for end in self.ends[2:])


def locate(tape: Tape, value: Node, active: bool, even: bool) -> OnTable:
    """A NaN is looked up in the first interval, where its fraction is NaN.

    Args:
        active: whether derivatives by the control points are asked; here and in `color_ends`.
        even: whether the control points stand at equal steps.
    """
    (_step_of if even else _search)(tape.source, value)
    ends = [_loaded(tape, f"end_{k}", f"opacities + 4 * interval + {k}", active) for k in range(4)]
    low, high, _, _ = ends
    share = tape.divide("share", tape.subtract("above", value, low), tape.subtract("width_of_interval", high, low))
    return OnTable(ends, tape.clamp_fraction("fraction", share))


def _step_of(source: Source, value: Node) -> None:
    source.line(f"steps = ({value} - low.to(arithmetic)) * scale.to(arithmetic)")
    source.line("steps = tl.where(steps > 0.0, steps, 0.0)  # NaN too: no comparison with it is true")
    source.line("interval = tl.where(steps < last.to(arithmetic), steps, last.to(arithmetic)).to(tl.int64)")


def _search(source: Source, value: Node) -> None:
    source.line("interval = tl.full((BLOCK,), 0, tl.int64)")
    with source.block("for half in range(halvings)"):
        source.line("further = interval + (tl.full((), 1, tl.int64) << (halvings - 1 - half))")
        source.line("beyond = further <= inner_points")
        source.line("control = tl.load(inner + further - 1, beyond, 0.0)")
        source.line(f"interval = tl.where(beyond & ({value} >= control), further, interval)")


def _loaded(tape: Tape, name: str, address: str, active: bool) -> Node:
    tape.source.line(f"{name} = tl.load({address})")
    return Node(name, active)


def opacity(tape: Tape, located: OnTable) -> Node:
    return tape.blend("alpha", located.ends[2], located.ends[3], located.fraction)


def color_ends(tape: Tape, active: bool) -> list[Node]:
    """r₀ r₁ g₀ g₁ b₀ b₁."""
    return [_loaded(tape, f"color_end_{k}", f"colors + 8 * interval + {k}", active) for k in range(6)]


def color(tape: Tape, located: OnTable, ends: Sequence[Node]) -> list[Node]:
    return [tape.blend(f"color_{k}", ends[2 * k], ends[2 * k + 1], located.fraction) for k in RGB]


def optical_depth(tape: Tape, alpha: Node, length: Node) -> Node:
    """τ = −log1p(−α) · s; ∞ for α = 1 over any s > 0, with derivative 0 there. s is in units of the opacity."""
    line = tape.source.line
    line(f"opaque_here = {alpha} >= 1.0")
    line(f"minus = tl.where(opaque_here, 0.0, -{alpha})")
    line("sum = 1.0 + minus  # log1p(minus), after Kahan")
    line("rest = tl.where(sum == 1.0, 1.0, sum - 1.0)")
    line("density = -tl.where(sum == 1.0, minus, tl.log(sum) * (minus / rest))")
    return tape.record(
        "tau",
        f"tl.where(opaque_here & ({length} > 0.0), infinity.to(arithmetic), density * {length})",
        (alpha, f"tl.where(opaque_here, 0.0, {length} / sum)"),
        (length, "tl.where(opaque_here, 0.0, density)"),
    )


@dataclass(frozen=True)
class Lights:
    """What shading needs besides the sample; the same all along a ray.

    Attributes:
        ambient, shininess: numbers.
        toward, halfway: for every light l and h, three nodes each.
        diffuse, specular: for every light D and S, three nodes each (red, green, blue).
    """

    ambient: Node
    shininess: Node
    toward: list[list[Node]]
    halfway: list[list[Node]]
    diffuse: list[list[Node]]
    specular: list[list[Node]]


def shade(tape: Tape, color: list[Node], gradient: list[Node], lights: Lights) -> list[Node]:
    """The lit colour; of a zero gradient only the ambient part."""
    normal = _normal(tape, gradient)
    matt = [lights.ambient] * 3
    shine: list[Node | None] = [None] * 3
    vectors_and_tints = zip(lights.toward, lights.halfway, lights.diffuse, lights.specular, strict=True)
    for i, (toward, halfway, diffuse, specular) in enumerate(vectors_and_tints):
        facing = tape.absolute(f"facing_{i}", tape.dot(f"along_light_{i}", normal, toward))
        half = tape.absolute(f"half_facing_{i}", tape.dot(f"along_halfway_{i}", normal, halfway))
        highlight = _power(tape, f"highlight_{i}", half, lights.shininess)
        for k in RGB:
            matt[k] = tape.multiply_add(f"matt_{i}_{k}", diffuse[k], facing, matt[k])
            name, before = f"shine_{i}_{k}", shine[k]
            shine[k] = (
                tape.multiply(name, specular[k], highlight)
                if before is None
                else tape.multiply_add(name, specular[k], highlight, before)
            )
    return [
        tape.multiply(f"lit_{k}", color[k], matt[k])
        if (bright := shine[k]) is None
        else tape.multiply_add(f"lit_{k}", color[k], matt[k], bright)
        for k in RGB
    ]


def _normal(tape: Tape, gradient: list[Node]) -> list[Node]:
    """The gradient made a unit vector; 0 for a zero gradient.

    It is first divided by its largest component, held constant, which changes no normal: then its square can be taken.
    """
    line, (x, y, z) = tape.source.line, gradient
    line(f"largest = tl.abs({x})")
    for g in (y, z):
        line(f"largest = tl.where(tl.abs({g}) > largest, tl.abs({g}), largest)")
    line("largest = tl.where(largest == 0.0, 1.0, largest)")
    scaled = [tape.record(f"scaled_{k}", f"{g} / largest", (g, "1.0 / largest")) for k, g in enumerate(gradient)]
    square = tape.dot("square", scaled, scaled)
    inverse = tape.record(
        "inverse",
        f"1.0 / tl.sqrt(tl.where({square} == 0.0, 1.0, {square}))",
        (square, "-0.5 * inverse * inverse * inverse"),
    )
    return [tape.multiply(f"normal_{k}", s, inverse) for k, s in enumerate(scaled)]


def _power(tape: Tape, name: str, base: Node, exponent: Node) -> Node:
    """base^exponent for 0 ≤ base ≤ 1, more is rounding; 0 with derivative 0 at base = 0."""
    tape.source.line(f"known_{name} = tl.where({base} == 0.0, 1.0, {base})")
    tape.source.line(f"logarithm_{name} = tl.log2(tl.where(known_{name} > 1.0, 1.0, known_{name}))")
    return tape.record(
        name,
        f"tl.where({base} == 0.0, 0.0, tl.exp2(logarithm_{name} * {exponent}))",
        (base, f"{exponent} * {name} / known_{name}"),
        (exponent, f"{name} * logarithm_{name} * {number(math.log(2))}"),
    )
