"""Shapes and layouts: nothing at all, one voxel, two voxels, any strides, any batch, any number of threads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product

import numpy as np
import torch
from torch import Tensor

import filterlab as fl
from experiments.extremes.contract import Case, Finding, Subject, Tally
from experiments.extremes.coordinates import SWEEP, field_of, largest, points_inside, refusal, samples_on, spline_of

# --- nothing ----------------------------------------------------------------------------------------------------------


def nothing(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """No points, no batch entries, no channels: empty results of the right shape, and a backward pass."""
    tally = Tally()
    for shape in ((0, 3), (4, 0, 3), (0, 5, 3)):
        points = torch.zeros(shape, device=subject.device, requires_grad=True)
        samples = samples_on(subject.device).clone().requires_grad_()
        value, gradient = field_of(subject, samples).jet(points, 1)
        tally.kept(value.shape == shape[:-1] and gradient.shape == shape, f"shapes for points {shape}")
        (value.sum() + gradient.sum()).backward()
        zero = samples.grad is not None and not samples.grad.any()
        tally.kept(zero and points.grad is not None and points.grad.shape == shape, f"backward for points {shape}")
    for n, c in ((0, 1), (0, 2), (2, 0), (0, 0)):
        samples = torch.zeros(n, c, 4, 3, 5, device=subject.device, requires_grad=True)
        points = torch.rand(n, 6, 3, device=subject.device)
        value, gradient = field_of(subject, samples).jet(points, 1)
        tally.kept(value.shape == (n, c, 6) and gradient.shape == (n, c, 6, 3), f"shapes for (N, C) = {(n, c)}")
        value.sum().backward()
        tally.kept(samples.grad is not None and samples.grad.shape == samples.shape, f"backward for {(n, c)}")
    for axis in range(3):
        shape = [4, 4, 4]
        shape[axis] = 0
        message = refusal(lambda shape=shape: field_of(subject, torch.zeros(shape)))
        tally.kept("at least one voxel" in message, f"a volume of shape {shape}: {message}")
    return tally.finding()


def small_axes(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Axes of one and two voxels: interpolated where the method promises it, constant along one voxel."""
    tally = Tally(1e-5)
    interpolating = fl.METHODS[subject.method].facts.interpolating
    for shape in product((1, 2, 5), repeat=3):
        if min(shape) > 2:
            continue
        samples = torch.tensor(random.uniform(-1, 1, shape), dtype=torch.float32, device=subject.device)
        grid = torch.stack(torch.meshgrid(*(torch.arange(float(n)) for n in shape), indexing="ij"), -1).flip(-1)
        points = points_inside(random, 50, subject.device)
        spline = spline_of(field_of(subject, samples))
        step = spline.period if spline and spline.period > 1 else 0
        moved = [_moved(points, axis, random, step) for axis in range(3) if shape[2 - axis] == 1]
        far = points[:20].sign() * 1000
        asked = [grid.reshape(-1, 3).to(subject.device), far, points, *moved]
        on_grid, outside, here, *there = field_of(subject, samples)(torch.cat(asked)).split([len(x) for x in asked])
        if interpolating:
            tally.error(largest(on_grid - samples.flatten()), f"samples of {shape}", samples.numel())
        if subject.boundary == "zeros":
            tally.error(largest(outside), f"outside of {shape} is not 0", 20)
            continue
        for other in there:
            tally.error(largest(here - other), f"constant along one voxel of {shape}", 50)
    return tally.finding()


def _moved(points: Tensor, axis: int, random: np.random.Generator, step: int) -> Tensor:
    """Somewhere else along an axis; by whole steps on octahedra, which are told apart along one voxel too."""
    moved = points.clone()
    if step:
        moved[:, axis] += step * torch.tensor(random.integers(-4, 5, len(points)), device=points.device)
    else:
        moved[:, axis] = torch.tensor(random.uniform(-9, 9, len(points)), dtype=torch.float32)
    return moved


# --- layouts ----------------------------------------------------------------------------------------------------------


def _layouts(samples: Tensor) -> Iterator[tuple[str, Tensor]]:
    """The same numbers (N, C, D, H, W), laid out differently."""
    yield "transposed", samples.transpose(-1, -3).contiguous().transpose(-1, -3)
    yield "channels last", samples.contiguous(memory_format=torch.channels_last_3d)
    yield "every other", torch.stack((samples, samples + 9), -1).flatten(-2)[..., ::2]
    yield "part of a larger one", torch.nn.functional.pad(samples, (2, 1, 3, 2, 1, 1), value=7)[..., 1:-1, 3:-2, 2:-1]
    yield "flipped twice", samples.flip(-1).flip(-1)


