"""How many voxels, how much memory and time does each method need to be as accurate as the usual one at n³?

The usual reconstruction (trilinear; for gradients with central differences) is measured at some resolutions n. For
every other method the least resolution m is sought at which its RMS error is no larger:

    E_method(m) ≤ E_usual(n) < E_method(m − 1),

by bisection over integers, with E measured at every step at the same uniform random points. Between m − 1 and m the
crossing is interpolated, log E against log m. Then fields of these resolutions take turns: time per sample at the same
world points, time to build, memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import pairwise
from typing import Annotated, Literal

import torch
from pydantic import AfterValidator, Field, model_validator

import filterlab as fl
from experiments.config import (
    BoundaryName,
    Dtype,
    Recipe,
    Recipes,
    check_signal,
    increasing,
    torch_dtype,
)
from experiments.rms_error import Truth, evaluate
from experiments.runs import Record, Run, Unit
from experiments.timing import CLOCKS, TimedConfig, along_rays, cost_record, ratio
from filterlab.costs import measure
from filterlab.io.config import StrictModel
from filterlab.scenes.model import SignalModel

Quantity = Literal["value", "gradient"]
ORDERS: dict[Quantity, int] = {"value": 0, "gradient": 1}  # of the jets that are timed
Resolution = Annotated[int, Field(ge=2, le=512)]
Resolutions = Annotated[list[Resolution], Field(min_length=1), AfterValidator(increasing)]


class Study(StrictModel):
    """One signal; points are drawn from its box shrunk to `inner`."""

    signal: SignalModel
    inner: Annotated[float, Field(gt=0, le=1)] = 0.9


class Comparison(StrictModel):
    """What must be equal, and the usual reconstruction."""

    quantity: Quantity
    usual: Recipe


class Config(TimedConfig):
    """Resolution, memory and time at equal error.

    Attributes:
        resolutions: of the usual reconstruction.
        smallest, largest: the resolutions that are tried for the others.
        points: for the errors. `timed_points`: for the times. `seconds`: of timing, for each group of equals.
    """

    experiment: Literal["equal_error"]
    studies: Annotated[list[Study], Field(min_length=1)]
    comparisons: Annotated[list[Comparison], Field(min_length=1)]
    resolutions: Resolutions
    methods: Recipes
    smallest: Resolution = 4
    largest: Resolution = 256
    boundary: BoundaryName = "reflect"
    points: Annotated[int, Field(ge=10, le=10**8)] = 100_000
    timed_points: Annotated[int, Field(ge=10, le=10**8)] = 50_000
    seconds: Annotated[float, Field(ge=0)] = 2.0
    dtype: Dtype = "float32"

    @model_validator(mode="after")
    def _in_order(self) -> Config:
        if self.smallest >= self.largest:
            raise ValueError(f"expected smallest < largest; got {self.smallest} and {self.largest}")
        quantities = [c.quantity for c in self.comparisons]
        if len(set(quantities)) < len(quantities):
            raise ValueError(f"expected each quantity once; got {quantities}")
        return self

    @property
    def usual(self) -> list[Recipe]:
        """The usual reconstructions, each once."""
        return list({c.usual.key: c.usual for c in self.comparisons}.values())


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the signals can be evaluated."""
    for i, study in enumerate(config.studies):
        check_signal(study.signal, f"{path}studies[{i}].signal")


def units(config: Config) -> list[Unit]:
    """Per study: the usual errors, the search of every method, and the times of those that are equal."""
    work = []
    for i, study in enumerate(config.studies):
        name = study.signal.name
        voxels = sum((n / 128) ** 3 for n in config.resolutions)
        work += [Unit(f"{i}/usual/{r.key}", f"{name}, {r.key} at n³", 0.2 + 0.4 * voxels) for r in config.usual]
        work += [Unit(f"{i}/search/{r.key}", f"{name}, search for {r.key}", 2.0) for r in config.methods]
        for c in config.comparisons:
            work += [
                Unit(
                    f"{i}/times/{c.quantity}/{n}",
                    f"{name}, times at the {c.quantity} error of {n}³",
                    _seconds(config, n),
                )
                for n in config.resolutions
            ]
    return work


