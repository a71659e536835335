"""Classes of signals, and members drawn from them: what a filter is fitted to, chosen by and judged on.

A member is a volume of samples and a truth that it was sampled from, known at random points. The members of the three
roles are drawn apart: other seeds for signals, other parts of the volume for a scan.

Letters: n voxels along an axis, N members, P points of each; β a bandwidth as a share of the Nyquist frequency.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, Protocol

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

import filterlab as fl
from experiments import fir
from experiments.config import VolumeChoice
from experiments.rms_error import evaluate, uniform_points
from filterlab import kernels, metrics, signals
from filterlab.io.config import StrictModel
from filterlab.signals import Signal
from filterlab.volume import Boundary

Role = Literal["training", "validation", "test"]
ROLES: tuple[Role, ...] = ("training", "validation", "test")

_PARTS = {"training": (0.0, 0.5), "validation": (0.5, 0.65), "test": (0.65, 1.0)}  # of a scan, along its longest axis
_MARGIN = 6  # coarse voxels around the points of a scan, as far as seven taps and a kernel see
_CONTENT, _DRAWS = 0.1, 100  # a piece varies by this share of what the scan does, or so many draws found no such one
_LARGEST = 256  # voxels along an axis of a scan that are used, from its middle: bounds the memory
_SHARPEST, _REACH = 0.42 * math.pi, 12  # of the low-pass before a scan is decimated: nothing is left beyond π/2


@dataclass(frozen=True)
class Sampling:
    """How members are sampled.

    Attributes:
        resolution: voxels along each axis (a scan may have fewer).
        inner: points are drawn from the box of a signal shrunk to this fraction, away from its ends.
        device: where everything lies; all is float64.
    """

    resolution: int
    inner: float
    device: str = "cpu"


@dataclass(frozen=True)
class Members:
    """N volumes with their truth at points.

    Attributes:
        volume: samples `(N, 1, D, H, W)`.
        points: `(N, P, 3)`, world.
        values, gradients: of the truth there, `(N, P)` and `(N, P, 3)`, per world unit.
    """

    volume: fl.Volume
    points: Tensor
    values: Tensor
    gradients: Tensor

    @classmethod
    def of_signals(cls, members: Sequence[Signal], sampling: Sampling, count: int, seed: int) -> Members:
        """Signals in one box, sampled at cell centres, at `count` points each."""
        inner, device = sampling.inner, sampling.device
        volumes = [s.sample(sampling.resolution, device=device) for s in members]
        points = [
            uniform_points(s, count, inner, seed_of(seed, i), torch.float64, device) for i, s in enumerate(members)
        ]
        truths = [evaluate(s, p) for s, p in zip(members, points, strict=True)]
        return cls(
            fl.Volume.with_geometry(torch.stack([v.samples for v in volumes])[:, None], volumes[0].geometry),
            torch.stack(points),
            torch.stack([value for value, _ in truths]),
            torch.stack([gradient for _, gradient in truths]),
        )

    @property
    def scales(self) -> tuple[float, float]:
        """What errors are compared with: the standard deviation of the values and the RMS of the gradients."""
        return float(self.values.std()), float(self.gradients.square().sum(-1).mean().sqrt())

    def mean_squares(self, field: fl.Field) -> tuple[Tensor, Tensor]:
        """Mean squared errors of value and gradient over all members, 0-d; differentiable in what made the field."""
        value, gradient = field.value_and_gradient(self.points)
        squared = (gradient[:, 0] - self.gradients).square().sum(-1)
        return (value[:, 0] - self.values).square().mean(), squared.mean()

    @torch.no_grad()
    def errors(self, field: fl.Field) -> dict[str, list[float]]:
        """RMS errors of value and gradient of each member."""
        value, gradient = field.value_and_gradient(self.points)
        return {
            "value": [float(metrics.rms(a, b)) for a, b in zip(value[:, 0], self.values, strict=True)],
            "gradient": [
                float(metrics.rms(a, b, vectors=True)) for a, b in zip(gradient[:, 0], self.gradients, strict=True)
            ],
        }


class Source(Protocol):
    """A class that members can be drawn from."""

    def members(self, role: Role, count: int, points: int, seed: int) -> Members:
        """So many members of a role, known at so many points; others for another seed or role."""
        ...


def seed_of(*numbers: int) -> int:
    """One seed made of several numbers, as good as unique."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> np.uint64(1))


