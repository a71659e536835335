"""Terrains of scenes: heights in a file, and how they are shaped, coloured, lit and surrounded."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from filterlab.heights import Heights
from filterlab.io.heights import format_of, load_heights
from filterlab.io.heights_header import DegreesWarning
from filterlab.render import materials, relief
from filterlab.render.colormaps import HYPSOMETRIC, check_colormap
from filterlab.render.materials import Coloring
from filterlab.scenes.model.colors import Color, parsed
from filterlab.scenes.model.materials import (
    EnvironmentModel,
    OfSheets,
    PhongModel,
    ReflectionLinesModel,
    ToonModel,
    of_kind,
)
from filterlab.scenes.model.quantities import LISTED, Component, Positive, Told, named
from filterlab.scenes.model.sources import found
from filterlab.scenes.model.surface import Cast
from filterlab.scenes.model.view import Degrees

QUANTITIES = ("slope", "aspect", "normal", "hillshade")
"""What may be asked for as colours, beside colormaps by height and one colour."""
CLEAR, NO_SKY = "clear", "none"
"""Skies that are no picture."""

Ends = Annotated[tuple[float, float], LISTED]
Altitude = Annotated[float, Field(gt=0, le=90)]
Rgb = Annotated[tuple[Component, Component, Component], LISTED]


class MattModel(OfSheets):
    """Bare ground under the sky: lit by what it faces, slopes that turn away from it are dark.

    Slopes, aspects, normals and hillshades are shown as they are.
    """

    examples = ("{kind: matt, skylight: [0.26, 0.31, 0.4], opacity: 1}",)

    kind: Literal["matt"] = "matt"
    """Tells it from the other materials; a terrain without one has this."""
    skylight: Color = (0.26, 0.31, 0.4)
    """Light from the whole sky; level ground has all of it, a wall half."""

    def build(self, coloring: Coloring) -> materials.Material:
        """The material, of a colouring."""
        return relief.Lambertian(coloring, self.skylight, self.opacity)


TerrainMaterial = Annotated[
    MattModel | PhongModel | ToonModel | ReflectionLinesModel | EnvironmentModel, Field(discriminator="kind")
]


def _of_kind(value: Any) -> Any:
    return {"kind": "matt", **value} if isinstance(value, dict) else of_kind(value)


class TerrainLook(Cast):
    """How heights are shown, wherever they come from."""

    unit: Annotated[str, Told("metre, kilometre, foot, degree, …")] | None = None
    """Of x and y, where the file declares none; left out, degrees where the numbers look like them, else metres."""
    fill: bool = False
    """Whether heights that are missing are made from those around; else they are holes."""
    spline: Literal["linear", "c0", "c1", "c2"] = "c1"
    """How heights become a surface: each smoother than the last, and `c2` farther from the heights."""
    prefilter: bool = False
    """Of `c2` only, which smooths: lets it follow the heights as well as `c1` does."""
    exaggeration: Annotated[float, Field(gt=0, le=1000)] | None = None
    """How many times as high as it is the ground stands; left out, as its relief suggests, 1 for mountains."""
    color: Annotated[
        str | Rgb, Told("a colormap, `slope`, `aspect`, `normal`, `hillshade`, or a [colour](#colours)")
    ] = HYPSOMETRIC
    """Tints of an atlas (`hypsometric`) or a colormap, by height; slope or aspect in degrees, the normal, or light from
    the sun as maps shade it; or one colour."""
    range: Annotated[Ends, Told("[low, high]", "heights as in the file, or degrees")] | None = None
    """Heights, slopes or azimuths at both ends of the colours; left out, heights that there are, but for half a percent
    at either end, slopes from 0 to 60, azimuths from 0 to 360."""
    drape: Annotated[str, Field(min_length=1), Told("a path")] | None = None
    """Instead of colours, a picture, looked for like a volume: PNG or JPEG that covers the whole map, or a GeoTIFF with
    its own place."""
    material: Annotated[TerrainMaterial, BeforeValidator(_of_kind)] = MattModel()
    """What the ground is made of; a bare name stands for its kind. Its colour is the terrain's."""
    sun: Annotated[tuple[Degrees, Altitude], LISTED, Told("[azimuth, altitude]", "degrees")] = (315.0, 38.0)
    """Where it stands: clockwise from north (+y), and above the horizon. Lights of a `lighting` take its place."""
    shadows: bool = True
    """Whether mountains cast them."""
    sky: Annotated[str, Field(min_length=1), Told("`clear`, `none`, or a path")] = CLEAR
    """What is around: a clear sky, the `background` (none), or an equirectangular picture, looked for like a volume."""
    water: Annotated[float, Told(unit="as the heights in the file")] | None = None
    """The level of still water; left out, there is none."""
    haze: Annotated[Positive, Told(unit="metres")] | None = None
    """How far one sees: the distance at which 1/e of a colour is left; left out, there is none."""
    block: bool = True
    """Whether there are walls of earth where the ground ends."""
    subpixels: Annotated[int, Field(ge=1, le=8)] = 2
    """s: a pixel is the mean of s² rays."""

    @field_validator("color")
    @classmethod
    def _known_color(cls, color: str | Rgb) -> str | Rgb:
        if isinstance(color, str) and color not in QUANTITIES and one_color(color) is None:
            try:
                check_colormap(color)
            except ValueError as error:
                raise ValueError(f"{error}; or {', '.join(QUANTITIES)}, or a colour by name") from None
        return color

    @field_validator("range")
    @classmethod
    def _increasing(cls, ends: Ends | None) -> Ends | None:
        if ends is not None and not ends[0] < ends[1]:
            raise ValueError(f"expected the lower end first; got {ends[0]:g} and {ends[1]:g}")
        return ends

    @field_validator("drape", "sky")
    @classmethod
    def _pictured(cls, name: str | None, info: ValidationInfo) -> str | None:
        """Looked for when the scene is read, as a volume is."""
        if name is None or (info.field_name == "sky" and name in (CLEAR, NO_SKY)):
            return name
        return str(found(name, info, "a picture"))

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        own = type(self.material).model_fields.get("color")
        if own is not None and self.material.color != own.default:  # type: ignore[union-attr]
            raise ValueError("material.color: the colours of a terrain are its own; give color")
        if self.drape is not None and self.color != HYPSOMETRIC:
            raise ValueError("expected either a drape or a color; got both")
        if self.range is not None and not self.shows_values:
            raise ValueError("range: these colours stand for no values; leave it out")
        if self.sheets > 1 and (self.water is not None or self.block):
            raise ValueError("sheets: more than one goes without water, and with block: false")
        if self.prefilter and self.spline != "c2":
            raise ValueError(f"prefilter: it is that of the spline c2; got {self.spline}")
        return self

    @property
    def shows_values(self) -> bool:
        """Whether colours stand for values, which a legend can tell."""
        plain = isinstance(self.material, ReflectionLinesModel) or self.drape is not None
        return not plain and self.color not in ("normal", "hillshade") and one_color(self.color) is None


