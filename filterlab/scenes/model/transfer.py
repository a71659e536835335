"""Transfer functions of scenes: what the values of a medium look like."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from filterlab.render.colormaps import check_colormap
from filterlab.render.transfer import TransferFunction
from filterlab.scenes.model.colors import Color, with_opacity
from filterlab.scenes.model.quantities import Opacity, Positive, Section, Told

Value = Annotated[float, Told(unit="of the volume's values, or parts of their range: `axis`")]
ColormapName = Annotated[
    str, AfterValidator(check_colormap), Told("a name of matplotlib's: viridis, magma, gray, coolwarm, …")
]


class ControlPoint(Section):
    """A control point of a transfer function: what a value looks like."""

    examples = ("{value: 120, color: [0.9, 0.5, 0.2], opacity: 0.1}", "{value: 120, color: '#ff880019'}")

    value: Value
    """The value."""
    color: Color
    """Its colour; `#rrggbbaa` brings the opacity as well."""
    opacity: Opacity
    """Its opacity in `unit`; 1 is exactly opaque."""

    @model_validator(mode="before")
    @classmethod
    def _of_color(cls, section: Any) -> Any:
        return with_opacity(section, "opacity")


class Peak(Section):
    """A triangle-shaped peak of a transfer function."""

    examples = ("{center: 130, width: 110, height: 0.05, color: steelblue}",)

    center: Value
    """The value at the apex."""
    width: Annotated[Positive, Told(unit="as `center`")]
    """Of the base."""
    height: Opacity
    """The opacity in `unit` at the apex."""
    color: Color
    """Of all of it; `#rrggbbaa` brings the height as well."""

    @model_validator(mode="before")
    @classmethod
    def _of_color(cls, section: Any) -> Any:
        return with_opacity(section, "height")


class OpacityPoint(Section):
    """A control point of the opacity alone, where a colormap gives the colours."""

    examples = ("{value: 0.2, opacity: 0}",)

    value: Value
    """The value."""
    opacity: Opacity
    """Its opacity in `unit`."""


class Transfer(Section):
    """What the values of a medium look like: by control points, as a sum of peaks, or by a colormap.

    Between control points colour and opacity are linear, beyond both ends they are constant. A colormap is taken at
    its own entries, decoded from sRGB; those of few colours are blended.
    """

    examples = (
        "{axis: normalized, unit: 0.5, points: [{value: 0.2, color: tomato, opacity: 0},"
        " {value: 0.6, color: '#fff0e0', opacity: 0.4}]}",
        "{peaks: [{center: 130, width: 110, height: 0.05, color: steelblue}]}",
        "{axis: normalized, colormap: viridis, ramp: [{value: 0.1, opacity: 0}, {value: 0.9, opacity: 0.5}],"
        " range: [0, 1]}",
    )

    points: Annotated[list[ControlPoint], Field(min_length=1)] | None = None
    """Control points, in order of their values."""
    peaks: Annotated[list[Peak], Field(min_length=1)] | None = None
    """Peaks, whose opacities are added."""
    colormap: ColormapName | None = None
    """Colours by value; with a `ramp`."""
    ramp: Annotated[list[OpacityPoint], Field(min_length=1)] | None = None
    """The opacities of a colormap, in order of their values."""
    range: tuple[Value, Value] | None = None
    """The values of the colormap's first and last colour; left out, those at the ends of the ramp."""
    axis: Literal["raw", "normalized"] = "raw"
    """`raw`: in values of the volume or signal; `normalized`: 0 … 1 stand for its smallest and largest sample."""
    unit: Annotated[Positive, Told(unit="world length")] | None = None
    """The length that the opacities are for; left out, one voxel (its shortest edge)."""

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        ways = [name for name in ("points", "peaks", "colormap") if getattr(self, name) is not None]
        if len(ways) != 1:
            raise ValueError("expected points, peaks or a colormap" + (f"; got {' and '.join(ways)}" if ways else ""))
        if (self.ramp is None) != (self.colormap is None):
            raise ValueError("expected a colormap and a ramp of opacities together; got one of them")
        if self.range is not None and self.colormap is None:
            raise ValueError("range goes with a colormap, and only with that")
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
        if self.colormap is not None:
            ramp = [(low + span * p.value, p.opacity) for p in self.ramp or ()]
            ends = None if self.range is None else (low + span * self.range[0], low + span * self.range[1])
            return TransferFunction.from_colormap(self.colormap, ramp, ends, unit)
        points = self.points or []
        return TransferFunction(
            [low + span * p.value for p in points], [p.color for p in points], [p.opacity for p in points], unit
        )