# --- signals ----------------------------------------------------------------------------------------------------------


class SignalClass(StrictModel, ABC):
    """What classes of closed-form signals have in common.

    Attributes:
        title: what the report calls it.
    """

    title: Annotated[str, Field(min_length=1)]

    @abstractmethod
    def draw(self, generator: torch.Generator, resolution: int) -> Signal:
        """One member, on [−1, 1]³."""

    def open(self, sampling: Sampling) -> Source:
        """What members are drawn from."""
        return _Signals(self, sampling)


class MarschnerLobbClass(SignalClass):
    """Marschner-Lobb signals with random frequency f_M, turned at random about a random centre.

    Attributes:
        frequency: f_M is uniform between these. At n voxels along an axis the signal reaches f_M π / 2 · 2 / n cycles
            per voxel: the Nyquist frequency at f_M = n / (2π).
    """

    kind: Literal["marschner-lobb"]
    frequency: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]

    @model_validator(mode="after")
    def _ordered(self) -> MarschnerLobbClass:
        if self.frequency[1] < self.frequency[0]:
            raise ValueError(f"expected the lower frequency first; got {self.frequency}")
        return self

    def draw(self, generator: torch.Generator, resolution: int) -> Signal:
        low, high = self.frequency
        frequency = low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))
        shift = 0.5 * torch.rand(3, generator=generator, dtype=torch.float64) - 0.25
        turn = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
        return _moved(signals.marschner_lobb(frequency), turn, shift)


class WavesClass(SignalClass):
    """Band-limited random fields: plane waves with random phases, wave vectors uniform in a ball.

    Attributes:
        bandwidth: β: the radius of the ball is β times the Nyquist frequency.
        waves: how many are summed; the variance of the sum is 1.
    """

    kind: Literal["waves"]
    bandwidth: Annotated[float, Field(gt=0, le=1)]
    waves: Annotated[int, Field(ge=1, le=4096)] = 64

    def draw(self, generator: torch.Generator, resolution: int) -> Signal:
        direction = torch.randn(self.waves, 3, generator=generator, dtype=torch.float64)
        radius = torch.rand(self.waves, 1, generator=generator, dtype=torch.float64) ** (1 / 3)
        phase = 2 * math.pi * torch.rand(self.waves, generator=generator, dtype=torch.float64)
        nyquist = math.pi * resolution / 2  # radians per world unit: a voxel is 2 / n long
        k = self.bandwidth * nyquist * radius * direction / direction.norm(dim=-1, keepdim=True)
        return _sum_of_waves(k, phase)


def _moved(signal: Signal, turn: Tensor, shift: Tensor) -> Signal:
    """The signal at turn · p + shift, in the same box."""

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        matrix = turn.to(p)
        value, gradient = signal.value_and_gradient(p @ matrix.T + shift.to(p))
        return value, gradient @ matrix

    return Signal(signal.name, function)


def _sum_of_waves(k: Tensor, phase: Tensor) -> Signal:
    """√(2 / K) Σ cos(k · p + phase) of K wave vectors `(K, 3)` in radians per world unit."""
    amplitude = math.sqrt(2 / len(k))

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        vectors = k.to(p)
        angle = p @ vectors.T + phase.to(p)
        return amplitude * torch.cos(angle).sum(-1), -amplitude * torch.sin(angle) @ vectors

    return Signal("waves", function)


@dataclass(frozen=True)
class _Signals:
    signal_class: SignalClass
    sampling: Sampling

    def members(self, role: Role, count: int, points: int, seed: int) -> Members:
        own = seed_of(seed, ROLES.index(role))
        generator = torch.Generator().manual_seed(own)
        drawn = [self.signal_class.draw(generator, self.sampling.resolution) for _ in range(count)]
        return Members.of_signals(drawn, self.sampling, points, own)


# --- scans ------------------------------------------------------------------------------------------------------------


