"""Which volume, and which transfer function, made these images? Both are recovered by descent through the renderer.

A known signal is rendered from directions spread over the sphere. Most images are matched; the others are held out to
judge by. In one part the voxels are unknown and the transfer function is known, in the other it is the other way round.
Everything comes from one marcher with one step in the world, so that images differ by the unknown and by the method
that makes a field of the voxels.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor

import filterlab as fl
from experiments.config import (
    BoundaryName,
    Dtype,
    ExperimentConfig,
    Recipes,
    check_signal,
    increasing,
    number,
    torch_dtype,
)
from experiments.descent import course, descended
from experiments.dvr_signal import amplified_difference, displayed
from experiments.recovery import (
    Bench,
    TransferFit,
    TransferProblem,
    Views,
    VolumeFit,
    VolumeProblem,
    displayed_psnr,
)
from experiments.runs import Record, Run, Unit
from experiments.views import MAX_SAMPLES
from filterlab.io.config import ConfigError, Problem
from filterlab.render.transfer import TransferFunction
from filterlab.scenes import model as scene
from filterlab.scenes.model import SignalModel

VOLUME, TRANSFER = "volume", "transfer"
GROUPS = 10  # of voxels, by how strongly the images depend on them
BINS = 64  # of the histogram of values
_DESCENT = 0.9  # the share of a unit's time, for its progress
_SECONDS_PER_SAMPLE = {VOLUME: 5e-7, TRANSFER: 3e-7}  # of a step, fused, on one core; only expectations use it
_SAMPLES_PER_VOXEL = 1.2  # of a ray through the box, times the voxels along an axis, divided by the step; measured


class Config(ExperimentConfig):
    """One signal and one set of views; a volume, a transfer function or both to recover.

    Attributes:
        images_of: what the images show: the `signal` itself, which n³ voxels match as well as the method lets them, or
            what each method makes of its `samples`, which that method can match exactly.
        record_every: steps between measurements of the convergence.
        checkpoint_every: steps between writing down where the descent is; an interrupted run goes on from there.
    """

    experiment: Literal["inverse_dvr"]
    signal: SignalModel
    resolution: Annotated[int, Field(ge=2, le=512)]
    methods: Recipes
    images_of: Literal["signal", "samples"] = "signal"
    views: Views = Views()
    volume: VolumeFit | None = None
    transfer_function: TransferFit | None = None
    record_every: Annotated[int, Field(ge=1)] = 25
    checkpoint_every: Annotated[int, Field(ge=1)] = 25
    boundary: BoundaryName = "reflect"
    dtype: Dtype = "float32"

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        if self.volume is None and self.transfer_function is None:
            raise ValueError("expected what is to be recovered, volume or transfer_function or both; got neither")
        for name, part in (("volume", self.volume), ("transfer_function", self.transfer_function)):
            if part is not None and part.rays > self.views.pixels:
                pixels = f"the {self.views.pixels} pixels of the training views"
                raise ValueError(f"{name}.rays: expected at most {pixels}; got {part.rays}")
        if self.volume is not None:
            listed = increasing(stage.resolution for stage in self.volume.stages)
            if listed[-1] != self.resolution:
                raise ValueError(f"volume.stages: expected {self.resolution} as the last resolution; got {listed}")
        return self

    @property
    def transfers(self) -> dict[str, scene.Transfer]:
        """The transfer functions of the images, by the path of their key."""
        listed = {}
        if self.volume is not None:
            listed["volume.transfer"] = self.volume.transfer
        if self.transfer_function is not None:
            listed["transfer_function.target"] = self.transfer_function.target
        return listed

    @property
    def samples_per_ray(self) -> float:
        """About."""
        return _SAMPLES_PER_VOXEL * self.resolution / self.views.step


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless signal, methods and images can be computed here."""
    check_signal(config.signal, f"{path}signal")
    for key, transfer in config.transfers.items():
        if transfer.axis != "raw":
            message = "expected raw, so that images of the signal and of every volume share the values"
            raise ConfigError([Problem("the transfer function", f"{path}{key}.axis", message)])
        if key == "volume.transfer" and len(transfer.build(lambda: (0.0, 1.0), 1.0).positions) < 2:
            message = "expected at least two control points: with one, the images do not depend on the volume"
            raise ConfigError([Problem("the transfer function", f"{path}{key}", message)])
    for i, recipe in enumerate(config.methods):
        try:
            recipe.build(fl.Volume(torch.zeros(2, 2, 2, dtype=torch_dtype(config.dtype))), config.boundary)
        except ValueError as error:
            raise ConfigError([Problem(recipe.key, f"{path}methods[{i}]", str(error))]) from None
    views = config.views
    for name, rays in (("size", (views.training + views.held_out) * views.size**2), ("shown", views.shown**2)):
        samples = rays * config.samples_per_ray
        if not samples <= MAX_SAMPLES:
            advice = "use a longer step, or fewer or smaller images"
            message = f"expected images of at most {MAX_SAMPLES:.2g} samples; got about {samples:.2g}: {advice}"
            raise ConfigError([Problem("the views", f"{path}views.{name}", message)])


