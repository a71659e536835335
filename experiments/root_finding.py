"""Does a root finder lose, invent or mix up roots? Families of polynomials that break them, judged in exact arithmetic.

One unit per family, degree and type. Every polynomial goes through a cheap check that knows nothing of how the roots
were found: is p zero at the root, within rounding; has p no other sign before it, at evenly spaced points; is the root
that was put into the polynomial there? Who fails it, and a sample of all, is judged by `experiments.exact_roots`.

Beside `first_root` the closed forms of kornia.geometry.solvers, up to degree 4, on a part of the same polynomials. They
get powers of t, converted in float64, and answer with numbers of which those in [0, 1] (and 10⁻⁹ beyond) are taken.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from math import comb, inf
from typing import Annotated, Literal

import torch
from pydantic import AfterValidator, Field
from torch import Tensor

from experiments.config import Dtype, ExperimentConfig
from experiments.exact_roots import BAD, judge
from experiments.polynomial_families import FAMILIES
from experiments.runs import Record, Run, Unit
from filterlab.bernstein import to_monomial
from filterlab.names import unknown_name
from filterlab.roots import first_root

SOLVERS = ("filterlab", "kornia")
ROUNDINGS = 6  # p is 0 within rounding where |p| ≤ 6 n ε Σ_i |c_i| B_i: what `filterlab.roots` promises
_POINTS = [k / 16 for k in range(1, 17)]  # of the cheap check


def _known_family(name: str) -> str:
    if name not in FAMILIES:
        raise ValueError(unknown_name("family", name, FAMILIES))
    return name


class Config(ExperimentConfig):
    """Which polynomials, and how many.

    Attributes:
        families: names of `experiments.polynomial_families.FAMILIES`; left out, all.
        degrees: 2 to 9.
        dtypes: of the coefficients and the search.
        count: polynomials of each family, degree and type that are solved and checked.
        kornia: how many of them kornia solves as well, all of which are judged.
        exact: how many are judged exactly in any case.
        chunk: how many are made at a time.
    """

    experiment: Literal["root_finding"]
    families: Annotated[list[Annotated[str, AfterValidator(_known_family)]], Field(min_length=1)] | None = None
    degrees: Annotated[list[Annotated[int, Field(ge=2, le=9)]], Field(min_length=1)]
    dtypes: Annotated[list[Dtype], Field(min_length=1)]
    count: Annotated[int, Field(ge=1, le=10**9)]
    kornia: Annotated[int, Field(ge=0, le=10**7)] = 0
    exact: Annotated[int, Field(ge=0, le=10**7)] = 100
    chunk: Annotated[int, Field(ge=1, le=10**8)] = 250_000

    def work(self) -> dict[str, tuple[str, int, Dtype]]:
        """Unit keys -> family, degree, type."""
        return {
            f"{family}/{degree}/{dtype}": (family, degree, dtype)
            for dtype in self.dtypes
            for degree in self.degrees
            for family in self.families or FAMILIES
        }


def units(config: Config) -> list[Unit]:
    """One per family, degree and type."""
    seconds = 2e-6 * config.count + 1e-3 * (config.exact + config.kornia)
    return [Unit(key, f"{f}, degree {n}, {d}", seconds) for key, (f, n, d) in config.work().items()]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit: for every solver how many answers were judged, and what they were."""
    with torch.device(config.device):
        return _computed(config, unit, run)


def _computed(config: Config, unit: Unit, run: Run) -> Record:
    family, degree, dtype = config.work()[unit.key]
    generator = torch.Generator(config.device).manual_seed(config.seed)
    found, done = Counter[str](), 0
    verdicts = {solver: Counter[str]() for solver in SOLVERS}
    examples: dict[str, list[float]] = {}
    while done < config.count:
        c, known = FAMILIES[family](degree, min(config.chunk, config.count - done), generator)
        c = c.to(getattr(torch, dtype))
        t = first_root(c)
        suspects = suspicious(c, t, known)
        found.update(solved=len(c), hits=int((t < inf).sum()), suspects=int(suspects.sum()))
        place = torch.arange(done, done + len(c))
        _judged(verdicts["filterlab"], examples, c, t, suspects | (place < config.exact))
        if degree in CLOSED_FORMS and done < config.kornia:
            _judged(verdicts["kornia"], {}, c, closed_form(c), place < config.kornia)
        done += len(c)
        run.advance(done / config.count)
    return {
        "family": family,
        "degree": degree,
        "dtype": dtype,
        **found,
        "verdicts": {solver: dict(v) for solver, v in verdicts.items() if v},
        "examples": examples,
    }


