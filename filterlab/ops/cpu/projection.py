"""The largest sample along rays as vector code: describes rays to the program of `ops.cpu.largest`."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu.largest import LargestJob, LargestVariant
from filterlab.ops.cpu.machine import lanes_of
from filterlab.ops.cpu.march import in_blocks, lie
from filterlab.ops.cpu.memory import ARITHMETIC, has_room
from filterlab.ops.gather import STORAGE
from filterlab.ops.projection import Projection


def largest(given: Projection, report: Callable[[int], None] = lambda rays: None) -> Tensor:
    """`ops.reference.projection.largest`, fused."""
    numbers = torch.empty_like(given.chords.count)
    if len(numbers):
        coefficients = given.coefficients.detach().resolve_neg().contiguous()
        job = LargestJob(step=given.step, per_unit=1.0, opaque=math.inf)
        lie(job, coefficients, given.start, given.stencil)
        rays = {name: x.detach().contiguous() for name, x in vars(given.chords).items()}
        job.point(coefficients=coefficients, largest=numbers, **rays)
        in_blocks(compiler.compiled(_variant(given, coefficients)), job, len(numbers), report)
    return numbers


def _variant(given: Projection, coefficients: Tensor) -> LargestVariant:
    return LargestVariant(
        given.stencil.up_to(0).lowered,
        ARITHMETIC[given.dtype],
        STORAGE[coefficients.dtype],
        has_room(coefficients),
        lanes_of(given.dtype),
    )
