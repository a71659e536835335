"""Rendering: opacities, steps and numbers of samples from the least to the most; how the work is cut up."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

import filterlab as fl
from experiments.extremes.contract import Case, Finding, Subject, Tally
from experiments.extremes.coordinates import largest, refusal
from experiments.extremes.shapes import threads
from filterlab.fields.base import Domain, Field
from filterlab.render import TransferFunction, render

SWEEP = ("scheme", "device")
_METHOD = "triquadratic"  # the one that every scheme can evaluate
_N = 12  # voxels along an axis
_RGB = (1.0, 0.5, 0.25)
_EPS = {torch.float32: 2.0**-23, torch.float64: 2.0**-52}
_OPACITIES = (0.0, 5e-324, 1e-300, 1e-12, 0.5, 1 - 2.0**-23, 1 - 2.0**-52, 1.0)
_STEPS = (0.01, 0.1, 0.5, 1.0, 8.0)


def _field(subject: Subject, samples: Tensor, method: str = _METHOD) -> Field:
    return fl.reconstruct(samples.to(subject.device), method, scheme=subject.scheme)


def _noise() -> Tensor:
    return torch.rand(_N, _N, _N, generator=torch.Generator().manual_seed(3))


def _along(length: float, count: int = 1) -> dict[str, Any]:
    """Arguments of `render`: parallel rays of which so many voxels are inside."""
    y = torch.linspace(1.0, _N - 2.0, count, dtype=torch.float64)
    origins = torch.stack((torch.full_like(y, -5.0), y, torch.full_like(y, 5.5)), -1)
    directions = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(count, 3)
    return {"camera": (origins, directions), "region": ((0.0, -1.0, -1.0), (length, float(_N), float(_N)))}


def _medium(opacity: float | Tensor, unit: float = 1.0, falls_to: float = 1.0) -> TransferFunction:
    """One colour; the opacity goes from so much of it at value 0 to all of it at value 1."""
    alpha = torch.as_tensor(opacity, dtype=torch.float64) * torch.tensor([falls_to, 1.0], dtype=torch.float64)
    return TransferFunction(torch.tensor([0.0, 1.0]).double(), torch.tensor([_RGB, _RGB]).double(), alpha, unit)


def _draw(subject: Subject, field: Field, transfer: TransferFunction, **scene: Any) -> Tensor:
    return render(field, transfer=transfer, device=subject.device, **scene)


def closed_form(opacity: float, exponent: float) -> tuple[float, float]:
    """1 − (1 − α)^e and its derivative by α; at α = 1 that is taken as 0."""
    if opacity == 1:
        return 1.0, 0.0
    depth = -math.log1p(-opacity) * exponent
    return -math.expm1(-depth), exponent * math.exp(-depth) / (1 - opacity)


# --- a constant medium ------------------------------------------------------------------------------------------------


def constant_medium(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Any opacity, step, unit and length; error of value and derivative in units of the stated bound."""
    tally = Tally(1.0)
    for i in range(max(int(400 * amount), 16)):
        dtype = (torch.float32, torch.float64)[i % 2]
        opacity = float(random.choice(_OPACITIES) if random.random() < 0.5 else random.random())
        step = float(random.choice(_STEPS) if random.random() < 0.7 else 10 ** random.uniform(1, 300))
        unit, length = 10 ** random.uniform(-6, 6), float(random.uniform(0.05, 11))
        _constant(subject, tally, dtype, opacity, step, unit, length)
    return tally.finding()


