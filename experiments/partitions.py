"""What do splines on tetrahedra look like? Cells, cut into tetrahedra, and the pieces of a level set in one of them.

Everything is taken from the splines' own tables: the shapes of the cone and their masks, under the signed permutations
of the axes. Samples are random, on a slope; the level is the spline's own value at the centre of the cell, so that its
surface passes there.

A patch is found by marching cubes of the cube that a tetrahedron is the image of, λ = (1 − u, u (1 − v), u v (1 − w),
u v w): it ends where the tetrahedron does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import AfterValidator, Field
from skimage.measure import marching_cubes

from experiments.config import ExperimentConfig
from experiments.runs import Record, Run, Unit
from filterlab import bernstein
from filterlab.bernstein import multi_indices
from filterlab.fields.tetrahedral import Shape, Spline, Turn, Vector
from filterlab.methods import METHODS, Tetrahedral
from filterlab.names import unknown_name

SPLINES = {name: method.spline for name, method in METHODS.items() if isinstance(method, Tetrahedral)}

_SAMPLES = 8  # along an axis: a cell in the middle, and all that it needs


def _known(name: str) -> str:
    if name not in SPLINES:
        raise ValueError(unknown_name("spline", name, SPLINES))
    return name


SplineName = Annotated[str, AfterValidator(_known)]


class Config(ExperimentConfig):
    """Cells of splines, and patches in them."""

    experiment: Literal["partitions"]
    splines: Annotated[list[SplineName], Field(min_length=1)]
    noise: Annotated[float, Field(ge=0)] = 1.0
    fineness: Annotated[int, Field(ge=2, le=64)] = 6


def units(config: Config) -> list[Unit]:
    """One per spline."""
    return [Unit(name, f"cell of {name}", 2.0) for name in config.splines]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one spline."""
    spline = SPLINES[unit.key]
    pieces = pieces_of(spline)
    samples = _samples(config)
    coefficients = np.array([piece.coefficients(samples, _middle(spline)) for piece in pieces])
    level = coefficients[0, 0]  # all α in v_0, the centre of the cell
    patches = [patch(piece, b, level, config.fineness) for piece, b in zip(pieces, coefficients, strict=True)]
    files = {
        name: run.save_array(f"{unit.key}-{name}", torch.from_numpy(array))
        for name, array in (
            ("vertices", np.array([piece.vertices for piece in pieces])),
            ("coefficients", coefficients),
            ("patches", np.concatenate(patches)),
        )
    }
    return {
        "spline": spline.name,
        "degree": spline.degree,
        "kinds": [piece.kind for piece in pieces],
        "shift": float(spline.shift),
        "level": float(level),
        "patch_triangles": [len(part) for part in patches],
        "volumes": [str(abs(_volume(shape))) for shape in spline.shapes],
        "samples_of_one": len(spline.samples),
        "samples_of_all": len({place for piece in pieces for place in piece.samples}),
        "domain_points": len({point for piece in pieces for point in piece.domain_points}),
        **files,
        "files": list(files.values()),
    }


def _samples(config: Config) -> np.ndarray:
    """[x, y, z]: random ones on a slope, so that a level set has one sheet or a few."""
    slope = np.indices((_SAMPLES,) * 3).sum(0) / np.sqrt(3)
    return slope + config.noise * np.random.default_rng(config.seed).standard_normal(slope.shape)


@dataclass(frozen=True)
class Piece:
    """A tetrahedron of the cell about the origin.

    Attributes:
        kind: the number of its shape.
        shape: that it is the image of.
        turn: maps the shape to it.
    """

    kind: int
    shape: Shape
    turn: Turn

    @property
    def vertices(self) -> np.ndarray:
        return np.array([self.turn(v) for v in self.shape.vertices], dtype=np.float64)

    @property
    def samples(self) -> Iterator[tuple[Fraction, ...]]:
        return (self.turn(place) for mask in self.shape.masks.values() for place in mask)

    @property
    def domain_points(self) -> Iterator[tuple[Fraction, ...]]:
        """Σ α_k v_k / n for every α."""
        for alpha in self.shape.masks:
            axes = zip(*self.shape.vertices, strict=True)
            point = tuple(sum((n * c for n, c in zip(alpha, row, strict=True)), Fraction()) for row in axes)
            x, y, z = (c / sum(alpha) for c in point)
            yield self.turn((x, y, z))

    def coefficients(self, samples: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Bernstein coefficients in the order of `multi_indices`, of samples [x, y, z] about a centre."""
        degree = sum(next(iter(self.shape.masks)))
        masks = (self.shape.masks[alpha] for alpha in multi_indices(degree, 3))
        return np.array([sum(float(w) * samples[self._index(place, centre)] for place, w in m.items()) for m in masks])

    def _index(self, place: Vector, centre: np.ndarray) -> tuple[int, ...]:
        return tuple(int(n) for n in centre + np.array(self.turn(place), dtype=np.float64))


@cache
def pieces_of(spline: Spline) -> list[Piece]:
    """All tetrahedra of a cell, each once."""
    return [Piece(kind, spline.shapes[kind], turn) for kind, turn in spline.tetrahedra]


def patch(piece: Piece, coefficients: np.ndarray, level: float, fineness: int) -> np.ndarray:
    """Triangles (T, 3, 3) of the level set in a tetrahedron, relative to the centre of the cell."""
    steps = torch.linspace(0, 1, fineness + 1, dtype=torch.float64)
    cube = torch.cartesian_prod(steps, steps, steps)
    values = bernstein.evaluate(torch.from_numpy(coefficients), _from_cube(cube)).numpy() - level
    if not values.min() < 0 < values.max():
        return np.empty((0, 3, 3))
    vertices, faces, _, _ = marching_cubes(values.reshape((fineness + 1,) * 3), 0.0)
    barycentric = _from_cube(torch.from_numpy(vertices.astype(np.float64)) / fineness)
    return (barycentric.numpy() @ piece.vertices)[faces]


def _from_cube(points: torch.Tensor) -> torch.Tensor:
    u, v, w = points.unbind(-1)
    return torch.stack([1 - u, u * (1 - v), u * v * (1 - w), u * v * w], -1)


def _middle(spline: Spline) -> np.ndarray:
    """The centre of the cell about the middle of the samples."""
    return spline.cells(torch.full((3,), (_SAMPLES - 1) / 2, dtype=torch.float64)).numpy() + float(spline.shift)


def _volume(shape: Shape) -> Fraction:
    origin, *others = shape.vertices
    a, b, c = ([p - q for p, q in zip(v, origin, strict=True)] for v in others)
    return sum((a[i] * (b[i - 2] * c[i - 1] - b[i - 1] * c[i - 2]) for i in range(3)), Fraction()) / 6
