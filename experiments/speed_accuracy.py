"""What does accuracy cost? Errors of value, gradient and image against time per sample, time to build, and memory.

Candidates are methods × variants (scheme, precision of the arithmetic, storage of the coefficients) at several
resolutions of signals that are known exactly. All candidates of one resolution are held at once (75 of 128³: 0.6 GB)
and take turns; their times do not depend on the signal. Images are compared with one of the signal itself, drawn with a
much shorter step: so the step counts as an error too. A candidate is on a front where nobody who costs less is as
accurate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import AfterValidator, BeforeValidator, Field, model_validator
from torch import Tensor

import filterlab as fl
from experiments.claims import Evidence, judged
from experiments.config import (
    BoundaryName,
    Dtype,
    Recipe,
    Recipes,
    VolumeChoice,
    check_signal,
    increasing,
    torch_dtype,
)
from experiments.dvr_signal import amplified_difference, image_errors
from experiments.fronts import front
from experiments.held_out import HeldOut, resolution_of
from experiments.rms_error import Truth, angles, evaluate, uniform_points
from experiments.runs import Record, Run, Unit
from experiments.timing import CLOCKS, TimedConfig, along_rays, cost_record, quartile_record
from experiments.views import Silent, View
from filterlab.costs import Quartiles, measure, take_turns
from filterlab.io.config import StrictModel
from filterlab.methods import scheme_named
from filterlab.scenes.model import SignalModel
from filterlab.signals import Signal

WORK: dict[str, tuple[str, int]] = {  # name -> where the points lie, order of the jet
    "value-rays": ("rays", 0),
    "gradient-rays": ("rays", 1),
    "gradient-random": ("random", 1),
}
Resolutions = Annotated[list[Annotated[int, Field(ge=2, le=512)]], Field(min_length=1), AfterValidator(increasing)]
Positive = Annotated[float, Field(gt=0)]


class Variant(StrictModel):
    """How a method is evaluated; `dtype` is that of samples and points, and so of the arithmetic."""

    name: Annotated[str, Field(min_length=1)]
    dtype: Dtype = "float32"
    scheme: Annotated[Literal["direct", "fused", "sampled"] | None, BeforeValidator(scheme_named)] = None
    sampler: Literal["exact", "texture_unit"] = "exact"
    storage: Literal["float64", "float32", "float16", "bfloat16", "int16", "int8", "uint8"] | None = None

    def of(self, recipe: Recipe) -> Candidate | None:
        """The recipe evaluated so; None where the method does not offer the scheme with that kind of gradient."""
        try:
            fl.METHODS[recipe.name].scheme(self.scheme, recipe.gradient, self.sampler)
        except ValueError:
            return None
        changes = {"scheme": self.scheme, "sampler": self.sampler, "storage": self.storage}
        return Candidate(recipe.model_copy(update=changes), self)


@dataclass(frozen=True)
class Candidate:
    """A method in one of its variants."""

    recipe: Recipe
    variant: Variant

    @property
    def key(self) -> str:
        return self.recipe.key if self.variant.dtype == "float32" else f"{self.recipe.key}+in_{self.variant.dtype}"

    def field(self, volume: fl.Volume, boundary: str) -> fl.Field:
        return self.recipe.build(volume.to(torch_dtype(self.variant.dtype)), boundary)

    def record(self) -> Record:
        return {**self.recipe.record(), "candidate": self.key, "variant": self.variant.name}


class Source(StrictModel):
    """A signal, the part of its box that points are drawn from, and a view where images are compared."""

    signal: SignalModel
    inner: Annotated[float, Field(gt=0, le=1)] = 0.9
    view: View | None = None

    @property
    def name(self) -> str:
        return self.signal.name

    @property
    def label(self) -> str:
        return self.signal.label

    def open(self, device: str) -> Signal:
        """What is known exactly."""
        return self.signal.build()

    def check(self, path: str) -> None:
        """Raises ConfigError unless it can be evaluated."""
        check_signal(self.signal, f"{path}signal")


class ScanSource(StrictModel):
    """A scan that is held out from itself; points keep away from where the cube was cut out of it."""

    volume: VolumeChoice
    inner: Annotated[float, Field(gt=0, le=1)] = 0.8
    view: None = None

    @property
    def name(self) -> str:
        return Path(self.volume.file).name

    @property
    def label(self) -> str:
        return f"{self.name}, low-passed and decimated by two"

    def open(self, device: str) -> HeldOut:
        return HeldOut.of(self.volume.load().samples, device)

    def check(self, path: str) -> None:
        self.volume.check(f"{path}volume")


class ImageStudy(StrictModel):
    """Images of some methods at some resolutions and steps (voxels); those of `shown` (resolution, step) are kept."""

    title: str
    methods: Recipes
    resolutions: Resolutions
    steps: Annotated[list[Positive], Field(min_length=1)]
    shown: tuple[int, float] | None = None


class Config(TimedConfig):
    """Speed against accuracy.

    Attributes:
        volume: a scan, in place of all sources, resolutions and images: what is true of it is known by hold-out
            (`experiments.held_out`), at the one resolution that it has.
        methods: without scheme, sampler and storage, which the variants give.
        points: for the errors. `timed_points`: for the times.
        seconds: of timing, for each resolution and kind of work. `image_seconds`: for each set of images.
        finest: samples of the true image across the box of the signal.
        amplify: differences of images are shown so many times larger.
    """

    experiment: Literal["speed_accuracy"]
    volume: VolumeChoice | None = None
    sources: Annotated[list[Source], Field(min_length=1)]
    resolutions: Resolutions
    methods: Recipes
    variants: Annotated[list[Variant], Field(min_length=1)]
    images: list[ImageStudy] = Field(default_factory=list)
    boundary: BoundaryName = "reflect"
    points: Annotated[int, Field(ge=10, le=10**8)] = 50_000
    timed_points: Annotated[int, Field(ge=10, le=10**8)] = 50_000
    seconds: Annotated[float, Field(ge=0)] = 6.0
    image_seconds: Annotated[float, Field(ge=0)] = 6.0
    finest: Annotated[int, Field(ge=2, le=2**14)] = 2048
    amplify: Positive = 4.0

    @model_validator(mode="after")
    def _candidates_differ(self) -> Config:
        for recipe in self.methods:
            if (recipe.scheme, recipe.sampler, recipe.storage) != (None, "exact", None):
                raise ValueError(f"{recipe.key}: the variants give scheme, sampler and storage; leave them out")
        for variant in self.variants:
            if not any(variant.of(recipe) for recipe in self.methods):
                raise ValueError(f"variant {variant.name!r}: expected at least one method that offers it")
        across = max((n / step for study in self.images for n in study.resolutions for step in study.steps), default=0)
        if self.finest < 2 * across:
            raise ValueError(
                f"expected a true image with at least twice the samples of the others, finest ≥ {2 * across:g}; "
                f"got {self.finest}"
            )
        keys = [c.key for c in self.candidates]
        if twice := {key for key in keys if keys.count(key) > 1}:
            raise ValueError(f"expected variants that differ; {', '.join(sorted(twice))} would be measured twice")
        return self

    @property
    def subjects(self) -> Sequence[Source | ScanSource]:
        """The sources, or the scan."""
        return self.sources if self.volume is None else [ScanSource(volume=self.volume)]

    @property
    def sizes(self) -> list[int]:
        """Resolutions that are measured."""
        return self.resolutions if self.volume is None else [resolution_of(self.volume.header().shape)]

    @property
    def studies(self) -> list[ImageStudy]:
        """Those of images: nothing draws the truth of a scan as finely as a signal's."""
        return self.images if self.volume is None else []

    @property
    def candidates(self) -> list[Candidate]:
        """Every method in every variant that it offers."""
        return [c for v in self.variants for recipe in self.methods if (c := v.of(recipe)) is not None]


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the signals, or the scan, can be evaluated, drawn and compared."""
    for i, source in enumerate(config.subjects):
        source.check(f"{path}sources[{i}]." if config.volume is None else path)
        if isinstance(source, Source) and source.view is not None and config.studies:
            _fine(config, source).check(_signal(config, source).domain, f"{path}sources[{i}].view", compared=True)


def units(config: Config) -> list[Unit]:
    """Times; errors; images of each signal itself and of its reconstructions; then what follows from them."""
    work = []
    for n in config.sizes:
        seconds = 1.2 * config.seconds + len(config.candidates) * (n / 64) ** 3 * 0.01
        work += [Unit(f"cost/{n}/{name}", f"times at {n}³, {name}", seconds) for name in WORK]
    for i, source in enumerate(config.subjects):
        name, each = source.name, 0.02 + config.points * 1e-6
        work += [
            Unit(f"error/{i}/{n}/{c.key}", f"{name} {n}³, {c.key}", each)
            for n in config.sizes
            for c in config.candidates
        ]
    for i, source in enumerate(config.subjects):
        if source.view is not None and config.studies:
            work += _image_units(config, i, source)
    fronts = [Unit(f"front/{i}", f"{s.name}, fronts", 0.1) for i, s in enumerate(config.subjects)]
    return [*work, *fronts, Unit("claims", "what the paper says", 0.1)]


def _image_units(config: Config, i: int, source: Source) -> list[Unit]:
    name = source.name
    seconds = 4.0 * _pixels(source) * config.finest / 1e8
    work = [Unit(f"truth/{i}", f"{name} itself, drawn finely", seconds)]
    for j, study in enumerate(config.studies):
        seconds = 1.5 * config.image_seconds
        work += [Unit(f"images/{i}/{j}/{n}", f"{name} {n}³, images: {study.title}", seconds) for n in study.resolutions]
    return work


def _pixels(source: Source) -> int:
    assert source.view is not None
    return source.view.size[0] * source.view.size[1]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit."""
    what, *rest = unit.key.split("/")
    if what == "cost":
        return {"kind": what, "resolution": int(rest[0]), "work": rest[1], **_cost(config, int(rest[0]), rest[1], run)}
    if what == "claims":
        names = [s.name for s in config.subjects]
        return {"kind": what, "claims": judged(Evidence(run.records, config.sizes, names))}
    index = int(rest[0])
    common = {"kind": what, "source": index, "signal": config.subjects[index].label}
    if what == "error":
        return {**common, "resolution": int(rest[1]), **_error(config, index, int(rest[1]), rest[2], run)}
    if what == "truth":
        return {**common, **_truth(config, config.sources[index], index, run)}
    if what == "images":
        return {
            **common,
            "study": int(rest[1]),
            "resolution": int(rest[2]),
            **_images(config, index, rest[1], rest[2], run),
        }
    return {**common, "fronts": _fronts(config, index, run.records)}


