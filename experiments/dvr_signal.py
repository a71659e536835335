"""What does each method make of a known signal, as an image? (Figure 5 of the paper.)

The signal is rendered itself, by the same marcher, camera and transfer function; so is every reconstruction of its
samples. The difference between two images is what the reconstruction changed, and nothing else. Metrics are taken of
images as displayed (sRGB).
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from torch import Tensor

import filterlab as fl
from experiments.config import BoundaryName, Dtype, ExperimentConfig, Recipe, Recipes, check_signal, number, torch_dtype
from experiments.runs import Record, Run, Unit, timed
from experiments.views import View
from filterlab import metrics
from filterlab.io.images import to_srgb
from filterlab.scenes.model import SignalModel

TRUTH = "signal"


class Config(ExperimentConfig):
    """One signal at one resolution, rendered with every method."""

    experiment: Literal["dvr_signal"]
    signal: SignalModel
    resolution: Annotated[int, Field(ge=2, le=1024)]
    methods: Recipes
    view: View
    boundary: BoundaryName = "reflect"
    amplify: Annotated[float, Field(gt=0)] = 4.0
    dtype: Dtype = "float32"


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the images can be drawn and compared."""
    check_signal(config.signal, f"{path}signal")
    config.view.check(_truth(config).domain, f"{path}view", compared=True)


def units(config: Config) -> list[Unit]:
    """The image of the signal itself, then one per method."""
    view, n, name = config.view, config.resolution, config.signal.name
    return [
        Unit(TRUTH, f"{name} itself", 0.5 * view.seconds(n, "direct")),
        *(Unit(r.key, f"{name} {n}³, {r.key}", view.seconds(n, r.first_scheme)) for r in config.methods),
    ]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one image."""
    if unit.key == TRUTH:
        field = _truth(config)
        image, seconds = config.view.timed(field, run, config.device, config.dtype)
        files = {"image": run.save_image(TRUTH, image), "array": run.save_array(TRUTH, image)}
        return {"kind": TRUTH, **files, "files": list(files.values()), "render_seconds": seconds}
    recipe = next(r for r in config.methods if r.key == unit.key)
    return {"kind": "method", **recipe.record(), **_image(config, recipe, run)}


def _truth(config: Config) -> fl.Field:
    """The signal, with the step in world units that the volumes have: images differ by the reconstruction alone."""
    signal = config.signal.build()
    extent = max(b - a for a, b in zip(signal.domain.lower, signal.domain.upper, strict=True))
    return signal.with_voxel_size(extent / config.resolution)


def _image(config: Config, recipe: Recipe, run: Run) -> Record:
    signal = config.signal.build()
    volume = run.memo(
        f"volume:{config.resolution}",
        lambda: signal.sample(config.resolution, dtype=torch_dtype(config.dtype), device=config.device),
    )
    field, building = timed(lambda: recipe.build(volume, config.boundary))
    image, rendering = config.view.timed(field, run, config.device, config.dtype)
    truth = run.memo("truth:", lambda: run.load_array(run.records[TRUTH]["array"]))
    files = {
        "image": run.save_image(recipe.key, image),
        "difference": run.save_image(
            f"{recipe.key}-difference", amplified_difference(image, truth, config.amplify), srgb=False
        ),
    }
    return {
        **files,
        "files": list(files.values()),
        **image_errors(image, truth),
        "build_seconds": building,
        "render_seconds": rendering,
    }


def image_errors(image: Tensor, truth: Tensor) -> Record:
    """PSNR (dB), SSIM, RMS and largest difference of two linear images (H, W, 3), as displayed (sRGB, 0 … 1)."""
    a, b = displayed(image), displayed(truth)
    rms = metrics.rms(a, b)
    return {
        "psnr": number(metrics.psnr(a, b)) if rms > 0 else None,
        "ssim": number(metrics.ssim(a, b)),
        "rms": number(rms),
        "max": number(metrics.max_error(a, b)),
    }


def amplified_difference(image: Tensor, truth: Tensor, factor: float) -> Tensor:
    """factor · |difference| of the displayed images, cut off at 1: an image that is to be shown as it is."""
    return (factor * (displayed(image) - displayed(truth)).abs()).clamp(0, 1)


def displayed(image: Tensor) -> Tensor:
    """What a screen is sent for a linear image: clipped to 0 … 1 and sRGB-encoded."""
    return to_srgb(image.clamp(0, 1))
