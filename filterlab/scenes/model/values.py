"""Pictures of values: the largest along every ray, and those on a plane."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import model_validator

from filterlab.fields.base import Domain
from filterlab.render.colormaps import GRAY, ColorScale
from filterlab.render.values import Plane
from filterlab.scenes.model.quantities import Positive, Section, Switched, Told, Vector, named
from filterlab.scenes.model.transfer import ColormapName


class ValueColors(Section):
    """What values look like: grey or a colormap over a window of them."""

    center: Annotated[float, Told(unit="of the volume's values")] | None = None
    """The value in the middle of the window; with a `width`. Left out, the window is the range of the samples."""
    width: Annotated[Positive, Told(unit="of the volume's values")] | None = None
    """From the window's first value to its last; values beyond look as those."""
    colormap: ColormapName = GRAY
    """Colours from the window's first value to its last. Under `gray` the digits of the picture are linear in the
    values, as viewers of scans show them."""

    @model_validator(mode="after")
    def _together(self) -> Self:
        if (self.center is None) != (self.width is None):
            raise ValueError("expected center and width of the window together; got one of them")
        return self

    @property
    def chosen(self) -> bool:
        """Whether any of it is."""
        return self.center is not None or self.colormap != GRAY

    def scale(self, value_range: Callable[[], tuple[float, float]]) -> ColorScale:
        """The colours. `value_range` is asked for (least, largest) where there is no window."""
        if self.center is None or self.width is None:
            return ColorScale(*value_range(), self.colormap)
        return ColorScale(self.center - self.width / 2, self.center + self.width / 2, self.colormap)


class MipModel(Switched, ValueColors):
    """The largest value along every ray (maximum intensity projection); `true` stands for all defaults.

    With a `transfer` it has that one's colours, and no window.
    """

    examples = ("true", "{center: 400, width: 900, colormap: bone}")


class SliceModel(ValueColors):
    """The values on a plane; a bare axis stands for the plane across its middle.

    With a `transfer` it has that one's colours, and no window. Without a direction or position of the camera it is seen
    from its front, orthographically: across x, y or z the other two axes go to the right and up.
    """

    examples = (
        "z",
        "{axis: z, position: 31.5, center: 40, width: 400, colormap: gray}",
        "{point: [64, 64, 32], normal: [1, 1, 1]}",
    )
    bare: ClassVar[str] = "axis"

    axis: Literal["x", "y", "z"] | None = None
    """The world axis that the plane lies across."""
    position: Annotated[float, Told(unit="world")] | None = None
    """Where on the axis; left out, in the middle of the volume."""
    point: Annotated[Vector, Told(unit="world")] | None = None
    """Instead of an axis, a point on the plane; with a `normal`."""
    normal: Annotated[Vector, Told(unit="world, any length")] | None = None
    """What the plane is orthogonal to; it points to where the plane is seen from."""

    @model_validator(mode="before")
    @classmethod
    def _from_axis(cls, value: Any) -> Any:
        return named(value, cls.bare)

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.point is None) != (self.normal is None):
            raise ValueError("expected point and normal together; got one of them")
        if (self.axis is None) == (self.point is None):
            raise ValueError("expected either an axis or a point and a normal" + ("; got both" if self.axis else ""))
        if self.position is not None and self.axis is None:
            raise ValueError("position goes with an axis, and only with that")
        self.plane(Domain((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)))
        return self

    def plane(self, domain: Domain) -> Plane:
        """The plane."""
        if self.axis is not None:
            return Plane.across(self.axis, domain, self.position)
        assert self.point is not None
        assert self.normal is not None
        return Plane(self.point, self.normal)
