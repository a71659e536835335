"""What does each method make of a surface, as a picture? (Figures 7 and 8 of paper 003, figure 12 of paper 000.)

Surfaces of sampled signals, beside the signal's own, and of scans: whole, and through windows that magnify a part. All
are hit exactly but the triangles of marching cubes, which stand in the same grid. A surface is lit, shows reflection
lines, or has the colour of its error, the distance to the signal's surface to first order:

    |f(p) − level| / |∇f(p)|,    f the signal, in voxels
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor

import filterlab as fl
from experiments import triangles
from experiments.config import (
    BoundaryName,
    Dtype,
    ExperimentConfig,
    Recipe,
    Recipes,
    number,
    torch_dtype,
)
from experiments.dvr_signal import TRUTH
from experiments.dvr_volume import WHOLE, Zoom
from experiments.runs import Record, Run, Unit, timed
from experiments.sampled import Sampled
from experiments.signal_surface import SignalSurface
from experiments.views import Window, magnified
from filterlab.fields.base import Domain
from filterlab.io.config import ConfigError, Problem, StrictModel
from filterlab.render.materials import ByField, Material, Phong
from filterlab.render.raycast import raycast
from filterlab.render.transfer import TransferFunction
from filterlab.scenes import model as scene
from filterlab.signals import Signal
from filterlab.surfaces import LevelSet, Surface

ABSENT = "absent"
MOST = 0.95  # of the points that are seen
SAMPLES = 512  # of a signal along a ray of its own picture
SECONDS_PER_RAY = {"exact": 1e-4, triangles.NAME: 4e-5, TRUTH: 1e-4}  # only expectations use it
LOW, MIDDLE, HIGH = (
    (0.02, 0.08, 0.6),
    (0.75, 0.75, 0.7),
    (0.75, 0.03, 0.02),
)  # errors: none, half of the limit, all of it


class Look(StrictModel):
    """How surfaces are shown: sections of scene files.

    Attributes:
        size: (width, height) in pixels.
        error: instead of the material's colour, that of the distance to the signal's surface, up to so many voxels.
    """

    size: tuple[scene.Pixels, scene.Pixels] = (320, 320)
    camera: scene.CameraView = scene.CameraView()
    lighting: scene.Lighting = scene.Lighting()
    region: scene.Region | None = None
    background: scene.Color = (1.0, 1.0, 1.0)
    error: scene.Positive | None = None

    def cast(self, surface: Surface, material: Material, window: Window | None = None, **options: Any) -> Any:
        """What `raycast` makes of the surface, whole or through a window."""
        return raycast(
            surface,
            magnified(self.camera, window).build(surface.domain, self.size),
            material,
            size=self.size,
            lights=self.lighting.build().lights,
            background=self.background,
            region=self.region.build() if self.region else None,
            **options,
        )


class Figure(Sampled):
    """One surface, with every method.

    Attributes:
        title: of the figure.
        noise: standard deviation of what is added to the samples of a signal, independent and Gaussian, in its values.
        surface: level, material and the rest, as in a scene.
        zooms: what is magnified.
    """

    title: Annotated[str, Field(min_length=1)]
    noise: Annotated[float, Field(ge=0)] = 0.0
    surface: scene.LevelSetModel
    methods: Recipes
    marching_cubes: bool = True
    look: Look = Look()
    zooms: list[Zoom] = Field(default_factory=list)
    boundary: BoundaryName = "mirror"

    @property
    def level(self) -> float:
        """The value on the surface."""
        return self.surface.level

    @model_validator(mode="after")
    def _consistent(self) -> Figure:
        if self.noise and self.signal is None:
            raise ValueError("noise: it is added to the samples of a signal; a scan has its own, leave it out")
        if self.look.error is not None and self.signal is None:
            raise ValueError("look.error: a scan has no surface of its own to be compared with; leave it out")
        if self.look.error is not None and not isinstance(self.surface.material, scene.PhongModel):
            raise ValueError("look.error: expected the material phong, whose colour it replaces")
        if self.surface.axis != "raw" or self.surface.sheets != 1:
            raise ValueError("surface: expected axis: raw and sheets: 1, which all surfaces here share")
        return self

    @property
    def contenders(self) -> list[str]:
        """Keys of what is compared, in the order of the report; first the signal itself."""
        own = [] if self.signal is None else [TRUTH]
        return own + ([triangles.NAME] if self.marching_cubes else []) + [recipe.key for recipe in self.methods]

    @property
    def windows(self) -> dict[str, Window | None]:
        """Every view, by a name for keys and files."""
        return {WHOLE: None, **{f"zoom-{i + 1}": zoom.window for i, zoom in enumerate(self.zooms)}}


class Config(ExperimentConfig):
    """Pictures of surfaces."""

    experiment: Literal["isosurface_quality"]
    figures: Annotated[list[Figure], Field(min_length=1)]
    dtype: Dtype = "float32"

    @model_validator(mode="after")
    def _on_the_cpu(self) -> Config:
        if self.device != "cpu":
            raise ValueError("device: signals and triangles are traced on the CPU here; expected device: cpu")
        return self


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the signals can be evaluated, and the scans, but for optional ones, are here."""
    for i, figure in enumerate(config.figures):
        own = f"{path}figures[{i}]"
        domain = figure.check(own)
        if domain is not None:
            _check_camera(figure, domain, f"{own}.look.camera")


