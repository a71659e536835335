"""What the programs have in common: a function `run(Job *)` that takes chunks of work until none is left."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import SimpleNamespace

from llvmlite import ir

from filterlab.ops.cpu.lanes import DOUBLE, I64, POINTER, Lanes, Value

ENTRY = "run"  # name of the compiled function: void run(Job *)


def new_module() -> tuple[ir.Module, ir.Function]:
    """A module with the empty function `run`."""
    module = ir.Module("filterlab")
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [POINTER]), ENTRY)
    function.attributes.add("nounwind")
    return module, function


def load_job(e: Lanes, address: Value, fields: Mapping[str, type]) -> SimpleNamespace:
    """The fields of a job (each of 64 bits), as values; `next` as an address, threads share it."""
    loaded = {}
    for index, (name, ctype) in enumerate(fields.items()):
        kind = {"P": POINTER, "d": DOUBLE}.get(ctype._type_, I64)  # type: ignore[attr-defined]
        where = e.advance(address, I64(index), I64)
        loaded[name] = where if name == "next" else e.builder.load(where, typ=kind)
    return SimpleNamespace(**loaded)


@contextmanager
def every_chunk(e: Lanes, job: SimpleNamespace) -> Iterator[Value]:
    """while (c = next++) < chunks: the with-block, given c."""
    b = e.builder
    take, work, done = (b.append_basic_block(name) for name in ("take", "work", "done"))
    b.branch(take)
    b.position_at_end(take)
    c = b.atomic_rmw("add", job.next, I64(1), "monotonic")
    b.cbranch(b.icmp_signed("<", c, job.chunks), work, done)
    b.position_at_end(work)
    yield c
    b.branch(take)
    b.position_at_end(done)
