"""More than 2³¹ voxels, and more than 2³¹ points: addresses of 64 bits, tried on memory that is mapped but not used.

A volume of 1,300³ voxels of a byte is an anonymous mapping whose pages are nowhere until something is written to them:
one corner is. The fields and the marcher must find in that corner what they find in a small volume that holds only it.
Points are 2³¹ + 5, of which the last are evaluated: the address of a point and those of its rows are beyond 32 bits.
"""

from __future__ import annotations

import ctypes
import mmap
import sys
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

import filterlab as fl
from experiments.extremes.contract import Case, Finding, Subject, Tally
from experiments.extremes.coordinates import largest
from filterlab.fields.grid import GridField
from filterlab.kernels import bspline
from filterlab.ops import Stencil, gather
from filterlab.ops.cpu import threads
from filterlab.ops.cpu.gather import Program, scatter
from filterlab.ops.cpu.job import Function
from filterlab.ops.cpu.machine import lanes_of
from filterlab.ops.cpu.points import BLOCK
from filterlab.render import TransferFunction, render

EDGE, CORNER = 1300, 24  # voxels along an axis, of the volume and of its corner that is written to; 1300³ > 2³¹
POINTS = 2**31 + 5
MAP_NORESERVE = 0x4000  # of Linux; Python 3.13 has a name for it


def mapped(bytes_wanted: int) -> mmap.mmap | str:
    """Memory that takes none until it is written to; or why there is none."""
    if sys.platform != "linux":
        return "memory is mapped without being reserved on Linux only"
    try:
        return mmap.mmap(-1, bytes_wanted, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | MAP_NORESERVE)
    except (OSError, ValueError) as error:
        return f"{bytes_wanted / 2**30:.0f} GiB of untouched memory can't be mapped: {error}"


@lru_cache(maxsize=1)
def vast_and_corner() -> tuple[Tensor, Tensor] | str:
    """A volume of more than 2³¹ voxels of uint8 that are 0 but in its last corner, and that corner."""
    memory = mapped(EDGE**3)
    if isinstance(memory, str):
        return memory
    vast = torch.frombuffer(memory, dtype=torch.uint8).reshape(EDGE, EDGE, EDGE)
    corner = torch.randint(0, 256, (CORNER,) * 3, generator=torch.Generator().manual_seed(5), dtype=torch.uint8)
    vast[-CORNER:, -CORNER:, -CORNER:] = corner
    return vast, corner


def field_over(subject: Subject, coefficients: Tensor, first: int) -> GridField:
    """The subject's field of given coefficients as they lie, the first of them at `first` along every axis."""
    gradient = fl.METHODS[subject.method].gradient_of(subject.scheme)
    few = torch.zeros((8, 8, 8), dtype=torch.uint8)
    built = fl.reconstruct(few, subject.method, scheme=subject.scheme, gradient=gradient, prefilter=False)
    assert isinstance(built, GridField)
    size = (coefficients.shape[2], coefficients.shape[1], coefficients.shape[0])
    built.coefficients = replace(built.coefficients, values=coefficients, start=first, size=size, quantization=None)
    built._settle()  # these lie elsewhere
    built.domain = replace(built.domain, upper=(size[0] - 0.5, size[1] - 0.5, size[2] - 0.5))
    return built


