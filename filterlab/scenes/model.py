"""Models: what scene files and experiment configs say of volumes, signals, methods, cameras and lights.

Each is a strict section of a YAML file with a `build` that makes the object of this package it describes. A section
that is left out costs nothing: no lighting, no gradients. `scenes.build` puts them together.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import torch
from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from filterlab import signals
from filterlab.fields.base import Domain
from filterlab.fields.base import Field as FilterlabField
from filterlab.fields.storage import StorageName
from filterlab.io.bounded import VolumeFileError
from filterlab.io.config import StrictModel
from filterlab.io.images import load_image
from filterlab.io.volumes import VolumeHeader, describe, load_volume
from filterlab.methods import METHODS, Method, reconstruct, scheme_named
from filterlab.names import NanChoice, unknown_name
from filterlab.render import materials
from filterlab.render.camera import WHOLE, Camera, OrthographicCamera, PerspectiveCamera, Window, check_window
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
    if name not in METHODS:
        raise ValueError(unknown_name("method", name, METHODS))
    return name


MethodName = Annotated[str, AfterValidator(_known_method)]


def _known_method_or_auto(name: str) -> str:
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


def _of_kind(value: Any) -> Any:
    """A bare name stands for the section of that kind and every default; without a kind it is phong."""
    if isinstance(value, str):
        return {"kind": value}
    return {"kind": "phong", **value} if isinstance(value, Mapping) else value


# a section that a bare name may stand for is validated as Python data, where a strict tuple would be no list
_Listed = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)
_ListedColor = Annotated[Color, _Listed]
_ListedVector = Annotated[Vector, _Listed]
Parameters = dict[str, float | Annotated[tuple[float, ...], _Listed]]


# --- what is shown ----------------------------------------------------------------------------------------------------


class VolumeFile(StrictModel):
    """A volume file; a bare name stands for the file as it is.

    Attributes:
        file: a path; `$NAME` in it stands for an environment variable. One that is not absolute is looked for in the
            folder of the scene, in the current folder, and in the folder named by $FILTERLAB_VOLUMES; `package:path` is
            a file that comes with an installed Python package (`nibabel:tests/data/example4d.nii.gz`).
        frame, channel: which volume of a time series, which of several values per voxel; see `filterlab.load_volume`.
    """

    bare: ClassVar[str] = "file"

    file: Annotated[str, Field(min_length=1)]
    frame: Annotated[int, Field(ge=0)] | None = None
    channel: Annotated[int, Field(ge=0)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_path(cls, value: Any) -> Any:
        return {cls.bare: value} if isinstance(value, str) else value

    def path(self, folder: Path = Path()) -> Path:
        """The file, absolute. Raises ValueError if there is none; the message lists where it was looked for."""
        return find_volume(self.file, folder)

    def header(self) -> VolumeHeader:
        """What the file says of its volume; no voxels are read.

        Raises VolumeFileError for a damaged file, or one that holds several volumes.
        """
        header = describe(self.path(), frame=self.frame, channel=self.channel)
        header.check_choice()
        if len(header.shape) != 3:
            expected = "one volume of shape (D, H, W) to show (a frame and a channel of several)"
            raise VolumeFileError(self.path(), expected, f"a batch (N, C, D, H, W) = {header.shape}")
        return header

    def load(self) -> Volume:
        """The volume, with its geometry. Raises VolumeFileError as `header` does."""
        self.header()
        return load_volume(self.path(), frame=self.frame, channel=self.channel)


def find_volume(name: str, folder: Path = Path()) -> Path:
    """The existing file that `name` stands for (see `VolumeFile`), absolute. Raises ValueError if there is none."""
    package, colon, inside = name.partition(":")
    if colon and package.isidentifier() and len(package) > 1:  # one letter is a drive
        return _packaged(package, inside)
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


def _folder(info: ValidationInfo) -> Path:
    """That of the file that is being read."""
    return Path((info.context or {}).get("folder", "."))


def _packaged(package: str, inside: str) -> Path:
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ValueError(f"expected the installed package {package!r}; it is not here (pip install {package})")
    path = Path(spec.submodule_search_locations[0]) / inside
    if not path.is_file():
        raise ValueError(f"expected a file of the package {package}; it has no {inside!r}")
    return path


class SignalModel(StrictModel):
    """A closed-form signal; a bare name stands for its default parameters.

    Attributes:
        name: a name from `filterlab.signals.SIGNALS`.
        parameters: of that signal, by name.
    """

    name: Annotated[str, AfterValidator(_known_signal)]
    parameters: Annotated[Parameters, Field(default_factory=dict)]

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        return _named(value)

    @field_validator("parameters")
    @classmethod
    def _usable(cls, parameters: Parameters, info: ValidationInfo) -> Parameters:
        if "name" in info.data:  # else the name is the mistake
            _check_parameters(info.data["name"], parameters)
        return parameters

    def build(self) -> signals.Signal:
        """The signal."""
        return signals.named(self.name, **self.parameters)  # type: ignore[arg-type]

    def finite(self) -> signals.Signal:
        """The signal. Raises ValueError unless it is finite at a point like any other."""
        told = f"expected parameters with which {self.name} is finite; got {self.parameters}"
        try:
            signal = self.build()
            point = torch.tensor([signal.domain.center], dtype=torch.float64) + 0.1 * signal.domain.voxel_size
            found = signal.value_and_gradient(point)
        except (ArithmeticError, RuntimeError, TypeError) as error:
            raise ValueError(f"{told} ({error})") from None
        if not all(bool(x.isfinite().all()) for x in found):
            raise ValueError(told)
        return signal

    @property
    def label(self) -> str:
        """The name with its parameters, e.g. `gaussian (sigma 0.2)`."""
        listed = ", ".join(f"{k} {list(v) if isinstance(v, tuple) else v}" for k, v in self.parameters.items())
        return f"{self.name} ({listed})" if listed else self.name


class SignalSource(SignalModel):
    """A signal that is shown, exact or sampled.

    Attributes:
        samples: n (or nx, ny, nz) voxels to sample it on, for a method to reconstruct; left out, the signal itself.
    """

    samples: Annotated[int, Field(ge=1, le=2048)] | Annotated[tuple[int, int, int], _Listed] | None = None

    @model_validator(mode="after")
    def _accepted(self) -> Self:
        if isinstance(self.samples, tuple) and min(self.samples) < 1:
            raise ValueError(f"samples must be positive; got {self.samples}")
        self.finite()
        return self


def _check_parameters(name: str, parameters: Parameters) -> None:
    """Raises ValueError for a parameter that the signal does not have, of another kind, or that it refuses."""
    known = inspect.signature(signals.SIGNALS[name]).parameters
    for parameter, value in parameters.items():
        if parameter not in known:
            raise ValueError(unknown_name(f"parameter of {name}", parameter, known))
        expected = "three numbers [x, y, z]" if isinstance(known[parameter].default, tuple) else "a number"
        vector = isinstance(value, tuple)
        if vector != isinstance(known[parameter].default, tuple) or (vector and len(value) != 3):
            raise ValueError(f"{parameter}: expected {expected}; got {value}")
    signals.named(name, **parameters)  # type: ignore[arg-type]


class Reconstruction(StrictModel):
    """How samples become a field; a bare name stands for a method as it is. See `filterlab.reconstruct`.

    Attributes:
        name: of a method.
        scheme: left out, the fastest that runs.
    """

    name: MethodName
    prefilter: bool = True
    gradient: Literal["analytic", "central"] | None = None
    scheme: Annotated[str | None, AfterValidator(scheme_named)] = None
    sampler: Literal["exact", "texture_unit"] = "exact"
    storage: StorageName | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        if isinstance(value, Mapping) and "method" in value:
            raise ValueError("the key method is called name here: write {name: " + f"{value['method']}, …" + "}")
        return _named(value)

    @model_validator(mode="after")
    def _offered(self) -> Self:
        self._method.scheme(self.scheme, self.gradient, self.sampler)
        return self

    @property
    def _method(self) -> Method:
        return METHODS[self.name]

    def build(self, volume: Volume, boundary: str = "mirror", nan: str = "refuse") -> FilterlabField:
        """The field."""
        return reconstruct(
            volume,
            self.name,
            boundary=boundary,
            prefilter=self.prefilter,
            gradient=self.gradient,
            scheme=self.scheme,
            sampler=self.sampler,
            storage=self.storage,
            nan=nan,
        )


class SceneMethod(Reconstruction):
    """The method of a scene, and what it does at the volume's ends and where there are no values.

    Attributes:
        name: of a method, or `auto`: the cheapest one whose error on this volume stays within a budget, with the
            scheme, storage and (unless the scene has one) step that `filterlab.recommend` finds for task "dvr".
        max_error: that budget, in parts of the range of the volume's values; only with `auto`.
    """

    name: Annotated[str, AfterValidator(_known_method_or_auto)] = "triquadratic"
    max_error: Annotated[float, BeforeValidator(_part), Field(gt=0)] | None = None
    boundary: Annotated[str, AfterValidator(_known_boundary)] = "mirror"
    nan: NanChoice = "refuse"

    @model_validator(mode="after")
    def _offered(self) -> Self:
        if (self.name == AUTO) != (self.max_error is not None):
            raise ValueError(f"max_error goes with the name {AUTO}, and only with that; got {self.name}")
        if self.name != AUTO:
            self._method.scheme(self.scheme, self.gradient, self.sampler)
        elif settled := {"prefilter", "scheme", "gradient", "sampler", "storage"} & self.model_fields_set:
            raise ValueError(f"{AUTO} settles {', '.join(sorted(settled))}; leave it out, or name a method")
        return self

    def build(self, volume: Volume, boundary: str | None = None, nan: str | None = None) -> FilterlabField:
        """The field, by default with the scene's own boundary and choice of NaN."""
        return super().build(volume, boundary or self.boundary, nan or self.nan)


