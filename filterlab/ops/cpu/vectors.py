"""Facts about vectors by a program: describes them to that of `ops.cpu.vector_bits`, and runs it."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.machine import lanes_of, threads_for
from filterlab.ops.cpu.memory import ARITHMETIC
from filterlab.ops.cpu.vector_bits import VectorJob, VectorVariant
from filterlab.ops.vectors import Facts

_CHUNK = 4096
_ROWS_PER_THREAD = 32768  # fewer are not worth waking a thread for


def facts(vectors: Tensor) -> Facts:
    """`ops.reference.vectors.facts`, fused; of contiguous vectors (..., 3) of float32 or float64, P at least."""
    rows, arithmetic = vectors.numel() // 3, ARITHMETIC[vectors.dtype]
    program = compiler.compiled(VectorVariant(arithmetic, lanes_of(vectors.dtype)))
    found = np.array((0, np.iinfo(np.int64).max))
    job = VectorJob(rows=rows, chunk=_CHUNK, chunks=-(-rows // _CHUNK))
    job.point(vectors=vectors.detach(), found=found)
    pool.run(program, [job] * threads_for(rows, _ROWS_PER_THREAD))
    greatest = found[:1].astype(f"i{vectors.itemsize}").view(arithmetic)
    return Facts(float(greatest[0]), not found[1])
