"""The largest sample along rays: the program beside its plain twin, and both beside rows that are searched by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import pytest
import torch

from filterlab import METHODS, reconstruct
from filterlab.ops.differentiable.projection import largest
from filterlab.ops.gather import STORAGE
from filterlab.ops.march import Chords
from filterlab.ops.projection import Projection
from filterlab.ops.stencil import Stencil
from tests.pairs import covering

RAYS = 37


def chords(size: tuple[int, int, int], count: torch.Tensor, step: float) -> Chords:
    """Rays from anywhere to anywhere in the box between the first and the last of (D, H, W), cut somewhere."""
    generator = torch.Generator().manual_seed(5)
    ends = torch.rand(2, len(count), 3, dtype=torch.float64, generator=generator)
    start, end = ends * (torch.tensor(size[::-1], dtype=torch.float64) - 1)
    offset = 0.05 + 0.9 * torch.rand(len(count), dtype=torch.float64, generator=generator)
    length = ((count - 1 + offset) * step + 0.5 * step).clamp_min(step / 2) * (count > 0)
    return Chords(start, (end - start) / length.clamp_min(step)[:, None], length, offset, count)


def counts() -> torch.Tensor:
    """Of segments: none, one, and about as many as fill runs of 8, 16 and 64."""
    return torch.tensor([0, 1, 2, 7, 8, 9, 15, 16, 17, 31, 32, 33, 63, 64, 65, 100, 200])[torch.arange(RAYS) % 17]


def projection(method: str, boundary: str = "mirror") -> Projection:
    samples = torch.rand(7, 6, 9, generator=torch.Generator().manual_seed(1))
    field = reconstruct(samples, method, boundary=boundary, scheme="fused")
    values, start = field.coefficients.values, field.coefficients.start
    through = chords((7, 6, 9), counts(), 0.37)
    return Projection(values, start, field.scheme.stencils[0], through, 0.37, torch.float64)


@pytest.mark.parametrize(
    ("method", "dtype", "boundary"),
    covering(
        product([m for m, given in METHODS.items() if "fused" in given.schemes], STORAGE, ["mirror", "border"]),
        lambda method, dtype, boundary: (method, dtype, boundary),
    ),
)
def test_the_program_finds_what_its_twin_finds(method: str, dtype: torch.dtype, boundary: str) -> None:
    given = projection(method, boundary)
    given = replace(given, coefficients=(100 * given.coefficients).to(dtype))
    plain, fused = (largest(given, implementation=where) for where in ("reference", "cpu"))
    assert len(plain.unique()) > 8
    assert torch.equal(plain == -1, given.chords.count == 0)
    assert torch.equal(plain, fused)


@pytest.mark.parametrize("implementation", ["reference", "cpu"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_along_a_line_of_numbers(implementation: str, dtype: torch.dtype) -> None:
    """Trilinear numbers on the line of their middles: the first of equal ones, none that is NaN or −∞."""
    row = torch.tensor([3.0, 1.0, 7.0, 7.0, math.nan, 2.0, -math.inf, 9.0, 0.0], dtype=dtype)
    expected = {9: 7, 8: 7, 7: 2, 4: 2, 3: 2, 2: 0, 1: 0, 0: -1}
    count = torch.tensor(list(expected))
    coefficients = row.expand(2, 2, 9).contiguous()
    start = torch.zeros(len(count), 3, dtype=torch.float64)
    along = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(len(count), 3)
    offset = torch.full((len(count),), 1.0, dtype=torch.float64)
    stencil = Stencil.jet(METHODS["nearest"].kernel, 0)
    given = Projection(
        coefficients, 0, stencil, Chords(start - 0.5 * along, along, count.double(), offset, count), 1.0, dtype
    )
    assert largest(given, implementation=implementation).tolist() == list(expected.values())
    nothing = replace(given, coefficients=torch.full_like(coefficients, math.nan))
    assert (largest(nothing, implementation=implementation) == -1).all()


def test_threads_and_neighbours_change_nothing() -> None:
    given = projection("triquadratic")
    told: list[int] = []
    whole = largest(given, told.append)
    assert told[-1] == RAYS
    some = torch.arange(3, RAYS, 5)
    assert torch.equal(largest(replace(given, chords=given.chords.at(some))), whole[some])
    torch.set_num_threads(2)
    try:
        assert torch.equal(largest(given), whole)
    finally:
        torch.set_num_threads(1)
