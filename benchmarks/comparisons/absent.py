"""What a scene leaves out costs nothing: the frame without a section in units of the frame with it.

    cost(a part of the samples) ÷ cost(all of them)    is compared with    that part itself

so that a row says not only that less is faster, but whether what is left out is left out altogether.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, Tick, run_race
from benchmarks.records import Figure, Outcome, Spread
from benchmarks.scene import Scene, marschner_lobb
from benchmarks.settings import Settings
from filterlab.costs import per_round

_TERMINATION = 0.01


@dataclass(frozen=True)
class _Frame:
    """One scene and the options of `render` that it is drawn with."""

    scene: Scene
    options: Mapping[str, Any]

    @staticmethod
    def of(scene: Scene, **options: Any) -> _Frame:
        return _Frame(scene, options)

    def contestant(self, name: str) -> Contestant:
        field = self.scene.field("triquadratic", "fused")

        def call() -> tuple[Tensor]:
            with torch.no_grad():
                return (self.scene.image(field, **self.options),)

        return Contestant(name, call, samples=max(self.scene.samples(field, **self.options), 1))


def _scene(settings: Settings, **changes: Any) -> Scene:
    """Unlit, unless said; every sample of it is seen."""
    whole = marschner_lobb(settings.image_voxels, settings.image, threads=settings.threads, lit=False)
    return replace(whole, **changes)


def _with_opacity(scene: Scene, opacity: float) -> Scene:
    table = scene.table.clone()
    table[:, 3] = opacity
    return replace(scene, table=table)


def _box(scene: Scene, part: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The middle of the volume, `part` of it along every axis."""
    domain = scene.field("trilinear", "direct").domain
    middle = [(a + b) / 2 for a, b in zip(domain.lower, domain.upper, strict=True)]
    half = [part * (b - a) / 2 for a, b in zip(domain.lower, domain.upper, strict=True)]
    lower = tuple(m - h for m, h in zip(middle, half, strict=True))
    return lower, tuple(m + h for m, h in zip(middle, half, strict=True))


Frames = dict[str, _Frame]


def _lighting(settings: Settings) -> Frames:
    return {"unlit": _Frame.of(_scene(settings)), "lit": _Frame.of(_scene(settings, lit=True))}


def _region(part: float) -> Callable[[Settings], Frames]:
    def frames(settings: Settings) -> Frames:
        scene = _scene(settings)
        return {"cropped": _Frame.of(scene, region=_box(scene, part)), "whole": _Frame.of(scene)}

    return frames


def _no_region(settings: Settings) -> Frames:
    """Both show the whole volume."""
    scene = _scene(settings)
    return {"no region": _Frame.of(scene), "region of everything": _Frame.of(scene, region=_box(scene, 1.0))}


def _jitter(settings: Settings) -> Frames:
    scene = _scene(settings)
    return {"no jitter": _Frame.of(scene), "jitter": _Frame.of(scene, jitter_seed=1)}


def _opaque(settings: Settings) -> Frames:
    """Every value is opaque, or of an opacity that light passes to the end."""
    scene = _scene(settings)
    return {name: _Frame.of(_with_opacity(scene, a)) for name, a in (("opaque", 1.0), ("transparent", 0.005))}


def _termination(settings: Settings) -> Frames:
    """In a medium through which little light passes: what ends early, and what does not ask to."""
    scene = _with_opacity(_scene(settings), 0.1)
    return {"ending": _Frame.of(scene, termination=_TERMINATION), "not ending": _Frame.of(scene)}


def _no_termination(settings: Settings) -> Frames:
    """In a haze so thin that no ray ends: what asking costs."""
    scene = _with_opacity(_scene(settings), 1e-4)
    return {"no termination": _Frame.of(scene), "termination": _Frame.of(scene, termination=_TERMINATION)}


def _empty(settings: Settings) -> Frames:
    """Every value has opacity 0, or some."""
    scene = _scene(settings)
    return {name: _Frame.of(_with_opacity(scene, a)) for name, a in (("empty", 0.0), ("full", 0.005))}


_RACES: dict[str, tuple[str, float, Callable[[Settings], Frames]]] = {
    "lighting": ("no lighting against a headlight", 20, _lighting),
    "region-half": ("the middle half along every axis against everything", 15, _region(0.5)),
    "region-tenth": ("the middle tenth along every axis against everything", 15, _region(0.1)),
    "region-unasked": ("no region against one that leaves nothing out", 15, _no_region),
    "jitter": ("no jitter against some", 15, _jitter),
    "opaque": ("opacity 1 everywhere against 0.005 a voxel", 15, _opaque),
    "termination": (f"opacity 0.1 a voxel: ending at {_TERMINATION} against not ending", 15, _termination),
    "termination-unasked": ("a haze that no ray ends in: not asked to end against asked", 15, _no_termination),
    "empty": ("opacity 0 everywhere against 0.005 a voxel", 15, _empty),
}


def _run(name: str, settings: Settings, tick: Tick) -> Outcome:
    what, _, build = _RACES[name]
    frames = build(settings)
    contestants = [frame.contestant(label) for label, frame in frames.items()]
    less, more = contestants
    scene = next(iter(frames.values())).scene
    described = f"image {scene.size}², volume {scene.volume.shape[-1]}³, step {scene.step:g} voxel, triquadratic fused"
    race = Race(f"{what}; {described}", contestants, [Ratio(less.name, more.name)])
    outcome = run_race(name, race, settings, tick)
    if less.samples == more.samples or len(outcome.timings) < 2:
        return outcome
    part = less.samples / more.samples
    a, b = (timing.seconds for timing in outcome.timings)
    extra = (
        Figure(name=f"{less.name} ÷ {more.name}, samples", spread=Spread.of([part])),
        Figure(name=f"{less.name} ÷ {more.name}, per sample", spread=Spread.of([r / part for r in per_round(a, b)])),
    )
    return outcome.model_copy(update={"figures": (*outcome.figures, *extra)})


def _items(_settings: Settings) -> list[Item]:
    return [
        Item(name, seconds, lambda s, tick, name=name: _run(name, s, tick)) for name, (_, seconds, _) in _RACES.items()
    ]


COMPARISON = Comparison("absent", "frames without a section of the scene against frames with it", _items)