def _constant(
    subject: Subject, tally: Tally, dtype: torch.dtype, opacity: float, step: float, unit: float, length: float
) -> None:
    what = f"α {opacity!r}, step {step:.3g}, unit {unit:.3g}, length {length:.3g}, {dtype}"
    alpha = torch.tensor(opacity, dtype=torch.float64, requires_grad=True)
    volume = torch.full((_N, _N, _N), 0.5, dtype=dtype, requires_grad=True)
    field = _field(subject, volume)
    image = _draw(subject, field, _medium(alpha, unit), step=step, dtype=dtype, **_along(length))[0]
    used = float(torch.tensor(opacity, dtype=torch.float64).to(dtype))
    value, slope = closed_form(used, length / unit)
    bound = 16 * _EPS[dtype] * (1 + min(step, 2 * field.domain.diagonal) / length)
    tally.error(_relative(image[3].item(), value) / (bound * max(1.0, length / unit)), what)
    (by_opacity,) = torch.autograd.grad(image[3], alpha, retain_graph=True)
    steepness = 1 + length / unit * (1 + math.log1p(1 / (1 - used + 1e-16)))
    tally.error(_relative(by_opacity.item(), slope) / (64 * bound * steepness), f"derivative, {what}")
    by_all = torch.autograd.grad(image.sum(), (alpha, volume))
    tally.kept(all(bool(g.isfinite().all()) for g in by_all), f"a derivative is not finite, {what}")


def _relative(found: float, expected: float) -> float:
    """|found − expected| in units of `expected`; denormal numbers of float32 may vanish."""
    difference = abs(found - expected)
    return 0.0 if difference < 1e-37 else difference / max(abs(expected), 1e-300)


