"""What derivatives and better filters cost, in units of the fused value and gradient."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks import workloads
from benchmarks.comparisons.jets import field_contestant
from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, race_item
from benchmarks.records import Bar, at_most, below
from benchmarks.settings import Settings
from filterlab import ops
from filterlab.methods import reconstruct

CHECKED = 20_000  # points at which numbers are compared with the plain sum
_POINTS_BAR, _SPLAT_BAR = at_most("1.3"), at_most("2.2")


@dataclass(frozen=True)
class _Pair:
    """Two methods, each with the kind of gradient (None: its own), and the bar of their ratio along rays."""

    one: tuple[str, str | None]
    other: tuple[str, str | None]
    bar: Bar


_PAIRS = {
    "notch": _Pair(("notch", None), ("triquadratic", None), at_most("1.02")),
    "trilinear-central": _Pair(("triquadratic", None), ("trilinear", "central"), below("1")),
}


def _adjoints(settings: Settings, method: str, arrangement: str) -> Race:
    """Forward: `ops.jet` of order 1. Gradient to points: its backward pass, every row weighted. Splat: its adjoint."""
    (term,) = workloads.terms_of(method)
    volume = workloads.noise(settings.voxels)[None, None]
    where = workloads.points(arrangement, settings.voxels, settings.points)[None]
    weights = torch.randn(1, 1, 4, where.shape[1], generator=torch.Generator().manual_seed(2))

    def jet(x: Tensor, implementation: str = "cpu") -> Tensor:
        return ops.jet(volume, x, term.kernels, 1, 0, implementation)

    def splat(implementation: str = "cpu") -> Tensor:
        return ops.splat(weights, where, term.kernels, 1, tuple(volume.shape[2:]), 0, implementation)

    def to_points(count: int, implementation: str = "cpu") -> Callable[[], tuple[Tensor, ...]]:
        x = where[:, :count].clone().requires_grad_()
        out = jet(x, implementation)
        return lambda: torch.autograd.grad(out, x, weights[..., :count], retain_graph=True)

    count = where.shape[1]
    checked = min(CHECKED, count)
    coherent = arrangement == "coherent"
    return Race(
        f"{method} value + gradient and its two adjoints, points {arrangement}",
        [
            Contestant("forward", lambda: jet(where), "forward", lambda r: (r[..., :checked],), count),
            Contestant("gradient to points", to_points(count), "to points", lambda r: (r[0][:, :checked],), count),
            Contestant("splat", splat, "splat", lambda r: (r,), count),
        ],
        [
            Ratio("gradient to points", "forward", _POINTS_BAR if coherent else None),
            Ratio("splat", "forward", _SPLAT_BAR if coherent else None),
        ],
        tolerance=2e-5,
        references={
            "forward": lambda: (jet(where[:, :checked], "reference"),),
            "to points": lambda: to_points(checked, "reference")(),
            "splat": lambda: (splat("reference"),),
        },
    )


def _fields(settings: Settings, pair: _Pair, arrangement: str) -> Race:
    """Two fused fields against each other; each is compared with the plain sum of its own."""
    volume = workloads.noise(settings.voxels)
    where = workloads.points(arrangement, settings.voxels, settings.points)
    checked = where[:CHECKED]
    names, contestants, references = [], [], {}
    for method, gradient in (pair.one, pair.other):
        names.append(f"{method}, {gradient} gradient" if gradient else method)
        made = field_contestant(method, "fused", volume, where, gradient=gradient, name=names[-1], computes=names[-1])
        contestants.append(_first_points(made, len(checked)))
        direct = reconstruct(volume, method, scheme="direct", gradient=gradient)
        references[names[-1]] = lambda direct=direct: direct.value_and_gradient(checked)
    return Race(
        f"{names[0]} against {names[1]}, both fused: value + gradient of a field, points {arrangement}",
        contestants,
        [Ratio(names[0], names[1], pair.bar if arrangement == "coherent" else None)],
        tolerance=2e-5,
        references=references,
    )


def _first_points(c: Contestant, count: int) -> Contestant:
    return Contestant(c.name, c.call, c.computes, lambda result: [part[:count] for part in result], c.samples)


def _items(settings: Settings) -> list[Item]:
    adjoints = [
        race_item(f"{method}-{order}", 3, lambda s, m=method, o=order: _adjoints(s, m, o))
        for method in ("triquadratic", "tricubic")
        for order in workloads.ARRANGEMENTS
    ]
    pairs = [
        race_item(f"{name}-{order}", 2, lambda s, pair=pair, o=order: _fields(s, pair, o))
        for name, pair in _PAIRS.items()
        for order in workloads.ARRANGEMENTS
    ]
    return [*adjoints, *pairs]


COMPARISON = Comparison(
    "derivatives",
    "gradient to points, splat, the notch and the analytic gradient, in units of what they extend",
    _items,
)