class ScanClass(StrictModel):
    """Pieces of a scan that was low-passed and decimated by two; the truth is the low-passed scan.

    Between its voxels that is its quintic B-spline, which at half the Nyquist frequency is exact to a few thousandths.
    Lengths are in voxels of the decimated volume, whatever the spacing.

    Attributes:
        title: what the report calls it.
        volume: the file.
    """

    kind: Literal["scan"]
    title: Annotated[str, Field(min_length=1)]
    volume: VolumeChoice

    def open(self, sampling: Sampling) -> Source:
        """Reads, low-passes and decimates it."""
        return Scan.of(self.volume.load().samples.to(device=sampling.device, dtype=torch.float64), sampling)


@dataclass(frozen=True)
class Scan:
    """A scan held out from itself.

    Attributes:
        truth: the low-passed scan as a field; two of its voxels are one of the coarse volume.
        coarse: every second of its voxels, `(D, H, W)`.
        sampling: how many pieces are read from it, and how large.
    """

    truth: fl.Field
    coarse: Tensor
    sampling: Sampling

    @classmethod
    def of(cls, samples: Tensor, sampling: Sampling) -> Scan:
        """From voxels `(D, H, W)`, float64.

        Odd lengths under the boundary mirror keep both ends when decimated: then the coarse volume extends beyond its
        ends as the fine one does.
        """
        for dim, n in enumerate(samples.shape):
            kept = min(n, _LARGEST) - 1 + min(n, _LARGEST) % 2
            samples = samples.narrow(dim, (n - kept) // 2, kept)
        smooth = fir.convolve(samples, fir.low_pass(_SHARPEST, _REACH).to(samples), Boundary.MIRROR)
        truth = fl.reconstruct(smooth, kernels.bspline(5), boundary=Boundary.MIRROR)
        return cls(truth, smooth[::2, ::2, ::2].contiguous(), sampling)

    def members(self, role: Role, count: int, points: int, seed: int) -> Members:
        generator = torch.Generator().manual_seed(seed_of(seed, ROLES.index(role)))
        padded = self.coarse
        for dim in (-3, -2, -1):
            padded = Boundary.MIRROR.extend(padded, dim, _MARGIN, _MARGIN)
        pieces, placed, truths = [], [], []
        for _ in range(count):
            start, size = self._box_with_content(role, generator)
            pieces.append(padded[tuple(slice(s, s + n + 2 * _MARGIN) for s, n in zip(start, size, strict=True))])
            corner, extent = (padded.new_tensor(v[::-1]) for v in (start, size))
            local = torch.rand(points, 3, generator=generator, dtype=torch.float64).to(padded)
            local = local * (extent - 1)
            placed.append(local + _MARGIN)
            truths.append(evaluate(self.truth, 2 * (local + corner)))
        return Members(
            fl.Volume(torch.stack(pieces)[:, None]),
            torch.stack(placed),
            torch.stack([value for value, _ in truths]),
            2 * torch.stack([gradient for _, gradient in truths]),
        )

    def _box_with_content(self, role: Role, generator: torch.Generator) -> tuple[list[int], list[int]]:
        """A box as `_box` draws them, drawn again while there is next to nothing in it: air tells no filter apart."""
        least = _CONTENT * float(self.coarse.std())
        start, size = self._box(role, generator)
        for _ in range(_DRAWS):
            inside = self.coarse[tuple(slice(s, s + n) for s, n in zip(start, size, strict=True))]
            if float(inside.std()) >= least:
                break
            start, size = self._box(role, generator)
        return start, size

    def _box(self, role: Role, generator: torch.Generator) -> tuple[list[int], list[int]]:
        """(first voxel, voxels) along z, y, x of a piece at random within the role's part of the coarse volume."""
        longest = max(range(3), key=lambda d: self.coarse.shape[d])
        start, size = [], []
        for d, n in enumerate(self.coarse.shape):
            low, high = (round(share * n) for share in _PARTS[role]) if d == longest else (0, n)
            size.append(min(high - low, max(self.sampling.resolution - 2 * _MARGIN, 2)))
            start.append(low + int(torch.randint(high - low - size[-1] + 1, (), generator=generator)))
        return start, size


def largest_extent(n: int) -> int:
    """Coarse voxels along an axis of n of a scan."""
    return (min(n, _LARGEST) + 1) // 2


def least_extent(shape: Sequence[int]) -> int:
    """Coarse voxels along the longest axis in the smallest part of a scan of that shape."""
    coarse = max(map(largest_extent, shape))
    return min(round(high * coarse) - round(low * coarse) for low, high in _PARTS.values())
