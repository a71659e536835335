"""Forks while other threads compile, import and compute: the child must go on, and end.

The first fork comes while the first calls are still importing what they need. A child computes what its parent did,
with a program that it compiles itself, and ends; one that takes too long hangs, and is killed.

    python -m experiments.extremes.forks COUNT SEED      prints what came of it as JSON
"""

from __future__ import annotations

import faulthandler
import json
import os
import random
import signal
import sys
import threading
import time
from dataclasses import asdict, dataclass, field

import torch
from torch import Tensor

from filterlab import ops
from filterlab.kernels import bspline
from filterlab.ops.cpu import cache

SILENCE = 30.0  # seconds; a child that takes longer hangs
_COMPILING, _COMPUTING = 2, 2  # threads
_DEGREES = range(1, 5)


@dataclass
class Forked:
    """What came of it.

    Attributes:
        forks: how many; longest: seconds that the slowest took, with its child.
        findings: what must not be.
    """

    forks: int = 0
    longest: float = 0.0
    findings: list[str] = field(default_factory=list)


def _jet(degree: int) -> Tensor:
    coefficients = torch.linspace(0, 9, 12**3).sin().reshape(1, 1, 12, 12, 12)
    points = torch.linspace(3, 8, 3 * 30_000).reshape(1, -1, 3)
    return ops.jet(coefficients, points, bspline(degree), 1, 0, "cpu")


def _compile(ended: threading.Event, dice: random.Random) -> None:
    while not ended.is_set():
        degree = dice.choice(_DEGREES)
        _jet(degree)
        _forget_programs()


def _compute(ended: threading.Event) -> None:
    while not ended.is_set():
        _jet(_DEGREES[0])


def _forget_programs() -> None:
    from filterlab.ops.cpu import compiler

    compiler._programs.clear()


def _child(degree: int, expected: Tensor | None) -> None:
    """Ends this process: 0 when it gave the bits that were expected."""
    code = 1
    try:
        faulthandler.dump_traceback_later(SILENCE / 2, exit=True)
        _forget_programs()
        code = 0 if expected is None or torch.equal(_jet(degree), expected) else 2
    finally:
        os._exit(code)


def _ended(child: int) -> str | None:
    """How it ended, when not well."""
    limit = time.monotonic() + SILENCE
    while time.monotonic() < limit:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return None if status == 0 else f"the child ended with status {status}"
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "the child hung"


def main(count: int, seed: int) -> None:
    """Prints one JSON object of what came of so many forks."""
    faulthandler.enable()
    torch.get_num_threads = lambda: 2  # of ours; torch's own can't be forked
    os.environ[cache.VARIABLE] = os.devnull  # a folder in which nothing can be kept
    dice, result, ended = random.Random(seed), Forked(), threading.Event()
    threads = [threading.Thread(target=_compile, args=(ended, random.Random(dice.random()))) for _ in range(_COMPILING)]
    threads += [threading.Thread(target=_compute, args=(ended,)) for _ in range(_COMPUTING)]
    for thread in threads:
        thread.start()
    expected: dict[int, Tensor] = {}
    for i in range(count):
        degree = dice.choice(_DEGREES)
        time.sleep(dice.uniform(0, 0.05))
        start = time.monotonic()
        child = os.fork()
        if child == 0:
            _child(degree, expected.get(degree))
        found = _ended(child)
        result.forks += 1
        result.longest = max(result.longest, time.monotonic() - start)
        result.findings += [] if found is None else [f"fork {i}: {found}"]
        if degree not in expected:
            expected[degree] = _jet(degree)
    ended.set()
    for thread in threads:
        thread.join()
    print(json.dumps(asdict(result)), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
