"""Samples: offsets, tiny and huge ranges, denormals, short types, NaN."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

import filterlab as fl
from experiments.extremes.contract import Case, Finding, Subject, Tally
from experiments.extremes.coordinates import SWEEP, field_of, largest, points_inside, refusal, samples_on
from filterlab.fields.storage import STORAGE
from filterlab.fields.tensor_product import Direct
from filterlab.methods import TensorProduct, Tetrahedral, named
from filterlab.render.bricks import bound

ROUNDING = 2.0**-24
SCALES = (1e-30, 1e-20, 1e-6, 1.0, 1e6, 1e20, 1e30)


# --- ranges -----------------------------------------------------------------------------------------------------------


def _compared(subject: Subject, samples: Tensor, points: Tensor) -> tuple[float, float]:
    """Largest difference of value and gradient from those in float64, relative to the largest sample."""
    exact = field_of(subject, samples.double()).jet(points.double(), 1)
    found = field_of(subject, samples).jet(points, 1)
    scale = largest(samples.double())
    value, gradient = (largest(a.double() - b) / scale for a, b in zip(found, exact, strict=True))
    return value, gradient


def ranges(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Samples up to 10⁻³⁰ … 10³⁰ in float32, against the same in float64."""
    tally = Tally(2e-5)
    count = max(int(500 * amount), 50)
    points = points_inside(random, count, subject.device)
    for scale in SCALES:
        for error in _compared(subject, samples_on(subject.device) * scale, points):
            tally.error(error, f"samples up to {scale:g}", count)
    return tally.finding()


