"""Calls that are interrupted at random moments, as by Ctrl-C, and what comes of the next ones.

An alarm raises KeyboardInterrupt wherever Python happens to be within a call; every other time in bursts, so that what
an interrupt sets off is interrupted too. Then the call is made once more, undisturbed: it must give the bits that it
gave before any interrupt. Now and then a process ends right behind an interrupt, while threads may still be at work.

    python -m experiments.extremes.interrupts COUNT SEED [WORK …]      prints what came of it as JSON
"""

from __future__ import annotations

import faulthandler
import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import mkdtemp
from types import FrameType

import torch
from torch import Tensor

import filterlab as fl
from experiments.extremes.killing import ENDINGS
from filterlab import ops
from filterlab.io import load_volume, save_volume
from filterlab.kernels import bspline
from filterlab.ops.cpu import cache, compiler
from filterlab.ops.cpu import gather as driver
from filterlab.ops.cpu.threads import aside
from filterlab.ops.differentiable.prefilter import prefilter_samples
from filterlab.render import PerspectiveCamera, Shading, TransferFunction, render

THREADS = 8  # at most
SILENCE = 60.0  # seconds; a call that takes longer hangs: the process tells where, and ends
_EXITS = 25  # one process ends behind so many interrupts
_AGAIN = 0.02  # seconds; an interrupt that was swallowed (in a `__del__`) comes again
_POINTS = 40_000
_PROGRAMS = "programs"  # where they are kept

Call = Callable[[], list[Tensor]]


@dataclass
class Interrupted:
    """What came of it.

    Attributes:
        interrupts: how many arrived, by work.
        ends: how many processes were ended behind one.
        latest: seconds from an interrupt to its arrival, the most, by work.
        findings: what must not be.
    """

    interrupts: dict[str, int] = field(default_factory=dict)
    ends: int = 0
    latest: dict[str, float] = field(default_factory=dict)
    findings: list[str] = field(default_factory=list)


# --- what is interrupted ----------------------------------------------------------------------------------------------


def works(folder: Path) -> dict[str, Call]:
    """Name -> a call of some milliseconds that returns what can be compared."""
    torch.manual_seed(0)
    samples = torch.rand(40, 40, 40)
    scattered = torch.rand(_POINTS, 3) * 39  # these are sorted first
    points = scattered.sort(0).values
    located, cotangents = points[None] * 0.9 + 1, torch.rand(1, 1, 4, _POINTS)
    smooth = fl.reconstruct(samples, "triquadratic")
    return {
        "jets": lambda: list(smooth.value_and_gradient(points)),
        "sorted jets": lambda: list(smooth.value_and_gradient(scattered)),
        "splats": lambda: [ops.splat(cotangents, located, bspline(2), 1, (40, 40, 40), 0, "cpu")],
        "derivatives by points": lambda: _by_points(smooth, points),
        "prefilters": lambda: [prefilter_samples(samples, "quadratic", implementation="cpu")],
        "march": lambda: [_image(samples[:16, :16, :16])],
        "adjoint": lambda: _by_samples(samples[:12, :12, :12].clone()),
        "reading": lambda: _read(folder),
        "writing": lambda: _written(folder, samples[:16]),
        "compiling": lambda: _compiled(folder, located[:, :100], samples),
    }


def _by_points(smooth: fl.Field, points: Tensor) -> list[Tensor]:
    points = points.clone().requires_grad_()
    return list(torch.autograd.grad(smooth(points).sum(), points))


def _image(samples: Tensor, opacities: Tensor | None = None) -> Tensor:
    smooth = fl.reconstruct(samples, "triquadratic")
    alpha = torch.tensor([0.0, 0.1, 0.6]) if opacities is None else opacities
    transfer = TransferFunction([0.2, 0.5, 1.0], [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]], alpha)
    camera = PerspectiveCamera.framing(smooth.domain, (0.4, 0.8, -0.45))
    return render(smooth, camera, transfer, size=(48, 32), shading=Shading())


def _by_samples(samples: Tensor) -> list[Tensor]:
    leaves = [samples.requires_grad_(), torch.tensor([0.0, 0.1, 0.6]).requires_grad_()]
    return list(torch.autograd.grad(_image(*leaves).square().sum(), leaves))


def _files(folder: Path) -> list[Path]:
    return [folder / f"a{ending}" for ending in ENDINGS]


def _read(folder: Path) -> list[Tensor]:
    return [load_volume(path).samples for path in _files(folder)]


def _written(folder: Path, samples: Tensor) -> list[Tensor]:
    """Written over itself: whenever it is cut off, the file is whole, and what it was written as is gone."""
    path = folder / "written.nrrd"
    save_volume(fl.Volume(samples), path)
    return [load_volume(path).samples]


def _compiled(folder: Path, points: Tensor, samples: Tensor) -> list[Tensor]:
    """Nothing in memory, and every other time not on disk: in a place of its own, as to make all anew takes seconds.

    Programs are let go aside, which the library never does: llvmlite's lock would stay locked behind an interrupt.
    """
    aside(compiler._programs.clear)
    os.environ[cache.VARIABLE] = str(folder / "compiled")
    try:
        if random.random() < 0.5:
            for file in (folder / "compiled").glob("*.o"):
                file.unlink(missing_ok=True)
        return [ops.jet(samples[None, None], points, bspline(1), 1, 0, "cpu")]
    finally:
        os.environ[cache.VARIABLE] = str(folder / _PROGRAMS)


