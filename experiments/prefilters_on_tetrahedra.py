"""What do prefilters do for splines on tetrahedra: to errors, spectra, noise and surfaces?

Published, these splines have none, and blur: Q f = f + h²/8 Δf + …. A prefilter turns the samples into others first:

    published   none: order 2
    recursive   that of the quadratic B-spline, which cancels h²/8 Δf: order 3
    fir-m       m symmetric taps along each axis, learned (`experiments.fir`)

A prefilter raises what the spline lowers, noise too. Reconstruction is linear: of samples f + σn, with n white noise of
standard deviation 1, the error at a point is e + σν, e that of f and ν the field of n. The noise is independent of e:

    E(σ)² = mean e² + σ² mean ν²,

so that two prefilters are equally good at σ² = (mean e₁² − mean e₂²) / (mean ν₂² − mean ν₁²).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor

import filterlab as fl
from experiments import fir
from experiments.comparison import QUANTITIES, compared
from experiments.config import ExperimentConfig, Recipe, check_signal, increasing, number
from experiments.descent import Parameters, Stage, minimize
from experiments.fit_kernel import AnyClass, Count, check_class
from experiments.fitting import Fit, Objective, parameters_of
from experiments.isosurface_quality import Look, SurfaceDistance, noisy
from experiments.members import Members, Role, Sampling, seed_of
from experiments.partitions import SplineName
from experiments.rms_error import evaluate, uniform_points
from experiments.runs import Record, Run, Unit, timed
from filterlab import metrics, spectrum
from filterlab.io.config import StrictModel
from filterlab.scenes import model as scene
from filterlab.scenes.model import Positive, SignalModel
from filterlab.surfaces import LevelSet

PUBLISHED, RECURSIVE, FIR = "published", "recursive", "fir"
CLEAN, NOISY = "clean", "noisy"
DIRECTIONS = {"along an axis": (1, 0, 0), "face diagonal": (1, 1, 0), "space diagonal": (1, 1, 1)}
BOUNDARY = "reflect"
MARKERS = 4  # of the frequencies, every so many is also measured with the recursive prefilter


def _odd(taps: list[int]) -> list[int]:
    if any(n % 2 == 0 for n in taps):
        raise ValueError(f"a symmetric prefilter has an odd number of taps; got {taps}")
    return increasing(taps)


class Learning(StrictModel):
    """How short prefilters are learned; see `experiments.fit_kernel`, which does so for kernels.

    Attributes:
        source: what members are drawn from.
        taps: of the prefilters along an axis, one after the other.
        training, validation, test: how many members of each.
        points, test_points: at which a member is known.
        resolution, inner: of a member, and where its points lie.
        gradient_weight: of the gradient's error, beside 1 for the value's, each relative to that of `recursive`.
    """

    source: AnyClass
    taps: Annotated[list[Annotated[int, Field(ge=3, le=31)]], Field(min_length=1), AfterValidator(_odd)]
    training: Count = 4
    validation: Count = 4
    test: Count = 8
    points: Annotated[int, Field(ge=10, le=10**6)] = 512
    test_points: Annotated[int, Field(ge=10, le=10**6)] = 2048
    resolution: Annotated[int, Field(ge=4, le=256)] = 24
    inner: Annotated[float, Field(gt=0, le=1)] = 0.55
    gradient_weight: Annotated[float, Field(ge=0)] = 1.0
    iterations: Annotated[int, Field(ge=1, le=10**6)] = 100
    learning_rate: Positive = 0.05


class Pictures(StrictModel):
    """A surface of a signal, with and without noise in the samples.

    Attributes:
        noise: standard deviation, as a share of the samples' range.
    """

    signal: SignalModel
    resolution: Annotated[int, Field(ge=2, le=1024)]
    level: float
    noise: Positive
    material: scene.PhongModel = scene.PhongModel()
    look: Look = Look()

    @model_validator(mode="after")
    def _plain(self) -> Pictures:
        if self.look.error is not None:
            raise ValueError("look.error: these pictures show the surface alone; leave it out")
        return self


class Config(ExperimentConfig):
    """Splines, with every prefilter.

    Attributes:
        signal, resolutions: what errors are measured on.
        noise: standard deviations, as shares of the samples' range.
        upper, frequencies: of the spectra, in multiples of π, and how many of them.
    """

    experiment: Literal["prefilters_on_tetrahedra"]
    splines: Annotated[list[SplineName], Field(min_length=1)]
    learning: Learning
    signal: SignalModel
    resolutions: Annotated[list[Annotated[int, Field(ge=2, le=512)]], Field(min_length=1), AfterValidator(increasing)]
    noise: Annotated[list[Positive], Field(min_length=1)]
    points: Annotated[int, Field(ge=10, le=10**7)] = 20_000
    inner: Annotated[float, Field(gt=0, le=1)] = 0.9
    upper: Annotated[float, Field(gt=0, le=8)] = 2.0
    frequencies: Annotated[int, Field(ge=2, le=1000)] = 65
    pictures: Pictures | None = None

    @model_validator(mode="after")
    def _on_the_cpu(self) -> Config:
        if self.device != "cpu":
            raise ValueError("device: all of this is computed on the CPU; expected device: cpu")
        return self

    @property
    def variants(self) -> list[str]:
        """The prefilters that are compared, none first."""
        return [PUBLISHED, RECURSIVE, *(f"{FIR}{n}" for n in self.learning.taps)]

    @property
    def shown(self) -> list[str]:
        """Those of which there are pictures."""
        return [PUBLISHED, RECURSIVE, f"{FIR}{self.learning.taps[-1]}"]


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the signals can be evaluated, and a scan that is learned from is here and can be."""
    check_signal(config.signal, f"{path}signal")
    if config.pictures is not None:
        check_signal(config.pictures.signal, f"{path}pictures.signal")
    check_class(config.learning.source, f"{path}learning.source")


