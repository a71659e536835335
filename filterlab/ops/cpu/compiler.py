"""From a recipe to a function that can be called: LLVM through llvmlite, with the result kept on disk.

Compiling takes a few tenths of a second, loading a few milliseconds. What a stored kernel is found by contains all that
it depends on: the recipe, the text of this package, LLVM's version, the machine.
"""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Callable, Hashable
from functools import cache
from importlib import resources
from threading import RLock
from typing import Protocol

from llvmlite import binding as llvm

from filterlab.ops.cpu import cache as disk
from filterlab.ops.cpu.frame import ENTRY

Function = Callable[[int], None]
"""Takes the address of a `Job` and works until its chunks are used up; lets other Python threads run meanwhile."""


class Recipe(Hashable, Protocol):
    """A frozen dataclass with everything that a program depends on, apart from the machine."""

    def generate(self) -> str:
        """The program as LLVM IR text, with the entry point `frame.ENTRY`."""
        ...


_lock = RLock()
_engines: list[llvm.ExecutionEngine] = []  # they own the machine code


def compiled(recipe: Recipe) -> Function:
    """The kernel of a recipe: from memory, from disk, or compiled now."""
    with _lock:  # two threads asking for one kernel compile it once
        return _compiled(recipe)


@cache
def _compiled(recipe: Recipe) -> Function:
    name = hashlib.sha256(repr((recipe, _surroundings())).encode()).hexdigest()[:40] + ".o"
    code = disk.read(name)
    if code is None:
        code = _compile(recipe)
        disk.write(name, code)
    return _load(code)


@cache
def features() -> frozenset[str]:
    """What this processor can do, in LLVM's words: "avx2", "fma", "neon", …"""
    return frozenset(name for name, present in llvm.get_host_cpu_features().items() if present)


@cache
def _surroundings() -> tuple[object, ...]:
    sources = [s for s in resources.files("filterlab.ops.cpu").iterdir() if s.name.endswith(".py")]
    text = b"".join(source.read_bytes() for source in sorted(sources, key=lambda s: s.name))
    cpu = llvm.get_host_cpu_name(), sorted(features()), llvm.get_process_triple()
    return hashlib.sha256(text).hexdigest(), llvm.llvm_version_info, cpu


def _machine() -> llvm.TargetMachine:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        reloc="pic",
        codemodel="small",
        jit=True,
    )


def _compile(recipe: Recipe) -> bytes:
    """An object file. Our programs have vectors and loops as they should be: LLVM shall not rearrange them."""
    machine = _machine()
    module = llvm.parse_assembly(recipe.generate())
    module.triple = machine.triple
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.loop_vectorization = options.slp_vectorization = options.loop_unrolling = False
    llvm.create_pass_builder(machine, options).getModulePassManager().run(
        module, llvm.create_pass_builder(machine, options)
    )
    return machine.emit_object(module)


def _load(code: bytes) -> Function:
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _engines.append(engine)
    return ctypes.CFUNCTYPE(None, ctypes.c_void_p)(engine.get_function_address(ENTRY))
