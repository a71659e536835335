"""How long does a frame of a terrain take, by the size of its grid and the angle of view? First hits, nothing shaded.

The same hills in the same square for every size, rough down to its own step: twice as many data along an edge show
twice as fine detail. The camera looks at the middle from so many degrees above the horizon. Bounds of blocks are made
once for each grid; how long that takes and what they weigh is told beside.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import interpolate

from experiments.runs import Record, Run, Unit
from experiments.timing import CLOCKS, TimedConfig, quartile_record
from filterlab.costs import Quartiles, take_turns
from filterlab.names import SPLINES
from filterlab.render import PerspectiveCamera
from filterlab.surfaces import HeightField

_DISTANCE, _FIELD_OF_VIEW = 1.6, 30.0
_HEIGHT, _ROUGHNESS = 0.12, 0.55  # of the largest hills, in edges of the square; of every octave, of the one before


class Config(TimedConfig):
    """Which terrains and views.

    Attributes:
        splines: names of splines.
        sizes: data along an edge.
        angles: degrees of the camera above the horizon; 90 looks straight down.
        pixels: along an edge of a frame.
        seconds: of measurement for each spline and size.
    """

    experiment: Literal["terrain_frames"]
    splines: Annotated[
        list[Literal["linear", "c0", "c1", "c2"]], Field(min_length=1, default_factory=lambda: [*SPLINES])
    ]
    sizes: Annotated[list[Annotated[int, Field(ge=8, le=32768)]], Field(min_length=1)]
    angles: Annotated[list[Annotated[float, Field(gt=0, le=90)]], Field(min_length=1)]
    pixels: Annotated[int, Field(ge=2, le=4096)] = 512
    seconds: Annotated[float, Field(gt=0)] = 10.0

    def work(self) -> dict[str, tuple[str, int]]:
        """Unit keys -> spline, size."""
        return {f"{spline}/{size}": (spline, size) for size in self.sizes for spline in self.splines}


def units(config: Config) -> list[Unit]:
    """One per spline and size."""
    return [
        Unit(key, f"{spline}, {size}²", config.seconds + 1e-7 * size**2)
        for key, (spline, size) in config.work().items()
    ]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit: seconds of a frame from every angle, share of rays that hit, bounds."""
    spline, size = config.work()[unit.key]
    heights = hills(size, config.seed)
    clock = CLOCKS[config.clock]
    _warm(spline)
    begin = clock()
    surface = HeightField(heights, spline, spacing=1 / (size - 1))
    weight = surface.cast.pyramid.numbers.nbytes
    bounds = clock() - begin
    views = {f"{angle:g}": rays(angle, config.pixels) for angle in config.angles}
    calls = {name: (lambda own=own: surface.hit(*own)) for name, own in views.items()}
    rounds = take_turns(calls, seconds=config.seconds, clock=clock, tick=run.advance)
    return {
        "spline": spline,
        "size": size,
        "rays": config.pixels**2,
        "bounds_seconds": bounds,
        "bounds_bytes": weight,
        "heights_bytes": heights.nbytes,
        "frames": {name: quartile_record(Quartiles.of(taken)) for name, taken in rounds.seconds.items()},
        "hits": {name: float(surface.hit(*own).valid.float().mean()) for name, own in views.items()},
        "cores": rounds.cores,
    }


def _warm(spline: str) -> None:
    """Programs are compiled at their first use."""
    surface = HeightField(hills(512, 0), spline)
    surface.hit(torch.zeros(3), torch.ones(3))


def hills(size: int, seed: int) -> Tensor:
    """(size, size) float32: octaves of noise, the finest of two steps; those that two sizes have are the same."""
    total = torch.zeros(size, size)
    amplitude = _HEIGHT / 2
    for octave in range(1, max(2, math.ceil(math.log2(size)))):
        own = torch.rand(2**octave + 1, 2**octave + 1, generator=torch.Generator().manual_seed(seed + octave))
        own = interpolate(own[None, None] - 0.5, size=(size, size), mode="bicubic", align_corners=True)[0, 0]
        total += own.mul_(2 * amplitude)
        amplitude *= _ROUGHNESS
    return total


def rays(angle: float, pixels: int) -> tuple[Tensor, Tensor]:
    """Origins and directions (pixels, pixels, 3), float32."""
    turn = math.radians(angle)
    eye = (0.5, 0.5 - _DISTANCE * math.cos(turn), _DISTANCE * math.sin(turn))
    up = (0.0, math.sin(turn), math.cos(turn))
    camera = PerspectiveCamera(position=eye, target=(0.5, 0.5, 0.0), up=up, field_of_view=_FIELD_OF_VIEW)
    origins, directions = camera.rays(pixels, pixels)
    return origins.expand_as(directions).float().contiguous(), directions.float().contiguous()