def units(config: Config) -> list[Unit]:
    """For each spline the prefilters that are learned, then spectrum, errors and pictures of all."""
    return [unit for spline in config.splines for unit in _units(config, spline)]


def _units(config: Config, spline: str) -> list[Unit]:
    learning = config.learning
    reads = 2e-5 * learning.iterations * learning.training * learning.points
    work = [Unit(f"{spline}/fit/{n}", f"{spline}, {n} taps", 0.2 + reads) for n in learning.taps]
    work.append(Unit(f"{spline}/spectrum/", f"{spline}, spectrum", 3.0))
    seconds = 4e-6 * config.points * len(config.variants)
    work += [Unit(f"{spline}/errors/{n}", f"{spline}, errors at {n}³", seconds) for n in config.resolutions]
    if config.pictures is not None:
        width, height = config.pictures.look.size
        work += [
            Unit(f"{spline}/picture/{variant}-{samples}", f"{spline}, {variant}, {samples}", 1e-4 * width * height)
            for samples in (CLEAN, NOISY)
            for variant in config.shown
        ]
    return work


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit."""
    spline, what, rest = unit.key.split("/")
    common = {"kind": what, "spline": spline}
    match what:
        case "fit":
            return {**common, **_fit(config, spline, int(rest), unit, run)}
        case "spectrum":
            return {**common, **_spectrum(config, spline, run)}
        case "errors":
            return {**common, **_errors(config, spline, int(rest), run)}
        case _:
            variant, samples = rest.split("-")
            return {**common, "variant": variant, "samples": samples, **_picture(config, spline, unit, run)}


# --- prefilters -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ShortPrefilter:
    """A spline on samples that were convolved with a few taps (`experiments.fitting.Learned`)."""

    spline: str

    def reconstruct(self, parameters: Parameters, volume: fl.Volume, boundary: str) -> fl.Field:
        """The field, differentiable in `taps`, h_1 … h_m."""
        samples = fir.convolve(volume.samples, parameters["taps"], boundary)
        filtered = fl.Volume.with_geometry(samples, volume.geometry)
        return fl.reconstruct(filtered, self.spline, boundary=boundary, prefilter=False)


def _field(spline: str, variant: str, volume: fl.Volume, run: Run) -> fl.Field:
    if not variant.startswith(FIR):
        return fl.reconstruct(volume, spline, boundary=BOUNDARY, prefilter=variant == RECURSIVE)
    return ShortPrefilter(spline).reconstruct({"taps": _learned(spline, variant, run)}, volume, BOUNDARY)


def _learned(spline: str, variant: str, run: Run) -> Tensor:
    return parameters_of(run.records[f"{spline}/fit/{variant.removeprefix(FIR)}"]["parameters"])["taps"]


def _response(spline: str, variant: str, omega: Tensor, run: Run) -> Tensor:
    """P(ω) along an axis."""
    if variant == PUBLISHED:
        return torch.ones_like(omega)
    if variant == RECURSIVE:
        return fl.prefilters.QUADRATIC.response(omega)
    return fir.response(_learned(spline, variant, run), omega)


def _fit(config: Config, spline: str, taps: int, unit: Unit, run: Run) -> Record:
    learning = config.learning
    training, validation = (
        Objective.of(_members(config, role, run), BOUNDARY, learning.gradient_weight, Recipe(name=spline))
        for role in ("training", "validation")
    )
    first = {"taps": torch.zeros((taps - 1) // 2, dtype=torch.float64)}
    state = minimize(
        Fit.of(ShortPrefilter(spline), training, validation, first),
        [Stage(iterations=learning.iterations, learning_rate=learning.learning_rate)],
        run.folder / "files" / f"{run.prefix}{unit.key}.state.pt".replace("/", "--"),
        observe_every=5,
        checkpoint_every=learning.iterations,
        progress=run.advance,
    )
    best = min(state.observations, key=lambda o: o["validation"])
    learned = parameters_of(best["parameters"])
    test = _members(config, "test", run)
    errors = test.errors(ShortPrefilter(spline).reconstruct(learned, test.volume, BOUNDARY))
    recursive, published = (
        test.errors(fl.reconstruct(test.volume, spline, boundary=BOUNDARY, prefilter=on)) for on in (True, False)
    )
    return {
        "taps": taps,
        **best,
        "training": state.misfits,
        "multiplications": fir.multiplications(taps),
        "recursive_multiplications": fir.multiplications(fl.prefilters.QUADRATIC),
        "second_moment": float(sum(k * k * h for k, h in enumerate(learned["taps"].tolist(), start=1))),
        "against_recursive": {q: compared([errors], recursive, q) for q in QUANTITIES},
        "against_published": {q: compared([errors], published, q) for q in QUANTITIES},
    }


def _members(config: Config, role: Role, run: Run) -> Members:
    learning = config.learning

    def make() -> Members:
        count = {"training": learning.training, "validation": learning.validation, "test": learning.test}[role]
        points = learning.test_points if role == "test" else learning.points
        source = learning.source.open(Sampling(learning.resolution, learning.inner))
        return source.members(role, count, points, seed_of(config.seed))

    return run.memo(f"{role}:", make)


# --- spectra ----------------------------------------------------------------------------------------------------------


def _spectrum(config: Config, spline: str, run: Run) -> Record:
    """(variants, directions, 3, frequencies): the mean over positions, the least and the greatest; and the check."""
    omega = torch.linspace(0, config.upper * math.pi, config.frequencies, dtype=torch.float64)
    points = torch.stack([omega[:, None] * omega.new_tensor(d) for d in DIRECTIONS.values()])
    found = spectrum.position_responses(spline, points)
    alone = torch.stack([found.mean(0), found.amin(0), found.amax(0)], 1)
    rows = [
        _response(spline, variant, points, run).prod(-1)[:, None] * alone for variant in config.variants
    ]  # a prefilter acts along each axis
    again = omega[::MARKERS]
    measured = spectrum.measured_response(spline, again)
    files = {
        "omega": run.save_array(f"{spline}-omega", omega),
        "responses": run.save_array(f"{spline}-responses", torch.stack(rows)),
        "measured_omega": run.save_array(f"{spline}-measured-omega", again),
        "measured": run.save_array(f"{spline}-measured", measured),
    }
    difference = (measured - rows[1][0, 0, ::MARKERS]).abs().max()
    bspline = spectrum.kernel_response(fl.KERNELS["bspline2"], omega)
    return {
        "variants": config.variants,
        "positions": len(found),
        "spread": number((found - found.mean(0)).abs().max()),
        "largest_difference": number(difference),
        "from_bspline": number((found[:, 0] - bspline).abs().max()),
        **files,
        "files": list(files.values()),
    }


# --- errors -----------------------------------------------------------------------------------------------------------


def _errors(config: Config, spline: str, n: int, run: Run) -> Record:
    """RMS errors of every prefilter, without noise and with it, and the noise at which it is as good as none."""
    signal = config.signal.build()
    volume = signal.sample(n)
    extent = float(volume.samples.max() - volume.samples.min())
    white = noisy(fl.Volume.with_geometry(torch.zeros_like(volume.samples), volume.geometry), 1.0, config.seed)
    points = uniform_points(signal, config.points, config.inner, config.seed, torch.float64, "cpu")
    truth = evaluate(signal, points)
    listed = []
    for variant in config.variants:
        (v, g), (noise_v, noise_g) = (evaluate(_field(spline, variant, f, run), points) for f in (volume, white))
        off, noise = (v - truth[0], g - truth[1]), (noise_v, noise_g)
        listed.append({"variant": variant, **_levels(off, noise, [extent * share for share in config.noise])})
    for entry in listed[1:]:
        entry["equal_noise"] = {q: equal_noise(listed[0], entry, q, extent) for q in QUANTITIES}
    return {"resolution": n, "range": extent, "variants": listed}


def _levels(off: tuple[Tensor, Tensor], noise: tuple[Tensor, Tensor], deviations: list[float]) -> Record:
    """By quantity: the RMS error without noise, that of noise of standard deviation 1, and with noise of each level."""
    return {
        quantity: {
            "error": _rms(e),
            "gain": _rms(ν),
            "noisy": [_rms(e + deviation * ν) for deviation in deviations],
        }
        for quantity, e, ν in zip(QUANTITIES, off, noise, strict=True)
    }


def _rms(errors: Tensor) -> float:
    return float(metrics.rms(errors, torch.zeros_like(errors), vectors=errors.ndim == 2))


def equal_noise(published: Record, other: Record, quantity: str, extent: float) -> float | None:
    """Above which noise the published form is better than another one, as a share of the range; None: never or always.

    `published` and `other` have the error without noise and that of white noise, by quantity.
    """
    a, b = published[quantity], other[quantity]
    less, more = a["error"] ** 2 - b["error"] ** 2, b["gain"] ** 2 - a["gain"] ** 2
    return math.sqrt(less / more) / extent if less > 0 and more > 0 else None


# --- pictures ---------------------------------------------------------------------------------------------------------


@torch.no_grad()
def _picture(config: Config, spline: str, unit: Unit, run: Run) -> Record:
    assert config.pictures is not None
    pictures, (variant, samples) = config.pictures, unit.key.rpartition("/")[2].split("-")
    signal = pictures.signal.build()
    volume = signal.sample(pictures.resolution)
    extent = float(volume.samples.max() - volume.samples.min())
    volume = noisy(volume, pictures.noise * extent if samples == NOISY else 0.0, config.seed)
    surface = LevelSet(_field(spline, variant, volume, run), pictures.level)
    seen, seconds = timed(
        lambda: pictures.look.cast(
            surface,
            pictures.material.build(),
            seed=config.seed,
            progress=lambda done, total: run.advance(done / max(total, 1)),
            channels=("color", "position", "sheets"),
        )
    )
    hit = seen["position"][seen["sheets"][..., 0] > 0]
    voxel = max(b - a for a, b in zip(signal.domain.lower, signal.domain.upper, strict=True)) / pictures.resolution
    distance = SurfaceDistance(signal.with_voxel_size(voxel), pictures.level)(hit.double())
    file = run.save_image(unit.key.replace("/", "-"), seen["color"][..., :3].float())
    return {
        "image": file,
        "files": [file],
        "distance": number(distance.square().mean().sqrt()) if len(hit) else None,
        "render_seconds": seconds,
    }
