"""What the programs have in common: `run(Job *, i64 thread, i64 most)`, which takes chunks of work until none is left.

`thread` is a number from 0 on, another one for everybody who works on the same job at the same time; after `most`
chunks the function returns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import SimpleNamespace

from llvmlite import ir

from filterlab.ops.cpu.lanes import DOUBLE, I64, POINTER, Lanes, Value

ENTRY = "run"  # name of the compiled function
SHARED = ("next", "met")

_SIGNATURE = ir.FunctionType(ir.VoidType(), [POINTER, I64, I64])


def text(write: Callable[[ir.Function], None]) -> str:
    """A module with the function `run`, whose body is written, as LLVM IR text."""
    module = ir.Module("filterlab")
    function = ir.Function(module, _SIGNATURE, ENTRY)
    function.attributes.add("nounwind")
    write(function)
    return str(module)


def call(builder: ir.IRBuilder, program: Value, job: Value) -> None:
    """One chunk of a job by the program at an address."""
    program.type = ir.PointerType(_SIGNATURE)  # llvmlite wants to know what it calls
    builder.call(program, [job, I64(0), I64(1)])


def load_job(e: Lanes, address: Value, fields: Mapping[str, type]) -> SimpleNamespace:
    """The fields of a job (each of 64 bits), as values; those that threads write (`SHARED`) as addresses."""
    loaded = {}
    for index, (name, ctype) in enumerate(fields.items()):
        kind = {"P": POINTER, "d": DOUBLE}.get(ctype._type_, I64)  # type: ignore[attr-defined]
        where = e.advance(address, I64(index), I64)
        loaded[name] = where if name in SHARED else e.builder.load(where, typ=kind)
    return SimpleNamespace(**loaded)


@contextmanager
def every_chunk(e: Lanes, job: SimpleNamespace) -> Iterator[Value]:
    """while most-- > 0 and (c = next++) < chunks: the with-block, given c."""
    b = e.builder
    most = b.function.args[2]
    before, test, take, work, done = b.block, *(b.append_basic_block(n) for n in ("test", "take", "work", "done"))
    b.branch(test)
    b.position_at_end(test)
    left = b.phi(I64, "left")
    left.add_incoming(most, before)
    b.cbranch(b.icmp_signed(">", left, I64(0)), take, done)
    b.position_at_end(take)
    c = b.atomic_rmw("add", job.next, I64(1), "monotonic")
    b.cbranch(b.icmp_signed("<", c, job.chunks), work, done)
    b.position_at_end(work)
    yield c
    left.add_incoming(b.sub(left, I64(1)), b.block)
    b.branch(test)
    b.position_at_end(done)
