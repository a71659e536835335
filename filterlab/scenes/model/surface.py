"""Surfaces of scenes: level sets, and those that are in files or in the scene itself."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import torch
from pydantic import BeforeValidator, Discriminator, Field, Tag, ValidationInfo, field_validator, model_validator

from filterlab.io.covers import is_slim, load_slim
from filterlab.io.molecules import check_molecule_file, load_molecule
from filterlab.io.quadric_files import is_quadrics, load_quadrics
from filterlab.scenes.model.materials import MaterialModel, PhongModel, of_kind
from filterlab.scenes.model.quantities import LISTED, Positive, Section, Told, Vector
from filterlab.scenes.model.sources import found
from filterlab.surfaces import Quadrics, molecular_skin
from filterlab.surfaces.base import Surface

_FLAT = 1e-12  # of the product of three axes, their volume that is none


class Cast(Section):
    """How rays are cast at a surface."""

    sheets: Annotated[int, Field(ge=1, le=64)] = 1
    """How many hits of a ray are shown through each other, where the material is transparent."""
    shadows: bool = False
    """Whether lights with a direction cast any."""
    subpixels: Annotated[int, Field(ge=1, le=8)] = 1
    """s: a pixel is the mean of s² rays."""


class OnSurface(Cast):
    """What every surface has."""

    material: Annotated[MaterialModel, BeforeValidator(of_kind)] = PhongModel()
    """What it is made of; a bare name stands for its kind."""


class LevelSetModel(OnSurface):
    """The level set of a scene's field, hit exactly; a bare number stands for a level."""

    examples = (
        "90",
        "{level: 0.35, axis: normalized, material: toon, sheets: 1, shadows: true, subpixels: 2}",
    )
    bare: ClassVar[str] = "level"

    level: Annotated[float, Told(unit="of the volume's values, or parts of their range: `axis`")]
    """The value on the surface."""
    axis: Literal["raw", "normalized"] = "raw"
    """`raw`: a value of the volume; `normalized`: 0 … 1 stand for its smallest and largest sample."""

    @model_validator(mode="before")
    @classmethod
    def _from_level(cls, value: Any) -> Any:
        return {cls.bare: value} if isinstance(value, int | float) and not isinstance(value, bool) else value

    def at(self, value_range: Callable[[], tuple[float, float]]) -> float:
        """The level as a value of the field. `value_range` is asked where the axis is normalized."""
        if self.axis == "raw":
            return self.level
        low, high = value_range()
        return low + self.level * (high - low)


class SurfaceOfItsOwn(OnSurface, ABC):
    """A surface that is that of no field: neither a volume nor a method belongs to it.

    Attributes:
        called: what messages call it.
    """

    called: ClassVar[str]

    @property
    def source(self) -> str | None:
        """The file that it is in."""
        return None

    @abstractmethod
    def build(self) -> Surface:
        """The surface. Raises ValueError for a file that can't be read."""


class SlimModel(SurfaceOfItsOwn):
    """Scanned points as blended quadrics: a SLIM surface, which needs neither volume nor method."""

    examples = ("{slim: bunny.npz, material: reflection_lines, sheets: 1, shadows: true, subpixels: 2}",)
    called = "a SLIM surface"

    slim: Annotated[str, Field(min_length=1), Told("a path")]
    """A file that `filterlab slim` wrote, looked for like a volume."""

    @field_validator("slim")
    @classmethod
    def _found(cls, slim: str, info: ValidationInfo) -> str:
        return _file_of("that `filterlab slim` wrote", is_slim, slim, info)

    @property
    def source(self) -> str | None:
        return self.slim

    def build(self) -> Surface:
        return load_slim(self.slim)


class QuadricsModel(SurfaceOfItsOwn):
    """Quadrics, each within its own ball, tetrahedron or planes; they need neither volume nor method."""

    examples = ("{quadrics: glyphs.npz, material: toon, sheets: 1, shadows: true, subpixels: 2}",)
    called = "a surface of quadrics"

    quadrics: Annotated[str, Field(min_length=1), Told("a path")]
    """A file that `filterlab.io.save_quadrics` wrote, looked for like a volume."""

    @field_validator("quadrics")
    @classmethod
    def _found(cls, quadrics: str, info: ValidationInfo) -> str:
        return _file_of("that filterlab.io.save_quadrics wrote", is_quadrics, quadrics, info)

    @property
    def source(self) -> str | None:
        return self.quadrics

    def build(self) -> Surface:
        return load_quadrics(self.quadrics)


