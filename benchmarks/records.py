"""What a run leaves: records, checked by their models, that tables are made of and that a JSON file holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Self

from pydantic import BaseModel, ConfigDict

from filterlab.costs import Quartiles

SCHEMA = 1


class Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Spread(Record):
    """Median and quartiles of a sample."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Self:
        """Quartiles are interpolated between the sorted values; of a single value all three are that value."""
        return cls(**asdict(Quartiles.of(values)))


class Bar(Record):
    """What a figure must reach.

    Attributes:
        limit: the number.
        at_most: the figure must not be above the limit; else not below.
        strict: equality does not do.
        written: how the limit is written, as in "1/25".
    """

    limit: float
    at_most: bool = True
    strict: bool = False
    written: str

    def met(self, value: float) -> bool:
        if value == self.limit:
            return not self.strict
        return (value < self.limit) is self.at_most

    def __str__(self) -> str:
        sign = {(True, False): "≤", (True, True): "<", (False, False): "≥", (False, True): ">"}
        return f"{sign[self.at_most, self.strict]} {self.written}"


def at_most(written: str) -> Bar:
    """The bar "≤ written", a number or a fraction such as 1/25."""
    return Bar(limit=_number(written), written=written)


def below(written: str) -> Bar:
    """The bar "< written"."""
    return Bar(limit=_number(written), written=written, strict=True)


def at_least(written: str) -> Bar:
    """The bar "≥ written"."""
    return Bar(limit=_number(written), written=written, at_most=False)


def _number(written: str) -> float:
    above, _, under = written.split()[0].partition("/")
    return float(above) / float(under or 1)


class Timing(Record):
    """How long one contestant took.

    Attributes:
        name: of the contestant.
        first_call: seconds of its first call: compilation, loading and caches included.
        seconds: of one call, one number per round; where a round has several calls, their median (see
            `filterlab.costs.take_turns`).
        spread: of `seconds`.
        calls: calls in a round.
        samples: what one call computes this many of.
        compared_with: what its numbers were compared with; None: nothing.
        difference: largest difference, in units of the largest magnitude there.
        tolerance: the difference that was allowed.
    """

    name: str
    first_call: float
    seconds: tuple[float, ...]
    spread: Spread
    calls: int
    samples: int
    compared_with: str | None = None
    difference: float | None = None
    tolerance: float | None = None


class Figure(Record):
    """A number that is reported, with the bar that it must reach where there is one.

    Attributes:
        name: what it is, as in "fused ÷ direct".
        spread: over the rounds.
        unit: "" for ratios.
        bar: None where nothing is asked.
    """

    name: str
    spread: Spread
    unit: str = ""
    bar: Bar | None = None

    @property
    def met(self) -> bool | None:
        return None if self.bar is None else self.bar.met(self.spread.median)


class Outcome(Record):
    """What one item of a comparison gave.

    Attributes:
        name: key of the item.
        what: one line for people.
        rounds: how often every contestant had its turn.
        share_of_core: CPU time ÷ (wall-clock time · threads) while the rounds ran; far below 1: the machine was busy
            with other work, or the contestants wait.
        timings, figures: the numbers.
        absent: peers that did not take part, and why.
        errors: contestants that failed or disagreed, and how; they have no timing.
    """

    name: str
    what: str
    rounds: int = 0
    share_of_core: float | None = None
    timings: tuple[Timing, ...] = ()
    figures: tuple[Figure, ...] = ()
    absent: dict[str, str] = {}
    errors: dict[str, str] = {}


class Section(Record):
    """The outcomes of one comparison."""

    name: str
    summary: str
    outcomes: tuple[Outcome, ...] = ()


class Machine(Record):
    """Where it ran: nothing in it names a person, a host or a folder."""

    cpu: str
    llvm_cpu: str
    features: tuple[str, ...]
    cores: int
    usable_cores: int
    system: str
    versions: dict[str, str]
    gpu: str = ""


class Report(Record):
    """Everything of one run."""

    schema_version: int = SCHEMA
    machine: Machine
    settings: dict[str, int | float | bool | str]
    complete: bool
    sections: tuple[Section, ...]
