"""Points: NaN, infinite, huge, at the ends and the knots, far from the origin."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

import filterlab as fl
from experiments.extremes.contract import Case, Finding, Subject, Tally
from filterlab.fields.grid import GridField
from filterlab.fields.tetrahedral import OnTetrahedra, Spline
from filterlab.render import Light, Shading, TransferFunction, render

SIZE = (6, 7, 9)  # D, H, W of the volumes
SWEEP = ("method", "scheme", "boundary", "device")
SHEARED = np.array([[1, 0.25, 0, 0], [0, 1, 0, 0], [0.5, 0, 1, 0], [0, 0, 0, 1]])  # its inverse has zeros, met by ∞
SPACINGS = (1.0, 0.5)  # with ½ the voxels of a huge point are beyond float32


@lru_cache(maxsize=512)
def samples_on(device: str) -> Tensor:
    values = torch.rand(SIZE, generator=torch.Generator().manual_seed(11), dtype=torch.float64)
    return (2 * values - 1).to(torch.float32).to(device)


def field_of(subject: Subject, samples: Tensor | fl.Volume | None = None, **options: str) -> GridField:
    """The subject's field of a small volume of numbers between −1 and 1; with the gradient that its scheme gives."""
    samples = samples_on(subject.device) if samples is None else samples
    found = fl.reconstruct(
        samples,
        subject.method,
        boundary=subject.boundary,
        scheme=subject.scheme,
        gradient=fl.METHODS[subject.method].gradient_of(subject.scheme),
        storage=options.get("storage"),
        nan=options.get("nan", "refuse"),
    )
    assert isinstance(found, GridField)
    return found


def spline_of(field: GridField) -> Spline | None:
    """What a field on tetrahedra is; None for others."""
    return field.scheme.spline if isinstance(field.scheme, OnTetrahedra) else None


def refusal(call: Callable[[], object]) -> str:
    """The message of the ValueError that a call raises."""
    try:
        call()
    except ValueError as error:
        return str(error)
    return "was accepted"


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
        samples = samples_on(subject.device).clone().requires_grad_()
        leaf = chosen.clone().requires_grad_()
        field_of(subject, samples)(leaf).sum().backward()
        assert samples.grad is not None
        assert leaf.grad is not None
        grads.append((samples.grad, leaf.grad))
    (by_samples, by_points), (by_samples_rest, by_points_rest) = grads
    close = torch.allclose(by_samples, by_samples_rest, rtol=1e-4, atol=1e-4)
    tally.kept(close, "a NaN point gave the volume a derivative")
    tally.kept(bool(by_points[hit].gather(1, axes[hit, None]).isnan().all()), "a NaN coordinate got a derivative")
    # on tetrahedra they are sums of torch's own, whose order depends on how many points there are
    rounding = 1e-5 if spline_of(field_of(subject)) else 0.0
    same = torch.allclose(by_points[~hit], by_points_rest, rtol=rounding, atol=rounding)
    tally.kept(same, "derivatives by other points changed")


# --- infinite and huge -----------------------------------------------------------------------------------------------