class Ellipsoid(Section):
    """An ellipsoid: half axes along x, y, z, or three of them as they lie."""

    examples = (
        "{center: [0, 0, 0], radii: [1, 0.5, 0.5]}",
        "{center: [2, 0, 0], axes: [[1, 1, 0], [-0.3, 0.3, 0], [0, 0, 0.4]]}",
    )

    center: Annotated[Vector, Told(unit="world")]
    """Its middle."""
    radii: Annotated[tuple[Positive, Positive, Positive], LISTED, Told("3 numbers > 0", "world length")] | None = None
    """Half lengths along x, y and z; or `axes`."""
    axes: Annotated[tuple[Vector, Vector, Vector], LISTED, Told("3 lists of 3 numbers", "world length")] | None = None
    """Half axes, or whatever three edges a parallelepiped around it has from its middle: the columns of a √D of a
    diffusion tensor D."""

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.radii is None) == (self.axes is None):
            raise ValueError("expected either radii or axes" + ("; got both" if self.radii else "; got neither"))
        sides = torch.tensor(self.matrix, dtype=torch.float64)
        if not torch.linalg.det(sides).abs() > _FLAT * sides.norm(dim=0).prod():
            raise ValueError(f"axes: expected three that span space; got {self.axes}")
        return self

    @property
    def matrix(self) -> list[list[float]]:
        """Half axes in its columns."""
        if self.axes is not None:
            return [list(row) for row in zip(*self.axes, strict=True)]
        assert self.radii is not None
        return [[r if i == j else 0.0 for j in range(3)] for i, r in enumerate(self.radii)]


class EllipsoidsModel(SurfaceOfItsOwn):
    """Ellipsoids: glyphs of tensors, balls and whatever else is round; they need neither volume nor method."""

    examples = (
        "{ellipsoids: [{center: [0, 0, 0], radii: [1, 0.5, 0.5]}], material: phong, sheets: 1, shadows: true,"
        " subpixels: 2}",
    )
    called = "a surface of ellipsoids"

    ellipsoids: Annotated[tuple[Ellipsoid, ...], LISTED, Field(min_length=1)]
    """All of them."""

    @model_validator(mode="after")
    def _valid(self) -> Self:
        self.build()
        return self

    def build(self) -> Surface:
        centers = torch.tensor([e.center for e in self.ellipsoids], dtype=torch.float64)
        return Quadrics.ellipsoids(centers, torch.tensor([e.matrix for e in self.ellipsoids], dtype=torch.float64))


class MoleculeModel(SurfaceOfItsOwn):
    """The skin of a molecule: its atoms as balls, which go over smoothly into each other (Edelsbrunner).

    It needs neither volume nor method. Radii are those of van der Waals (Bondi, J. Phys. Chem. 68, 1964; Mantina et
    al., J. Phys. Chem. A 113, 2009).
    """

    examples = (
        "{molecule: caffeine.xyz, shrink: 0.6, scale: 0.8, material: phong, sheets: 1, shadows: true, subpixels: 2}",
    )
    called = "the skin of a molecule"

    molecule: Annotated[str, Field(min_length=1), Told("a path")]
    """A file of atoms, looked for like a volume: `.xyz` (how many, a line of text, then element x y z) or `.pdb`."""
    shrink: Annotated[float, Field(gt=0, lt=1)] = 0.5
    """Near 1 the skin is the union of the balls, near 0 it fills in between them."""
    scale: Positive = 1.0
    """Of all radii."""

    @field_validator("molecule")
    @classmethod
    def _found(cls, molecule: str, info: ValidationInfo) -> str:
        path = found(molecule, info, "a file of atoms")
        check_molecule_file(path)
        return str(path)

    @property
    def source(self) -> str | None:
        return self.molecule

    def build(self) -> Surface:
        atoms = load_molecule(self.molecule)
        return molecular_skin(atoms.centers, self.scale * atoms.radii, self.shrink)


def _file_of(what: str, holds: Callable[[Path], bool], name: str, info: ValidationInfo) -> str:
    """Looked for when the scene is read, as a volume is. Raises ValueError unless it holds what it is to hold."""
    path = found(name, info, "a file")
    if not holds(path):
        raise ValueError(f"expected a file {what} (.npz); got {path}")
    return str(path)


SURFACES: dict[str, type[OnSurface]] = {
    "level": LevelSetModel,
    "slim": SlimModel,
    "quadrics": QuadricsModel,
    "ellipsoids": EllipsoidsModel,
    "molecule": MoleculeModel,
}
"""All kinds of surfaces, by the key that tells a section of one."""


def _one_kind(value: Any) -> Any:
    """Raises ValueError for a section of several kinds, or of none."""
    if isinstance(value, Mapping):
        kinds = [key for key in SURFACES if key in value]
        if len(kinds) != 1:
            raise ValueError(f"expected one of {', '.join(SURFACES)}; got {' and '.join(kinds) or 'none of them'}")
    return value


def _kind_of(value: Any) -> str:
    """The name of the model that a section is checked by."""
    if isinstance(value, OnSurface):
        return type(value).__name__
    return next(
        (m.__name__ for key, m in SURFACES.items() if isinstance(value, Mapping) and key in value), "LevelSetModel"
    )


SurfaceModel = Annotated[
    Annotated[LevelSetModel, Tag("LevelSetModel")]
    | Annotated[SlimModel, Tag("SlimModel")]
    | Annotated[QuadricsModel, Tag("QuadricsModel")]
    | Annotated[EllipsoidsModel, Tag("EllipsoidsModel")]
    | Annotated[MoleculeModel, Tag("MoleculeModel")],
    Discriminator(_kind_of),
    BeforeValidator(_one_kind),
]