# --- how it is shown --------------------------------------------------------------------------------------------------


class ControlPoint(StrictModel):
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

    points: Annotated[list[ControlPoint], Field(min_length=1)] | None = None
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


class CameraView(StrictModel):
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
    def _consistent(self) -> CameraView:
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


# --- surfaces ---------------------------------------------------------------------------------------------------------


class PhongModel(StrictModel):
    """Blinn-Phong; see `filterlab.render.materials.Phong`."""

    kind: Literal["phong"] = "phong"
    color: _ListedColor = (0.85, 0.72, 0.55)
    ambient: Component = 0.2
    diffuse: Component = 0.7
    specular: Component = 0.3
    shininess: Annotated[float, Field(ge=1)] = 32.0
    opacity: Opacity = 1.0

    def build(self) -> materials.Material:
        """The material."""
        weights = (self.ambient, self.diffuse, self.specular, self.shininess)
        return materials.Phong(self.color, *weights, opacity=self.opacity)


class ToonModel(StrictModel):
    """Bands of light and contours; see `filterlab.render.materials.Toon`. `contour` is a world length."""

    kind: Literal["toon"]
    color: _ListedColor = (0.9, 0.75, 0.5)
    bands: Annotated[int, Field(ge=1)] = 3
    ambient: Annotated[float, Field(ge=0, le=1)] = 0.3
    contour: Component = 0.0
    ink: _ListedColor = (0.02, 0.02, 0.05)
    opacity: Opacity = 1.0

    def build(self) -> materials.Material:
        """The material."""
        return materials.Toon(self.color, self.bands, self.ambient, self.contour, self.ink, self.opacity)