def many_voxels(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """A field of 1,300³ coefficients near its last corner, against the field of that corner alone."""
    made = vast_and_corner()
    if isinstance(made, str):
        return Finding(0, 0.0, 0.0, skipped=made)
    vast, corner = made
    count = max(int(2000 * amount), 100)
    margin = fl.METHODS[subject.method].reach(prefilter=False) + 1
    points = random.integers(64 * margin, 64 * (CORNER - margin), (count, 3)) / 64.0  # float32 holds them exactly
    near = torch.tensor(points, dtype=torch.float32)
    tally = Tally(2e-6)
    own, whole = field_over(subject, corner, 0), field_over(subject, vast, 0)
    flat = fl.METHODS[subject.method].facts.continuity < 0  # all derivatives are 0
    pairs = zip(whole.jet(near + (EDGE - CORNER), 1), own.jet(near, 1), strict=True)
    for order, (found, expected) in enumerate(pairs):
        tally.error(largest(found - expected) / 255, "another sum than that of the corner alone", count)
        tally.kept(largest(expected) > 10 or (flat and order > 0), "there is nothing in the corner")
    return tally.finding()


def march_through_many(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Rays through the last corner of 1,300³ coefficients, empty space left out, against the corner alone."""
    made = vast_and_corner()
    if isinstance(made, str):
        return Finding(0, 0.0, 0.0, skipped=made)
    images = []
    directions = torch.tensor([[0.0, 0.0, 1.0]]).double().expand(max(int(200 * amount), 20), 3)
    across = torch.tensor(random.uniform(4, CORNER - 5, (len(directions), 3)), dtype=torch.float64)
    transfer = TransferFunction([0.0, 60.0, 255.0], [[1, 0.5, 0], [0.2, 1, 0], [0, 0.3, 1]], [0.0, 0.0, 0.3])
    for coefficients in made:
        first = float(coefficients.shape[0] - CORNER)
        box = ([first + 4.0] * 3, [first + CORNER - 5.0] * 3)
        origins = across * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([first, first, first + 1.0])
        field = field_over(replace(subject, method="triquadratic"), coefficients, 0)
        images.append(render(field, (origins, directions), transfer, region=box, step=0.5))
    tally = Tally(2e-4)  # float32 coordinates of 1,300 voxels are multiples of 1/8192
    tally.error(largest(images[0] - images[1]), "another image than that of the corner alone", len(directions))
    tally.kept(largest(images[1][:, 3]) > 0.5, "there is nothing in the corner")
    return tally.finding()


def scatter_into_many(_subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Add to the last corner of 1,300³ coefficients of float32, against adding to the corner alone."""
    count, tally = max(int(500 * amount), 50), Tally(2e-6)
    points = torch.tensor(random.integers(64 * 3, 64 * (CORNER - 3), (1, count, 3)) / 64.0, dtype=torch.float32)
    cotangents = torch.tensor(random.uniform(-1, 1, (1, 1, 4, count)), dtype=torch.float32)
    memory = mapped(4 * EDGE**3 + 4)
    if isinstance(memory, str):
        return Finding(0, 0.0, 0.0, skipped=memory)
    vast = torch.frombuffer(memory, dtype=torch.float32)[:-1].reshape(1, 1, EDGE, EDGE, EDGE)
    stencil = Stencil.jet(bspline(2), 1)
    program = Program.of("scatter", vast, stencil, 0, vast.dtype)
    threads.run(program.run, program.divided([vast], points + (EDGE - CORNER), cotangents))
    expected = scatter(cotangents, points, stencil, (CORNER,) * 3)
    found = vast[..., -CORNER:, -CORNER:, -CORNER:]
    tally.error(largest(found - expected) / largest(expected), "something else was added to the corner", count)
    tally.kept(largest(expected) > 0.1, "nothing was added")
    return tally.finding()


def many_points(_subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """2³¹ + 5 points, of which the last chunk is evaluated: value and gradient, against those points alone."""
    count, tally = max(int(1000 * amount), 100), Tally()
    point_memory, row_memory = mapped(12 * POINTS), mapped(16 * POINTS)
    for memory in (point_memory, row_memory):
        if isinstance(memory, str):
            return Finding(0, 0.0, 0.0, skipped=memory)
    points = torch.frombuffer(point_memory, dtype=torch.float32).reshape(1, POINTS, 3)  # type: ignore[call-overload]
    rows = torch.frombuffer(row_memory, dtype=torch.float32).reshape(1, 1, 4, POINTS)  # type: ignore[call-overload]
    coefficients = torch.tensor(random.uniform(-1, 1, (1, 1, 9, 8, 7)), dtype=torch.float32)
    points[0, -count:] = torch.tensor(random.uniform(0, 6, (count, 3)), dtype=torch.float32)
    stencil = Stencil.jet(bspline(2), 1)

    program = Program.of("gather", coefficients, stencil, 0, points.dtype)
    _run_the_last(program.run, program.shared(coefficients, points, rows)[0], count)
    expected = gather(coefficients, points[:, -count:].clone(), stencil, 0, "cpu")
    tally.kept(torch.equal(rows[..., -count:], expected), "other bits than those points alone", count)
    tally.kept(largest(expected) > 0.1, "the rows are empty")
    return tally.finding()


def _run_the_last(function: Function, job: Any, count: int) -> None:
    """Only the chunks that hold the last `count` points, on this thread."""
    lanes = lanes_of(torch.float32)
    packs = -(-job.count // lanes)
    job.chunk = BLOCK
    job.chunks = -(-packs // BLOCK)
    job.next = job.chunks - count // (lanes * BLOCK) - 2
    function(ctypes.addressof(job), 0, job.chunks)


def many_segments(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """A ray of 3·10⁹ segments: the count is exact, and an image of it is refused before it is marched."""
    tally = Tally()
    field = fl.reconstruct(torch.rand(8, 8, 8), "trilinear")
    rays = torch.tensor([[-3.0, 4, 4]], dtype=torch.float64), torch.tensor([[1.0, 0, 0]], dtype=torch.float64)
    transfer = TransferFunction([0.0, 1.0], [[1.0, 1, 1]] * 2, [0.1, 0.1])
    for exponent in random.uniform(31.5, 60, max(int(20 * amount), 4)):
        step = 8.0 / 2.0**exponent
        try:
            render(field, rays, transfer, step=step, max_samples=2**31)
            tally.kept(False, f"an image of 2^{exponent:.1f} samples was begun")
        except ValueError as error:
            tally.kept(f"{2.0**exponent:.3g} samples" in str(error), f"another count than 2^{exponent:.3f}: {error}")
    return tally.finding()


PROMISE = "Addresses have 64 bits: what stands beyond 2³¹ is what it would be in a small volume, within 2·10⁻⁶."
CASES = (
    Case("many-voxels", "a volume of 1,300³ > 2³¹ voxels", PROMISE, many_voxels, ("method", "scheme"), 0.1),
    Case(
        "march-through-many",
        "an image of 1,300³ > 2³¹ voxels",
        "The fused and the plain marcher read, skip and composite beyond 2³¹ voxels as in a small volume.",
        march_through_many,
        ("scheme",),
        2.0,
    ),
    Case(
        "scatter-into-many",
        "derivatives by 1,300³ > 2³¹ voxels",
        "They are added beyond 2³¹ voxels as in a small volume, within 2·10⁻⁶ of the largest.",
        scatter_into_many,
        (),
        0.2,
    ),
    Case("many-points", "2³¹ + 5 points", "The last ones have the bits that they have alone.", many_points, (), 0.2),
    Case(
        "many-segments",
        "10⁹ … 10¹⁸ samples of a ray",
        "Counted without wrapping round, and refused with the count before anything is marched.",
        many_segments,
        (),
        0.1,
    ),
)