def infinite_coordinate(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """One, two or three coordinates of points become ±inf, in the world of the voxels and in a sheared one."""
    tally = Tally(1e-5)
    for affine in (np.eye(4), SHEARED):
        field = field_of(subject, fl.Volume(samples_on(subject.device), affine=affine))
        _infinite_in(field, subject, random, amount, tally)
    return tally.finding()


def _infinite_in(field: GridField, subject: Subject, random: np.random.Generator, amount: float, tally: Tally) -> None:
    count = max(int(1000 * amount), 50)
    points = points_inside(random, count, subject.device)
    hit = random.random((count, 3)) < 0.4
    hit[:, 0] |= ~hit.any(1)
    signs = np.where(random.random((count, 3)) < 0.5, -1.0, 1.0)
    infinite, hit = torch.tensor(signs * math.inf, device=subject.device), torch.tensor(hit, device=subject.device)
    value, gradient = field.jet(torch.where(hit, infinite.float(), points), 1)
    if field.coefficients.boundary.periodic:
        tally.kept(bool(value.isnan().all() and gradient.isnan().all()), "not NaN at infinity", count)
        return
    spline = spline_of(field)
    if spline and spline.period > 1 and subject.boundary == "border" and not field.domain.geometry.is_identity:
        return  # octahedra go on without end, and a field on them with them
    # where the extension is constant: far outside, at a coordinate that float32 has without rounding
    far = torch.where(hit, (1000 * infinite.sign()).float(), points)
    for found, expected in zip((value, gradient), field.jet(far, 1), strict=True):
        tally.error(largest(found - expected), "another value than far outside", count)
    if subject.boundary == "zeros":
        tally.error(largest(value), "not 0 at infinity")
    elif field.domain.geometry.is_identity:
        tally.error(largest(field(infinite.float()[:8]) - _corner_values(field, infinite[:8])), "not a corner's value")


def _corner_values(field: GridField, directions: Tensor) -> Tensor:
    """The value at the corner voxel of each direction `(P, 3)`, of an interpolating method; else far outside."""
    size = directions.new_tensor(SIZE[::-1])
    if not fl.METHODS[field.method].facts.interpolating:
        return field((1000 * directions.sign()).float())
    return field(torch.where(directions > 0, size - 1, 0 * size).float())


def huge_coordinate(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Coordinates from 2²⁴ to 3·10³⁸ world units, where float32 has integers only: folded as integers of Python are."""
    tally = Tally(2e-5)
    for spacing in SPACINGS:
        _huge_in(spacing, subject, random, amount, tally)
    return tally.finding()


def _huge_in(spacing: float, subject: Subject, random: np.random.Generator, amount: float, tally: Tally) -> None:
    near, field = field_of(subject), field_of(subject, fl.Volume(samples_on(subject.device), spacing=spacing))
    spline = spline_of(field)
    count = max(int(500 * amount), 50)
    exponents = random.uniform(24, 127.99, (count, 3))
    huge = np.float32(np.where(random.random((count, 3)) < 0.5, -1, 1) * 2.0**exponents)
    some = random.random((count, 3)) < 0.5
    inside = points_inside(random, count, subject.device, beyond=0.0).cpu().numpy()
    points = np.where(some, huge, spacing * inside).astype(np.float32)
    folded, signs = np.empty((count, 3)), np.empty((count, 3))
    for index in np.ndindex(count, 3):
        x, n = float(points[index]) / spacing, SIZE[2 - index[1]]
        folded[index], signs[index] = _shifted(x, n, subject, spline) if spline else _folded(x, n, subject.boundary)
    value, gradient = field.jet(torch.tensor(points, device=subject.device), 1)
    expected, slope = near.jet(torch.tensor(folded, dtype=torch.float32, device=subject.device), 1)
    tally.error(largest(value - expected), "a value that its folded point does not have", count)
    found, wanted = spacing * gradient, slope * torch.tensor(signs, device=subject.device).float()
    plane = _on_a_plane_of_reflection(points.astype(float) / spacing, subject.boundary).to(subject.device)
    off = torch.where(plane, found.abs() - wanted.abs(), found - wanted)  # there the sign is one of two
    tally.error(largest(off), "a gradient that its folded point does not have", count)


def _on_a_plane_of_reflection(x: np.ndarray, boundary: str) -> Tensor:
    """Which coordinates `(P, 3)` lie on one; those of `reflect` are halfway between integers, where nothing huge is."""
    return torch.from_numpy((np.fmod(x, np.array(SIZE[::-1]) - 1) == 0) & (boundary == "mirror"))


def _folded(x: float, n: int, boundary: str) -> tuple[float, float]:
    """The coordinate within one period, or far outside, and the derivative by x; exact for integers."""
    if boundary in ("border", "zeros"):
        return (max(min(x, 1000.0), -1000.0), 0.0 if abs(x) >= 1000 else 1.0)
    period = {"mirror": 2 * n - 2, "reflect": 2 * n, "wrap": n}[boundary]
    if x != int(x):
        return x, 1.0
    k = int(x) % period
    if boundary == "wrap" or k < n:
        return float(k), 1.0
    return float((period if boundary == "mirror" else period - 1) - k), -1.0


def _shifted(x: float, n: int, subject: Subject, spline: Spline) -> tuple[float, float]:
    """The same where a partition is not reflected with the samples: moved by a period of both."""
    period = fl.Boundary.named(subject.boundary).period(n)
    if period is None or x != int(x):
        return _folded(x, n, subject.boundary)[0], 1.0
    return float(int(x) % math.lcm(int(period), spline.period)), 1.0


# --- the ends and the knots ------------------------------------------------------------------------------------------


def ends_and_knots(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """A step of one unit of rounding across ends, knots and half-knots: value and gradient go on as the class says."""
    facts = fl.METHODS[subject.method].facts
    if facts.continuity < 0:
        return Finding(0, 0.0, 0.0, skipped=f"{subject.method} jumps between samples")
    tally, field = Tally(1e-4), field_of(subject)
    count = max(int(800 * amount), 50)
    size = np.array(SIZE[::-1])
    places = random.integers(-6, 2 * size + 6, (count, 3)) / 2.0  # knots and half-knots, outside too
    ends = np.where(random.random((count, 3)) < 0.5, 0.0, size - 1.0)
    places = np.where(random.random((count, 3)) < 0.3, ends, places).astype(np.float32)
    axis = random.integers(0, 3, count)
    before, after = places.copy(), places.copy()
    rows = np.arange(count)
    before[rows, axis] = np.nextafter(places[rows, axis], np.float32(-np.inf))
    after[rows, axis] = np.nextafter(places[rows, axis], np.float32(np.inf))
    jets = [field.jet(torch.tensor(p, device=subject.device), 1) for p in (before, places, after)]
    smooth = facts.continuity >= 1 or field.scheme.gradient == "central"
    for order in range(2 if smooth else 1):
        for one, other in ((0, 1), (1, 2)):
            tally.error(largest(jets[one][order] - jets[other][order]), f"a jump of derivative {order}", count)
    zero = places.copy()
    zero[zero == 0] = -0.0
    same = all(
        torch.equal(a, b) for a, b in zip(jets[1], field.jet(torch.tensor(zero, device=subject.device), 1), strict=True)
    )
    tally.kept(same, "−0.0 is not 0.0", count)
    return tally.finding()


# --- far from the origin ---------------------------------------------------------------------------------------------

ORIGIN = (1e6, -1e6, 2e6)


def far_from_the_origin(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """The volume stands millions of voxels away; its points are given in float64, and measured from a point nearby."""
    tally = Tally(1e-5)
    samples = samples_on(subject.device)
    near, far = field_of(subject), field_of(subject, fl.Volume(samples, origin=ORIGIN))
    count = max(int(2000 * amount), 50)
    points = points_inside(random, count, subject.device)
    moved = points.double() + points.new_tensor(ORIGIN, dtype=torch.float64)
    exact, lost = near.jet(points.double(), 1), 0.0
    for found, how in ((far.jet(moved, 1), "in float64"), (far.relative_to(ORIGIN).jet(points, 1), "measured nearby")):
        for a, b in zip(exact, found, strict=True):
            tally.error(largest(a - b), f"digits were lost with points {how}", count)
    for a, b in zip(exact, far.jet(moved.float(), 1), strict=True):
        lost = max(lost, largest(a - b))
    found = tally.finding()
    return replace(found, note=found.note or f"with float32 points the error is {lost:.2g}")


def images_far_from_the_origin(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """The same rays through the same volume, at the origin and millions of voxels away."""
    tally, count = Tally(1e-5), max(int(400 * amount), 40)
    samples, size = samples_on(subject.device), np.array(SIZE[::-1])
    inside = torch.tensor(random.uniform(0, size - 1, (count, 3)), device=subject.device)
    directions = torch.tensor(random.normal(size=(count, 3)), device=subject.device)
    transfer = TransferFunction([-1.0, 0.0, 1.0], [[1, 0.5, 0], [0.2, 1, 0], [0, 0.3, 1]], [0.0, 0.1, 0.5])
    images = []
    for origin in ((0.0, 0.0, 0.0), ORIGIN):
        field = field_of(subject, fl.Volume(samples, origin=origin))
        rays = inside - 20 * directions + inside.new_tensor(origin), directions
        images.append(render(field, rays, transfer, shading=Shading(lights=[Light((0.5, -1, 0.2))])))
    tally.error(largest(images[0] - images[1]), "another image than at the origin", count)
    tally.kept(largest(images[0][:, 3]) > 0.3, "there is nothing to see")
    return tally.finding()


def largest(x: Tensor) -> float:
    return float(x.detach().abs().max())


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
    Case(
        "infinite-coordinate",
        "±inf coordinate, also under a sheared affine",
        "border: the edge value; zeros: 0; mirror, reflect and wrap: NaN in that output.",
        infinite_coordinate,
        SWEEP,
        0.05,
    ),
    Case(
        "huge-coordinate",
        "coordinates of 2²⁴ … 3·10³⁸, of voxels and of half voxels",
        "Folded as exactly as small ones; border: the edge value; zeros: 0.",
        huge_coordinate,
        SWEEP,
        0.05,
    ),
    Case(
        "ends-and-knots",
        "0, −0.0, n−1, knots and half-knots, from both sides",
        "The value is continuous, the gradient too where the method is C¹ (or takes central differences).",
        ends_and_knots,
        SWEEP,
        0.05,
    ),
    Case(
        "far-from-the-origin",
        "a volume 10⁶ voxels from the origin",
        "Float64 points, and float32 points measured from nearby (`relative_to`), keep value and gradient to 10⁻⁵; "
        "float32 points in the world have lost their digits already.",
        far_from_the_origin,
        SWEEP,
        0.05,
    ),
    Case(
        "images-far-from-the-origin",
        "an image of a volume 10⁶ voxels from the origin",
        "Within 10⁻⁵ of the image at the origin, by the fused and by the plain marcher.",
        images_far_from_the_origin,
        SWEEP,
        0.2,
    ),
)
