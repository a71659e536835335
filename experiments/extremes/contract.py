"""What a case is: a contract in words, and a check that measures how far inputs are from breaking it."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import product

import numpy as np

import filterlab as fl


@dataclass(frozen=True)
class Subject:
    """What a case is checked on; a part that its sweep leaves out is empty.

    Attributes:
        method, scheme, boundary: as `filterlab.reconstruct` takes them.
        device: as torch names it.
    """

    method: str = ""
    scheme: str = ""
    boundary: str = ""
    device: str = ""

    @property
    def key(self) -> str:
        """A short unique name, `all` for a case that sweeps nothing."""
        return "+".join(part for part in (self.method, self.scheme, self.boundary, self.device) if part) or "all"


@dataclass(frozen=True)
class Finding:
    """What a check found.

    Attributes:
        inputs: how many were tried.
        worst: the largest error among them; for a contract that is kept or broken, how many broke it.
        bound: what `worst` must not exceed; 0 for those.
        note: what the worst input was, or what else a reader should know.
        skipped: why nothing could be tried here; then nothing else counts.
    """

    inputs: int
    worst: float
    bound: float
    note: str = ""
    skipped: str = ""

    @property
    def holds(self) -> bool:
        """Whether something was tried and the contract was kept; an error of NaN breaks it."""
        return not self.skipped and self.inputs > 0 and self.worst <= self.bound


Check = Callable[[Subject, np.random.Generator, float], Finding]
"""(subject, random numbers, amount) -> finding. `amount` 1 is the full length; tests ask for less."""


@dataclass(frozen=True)
class Case:
    """A row of the contract.

    Attributes:
        key: short and unique, like `nan-coordinate`.
        title: which inputs.
        contract: what must hold, one sentence.
        check: measures it.
        sweep: the parts of a subject that it is checked for: some of method, scheme, boundary, device.
        seconds: what one subject takes at full length, roughly, on one core.
        tested: the amount that tests can afford.
    """

    key: str
    title: str
    contract: str
    check: Check
    sweep: tuple[str, ...] = ()
    seconds: float = 0.5
    tested: float = 0.1

    def subjects(
        self,
        methods: Iterable[str] | None = None,
        schemes: Iterable[str] | None = None,
        boundaries: Iterable[str] | None = None,
        devices: Iterable[str] = ("cpu",),
    ) -> list[Subject]:
        """All subjects of its sweep; schemes that a method does not offer are left out."""
        ranges = {
            "method": list(fl.METHODS if methods is None else methods),
            "scheme": ["fused", "direct", "sampled"] if schemes is None else list(schemes),
            "boundary": list(map(str, fl.Boundary)) if boundaries is None else list(boundaries),
            "device": list(devices),
        }
        unknown = set(self.sweep) - set(ranges)
        assert not unknown, f"{self.key} sweeps {unknown}, which a subject does not have"
        chosen = product(*(ranges[part] for part in self.sweep))
        found = [Subject(**dict(zip(self.sweep, parts, strict=True))) for parts in chosen]
        return [s for s in found if not (s.method and s.scheme) or s.scheme in fl.METHODS[s.method].schemes]

    def run(self, subject: Subject, seed: int, amount: float = 1.0) -> Finding:
        """The finding for one subject; the same for the same seed, whatever else runs.

        An error that the check does not expect breaks the contract: it is the finding.
        """
        try:
            return self.check(subject, random_numbers(self.key, subject, seed), amount)
        except Exception as error:
            return Finding(1, math.inf, 0.0, f"{type(error).__name__}: {' '.join(str(error).split())}"[:300])


def random_numbers(key: str, subject: Subject, seed: int) -> np.random.Generator:
    """A stream of its own for every case and subject."""
    return np.random.default_rng([seed, zlib.crc32(f"{key}/{subject.key}".encode())])


@dataclass
class Tally:
    """Counts inputs and keeps the worst of them, for checks that try many.

    Attributes:
        bound: what an error must not exceed.
    """

    bound: float = 0.0
    inputs: int = 0
    worst: float = 0.0
    note: str = ""
    broken: int = field(default=0, init=False)

    def error(self, size: float, what: str = "", inputs: int = 1) -> None:
        """An error of that size, NaN counting as infinite, found on `inputs` inputs."""
        size = math.inf if math.isnan(size) else float(size)
        self.inputs += inputs
        if size > self.worst:
            self.worst, self.note = size, what if size > self.bound else self.note

    def kept(self, kept: bool, what: str = "", inputs: int = 1) -> None:
        """A promise that was kept, or was not; counted."""
        self.inputs += inputs
        if not kept:
            self.broken += 1
            self.note = self.note or what

    def finding(self) -> Finding:
        """What was found; a broken promise outweighs every error."""
        worst = math.inf if self.broken and self.bound > 0 else max(self.worst, float(self.broken))
        return Finding(self.inputs, worst, self.bound, self.note)
