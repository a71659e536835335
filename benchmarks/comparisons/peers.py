"""The fused sum against other libraries: value, or value and gradient, of the same coefficients at the same points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

from torch import Tensor

from benchmarks import workloads
from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, race_item
from benchmarks.peers import samplers
from benchmarks.peers.task import Sampling
from benchmarks.records import Bar, at_most
from benchmarks.settings import Settings
from filterlab import kernels, ops
from filterlab.kernels import Kernel
from filterlab.methods import reconstruct

_KEYS = kernels.bc(0, Fraction(3, 4), "keys")  # the kernel of torch's bicubic modes
assert isinstance(_KEYS, Kernel)
_KERNELS: dict[str, Kernel] = {
    "linear": kernels.LINEAR,
    "bspline2": kernels.bspline(2),
    "bspline3": kernels.bspline(3),
    "keys": _KEYS,
}


@dataclass(frozen=True)
class _Case:
    title: str
    kernel: str
    gradient: bool
    seconds: float


_CASES: dict[str, _Case] = {
    "trilinear-value": _Case("trilinear value", "linear", False, 4),
    "trilinear": _Case("trilinear value + gradient", "linear", True, 20),
    "triquadratic-value": _Case("triquadratic value", "bspline2", False, 30),
    "triquadratic": _Case("triquadratic value + gradient", "bspline2", True, 30),
    "tricubic-value": _Case("tricubic value", "bspline3", False, 35),
    "tricubic": _Case("tricubic value + gradient", "bspline3", True, 40),
    "keys-value": _Case("cubic convolution (a = −¾) value", "keys", False, 1),
}

_TOLERANCE = 1e-4  # points from −1 to 1, or 0 to 1, as textures take them, lose 7 bits of float32 at 128 voxels

# (case, arrangement, peer): the bar of the bare sum against it
_BARS: dict[tuple[str, str, str], Bar] = {
    ("triquadratic", "coherent", "Dr.Jit by hand"): at_most("0.85"),
    ("triquadratic", "random", "Dr.Jit by hand"): at_most("1.1"),
    ("tricubic", "coherent", "Dr.Jit eval_cubic_grad"): at_most("0.75"),
}


def _race(settings: Settings, key: str, arrangement: str) -> Race:
    case = _CASES[key]
    volume = workloads.noise(settings.voxels)
    where = workloads.points(arrangement, settings.voxels, settings.points)
    task = Sampling(case.kernel, case.gradient, volume, where, settings.threads)
    contestants = [_bare(task), _field(task)]
    absent: dict[str, str] = {}
    for peer in samplers(case.kernel, case.gradient):
        if why := peer.missing():
            absent[peer.NAME] = why
        else:
            contestants.append(peer.sampling(task))
    ratios = [
        Ratio(ours.name, peer.name, _BARS.get((key, arrangement, peer.name)) if ours.name == "fused op" else None)
        for peer in contestants[2:]
        for ours in contestants[:2]
    ]
    return Race(f"{case.title}, points {arrangement}", contestants, ratios, tolerance=_TOLERANCE, absent=absent)


def _bare(task: Sampling) -> Contestant:
    """The sum alone, as most peers compute it: nothing beyond the ends, no prefilter."""
    coefficients, points = task.coefficients[None, None], task.points[None]
    kernel, order = _KERNELS[task.kernel], int(task.gradient)

    def call() -> Tensor:
        return ops.jet(coefficients, points, kernel, order, 0, "cpu")

    def numbers(rows: Tensor) -> list[Tensor]:
        return [rows[0, 0, 0], *([rows[0, 0, 1:]] if task.gradient else [])]

    return Contestant("fused op", call, task.computes, numbers, len(task.points))


def _field(task: Sampling) -> Contestant:
    """The same through a field, with its boundary."""
    field = reconstruct(task.coefficients, _KERNELS[task.kernel], prefilter=False, scheme="fused")
    call: Callable[[], tuple[Tensor, ...]] = lambda: field.jet(task.points, int(task.gradient))  # noqa: E731
    return Contestant(
        "fused field", call, task.computes, lambda jet: [jet[0], *(g.T for g in jet[1:])], len(task.points)
    )


def _items(settings: Settings) -> list[Item]:
    return [
        race_item(f"{key}-{arrangement}", case.seconds, lambda s, k=key, a=arrangement: _race(s, k, a))
        for key, case in _CASES.items()
        for arrangement in workloads.ARRANGEMENTS
    ]


COMPARISON = Comparison("peers", "the fused sum against other libraries on the same coefficients and points", _items)
