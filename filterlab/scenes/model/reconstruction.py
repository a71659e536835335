"""How samples become a field."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from filterlab.fields.base import Field as FilterlabField
from filterlab.fields.storage import StorageName
from filterlab.methods import METHODS, Method, reconstruct, scheme_named
from filterlab.names import NanChoice
from filterlab.scenes.model.quantities import Names, Section, Told, named, part
from filterlab.volume import Boundary, Volume

AUTO = "auto"

MethodName = Annotated[str, AfterValidator(Names("method", lambda: METHODS))]


class Reconstruction(Section):
    """How samples become a field; a bare name stands for a method as it is. See `filterlab.reconstruct`."""

    bare: ClassVar[str] = "name"

    name: MethodName
    """Of a method."""
    prefilter: bool = True
    """Whether samples are prefiltered, as the method does by default; without, it smooths."""
    gradient: Literal["analytic", "central"] | None = None
    """Which gradient; left out, the method's own."""
    scheme: Annotated[
        str | None, AfterValidator(scheme_named), Told("fused, direct, or another of the method's schemes")
    ] = None
    """How it is computed; left out, the fastest that runs."""
    sampler: Literal["exact", "texture_unit"] = "exact"
    """`texture_unit`: with fractions of 8 bits, as texture units of GPUs interpolate."""
    storage: StorageName | None = None
    """The type in which coefficients are kept; left out, the one they are computed in."""

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        if isinstance(value, Mapping) and "method" in value:
            raise ValueError("the key method is called name here: write {name: " + f"{value['method']}, …" + "}")
        return named(value, cls.bare)

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
    """How samples become a field; a bare name stands for a method as it is. `filterlab methods` lists them."""

    examples = (
        "triquadratic",
        "{name: notch, prefilter: false, gradient: analytic, scheme: fused, sampler: exact, storage: float16,"
        " boundary: wrap, nan: propagate}",
        "{name: auto, max_error: 0.5%}",
    )

    name: Annotated[str, AfterValidator(Names("method", lambda: (*METHODS, AUTO)))] = "triquadratic"
    """Of a method; or `auto`: the cheapest one whose error on this volume stays within `max_error`, with the scheme,
    the storage and (unless the scene has one) the step that `filterlab recommend` finds: for a surface by the errors
    next to its level, for slices by those of values, else for dvr."""
    max_error: (
        Annotated[float, BeforeValidator(part), Field(gt=0), Told(unit="parts of the values' range, or %")] | None
    ) = None
    """The largest error; with `auto`, and only with that."""
    boundary: Annotated[str, AfterValidator(Names("boundary", lambda: Boundary))] = "mirror"
    """How the volume goes on beyond its ends."""
    nan: NanChoice = "refuse"
    """What becomes of voxels that are NaN or infinite."""

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
