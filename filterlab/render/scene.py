"""Scenes: what a picture shows and how, as a strict configuration that a YAML file holds.

    scene = load_scene("engine.yaml", {"method": "notch"})
    image = render_scene(scene)

Each section is a model with a `build` that makes the object of this package it describes; experiments use the same
sections. A section that is left out costs nothing: no lighting, no gradients.
"""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, field_validator, model_validator
from torch import Tensor

from filterlab import signals
from filterlab.fields.base import Domain
from filterlab.fields.base import Field as FilterlabField
from filterlab.fields.storage import StorageName
from filterlab.io.bounded import VolumeFileError
from filterlab.io.config import StrictModel, load_config, unknown_name
from filterlab.io.volumes import describe, load_volume
from filterlab.methods import METHODS, reconstruct
from filterlab.missing_values import NanChoice
from filterlab.recommendation import recommend, report
from filterlab.render.camera import WHOLE, Camera, OrthographicCamera, PerspectiveCamera, Window, check_window
from filterlab.render.dvr import Progress, render
from filterlab.render.rays import check_region
from filterlab.render.shading import Light, Shading
from filterlab.render.transfer import TransferFunction
from filterlab.volume import Boundary, Volume

VOLUMES_VARIABLE = "FILTERLAB_VOLUMES"
AUTO = "auto"
STEP = 0.5  # voxels

Vector = tuple[float, float, float]
Component = Annotated[float, Field(ge=0)]
Color = tuple[Component, Component, Component]
Positive = Annotated[float, Field(gt=0)]
Opacity = Annotated[float, Field(ge=0, le=1)]
Pixels = Annotated[int, Field(ge=1, le=2**15)]


def _known_method(name: str) -> str:
    if name not in (*METHODS, AUTO):
        raise ValueError(unknown_name("method", name, (*METHODS, AUTO)))
    return name


def _part(value: Any) -> Any:
    """A part as a number, or as a text like `0.5%`."""
    if not isinstance(value, str):
        return value
    number = value.removesuffix("%").strip()
    if number == value or not re.fullmatch(r"[0-9]*\.?[0-9]+(e-?[0-9]+)?", number):
        raise ValueError(f"expected a part like 0.005 or 0.5%; got {value!r}")
    return float(number) / 100


def _known_signal(name: str) -> str:
    if name not in signals.SIGNALS:
        raise ValueError(unknown_name("signal", name, signals.SIGNALS))
    return name


def _known_boundary(name: str) -> str:
    if name not in list(Boundary):
        raise ValueError(unknown_name("boundary", name, Boundary))
    return name


def _named(value: Any) -> Any:
    """A bare name stands for the section with that name and every default."""
    return {"name": value} if isinstance(value, str) else value


# a section that a bare name may stand for is validated as Python data, where a strict tuple would be no list
_Listed = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)
Parameters = dict[str, float | Annotated[Vector, _Listed]]


# --- what is shown ----------------------------------------------------------------------------------------------------


