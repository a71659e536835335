"""What would it buy to sample a brick by trilinear interpolation where that is as good as the method asked for?

Along an axis, with coefficients c, second differences δ²c and t in 0 … 1 of the way between samples 0 and 1, the
quadratic and the cubic B-spline f that interpolate the samples differ from the straight line L between them by

    f − L = a(t) δ²c₀ + b(t) δ²c₁        |a| + |b| = (t − t²)/2  ≤  1/8     for both.

Both f and L are averages of coefficients along the other two axes, so that in space, axis by axis,

    |f − L| ≤ ⅛ Σ_axes max |δ²c|         over the coefficients that the cell reads.

The bound of a brick is the largest of its cells. A brick *qualifies* for a budget if its bound is no larger. With s the
share of qualifying bricks and r the time of trilinear ÷ that of the method, time falls to 1 − s(1 − r) at best. For
points it is also measured: they are told apart by brick, each part is sampled, and the parts are put together.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Annotated, Literal

import torch
from pydantic import AfterValidator, Field
from torch import Tensor
from torch.nn.functional import max_pool3d

import filterlab as fl
from experiments.config import BoundaryName, VolumeChoice, check_signal
from experiments.runs import Record, Run, Unit
from experiments.timing import CLOCKS, TimedConfig, along_rays, quartile_record
from filterlab.costs import Quartiles, per_round, take_turns
from filterlab.fields.grid import GridField
from filterlab.io.config import StrictModel
from filterlab.render import OrthographicCamera, TransferFunction, render
from filterlab.scenes.model import SignalModel

CHEAP = "trilinear"


def _increasing(budgets: list[float]) -> list[float]:
    if sorted(set(budgets)) != budgets:
        raise ValueError(f"expected increasing numbers; got {budgets}")
    return budgets


class Sampled(StrictModel):
    """A signal on n³ voxels."""

    signal: SignalModel
    resolution: Annotated[int, Field(ge=4, le=512)]


class Config(TimedConfig):
    """Bricks in which a cheaper method would do.

    Attributes:
        scans, signals: the volumes.
        budgets: allowed differences of values, in parts of the volume's range.
        visible: from which part of the range on the transfer function has opacity.
        brick: cells along an edge.
        points: to compare with the bound; timed_points: along rays, half a voxel apart.
        size: of the unlit orthographic image that is timed; seconds: of each of both timings.
    """

    experiment: Literal["brick_economy"]
    scans: list[VolumeChoice] = Field(default_factory=list)
    signals: list[Sampled] = Field(default_factory=list)
    methods: Annotated[list[Literal["triquadratic", "tricubic"]], Field(min_length=1)]
    budgets: Annotated[
        list[Annotated[float, Field(gt=0, lt=1)]], Field(min_length=1, max_length=6), AfterValidator(_increasing)
    ]
    visible: Annotated[float, Field(gt=0, lt=1)] = 0.2
    brick: Annotated[int, Field(ge=1, le=64)] = 8
    boundary: BoundaryName = "mirror"
    points: Annotated[int, Field(ge=10, le=10**8)] = 200_000
    timed_points: Annotated[int, Field(ge=10, le=10**8)] = 500_000
    size: Annotated[int, Field(ge=1, le=4096)] = 192
    seconds: Annotated[float, Field(ge=0)] = 2.0

    @property
    def sources(self) -> dict[str, VolumeChoice | Sampled]:
        """Key -> every volume that is there."""
        scans = {c.file: c for c in self.scans if c.present}
        return {**scans, **{f"{s.signal.label}, {s.resolution}³": s for s in self.signals}}


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the volumes are there, those that may be missing aside."""
    for i, scan in enumerate(config.scans):
        if scan.present:
            scan.check(f"{path}scans[{i}]")
    for i, sampled in enumerate(config.signals):
        check_signal(sampled.signal, f"{path}signals[{i}].signal")


