"""Is the derivative of an image right where edges move? Estimates by `raycast(silhouettes=…)`, against differences.

What is differentiated is Q = ∫ w L over an image, w another number in each of its quarters. The reference knows
nothing of how edges are found or move: along rows drawn at random it finds jumps of the first hit by looking closely,
integrates between them by a rule that bears the square roots at edges, and takes central differences of the same rows.

Letters: θ what is changed, h its step; t = (mean of the estimates − reference) / the standard error of both, which is
Student's with ν degrees of freedom (Welch), and z the normal number that is as likely: Σ z² over all units is χ² where
nothing is wrong.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field
from scipy.special import chdtrc, ndtri, stdtr  # scipy.stats, which has the same, takes 0.7 s to import
from torch import Tensor

import filterlab as fl
from experiments import covers
from experiments.config import ExperimentConfig, Recipe
from experiments.runs import Record, Run, Unit
from filterlab.render import Light, PerspectiveCamera, Phong, Silhouettes, raycast
from filterlab.render.materials import Material, Seen
from filterlab.surfaces import LevelSet, Quadrics, Slim, Surface

Volume = Literal["ball", "bumps", "cut", "quadrics", "cover"]
Parameter = Literal["level", "sample", "camera"]
Quantity = Literal["mask", "depth", "shaded"]

_N = 10  # voxels along an axis
_CENTER = (_N - 1) / 2
_QUARTERS = ((1.0, 0.3), (0.6, 1.7))  # w, row by row
_LIGHTS = (Light((-1.0, -2.0, 1.5)),)
_LOOKED_AT = 256  # places along a row of the reference
_LEAP = 0.3  # voxels of depth between neighbours, from which on halving decides whether it is a jump
_HALVINGS = 22
_NODES = 24  # of the rule between jumps
_STEPS = {"level": 3e-3, "sample": 5e-3, "camera": 1e-2}


class Config(ExperimentConfig):
    """Which derivatives are judged.

    Attributes:
        methods, volumes, parameters, quantities: every combination is a unit; methods have no part in quadrics, covers.
        size: pixels along an edge of the estimates; subpixels: s² rays in each, for the part between edges.
        lines, parts: of `Silhouettes`.
        estimates: how many are made, each with a seed of its own.
        rows, repeats: of the reference, stratified; repeated to know its error.
    """

    experiment: Literal["silhouettes"]
    methods: Annotated[list[Recipe], Field(min_length=1)]
    volumes: Annotated[list[Volume], Field(min_length=1)]
    parameters: Annotated[list[Parameter], Field(min_length=1)]
    quantities: Annotated[list[Quantity], Field(min_length=1)]
    size: Annotated[int, Field(ge=2, le=512, multiple_of=2)] = 16
    subpixels: Annotated[int, Field(ge=1, le=8)] = 4
    lines: Annotated[int, Field(ge=1, le=64)] = 8
    parts: Annotated[int, Field(ge=1, le=64)] = 2
    estimates: Annotated[int, Field(ge=2)] = 10
    rows: Annotated[int, Field(ge=2, multiple_of=2)] = 32
    repeats: Annotated[int, Field(ge=2)] = 8

    def work(self) -> dict[str, tuple[Recipe, Volume, Parameter, Quantity]]:
        """Unit keys -> what is judged."""
        return {
            f"{m.key}/{v}/{p}/{q}": (m, v, p, q)
            for v in self.volumes
            for m in (self.methods[:1] if v in IN_PIECES else self.methods)
            for p in self.parameters
            for q in self.quantities
        }


def units(config: Config) -> list[Unit]:
    """One per method, volume, parameter and quantity."""
    return [Unit(key, ", ".join((m.key, *rest)), 1.0 * config.estimates) for key, (m, *rest) in config.work().items()]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one derivative."""
    recipe, volume, parameter, quantity = config.work()[unit.key]
    scene = Scene(recipe, volume, parameter, quantity)
    how = Silhouettes(config.lines, config.parts)
    first = zlib.crc32(f"{config.seed}/{unit.key}".encode())  # so that no two units share what is drawn
    seeds = [first + k for k in range(config.estimates)]
    found = [scene.estimated(config.size, config.subpixels, how, seed) for seed in seeds]
    run.advance(0.5)
    alone = scene.estimated(config.size, config.subpixels, None, first)
    reference = scene.differences(config.rows, config.repeats, first)
    (mean, error), (truth, doubt) = map(mean_and_error, (found, reference))
    t = (mean - truth) / max(math.hypot(error, doubt), 1e-300)
    degrees = welch((error, len(found)), (doubt, len(reference)))
    return {
        **recipe.record(),
        "volume": volume,
        "parameter": parameter,
        "quantity": quantity,
        "mean": mean,
        "error": error,
        "reference": truth,
        "reference_error": doubt,
        "without": alone,
        "t": t,
        "degrees": degrees,
        "z": normal(t, degrees),
    }


