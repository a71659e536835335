"""Configurations that mean harm, and configurations with their bytes damaged."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from experiments.extremes.contract import Case, Finding, Subject, Tally
from experiments.extremes.mutations import edited, random_edits
from experiments.headings import known_configs, load_heading
from experiments.registry import EXPERIMENTS
from filterlab.io.config import MAX_BYTES, ConfigError, StrictModel, loads_config
from filterlab.scenes.model import Scene

_SECONDS = 20.0


class _Anything(StrictModel):
    """A config that takes every value."""

    value: Any = None
    count: int = 1


# one line that is refused, and a word of the message
_REFUSED = (
    ("value: &a [1]", "anchors"),
    ("value: *a", "anchors"),
    ("value: !!python/object/apply:os.system [ls]", "tags"),
    ("value: !!python/name:os.system", "tags"),
    ("value: !!binary aGk=", "tags"),
    ("value: .nan", "finite"),
    ("value: [1, -.inf]", "finite"),
    ("value: 1e999", "finite"),
    ("value: 0x" + "f" * 5000, "digits"),
    ("value: " + "9" * 5000, "digits"),
    ('value: "\\ud800"', "Unicode"),
    ('value: "\\UFFFFFFFF"', "U+10FFFF"),
    ("count: 1.5", "integer"),
    ("cuont: 1", "did you mean 'count'"),
    ("output: ../../somewhere", "unknown key"),
    ("? [a]\n: b", "text"),
    ("1: b", "text"),
    ("<<: {count: 1}", "unknown key"),
    ("value: ]", "valid YAML"),
    ("value: {a: 1, a: 2}", "once"),
    ("value: " + "[" * 40 + "]" * 40, "levels"),
)


def refused(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """One bad line below some good ones: the message names that line."""
    tally = Tally()
    for text, word in _REFUSED:
        for above in random.integers(0, 2000, size=max(int(10 * amount), 2)):
            head = "".join(f"# {i}\n" for i in range(above))
            told = _told(f"{head}{text}\n", _Anything)
            line = above + 1
            tally.kept(word in told and f"<text>:{line}: " in told, f"{text[:40]!r}: {told[:120]}")
    return tally.finding()


def huge(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """As much as fits into a file, and more: it is refused, and soon."""
    tally, room = Tally(), MAX_BYTES - 20
    texts = {
        "a million values": "value: [" + "1," * 10**6,
        "half a million values": "value: [" + "1," * (room // 2 - 8) + "]",
        "as many keys": "\n".join(f"k{i}: 1" for i in range(room // 12)),
        "levels of lists": "value: " + "[" * room,
        "levels of mappings": "value: " + "{" * room,
        "levels of dashes": "value:\n " + "- " * (room // 2 - 10),
        "levels of keys": "? " * (room // 2),
        "anchors": "value: " + "&a " * (room // 3 - 10),
        "tags": "value: " + "!a " * (room // 3 - 10),
        "directives": "%TAG ! a\n" * (room // 9),
        "documents": "---\n" * (room // 4),
        "a number": "value: " + "9" * room,
        "a hexadecimal number": "value: 0x" + "f" * room,
        "an open quote": 'value: "' + "x" * room,
        "an open list": "value: [" + "\n" * room,
    }
    slowest = ("", 0.0)
    for name in random.choice(list(texts), size=min(max(int(len(texts) * amount), 3), len(texts)), replace=False):
        text = texts[name]
        start = time.perf_counter()
        told = _told(text, _Anything)
        seconds = time.perf_counter() - start
        slowest = max(slowest, (name, seconds), key=lambda pair: pair[1])
        tally.kept(told.startswith("<text>:") and seconds < _SECONDS, f"{name}: {told[:80]} after {seconds:.1f} s")
    found = tally.finding()
    note = found.note or f"slowest: {slowest[0]}, {slowest[1]:.2g} s"
    return Finding(found.inputs, found.worst, found.bound, note)


def damaged(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Configs and scenes of this project with some bytes changed: a config, or a ConfigError with a place."""
    tally = Tally()
    known = [
        (path.read_bytes(), EXPERIMENTS[load_heading(path).experiment].config) for path in known_configs().values()
    ]
    scenes = sorted(next(iter(known_configs().values())).parent.glob("scenes/*.yaml"))
    known += [(path.read_bytes(), Scene) for path in scenes]
    for i in range(max(int(5000 * amount), len(known))):
        content, model = known[i % len(known)]
        text = edited(content, random_edits(random)).decode("utf-8", errors="replace")
        try:
            told = _told(text, model)
        except Exception as error:
            told = f"{type(error).__name__}: {error}"
        kept = told in ("", "accepted") or told.startswith("<text>")
        tally.kept(kept, f"config {i}: {told[:200]}")
    return tally.finding()


def _told(text: str, model: type) -> str:
    try:
        loads_config(text, model)
    except ConfigError as error:
        return str(error)
    return "accepted"


CASES = (
    Case(
        "hostile-configs",
        "aliases, tags (`!!python/*`), duplicate and unknown keys, NaN, huge numbers, half characters, output paths",
        "A ConfigError that names the line.",
        refused,
        seconds=10,
    ),
    Case(
        "huge-configs",
        "10⁶ values, 10⁶ levels, 1 MiB of one thing",
        f"A ConfigError that names the line, within {_SECONDS:.0f} s.",
        huge,
        seconds=15,
    ),
    Case(
        "damaged-configs",
        "configs and scenes of the project with bytes changed, added, left out",
        "A valid config, or a ConfigError with a place; nothing else.",
        damaged,
        seconds=20,
        tested=0.05,
    ),
)
