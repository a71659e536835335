"""Direct volume rendering: the marcher of a fused field against that of a plain one, against peers, against itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, Tick, race_item
from benchmarks.peers import marchers
from benchmarks.probe import measured
from benchmarks.records import Bar, Figure, Outcome, Spread, at_most
from benchmarks.scene import Scene, blobs, marschner_lobb, without_skipping
from benchmarks.settings import Settings

_BARS = {"direct": at_most("1/40"), "Dr.Jit loop": at_most("0.35"), "VTK fixed-point": at_most("0.3")}
_STEPS = (200, 2000)
_PROCESSES = 7  # pairs of them
_LEAST = 2.0**20  # bytes; less counts as so much: it is chance


def _contestant(scene: Scene, method: str, scheme: str, name: str | None = None) -> Contestant:
    """A frame without derivatives."""
    field = scene.field(method, scheme)

    def call() -> tuple[Tensor]:
        with torch.no_grad():
            return (scene.image(field),)

    return Contestant(name or scheme, call, f"{method} image", samples=scene.size**2)


def _scene(settings: Settings, **options: Any) -> Scene:
    return marschner_lobb(settings.image_voxels, settings.image, threads=settings.threads, **options)


def _lit(settings: Settings) -> Race:
    """The bars are for the triquadratic; the Dr.Jit loop is tricubic, and so compared with that one too."""
    scene = _scene(settings)
    contestants = [
        _contestant(scene, "triquadratic", "fused"),
        _contestant(scene, "triquadratic", "direct"),
        _contestant(scene, "tricubic", "fused", "fused tricubic"),
    ]
    ratios = [Ratio("fused", "direct", _BARS["direct"])]
    absent: dict[str, str] = {}
    for peer in marchers():
        if why := peer.missing():
            absent[peer.NAME] = why
            continue
        contestants.append(peer.marching(scene))
        ratios.append(Ratio("fused", peer.NAME, _BARS.get(peer.NAME)))
        if contestants[-1].computes == "tricubic image":
            ratios.append(Ratio("fused tricubic", peer.NAME))
    return Race(
        f"{_described(scene)}, lit, triquadratic unless said", contestants, ratios, tolerance=5e-4, absent=absent
    )


def _described(scene: Scene) -> str:
    n = scene.volume.shape[-1]
    return f"image {scene.size}², volume {n}³ float32, step {scene.step:g} voxel"


def _unlit(settings: Settings, scheme: str, bar: Bar | None) -> Race:
    lit = _scene(settings)
    unlit = replace(lit, lit=False)
    contestants = [_contestant(lit, "triquadratic", scheme, "lit"), _contestant(unlit, "triquadratic", scheme, "unlit")]
    contestants = [replace(c, computes=None) for c in contestants]
    return Race(f"{_described(lit)}, triquadratic {scheme}", contestants, [Ratio("unlit", "lit", bar)])


def _skipping(settings: Settings) -> Race:
    """The same image, bit by bit."""
    scene = blobs(settings.image_voxels, settings.image, threads=settings.threads)
    skipping = _contestant(scene, "triquadratic", "fused", "skipping")
    everything = replace(skipping, name="not skipping", call=without_skipping(skipping.call))
    return Race(
        f"{_described(scene)}, lit, 80 % of the bricks of 8³ voxels empty",
        [everything, skipping],
        [Ratio("skipping", "not skipping", at_most("0.4"))],
        tolerance=0.0,
    )


def _backward(settings: Settings) -> Race:
    """Gradient of the mean of an image, of half the size, to volume and transfer function."""
    scene = marschner_lobb(settings.image_voxels, settings.image // 2, threads=settings.threads)
    forward = _contestant(scene, "triquadratic", "fused", "forward")
    volume = scene.volume.clone().requires_grad_()
    table = scene.table.clone().requires_grad_()

    def both() -> tuple[Tensor, ...]:
        image = scene.image(scene.field("triquadratic", "fused", volume), table)
        torch.autograd.grad(image.mean(), (volume, table))
        return (image.detach(),)

    contestants = [forward, Contestant("forward + backward", both, forward.computes, samples=forward.samples)]
    what = f"{_described(scene)}, lit, triquadratic fused: gradients to volume and transfer function"
    return Race(what, contestants, [Ratio("forward + backward", "forward", at_most("4"))])


def _memory(settings: Settings, tick: Tick) -> Outcome:
    """Both numbers of steps in turn, each time in a process of its own.

    What is compared is the memory beyond that before rendering, the least with the least and so on to the most: it
    differs by some MiB from process to process.
    """
    size = settings.image
    beyond, whole = [], []
    for done in range(_PROCESSES):
        pair = [
            measured("memory", threads=settings.threads, voxels=settings.image_voxels, size=size, steps=steps)
            for steps in _STEPS
        ]
        beyond.append([measure["peak"] - measure["before"] for measure in pair])
        whole.append([measure["peak"] for measure in pair])
        tick((done + 1) / _PROCESSES)
    few, many = _STEPS
    figures = [
        _megabytes(f"{steps} steps, beyond what there was before", list(own))
        for steps, own in zip(_STEPS, zip(*beyond, strict=True), strict=True)
    ]
    return Outcome(
        name="memory",
        what=f"peak memory of forward + backward, triquadratic fused, lit, image {size}², volume "
        f"{settings.image_voxels}³: {many} against {few} steps a ray",
        figures=(
            _ratio(f"{many} ÷ {few} steps, beyond what there was before", beyond, at_most("1.1")),
            _ratio(f"{many} ÷ {few} steps, whole process", whole),
            *figures,
        ),
    )


def _megabytes(name: str, values: list[float]) -> Figure:
    return Figure(name=name, spread=Spread.of([value / 2**20 for value in values]), unit="MiB")


def _ratio(name: str, pairs: list[list[float]], bar: Bar | None = None) -> Figure:
    ranks = zip(*(sorted(own) for own in zip(*pairs, strict=True)), strict=True)
    ratios = [max(many, _LEAST) / max(few, _LEAST) for few, many in ranks]
    return Figure(name=name, spread=Spread.of(ratios), bar=bar)


_ITEMS: dict[str, tuple[float, Callable[[Settings], Race]]] = {
    "lit": (60, _lit),
    "unlit": (40, lambda s: _unlit(s, "fused", at_most("0.7"))),
    "unlit-direct": (60, lambda s: _unlit(s, "direct", None)),
    "skipping": (30, _skipping),
    "backward": (30, _backward),
}


def _items(settings: Settings) -> list[Item]:
    races = [race_item(name, seconds, build) for name, (seconds, build) in _ITEMS.items()]
    return [*races, Item("memory", 60, _memory)]


COMPARISON = Comparison("dvr", "frames: fused against plain and against peers; lighting, skipping, derivatives", _items)
