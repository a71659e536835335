"""What computes an op, by the name of the implementation."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from types import ModuleType

import torch

from filterlab import forking


@cache
def driver(implementation: str, op: str) -> ModuleType:
    """The module of that op in that room: "reference", "cpu" (it needs llvmlite) or "cuda" (it needs Triton).

    Imported at its first use, and whole: no fork comes in between.
    """
    with forking.lock:
        return import_module(f"filterlab.ops.{implementation}.{op}")


def room_of(device: torch.device) -> str:
    """The room of programs for tensors on a device: "cuda" for a GPU, else "cpu"."""
    return "cuda" if device.type == "cuda" else "cpu"