def layouts(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Strides, expansion, and what requires grad change no bit, and no input is written to."""
    tally = Tally()
    one = samples_on(subject.device)
    samples = torch.stack((one, one.flip(0), one.flip(1), one.flip(2))).reshape(2, 2, *one.shape)
    count = max(int(300 * amount), 30)
    points = points_inside(random, 2 * count, subject.device).reshape(2, count, 3)
    expected = field_of(subject, samples).jet(points, 1)

    def same(what: str, volume: Tensor, at: Tensor) -> None:
        before = volume.detach().clone(), at.detach().clone()
        found = field_of(subject, volume).jet(at, 1)
        kept = all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
        tally.kept(kept, f"{what}: other bits", 2 * count)
        untouched = torch.equal(before[0], volume.detach()) and torch.equal(before[1], at.detach())
        tally.kept(untouched, f"{what}: an input was written to", 2 * count)

    for name, volume in _layouts(samples):
        assert torch.equal(volume, samples)
        same(f"samples {name}", volume, points)
    same("points in another layout", samples, points.permute(2, 0, 1).contiguous().permute(1, 2, 0))
    for volume_grad, points_grad in product((False, True), repeat=2):
        volume, at = samples.clone().requires_grad_(volume_grad), points.clone().requires_grad_(points_grad)
        same(f"requires_grad of samples {volume_grad}, of points {points_grad}", volume, at)
    spread = one.expand(2, 2, *one.shape)
    alone = field_of(subject).jet(points, 1)
    for n, c in product(range(2), repeat=2):
        for a, b in zip(field_of(subject, spread).jet(points, 1), alone, strict=True):
            tally.kept(torch.equal(a[n, c], b[n]), "expanded samples: other bits", count)
    return tally.finding()


@contextmanager
def threads(number: int) -> Iterator[None]:
    """torch, and all vector code, on so many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def repeatable(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Fields give the same bits for any batch, cut and number of threads; derivatives by samples to 10⁻⁵."""
    tally = Tally(1e-5)
    fewest = 12_300 if subject.scheme == "fused" else 2000  # so many occupy three threads, and fill no last chunk
    count = min(max(int(10_000 * amount), fewest), 20_000)
    points = points_inside(random, count, subject.device)
    samples = samples_on(subject.device).clone().requires_grad_()
    found = []
    for number in (1, 2, 3):
        with threads(number):
            samples.grad = None
            field = field_of(subject, samples)
            value, gradient = field.jet(points, 1)
            (value.square().sum() + gradient.sum()).backward()
            assert samples.grad is not None
            found.append((value.detach(), gradient.detach(), samples.grad.clone()))
    first = found[0]
    for number, other in enumerate(found[1:], start=2):
        kept = torch.equal(first[0], other[0]) and torch.equal(first[1], other[1])
        tally.kept(kept, f"other bits on {number} threads", count)
        tally.error(largest(first[2] - other[2]) / largest(first[2]), f"derivatives on {number} threads", count)
    field = field_of(subject)
    cut = torch.cat([field.jet(part, 1)[0] for part in points.split(int(random.integers(100, 900)))])
    tally.kept(torch.equal(cut, first[0]), "other bits when the points come in parts", count)
    batch = torch.stack((samples_on(subject.device), samples_on(subject.device).flip(2)))[:, None]
    in_batch = field_of(subject, batch).jet(points[None].expand(2, -1, -1), 1)[0][0, 0]
    tally.kept(torch.equal(in_batch, first[0]), "other bits within a batch", count)
    return tally.finding()


CASES = (
    Case(
        "nothing",
        "no points, N = 0, C = 0, an axis without voxels",
        "Empty results of the right shape, and a backward pass that runs; a volume without voxels is a ValueError.",
        nothing,
        SWEEP,
        0.05,
    ),
    Case(
        "small-axes",
        "axes of one and two voxels",
        "Every sample is interpolated where the method does; constant along one voxel but for octahedra (under zeros: "
        "0 outside).",
        small_axes,
        SWEEP,
        0.1,
    ),
    Case(
        "layouts",
        "transposed, channels-last, strided, cut-out, expanded; requires_grad on any subset",
        "The same bits; inputs unchanged.",
        layouts,
        SWEEP,
        0.2,
    ),
    Case(
        "repeatable",
        "any batch, any cut of the points, 1, 2 and 3 threads",
        "The same bits of value and gradient; derivatives by the samples within 10⁻⁵ of the largest.",
        repeatable,
        SWEEP,
        0.3,
    ),
)