class VolumeFile(StrictModel):
    """A volume file.

    Attributes:
        file: a path; `$NAME` in it stands for an environment variable. A path that is not absolute is looked for in the
            folder of the scene, in the current folder, and in the folder named by $FILTERLAB_VOLUMES.
    """

    file: Annotated[str, Field(min_length=1)]

    @model_validator(mode="before")
    @classmethod
    def _from_path(cls, value: Any) -> Any:
        return {"file": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _found(self, info: ValidationInfo) -> VolumeFile:
        folder = Path((info.context or {}).get("folder", "."))
        object.__setattr__(self, "file", str(find_volume(self.file, folder)))
        return self

    def load(self) -> Volume:
        """The volume. Raises VolumeFileError for a damaged file, or one that holds several volumes."""
        shape = describe(self.file).shape
        if len(shape) != 3:
            raise VolumeFileError(
                self.file, "one volume of shape (D, H, W) to show", f"a batch (N, C, D, H, W) = {shape}"
            )
        return load_volume(self.file)


def find_volume(name: str, folder: Path) -> Path:
    """The existing file that `name` stands for (see `VolumeFile`), absolute. Raises ValueError if there is none."""
    path = Path(name)
    if not path.is_absolute() or not path.exists():  # else a name that is as it stands, with a $ in it or not
        path = Path(os.path.expandvars(name)).expanduser()
    if "$" in str(path) and not path.exists():
        raise ValueError(f"expected environment variables that are set; got {name!r}")
    volumes = os.environ.get(VOLUMES_VARIABLE)
    places = [Path("/")] if path.is_absolute() else [folder, Path()] + ([Path(volumes)] if volumes else [])
    for place in places:
        if (place / path).exists():
            return (place / path).resolve()
    looked = " or ".join(dict.fromkeys(str((place / path).absolute()) for place in places))
    hint = "" if volumes or path.is_absolute() else f" (set {VOLUMES_VARIABLE} to the folder of your volumes)"
    raise ValueError(f"expected a volume file; found none at {looked}{hint}")


class SignalSource(StrictModel):
    """A closed-form signal, exact or sampled.

    Attributes:
        name: a name from `filterlab.signals.SIGNALS`.
        parameters: of that signal, by name.
        samples: n (or nx, ny, nz) voxels to sample it on, for a method to reconstruct; left out, the signal itself.
    """

    name: Annotated[str, AfterValidator(_known_signal)]
    parameters: Annotated[Parameters, Field(default_factory=dict)]
    samples: Annotated[int, Field(ge=1, le=2048)] | Annotated[tuple[int, int, int], _Listed] | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        return _named(value)

    @model_validator(mode="after")
    def _accepted(self) -> SignalSource:
        if isinstance(self.samples, tuple) and min(self.samples) < 1:
            raise ValueError(f"samples must be positive; got {self.samples}")
        return self

    @field_validator("parameters")
    @classmethod
    def _usable(cls, parameters: Parameters, info: ValidationInfo) -> Parameters:
        if "name" in info.data:  # else the name is the mistake
            _check_parameters(info.data["name"], parameters)
        return parameters

    def build(self) -> signals.Signal:
        """The signal."""
        return signals.named(self.name, **self.parameters)  # type: ignore[arg-type]


def _check_parameters(name: str, parameters: Parameters) -> None:
    """Raises ValueError for a parameter that the signal does not have, of another kind, or that gives no numbers."""
    known = inspect.signature(signals.SIGNALS[name]).parameters
    for parameter, value in parameters.items():
        if parameter not in known:
            raise ValueError(unknown_name(f"parameter of {name}", parameter, known))
        expected = "three numbers [x, y, z]" if isinstance(known[parameter].default, tuple) else "a number"
        if isinstance(value, tuple) != isinstance(known[parameter].default, tuple):
            raise ValueError(f"{parameter}: expected {expected}; got {value}")
    try:
        signal = signals.named(name, **parameters)  # type: ignore[arg-type]
        point = torch.tensor([signal.domain.center], dtype=torch.float64) + 0.1  # nothing special about it
        finite = all(bool(x.isfinite().all()) for x in signal.value_and_gradient(point))
    except (ArithmeticError, RuntimeError, TypeError) as error:
        raise ValueError(f"expected parameters with which {name} can be computed; got {parameters} ({error})") from None
    if not finite:
        raise ValueError(f"expected parameters with which {name} is finite; got {parameters}")


class Reconstruction(StrictModel):
    """How samples become a field; a bare name stands for a method as it is. See `filterlab.reconstruct`.

    Attributes:
        name: of a method, or `auto`: the cheapest one whose error on this volume stays within a budget, with the
            scheme, storage and (unless the scene has one) step that `filterlab.recommend` finds for task "dvr".
        max_error: that budget, in parts of the range of the volume's values; only with `auto`.
    """

    name: Annotated[str, AfterValidator(_known_method)] = "triquadratic"
    max_error: Annotated[float, BeforeValidator(_part), Field(gt=0)] | None = None
    prefilter: bool = True
    scheme: str | None = None
    boundary: Annotated[str, AfterValidator(_known_boundary)] = "mirror"
    gradient: str | None = None
    sampler: Literal["exact", "texture_unit"] = "exact"
    storage: StorageName | None = None
    nan: NanChoice = "refuse"

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        return _named(value)

    @model_validator(mode="after")
    def _offered(self) -> Reconstruction:
        if (self.name == AUTO) != (self.max_error is not None):
            raise ValueError(f"max_error goes with the name {AUTO}, and only with that; got {self.name}")
        if self.name == AUTO:
            settled = {"prefilter", "scheme", "gradient", "sampler", "storage"} & self.model_fields_set
            if settled:
                raise ValueError(f"{AUTO} settles {', '.join(sorted(settled))}; leave it out, or name a method")
            return self
        METHODS[self.name].scheme(self.scheme, self.gradient, self.sampler)
        return self

    def build(self, volume: Volume) -> FilterlabField:
        """The field."""
        return reconstruct(
            volume,
            self.name,
            boundary=self.boundary,
            prefilter=self.prefilter,
            scheme=self.scheme,
            gradient=self.gradient,
            sampler=self.sampler,
            storage=self.storage,
            nan=self.nan,
        )


# --- how it is shown --------------------------------------------------------------------------------------------------


class Point(StrictModel):
    """A control point of a transfer function: what a value looks like."""

    value: float
    color: Color
    opacity: Opacity


class Peak(StrictModel):
    """A triangle-shaped peak of a transfer function: `width` at the base, opacity `height` at the apex."""

    center: float
    width: Positive
    height: Opacity
    color: Color


class Transfer(StrictModel):
    """A transfer function, by control points or as a sum of peaks.

    Attributes:
        points, peaks: exactly one of them; colours are linear RGB.
        axis: `raw`: in values of the volume or signal; `normalized`: 0 … 1 stand for its smallest and largest sample.
        unit: world length that the opacities are for; default one voxel (the shortest edge).
    """

    points: Annotated[list[Point], Field(min_length=1)] | None = None
    peaks: Annotated[list[Peak], Field(min_length=1)] | None = None
    axis: Literal["raw", "normalized"] = "raw"
    unit: Positive | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Transfer:
        if (self.points is None) == (self.peaks is None):
            raise ValueError("expected either points or peaks; got both" if self.points else "expected points or peaks")
        self.build(lambda: (0.0, 1.0), 1.0)
        return self

    def build(self, value_range: Callable[[], tuple[float, float]], voxel_size: float) -> TransferFunction:
        """The transfer function. `value_range` is asked for (least, largest) where the axis is normalized."""
        low, high = value_range() if self.axis == "normalized" else (0.0, 1.0)
        span = high - low or 1.0
        unit = self.unit or voxel_size
        if self.peaks is not None:
            peaks = [(low + span * p.center, span * p.width, p.height, p.color) for p in self.peaks]
            return TransferFunction.triangle_peaks(peaks, unit)
        points = self.points or []
        return TransferFunction(
            [low + span * p.value for p in points], [p.color for p in points], [p.opacity for p in points], unit
        )


class View(StrictModel):
    """Where the camera is: at a pose, or looking along a direction from where the whole domain is in view.

    Attributes:
        projection: `perspective` or `orthographic`.
        direction: the world direction in which the camera looks; the rest is framing.
        position, target: instead of it, both ends of the view.
        up: what is up in the image.
        field_of_view: of a perspective view, vertical, in degrees.
        height: of an orthographic view with a pose, the world height of the image plane.
        margin: of framing; the domain fills 1/margin of the image.
        window: (left, top, right, bottom) in 0 … 1 of the image plane: the part that is shown, magnified.
    """

    projection: Literal["perspective", "orthographic"] = "perspective"
    direction: Vector | None = None
    position: Vector | None = None
    target: Vector | None = None
    up: Vector = (0.0, 0.0, 1.0)
    field_of_view: float = 30.0
    height: Positive | None = None
    margin: float = 1.05
    window: Window = WHOLE

    @model_validator(mode="after")
    def _consistent(self) -> View:
        if (self.position is None) != (self.target is None):
            raise ValueError("expected position and target together; got one of them")
        if self.position is not None and self.direction is not None:
            raise ValueError("expected either a direction or position and target; got both")
        with_height = self.projection == "orthographic" and self.position is not None
        if with_height != (self.height is not None):
            raise ValueError("height goes with an orthographic view of a given position and target, and only with that")
        self.build(Domain((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), (1, 1))
        return self

    def build(self, domain: Domain, size: tuple[int, int]) -> Camera:
        """The camera, for an image of that size."""
        if self.position is not None and self.target is not None:
            pose = {"position": self.position, "target": self.target, "up": self.up, "window": self.window}
            if self.projection == "perspective":
                return PerspectiveCamera(**pose, field_of_view=self.field_of_view)
            assert self.height is not None
            return OrthographicCamera(**pose, height=self.height)
        check_window(self.window)
        left, top, right, bottom = self.window
        aspect = size[0] * (bottom - top) / (size[1] * (right - left))
        framing = {"up": self.up, "aspect": aspect, "margin": self.margin, "window": self.window}
        direction = self.direction or (0.0, 1.0, 0.0)
        if self.projection == "perspective":
            return PerspectiveCamera.framing(domain, direction, field_of_view=self.field_of_view, **framing)
        return OrthographicCamera.framing(domain, direction, **framing)


class LightSource(StrictModel):
    """A directional light: the world direction *to* it (left out: a headlight), and its linear RGB."""

    direction: Vector | None = None
    color: Color = (1.0, 1.0, 1.0)

    @model_validator(mode="after")
    def _valid(self) -> LightSource:
        Light(self.direction, self.color)
        return self


class Lighting(StrictModel):
    """Blinn-Phong shading; see `filterlab.render.Shading`."""

    lights: tuple[LightSource, ...] = (LightSource(),)
    ambient: Component = 0.2
    diffuse: Component = 0.7
    specular: Component = 0.3
    shininess: Annotated[float, Field(ge=1)] = 32.0

    def build(self) -> Shading:
        """The shading."""
        lights = tuple(Light(light.direction, light.color) for light in self.lights)
        return Shading(lights, self.ambient, self.diffuse, self.specular, self.shininess)


class Region(StrictModel):
    """A world-space box outside of which nothing is seen."""

    lower: Vector
    upper: Vector

    @model_validator(mode="after")
    def _valid(self) -> Region:
        check_region(self.build())
        return self

    def build(self) -> tuple[Vector, Vector]:
        """(lower, upper)."""
        return self.lower, self.upper


class Scene(StrictModel):
    """A picture of a volume or a signal.

    Attributes:
        description: for people.
        volume, signal: what is shown; exactly one of them.
        method: how samples are reconstructed; default triquadratic.
        transfer, camera, lighting, region: see there; without lighting colours are shown as they are.
        size: (width, height) in pixels.
        step: in voxels; default half a voxel, or what `method: auto` finds.
        background: linear RGB.
        jitter: a seed; see `render`.
        termination: see `render`.
        precision: of samples and arithmetic.
        device: where to compute, as torch names it.
    """

    description: str = ""
    volume: VolumeFile | None = None
    signal: SignalSource | None = None
    method: Reconstruction | None = None
    transfer: Transfer
    camera: View = View()
    size: tuple[Pixels, Pixels] = (512, 512)
    step: Positive | None = None
    lighting: Lighting | None = None
    background: Color = (0.0, 0.0, 0.0)
    region: Region | None = None
    jitter: Annotated[int, Field(ge=0, lt=2**63)] | None = None
    termination: Annotated[float, Field(gt=0, lt=1)] | None = None
    precision: Literal["float32", "float64"] = "float32"
    device: str = "cpu"

    @model_validator(mode="after")
    def _consistent(self) -> Scene:
        if (self.volume is None) == (self.signal is None):
            raise ValueError("expected either a volume or a signal" + ("; got both" if self.volume else ""))
        if self.signal is not None and self.signal.samples is None and self.method is not None:
            raise ValueError("a signal that is not sampled needs no method: give signal.samples, or leave method out")
        if self.transfer.axis == "raw":  # else the values are known with the volume
            self.transfer.build(lambda: (0.0, 1.0), 1.0).to(self.dtype)
        return self

    @property
    def dtype(self) -> torch.dtype:
        """Of samples and arithmetic."""
        return torch.float64 if self.precision == "float64" else torch.float32

    @property
    def step_or_default(self) -> float:
        """In voxels."""
        return STEP if self.step is None else self.step


@dataclass(frozen=True)
class Prepared:
    """A scene with everything built: what `render` takes.

    Attributes:
        scene: with `method: auto` replaced by what was found.
        volume_bytes: of the samples; 0 for a signal that is not sampled.
        chosen: how `method: auto` came to its choice, in sentences; else nothing.
    """

    scene: Scene
    field: FilterlabField
    camera: Camera
    transfer: TransferFunction
    options: dict[str, Any]
    volume_bytes: int = 0
    chosen: tuple[str, ...] = ()

    def render(self, progress: Progress = False) -> Tensor:
        """The image `(H, W, 4)`, as `filterlab.render.render` gives it."""
        return render(self.field, self.camera, self.transfer, progress=progress, **self.options)


def load_scene(path: str | os.PathLike[str], overrides: Mapping[str, str] | None = None) -> Scene:
    """The scene in a YAML file, with some of its keys set anew ({"camera.window": "[0, 0, 0.5, 0.5]"}).

    Raises:
        ConfigError: every problem with its line, the path of the key and, for names, the known ones. Volume files are
            found here, before anything is computed.
    """
    return load_config(path, Scene, overrides)


def build(scene: Scene) -> Prepared:
    """Loads or samples what the scene shows, reconstructs it and builds camera, transfer function and lights.

    Raises ValueError where `method: auto` finds nothing within its budget, with the best there is.
    """
    volume = _volume(scene)
    scene, chosen = settled(scene, volume)
    if volume is None:
        assert scene.signal is not None
        signal = scene.signal.build()
        field, value_range = signal, lambda: _range(signal.sample(64).samples)
    else:
        field = (scene.method or Reconstruction()).build(volume)
        value_range = partial(_range, volume.samples)
    options = {
        "size": scene.size,
        "step": scene.step_or_default,
        "shading": scene.lighting.build() if scene.lighting else None,
        "background": scene.background,
        "region": scene.region.build() if scene.region else None,
        "jitter_seed": scene.jitter,
        "termination": scene.termination,
        "dtype": scene.dtype,
        "device": scene.device,
    }
    transfer = scene.transfer.build(value_range, field.domain.voxel_size)
    camera = scene.camera.build(field.domain, scene.size)
    return Prepared(scene, field, camera, transfer, options, 0 if volume is None else volume.samples.nbytes, chosen)


def render_scene(scene: Scene, progress: Progress = False) -> Tensor:
    """The picture `(H, W, 3)`: linear RGB over the scene's background, ready for `filterlab.io.save_image`.

    For its opacity as well: `build(scene).render()`.
    """
    return build(scene).render(progress)[..., :3]


def settled(scene: Scene, volume: Volume | None) -> tuple[Scene, tuple[str, ...]]:
    """The scene with `method: auto` replaced by what is found on the volume, and how, in sentences."""
    method = scene.method
    if volume is None or method is None or method.max_error is None:
        return scene, ()
    found = recommend(volume, method.max_error, task="dvr", boundary=method.boundary, nan=method.nan)
    if found.pick is None:
        best = report.sentences(found)[-1].removeprefix("The ").removesuffix(".")
        raise ValueError(f"method: found none within max_error {report.percent(method.max_error)}; the {best}")
    explicit = Reconstruction(
        name=found.pick.method,
        scheme=found.pick.scheme,
        storage=found.pick.storage,  # type: ignore[arg-type]
        boundary=method.boundary,
        nan=method.nan,
    )
    step = found.pick.step if scene.step is None else scene.step
    return scene.model_copy(update={"method": explicit, "step": step}), tuple(report.sentences(found))


def _volume(scene: Scene) -> Volume | None:
    """The samples, in the type and on the device of the scene; None for a signal that is shown as it is."""
    dtype = scene.dtype
    if scene.volume is not None:
        volume = scene.volume.load()
    else:
        assert scene.signal is not None
        if scene.signal.samples is None:
            return None
        volume = scene.signal.build().sample(scene.signal.samples, dtype=dtype)
    if dtype == torch.float64 or volume.dtype == torch.float64:
        volume = volume.to(dtype)
    return volume.to(scene.device)


def _range(samples: Tensor) -> tuple[float, float]:
    low, high = samples.aminmax()
    return float(low), float(high)
