"""Measurements that need a process of their own: peak memory, and the first call of a kernel.

`measured` starts `python -m benchmarks.probe NAME ARGUMENTS` and reads the line of JSON that it prints.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

LIMIT = 1200  # seconds


class ProbeError(RuntimeError):
    """The process failed."""


def measured(name: str, environment: Mapping[str, str] | None = None, **arguments: Any) -> dict[str, float]:
    """What the measurement of that name finds in a fresh process.

    Raises:
        ProbeError: it ended with an error; the message has its last line.
    """
    paths = os.pathsep.join([str(Path(__file__).resolve().parents[1]), *filter(None, sys.path)])
    inherited = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}  # else every import compiles
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.probe", name, json.dumps(arguments)],
        env={**inherited, "PYTHONPATH": paths, **(environment or {})},
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    if done.returncode:
        raise ProbeError(f"{name}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    return json.loads(done.stdout.splitlines()[-1])


def memory(threads: int, voxels: int, size: int, steps: int) -> dict[str, float]:
    """Peak bytes before and after an image of `steps` steps a ray and its gradients."""
    import torch

    torch.set_num_threads(threads)
    _image_and_gradients(voxels, 2, 4)  # whatever is loaded, compiled and pooled at first use
    before = _peak()
    _image_and_gradients(voxels, size, steps)
    return {"before": before, "peak": _peak()}


def _image_and_gradients(voxels: int, size: int, steps: int) -> None:
    """Seen along an axis, so that every ray takes as many steps."""
    import torch

    from benchmarks.scene import marschner_lobb
    from filterlab.render import OrthographicCamera, render

    scene = marschner_lobb(voxels, size)
    scene = replace(scene, volume=scene.volume.requires_grad_(), table=scene.table.requires_grad_())
    center = (voxels - 1) / 2
    camera = OrthographicCamera(position=(center, -voxels, center), target=(center,) * 3, height=0.9 * voxels)
    field = scene.field("triquadratic", "fused")
    image = render(field, camera, scene.transfer, size=(size, size), step=voxels / steps, shading=scene.shading)
    torch.autograd.grad(image.mean(), (scene.volume, scene.table))


def casting_memory(threads: int, voxels: int, size: int) -> dict[str, float]:
    """Peak bytes before and after the first picture of a level set: bounds, hits and normals of size² rays."""
    import torch

    from benchmarks.level_sets import hits_and_normals, surface_of, task_of
    from benchmarks.settings import Settings

    torch.set_num_threads(threads)
    small = task_of(Settings(), 8, 8)
    hits_and_normals(surface_of(small, "triquadratic"), small.origins, small.directions)  # loaded and compiled
    task = task_of(Settings(), size, voxels)
    surface = surface_of(task, "triquadratic")
    before = _peak()
    hits_and_normals(surface, task.origins, task.directions)
    return {"before": before, "peak": _peak()}


def _peak() -> float:
    """The most memory this process has had, in bytes."""
    if sys.platform == "linux":  # ru_maxrss would be that of the process that started this one, where that had more
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return 1024.0 * int(status.split("VmHWM:")[1].split()[0])
    import resource

    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)  # bytes on macOS


def steadiness(threads: int, voxels: int, size: int, renders: int) -> dict[str, float]:
    """Seconds of the slowest and the median of so many renders; CPU seconds of one whose threads all share a core.

    A scheduler may put threads on one core, as others want the rest. Whoever waits for them by spinning shows in the
    CPU time then, whatever else the machine does. `busy`: CPU ÷ wall-clock time; less than `threads` where others work.
    """
    import torch

    from benchmarks.scene import marschner_lobb

    torch.set_num_threads(threads)
    scene = marschner_lobb(voxels, size)
    field = scene.field("triquadratic", "fused")
    for _ in range(3):
        scene.image(field)
    times = [_seconds(scene.image, field) for _ in range(renders)]
    wall = statistics.median(t for t, _ in times)
    found = {
        "slowest": max(t for t, _ in times),
        "median": wall,
        "busy": sum(cpu for _, cpu in times) / sum(t for t, _ in times),
    }
    if sys.platform == "linux":
        for task in os.listdir("/proc/self/task"):
            os.sched_setaffinity(int(task), {min(os.sched_getaffinity(0))})
        found["packed"] = statistics.median(_seconds(scene.image, field)[1] for _ in range(5))
        torch.set_num_threads(1)
        found["alone"] = statistics.median(_seconds(scene.image, field)[1] for _ in range(5))
    return found


def _seconds(call: Callable[..., object], *arguments: object) -> tuple[float, float]:
    """Of the wall clock, and of the CPU."""
    wall, cpu = time.perf_counter(), time.process_time()
    call(*arguments)
    return time.perf_counter() - wall, time.process_time() - cpu


def first_call(methods: list[str]) -> dict[str, float]:
    """Seconds of the first value and gradient of each fused kernel, one after the other, and of another of the last."""
    import torch

    from benchmarks.workloads import terms_of
    from filterlab import ops

    torch.set_num_threads(1)
    coefficients, points = torch.rand(1, 1, 8, 8, 8), torch.full((1, 16, 3), 3.5)

    def call(method: str) -> float:
        (term,) = terms_of(method)
        start = time.perf_counter()
        ops.jet(coefficients, points, term.kernels, 1, 0, "cpu")
        return time.perf_counter() - start

    return {method: call(method) for method in methods} | {"again": call(methods[-1])}


def torch_compile(threads: int, method: str | None) -> dict[str, float]:
    """CPU seconds of the first call, and its derivatives, of what torch.compile is given, with all that it starts.

    Given a step that trains an `nn.Reconstruction` by that method; without one, the sum of sines, the least that torch
    itself takes.
    """
    import torch

    torch.set_num_threads(threads)
    points = 31 * torch.rand(4096, 3)
    if method is None:
        samples = torch.rand(32, 32, 32, requires_grad=True)
        step = torch.compile(lambda: samples.sin().sum(), fullgraph=True)
    else:
        from filterlab.nn import Reconstruction

        module = Reconstruction((32, 32, 32), method)

        def loss() -> torch.Tensor:
            value, gradient = module.value_and_gradient(points)
            return value.sin().sum() + gradient.square().sum()

        loss().backward()  # machine code is compiled
        step = torch.compile(loss, fullgraph=True)
    before = _cpu_with_children()
    step().backward()
    return {"seconds": _cpu_with_children() - before}


def _cpu_with_children() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


if __name__ == "__main__":
    probes = {f.__name__: f for f in (memory, casting_memory, steadiness, first_call, torch_compile)}
    print(json.dumps(probes[sys.argv[1]](**json.loads(sys.argv[2]))))
