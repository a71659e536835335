"""What surfaces of scenes are made of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from filterlab.io.images import load_image
from filterlab.render import materials
from filterlab.render.materials import Coloring
from filterlab.scenes.model.colors import Color, with_opacity
from filterlab.scenes.model.quantities import Component, Opacity, Positive, Section, Told, Vector
from filterlab.scenes.model.sources import found


class OfSheets(Section):
    """What every material of a surface has."""

    bare: ClassVar[str] = "kind"

    opacity: Opacity = 1.0
    """Of one sheet; below 1 those behind show through (`sheets`)."""

    @model_validator(mode="before")
    @classmethod
    def _of_color(cls, section: Any) -> Any:
        return with_opacity(section, "opacity")


class PhongModel(OfSheets):
    """Blinn-Phong, two-sided."""

    examples = (
        "{kind: phong, color: '#d9b88c', ambient: 0.2, diffuse: 0.7, specular: 0.3, shininess: 32, opacity: 0.5}",
    )

    kind: Literal["phong"] = "phong"
    """Tells it from the other materials; a surface without one has this."""
    color: Color = (0.85, 0.72, 0.55)
    """Of the surface; `#rrggbbaa` brings the opacity as well."""
    ambient: Component = 0.2
    """Weight of light from everywhere."""
    diffuse: Component = 0.7
    """Weight of the lights on a matt surface."""
    specular: Component = 0.3
    """Weight of their highlights."""
    shininess: Annotated[float, Field(ge=1)] = 32.0
    """Exponent of the highlights: the higher, the smaller."""

    def build(self, coloring: Coloring | None = None) -> materials.Material:
        """The material; of a colouring in place of its own colour."""
        weights = (self.ambient, self.diffuse, self.specular, self.shininess)
        return materials.Phong(coloring or self.color, *weights, opacity=self.opacity)


class ToonModel(OfSheets):
    """Bands of light and contours, as a draughtsman's."""

    examples = ("{kind: toon, color: gold, bands: 3, ambient: 0.3, contour: 0.8, ink: black, opacity: 1}",)

    kind: Literal["toon"]
    """Tells it from the other materials."""
    color: Color = (0.9, 0.75, 0.5)
    """Of the surface; `#rrggbbaa` brings the opacity as well."""
    bands: Annotated[int, Field(ge=1)] = 3
    """Of light."""
    ambient: Opacity = 0.3
    """Part of the colour that is there without light."""
    contour: Annotated[Component, Told(unit="world length")] = 0.0
    """How wide contours are; 0: none, and no curvature is computed."""
    ink: Color = (0.02, 0.02, 0.05)
    """The colour of contours."""

    def build(self, coloring: Coloring | None = None) -> materials.Material:
        """The material; of a colouring in place of its own colour."""
        return materials.Toon(coloring or self.color, self.bands, self.ambient, self.contour, self.ink, self.opacity)


class ReflectionLinesModel(OfSheets):
    """Mirrored stripes of light: their kinks show where the curvature jumps."""

    examples = (
        "{kind: reflection_lines, axis: [0, 0, 1], count: 8, sharpness: 8, bright: white, dark: midnightblue,"
        " opacity: 1}",
    )

    kind: Literal["reflection_lines"]
    """Tells it from the other materials."""
    axis: Annotated[Vector, Told(unit="world, any length")] = (0.0, 0.0, 1.0)
    """About which the stripes go round."""
    count: Positive = 8.0
    """How many of them."""
    sharpness: Positive = 8.0
    """Of their edges."""
    bright: Color = (0.95, 0.95, 0.95)
    """The colour of stripes."""
    dark: Color = (0.05, 0.05, 0.1)
    """The colour between them."""

    @model_validator(mode="after")
    def _valid(self) -> Self:
        self.build()
        return self

    def build(self, coloring: Coloring | None = None) -> materials.Material:
        """The material, which has colours of its own."""
        return materials.ReflectionLines(self.axis, self.count, self.sharpness, self.bright, self.dark, self.opacity)


class EnvironmentModel(OfSheets):
    """A mirror of what is around."""

    examples = (
        "{kind: environment, color: '#7d7d82', reflectivity: 0.4, opacity: 1}",
        "{kind: environment, picture: sky.png}",
    )

    kind: Literal["environment"]
    """Tells it from the other materials."""
    picture: Annotated[str, Field(min_length=1), Told("a path")] | None = None
    """An equirectangular PNG, looked for like a volume, its top towards +z; left out, a clear sky."""
    color: Color = (0.2, 0.2, 0.22)
    """Of the surface itself; `#rrggbbaa` brings the opacity as well."""
    reflectivity: Opacity = 0.4
    """Part of the light that is mirrored, seen from the front; at grazing angles it is more."""

    @field_validator("picture")
    @classmethod
    def _found(cls, picture: str | None, info: ValidationInfo) -> str | None:
        """Looked for when the scene is read, as a volume is."""
        return None if picture is None else str(found(picture, info, "a picture"))

    def build(self, coloring: Coloring | None = None) -> materials.Material:
        """The material; of a colouring in place of its own colour. Raises ValueError for a picture that is none."""
        picture = None if self.picture is None else load_image(self.picture)
        return materials.Environment(picture, coloring or self.color, self.reflectivity, self.opacity)


def of_kind(value: Any) -> Any:
    """A bare name stands for the section of that kind and every default; without a kind it is phong."""
    if isinstance(value, str):
        return {"kind": value}
    return {"kind": "phong", **value} if isinstance(value, Mapping) else value


MaterialModel = Annotated[PhongModel | ToonModel | ReflectionLinesModel | EnvironmentModel, Field(discriminator="kind")]
