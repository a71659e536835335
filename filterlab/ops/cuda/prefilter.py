"""The prefilter in Triton: describes the samples to the programs of `ops.cuda.recursion`, and launches them.

Same meaning as `ops.reference.prefilter`, any number of poles; one launch per axis. Memory: while an axis is filtered
its samples and its coefficients, so that of a volume the result and one copy. Samples are read as they are stored,
through any strides that view as (lines, length, lines); what lies otherwise is copied first. Never written to.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from filterlab.ops.cuda import recursion
from filterlab.ops.cuda.launch import interpreting, launchable
from filterlab.ops.cuda.recursion import BLOCK, steps_of
from filterlab.ops.prefilter import Filtering
from filterlab.prefilters import Prefilter


def filter_axes(samples: Tensor, how: Filtering) -> Tensor:
    """Coefficients along one axis or all three, of a prefilter with at least one pole; no derivatives.

    Args:
        samples: real, of a dtype of `ops.gather.STORAGE`.
    """
    dtype = torch.promote_types(samples.dtype, torch.float32)
    out = samples.detach().resolve_neg()
    for dim in how.dims:
        out = _along(out, dim, dtype, how)
    return out


def _along(samples: Tensor, dim: int, dtype: torch.dtype, how: Filtering) -> Tensor:
    """One axis, negative."""
    outer, n, inner = samples.shape[:dim], samples.shape[dim], samples.shape[dim:][1:]
    shape = math.prod(outer), n, math.prod(inner)
    out = samples.new_empty((shape[0], n + 2 * how.tail, shape[2]), dtype=dtype)
    if out.numel():
        _launch(samples.reshape(shape), out, how)
    return out.reshape(*outer, out.shape[1], *inner)


def _launch(source: Tensor, target: Tensor, how: Filtering) -> None:
    """From (outer, length, inner) to as many coefficients along the axis in the middle."""
    outer, n, inner = source.shape
    lines, count, decay = outer * inner, target.shape[1], how.prefilter.decay(target.dtype)
    poles = len(how.prefilter.poles)
    before = _stepped(decay + count, poles) - count  # so that the last coefficient ends a step
    behind = _stepped(decay, poles)
    places = how.places(n, before, behind, target.device)
    numbers = _numbers(how.prefilter, behind, target.dtype, target.device)
    arrays = source, target, places, numbers
    sizes = lines, inner, count, before, behind, *source.stride()
    program = _program("rows" if inner == 1 else "columns", poles, interpreting())
    with torch.cuda.device_of(target):  # Triton launches on the current device
        program[(-(-lines // BLOCK),)](*arrays, *sizes, BLOCK=BLOCK, num_warps=BLOCK // 32)


def _stepped(places: int, poles: int) -> int:
    """Up to a whole number of steps."""
    return -(-places // steps_of(poles)) * steps_of(poles)


@lru_cache(maxsize=64)
def _program(lines: str, poles: int, interpreted: bool) -> Any:
    return launchable({"rows": recursion.Rows, "columns": recursion.Columns}[lines](poles).write())


@lru_cache(maxsize=64)
def _numbers(prefilter: Prefilter, behind: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Poles, gain, T and w of `recursion`, as a program reads them."""
    poles = np.array(prefilter.poles)
    numbers = np.concatenate((poles, [np.prod((1 - poles) ** 2)], _turn(poles, behind).ravel()))
    return torch.as_tensor(numbers).to(device, dtype)


def _turn(poles: np.ndarray, behind: int) -> np.ndarray:
    """(poles + behind, poles): T by rows, then w_0, w_1, …: b = T a + Σ_k w_k f_k.

    What goes forwards through every possible state and every possible sample behind the line, one of them 1 and all
    others 0, comes backwards from zero: these are the columns of T and the w.
    """
    count = len(poles)
    a = np.eye(count, count + behind)
    samples = np.eye(behind, count + behind, count)
    passed = [_advance(a, f, poles) for f in samples]
    b = np.zeros_like(a)
    for f in reversed(passed):
        _advance(b, f, poles)
    return np.concatenate((b[:, :count], b[:, count:].T))


def _advance(state: np.ndarray, value: np.ndarray, poles: np.ndarray) -> np.ndarray:
    """One step of all poles, in place; a copy of what the last one has made."""
    for own, pole in zip(state, poles, strict=True):
        own *= pole
        own += value
        value = own
    return value.copy()
