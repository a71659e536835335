"""Gradient descent that goes on where it was stopped: Adam, with all that decides its next step kept in one file.

Letters: i, the number of a step within its stage, from 0; N, the steps of the stage; η, its learning rate. Step i is
made with η (0.05 + 0.95 (1 + cos(π i / N)) / 2): large at first, a twentieth at the end, so that what random batches
stirred up comes to rest.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Annotated, Protocol

import torch
from pydantic import Field
from torch import Tensor

from experiments.errors import RunError
from experiments.runs import Record, Run
from filterlab.io.atomic import atomic_write
from filterlab.io.config import StrictModel
from filterlab.scenes.model import Positive

Parameters = dict[str, Tensor]

BETAS = (0.9, 0.99)  # of Adam; the second looks back over about a hundred steps
_SLOWEST = 0.05  # of the learning rate, at the end of a stage


class Stage(StrictModel):
    """A number of steps with one set of parameters."""

    iterations: Annotated[int, Field(ge=1, le=10**6)]
    learning_rate: Positive


class Problem(Protocol):
    """What is minimised. `parameters` are leaf tensors by name; every stage may have others.

    For the same bits after an interruption as without one, nothing here may depend on what was asked before.
    """

    def start(self) -> Parameters:
        """The parameters of the first stage."""
        ...

    def refine(self, parameters: Parameters, stage: int) -> Parameters:
        """The parameters that `stage` begins with, from those that the stage before it ended with."""
        ...

    def loss(self, parameters: Parameters, stage: int, iteration: int) -> tuple[Tensor, Tensor]:
        """(misfit, penalty) at a step; their sum is minimised."""
        ...

    def project(self, parameters: Parameters) -> None:
        """Puts the parameters back, in place, to where they are allowed to be."""
        ...

    def observe(self, parameters: Parameters, stage: int) -> Record:
        """What is written down of the parameters now and then."""
        ...


class OneStage:
    """A problem of one stage, whose parameters may have any values."""

    def refine(self, parameters: Parameters, stage: int) -> Parameters:
        raise AssertionError("there is one stage")

    def project(self, parameters: Parameters) -> None:
        """Nothing: all values are allowed."""


class Recorded(Protocol):
    """Of a config: steps between observations, and between checkpoints; where parameters are."""

    @property
    def record_every(self) -> int: ...

    @property
    def checkpoint_every(self) -> int: ...

    @property
    def device(self) -> str: ...


@dataclass
class State:
    """How far a descent has come.

    Attributes:
        parameters: of the stage.
        stage: the one that the parameters belong to.
        iteration: steps made, over all stages.
        moments: the state of Adam; None at the beginning of a stage.
        misfits, penalties: of every step made, before it.
        observations: what `observe` gave, each with its `iteration`.
    """

    parameters: Parameters
    stage: int = 0
    iteration: int = 0
    moments: Record | None = None
    misfits: list[float] = field(default_factory=list)
    penalties: list[float] = field(default_factory=list)
    observations: list[Record] = field(default_factory=list)


def minimize(
    problem: Problem,
    stages: Sequence[Stage],
    checkpoint: Path,
    *,
    observe_every: int,
    checkpoint_every: int,
    device: str = "cpu",
    progress: Callable[[float], None] = lambda _fraction: None,
) -> State:
    """Goes through all stages, from `checkpoint` on if that file is there, and returns the last state.

    Args:
        problem: what is minimised.
        stages: one after the other; where a new one begins, parameters are refined and Adam starts anew.
        checkpoint: the file of the state, written under a temporary name every `checkpoint_every` steps and at the end.
        observe_every: steps between observations; the start and the end are always observed.
        device: where the parameters of a checkpoint go.
        progress: told the fraction done, 0 … 1.

    Raises:
        ValueError: the loss is no longer a finite number; the checkpoint before that is kept.
        RunError: a checkpoint that can't be read.
    """
    ends = list(accumulate(stage.iterations for stage in stages))
    state = _load(checkpoint, device) if checkpoint.exists() else State(problem.start())
    if not state.observations:
        state.observations.append({"iteration": 0, **problem.observe(state.parameters, 0)})
    optimizer = _optimizer(state)
    while state.iteration < ends[-1]:
        stage = bisect_right(ends, state.iteration)
        if stage != state.stage:
            state.parameters, state.stage, state.moments = problem.refine(state.parameters, stage), stage, None
            optimizer = _optimizer(state)
        i, n = state.iteration - (ends[stage] - stages[stage].iterations), stages[stage].iterations
        _step(problem, state, optimizer, stages[stage].learning_rate * slowing(i, n))
        last = state.iteration == ends[-1]
        if last or state.iteration % observe_every == 0:
            state.observations.append({"iteration": state.iteration, **problem.observe(state.parameters, stage)})
        if last or state.iteration % checkpoint_every == 0:
            state.moments = optimizer.state_dict()
            _save(state, checkpoint)
        progress(state.iteration / ends[-1])
    return state


def descended(
    problem: Problem, stages: Sequence[Stage], config: Recorded, key: str, run: Run, share: float = 1.0
) -> State:
    """`minimize` with its state in a file of a run's, named by a key; all of it is a share of the unit's work."""
    return minimize(
        problem,
        stages,
        run.folder / "files" / f"{run.prefix}{key}.state.pt".replace("/", "--"),
        observe_every=config.record_every,
        checkpoint_every=config.checkpoint_every,
        device=config.device,
        progress=lambda fraction: run.advance(share * fraction),
    )


def course(state: State) -> Record:
    """How a descent went; observations with the mean misfit of the steps since the one before."""
    ends = [observation["iteration"] for observation in state.observations]
    means = [None, *(sum(state.misfits[a:b]) / (b - a) for a, b in pairwise(ends))]
    observations = [{**o, "misfit": m} for o, m in zip(state.observations, means, strict=True)]
    return {"misfits": state.misfits, "penalties": state.penalties, "observations": observations}


def slowing(i: int, n: int) -> float:
    """The share of the learning rate with which step i of n is made."""
    return _SLOWEST + (1 - _SLOWEST) * (1 + math.cos(math.pi * i / n)) / 2


def _optimizer(state: State) -> torch.optim.Adam:
    parameters = [p.requires_grad_() for p in state.parameters.values()]
    optimizer = torch.optim.Adam(parameters, betas=BETAS)
    if state.moments is not None:
        optimizer.load_state_dict(state.moments)
    return optimizer


def _step(problem: Problem, state: State, optimizer: torch.optim.Adam, learning_rate: float) -> None:
    for group in optimizer.param_groups:
        group["lr"] = learning_rate
    optimizer.zero_grad()
    misfit, penalty = problem.loss(state.parameters, state.stage, state.iteration)
    loss = misfit + penalty
    if not bool(loss.isfinite()):
        found = f"{float(loss.detach())} at iteration {state.iteration}"
        raise ValueError(f"expected a finite loss; got {found}: use a smaller learning rate")
    loss.backward()
    optimizer.step()
    with torch.no_grad():
        problem.project(state.parameters)
    state.misfits.append(float(misfit.detach()))
    state.penalties.append(float(penalty.detach()))
    state.iteration += 1


def _save(state: State, path: Path) -> None:
    content = {**vars(state), "parameters": {name: p.detach() for name, p in state.parameters.items()}}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)


def _load(path: Path, device: str) -> State:
    try:
        return State(**torch.load(path, map_location=device, weights_only=True))
    except Exception as error:  # torch.load has many: of the archive, of the pickle, of what is in it
        told = (str(error).splitlines() or [type(error).__name__])[0]
        raise RunError(f"{path} is no state of a descent ({told}); remove it, or use --fresh") from None