def mean_and_error(numbers: list[float]) -> tuple[float, float]:
    """The mean, and its standard error."""
    listed = torch.tensor(numbers, dtype=torch.float64)
    return float(listed.mean()), float(listed.std() / math.sqrt(len(numbers)))


def welch(*errors: tuple[float, int]) -> float:
    """ν = (Σ e²)² / Σ e⁴ / (n − 1), of standard errors e of n numbers.

    Source: Welch, The generalization of Student's problem, 1947.
    """
    total = sum(e**2 for e, _ in errors)
    return max(total**2 / max(sum(e**4 / (n - 1) for e, n in errors), 1e-300), 1.0)


def normal(t: float, degrees: float) -> float:
    """The normal number as likely as Student's t."""
    return math.copysign(-float(ndtri(stdtr(degrees, -abs(t)))), t)


def chance(records: Iterable[Record]) -> tuple[float, float]:
    """Σ z² of units, and how likely so much or more is by chance alone: units share nothing that is drawn."""
    z = [r["z"] for r in records]
    total = math.fsum(x * x for x in z)
    return total, float(chdtrc(len(z), total))


# --- what is looked at ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Depth(Material):
    """The distance along y as a colour: depths that have means, over a background of 0."""

    opacity: float = 1.0

    @property
    def order(self) -> int:
        return 1

    def __call__(self, seen: Seen, lights: Sequence[Light]) -> Tensor:
        return seen.point[:, 1:2].expand(-1, 3) + 20


