"""Mutations: valid bytes, a little damaged. What the fuzzing of files and of configurations is made of.

An edit is data, so that a generator of random numbers (here) or a searching tool (in the tests) may choose it, and so
that a case can be told again from its seed.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

Kind = Literal["set", "insert", "delete", "cut", "number", "repeat"]
KINDS: tuple[Kind, ...] = ("set", "insert", "delete", "cut", "number", "repeat")

# numbers at which programs go wrong, as text and as binary words of 1, 2, 4 and 8 bytes in both orders
_WHOLE = (0, 1, -1, 2, 3, 7, 127, 128, 255, 256, 32767, 32768, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1, 2**32)
_WHOLE += (2**63 - 1, 2**63, 10**18, -(2**31), -(2**63))
NUMBERS = (
    *(str(n).encode() for n in _WHOLE),
    b"",
    b"nan",
    b"inf",
    b"-inf",
    b"1e999",
    b"1e-999",
    b"1e308",
    b"0.5",
    b"-0",
)
NUMBERS += (b"9" * 400, b"0x10", b"1_0", b"none", b"(1,2)", b"[1, 2]")
WORDS = tuple(
    dict.fromkeys(
        n.to_bytes(width, order, signed=n < 0)
        for n in _WHOLE
        for width in (1, 2, 4, 8)
        for order in ("little", "big")
        if -(2 ** (8 * width - 1)) <= n < 2 ** (8 * width)
    )
) + tuple(
    struct.pack(f"{order}{kind}", x) for x in (np.nan, np.inf, 1e30, -1.0, 0.5) for order in "<>" for kind in "fd"
)

_NUMBER = re.compile(rb"[-+]?[0-9][0-9.eE+-]*")
_TEXT_HEADER = 4096  # bytes in which numbers are looked for


@dataclass(frozen=True)
class Edit:
    """One change of some bytes.

    Attributes:
        kind: overwrite with the patch; insert it; delete as many bytes; cut off the rest; replace a decimal number of
            the text by the patch; repeat as many bytes as the patch has, once more in place.
        where: 0 … 1: which place or which number; places near the front are more frequent, headers are there.
        patch: bytes.
    """

    kind: Kind
    where: float
    patch: bytes


def edited(content: bytes, edits: Sequence[Edit]) -> bytes:
    """The content with one edit made after the other."""
    data = bytearray(content)
    for edit in edits:
        at, end = _place(data, edit)
        match edit.kind:
            case "insert":
                data[at:at] = edit.patch
            case "delete" | "cut":
                del data[at:end]
            case "repeat":
                data[at:at] = data[at:end]
            case _:
                data[at:end] = edit.patch
    return bytes(data)


def _place(data: bytearray, edit: Edit) -> tuple[int, int]:
    """The bytes that an edit is about, from and to."""
    if edit.kind == "number":
        found = [match.span() for match in _NUMBER.finditer(data[:_TEXT_HEADER])]
        if found:
            return found[min(int(edit.where * len(found)), len(found) - 1)]
    at = int(edit.where**2 * len(data))
    return at, len(data) if edit.kind == "cut" else at + len(edit.patch)


def random_edits(rng: np.random.Generator) -> list[Edit]:
    """One to three edits; in half of the cases bytes are only overwritten, so that lengths go on to agree."""
    kinds = KINDS if rng.random() < 0.5 else KINDS[:1]
    return [_random_edit(rng, kinds) for _ in range(int(rng.integers(1, 4)))]


def _random_edit(rng: np.random.Generator, kinds: Sequence[Kind]) -> Edit:
    kind = kinds[int(rng.integers(len(kinds)))]
    patch = rng.bytes(int(rng.integers(1, 30 if kind in ("delete", "repeat") else 7)))
    if kind == "number":
        patch = NUMBERS[int(rng.integers(len(NUMBERS)))]
    elif kind in ("set", "insert") and rng.random() < 0.5:
        patch = WORDS[int(rng.integers(len(WORDS)))]
    return Edit(kind, float(rng.random()), patch)