def many_steps(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Rays of up to 10⁵ segments, with derivatives."""
    tally, steps = Tally(1e-10), max(int(1e5 * amount), 2000)
    for opacity in (1e-6, 1 - 2.0**-52):
        alpha = torch.tensor(opacity, dtype=torch.float64, requires_grad=True)
        volume = torch.full((_N, _N, _N), 0.5, dtype=torch.float64, requires_grad=True)
        scene = {"step": 10.0 / steps, "dtype": torch.float64, **_along(10.0)}
        image = _draw(subject, _field(subject, volume), _medium(alpha), **scene)[0]
        value, slope = closed_form(opacity, 10.0)
        by_opacity, by_volume = torch.autograd.grad(image[3], (alpha, volume))
        tally.error(_relative(image[3].item(), value), f"value, α = {opacity}", steps)
        tally.error(_relative(by_opacity.item(), slope), f"derivative, α = {opacity}", 0)
        tally.kept(bool(by_volume.isfinite().all()), "a derivative by the volume is not finite", 0)
    return tally.finding()


def long_steps(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Steps of 10² … 10³⁰⁸ voxels on rays of 10: one segment, which has what its middle has."""
    tally = Tally(1e-6)
    field, table = _field(subject, _noise()), _medium(0.6, falls_to=0.2)
    scene = _along(10.0, count=10)
    origins, _ = scene["camera"]
    middle = origins + torch.tensor([10.0, 0.0, 0.0], dtype=torch.float64)
    rgb, alpha = table(field(middle.float().to(subject.device)))
    opacity = -torch.expm1(10 * torch.log1p(-alpha))
    expected = torch.cat((opacity[:, None] * rgb, opacity[:, None]), -1)
    for step in (*10.0 ** random.uniform(2, 308, max(int(30 * amount), 3)), 1.7e308):
        found = _draw(subject, field, table, step=float(step), **scene)
        tally.error(largest(found - expected), f"step {step:.3g}", len(found))
    return tally.finding()


# --- limits -----------------------------------------------------------------------------------------------------------


class _Untouched(Field):
    """A field that must not be evaluated."""

    domain = Domain((-0.5, -0.5, -0.5), (_N - 0.5, _N - 0.5, _N - 0.5))

    def jet(self, points: Tensor, order: int) -> tuple[Tensor, ...]:
        raise AssertionError("the field was evaluated")


@torch.no_grad()
def refused(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Steps that are none, and more samples than are allowed."""
    tally = Tally()
    for step in (0.0, -0.0, -1.0, -5e-324, math.nan, math.inf, -math.inf, None, "a", 10**400, torch.zeros(2)):
        told = refusal(lambda step=step: render(_Untouched(), transfer=_medium(0.5), step=step, **_along(10.0)))  # type: ignore[arg-type]
        tally.kept(told.startswith("step must be a positive number of voxels; got"), f"step {step!r}: {told}")
    for step in 10 ** -random.uniform(9.5, 300, max(int(50 * amount), 5)):
        told = refusal(lambda step=step: render(_Untouched(), transfer=_medium(0.5), step=step, **_along(10.0)))
        count = f"{10 / step:.3g}" if 10 / step < 2**62 else "more than 4.61e+18"
        tally.kept(f"would take {count} samples" in told, f"step {step:.3g}: {told}")
    for limit in random.integers(1, 999, max(int(50 * amount), 5)):
        scene = {"step": 0.01, "max_samples": int(limit), **_along(10.0)}
        told = refusal(lambda scene=scene: render(_Untouched(), transfer=_medium(0.5), **scene))
        tally.kept("would take 1e+03 samples" in told and f"max_samples={limit}" in told, f"limit {limit}: {told}")
    return tally.finding()


def termination(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Images with early termination and without; and with it where derivatives are asked."""
    tally = Tally(1.0)
    for _ in range(max(int(60 * amount), 5)):
        limit, glow = 10 ** random.uniform(-5, -0.05), float(random.uniform(0, 4))
        opacity, background = float(random.random()), tuple(random.uniform(0, 2, 3).tolist())
        table = TransferFunction([0.0, 1.0], [(glow, 0.1, 1.0), (0.3, glow, 0.0)], [0.2 * opacity, opacity])
        scene = {"step": float(random.uniform(0.1, 3)), "background": background, **_along(11.0, count=7)}
        fields = [_field(subject, _noise().requires_grad_(grad)) for grad in (False, True)]
        full, short = (_draw(subject, fields[0], table, termination=t, **scene) for t in (None, limit))
        tally.error(largest(full - short) / (limit + 2e-6), f"termination {limit:.3g}", len(full))
        exact, asked = (_draw(subject, fields[1], table, termination=t, **scene) for t in (None, limit))
        tally.kept(torch.equal(exact, asked), f"termination {limit:.3g} is on where derivatives are asked", len(full))
    return tally.finding()


# --- how the work is cut up -------------------------------------------------------------------------------------------


def same_bits(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """The same image in tiles of any size, on 1, 2 and 3 threads, alone and as part of a larger one."""
    tally = Tally()
    rays = max(int(300 * amount), 40)
    field, table = _field(subject, _noise()), _medium(0.3, falls_to=0.1)
    scene = {"step": 0.7, **_along(10.0, count=rays)}
    origins, directions = scene.pop("camera")
    for seed in (None, int(random.integers(2**62))):
        with threads(1):
            whole = _draw(subject, field, table, camera=(origins, directions), jitter_seed=seed, **scene)
        for memory, number in ((1, 1), (2**14, 2), (2**17, 3), (2**40, 3), (int(2 ** random.uniform(10, 30)), 2)):
            options = {"camera": (origins, directions), "jitter_seed": seed, "memory": memory}
            with threads(number):
                found = _draw(subject, field, table, **options, **scene)
            tally.kept(torch.equal(found, whole), f"other bits with memory={memory} on {number} threads", rays)
        if seed is None:  # jitter is of a pixel's number
            first, last = sorted(random.choice(rays, 2, replace=False).tolist())
            part = _draw(subject, field, table, camera=(origins[first:last], directions[first:last]), **scene)
            tally.kept(torch.equal(part, whole[first:last]), "other bits of a part of the image", last - first)
    volumes = torch.stack((_noise(), _noise().flip(0)))[:, None]
    batch = _draw(subject, _field(subject, volumes), table, camera=(origins, directions), **scene)
    for n in range(2):
        alone = _draw(subject, _field(subject, volumes[n, 0]), table, camera=(origins, directions), **scene)
        tally.kept(torch.equal(batch[n, 0], alone), "other bits in a batch", rays)
    return tally.finding()


def torn_volume(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """A voxel of NaN: the rays that pass it lose what is there, all others have the bits that they had."""
    tally = Tally()
    scene: dict[str, Any] = {"step": 0.5, **_along(11.0, count=10)}
    whole = _draw(subject, _plain(subject, _noise()), _medium(0.05), **scene)
    for _ in range(max(int(60 * amount), 5)):
        z, y, x = random.integers(0, _N, 3).tolist()
        torn = _noise()
        torn[z, y, x] = math.nan
        image = _draw(subject, _plain(subject, torn), _medium(0.05), **scene)
        place = torch.tensor([y, z], dtype=torch.float64)
        distance = (scene["camera"][0][:, 1:] - place).abs().amax(-1)
        far, met = distance > 1.55, distance < 1.45  # half the support of the kernel
        left = torch.log1p(-image[:, 3].double().cpu()) / math.log1p(-0.05)
        missing = min(x + 1.5, 11.0) - max(x - 1.5, 0.0)
        amiss = (left[met] - (11.0 - missing)).abs() > scene["step"] + 1e-5
        tally.kept(bool(image.isfinite().all()), f"a NaN at {(x, y, z)} is in the image", len(left))
        tally.kept(not bool(amiss.any()), f"more or less than a NaN at {(x, y, z)} is transparent", len(left))
        tally.kept(torch.equal(image[far], whole[far]), "other rays have other bits", len(left))
    return tally.finding()


def _plain(subject: Subject, samples: Tensor) -> Field:
    """Without a prefilter, which would carry a NaN through the volume."""
    return fl.reconstruct(samples.to(subject.device), _METHOD, scheme=subject.scheme, prefilter=False, nan="propagate")


CASES = (
    Case(
        "constant-medium",
        "opacity 0, 5·10⁻³²⁴ … 1 − ε, 1; steps of 0.01 … 8 voxels and up to 10³⁰⁰; units of 10⁻⁶ … 10⁶",
        "Opacity and its derivative are those of 1 − (1 − α)^(length/unit), relative to 16 ε (1 + step/length) and "
        "what α itself costs; all derivatives are finite. The table says the error in units of that bound.",
        constant_medium,
        SWEEP,
        6,
        tested=0.05,
    ),
    Case(
        "many-steps",
        "10⁵ steps along a ray, nearly clear and nearly opaque",
        "Value and derivative of the closed form to 10⁻¹⁰ (float64); derivatives by the volume are finite.",
        many_steps,
        SWEEP,
        40,
        tested=0.02,
    ),
    Case(
        "long-steps",
        "steps longer than every ray, up to 10³⁰⁸ voxels",
        "One segment with the value in its middle, to 10⁻⁶ (float32).",
        long_steps,
        SWEEP,
        0.3,
    ),
    Case(
        "too-many-samples",
        "a step of 0, less, NaN, ∞, no number; steps of 10⁻³⁰⁰; more samples than `max_samples`",
        "A ValueError with the number of samples and the limit, before the field is evaluated.",
        refused,
        seconds=0.2,
    ),
    Case(
        "early-termination",
        "any termination, glowing colours and backgrounds",
        "The image changes by at most `termination`; where derivatives are asked it is off, to the bit.",
        termination,
        SWEEP,
        2,
    ),
    Case(
        "same-image",
        "any memory=, 1 … 3 threads, a part of the image, a batch; jitter",
        "The same bits.",
        same_bits,
        SWEEP,
        4,
    ),
    Case(
        "nan-voxel-rays",
        "one voxel of NaN in a volume that is rendered",
        "Transparent as far as the kernel reaches, to a step; the same bits in the pixels whose rays pass by.",
        torn_volume,
        SWEEP,
        1,
    ),
)
