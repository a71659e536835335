"""Prefilters of a whole volume against scipy.ndimage.spline_filter."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from benchmarks import workloads
from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, race_item
from benchmarks.peers import scipy_ndimage
from benchmarks.records import Bar, at_most
from benchmarks.settings import Settings
from filterlab.ops.differentiable.prefilter import prefilter_samples

_ORDERS = {"quadratic": 2, "cubic": 3}
_BAR = at_most("0.2")
_LABELS = {"cpu": "fused", "reference": "plain torch"}


def _race(settings: Settings, name: str) -> Race:
    n = settings.prefilter_voxels
    samples = workloads.noise(n)
    ours = [_contestant(samples, name, implementation) for implementation in _LABELS]
    absent: dict[str, str] = {}
    peers: list[Contestant] = []
    if why := scipy_ndimage.missing():
        absent[scipy_ndimage.NAME] = why
    else:
        kinds = (np.float32, np.float64)
        peers = [scipy_ndimage.prefiltering(samples, _ORDERS[name], kind, "coefficients") for kind in kinds]
    ratios = [Ratio("fused", "plain torch"), *(Ratio("fused", peer.name, _bar(peer)) for peer in peers)]
    return Race(
        f"{name} prefilter of {n}³ float32, boundary mirror; scipy sums in float64 and stores float32 or float64",
        [*ours, *peers],
        ratios,
        tolerance=5e-6,
        absent=absent,
    )


def _bar(peer: Contestant) -> Bar | None:
    return _BAR if peer.name.endswith("float32") else None


def _contestant(samples: Tensor, name: str, implementation: str) -> Contestant:
    def call() -> tuple[Tensor, ...]:
        with torch.no_grad():
            return (prefilter_samples(samples, name, "mirror", implementation=implementation),)

    return Contestant(_LABELS[implementation], call, "coefficients", samples=samples.numel())


def _items(settings: Settings) -> list[Item]:
    return [race_item(name, 40, lambda s, name=name: _race(s, name)) for name in _ORDERS]


COMPARISON = Comparison("prefilter", "samples to coefficients, against scipy.ndimage.spline_filter", _items)
