"""A volume on a grid of 1.5 times as many voxels along every axis, against SimpleITK."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, race_item
from benchmarks.peers import simple_itk
from benchmarks.records import Bar, at_most
from benchmarks.settings import Settings
from filterlab.methods import reconstruct
from filterlab.resampling import resample
from filterlab.sites import Sites
from filterlab.volume import as_volume

# method -> the bar, and the boundary that SimpleITK has
_CASES: dict[str, tuple[Bar, str]] = {
    "trilinear": (at_most("0.6"), "border"),
    "tricubic": (at_most("0.25"), "mirror"),
}


def _race(settings: Settings, method: str) -> Race:
    n = settings.prefilter_voxels
    samples = torch.rand(max(n // 2, 1), n, n, generator=torch.Generator().manual_seed(0))
    shape = tuple(k * 3 // 2 for k in samples.shape)
    bar, boundary = _CASES[method]
    absent: dict[str, str] = {}
    contestants = [_ours(samples, method, shape, boundary), _points(samples, method, shape, boundary)]
    if why := simple_itk.missing():
        absent[simple_itk.NAME] = why
    else:
        contestants.append(simple_itk.resampling(samples, method, shape, settings.threads, "samples"))
    size = " × ".join(str(k) for k in samples.shape)
    return Race(
        f"{size} float32 samples to 1.5 times as many along every axis, {method}, prefilter included",
        contestants,
        [Ratio("resample", simple_itk.NAME, bar), Ratio("resample", "point by point")],
        tolerance=1e-5,
        absent=absent,
    )


def _ours(samples: Tensor, method: str, shape: tuple[int, ...], boundary: str) -> Contestant:
    def call() -> tuple[Tensor, ...]:
        return (resample(samples, method, shape=shape, boundary=boundary).samples,)

    return Contestant("resample", call, "samples", samples=torch.Size(shape).numel())


def _points(samples: Tensor, method: str, shape: tuple[int, ...], boundary: str) -> Contestant:
    """The field, built each time, at every place of the grid."""
    volume = as_volume(samples)
    grid = resample(volume, "nearest", shape=shape)
    sites = Sites.of(volume, (shape[0], shape[1], shape[2]), grid.geometry)

    def call() -> tuple[Tensor, ...]:
        field = reconstruct(volume, method, boundary=boundary)
        values = torch.cat([field(points.float()) for points in sites.points(sites.everything)])
        return (values.reshape(shape),)

    return Contestant("point by point", call, "samples", samples=torch.Size(shape).numel())


def _items(settings: Settings) -> list[Item]:
    return [race_item(name, 60, lambda s, name=name: _race(s, name)) for name in _CASES]


COMPARISON = Comparison("resample", "a volume on a finer grid, against SimpleITK", _items)
