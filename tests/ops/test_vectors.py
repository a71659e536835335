"""Facts about vectors: both ways against a loop over numbers."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from filterlab.ops.cpu import vectors as cpu
from filterlab.ops.differentiable import vectors
from filterlab.ops.reference import vectors as reference

ROOMS = pytest.mark.parametrize("room", [reference, cpu], ids=["reference", "cpu"])
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
COUNT = 4096 * 3 + 5  # several chunks, and a pack that is not whole


def some(dtype: torch.dtype, count: int = COUNT) -> Tensor:
    return torch.randn(count, 3, dtype=dtype).clamp(-4, 4)


@ROOMS
@DTYPES
@pytest.mark.parametrize("place", [0, 4095, 4096, COUNT - 5, COUNT - 1])
@pytest.mark.parametrize("component", range(3))
def test_the_greatest_is_found_wherever_it_is_and_whatever_its_sign(room, dtype, place, component):
    x = some(dtype)
    x[place, component] = -5.5
    assert room.facts(x) == (5.5, False)


@ROOMS
@DTYPES
@pytest.mark.parametrize("place", [0, 4097, COUNT - 1])
def test_a_vector_is_0_where_all_its_components_are(room, dtype, place):
    x = some(dtype)
    x[place] = torch.tensor([0.0, -0.0, 0.0])
    x[place - 1, :2] = 0
    assert room.facts(x).none
    x[place, 1] = torch.finfo(dtype).smallest_normal / 4  # too small to be normal, and not 0
    assert not room.facts(x).none


@ROOMS
@DTYPES
@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, -math.nan])
def test_one_number_that_is_not_finite_is_told(room, dtype, value):
    x = some(dtype)
    assert room.facts(x).finite
    x[COUNT - 3, 1] = value
    assert not room.facts(x).finite
    assert not room.facts(x).none


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_find_the_same(threads):
    x = torch.arange(1.0, 3 * 200_000 + 1).reshape(-1, 3)
    torch.set_num_threads(threads)
    try:
        assert cpu.facts(x) == reference.facts(x) == (600_000, False)
    finally:
        torch.set_num_threads(1)


def test_what_cannot_be_read_as_it_lies_is_looked_at_by_torch(monkeypatch):
    asked = []
    monkeypatch.setattr(vectors, "driver", lambda *room: asked.append(room) or cpu)
    whole = some(torch.float32)
    for x in (whole.half(), whole[::2], whole[:5], whole.T.contiguous().T, some(torch.float32)[:0]):
        assert vectors.facts(x) == reference.facts(x)
    assert not asked
    assert vectors.facts(whole) == reference.facts(whole)
    assert asked == [("cpu", "vectors")]
