"""From a variant to a function that can be called: LLVM through llvmlite, with the result kept on disk.

Compiling takes a few tenths of a second, loading a few milliseconds. What a stored program is found by contains all
that it depends on: the variant, the text of `SOURCES`, LLVM's version, the machine.

LLVM is only used aside (`threads`), one program after the other. There nothing can interrupt it, so that no lock of
LLVM's is left locked and no program is half there; who is interrupted while waiting finds it made the next time. A fork
and the end of Python wait until LLVM is at rest.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import hashlib
from collections.abc import Callable, Hashable, Iterator
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Protocol, TypeVar

from llvmlite import binding as llvm
from llvmlite import ir

from filterlab import forking
from filterlab.ops.cpu import cache as disk
from filterlab.ops.cpu import frame, threads
from filterlab.ops.cpu.job import Function

SOURCES = (
    "ops",
    "arrays.py",
    "bernstein.py",
    "geometry.py",
    "kernels.py",
    "prefilters.py",
    "roots.py",
    "volume.py",
    "world.py",
)
"""Files and folders of filterlab that a program depends on: everything that `ops` imports (a test checks it)."""

_Result = TypeVar("_Result")


class Variant(Hashable, Protocol):
    """A frozen dataclass with everything that a program depends on, apart from the machine."""

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        ...


_programs: dict[Variant, Function] = {}
_signature = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)


def compiled(variant: Variant) -> Function:
    """The program of a variant: from memory, from disk, or compiled now."""
    found = _programs.get(variant)
    return found or _with_llvm(lambda: _made(variant))


def _with_llvm(use: Callable[[], _Result]) -> _Result:
    def alone() -> _Result:
        with forking.gate:
            pass
        with forking.lock:
            return use()

    return threads.aside(alone)


def _made(variant: Variant) -> Function:
    if variant not in _programs:  # two threads that ask for one program make it once
        name = hashlib.sha256(repr((variant, _surroundings())).encode()).hexdigest()[:40] + ".o"
        code = disk.read(name)
        if code is None:
            code = _compile(variant)
            disk.write(name, code)
        _programs[variant] = _load(code)
    return _programs[variant]


@cache
def features() -> frozenset[str]:
    """What this processor can do, in LLVM's words: "avx2", "fma", "neon", …"""
    return _with_llvm(lambda: frozenset(name for name, present in llvm.get_host_cpu_features().items() if present))


@cache
def _surroundings() -> tuple[object, ...]:
    text = hashlib.sha256()
    for path, source in _files(resources.files("filterlab")):
        text.update(f"{path}\0".encode() + hashlib.sha256(source.read_bytes()).digest())
    cpu = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten(), llvm.get_process_triple()
    return text.hexdigest(), llvm.llvm_version_info, cpu


def _files(package: Traversable) -> Iterator[tuple[str, Traversable]]:
    """The files of `SOURCES`, in order, each with its path in the package."""
    left = [(name, package / name) for name in reversed(SOURCES)]
    while left:
        path, found = left.pop()
        if found.is_file():
            yield path, found
        elif found.name != "__pycache__":
            left += sorted(((f"{path}/{f.name}", f) for f in found.iterdir()), reverse=True)


def _machine() -> llvm.TargetMachine:
    """Code finds its constants by addresses of 64 bits: LLVM loads both wherever there is room, and where that is more
    than 2 GiB apart, beyond and before a large volume, it would end the process. On ARM llvmlite loads them together.
    """
    x86 = llvm.get_process_triple().startswith(("x86_64", "amd64"))
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        reloc="pic",
        codemodel="large" if x86 else "small",
        jit=True,
    )


_PASSES = (
    "sroa",
    "simplify_cfg",
    "instruction_combine",
    "reassociate",
    "new_gvn",
    "loop_rotate",
    "dead_store_elimination",
    "simplify_cfg",
    "instruction_combine",
)
"""What LLVM does before it chooses instructions: of the passes of -O2 those that change our programs.

Measured: 0.29 of the time of the passes of -O2, and as fast code: 35 kinds of work take 0.986 of their time in mean.
Sums are rounded alike, but for those of SLIM surfaces and of jets of heights, where the last bit may differ.
"""


def _compile(variant: Variant) -> bytes:
    """An object file. Our programs have vectors and loops as they should be: LLVM shall not rearrange them."""
    machine = _machine()
    module = llvm.parse_assembly(frame.text(variant.write))
    module.triple = machine.triple
    module.verify()
    passes = llvm.create_new_module_pass_manager()
    for name in _PASSES:
        getattr(passes, f"add_{name}_pass")()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    return machine.emit_object(module)


def _load(code: bytes) -> Function:
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    function = _signature(engine.get_function_address(frame.ENTRY))
    function.owner = engine  # type: ignore[attr-defined]  # of the machine code: it lives as long as who calls it
    return function


# --- forks and the end ------------------------------------------------------------------------------------------------


if hasattr(llvm.ffi.lib, "_lock"):  # llvmlite's own, which others who use it may hold
    forking.others.append(llvm.ffi.lib._lock)


@atexit.register
def _finish() -> None:
    """Programs of the C library end LLVM when the process does: not while a thread is in the middle of it."""
    while True:
        with contextlib.suppress(BaseException):
            forking.lock.acquire()
            return
