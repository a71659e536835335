"""What the machine is: its processor, what it can do, and the versions of what ran on it. No names, no folders."""

from __future__ import annotations

import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from benchmarks.harness import usable_cores
from benchmarks.peers import drjit_texture
from benchmarks.records import Machine
from filterlab.ops.cpu.compiler import features

_TOLD = ("sse4.2", "avx", "avx2", "fma", "f16c", "avx512f", "avx512vl", "avx512bw", "avx512dq", "neon", "sve")
_PACKAGES = ("filterlab", "torch", "numpy", "llvmlite", "scipy", "torch-interpol", "drjit", "mitsuba", "embreex", "vtk")
_ABSENT = "not installed"
_OF_GPU = ("triton", "cupy-cuda12x", "cupy-cuda13x")


def describe() -> Machine:
    """The machine this runs on."""
    from llvmlite import binding as llvm

    return Machine(
        cpu=_cpu_name(),
        llvm_cpu=llvm.get_host_cpu_name(),
        features=tuple(name for name in _TOLD if name in features()),
        cores=os.cpu_count() or 1,
        usable_cores=usable_cores(),
        system=f"{platform.system()} {platform.machine()}",
        versions={
            "python": platform.python_version(),
            **{name: _version(name) for name in _PACKAGES},
            **{name: v for name in _OF_GPU if torch.cuda.is_available() and (v := _version(name)) != _ABSENT},
            **({} if drjit_texture.missing() else {"LLVM of Dr.Jit": drjit_texture.llvm_version()}),
        },
        gpu=torch.cuda.get_device_name() if torch.cuda.is_available() else "",
    )


def _cpu_name() -> str:
    if sys.platform == "linux":
        try:
            lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        except OSError:
            lines = []
        for line in lines:
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return " ".join(value.split())
    return platform.processor() or platform.machine()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return _ABSENT