def _cost(config: Config, n: int, work: str, run: Run) -> Record:
    where, order = WORK[work]
    signal = _opened(config, 0, run)
    volumes = {v.dtype: signal.sample(n, dtype=torch_dtype(v.dtype), device=config.device) for v in config.variants}
    rays = along_rays(signal, config.timed_points, 0.5 / n, config.device)
    if where == "random":
        rays = rays[torch.randperm(len(rays), generator=torch.Generator().manual_seed(config.seed)).to(rays.device)]
    points = {c.key: rays.to(torch_dtype(c.variant.dtype)) for c in config.candidates}
    candidates = {c.key: _builder(c, volumes[c.variant.dtype], config.boundary) for c in config.candidates}
    clock = CLOCKS[config.clock]
    costs = measure(candidates, points, order=order, seconds=config.seconds, clock=clock, tick=run.advance)
    return {"costs": {c.key: {**c.record(), **cost_record(costs[c.key])} for c in config.candidates}}


def _builder(candidate: Candidate, volume: fl.Volume, boundary: str) -> Callable[[], fl.Field]:
    return lambda: candidate.field(volume, boundary)


def _error(config: Config, index: int, n: int, key: str, run: Run) -> Record:
    source = config.subjects[index]
    candidate = next(c for c in config.candidates if c.key == key)
    known = _opened(config, index, run)
    truth = run.memo(f"truth:{index}", lambda: _exactly(config, source, known))
    volume = run.memo(f"volume:{index}/{n}", lambda: known.sample(n, device=config.device))
    points = truth.points.to(torch_dtype(candidate.variant.dtype))
    value, gradient = (t.double() for t in evaluate(candidate.field(volume, config.boundary), points))
    return {**candidate.record(), **truth.errors(value, gradient), **angles(gradient, truth.gradient)}


