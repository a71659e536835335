"""How a program written as text becomes something that can be launched. The one module that imports Triton."""

from __future__ import annotations

import hashlib
import linecache
from functools import cache
from typing import Any

import triton as _triton  # type: ignore[import-not-found]
import triton.language as tl  # type: ignore[import-not-found]

from filterlab.ops.cuda.source import Source

triton: Any = _triton  # it comes without types


def interpreting() -> bool:
    """True when programs are to run in Triton's interpreter, on tensors of the CPU (TRITON_INTERPRET=1)."""
    return bool(triton.knobs.runtime.interpret)


def launchable(source: Source) -> Any:
    """The program as Triton launches it: `launchable(source)[grid](*arguments)`.

    Triton reads the source of the function that it compiles. That of ours is kept in `linecache`, where Python looks
    for the lines of code that has no file. Sizes and strides are not built into the machine code: one compilation
    serves arrays of any shape.
    """
    return _launchable(source.name, str(source), interpreting())


def _either(a, b):
    """What programs reduce truth with, as `either`."""
    return a | b


@cache
def _launchable(name: str, text: str, interpreted: bool) -> Any:
    file = f"<filterlab {name} {hashlib.sha256(text.encode()).hexdigest()[:16]}>"
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    # the interpreter calls a function for every number, but for some that it knows
    either = tl.standard._elementwise_max if interpreted else triton.jit(_either)
    namespace: dict[str, Any] = {"tl": tl, "either": either, "__name__": __name__}
    exec(compile(text, file, "exec"), namespace)
    function = namespace[name]
    parameters = function.__code__.co_varnames[: function.__code__.co_argcount]
    return triton.jit(function, do_not_specialize=[p for p in parameters if not p.isupper()])
