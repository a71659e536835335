"""What experiments on cost share: where fields are timed, and costs as records.

Points along rays are what a renderer asks for, one after the other near in memory; random ones are the other extreme.
"""

from __future__ import annotations

import math
import time
from typing import Literal

import torch
from pydantic import model_validator
from torch import Tensor

from experiments.config import ExperimentConfig
from experiments.rms_error import Known
from experiments.runs import Record
from filterlab.costs import Clock, Cost, Quartiles, per_round

CLOCKS: dict[str, Clock] = {"wall": time.perf_counter, "cpu": time.process_time}

SLANT = (0.12, 0.08)  # of the rays across x and y, in units of their way along z
INNER = 0.9  # of the box: points keep away from its ends


class TimedConfig(ExperimentConfig):
    """A config with a clock: `wall`, or `cpu`, which does not see the time in which the core worked for others."""

    clock: Literal["wall", "cpu"] = "wall"

    @model_validator(mode="after")
    def _one_thread(self) -> TimedConfig:
        if self.clock == "cpu" and (self.threads != 1 or self.device != "cpu"):
            raise ValueError("clock: cpu adds up the time of all threads; expected threads: 1 and device: cpu with it")
        return self

    @property
    def timed_by(self) -> str:
        """In words."""
        threads = "one thread" if self.threads == 1 else "the threads of this run"
        return f"CPU time of {threads}" if self.clock == "cpu" else f"wall-clock time on {threads}"


def along_rays(field: Known, count: int, spacing: float, device: str = "cpu") -> Tensor:
    """`count` world points `(count, 3)`, float32, on slanted parallel rays through the field's box, `spacing` apart.

    Ray after ray on a square grid; the rays fill the box shrunk to nine tenths about its centre. `spacing` is along z,
    in units of the box's depth.
    """
    each = max(math.ceil(INNER / spacing), 1)
    side = math.ceil(math.sqrt(math.ceil(count / each)))
    t = (torch.arange(each, dtype=torch.float64) + 0.5) / each
    start = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    y, x, z = torch.meshgrid(start, start, t, indexing="ij")
    across = [(1 - slant) * s + slant * z for s, slant in zip((x, y), SLANT, strict=True)]
    unit = torch.stack((*across, z), -1).reshape(-1, 3)[:count]
    lower, upper = (torch.tensor(c, dtype=torch.float64) for c in (field.domain.lower, field.domain.upper))
    inset = (1 - INNER) / 2
    inside = lower + (upper - lower) * (inset + INNER * unit)
    return field.domain.geometry.to_world(inside).to(dtype=torch.float32, device=device)


def cost_record(cost: Cost) -> Record:
    """A cost as plain numbers: quartiles of ns per sample and of seconds to build, bytes, and ns of every round."""
    return {
        "ns_per_sample": quartile_record(cost.sample),
        "build_seconds": quartile_record(cost.build),
        "bytes": cost.coefficient_bytes,
        "rounds": list(cost.rounds),
    }


def quartile_record(quartiles: Quartiles) -> list[float]:
    """[lower quartile, median, upper quartile]."""
    return [quartiles.low, quartiles.median, quartiles.high]


def ratio(above: Record, below: Record) -> list[float]:
    """Quartiles of time per sample ÷ time per sample within the rounds of one measurement, from two `cost_record`s."""
    return quartile_record(Quartiles.of(per_round(above["rounds"], below["rounds"])))