def _seconds(config: Config, n: int) -> float:
    return 2 * config.seconds + len(config.methods) * (n / 256) ** 3


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit."""
    index, what, *rest = unit.key.split("/")
    study = config.studies[int(index)]
    common = {"study": int(index), "signal": study.signal.label, "kind": what}
    if what == "times":
        quantity, n = rest
        (comparison,) = (c for c in config.comparisons if c.quantity == quantity)
        return {**common, "quantity": quantity, "resolution": int(n), **_times(config, index, comparison, int(n), run)}
    listed = config.usual if what == "usual" else config.methods
    recipe = next(r for r in listed if r.key == rest[0])
    errors = _measured(config, int(index), recipe, run)
    if what == "usual":
        return {**common, **recipe.record(), "errors": {str(n): errors(n) for n in config.resolutions}}
    return {**common, **recipe.record(), **_search(config, index, errors, run)}


def _measured(config: Config, index: int, recipe: Recipe, run: Run) -> Callable[[int], Record]:
    """n -> the errors at n³, each computed once."""
    study, dtype = config.studies[index], torch_dtype(config.dtype)
    signal = study.signal.build()
    truth = run.memo(
        f"truth:{index}",
        lambda: Truth.of(signal, config.points, study.inner, config.seed, dtype, config.device),
    )

    @cache
    def errors(n: int) -> Record:
        volume = run.memo(f"volume:{index}/{n}", lambda: signal.sample(n, dtype=dtype, device=config.device))
        return truth.errors(*evaluate(recipe.build(volume, config.boundary), truth.points))

    return errors


def _search(config: Config, index: str, errors: Callable[[int], Record], run: Run) -> Record:
    """What is needed for each comparison and resolution, and everything that was measured on the way."""
    tried: dict[int, Record] = {}

    def error(n: int, quantity: Quantity) -> float:
        tried[n] = errors(n)
        return tried[n][f"{quantity}_rms"]

    needed: dict[str, dict[str, Record]] = {}
    grid = coarse(config.smallest, config.largest)
    for i, c in enumerate(config.comparisons):
        usual = run.records[f"{index}/usual/{c.usual.key}"]["errors"]
        needed[c.quantity] = {}
        for j, n in enumerate(config.resolutions):
            target = usual[str(n)][f"{c.quantity}_rms"]
            found = least_resolution(lambda m, q=c.quantity: error(m, q), target, grid)
            also = {} if found.resolution is None else errors(found.resolution)
            needed[c.quantity][str(n)] = {**asdict(found), "target": target, "errors": also}
            run.advance((i + (j + 1) / len(config.resolutions)) / len(config.comparisons))
    return {"needed": needed, "tried": {str(n): tried[n] for n in sorted(tried)}}


def coarse(smallest: int, largest: int) -> list[int]:
    """Resolutions from the smallest to the largest, each about a third larger than the one before."""
    grid = [smallest]
    while grid[-1] < largest:
        grid.append(min(max(grid[-1] + 1, round(grid[-1] * 4 / 3)), largest))
    return grid


@dataclass(frozen=True)
class Needed:
    """The resolution that an error needs.

    Attributes:
        resolution: the least one that reaches it; None where none that was tried does.
        crossing: where the error is reached between that resolution and the one below, interpolated; None where nothing
            below was tried, or nothing reaches it.
    """

    resolution: int | None
    crossing: float | None


def least_resolution(error: Callable[[int], float], target: float, grid: Sequence[int]) -> Needed:
    """The least n with error(n) ≤ target, between neighbours of the grid where the error comes to stay below it.

    Two neighbours in a row must be below (or the last one): where a signal is not resolved yet, an error may dip.
    Within the bracket the error is taken to fall; it is cut at the log-log interpolated crossing and in the middle in
    turn.
    """
    bracket = _bracket(error, target, grid)
    if bracket is None:
        return Needed(None, None)
    above, below = bracket
    if above is None:
        return Needed(below, None)
    interpolate = True
    while below - above > 1:
        guess = math.ceil(_crossing(error, target, above, below)) if interpolate else (above + below) // 2
        middle = min(max(guess, above + 1), below - 1)
        above, below = (above, middle) if error(middle) <= target else (middle, below)
        interpolate = not interpolate
    return Needed(below, _crossing(error, target, above, below))


def _bracket(error: Callable[[int], float], target: float, grid: Sequence[int]) -> tuple[int | None, int] | None:
    """(the last resolution above the target or None, the first below it); None if the error never stays below."""
    above: int | None = None
    for n, following in pairwise([*grid, grid[-1]]):
        if error(n) > target:
            above = n
        elif error(following) <= target:
            return above, n
    return None


def _crossing(error: Callable[[int], float], target: float, above: int, below: int) -> float:
    """Where log error, linear in log n between the two, is log target."""
    high, low = math.log(error(above)), math.log(max(error(below), 1e-300))
    part = (high - math.log(max(target, 1e-300))) / (high - low)
    return above * (below / above) ** min(max(part, 0.0), 1.0)


def _times(config: Config, index: str, comparison: Comparison, n: int, run: Run) -> Record:
    """Costs of the usual reconstruction at n³ and of all that are as accurate, measured in turn."""
    quantity, signal = comparison.quantity, config.studies[int(index)].signal.build()
    chosen: dict[str, tuple[Recipe, int]] = {"usual": (comparison.usual, n)}
    for recipe in config.methods:
        needed = run.records[f"{index}/search/{recipe.key}"]["needed"][quantity][str(n)]
        if needed["resolution"] is not None:
            chosen[recipe.key] = recipe, needed["resolution"]
    volumes = {m: signal.sample(m, dtype=torch_dtype(config.dtype), device=config.device) for _, m in chosen.values()}
    candidates = {key: _builder(recipe, volumes[m], config.boundary) for key, (recipe, m) in chosen.items()}
    found = {}
    for half, (order, points) in enumerate(_orders(config, signal, n).items()):
        costs = measure(
            candidates,
            points,
            order=ORDERS[quantity],
            seconds=config.seconds,
            clock=CLOCKS[config.clock],
            tick=lambda done, half=half: run.advance((half + done) / 2),
        )
        found[order] = _with_ratios({key: cost_record(cost) for key, cost in costs.items()})
    return {"resolutions": {key: m for key, (_, m) in chosen.items()}, "costs": found}


def _builder(recipe: Recipe, volume: fl.Volume, boundary: str) -> Callable[[], fl.Field]:
    return lambda: recipe.build(volume, boundary)


def _orders(config: Config, signal: fl.Field, n: int) -> dict[str, torch.Tensor]:
    """Points in two orders: along rays, half a voxel of n³ apart, and the same at random."""
    rays = along_rays(signal, config.timed_points, 0.5 / n, config.device)
    shuffled = torch.randperm(len(rays), generator=torch.Generator().manual_seed(config.seed)).to(rays.device)
    return {"rays": rays, "random": rays[shuffled]}


def _with_ratios(costs: Mapping[str, Record]) -> dict[str, Record]:
    return {key: {**cost, "ratio": ratio(cost, costs["usual"])} for key, cost in costs.items()}
