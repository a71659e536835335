"""What a compiled program is told: one struct of 64-bit fields, described once for Python and for the program.

A job holds the arrays whose addresses it has. Whoever works on it, on whatever thread, holds the job: so no memory goes
before the last one is done with it, whatever is raised meanwhile.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Self

import numpy as np
from torch import Tensor

AXES = ("x", "y", "z")

Function = Callable[[int, int, int], None]
"""A program: takes the address of a job, the number of the thread among those that share the job, and how many chunks
to do at most; lets other Python threads run meanwhile."""


class Job(ctypes.Structure):
    """The part that all have; each kind has fields of its own, of eight bytes each, so both sides agree on the layout.

    Attributes:
        next: the chunk to be taken next; threads add 1 atomically.
        chunks: `next` stops here.
        memory: the arrays that it points to, and whatever else.
    """

    next: int
    chunks: int
    memory: tuple[object, ...] = ()

    def point(self, **arrays: Tensor | np.ndarray) -> None:
        """Write where arrays are into the fields of their names, and hold them."""
        for name, array in arrays.items():
            setattr(self, name, array.data_ptr() if isinstance(array, Tensor) else array.ctypes.data)
        self.memory += tuple(arrays.values())

    def call(self, place: Function, placing: Job) -> None:
        """Write where a program and its job are into the fields of their names, and hold them."""
        self.place, self.placing = ctypes.cast(place, ctypes.c_void_p), ctypes.addressof(placing)  # type: ignore[arg-type]
        self.memory += (place, placing)

    def copy(self, **arrays: Tensor | np.ndarray) -> Self:
        """Another job of the same arrays, and of these."""
        other = type(self).from_buffer_copy(self)
        other.memory = self.memory
        other.point(**arrays)
        return other
