"""Filters that are learned: a kernel with a short prefilter, and the descent to their parameters.

    samples ─▶ prefilter h_1 … h_m ─▶ kernel, or the family of B and C ─▶ field ─▶ errors at the points of all members

What is minimised is

    ( E_v / E_v⁰ + w E_g / E_g⁰ ) / (1 + w)

with E_v and E_g the mean squared errors of value and gradient, E⁰ those of a named method on the same members and w the
weight of the gradient: 1 is as good as that method.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Protocol

import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor

import filterlab as fl
from experiments import fir
from experiments.config import Recipe
from experiments.descent import Parameters
from experiments.members import Members
from experiments.runs import Record
from filterlab import kernels, prefilters
from filterlab.io.config import StrictModel
from filterlab.kernels import PiecewisePolynomial
from filterlab.methods import from_kernel
from filterlab.names import unknown_name

FAMILY = "bc"  # the kernels with parameters B and C
KERNELS = (FAMILY, *fl.KERNELS)

_FLATTEST = 1e-6  # of the steepest curvature: no direction is taken for flatter


def _known_kernel(name: str) -> str:
    if name not in KERNELS:
        raise ValueError(unknown_name("kernel", name, KERNELS))
    return name


def _odd(taps: int) -> int:
    if taps % 2 == 0:
        raise ValueError(f"a symmetric prefilter has an odd number of taps; got {taps}")
    return taps


class Candidate(StrictModel):
    """What is learned. A bare name stands for the kernel without a prefilter.

    Attributes:
        kernel: a kernel of the library, or `bc`: B and C are learned.
        prefilter: taps along an axis, 1 for none; learned, but for their sum, which is 1.
    """

    kernel: Annotated[str, AfterValidator(_known_kernel)]
    prefilter: Annotated[int, Field(ge=1, le=31), AfterValidator(_odd)] = 1

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        return {"kernel": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _learns(self) -> Candidate:
        if self.kernel != FAMILY and self.prefilter == 1:
            raise ValueError(f"{self.kernel} without a prefilter has nothing to learn; give it prefilter: 3 or more")
        return self

    @property
    def key(self) -> str:
        """A short unique name, e.g. `bspline2+fir5`."""
        return self.kernel if self.prefilter == 1 else f"{self.kernel}+fir{self.prefilter}"

    @property
    def taps(self) -> int:
        """Coefficients that one value needs."""
        kernel = kernels.MITCHELL if self.kernel == FAMILY else fl.KERNELS[self.kernel]
        return from_kernel(kernel, prefilters.IDENTITY).facts.taps

    def start(self, family: tuple[float, float], device: str = "cpu") -> Parameters:
        """The parameters that a descent begins with: B and C as given, and the prefilter that changes nothing."""
        parameters = {}
        if self.kernel == FAMILY:
            parameters["bc"] = torch.tensor(family, dtype=torch.float64, device=device)
        if self.prefilter > 1:
            parameters["taps"] = torch.zeros((self.prefilter - 1) // 2, dtype=torch.float64, device=device)
        return parameters

    def built(self, parameters: Parameters) -> PiecewisePolynomial:
        """The kernel, differentiable in B and C."""
        if self.kernel != FAMILY:
            return fl.KERNELS[self.kernel]
        B, C = parameters["bc"].unbind()
        return kernels.bc(B, C)

    def prefiltered(self, parameters: Parameters, samples: Tensor, boundary: str) -> Tensor:
        """The coefficients, differentiable in the taps of the prefilter."""
        return fir.convolve(samples, parameters["taps"], boundary) if "taps" in parameters else samples

    def reconstruct(self, parameters: Parameters, volume: fl.Volume, boundary: str) -> fl.Field:
        """The field, differentiable in the parameters."""
        coefficients = self.prefiltered(parameters, volume.samples, boundary)
        filtered = fl.Volume.with_geometry(coefficients, volume.geometry)
        return fl.reconstruct(filtered, self.built(parameters), boundary=boundary, prefilter=False)

    def record(self) -> Record:
        """What a record says about the candidate."""
        return {
            "candidate": self.key,
            "kernel": self.kernel,
            "prefilter": self.prefilter,
            "taps": self.taps,
            "multiplications": fir.multiplications(self.prefilter),
        }


class Learned(Protocol):
    """What a descent can find parameters of; a `Candidate` is one."""

    def reconstruct(self, parameters: Parameters, volume: fl.Volume, boundary: str) -> fl.Field:
        """The field, differentiable in the parameters."""
        ...


def distinct(candidates: list[Candidate]) -> list[Candidate]:
    """The candidates. Raises ValueError unless they are all different."""
    keys = [c.key for c in candidates]
    if repeated := {k for k in keys if keys.count(k) > 1}:
        raise ValueError(f"expected different candidates; listed twice: {', '.join(sorted(repeated))}")
    return candidates


@dataclass(frozen=True)
class Objective:
    """The errors of a filter on members, relative to those of a named method.

    Attributes:
        members: what it is evaluated on.
        boundary: of every field.
        weight: w, of the gradient.
        reference: mean squared errors of value and gradient of the named method.
    """

    members: Members
    boundary: str
    weight: float
    reference: tuple[float, float]

    @classmethod
    def of(cls, members: Members, boundary: str, weight: float, recipe: Recipe) -> Objective:
        """Raises ValueError where the named method makes no error that others could be compared with."""
        with torch.no_grad():
            value, gradient = members.mean_squares(recipe.build(members.volume, boundary))
        if not (value > 0 and gradient > 0):
            raise ValueError(f"expected members that {recipe.key} is not exact for; got errors {value}, {gradient}")
        return cls(members, boundary, weight, (float(value), float(gradient)))

    def __call__(self, candidate: Learned, parameters: Parameters) -> Tensor:
        """What is minimised, 0-d, differentiable in the parameters."""
        value, gradient = self.members.mean_squares(
            candidate.reconstruct(parameters, self.members.volume, self.boundary)
        )
        relative = value / self.reference[0] + self.weight * gradient / self.reference[1]
        return relative / (1 + self.weight)


@dataclass(frozen=True)
class Fit:
    """The descent to the parameters of what is learned (`experiments.descent.Problem`); one stage.

    The parameters p can nearly stand for each other where the members hold no high frequencies: a descent in them would
    creep. It goes along z instead, p = p₀ + W z, with W the inverse root of the Hessian at p₀, scaled so that a z of
    length one would take a parabola of the objective's height to zero: in z the objective is round.

    Attributes:
        candidate: what is learned.
        training: what is minimised.
        validation: what is looked at now and then, to stop where it is least.
        first: p₀.
        whitening: W.
    """

    candidate: Learned
    training: Objective
    validation: Objective
    first: Parameters
    whitening: Tensor

    @classmethod
    def of(cls, candidate: Learned, training: Objective, validation: Objective, first: Parameters) -> Fit:
        flat = torch.cat(list(first.values()))
        height = lambda p: training(candidate, _parts(p, first))  # noqa: E731
        eigenvalues, basis = torch.linalg.eigh(torch.func.hessian(height)(flat))
        curvature = eigenvalues.abs().clamp_min(_FLATTEST * eigenvalues.abs().max())
        return cls(candidate, training, validation, first, basis * (2 * height(flat) / curvature).sqrt())

    def parameters(self, z: Tensor) -> Parameters:
        """p at z; differentiable."""
        return _parts(torch.cat(list(self.first.values())) + self.whitening @ z, self.first)

    def start(self) -> Parameters:
        return {"z": torch.zeros_like(self.whitening[0])}

    def refine(self, parameters: Parameters, stage: int) -> Parameters:
        return parameters

    def loss(self, parameters: Parameters, stage: int, iteration: int) -> tuple[Tensor, Tensor]:
        objective = self.training(self.candidate, self.parameters(parameters["z"]))
        return objective, torch.zeros_like(objective)

    def project(self, parameters: Parameters) -> None:
        pass

    @torch.no_grad()
    def observe(self, parameters: Parameters, stage: int) -> Record:
        current = self.parameters(parameters["z"].detach())
        return {
            "validation": float(self.validation(self.candidate, current)),
            "parameters": {name: p.tolist() for name, p in current.items()},
        }


def _parts(flat: Tensor, like: Parameters) -> Parameters:
    """A vector cut into parameters of the shapes of others."""
    return dict(zip(like, flat.split([len(p) for p in like.values()]), strict=True))


def parameters_of(record: Record, device: str = "cpu") -> Parameters:
    """Parameters as a record has them, as tensors."""
    return {name: torch.tensor(v, dtype=torch.float64, device=device) for name, v in record.items()}
