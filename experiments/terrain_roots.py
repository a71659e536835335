"""Do Newton's steps from four safe starts find the first root of a quartic? The method of paper and shader, and ours.

The paper starts Newton's method at both ends of [0, 1] and at both inflection points, at the ends where these lie
outside, takes six steps and returns the smallest component in [0, 1]. From there it converges, if it does, but six
steps need not be enough, and a component that has not arrived anywhere is returned as well. A residual test,
|p(t)| ≤ r max |c_i|, throws such components away; twelve steps are the least that leave few.

Every answer is judged in exact arithmetic (`experiments.exact_roots`): lost, invented, later, inaccurate.

Source: High-quality rendering of quartic spline surfaces on the GPU, section V.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from math import inf
from typing import Annotated, Literal

import torch
from pydantic import AfterValidator, Field
from torch import Generator, Tensor

from experiments import polynomial_families as families
from experiments.config import Dtype, ExperimentConfig
from experiments.exact_roots import judge
from experiments.root_finding import tolerance
from experiments.runs import Record, Run, Unit
from filterlab.bernstein import to_monomial
from filterlab.names import unknown_name
from filterlab.ops.differentiable import height_hits
from filterlab.roots import first_root
from filterlab.surfaces import HeightField

_DEGREE = 4
_SIDE = 64  # data along an edge of the terrain
_RESIDUAL = {"float32": 1e-5, "float64": 1e-6}  # of the largest coefficient


# --- quartics ---------------------------------------------------------------------------------------------------------


def _known(name: str, count: int, generator: Generator) -> Tensor:
    return families.FAMILIES[name](_DEGREE, count, generator)[0]


def _on_a_terrain(count: int, generator: Generator) -> Tensor:
    """Pieces of rays at a C¹ spline of noise, as many of them as have coefficients of both signs."""
    heights = torch.rand(_SIDE, _SIDE, generator=generator, dtype=torch.float64)
    given = HeightField(heights, "c1").cast
    parts: list[Tensor] = []
    while sum(map(len, parts)) < count:
        origins = torch.rand(count, 3, generator=generator, dtype=torch.float64) * torch.tensor([_SIDE, _SIDE, 0])
        directions = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
        origins[:, 2], directions[:, 2] = 4, -directions[:, 2].abs()
        parts.append(height_hits.candidates(given, origins, directions).coefficients)
    return torch.cat(parts)[:count]


def _grazing(count: int, generator: Generator) -> Tensor:
    """(t − a)² q(t), q > 0, less or more by 10⁻⁹ to 10⁻³ of its range."""
    root = torch.rand(count, generator=generator, dtype=torch.float64)
    q = 0.2 + torch.rand(count, 3, generator=generator, dtype=torch.float64)
    c = families.product(families.pair(root, torch.zeros_like(root)), q)
    gap = 10 ** (-9 + 6 * torch.rand(count, generator=generator, dtype=torch.float64))
    sign = 1 - 2 * (torch.rand(count, generator=generator, dtype=torch.float64) < 0.5).double()
    return c + (sign * gap * (c.amax(-1) - c.amin(-1)))[:, None]


def _four_roots(count: int, generator: Generator) -> Tensor:
    c = torch.ones(count, 1, dtype=torch.float64)
    for _ in range(_DEGREE):
        c = families.product(c, families.factor(torch.rand(count, generator=generator, dtype=torch.float64)))
    return c


def _quadratics(count: int, generator: Generator) -> Tensor:
    c = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
    return families.product(c, torch.ones(count, 3, dtype=torch.float64))


QUARTICS: dict[str, Callable[[int, Generator], Tensor]] = {
    "random coefficients": partial(_known, "random"),
    "rays at the C1 terrain": _on_a_terrain,
    "grazing rays": _grazing,
    "four roots": _four_roots,
    "two roots close together": partial(_known, "near-double"),
    "small leading coefficient": partial(_known, "small-leading"),
    "raised quadratics": _quadratics,
}
"""What is solved: (count, generator) -> Bernstein coefficients (count, 5), float64."""


# --- solvers ----------------------------------------------------------------------------------------------------------


def newton(c: Tensor, steps: int, residual: float | None = None) -> Tensor:
    """The smallest in [0, 1] of four iterates, ∞ where none is; those whose |p| is larger than `residual` · max |c_i|
    left out."""
    powers = to_monomial(c)
    t = _starts(powers)
    for _ in range(steps):
        value, slope = _horner(powers, t)
        t = t - value / slope
    there = (t >= 0) & (t <= 1)
    if residual is not None:
        there &= _horner(powers, t)[0].abs() <= residual * c.abs().amax(-1, keepdim=True)
    return torch.where(there, t, inf).amin(-1)


def _starts(powers: Tensor) -> Tensor:
    """(N, 4): 0, both inflection points, 1; for those outside, 0 and 1."""
    a, b, d = 12 * powers[:, 4], 6 * powers[:, 3], 2 * powers[:, 2]
    root = (b * b - 4 * a * d).sqrt()
    low, high = torch.stack(((-b - root) / (2 * a), (-b + root) / (2 * a))).sort(0).values
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    low, high = (torch.where((x >= 0) & (x <= 1), x, end) for x, end in ((low, zero), (high, one)))
    return torch.stack((zero, low, high, one), -1)


def _horner(powers: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """p and p′ at t (N, 4)."""
    value, slope = powers[:, -1:].expand_as(t), torch.zeros_like(t)
    for a in powers[:, :-1].flip(-1).unbind(-1):
        slope, value = slope * t + value, value * t + a[:, None]
    return value, slope


SOLVERS: dict[str, Callable[[Tensor, str], Tensor]] = {
    "6 steps, as printed": lambda c, _: newton(c, 6),
    "6 steps, residual test": lambda c, dtype: newton(c, 6, _RESIDUAL[dtype]),
    "12 steps, residual test": lambda c, dtype: newton(c, 12, _RESIDUAL[dtype]),
    "filterlab": lambda c, _: first_root(c),
}


# --- the experiment ---------------------------------------------------------------------------------------------------


def _known_family(name: str) -> str:
    if name not in QUARTICS:
        raise ValueError(unknown_name("family", name, QUARTICS))
    return name


class Config(ExperimentConfig):
    """Which quartics, and how many.

    Attributes:
        families: of `QUARTICS`; left out, all.
        dtypes: of the coefficients and the search.
        count: quartics of each family and type, all of them judged exactly.
    """

    experiment: Literal["terrain_roots"]
    families: Annotated[list[Annotated[str, AfterValidator(_known_family)]], Field(min_length=1)] | None = None
    dtypes: Annotated[list[Dtype], Field(min_length=1)]
    count: Annotated[int, Field(ge=1, le=10**6)]

    def work(self) -> dict[str, tuple[str, Dtype]]:
        """Unit keys -> family, type."""
        return {f"{f}/{d}".replace(" ", "-"): (f, d) for d in self.dtypes for f in self.families or QUARTICS}


def units(config: Config) -> list[Unit]:
    """One per family and type."""
    return [Unit(key, f"{f}, {d}", 2e-3 * config.count) for key, (f, d) in config.work().items()]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit: verdicts on every solver's answers, and how far first roots were off at most."""
    family, dtype = config.work()[unit.key]
    generator = torch.Generator().manual_seed(config.seed)
    c = QUARTICS[family](config.count, generator).to(getattr(torch, dtype))
    verdicts = {}
    for done, (name, solve) in enumerate(SOLVERS.items(), 1):
        verdicts[name] = dict(_judged(c, solve(c, dtype)))
        run.advance(done / len(SOLVERS))
    return {"family": family, "dtype": dtype, "count": config.count, "verdicts": verdicts}


def _judged(c: Tensor, t: Tensor) -> Counter[str]:
    bits = {torch.float32: 24, torch.float64: 53}[c.dtype]
    pairs = zip(c.tolist(), t.tolist(), strict=True)
    return Counter(judge(own, root, tolerance(c), digits=bits) for own, root in pairs)
