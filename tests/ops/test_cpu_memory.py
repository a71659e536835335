"""The fused kernels touch nothing outside their arrays: each ends, then begins, at a page that may not be touched.

The checks run in a process of their own: a violation kills it.
"""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

GUARDED = r'''
import ctypes, itertools, mmap
import torch

PAGE = mmap.PAGESIZE
libc = ctypes.CDLL(None, use_errno=True)
keep = []

def guarded(tensor, at_end):
    """A copy between two pages without access, touching the second (at_end) or the first."""
    size = tensor.numel() * tensor.element_size()
    inner = -(-size // PAGE) * PAGE
    region = mmap.mmap(-1, inner + 2 * PAGE)
    address = ctypes.addressof(ctypes.c_char.from_buffer(region))
    offset = PAGE + (inner - size if at_end else 0)
    copy = torch.frombuffer(region, dtype=tensor.dtype, count=tensor.numel(), offset=offset).reshape(tensor.shape)
    copy.copy_(tensor)
    for page in (address, address + PAGE + inner):
        assert libc.mprotect(ctypes.c_void_p(page), ctypes.c_size_t(PAGE), 0) == 0
    keep.append(region)
    return copy

torch.manual_seed(0)
'''

POINTS = r"""
from filterlab.fields.ncrsi import NCRSI_TERMS
from filterlab.fields.tensor_product import Direct
from filterlab.kernels import CATMULL_ROM, LINEAR, bspline
from filterlab.ops import Stencil, gather
from filterlab.ops.cpu import threads
from filterlab.ops.cpu.gather import Program
from filterlab.ops.gather import MAX_ORDER

wild = torch.tensor([0.0, -0.0, 1e30, -1e30, float("inf"), -float("inf"), float("nan"), 3e9, -3e9, 1e10, 2**31, -2**31,
                     2**24, 6.5, 1e-45])
jets = [(LINEAR,) * 3, (bspline(2),) * 3, (bspline(5),) * 3, (bspline(0), CATMULL_ROM, bspline(4))]
ncrsi = [Direct(NCRSI_TERMS, "fused", gradient).stencils[1] for gradient in ("central", "analytic")]
types = [(torch.float32, torch.float32), (torch.float64, torch.float64), (torch.float32, torch.uint8)]
stencils = [Stencil.jet(kernels, 1) for kernels in jets] + ncrsi
cases = [(stencil, types[(i + j) % 3]) for i, stencil in enumerate(stencils) for j in (0, 1)]  # each type four times
for stencil, (dtype, stored) in cases:
    shape = tuple(support + 1 for support in stencil.supports[::-1])
    for at_end in (True, False):
        for m in (1, 3, 8, 13):
            points = torch.rand(2, m, 3, dtype=dtype) * 12 - 3
            choose = torch.rand(2, m, 3) < 0.4
            points = torch.where(choose, wild[torch.randint(len(wild), (2, m, 3))].to(dtype), points)
            points = guarded(points, at_end)
            coefficients = guarded((torch.rand(2, 2, *shape) * 100).to(stored), at_end)
            rows = guarded(torch.full((2, 2, 4, m), 7, dtype=dtype), at_end)
            program = Program.of("gather", coefficients, stencil, 0, dtype)
            threads.run(program.run, program.shared(coefficients, points, rows))
            expected = gather(coefficients, points, stencil)
            fine = ((points > -50) & (points < 50)).all(-1)[:, None, None].expand_as(rows)
            assert torch.allclose(rows[fine], expected[fine], rtol=1e-3, atol=1e-2 * float(expected[fine].abs().sum()))
            derivatives, raised = stencil.derivatives
            if derivatives.order <= MAX_ORDER:
                gradient = guarded(torch.full((2, m, 3), 7, dtype=dtype), at_end)
                pull = Program.of("pull", coefficients, derivatives, 0, dtype, raised)
                threads.run(pull.run, pull.shared(coefficients, points, rows, gradient=gradient))
            if stored == dtype:  # into volumes with room for one number behind them
                room = guarded(torch.zeros(coefficients.numel() + 1, dtype=dtype), at_end)
                target = room[:-1].view_as(coefficients)
                program = Program.of("scatter", target, stencil, 0, dtype)
                threads.run(program.run, program.divided([target], points, rows))
                assert room[-1] == 0
print("points touched nothing outside")
"""

MARCH = r"""
from dataclasses import replace

from filterlab.kernels import bspline
from filterlab.ops import Stencil
from filterlab.ops.cpu.memory import has_room
from filterlab.ops.differentiable import march as op
from filterlab.ops.march import Chords, March, Transfer

inside = torch.rand(40, 3, dtype=torch.float64) * 3 + 0.6
inside[:2] = torch.tensor([[0.5] * 3, [3.5] * 3])
entry = torch.cat((inside, torch.tensor([[1e30, -1e30, 3.0], [torch.nan, 1.0, torch.inf], [-3e9, 2.0**31, 1e10]])))
entry = guarded(entry, True)
direction = torch.nn.functional.normalize(2.0 - entry.nan_to_num(0).clamp(-9, 9) + 1e-3, dim=-1)
rays = len(entry)
length = torch.full((rays,), 2.0, dtype=torch.float64)
x = torch.linspace(0, 1, 5)
single, double = torch.float32, torch.float64
types = (single, single), (single, torch.uint8), (double, double), (double, single)
for (dtype, stored), at_end, room in itertools.product(types, (True, False), (0, 1)):
    samples = torch.rand(5 * 5 * 5 + room).mul(1 if stored.is_floating_point else 100).to(stored)
    volume = guarded(samples, at_end)[:125].view(5, 5, 5)
    assert has_room(volume) == bool(room)
    tables = Transfer(x.to(dtype), torch.rand(5, 3, dtype=dtype), x.to(dtype) / 3, 1.0)
    own = Chords(entry, direction, length, torch.ones_like(length), torch.full((rays,), 40))
    march = March(volume, 0, Stencil.jet((bspline(2),) * 3, 0), own, tables, None, 0.05)
    light, depth = op.run(march)
    expected, _ = op.run(replace(march, coefficients=samples[:125].view(5, 5, 5).clone()))
    assert torch.equal(light[:40], expected[:40])
    assert light[:40].isfinite().all() and light[:40].max() > 0.1
    op.adjoint(march, light, torch.ones_like(light), torch.ones_like(depth), ("coefficients", "rays", "table"))
print("the march touched nothing outside")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="guard pages are made with mprotect")
def test_nothing_outside_the_arrays_is_touched(forks: None) -> None:
    result = subprocess.run(
        [sys.executable, "-c", GUARDED + POINTS + MARCH],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, f"exit status {result.returncode} after {result.stdout!r}: {result.stderr}"
    assert result.stdout.splitlines() == ["points touched nothing outside", "the march touched nothing outside"]
