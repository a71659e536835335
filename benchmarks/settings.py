"""Sizes and patience of a run."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Self

CLOCKS = ("wall", "cpu")


@dataclass(frozen=True)
class Settings:
    """What the command line decides.

    Attributes:
        threads: of every contestant that can be told.
        repeats: rounds of a race.
        seconds: after so much time a race ends early, though not before `least_rounds`.
        least_rounds: see `seconds`.
        clock: "wall", or "cpu": time of this process, without that in which the core worked for others.
        voxels: edge of the volume that is evaluated.
        points: how many points it is evaluated at.
        image: edge of a rendered image.
        image_voxels: edge of the rendered volume.
        prefilter_voxels: edge of the prefiltered volume.
        most_points: where the cost is measured against the number of points.
        quick: sizes are small: a look, no figures to quote.
    """

    threads: int = 1
    repeats: int = 11
    seconds: float = 30.0
    least_rounds: int = 3
    clock: str = "wall"
    voxels: int = 128
    points: int = 10**6
    image: int = 256
    image_voxels: int = 128
    prefilter_voxels: int = 256
    most_points: int = 10**7
    quick: bool = False

    @classmethod
    def small(cls, **changes) -> Self:
        """What --quick takes: every comparison in about a second per contestant."""
        sizes = {"voxels": 48, "points": 50_000, "image": 48, "image_voxels": 32}
        return cls(**{"seconds": 2.0, **sizes, "prefilter_voxels": 48, "most_points": 10**5, "quick": True, **changes})

    def record(self) -> dict[str, int | float | bool | str]:
        return asdict(self)