class TerrainModel(TerrainLook):
    """Heights on a grid, an elevation model, as a smooth surface, with all that is around; a bare name is their file.

    Places in such a scene, of a camera or a region, are x and y as in the file, and heights in the file's unit;
    directions are those of the picture, with the ground as high as it is shown. Left out, the camera looks a little
    down to the north; the whole map is in view.
    """

    bare: ClassVar[str] = "heights"
    examples = (
        "dem.tif",
        "{heights: dem.tif, band: 1, unit: metre, fill: true, spline: c2, prefilter: true, exaggeration: 1.5,"
        " color: terrain, range: [0, 900], sun: [300, 15], shadows: false, material: matt, sky: clear, water: 12,"
        " haze: 40000, block: true, sheets: 1, subpixels: 3}",
        "{heights: dem.tif, drape: photo.jpg, sky: none}",
        "{heights: dem.tif, color: slope, material: {kind: phong, shininess: 10}}",
    )

    heights: Annotated[str, Field(min_length=1), Told("a path")]
    """The file, looked for like a volume: GeoTIFF, .npy, .npz, PNG of 16 bits, .asc or .hgt."""
    band: Annotated[int, Field(ge=1)] | None = None
    """Of a GeoTIFF with several."""

    @model_validator(mode="before")
    @classmethod
    def _from_path(cls, value: Any) -> Any:
        return named(value, cls.bare)

    @field_validator("heights")
    @classmethod
    def _found(cls, heights: str, info: ValidationInfo) -> str:
        path = found(heights, info, "a file of heights")
        format_of(path)
        return str(path)

    @property
    def sources(self) -> list[str]:
        """The files that it is made of."""
        pictures = [self.drape, None if self.sky in (CLEAR, NO_SKY) else self.sky]
        return [self.heights, *(picture for picture in pictures if picture is not None)]

    def load(self) -> Heights:
        """The heights. Raises VolumeFileError for a damaged file. What the unit says is not warned of."""
        with warnings.catch_warnings():
            if self.unit is not None:
                warnings.simplefilter("ignore", DegreesWarning)
            return load_heights(Path(self.heights), band=self.band)


def one_color(color: str | Rgb) -> Rgb | None:
    """That colour; None of a quantity, and of a colormap, which `gray` and `pink` are as well."""
    if not isinstance(color, str):
        return color
    if color in QUANTITIES:
        return None
    try:
        check_colormap(color)
    except ValueError:
        try:
            return parsed(color)[0]
        except ValueError:
            return None
    return None