def offsets(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Samples of 10⁸ + small: nothing is lost but what float32 can't hold of the samples themselves."""
    tally = Tally(2e-5)
    count = max(int(1000 * amount), 50)
    points = points_inside(random, count, subject.device)
    samples = samples_on(subject.device) * 1000 + 1e8
    value, gradient = _compared(subject, samples, points)
    tally.error(value, "value of samples near 1e8", count)
    tally.error(gradient, "gradient of samples near 1e8", count)
    return tally.finding()


def denormals(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Samples below the smallest normal float32, 1.2·10⁻³⁸: off by a few of the smallest, and finite."""
    tally = Tally(200.0)
    count = max(int(500 * amount), 50)
    points = points_inside(random, count, subject.device)
    samples = samples_on(subject.device).double().mul(1e-41).float()
    exact = field_of(subject, samples.double()).jet(points.double(), 1)
    found = field_of(subject, samples).jet(points, 1)
    for a, b in zip(found, exact, strict=True):
        tally.error(largest(a.double() - b) / 2.0**-149, "denormal samples", count)
    tally.kept(largest(found[0]) > 3e-43, "denormal samples were taken for 0")
    return tally.finding()


def nan_voxels(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Some voxels become NaN: refused with their number; kept to the reach of the kernel; filled."""
    tally = Tally()
    count = max(int(1000 * amount), 100)
    points = points_inside(random, count, subject.device)
    hit = torch.tensor(random.random(tuple(samples_on(subject.device).shape)) < 0.02, device=subject.device)
    hit[0, 0, 0] = True
    samples = samples_on(subject.device).masked_fill(hit, torch.nan)
    message = refusal(lambda: field_of(subject, samples))
    tally.kept(f"got {int(hit.sum())} NaN" in message, f"the message has another number: {message}")
    kept, whole = (field_of(subject, samples, nan=nan) for nan in ("propagate", "fill"))
    (value, gradient), (expected, slope) = kept.jet(points, 1), whole.jet(points, 1)
    tally.kept(bool(expected.isfinite().all() and slope.isfinite().all()), "filled, but not finite", count)
    unknown = value.isnan()
    one_tap = fl.METHODS[subject.method].facts.taps == 1  # few points are next to one
    tally.kept((one_tap or bool(unknown.any())) and not bool(unknown.all()), "NaN nowhere or everywhere", count)
    same = torch.equal(value[~unknown], expected[~unknown])
    tally.kept(same, "another value than the filled volume's where the hole does not reach", count)
    clear = ~gradient.isnan().any(-1)
    tally.kept(torch.equal(gradient[clear], slope[clear]), "another gradient than the filled volume's", count)
    return tally.finding()


# --- types ------------------------------------------------------------------------------------------------------------

VOLUMES = (torch.float16, torch.bfloat16, torch.uint8, torch.int8, torch.int16, torch.int32)


def short_volumes(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Volumes of short types give what the same numbers in float64 give; points of short types are those numbers."""
    tally = Tally(2e-5)
    count = max(int(400 * amount), 50)
    points = points_inside(random, count, subject.device)
    for dtype in VOLUMES:
        samples = samples_on(subject.device) * 100
        stored = (samples.abs() if dtype == torch.uint8 else samples).to(dtype)
        exact = field_of(subject, stored.double()).jet(points.double(), 1)
        found = field_of(subject, stored).jet(points, 1)
        for a, b in zip(found, exact, strict=True):
            tally.error(largest(a.double() - b) / largest(stored.double()), f"a volume of {dtype}", count)
    field = field_of(subject)
    for dtype in (torch.float16, torch.bfloat16, torch.int16):
        short = points.to(dtype)
        same = torch.equal(field(short), field(short.float()))
        tally.kept(same, f"points of {dtype} are not the same points in float32", count)
    return tally.finding()


def short_storage(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Coefficients in short types: off by their rounding times Σ |w|, what a sum can make of it."""
    tally = Tally(1.0)
    count = max(int(400 * amount), 50)
    points = points_inside(random, count, subject.device)
    exact = field_of(subject)
    values = exact.coefficients.values.double()
    norm = _norm(subject)
    for name, dtype in STORAGE.items():
        field = field_of(subject, storage=name)
        rounding = _rounding(values, dtype) * norm + 1e-5 * float(values.abs().max())
        tally.error(largest(field(points) - exact(points)) / rounding, f"storage {name}", count)
    return tally.finding()


def _norm(subject: Subject) -> float:
    """The largest Σ |w| of the weights of a value."""
    method = named(subject.method)
    if isinstance(method, Tetrahedral):
        return float(method.spline.norm)
    assert isinstance(method, TensorProduct)
    stencil = Direct(method.value_terms).stencils[0]
    return bound(stencil.lowered)[2]


def _rounding(values: Tensor, dtype: torch.dtype) -> float:
    """The largest rounding of a coefficient; of integers twice half a step, as 0 is kept exact."""
    if dtype.is_floating_point:
        return float(values.abs().max()) * torch.finfo(dtype).eps
    info = torch.iinfo(dtype)
    return float(values.max() - values.min()) / (info.max - info.min)


CASES = (
    Case(
        "ranges",
        "samples up to 10⁻³⁰ … 10³⁰",
        "Value and gradient per voxel in float32 within 2·10⁻⁵ of the largest sample; no NaN.",
        ranges,
        SWEEP,
        0.1,
    ),
    Case(
        "offsets",
        "samples of 10⁸ + small",
        "Value and gradient per voxel in float32 within 2·10⁻⁵ of the largest sample.",
        offsets,
        SWEEP,
        0.05,
    ),
    Case(
        "denormals",
        "samples of 10⁻⁴¹, denormal in float32",
        "Finite, and off by at most 200 times the smallest number, 1.4·10⁻⁴⁵.",
        denormals,
        SWEEP,
        0.05,
    ),
    Case(
        "nan-voxels",
        "NaN voxels",
        "Refused with their number; with `propagate` NaN where the kernel reaches one, else the bits of `fill`.",
        nan_voxels,
        SWEEP,
        0.05,
    ),
    Case(
        "short-volumes",
        "volumes of float16, bfloat16, (u)int8, int16, int32; points of float16, bfloat16, int16",
        "The numbers that they hold, summed in float32: within 2·10⁻⁵ of the largest; points are made float32 first.",
        short_volumes,
        SWEEP,
        0.2,
    ),
    Case(
        "short-storage",
        "coefficients stored as float16, bfloat16, int16, int8, uint8",
        "Off by no more than their rounding times Σ |w| of the method (1 is that much).",
        short_storage,
        SWEEP,
        0.2,
    ),
)
