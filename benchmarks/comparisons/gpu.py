"""On a GPU: the Triton sum against plain torch there, and against eight samples of the texture units."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks import workloads
from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, race_item
from benchmarks.peers import cupy_texture
from benchmarks.settings import Settings
from filterlab import ops
from filterlab.kernels import bspline


def _race(settings: Settings, arrangement: str) -> Race:
    """Triquadratic value and gradient; a call ends when the GPU has."""
    what = f"triquadratic value + gradient on a GPU, points {arrangement}"
    if not torch.cuda.is_available():
        return Race(what, [], absent={"everything": "no GPU that torch can use"})
    volume = workloads.noise(settings.voxels).cuda()
    points = workloads.points(arrangement, settings.voxels, settings.points).cuda()
    contestants = [
        _contestant("fused", lambda: _jet(volume, points, "cuda"), len(points)),
        _contestant("direct", lambda: _jet(volume, points, "reference"), len(points)),
    ]
    ratios, absent = [Ratio("fused", "direct")], {}
    if why := cupy_texture.missing():
        absent[cupy_texture.NAME] = why
    else:
        call = cupy_texture.triquadratic(volume, points)
        contestants.append(_contestant(cupy_texture.NAME, call, len(points), computes=None))
        ratios.append(Ratio("fused", cupy_texture.NAME))
    return Race(what, contestants, ratios, absent=absent)


def _jet(volume: Tensor, points: Tensor, implementation: str) -> Tensor:
    return ops.jet(volume[None, None], points[None], bspline(2), 1, 0, implementation)[0, 0]


def _contestant(
    name: str, call: Callable[[], Tensor], samples: int, computes: str | None = "value and gradient"
) -> Contestant:
    def finished() -> Tensor:
        rows = call()
        torch.cuda.synchronize()
        return rows

    return Contestant(name, finished, computes, lambda rows: (rows[0], rows[1:]), samples)


def _items(settings: Settings) -> list[Item]:
    return [race_item(a, 2, lambda s, a=a: _race(s, a)) for a in workloads.ARRANGEMENTS]


COMPARISON = Comparison("gpu", "on a GPU: the fused sum against plain torch and against the texture units", _items)
