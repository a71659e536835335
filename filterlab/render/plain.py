"""The plain marcher: any Field, device and derivative, in batched torch (`ops.reference.march`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from filterlab.fields.base import Field
from filterlab.ops.march import Chords
from filterlab.ops.reference import march as reference
from filterlab.render.shading import Shading
from filterlab.render.transfer import TransferFunction

Report = Callable[[int], None]
"""Is told how many samples of the current part are done."""


@dataclass(frozen=True)
class Medium:
    """What rays are marched through, and how.

    Attributes:
        field: unbatched.
        transfer: with tables in the dtype of the samples.
        shading: lights, or None.
        step: world length of a segment.
        faint: transmittance below which a ray ends; 0: only at exactly 0.
        differentiable: whether derivatives are asked.
    """

    field: Field
    transfer: TransferFunction
    shading: Shading | None
    step: float
    faint: float
    differentiable: bool

    @property
    def dtype(self) -> torch.dtype:
        return self.transfer.positions.dtype

    @property
    def order(self) -> int:
        """The highest derivative of the field that is asked for: none without light."""
        return 0 if self.shading is None else 1


class Marcher(Protocol):
    """Marches parts of an image's rays through a medium."""

    def march(self, medium: Medium, chords: Chords, report: Report) -> tuple[Tensor, Tensor]:
        """Emitted light (R, 3) and optical depth (R,), float64."""
        ...


class PlainMarcher:
    """Any field, device and derivative.

    Args:
        memory: bytes that samples in work may take, roughly.
    """

    def __init__(self, memory: int) -> None:
        self.memory = memory

    def march(self, medium: Medium, chords: Chords, report: Report) -> tuple[Tensor, Tensor]:
        """Emitted light (R, 3) and optical depth (R,), float64.

        Differentiable any number of times; blocks are recomputed in the backward pass, so that memory stays bounded.
        """
        medium, chords = _from_the_first_voxel(medium, chords)
        return reference.composite(chords, _Samples(**vars(medium)), self.memory, report)


@dataclass(frozen=True)
class _Samples(Medium):
    """A medium as it is sampled along rays."""

    @property
    def lit(self) -> bool:
        return self.shading is not None

    def at(self, rays: Tensor) -> _Samples:
        return self

    def jet(self, points: Tensor, order: int) -> tuple[Tensor, ...]:
        return self.field.jet(points, order)

    def shade(self, color: Tensor, gradient: Tensor, ray: Tensor, direction: Tensor) -> Tensor:
        assert self.shading is not None
        return self.shading(color, gradient, direction)


def _from_the_first_voxel(medium: Medium, chords: Chords) -> tuple[Medium, Chords]:
    """The same in a world whose origin is the volume's own: samples keep their digits wherever the volume stands."""
    origin = medium.field.domain.geometry.origin
    field = medium.field.relative_to(origin)
    return replace(medium, field=field), replace(chords, entry=chords.entry - chords.entry.new_tensor(origin))