# --- interrupts -------------------------------------------------------------------------------------------------------


def _again_and_again(call: Call) -> None:
    while True:
        call()


def _raise(_number: int, frame: FrameType | None) -> None:
    """Only within a call: what is around it would not expect it; nor would this, when the next one comes too soon."""
    if frame is not None and frame.f_code is _raise.__code__:
        return
    while frame is not None and frame.f_code is not _again_and_again.__code__:
        frame = frame.f_back
    if frame is not None:
        raise KeyboardInterrupt


def interrupt(call: Call, after: float, again: float = _AGAIN) -> float:
    """Calls again and again until an interrupt arrives; seconds that it took to.

    Args:
        after: seconds until it is sent.
        again: seconds until the next one is sent.
    """
    start = time.perf_counter()
    try:
        signal.setitimer(signal.ITIMER_REAL, after, again)
        _again_and_again(call)
    except KeyboardInterrupt:
        pass
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return time.perf_counter() - start - after


def main(count: int, seed: int, *chosen: str) -> None:
    """Prints one JSON object of what came of so many interrupts."""
    faulthandler.enable()
    sys.unraisablehook = lambda _: None  # interrupts in a `__del__` are told there
    signal.signal(signal.SIGALRM, _raise)
    dice, result = random.Random(seed), Interrupted()
    with _folder_of_this_process() as name:
        os.environ[cache.VARIABLE] = str(Path(name) / _PROGRAMS)
        for path in _files(Path(name)):
            save_volume(fl.Volume(torch.rand(12, 12, 12)), path)
        driver.SMALLEST_SORTED_IN, driver.FEWEST_SORTED = 0, _POINTS
        known = works(Path(name))
        known = {work: known[work] for work in chosen or known}
        expected = _expected(known, min(THREADS, -(-count // len(known))))
        for i in range(count):
            faulthandler.dump_traceback_later(SILENCE, exit=True)
            work, threads = list(known)[i % len(known)], 1 + i // len(known) % THREADS
            found = _interrupted(known[work], dice, threads, expected[work, threads], result, work)
            result.findings += [] if found is None else [f"{work}, {threads} threads, interrupt {i}: {found}"]
            if i % _EXITS == _EXITS - 1:
                _end_behind_one(known[work], dice, result, f"{work}, {threads} threads, interrupt {i}")
        left = [path.name for path in Path(name).glob(".tmp-*")]  # one in a hundred may stay, and of fewer one
        result.findings += [f"temporary files are left: {left[:3]}"] if len(left) > max(1, count // 100) else []
    faulthandler.cancel_dump_traceback_later()
    print(json.dumps(asdict(result)), flush=True)


@contextmanager
def _folder_of_this_process() -> Iterator[str]:
    """A temporary folder that forks leave alone when they end."""
    name, own = mkdtemp(), os.getpid()
    try:
        yield name
    finally:
        if os.getpid() == own:
            shutil.rmtree(name)


def _expected(known: dict[str, Call], most: int) -> dict[tuple[str, int], tuple[list[Tensor], float]]:
    """Of every work and number of threads: what it returns, and the seconds that it takes."""
    expected = {}
    for threads in range(1, most + 1):
        _use(threads)
        for work, call in known.items():
            call()
            start = time.perf_counter()
            expected[work, threads] = call(), time.perf_counter() - start
    return expected


def _use(threads: int) -> None:
    """As many of ours, and one of torch's own, which can't be forked."""
    torch.get_num_threads = lambda: threads


def _interrupted(
    call: Call, dice: random.Random, threads: int, known: tuple[list[Tensor], float], result: Interrupted, work: str
) -> str | None:
    expected, seconds = known
    _use(threads)
    again = dice.choice([_AGAIN, dice.uniform(2e-5, 1e-3)])
    late = interrupt(call, dice.uniform(1e-5, 2 * seconds), again)
    result.interrupts[work] = result.interrupts.get(work, 0) + 1
    result.latest[work] = max(result.latest.get(work, 0.0), late)
    same = all(torch.equal(a, b) for a, b in zip(call(), expected, strict=True))
    return None if same else "the next call gives other bits"


def _end_behind_one(call: Call, dice: random.Random, result: Interrupted, what: str) -> None:
    """In a fork, which ends as any process does."""
    faulthandler.cancel_dump_traceback_later()  # the thread that watches is not forked
    child = os.fork()
    faulthandler.dump_traceback_later(SILENCE, exit=True)
    if child == 0:
        interrupt(call, dice.uniform(1e-5, 0.01), dice.uniform(2e-5, 1e-3))
        sys.stdout = None  # nothing is told twice
        raise SystemExit(0)
    status = os.waitpid(child, 0)[1]
    result.ends += 1
    result.findings += [] if status == 0 else [f"{what}: the process ended with status {status}"]


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
