"""How it is seen: camera, lights, and the part that is shown."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator
from torch import Tensor

from filterlab.fields.base import Domain
from filterlab.render.camera import WHOLE, Camera, OrthographicCamera, PerspectiveCamera, Window, check_window
from filterlab.render.rays import check_region
from filterlab.render.scenery import toward
from filterlab.render.shading import Light, Shading
from filterlab.scenes.model.colors import Color
from filterlab.scenes.model.quantities import LISTED, Component, Positive, Section, Told, Vector

Degrees = Annotated[float, Field(ge=-360, le=360)]
Compass = Annotated[tuple[Degrees, Annotated[float, Field(ge=-90, le=90)]], LISTED]


class CameraView(Section):
    """Where the camera is: at a pose, or looking along a direction from where the whole domain is in view."""

    examples = (
        "{direction: [-0.6, 0.75, -0.5], up: [0, 0, 1], field_of_view: 30, margin: 1.05, window: [0.1, 0.1, 0.9, 0.9]}",
        "{compass: [20, 33]}",
        "{projection: orthographic, position: [64, -300, 64], target: [64, 64, 64], height: 150}",
    )

    projection: Literal["perspective", "orthographic"] = "perspective"
    """How it sees."""
    direction: Annotated[Vector, Told(unit="world, any length")] | None = None
    """In which it looks; the rest is framing. Left out, along y (along z where y is up)."""
    compass: Annotated[Compass, Told("[azimuth, down]", "degrees")] | None = None
    """Instead of a direction, as maps say it: clockwise from north (+y), and down from the horizontal. From straight
    above, 90, the azimuth is up in the picture."""
    position: Annotated[Vector, Told(unit="world")] | None = None
    """Where it is, instead of a direction; with a `target`."""
    target: Annotated[Vector, Told(unit="world")] | None = None
    """What is in the middle of the whole image plane; with a `position`."""
    up: Annotated[Vector, Told(unit="world, any length")] = (0.0, 0.0, 1.0)
    """What is up in the picture."""
    field_of_view: Annotated[float, Told("a number between 0 and 180", "degrees")] = 30.0
    """Vertical angle of a perspective view."""
    height: Annotated[Positive, Told(unit="world length")] | None = None
    """Of the image plane of an orthographic view with a position."""
    margin: Annotated[float, Told("a number ≥ 1")] = 1.05
    """Of framing: the domain fills 1/margin of the picture."""
    window: Annotated[Window, Told("[left, top, right, bottom] in 0 … 1", "parts of the image plane")] = WHOLE
    """The part of the image plane that is shown, magnified."""

    @model_validator(mode="after")
    def _consistent(self) -> CameraView:
        if (self.position is None) != (self.target is None):
            raise ValueError("expected position and target together; got one of them")
        ways = {"a direction": self.direction, "a compass": self.compass, "position and target": self.position}
        given = [name for name, value in ways.items() if value is not None]
        if len(given) > 1:
            raise ValueError(f"expected one of {', '.join(ways)}; got {' and '.join(given)}")
        with_height = self.projection == "orthographic" and self.position is not None
        if with_height != (self.height is not None):
            raise ValueError("height goes with an orthographic view of a given position and target, and only with that")
        self.build(Domain((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), (1, 1))
        return self

    @property
    def looking(self) -> Vector:
        """The direction in which it looks."""
        if self.compass is not None:
            return toward(self.compass[0], -self.compass[1])
        return self.direction or ((0.0, 0.0, 1.0) if self.up[0] == self.up[2] == 0 else (0.0, 1.0, 0.0))

    def build(self, domain: Domain, size: tuple[int, int], points: Tensor | None = None) -> Camera:
        """The camera, for an image of that size; in view are the domain, or world points (M, 3) in its stead."""
        if self.position is not None and self.target is not None:
            return self._at(self.position, self.target)
        framing = {"up": self._up, "aspect": self.aspect(size), "margin": self.margin, "window": self.window}
        kind = OrthographicCamera
        if self.projection == "perspective":
            kind, framing["field_of_view"] = PerspectiveCamera, self.field_of_view
        if points is None:
            return kind.framing(domain, self.looking, **framing)  # type: ignore[arg-type]
        return kind.of_points(points, self.looking, **framing)  # type: ignore[arg-type]

    def _at(self, position: Vector, target: Vector) -> Camera:
        pose = {"position": position, "target": target, "up": self.up, "window": self.window}
        if self.projection == "perspective":
            return PerspectiveCamera(**pose, field_of_view=self.field_of_view)
        assert self.height is not None
        return OrthographicCamera(**pose, height=self.height)

    @property
    def straight(self) -> bool:
        """Whether a compass says straight down or up: then azimuth is what is above in the picture."""
        return self.compass is not None and abs(self.compass[1]) == 90

    @property
    def _up(self) -> Vector:
        return toward(self.compass[0], 0) if self.straight else self.up  # type: ignore[index]

    @property
    def framed(self) -> bool:
        """Whether nothing is said of where it is and where it looks."""
        return self.direction is None and self.compass is None and self.position is None

    def aspect(self, size: tuple[int, int]) -> float:
        """Width / height of the whole image plane, of which a picture of that size shows the window."""
        check_window(self.window)
        left, top, right, bottom = self.window
        return size[0] * (bottom - top) / (size[1] * (right - left))


class LightSource(Section):
    """A light infinitely far away."""

    examples = ("{direction: [-0.2, -1, 0.8], color: lightyellow}",)

    direction: Annotated[Vector, Told(unit="world, any length")] | None = None
    """*To* the light; left out, it is a headlight, which shines along the ray."""
    color: Color = (1.0, 1.0, 1.0)
    """Of its light; numbers above 1 are brighter."""

    @model_validator(mode="after")
    def _valid(self) -> LightSource:
        Light(self.direction, self.color)
        return self


class Lighting(Section):
    """Blinn-Phong shading of a medium, two-sided; of a surface the lights alone, its material has the weights."""

    examples = (
        "{lights: [{direction: [-0.2, -1, 0.8]}, {color: [0.3, 0.3, 0.3]}], ambient: 0.2, diffuse: 0.7, specular: 0.3,"
        " shininess: 32}",
    )

    lights: tuple[LightSource, ...] = (LightSource(),)
    """All of them; left out, one white headlight."""
    ambient: Component = 0.2
    """Weight of light from everywhere."""
    diffuse: Component = 0.7
    """Weight of the lights on a matt surface."""
    specular: Component = 0.3
    """Weight of their highlights."""
    shininess: Annotated[float, Field(ge=1)] = 32.0
    """Exponent of the highlights: the higher, the smaller."""

    def build(self) -> Shading:
        """The shading."""
        lights = tuple(Light(light.direction, light.color) for light in self.lights)
        return Shading(lights, self.ambient, self.diffuse, self.specular, self.shininess)


class Region(Section):
    """A world-space box outside of which nothing is seen."""

    examples = ("{lower: [0, 0, 0], upper: [100, 100, 50]}",)

    lower: Annotated[Vector, Told(unit="world")]
    """Its corner with the least x, y, z."""
    upper: Annotated[Vector, Told(unit="world")]
    """Its corner with the largest."""

    @model_validator(mode="after")
    def _valid(self) -> Region:
        check_region(self.build())
        return self

    def build(self) -> tuple[Vector, Vector]:
        """(lower, upper)."""
        return self.lower, self.upper
