"""What computes an op, by the name of the implementation."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from types import ModuleType

from filterlab import forking


@cache
def driver(implementation: str, op: str) -> ModuleType:
    """The module of that op in that room: "reference", "cpu" (it needs llvmlite) or "cuda" (it needs Triton).

    Imported at its first use, and whole: no fork comes in between.
    """
    with forking.lock:
        return import_module(f"filterlab.ops.{implementation}.{op}")