def _check_camera(figure: Figure, domain: Domain, path: str) -> None:
    try:
        figure.look.camera.build(domain, figure.look.size)
    except ValueError as error:
        raise ConfigError([Problem(figure.title, path, str(error))]) from None


def units(config: Config) -> list[Unit]:
    """One per figure, contender and view; one that says so where an optional scan is not here."""
    return [unit for i, figure in enumerate(config.figures) for unit in _units(i, figure)]


def _units(index: int, figure: Figure) -> list[Unit]:
    if not figure.present:
        return [Unit(f"{index}/{ABSENT}/{WHOLE}", f"{figure.title}: not here", 0.01)]
    width, height = figure.look.size
    rays = width * height * figure.surface.subpixels**2
    return [
        Unit(f"{index}/{name}/{view}", f"{figure.title}, {name}, {view}", rays * _seconds_per_ray(name))
        for name in figure.contenders
        for view in figure.windows
    ]


def _seconds_per_ray(name: str) -> float:
    return SECONDS_PER_RAY.get(name, SECONDS_PER_RAY["exact"])


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one picture."""
    index, name, view = unit.key.split("/")
    figure = config.figures[int(index)]
    common = {"figure": int(index), "view": view}
    if name == ABSENT:
        assert figure.volume is not None
        return {**common, "kind": ABSENT, "file": figure.volume.file}
    recipe = next((r for r in figure.methods if r.key == name), None)
    own = {"recipe": TRUTH} if name == TRUTH else triangles.RECORD if recipe is None else recipe.record()
    made = run.memo(f"surface:{index}/{name}", lambda: timed(lambda: _surface(config, figure, name, recipe, run)))
    surface, building = made
    (image, found), seconds = timed(lambda: _drawn(config, figure, surface, figure.windows[view], run))
    stem = f"{index}-{name}-{view}"
    files = {"image": run.save_image(stem, image)}
    if name == TRUTH:
        files["array"] = run.save_array(stem, image)
    return {
        **common,
        **own,
        "kind": "picture",
        **files,
        "files": list(files.values()),
        **found,
        "build_seconds": building,
        "render_seconds": seconds,
    }


# --- surfaces ---------------------------------------------------------------------------------------------------------


def _surface(config: Config, figure: Figure, name: str, recipe: Recipe | None, run: Run) -> Surface:
    if name == TRUTH:
        return SignalSurface(_signal(figure), figure.level, SAMPLES)
    volume = run.memo(f"volume:{figure.title}", lambda: _volume(config, figure))
    if recipe is None:
        return triangles.marching_cubes(volume, figure.level, figure.boundary)
    return LevelSet(recipe.build(volume, figure.boundary), figure.level)


def _signal(figure: Figure) -> Signal:
    """The signal, with the voxels that it is sampled on for its scale."""
    assert figure.signal is not None
    assert figure.resolution is not None
    signal = figure.signal.build()
    extent = max(b - a for a, b in zip(signal.domain.lower, signal.domain.upper, strict=True))
    return signal.with_voxel_size(extent / figure.resolution)


def _volume(config: Config, figure: Figure) -> fl.Volume:
    dtype = torch_dtype(config.dtype)
    if figure.volume is not None:
        return figure.volume.load().to(dtype)
    assert figure.resolution is not None
    return noisy(_signal(figure).sample(figure.resolution, dtype=dtype), figure.noise, config.seed)


def noisy(volume: fl.Volume, deviation: float, seed: int) -> fl.Volume:
    """The volume with independent Gaussian noise of that standard deviation, the same for every type of samples."""
    if not deviation:
        return volume
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(volume.samples.shape, generator=generator, dtype=torch.float64)
    return fl.Volume.with_geometry(volume.samples + deviation * noise.to(volume.samples), volume.geometry)


class SurfaceDistance(fl.Field):
    """The distance to a signal's level set to first order, in voxels: |f − level| / (|∇f| · voxel)."""

    max_order = 0

    def __init__(self, signal: Signal, level: float) -> None:
        self.signal, self.level, self.domain = signal, level, signal.domain

    def jet(self, points: Tensor, order: int) -> tuple[Tensor, ...]:
        value, gradient = self.signal.value_and_gradient(points.double())
        size = (gradient.norm(dim=-1) * self.domain.voxel_size).clamp_min(1e-300)
        return (((value - self.level).abs() / size).to(points.dtype),)