def _opened(config: Config, index: int, run: Run) -> Signal | HeldOut:
    return run.memo(f"source:{index}", lambda: config.subjects[index].open(config.device))


def _exactly(config: Config, source: Source | ScanSource, known: Signal | HeldOut) -> Truth:
    """What is known in float64, at points that float32 holds: every variant is asked at the same ones."""
    points = uniform_points(known, config.points, source.inner, config.seed, torch.float32, config.device).double()
    return Truth(points, *evaluate(known, points))


def _signal(config: Config, source: Source) -> fl.Field:
    """The signal with voxels so small that the true image takes `finest` samples across its box."""
    signal = source.signal.build()
    extent = max(b - a for a, b in zip(signal.domain.lower, signal.domain.upper, strict=True))
    return signal.with_voxel_size(extent / config.finest)


def _fine(config: Config, source: Source) -> View:
    assert source.view is not None
    return source.view.model_copy(update={"step": 1.0})


def _truth(config: Config, source: Source, index: int, run: Run) -> Record:
    image = _fine(config, source).draw(_signal(config, source), run, config.device, "float32")
    files = {"image": run.save_image(f"{index}-truth", image), "array": run.save_array(f"{index}-truth", image)}
    return {**files, "files": list(files.values())}


def _images(config: Config, index: int, study: str, n: str, run: Run) -> Record:
    """Every method with every step: drawn once and compared with the truth, then timed in turn."""
    source, chosen, resolution = config.sources[index], config.studies[int(study)], int(n)
    volume = source.signal.build().sample(resolution, dtype=torch.float32, device=config.device)
    truth = run.memo(f"image:{index}", lambda: run.load_array(run.records[f"truth/{index}"]["array"]))
    calls, entries, files = {}, [], []
    for recipe in chosen.methods:
        field = recipe.build(volume, config.boundary)
        for step in chosen.steps:
            calls[f"{recipe.key}@{step:g}"] = draw = _drawing(config, source, field, step)
            image = draw()
            entry = {**recipe.record(), "step": step, **image_errors(image, truth)}
            if chosen.shown == (resolution, step):
                entry |= _kept(config, f"{index}-{study}-{recipe.key}", image, truth, run)
                files += [entry["image"], entry["difference"]]
            entries.append(entry)
    rounds = take_turns(calls, seconds=config.image_seconds, clock=CLOCKS[config.clock], tick=run.advance)
    for entry, key in zip(entries, calls, strict=True):
        entry["milliseconds"] = quartile_record(Quartiles.of([1e3 * s for s in rounds.seconds[key]]))
    return {"entries": entries, "files": files}