class ReflectionLinesModel(StrictModel):
    """Mirrored stripes of light; see `filterlab.render.materials.ReflectionLines`."""

    kind: Literal["reflection_lines"]
    axis: _ListedVector = (0.0, 0.0, 1.0)
    count: Positive = 8.0
    sharpness: Positive = 8.0
    bright: _ListedColor = (0.95, 0.95, 0.95)
    dark: _ListedColor = (0.05, 0.05, 0.1)
    opacity: Opacity = 1.0

    @model_validator(mode="after")
    def _valid(self) -> Self:
        self.build()
        return self

    def build(self) -> materials.Material:
        """The material."""
        return materials.ReflectionLines(self.axis, self.count, self.sharpness, self.bright, self.dark, self.opacity)


class EnvironmentModel(StrictModel):
    """A mirror of what is around; see `filterlab.render.materials.Environment`.

    Attributes:
        picture: an equirectangular image file, looked for like a volume; left out, a clear sky.
    """

    kind: Literal["environment"]
    picture: Annotated[str, Field(min_length=1)] | None = None
    color: _ListedColor = (0.2, 0.2, 0.22)
    reflectivity: Annotated[float, Field(ge=0, le=1)] = 0.4
    opacity: Opacity = 1.0

    @field_validator("picture")
    @classmethod
    def _found(cls, picture: str | None, info: ValidationInfo) -> str | None:
        """Looked for when the scene is read, as a volume is."""
        return None if picture is None else str(find_volume(picture, _folder(info)))

    def build(self) -> materials.Material:
        """The material. Raises ValueError for a picture that can't be read."""
        picture = None if self.picture is None else load_image(self.picture)
        return materials.Environment(picture, self.color, self.reflectivity, self.opacity)


MaterialModel = Annotated[PhongModel | ToonModel | ReflectionLinesModel | EnvironmentModel, Field(discriminator="kind")]