# --- pictures ---------------------------------------------------------------------------------------------------------


@torch.no_grad()
def _drawn(
    config: Config, figure: Figure, surface: Surface, window: Window | None, run: Run
) -> tuple[Tensor, dict[str, Any]]:
    """(linear RGB (H, W, 3), what is known of the points that are seen)."""
    cast: Callable[..., Any] = lambda **options: figure.look.cast(  # noqa: E731
        surface,
        _material(figure),
        window,
        shadows=figure.surface.shadows,
        seed=config.seed,
        dtype=torch_dtype(config.dtype),
        progress=lambda done, total: run.advance(done / max(total, 1)),
        **options,
    )
    if figure.surface.subpixels > 1:
        return cast(subpixels=figure.surface.subpixels)[..., :3].float(), {}
    seen = cast(channels=("color", "position", "sheets"))
    hit = seen["sheets"][..., 0] > 0
    return seen["color"][..., :3].float(), {"hit": float(hit.double().mean())} | _errors(figure, seen["position"][hit])


def _material(figure: Figure) -> Material:
    material = figure.surface.material
    if figure.look.error is None:
        return material.build()
    assert isinstance(material, scene.PhongModel)
    limit = figure.look.error
    transfer = TransferFunction([0, limit / 2, limit], [LOW, MIDDLE, HIGH], [1, 1, 1])
    colors = ByField(SurfaceDistance(_signal(figure), figure.level), transfer)
    return Phong(colors, material.ambient, material.diffuse, material.specular, material.shininess)


def _errors(figure: Figure, points: Tensor) -> dict[str, Any]:
    """Of the points that are seen of a sampled signal: distances to its surface, in voxels."""
    if figure.signal is None or not len(points):
        return {}
    distance = SurfaceDistance(_signal(figure), figure.level)(points.double())
    return {"distance_median": number(distance.median()), "distance_most": number(distance.quantile(MOST))}