def _drawing(config: Config, source: Source, field: fl.Field, step: float) -> Callable[[], Tensor]:
    assert source.view is not None
    view = source.view.model_copy(update={"step": step})
    return lambda: view.draw(field, Silent(), config.device, "float32")


def _kept(config: Config, stem: str, image: Tensor, truth: Tensor, run: Run) -> Record:
    difference = amplified_difference(image, truth, config.amplify)
    return {
        "image": run.save_image(stem, image),
        "difference": run.save_image(f"{stem}-difference", difference, srgb=False),
    }


def _fronts(config: Config, index: int, records: Mapping[str, Record]) -> list[Record]:
    """Fronts of error against time at each resolution, and of error against memory over all of them."""
    found = []
    for error, work in (("value_rms", "value-rays"), ("gradient_rms", "gradient-rays")):
        everyone = {}
        for n in config.sizes:
            costs = records[f"cost/{n}/{work}"]["costs"]
            errors = {c.key: records[f"error/{index}/{n}/{c.key}"] for c in _taking_part(config, error)}
            points = {f"{n}/{k}": (costs[k]["ns_per_sample"][1], e[error]) for k, e in errors.items()}
            found.append({"error": error, "cost": "time", "resolution": n, "members": front(points)})
            everyone |= {f"{n}/{k}": (costs[k]["bytes"], e[error]) for k, e in errors.items()}
        found.append({"error": error, "cost": "memory", "resolution": None, "members": front(everyone)})
    return found + _image_fronts(config, index, records)


def _taking_part(config: Config, error: str) -> list[Candidate]:
    """Those whose value is one of its own: another kind of gradient changes nothing about it."""
    usual = [c for c in config.candidates if c.record()["default_gradient"]]
    return usual if error == "value_rms" and usual else config.candidates


def _image_fronts(config: Config, index: int, records: Mapping[str, Record]) -> list[Record]:
    found = []
    for n in sorted({n for study in config.studies for n in study.resolutions}):
        points = {}
        for j in range(len(config.studies)):
            for entry in records.get(f"images/{index}/{j}/{n}", {}).get("entries", ()):
                points[f"{n}/{entry['recipe']}@{entry['step']:g}"] = (entry["milliseconds"][1], entry["rms"])
        if points:
            found.append({"error": "image_rms", "cost": "time", "resolution": n, "members": front(points)})
    return found