def units(config: Config) -> list[Unit]:
    """One per method for the volume; for the transfer function one per kind of positions and method."""
    listed: list[Unit] = []
    if (volume := config.volume) is not None:
        cost = _seconds(config, VOLUME, sum(stage.iterations for stage in volume.stages), volume.rays)
        listed += [Unit(f"{VOLUME}/{r.key}", f"volume, {r.key}", cost) for r in config.methods]
    if (fit := config.transfer_function) is not None:
        cost = _seconds(config, TRANSFER, fit.iterations, fit.rays)
        listed += [
            Unit(f"{TRANSFER}/{positions}/{r.key}", f"transfer function, {positions} positions, {r.key}", cost)
            for positions in fit.positions
            for r in config.methods
        ]
    return listed


def _seconds(config: Config, kind: str, steps: int, rays: int) -> float:
    """A rough expectation: the steps, the measurements among them, and the images before and after."""
    views = config.views
    seen = (views.training + (steps / config.record_every) * views.held_out) * views.size**2 + 6 * views.shown**2
    return config.samples_per_ray * (steps * rays * _SECONDS_PER_SAMPLE[kind] + seen * 3e-7)


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one recovery."""
    kind, _, rest = unit.key.partition("/")
    positions, _, key = rest.rpartition("/")
    recipe = next(r for r in config.methods if r.key == key)
    bench = Bench.of(
        config.signal.build(),
        config.resolution,
        config.views,
        recipe,
        config.boundary,
        config.images_of,
        seed=config.seed,
        dtype=torch_dtype(config.dtype),
        device=config.device,
    )
    if kind == VOLUME:
        assert config.volume is not None
        return {"kind": kind, **recipe.record(), **_volume(config, VolumeProblem(bench, config.volume), unit.key, run)}
    assert config.transfer_function is not None
    problem = TransferProblem(bench, config.transfer_function, "free" if positions == "free" else "fixed")
    return {"kind": kind, **recipe.record(), "positions": positions, **_transfer(config, problem, unit.key, run)}


# --- records ----------------------------------------------------------------------------------------------------------


def _volume(config: Config, problem: VolumeProblem, key: str, run: Run) -> Record:
    assert config.volume is not None
    state = descended(problem, list(config.volume.stages), config, key, run, _DESCENT)
    bench, truth = problem.bench, problem.bench.samples.samples
    first, found = problem.start()["voxels"], state.parameters["voxels"].detach()
    shown = {"target": bench.target, "start": bench.field(first), "result": bench.field(found)}
    images = _images(bench, bench.shown, {name: (f, problem.transfer) for name, f in shown.items()}, key, run)
    dependence = problem.dependence(config.seed, lambda f: run.advance(_DESCENT + (1 - _DESCENT) * f))
    voxels = {"target": truth, "start": problem.first_at_full_resolution(), "result": found}
    slices = _slices(voxels, dependence, config.views.amplify, key, run)
    array = run.save_array(key, found)
    return {
        **course(state),
        "samples": problem.observe({"voxels": truth}, state.stage),
        "groups": groups(dependence, found - truth),
        "images": images,
        "slices": slices,
        "voxels": array,
        "files": [*files(images), *files(slices), array],
    }


def groups(dependence: Tensor, error: Tensor, parts: int = GROUPS) -> list[Record]:
    """Voxels in groups of equal size, from those on which the images depend least to those on which they do most.

    Each has the RMS of the dependence and of the error in it.
    """
    dependence, error = dependence.reshape(-1), error.reshape(-1)
    return [
        {
            "dependence": number(dependence[part].square().mean().sqrt()),
            "rms": number(error[part].square().mean().sqrt()),
        }
        for part in dependence.argsort(stable=True).tensor_split(parts)
    ]


def _slices(voxels: Mapping[str, Tensor], dependence: Tensor, amplify: float, key: str, run: Run) -> Record:
    """The slices in the middle of y as grey images, x to the right and z up: the signal's range of samples as 0 … 1.

    Differences are absolute, amplified, in the same units; the dependence is relative to the largest of the slice.
    """
    low, high = voxels["target"].aminmax()
    tiny = torch.finfo(low.dtype).tiny
    grey = {name: ((v - low) / (high - low).clamp_min(tiny))[:, len(v) // 2] for name, v in voxels.items()}
    grey["difference"] = amplify * (grey["result"] - grey["target"]).abs()
    seen = dependence[:, len(dependence) // 2]
    grey["dependence"] = seen / seen.max().clamp_min(tiny)
    return {name: run.save_image(f"{key}-slice-{name}", g.flip(0).clamp(0, 1), srgb=False) for name, g in grey.items()}


def _images(
    bench: Bench, views: Iterable[str], shown: Mapping[str, tuple[fl.Field, TransferFunction]], key: str, run: Run
) -> Record:
    """Some of the views that are shown: target, start and result, and the difference of result and target."""
    saved: Record = {}
    for view in views:
        camera = bench.shown[view]
        images = {
            name: bench.image(field, transfer, camera, bench.views.shown).to(torch.float32).cpu()
            for name, (field, transfer) in shown.items()
        }
        difference = amplified_difference(images["result"], images["target"], bench.views.amplify)
        saved[view] = {name: run.save_image(f"{key}-{view}-{name}", image) for name, image in images.items()}
        saved[view]["difference"] = run.save_image(f"{key}-{view}-difference", difference, srgb=False)
        for name in ("start", "result"):
            saved[view][f"psnr_{name}"] = displayed_psnr(images[name], images["target"])
    return saved


def files(record: Any) -> list[str]:
    """Every file that a record names, however deep."""
    if isinstance(record, dict):
        return [name for value in record.values() for name in files(value)]
    return [record] if isinstance(record, str) else []


def _transfer(config: Config, problem: TransferProblem, key: str, run: Run) -> Record:
    assert config.transfer_function is not None
    state = descended(problem, [config.transfer_function], config, key, run, _DESCENT)
    bench = problem.bench
    with torch.no_grad():
        first, found = problem.transfer(problem.start()), problem.transfer(state.parameters)
    functions = {"target": problem.target, "start": first, "result": found}
    shown = {name: (bench.target if name == "target" else problem.field, t) for name, t in functions.items()}
    images = _images(bench, ("held_out",), shown, key, run)
    counts = torch.histc(problem.values.double().cpu(), BINS, problem.low, problem.high)
    return {
        **course(state),
        "exact": problem.observe_exact(),
        "curves": {name: _curve(t, problem.low, problem.high) for name, t in functions.items()},
        "histogram": {"low": problem.low, "high": problem.high, "shares": (counts / counts.sum()).tolist()},
        "unit": problem.unit,
        "images": images,
        "files": files(images),
    }


@torch.no_grad()
def _curve(transfer: TransferFunction, low: float, high: float) -> Record:
    """A transfer function as plain numbers: at its control points, and in the middle of every bin of the histogram.

    Where low … high reaches beyond the control points, the ends of it are added: it is constant there. The colours of
    the bins are those of a screen (sRGB, 0 … 1).
    """
    inner, rounding = transfer.positions.detach().double().cpu().tolist(), 1e-6 * (high - low)
    positions = [low] * (low < inner[0] - rounding) + inner + [high] * (high > inner[-1] + rounding)
    middles = low + (high - low) * (torch.arange(BINS, dtype=torch.float64) + 0.5) / BINS
    function = transfer.to(torch.float64, "cpu")
    colors, opacities = function(torch.tensor(positions, dtype=torch.float64))
    bin_colors, bin_opacities = function(middles)
    return {
        "positions": positions,
        "opacities": opacities.tolist(),
        "colors": colors.tolist(),
        "bins": {"opacities": bin_opacities.tolist(), "displayed": displayed(bin_colors).tolist()},
    }
