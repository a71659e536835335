"""Points: NaN, infinite, huge, at the ends and the knots."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

import filterlab as fl
from experiments.extremes.contract import Case, Finding, Subject, Tally
from filterlab.fields.grid import GridField

SIZE = (6, 7, 9)  # D, H, W of the volumes
SWEEP = ("method", "scheme", "boundary", "device")
REST = {"mirror": (0.0, 0.5), "reflect": (-0.5, 0.5), "wrap": (0.0, 1.0)}


@lru_cache(maxsize=512)
def _samples(device: str) -> Tensor:
    values = torch.rand(SIZE, generator=torch.Generator().manual_seed(11), dtype=torch.float64)
    return (2 * values - 1).to(torch.float32).to(device)


def field_of(subject: Subject, samples: Tensor | None = None) -> GridField:
    """The subject's field of a small volume of numbers between −1 and 1; with the gradient that its scheme gives."""
    samples = _samples(subject.device) if samples is None else samples
    gradient = fl.METHODS[subject.method].sampled_gradient if subject.scheme == "eight_trilinear" else None
    found = fl.reconstruct(samples, subject.method, boundary=subject.boundary, scheme=subject.scheme, gradient=gradient)
    assert isinstance(found, GridField)
    return found


def points_inside(random: np.random.Generator, count: int, device: str, beyond: float = 4.0) -> Tensor:
    """World points `(count, 3)`, float32, in the volume and up to `beyond` voxels around it."""
    size = np.array(SIZE[::-1])
    points = random.uniform(-beyond, size - 1 + beyond, (count, 3))
    return torch.tensor(points, dtype=torch.float32, device=device)


def nan_coordinate(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Replace one coordinate of some points by NaN; compare with the points left as they were."""
    tally, field = Tally(), field_of(subject)
    count = max(int(2000 * amount), 50)
    points = points_inside(random, count, subject.device)
    hit = torch.tensor(random.random(count) < 0.2, device=subject.device)
    poisoned = points.clone()
    axes = torch.tensor(random.integers(0, 3, count), device=subject.device)
    poisoned[hit, axes[hit]] = math.nan
    before, after = field.jet(points, 1), field.jet(poisoned, 1)
    for name, a, b in zip(("value", "gradient"), before, after, strict=True):
        tally.kept(bool(b[hit].isnan().all()), f"{name} of a NaN point is not NaN", int(hit.sum()))
        tally.kept(torch.equal(a[~hit], b[~hit]), f"{name} of another point changed", int((~hit).sum()))
    _nan_gradients(subject, poisoned, hit, axes, tally)
    return tally.finding()


def _nan_gradients(subject: Subject, points: Tensor, hit: Tensor, axes: Tensor, tally: Tally) -> None:
    """NaN to the coordinates of points that have one, nothing to the volume."""
    grads = []
    for chosen in (points, points[~hit]):
        samples = _samples(subject.device).clone().requires_grad_()
        leaf = chosen.clone().requires_grad_()
        field_of(subject, samples)(leaf).sum().backward()
        assert samples.grad is not None
        assert leaf.grad is not None
        grads.append((samples.grad, leaf.grad))
    (by_samples, by_points), (by_samples_rest, by_points_rest) = grads
    close = torch.allclose(by_samples, by_samples_rest, rtol=1e-4, atol=1e-4)
    tally.kept(close, "a NaN point gave the volume a derivative")
    tally.kept(bool(by_points[hit].gather(1, axes[hit, None]).isnan().all()), "a NaN coordinate got a derivative")
    tally.kept(torch.equal(by_points[~hit], by_points_rest), "derivatives by other points changed")


CASES = (
    Case(
        "nan-coordinate",
        "NaN coordinate",
        "NaN in that output only; no derivative to the volume, NaN to that coordinate; no bit of any other output "
        "changes.",
        nan_coordinate,
        SWEEP,
        0.05,
    ),
)
