"""What a compiled kernel is told: one struct of 64-bit fields, described once for Python and for the program."""

from __future__ import annotations

import ctypes

AXES = ("x", "y", "z")

# name: ctypes type. Strides are in elements, every field has eight bytes, so both sides agree on the layout.
FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next; threads add 1 atomically
    "coefficients": ctypes.c_void_p,  # (N, C, D, H, W); read by gather, added to by scatter
    "points": ctypes.c_void_p,  # (N, M, 3)
    "rows": ctypes.c_void_p,  # (N, C, J, M); written by gather, read by scatter and pull
    "gradient": ctypes.c_void_p,  # (N, M, 3); written by pull
    "channels": ctypes.c_int64,  # C
    "count": ctypes.c_int64,  # M, points of one batch entry
    "width": ctypes.c_int64,  # W
    "height": ctypes.c_int64,  # H
    "start": ctypes.c_int64,  # coordinate of coefficient 0
    **{f"low_{a}": ctypes.c_double for a in AXES},  # smallest and largest coordinate of a first tap
    **{f"high_{a}": ctypes.c_double for a in AXES},
    "coefficients_entry": ctypes.c_int64,  # strides: from one batch entry to the next,
    "coefficients_channel": ctypes.c_int64,  # from one channel to the next,
    "points_entry": ctypes.c_int64,
    "chunk": ctypes.c_int64,  # packs of a chunk
    "entries": ctypes.c_int64,  # N; chunk c is part c // N of batch entry c % N
    "chunks": ctypes.c_int64,  # `next` stops here
}


class Job(ctypes.Structure):
    _fields_ = list(FIELDS.items())