def _judged(verdicts: Counter[str], examples: dict[str, list[float]], c: Tensor, t: Tensor, which: Tensor) -> None:
    """Count the verdicts on those polynomials, and keep one example of each bad one."""
    bits = {torch.float32: 24, torch.float64: 53}[c.dtype]
    for coefficients, root in zip(c[which].tolist(), t[which].tolist(), strict=True):
        verdict = judge(coefficients, root, tolerance(c), digits=bits)
        verdicts[verdict] += 1
        if verdict in BAD:
            examples.setdefault(verdict, coefficients)


def tolerance(c: Tensor) -> float:
    """In units of Σ_i |c_i| B_i."""
    return ROUNDINGS * (c.shape[-1] - 1) * torch.finfo(c.dtype).eps


# --- the cheap check --------------------------------------------------------------------------------------------------


def suspicious(c: Tensor, t: Tensor, known: Tensor) -> Tensor:
    """(N,): whose root may be wrong. At the root of whoever passes p is 0, and these checks see none before it."""
    eps, allowed = torch.finfo(c.dtype).eps, tolerance(c)
    rows, t = list((c / c.abs().amax(-1, keepdim=True)).double().T.contiguous()), t.double()
    hit = t < inf
    at = torch.where(hit, t, 0)
    value, slope = _de_casteljau(rows, at)
    size, _ = _de_casteljau([r.abs() for r in rows], at)
    no_root = value.abs() > allowed * size + 2 * eps * at * slope.abs()
    moved = 10 * eps**0.5  # by more than this rounding does not move a double root, usually
    return (hit & no_root) | _crossed_before(rows, t) | (known + moved < t)


def _de_casteljau(rows: list[Tensor], t: Tensor) -> tuple[Tensor, Tensor]:
    """p(t) and p′(t)."""
    n = len(rows) - 1
    while len(rows) > 2:
        rows = [torch.lerp(left, right, t) for left, right in pairwise(rows)]
    left, right = rows
    return torch.lerp(left, right, t), n * (right - left)


def _crossed_before(rows: list[Tensor], t: Tensor) -> Tensor:
    """Whether p has another sign than at 0 at one of a few points before t; where c_0 = 0, whether t is not 0."""
    crossed = (rows[0] == 0) & (t != 0)
    sign = rows[0].sign()
    table, stacked = _basis(len(rows) - 1), torch.stack(rows)
    for point, weights in zip(_POINTS, table, strict=True):
        crossed |= ((weights @ stacked) * sign < 0) & (t > point + 1e-9)
    return crossed


def _basis(n: int) -> Tensor:
    """B_i of the points, (points, n + 1)."""
    return torch.tensor(
        [[comb(n, i) * s**i * (1 - s) ** (n - i) for i in range(n + 1)] for s in _POINTS], dtype=torch.float64
    )


# --- kornia -----------------------------------------------------------------------------------------------------------


def _solver(name: str) -> Callable[[Tensor], Tensor]:
    def solve(powers: Tensor) -> Tensor:
        from kornia.geometry import solvers

        return getattr(solvers, name)(powers)

    return solve


CLOSED_FORMS = {2: _solver("solve_quadratic"), 3: _solver("solve_cubic"), 4: _solver("solve_quartic")}


def closed_form(c: Tensor) -> Tensor:
    """The first root in [0, 1] according to kornia, ∞ for none; its zeros, which mean no root, count where c_0 is 0."""
    powers = to_monomial(c.double()).to(c.dtype)
    roots = CLOSED_FORMS[c.shape[-1] - 1](powers.flip(-1))
    there = (roots >= -1e-9) & (roots <= 1 + 1e-9) & ((roots != 0) | (c[:, :1] == 0))
    return torch.where(there, roots.clamp(0, 1), inf).amin(-1)
