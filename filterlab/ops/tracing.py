"""What torch.compile is told of this package's functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

_Function = TypeVar("_Function", bound=Callable[..., Any])


def constant(function: _Function) -> _Function:
    """Marks a function that is called while torch.compile traces, and whose result is written into the graph.

    As `torch.compiler.assume_constant_result`, which imports torch's compiler: as long as torch itself takes.
    """
    function._dynamo_marked_constant = True  # type: ignore[attr-defined]
    return function