def units(config: Config) -> list[Unit]:
    """One for every volume and method."""
    seconds = 5 + 3 * config.seconds
    return [Unit(f"{name}/{m}", f"{name}, {m}", seconds) for name in config.sources for m in config.methods]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one volume and method."""
    name, method = unit.key.rsplit("/", 1)
    volume = run.memo(f"volume:{name}", lambda: _volume(config.sources[name]))
    low, high = (float(x) for x in volume.samples.aminmax())
    span = (high - low) or 1.0
    asked, cheap = (_field(volume, m, config.boundary) for m in (method, CHEAP))
    cells = difference_bound(asked) / span
    bricks = of_bricks(cells, config.brick)
    seen = of_bricks(most_coefficient(asked), config.brick) > low + config.visible * span
    qualifying = [bricks <= budget for budget in config.budgets]
    run.advance(0.2)
    return {
        "volume": name,
        "method": method,
        "size": list(asked.coefficients.size),
        "bricks": bricks.numel(),
        "visible_bricks": int(seen.sum()),
        "shares": [float(q.double().mean()) for q in qualifying],
        "visible_shares": [float(q[seen].double().mean()) if seen.any() else None for q in qualifying],
        **_against_truth(config, asked, cheap, cells, span),
        "points": _timed_points(config, asked, cheap, qualifying),
        "image": _timed_images(config, asked, cheap, (low, span)),
    }


def _volume(source: VolumeChoice | Sampled) -> fl.Volume:
    if isinstance(source, VolumeChoice):
        return source.load().to(torch.float32)
    return source.signal.build().sample(source.resolution, dtype=torch.float32)


def _field(volume: fl.Volume, method: str, boundary: str) -> GridField:
    field = fl.reconstruct(volume, method, boundary=boundary)
    assert isinstance(field, GridField)
    return field


# --- bounds -----------------------------------------------------------------------------------------------------------


def difference_bound(field: GridField) -> Tensor:
    """By how much a triquadratic or tricubic field and trilinear interpolation of its samples differ in every cell.

    Returns `(D − 1, H − 1, W − 1)`, one for each cell between neighbouring samples.
    """
    c = field.coefficients.values.squeeze(0).squeeze(0)
    total = torch.zeros(())
    for dim in range(3):
        n = c.shape[dim]
        second = (c.narrow(dim, 0, n - 2) - 2 * c.narrow(dim, 1, n - 2) + c.narrow(dim, 2, n - 2)).abs()
        total = total + _most(second, [2 if axis == dim else 4 for axis in range(3)])
    return _cells(field, total) / 8


def most_coefficient(field: GridField) -> Tensor:
    """The largest coefficient that every cell reads, `(D − 1, H − 1, W − 1)`."""
    return _cells(field, _most(field.coefficients.values.squeeze(0).squeeze(0), [4, 4, 4]))


def _most(x: Tensor, window: list[int]) -> Tensor:
    for dim, n in enumerate(window):
        x = x.unfold(dim, n, 1).amax(-1)
    return x


def _cells(field: GridField, windows: Tensor) -> Tensor:
    """Of windows that begin at coefficient j, those of cells, which begin one before their first sample."""
    for dim, size in enumerate(reversed(field.coefficients.size)):
        windows = windows.narrow(dim, -field.coefficients.start - 1, size - 1)
    return windows


def of_bricks(cells: Tensor, edge: int) -> Tensor:
    """The largest of every brick of cells."""
    return max_pool3d(cells[None, None], edge, ceil_mode=True)[0, 0]


def _against_truth(config: Config, asked: GridField, cheap: GridField, cells: Tensor, span: float) -> Record:
    """The true difference at uniform random points, in parts of the range, and of the bound there."""
    sizes = torch.tensor(asked.coefficients.size, dtype=torch.float64)
    unit = torch.rand(config.points, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(config.seed))
    voxel = unit * (sizes - 1)
    world = asked.domain.geometry.to_world(voxel)
    true = (asked(world) - cheap(world)).abs() / span
    x, y, z = voxel.floor().long().minimum(sizes.long() - 2).unbind(-1)
    bound = cells[z, y, x].double()
    part = true[bound > 1e-6] / bound[bound > 1e-6]
    return {
        "true_rms": float(true.square().mean().sqrt()),
        "true_max": float(true.max()),
        "most_of_bound": float(part.max()) if len(part) else 0.0,
        "share_truly_within": [float((true <= budget).double().mean()) for budget in config.budgets],
    }


# --- times ------------------------------------------------------------------------------------------------------------


def _timed_points(config: Config, asked: GridField, cheap: GridField, qualifying: list[Tensor]) -> Record:
    """Values at points along rays: all by one field, or each point by the field that its brick allows."""
    points = along_rays(asked, config.timed_points, 0.5 / max(asked.coefficients.size[2], 1))
    mixtures = {str(i): partial(mixed, points, asked, cheap, q, config.brick) for i, q in enumerate(qualifying)}
    calls = {"asked": lambda: asked(points), "cheap": lambda: cheap(points), **mixtures}
    return _ratios(config, calls)


def mixed(points: Tensor, asked: GridField, cheap: GridField, qualifying: Tensor, edge: int) -> Tensor:
    """Values (S,): of the cheap field where the brick qualifies, else of the one asked for."""
    last = torch.tensor(qualifying.shape[::-1]) - 1
    brick = asked.domain.geometry.to_voxel(points).floor().int().div(edge, rounding_mode="floor").int()
    x, y, z = brick.clamp_min(0).minimum(last.int()).long().unbind(-1)
    at = qualifying[z, y, x]
    near, far = at.nonzero()[:, 0], (~at).nonzero()[:, 0]
    values = points.new_empty(len(points))
    values[near] = cheap(points[near])
    values[far] = asked(points[far])
    return values


def _timed_images(config: Config, asked: GridField, cheap: GridField, value_range: tuple[float, float]) -> Record:
    """Unlit frames of each field alone, empty space skipped."""
    low, span = value_range
    ends = [low + config.visible * span, low + span]
    transfer = TransferFunction(ends, [[1.0, 1.0, 1.0]] * 2, [0.0, 0.05], asked.domain.voxel_size)
    camera = OrthographicCamera.framing(asked.domain, (0.6, 0.75, -0.55))
    size = (config.size, config.size)
    return _ratios(
        config,
        {name: partial(render, f, camera, transfer, size=size) for name, f in (("asked", asked), ("cheap", cheap))},
    )


def _ratios(config: Config, calls: dict[str, Callable[[], Tensor]]) -> Record:
    """Seconds of the method asked for, and every other call in units of it."""
    with torch.no_grad():
        rounds = take_turns(calls, seconds=config.seconds, clock=CLOCKS[config.clock])
    own = rounds.seconds["asked"]
    others = {name: quartile_record(Quartiles.of(per_round(t, own))) for name, t in rounds.seconds.items()}
    return {"seconds": quartile_record(Quartiles.of(own)), **others}


def projected(share: float | None, ratio: float) -> float:
    """The speed-up of s qualifying samples that take r of the time; the rest, and telling them apart, as before."""
    return math.nan if share is None else 1 / (1 - share * (1 - min(ratio, 1.0)))
