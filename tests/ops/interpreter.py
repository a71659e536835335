"""Triton's interpreter without what it does anew for each of some hundred thousand small operations.

Types of blocks and all that follows from them are kept, blocks of one shape are not compared entry by entry, and the
sums in 64 bits that an overflow would show in are left out: `device_assert` does nothing there without `debug`. What is
computed stays what it was, at half of the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest


def hasten(monkeypatch: pytest.MonkeyPatch) -> None:
    """For the time of a test."""
    from triton.language import core
    from triton.language.semantic import TritonSemantic
    from triton.runtime import interpreter

    builder = interpreter.interpreter_builder
    numpy_type, to_ir = interpreter._get_np_dtype, core.block_type.to_ir
    broadcast = TritonSemantic.broadcast_impl_value

    def tensor(self: Any, handle: Any, type: Any) -> None:
        self.handle, self.type, self.dtype = handle, type, type.scalar
        self.shape, self.numel = _kept(type, "_extent", lambda: _extent(core, type))

    def broadcast_impl_value(self: Any, a: Any, b: Any) -> Any:
        if a.type.is_block() and b.type.is_block() and a.type.shape.values == b.type.shape.values:
            return a, b
        return broadcast(self, a, b)

    def with_element_ty(self: Any, scalar: Any) -> Any:
        return _kept(self, f"_of {scalar.name}", lambda: core.block_type(scalar, self.shape))

    monkeypatch.setattr(builder, "options", replace(builder.options, sanitize_overflow=False))
    monkeypatch.setattr(interpreter, "_get_np_dtype", lambda type: _kept(type, "_numpy", lambda: numpy_type(type)))
    monkeypatch.setattr(core.tensor, "__init__", tensor)
    monkeypatch.setattr(core.block_type, "with_element_ty", with_element_ty)
    monkeypatch.setattr(core.block_type, "to_ir", lambda self, to: self if to is builder else to_ir(self, to))
    monkeypatch.setattr(TritonSemantic, "broadcast_impl_value", broadcast_impl_value)


def _kept(of: Any, name: str, make: Callable[[], Any]) -> Any:
    """An attribute, made when it is asked for first."""
    own = of.__dict__
    if name not in own:
        own[name] = make()
    return own[name]


def _extent(core: Any, type: Any) -> tuple[Any, Any]:
    """The shape and the number of elements of a tensor of that type."""
    shape = type.shape if type.is_block() else ()
    return core.tuple([core.constexpr(n) for n in shape]), core.constexpr(math.prod(shape))
