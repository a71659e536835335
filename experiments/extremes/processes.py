"""Processes that are interrupted, and that fork, while vector code is at work."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np

from experiments.extremes.contract import Case, Finding, Subject

INTERRUPTS, FORKS = 10_000, 300
_PARTS = 10  # processes, one after the other
_SECONDS_EACH = 5.0  # of an interrupt or fork, at most, on a busy machine


def interrupted(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Calls of every kind on 1 to 8 threads."""
    parts = min(_PARTS, max(1, round(_PARTS * amount)))
    count = max(20, round(INTERRUPTS * amount / parts))
    told = [_run("interrupts", count, random) for _ in range(parts)]
    arrived = sum(sum(one["interrupts"].values()) for one in told)
    latest = {work: max(one["latest"][work] for one in told) for work in told[0]["latest"]}
    words = ", ".join(f"{work} {1000 * seconds:.0f}" for work, seconds in latest.items())
    return _found(told, arrived, f"{sum(one['ends'] for one in told)} processes ended behind one; at most, ms: {words}")


def forked(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Forks of a process whose other threads compile and compute."""
    told = _run("forks", max(6, round(FORKS * amount)), random)
    return _found([told], told["forks"], f"a fork and its child took at most {told['longest']:.2g} s")


def _run(module: str, count: int, random: np.random.Generator) -> dict:
    """What a process of its own tells; RuntimeError: how it ended instead."""
    command = [sys.executable, "-m", f"experiments.extremes.{module}", str(count), str(random.integers(2**31))]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    limit = 120 + _SECONDS_EACH * count
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=limit, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"the process ended with {done.returncode}: {done.stderr[-200:]}")
    return json.loads(done.stdout)


def _found(told: list[dict], inputs: int, words: str) -> Finding:
    if not inputs:
        return Finding(0, 0.0, 0.0, skipped="nothing was tried")
    findings = [finding for one in told for finding in one["findings"]]
    return Finding(inputs, float(len(findings)), 0.0, "; ".join([*findings[:3], words]))


def _where_it_can(check):
    def checked(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
        if not hasattr(os, "fork"):
            return Finding(0, 0.0, 0.0, skipped="processes are forked here, which this system does not do")
        return check(subject, random, amount)

    return checked


CASES = (
    Case(
        "interrupted",
        "Ctrl-C at any moment, singly and in bursts, on 1 to 8 threads",
        "No crash and no hang, at the end of the process neither; the next call gives the bits that it gave before.",
        _where_it_can(interrupted),
        seconds=1200,
        tested=0.002,
    ),
    Case(
        "forked",
        "forks while other threads import, compile and compute",
        "The child compiles and computes the same bits, and ends.",
        _where_it_can(forked),
        seconds=60,
        tested=0.02,
    ),
)
