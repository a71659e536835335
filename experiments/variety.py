"""Volumes of wide variety whose truth is known: signals drawn from classes, and scans held out from themselves.

What is varied: bandwidth, place, anisotropy, offset, edges, noise, precision of the samples. What lies beyond the
Nyquist frequency belongs to the truth (`power`, `edges`, `steps`), and so does noise that is a part of the signal
(`noisy`); noise of the samples alone does not (`bytes`).

Letters: n voxels along x, y, z, samples at the integers; P points; k wave vectors in radians per voxel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

import filterlab as fl
from experiments.members import Sampling, Scan
from filterlab import signals
from filterlab.kernels import bspline
from filterlab.recommendation.survey import inner_box
from filterlab.signals import Signal, ValueAndGradient

_CHUNK = 20_000  # points at a time
_APART = 1e-3  # voxels between the gradients that a second derivative is taken from
_WAVES = 64
_MOVES = 4  # of at most a voxel, onto a surface


@dataclass(frozen=True)
class Subject:
    """A volume and its truth.

    Attributes:
        label: for people.
        volume: samples (D, H, W) at the integers.
        points: (P, 3), float32, in the region that `recommend` promises for.
        weights: (P,), summing to 1.
        value, gradient: of the truth there, the gradient per voxel; float64.
        second_derivative: of the truth along a line in a random direction, (P,).
        signal: the truth, anywhere.
        differentiable: whether gradients count; a step has none.
    """

    label: str
    volume: Tensor
    points: Tensor
    weights: Tensor
    value: Tensor
    gradient: Tensor
    second_derivative: Tensor
    signal: Signal
    differentiable: bool = True

    def on_surface(self, level: float, points: Tensor, weights: Tensor) -> Subject:
        """Of points near a surface of the truth, moved onto it along its gradient; no second derivatives."""
        at = points.double()
        for _ in range(_MOVES):
            value, gradient = self.signal.value_and_gradient(at)
            slope = gradient.norm(dim=-1).clamp_min(1e-300)
            at = at - (((value - level) / slope).clamp(-1, 1) / slope)[:, None] * gradient
        at = at.float()
        value, gradient = self.signal.value_and_gradient(at.double())
        bend = torch.zeros_like(value)
        return replace(self, points=at, weights=weights, value=value, gradient=gradient, second_derivative=bend)


@dataclass(frozen=True)
class Draw:
    """Random numbers for a signal on a grid.

    Attributes:
        random: where they come from.
        n: voxels along x, y, z, (3,) float64.
    """

    random: np.random.Generator
    n: Tensor

    @property
    def longest(self) -> float:
        return float(self.n.max())

    def uniform(self, low: float, high: float) -> float:
        return float(self.random.uniform(low, high))

    def log_uniform(self, low: float, high: float) -> float:
        return math.exp(self.uniform(math.log(low), math.log(high)))

    def numbers(self, *shape: int) -> Tensor:
        """Uniform on [0, 1)."""
        return torch.tensor(self.random.random(shape))

    def directions(self, count: int) -> Tensor:
        normal = torch.tensor(self.random.standard_normal((count, 3)))
        return normal / normal.norm(dim=-1, keepdim=True)

    def places(self, count: int) -> Tensor:
        """Anywhere between the first and the last sample."""
        return self.numbers(count, 3) * (self.n - 1)


@dataclass(frozen=True)
class Drawn:
    """A signal of a class.

    Attributes:
        label: its class and what was varied.
        function: voxel points (P, 3) -> value (P), gradient (P, 3).
        foci: (centre, half edge) of cubes in which it has most of its detail, looked at more closely.
        samples: from exact samples to those of the volume.
        differentiable: see `Subject`.
    """

    label: str
    function: ValueAndGradient
    foci: tuple[tuple[Tensor, float], ...] = ()
    samples: Callable[[Tensor], Tensor] = Tensor.float
    differentiable: bool = True


def waves(k: Tensor, phase: Tensor, amplitude: Tensor) -> ValueAndGradient:
    """Σ a cos(k · p + phase) of wave vectors (K, 3)."""

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        angle = p @ k.T + phase
        return (amplitude * torch.cos(angle)).sum(-1), -(amplitude * torch.sin(angle)) @ k

    return function


def _random_waves(draw: Draw, k: Tensor, deviation: float = 1.0) -> ValueAndGradient:
    amplitude = torch.full((len(k),), deviation * math.sqrt(2 / len(k)), dtype=torch.float64)
    return waves(k, 2 * math.pi * draw.numbers(len(k)), amplitude)


def _in_ball(draw: Draw, bandwidth: float, count: int = _WAVES) -> Tensor:
    """Wave vectors uniform in a ball of a radius in parts of the Nyquist frequency."""
    return bandwidth * math.pi * draw.numbers(count, 1) ** (1 / 3) * draw.directions(count)


def _sum(*functions: ValueAndGradient) -> ValueAndGradient:
    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        values, gradients = zip(*(f(p) for f in functions), strict=True)
        return torch.stack(values).sum(0), torch.stack(gradients).sum(0)

    return function


def _windowed(inner: ValueAndGradient, center: Tensor, sigma: float) -> ValueAndGradient:
    """Times exp(−|p − c|² / 2σ²)."""

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        d = p - center
        window = torch.exp(-0.5 * d.square().sum(-1) / sigma**2)
        value, gradient = inner(p)
        return window * value, window[:, None] * (gradient - value[:, None] * d / sigma**2)

    return function


# --- classes ----------------------------------------------------------------------------------------------------------


def _isotropic(draw: Draw) -> Drawn:
    """Waves up to 0.1 … 1 of the Nyquist frequency."""
    bandwidth = draw.uniform(0.1, 1.0)
    return Drawn(f"waves to {bandwidth:.2f}", _random_waves(draw, _in_ball(draw, bandwidth)))


def _anisotropic(draw: Draw) -> Drawn:
    """Waves with another bandwidth along every axis."""
    band = torch.tensor([draw.log_uniform(0.08, 1.0) for _ in range(3)], dtype=torch.float64)
    label = "waves to " + ", ".join(f"{b:.2f}" for b in band.tolist())
    return Drawn(label, _random_waves(draw, _in_ball(draw, 1.0) * band))


def _power(draw: Draw) -> Drawn:
    """Energy per octave ∝ |k|^(1 − p), p = 1 … 5, up to four times the Nyquist frequency."""
    p, count = draw.uniform(1.0, 5.0), 3 * _WAVES
    low, high = math.log(2 * math.pi / draw.longest), math.log(4 * math.pi)
    radius = torch.exp(low + (high - low) * draw.numbers(count))
    k = radius[:, None] * draw.directions(count)
    return Drawn(f"|k|^−{p:.1f}", waves(k, 2 * math.pi * draw.numbers(count), radius ** ((1 - p) / 2)))


def _marschner_lobb(draw: Draw) -> Drawn:
    """The Marschner-Lobb signal, turned and moved, from well resolved to not at all."""
    frequency = draw.log_uniform(0.03, 0.25) * float(draw.n.min())
    signal, scale = signals.marschner_lobb(frequency), 2 / draw.longest
    turn = torch.linalg.qr(torch.tensor(draw.random.standard_normal((3, 3)))).Q
    shift, center = 0.6 * draw.numbers(3) - 0.3, (draw.n - 1) / 2

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        value, gradient = signal.value_and_gradient(scale * (p - center) @ turn.T + shift)
        return value, scale * gradient @ turn

    return Drawn(f"Marschner-Lobb {frequency:.1f}", function)


def _blobs(draw: Draw) -> Drawn:
    """One to five Gaussians of 0.6 to 8 voxels, anywhere."""
    count = int(draw.random.integers(1, 6))
    parts = []
    for center in draw.places(count):
        height, sigma = draw.uniform(0.3, 1.0), draw.log_uniform(0.6, 8.0)
        constant = waves(torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1), torch.tensor([height]))
        parts.append((sigma, center, _windowed(constant, center, sigma)))
    foci = tuple((center, 4 * sigma) for sigma, center, _ in parts)
    return Drawn(f"blobs from {min(sigma for sigma, *_ in parts):.1f} voxels", _sum(*(part[2] for part in parts)), foci)


def _edges(draw: Draw) -> Drawn:
    """Balls whose surface is a tanh of 0.25 to 4 voxels."""
    width, count = draw.log_uniform(0.25, 4.0), int(draw.random.integers(1, 4))
    centers, radii = draw.places(count), draw.longest * (0.15 + 0.3 * draw.numbers(count))

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        d = p[:, None] - centers
        r = d.norm(dim=-1).clamp_min(1e-12)
        t = torch.tanh((radii - r) / width)
        return 0.5 * t.sum(-1), -(0.5 * (1 - t * t) / width / r)[..., None].mul(d).sum(1)

    return Drawn(f"edges of {width:.2f} voxels", function)


def _steps(draw: Draw) -> Drawn:
    """A ball of ones in zeros."""
    center, radius = (0.2 + 0.6 * draw.numbers(3)) * (draw.n - 1), draw.uniform(0.2, 0.45) * draw.longest

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        return ((p - center).norm(dim=-1) < radius).double(), torch.zeros_like(p)

    return Drawn("a step", function, differentiable=False)


def _local(draw: Draw) -> Drawn:
    """Texture in one place, as little as a thousandth of the volume, on a smooth ground."""
    bandwidth, height = draw.uniform(0.3, 0.95), draw.log_uniform(0.02, 1.0)
    center, sigma = draw.places(1)[0], max(2.0, draw.uniform(0.05, 0.2) * draw.longest)
    texture = _windowed(_random_waves(draw, _in_ball(draw, bandwidth), height), center, sigma)
    ground = _random_waves(draw, _in_ball(draw, 0.05))
    label = f"texture to {bandwidth:.2f} within {sigma:.1f} voxels"
    return Drawn(label, _sum(ground, texture), ((center, 2.5 * sigma),))


def _polynomial(draw: Draw) -> Drawn:
    """Polynomials of degree 1 to 4 along every axis, summed: ramps among them."""
    degree = int(draw.random.integers(1, 5))
    factors = torch.tensor(draw.random.standard_normal((degree, 3)))
    powers, scale, center = torch.arange(1, degree + 1)[:, None], 2 / draw.longest, (draw.n - 1) / 2

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        x = scale * (p - center)[:, None]
        return (factors * x**powers).sum((1, 2)), scale * (factors * powers * x ** (powers - 1)).sum(1)

    return Drawn(f"polynomial of degree {degree}", function)


def _noisy(draw: Draw) -> Drawn:
    """Another signal with noise of 0.1 to 10 %, waves in the whole band."""
    ground, noise = _any_of(draw, "marschner-lobb", "blobs", "edges", "waves"), draw.log_uniform(0.001, 0.1)
    k = math.pi * (2 * draw.numbers(3 * _WAVES, 3) - 1)
    return replace(
        ground,
        label=f"{ground.label}, noise of {noise:.3f}",
        function=_sum(ground.function, _random_waves(draw, k, noise)),
    )


def _offset(draw: Draw) -> Drawn:
    """Another signal far from zero, in float64 or float32."""
    ground, offset = _any_of(draw, "marschner-lobb", "blobs", "edges", "waves", "local"), draw.log_uniform(3.0, 1e6)
    constant = waves(
        torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1), torch.tensor([offset], dtype=torch.float64)
    )
    dtype = (torch.float32, torch.float64)[int(draw.random.integers(2))]
    return replace(
        ground,
        label=f"{ground.label}, at {offset:.3g}, {str(dtype).removeprefix('torch.')}",
        function=_sum(ground.function, constant),
        samples=lambda x: x.to(dtype),
    )


def _bytes(draw: Draw) -> Drawn:
    """Another signal rounded to 256 levels."""
    ground = _any_of(draw, "marschner-lobb", "blobs", "edges", "waves", "power", "anisotropic")

    def rounded(x: Tensor) -> Tensor:
        low, high = x.aminmax()
        return (low + ((x - low) * (255 / (high - low))).round() * ((high - low) / 255)).float()

    return replace(ground, label=f"{ground.label}, 8 bits", samples=rounded)


CLASSES: dict[str, Callable[[Draw], Drawn]] = {
    "waves": _isotropic,
    "anisotropic": _anisotropic,
    "power": _power,
    "marschner-lobb": _marschner_lobb,
    "blobs": _blobs,
    "edges": _edges,
    "steps": _steps,
    "local": _local,
    "polynomials": _polynomial,
    "noisy": _noisy,
    "offset": _offset,
    "bytes": _bytes,
}


def _any_of(draw: Draw, *names: str) -> Drawn:
    return CLASSES[names[int(draw.random.integers(len(names)))]](draw)


# --- volumes ----------------------------------------------------------------------------------------------------------


def size_of(random: np.random.Generator, smallest: int, largest: int) -> tuple[int, int, int]:
    """Voxels along z, y, x: log-uniform; one in three has axes of different lengths."""
    n = round(smallest * (largest / smallest) ** random.random())
    if random.random() < 2 / 3:
        return n, n, n
    d, h, w = (max(smallest // 2, int(n * part)) for part in random.uniform(0.4, 1.0, 3))
    return d, h, w


def of_class(name: str, size: tuple[int, int, int], points: int, random: np.random.Generator) -> Subject:
    """A member of a class."""
    n = torch.tensor(size[::-1], dtype=torch.float64)
    drawn = CLASSES[name](Draw(random, n))
    signal = _truth(name, _chunked(drawn.function), size)
    volume = drawn.samples(signal.sample([int(k) for k in n], dtype=torch.float64).samples)
    at, weights = _points(size, points, drawn.foci, random)
    return _subject(drawn.label, volume, signal, at, weights, random, drawn.differentiable)


def of_scan(scan: Tensor, aliased: bool, largest: int, points: int, random: np.random.Generator) -> Subject:
    """A piece of at most `largest` voxels along an axis of every second voxel of a scan (D, H, W), float64.

    Its truth is the spline of degree five through all voxels; they are low-passed before, unless aliased.
    """
    start, size = [], []
    for n in scan.shape:
        size.append(min(n, 2 * largest) // 2 * 2 - 1)
        start.append(int(random.integers(0, n - size[-1] + 1)))
    piece = scan[tuple(slice(s, s + n) for s, n in zip(start, size, strict=True))]
    if aliased:
        truth, coarse = fl.reconstruct(piece, bspline(5)), piece[::2, ::2, ::2]
    else:
        known = Scan.of(piece, Sampling(resolution=largest, inner=1.0))
        truth, coarse = known.truth, known.coarse

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        value, gradient = truth.value_and_gradient(2 * p)
        return value, 2 * gradient

    d, h, w = coarse.shape
    at, weights = _points((d, h, w), points, (), random)
    signal = _truth("scan", _chunked(function), (d, h, w))
    return _subject("", coarse.contiguous().float(), signal, at, weights, random, True)


def _truth(name: str, function: ValueAndGradient, size: tuple[int, int, int]) -> Signal:
    """A signal in the box of voxels of length 1 whose centres are the integers, z, y, x of them."""
    d, h, w = size
    return Signal(name, function, (-0.5, -0.5, -0.5), (w - 0.5, h - 0.5, d - 0.5), 1.0)


def _subject(
    label: str,
    volume: Tensor,
    signal: Signal,
    points: Tensor,
    weights: Tensor,
    random: np.random.Generator,
    differentiable: bool,
) -> Subject:
    points = points.float()
    value, gradient = signal.value_and_gradient(points.double())
    along = torch.tensor(random.standard_normal(points.shape))
    along = along / along.norm(dim=-1, keepdim=True)
    ahead, behind = (signal.value_and_gradient(points.double() + sign * _APART / 2 * along)[1] for sign in (1, -1))
    bent = ((ahead - behind) * along).sum(-1) / _APART
    size = "×".join(str(n) for n in reversed(volume.shape))
    return Subject(f"{label} {size}".strip(), volume, points, weights, value, gradient, bent, signal, differentiable)


def _points(
    size: tuple[int, int, int], count: int, foci: Sequence[tuple[Tensor, float]], random: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Points in the region, half of them where it is in focus, and their weights; a scrambled Sobol sequence."""
    lower, upper = inner_box(size)
    unit = SobolEngine(3, scramble=True, seed=int(random.integers(2**31))).draw(count, dtype=torch.float64)
    boxes = [_box(center, reach, lower, upper) for center, reach in foci]
    boxes = [(low, high, share) for low, high, share in boxes if 0 < share < 0.5]
    at, density = lower + (upper - lower) * unit, torch.ones(count, dtype=torch.float64)
    if boxes:
        # in blocks: every second point of a Sobol sequence lies in one half of the cube
        which = torch.arange(count) * 2 * len(boxes) // count  # the second half of the numbers: anywhere
        density = 0.5 * density
        for i, (low, high, _) in enumerate(boxes):
            at[which == i] = (low + (high - low) * unit)[which == i]
        for low, high, share in boxes:
            density += ((at >= low) & (at <= high)).all(-1) * (0.5 / len(boxes) / share)
    return at, 1 / (count * density)


def _box(center: Tensor, reach: float, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor, float]:
    """A cube as far as it lies in the region: its corners, and its share of it."""
    low, high = torch.maximum(center - reach, lower), torch.minimum(center + reach, upper)
    return low, high, float(((high - low).clamp_min(0) / (upper - lower).clamp_min(1e-300)).prod())


def _chunked(function: ValueAndGradient) -> ValueAndGradient:
    """The same, a few points at a time: waves × points would not fit into memory."""

    def in_parts(p: Tensor) -> tuple[Tensor, Tensor]:
        values, gradients = zip(*(function(part) for part in p.reshape(-1, 3).split(_CHUNK)), strict=True)
        return torch.cat(values).reshape(p.shape[:-1]), torch.cat(gradients).reshape(p.shape)

    return in_parts