@dataclass(frozen=True)
class Scene:
    """An image of a volume that one number θ changes, at θ = 0.

    A `ball` is −|x|² / 10; `bumps` adds noise, so that parts hide parts; `cut` is that in a region that cuts it open.
    `quadrics` are ellipsoids, one of which a plane cuts; a `cover` is one of a torus, without the balls of one side.
    """

    recipe: Recipe
    volume: Volume
    parameter: Parameter
    quantity: Quantity

    def surface(self, theta: Tensor) -> Surface:
        if self.volume in IN_PIECES:
            return IN_PIECES[self.volume](theta, self.parameter)
        axis = torch.arange(_N, dtype=torch.float64) - _CENTER
        samples = -(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2) / 10
        if self.volume != "ball":
            generator = torch.Generator().manual_seed(1)
            samples = samples + 1.2 * (torch.rand(_N, _N, _N, generator=generator, dtype=torch.float64) - 0.5)
        if self.parameter == "sample":
            at = torch.zeros_like(samples)
            at[5, 4, 2] = 1  # at an outline of all of them
            samples = samples + theta * at
        level = -0.9 + theta if self.parameter == "level" else torch.tensor(-0.9, dtype=torch.float64)
        return LevelSet(self.recipe.build(fl.Volume(samples), "mirror"), level)

    def camera(self, theta: Tensor) -> PerspectiveCamera:
        moved = theta if self.parameter == "camera" else torch.zeros_like(theta)
        position = torch.tensor([4.0, -16.0, 6.0], dtype=torch.float64)
        toward = torch.tensor([0.5, 0.8, -0.4], dtype=torch.float64)
        return PerspectiveCamera(position=position + moved * toward, target=(_CENTER,) * 3, field_of_view=28.0)

    def options(self) -> dict[str, Any]:
        """Of `raycast`, for every image of it."""
        material = {"mask": Phong(), "depth": Depth(), "shaded": Phong((0.9, 0.6, 0.3))}[self.quantity]
        region = ((-1.0, 2.8, -1.0), (6.3, 11.0, 11.0)) if self.volume == "cut" else None
        return {"material": material, "region": region, "lights": _LIGHTS, "dtype": torch.float64}

    @property
    def _channel(self) -> int:
        return 3 if self.quantity == "mask" else 0

    def estimated(self, size: int, subpixels: int, how: Silhouettes | None, seed: int) -> float:
        """dQ/dθ, by derivatives."""
        theta = torch.zeros((), dtype=torch.float64, requires_grad=True)
        given = {"size": (size, size), "subpixels": subpixels, "silhouettes": how, "seed": seed, **self.options()}
        image = raycast(self.surface(theta), self.camera(theta), **given)
        assert isinstance(image, Tensor)
        image = image[..., self._channel]
        weights = torch.tensor(_QUARTERS, dtype=torch.float64).repeat_interleave(size // 2, 0)
        total = (weights.repeat_interleave(size // 2, 1) * image).mean()
        if not total.requires_grad:
            return 0.0
        (slope,) = torch.autograd.grad(total, theta, allow_unused=True)
        return 0.0 if slope is None else float(slope)

    @torch.no_grad()
    def differences(self, rows: int, repeats: int, seed: int) -> list[float]:
        """dQ/dθ, by central differences of the same rows; several times, with other rows."""
        step = _STEPS[self.parameter]
        above, below = (
            self.integrals(torch.tensor(s * step, dtype=torch.float64), rows, repeats, seed) for s in (1, -1)
        )
        return ((above - below) / (2 * step)).tolist()

    def integrals(self, theta: Tensor, rows: int, repeats: int, seed: int) -> Tensor:
        """Q, along rows, (repeats,)."""
        draw = torch.rand(repeats, rows, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        v = ((torch.arange(rows, dtype=torch.float64) + draw) / rows).flatten()
        surface, camera = self.surface(theta), self.camera(theta)

        def cast(row: Tensor, u: Tensor, channel: str) -> Tensor:
            rays = camera.pixel_rays(torch.zeros_like(row), 1, 1, (u, v[row]))
            image = raycast(surface, rays, channels=(channel,), **self.options())
            assert isinstance(image, dict)
            return image[channel]

        row, low, high = intervals(lambda row, u: cast(row, u, "depth")[..., 0], len(v))
        across, weights = between(low, high)
        light = cast(row.repeat_interleave(_NODES), across.flatten(), "color")[..., self._channel].view_as(across)
        w = torch.tensor(_QUARTERS, dtype=torch.float64)[(v[row] >= 0.5).long(), (low >= 0.5).long()]
        return v.new_zeros(len(v)).index_add(0, row, w * (weights * light).sum(1)).view(repeats, rows).mean(1)


def _ellipsoids(theta: Tensor, parameter: Parameter) -> Quadrics:
    """Three, that hide parts of each other; of one a half. What changes is F of all, or the place of one."""
    rows = lambda *x: torch.tensor(x, dtype=torch.float64)  # noqa: E731
    moved = torch.stack((theta, torch.zeros_like(theta), theta)) if parameter == "sample" else torch.zeros(3).double()
    centers = _CENTER + rows([0.0, 0, 0], [-1.6, -2, 0.5], [1.4, 1.5, -1.2]) + rows([0.0], [1.0], [0.0]) * moved
    whole = Quadrics.ellipsoids(centers, rows([2.0, 1.2, 2.2], [1.2, 1.0, 0.8], [1.3, 1.5, 1.7]))
    cuts = rows([0.6, 0.3, 0.74, -0.5], [0, 0, 1, -9], [0, 0, 1, -9])
    cuts[:, 3] -= (cuts[:, :3] * centers.detach()).sum(-1)
    offset = theta if parameter == "level" else torch.zeros_like(theta)
    return Quadrics(whole.A, whole.b, whole.c - offset, whole.bounds, whole.origins, cuts=cuts)


def _cover(theta: Tensor, parameter: Parameter) -> Slim:
    """A torus without the balls of one side. What changes is F of all, or the places and sizes of balls at that end."""
    centers, radii, A, b, c = covers.torus(300)
    kept = centers[:, 0] < 0.5
    centers, radii, A, b, c = (x[kept] for x in (centers, radii, A, b, c))
    turn = torch.linalg.qr(torch.tensor([[0.5, 1.0, 0.2], [1.0, -0.4, 0.5], [0.3, 0.5, -1.0]], dtype=torch.float64))[0]
    own = theta * (centers[:, 0] > 0.3) if parameter == "sample" else torch.zeros_like(radii)
    centers = _CENTER + 2.2 * (turn * centers[:, None]).sum(-1) + own[:, None] * turn[:, 0]
    A, b = torch.einsum("ij,mjk,lk->mil", turn, A, turn), (turn * b[:, None]).sum(-1)
    offset = theta if parameter == "level" else torch.zeros_like(theta)
    return Slim(centers, 2.2 * radii + own, A / 2.2, b, c - offset)


IN_PIECES: dict[str, Callable[[Tensor, Parameter], Surface]] = {"quadrics": _ellipsoids, "cover": _cover}


# --- the reference ----------------------------------------------------------------------------------------------------


def intervals(depth: Callable[[Tensor, Tensor], Tensor], rows: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rows and ends (K,) of what lies between jumps of the first hit, cut at the middle of the image as well."""
    u = torch.linspace(0, 1, _LOOKED_AT + 1, dtype=torch.float64)
    row = torch.arange(rows).repeat_interleave(len(u))
    t = depth(row, u.repeat(rows)).view(rows, -1)
    at, left = (_apart(t[:, :-1], t[:, 1:]) > _LEAP).nonzero().unbind(-1)
    jumps, real = _halved(depth, at, u[left], u[left + 1])
    at, jumps = at[real], jumps[real]
    listed = []
    for k in range(rows):
        ends = torch.cat((jumps[at == k], torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64))).sort().values
        listed.append((torch.full((len(ends) - 1,), k), ends[:-1], ends[1:]))
    row, low, high = (torch.cat(column) for column in zip(*listed, strict=True))
    return row, low, high


def _apart(a: Tensor, b: Tensor) -> Tensor:
    """|a − b|, where nothing is ∞ away from anything but nothing."""
    return torch.where(a == b, 0, (a - b).abs())


def _halved(depth: Callable[[Tensor, Tensor], Tensor], row: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Where between low and high depths leap most, and whether they do so at one place."""
    a, b = depth(row, low), depth(row, high)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        t = depth(row, middle)
        first = _apart(a, t) > _apart(t, b)
        low, a = torch.where(first, low, middle), torch.where(first, a, t)
        high, b = torch.where(first, middle, high), torch.where(first, t, b)
    return (low + high) / 2, _apart(a, b) > 1e-3


def between(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Nodes and weights (K, `_NODES`): Gauss-Legendre in φ, u = low + (high − low) (1 − cos φ) / 2, φ in 0 … π.

    Square roots of u at either end are smooth in φ.
    """
    node, weight = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(_NODES))
    angle = (node + 1) * (math.pi / 2)
    length = (high - low)[:, None]
    return low[:, None] + length * (1 - angle.cos()) / 2, length * weight * (math.pi / 2) * angle.sin() / 2