class SurfaceModel(StrictModel):
    """The level set of a scene's field, hit exactly; a bare number stands for its level.

    Attributes:
        level: the value on the surface.
        axis: `raw`: a value of the volume; `normalized`: 0 … 1 stand for its smallest and largest sample.
        material: what it is made of; a bare name stands for its kind.
        sheets: how many hits of a ray are shown through each other, where the material is transparent.
        shadows: whether lights with a direction cast any.
        subpixels: s: a pixel is the mean of s² rays.
    """

    level: float
    axis: Literal["raw", "normalized"] = "raw"
    material: Annotated[MaterialModel, BeforeValidator(_of_kind)] = PhongModel()
    sheets: Annotated[int, Field(ge=1, le=64)] = 1
    shadows: bool = False
    subpixels: Annotated[int, Field(ge=1, le=8)] = 1

    @model_validator(mode="before")
    @classmethod
    def _from_level(cls, value: Any) -> Any:
        return {"level": value} if isinstance(value, int | float) and not isinstance(value, bool) else value

    def at(self, value_range: Callable[[], tuple[float, float]]) -> float:
        """The level as a value of the field. `value_range` is asked where the axis is normalized."""
        if self.axis == "raw":
            return self.level
        low, high = value_range()
        return low + self.level * (high - low)


class Scene(StrictModel):
    """A picture of a volume or a signal: of a medium, or of a surface in it.

    Attributes:
        description: for people.
        volume, signal: what is shown; exactly one of them.
        method: how samples are reconstructed; default triquadratic.
        transfer: of a medium: what its values look like.
        surface: instead of it: the level set that is shown.
        camera, region: see there.
        lighting: without it a medium's colours are shown as they are, and a surface has a headlight; of a surface it is
            the lights alone, and the material has the weights.
        size: (width, height) in pixels.
        step: of a medium, in voxels; default half a voxel, or what `method: auto` finds.
        background: linear RGB.
        jitter, termination: of a medium; see `render`. A surface takes jitter as the seed of its subpixels.
        precision: of samples and arithmetic.
        device: where to compute, as torch names it.
    """

    description: str = ""
    volume: VolumeFile | None = None
    signal: SignalSource | None = None
    method: SceneMethod | None = None
    transfer: Transfer | None = None
    surface: SurfaceModel | None = None
    camera: CameraView = CameraView()
    size: tuple[Pixels, Pixels] = (512, 512)
    step: Positive | None = None
    lighting: Lighting | None = None
    background: Color = (0.0, 0.0, 0.0)
    region: Region | None = None
    jitter: Annotated[int, Field(ge=0, lt=2**63)] | None = None
    termination: Annotated[float, Field(gt=0, lt=1)] | None = None
    precision: Literal["float32", "float64"] = "float32"
    device: str = "cpu"

    @field_validator("volume")
    @classmethod
    def _found(cls, volume: VolumeFile | None, info: ValidationInfo) -> VolumeFile | None:
        """Looked for when the scene is read: nothing is computed before every file is known to be there."""
        return None if volume is None else volume.model_copy(update={"file": str(volume.path(_folder(info)))})

    @model_validator(mode="after")
    def _consistent(self) -> Scene:
        if (self.volume is None) == (self.signal is None):
            raise ValueError("expected either a volume or a signal" + ("; got both" if self.volume else ""))
        if self.signal is not None and self.signal.samples is None and self.method is not None:
            raise ValueError("a signal that is not sampled needs no method: give signal.samples, or leave method out")
        if (self.transfer is None) == (self.surface is None):
            both = "; got both" if self.transfer else "; got neither"
            raise ValueError(f"expected either a transfer function (a medium) or a surface{both}")
        if self.surface is not None:
            self._check_surface()
        elif self.transfer is not None and self.transfer.axis == "raw":  # else the values are known with the volume
            self.transfer.build(lambda: (0.0, 1.0), 1.0).to(self.dtype)
        return self

    def _check_surface(self) -> None:
        stepped = [name for name in ("step", "termination") if getattr(self, name) is not None]
        if stepped:
            raise ValueError(f"{' and '.join(stepped)}: a surface is hit exactly, not stepped to; leave it out")
        if self.signal is not None and self.signal.samples is None:
            raise ValueError("a surface is that of samples: give signal.samples, a signal itself has no exact pieces")

    @property
    def dtype(self) -> torch.dtype:
        """Of samples and arithmetic."""
        return torch.float64 if self.precision == "float64" else torch.float32

    @property
    def step_or_default(self) -> float:
        """In voxels."""
        return STEP if self.step is None else self.step
