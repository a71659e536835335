"""What do level sets of splines on tetrahedra take? (Table 1 of paper 000, table 1 of paper 003, with other volumes.)

For every volume and spline: how many cells and tetrahedra may hold the level, what the papers list before they draw;
the memory and set-up of each way to hold the spline, and what value and gradient take of it at points of the surface;
what a change of level costs; pictures, whole and of a part, of which the time of full size is extrapolated by the
number of their rays where they are measured smaller.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator, Field
from torch import Tensor

import filterlab as fl
from experiments.config import BoundaryName, Recipe, distinct
from experiments.dvr_volume import WHOLE, Zoom
from experiments.partitions import SPLINES
from experiments.runs import Record, Run, Unit
from experiments.sampled import Sampled
from experiments.timing import CLOCKS, TimedConfig, quartile_record
from experiments.views import Window, magnified
from filterlab.costs import Quartiles, coefficient_bytes, take_turns
from filterlab.fields.determining import Determining, Held
from filterlab.fields.octahedral import JETS
from filterlab.fields.tetrahedral_pieces import FieldOnTetrahedra
from filterlab.fields.type6 import D2, D3
from filterlab.io.config import ConfigError, Problem
from filterlab.names import unknown_name
from filterlab.render.raycast import raycast
from filterlab.scenes import model as scene
from filterlab.surfaces import LevelSet

ABSENT = "absent"
NUMBERS: dict[str, tuple[str, Determining]] = {
    "qss": ("D2", D2),
    "cubic-c1": ("D3", D3),
    "quadratic-c1": ("jets", JETS),
}
"""What else than samples holds a spline."""

SECONDS_PER_RAY = 4e-4  # only expectations use it


class Source(Sampled):
    """A volume, and a level of it.

    Attributes:
        title: of its section.
        published: the row of the 2008 table that is of the same volume and level.
        zoom: the close-up.
    """

    title: Annotated[str, Field(min_length=1)]
    level: float
    published: Literal["neghip", "dragon", "aneurism", "lobbster", "foot", "bonsai"] | None = None
    camera: scene.CameraView = scene.CameraView()
    zoom: Zoom

    @property
    def windows(self) -> dict[str, Window | None]:
        """Both views, by a name for keys and files."""
        return {WHOLE: None, "close-up": self.zoom.window}

    def load(self) -> fl.Volume:
        if self.volume is not None:
            return self.volume.load().to(torch.float32)
        assert self.signal is not None
        assert self.resolution is not None
        return self.signal.build().sample(self.resolution, dtype=torch.float32)


def _splines(recipes: list[Recipe]) -> list[Recipe]:
    for recipe in recipes:
        if recipe.name not in SPLINES:
            raise ValueError(unknown_name("spline", recipe.name, SPLINES))
    return distinct(recipes)


Size = tuple[scene.Pixels, scene.Pixels]


class Config(TimedConfig):
    """Volumes, splines, and pictures of them.

    Attributes:
        methods: splines on tetrahedra, as they are to be measured.
        sizes: (width, height) of the pictures.
        scale: of both, of what is measured of them.
        points: at most, where value and gradient are timed.
        seconds: about, that each of the short times is measured for.
    """

    experiment: Literal["tetrahedral_table"]
    sources: Annotated[list[Source], Field(min_length=1)]
    methods: Annotated[list[Recipe], Field(min_length=1), AfterValidator(_splines)]
    sizes: Annotated[list[Size], Field(min_length=1)]
    scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    boundary: BoundaryName = "border"
    points: Annotated[int, Field(ge=1)] = 20_000
    seconds: Annotated[float, Field(ge=0)] = 1.0

    def measured(self, size: Size) -> Size:
        """What of a size is measured."""
        width, height = (max(round(self.scale * n), 1) for n in size)
        return width, height


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless signals can be evaluated, and scans, but for optional ones, are here."""
    for i, source in enumerate(config.sources):
        own = f"{path}sources[{i}]"
        domain = source.check(own)
        try:
            if domain is not None:
                source.camera.build(domain, config.sizes[0])
        except ValueError as error:
            raise ConfigError([Problem(source.title, f"{own}.camera", str(error))]) from None


def units(config: Config) -> list[Unit]:
    """One per volume and spline; one that says so where an optional volume is not here."""
    rays = 2 * sum(math.prod(config.measured(size)) for size in config.sizes)
    found = []
    for i, source in enumerate(config.sources):
        if not source.present:
            found.append(Unit(f"{i}/{ABSENT}", f"{source.title}: not here", 0.01))
            continue
        seconds = rays * SECONDS_PER_RAY + 3 * config.seconds
        found += [Unit(f"{i}/{r.key}", f"{source.title}, {r.key}", seconds) for r in config.methods]
    return found


@torch.no_grad()
def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one spline of one volume."""
    index, key = unit.key.split("/")
    source = config.sources[int(index)]
    if key == ABSENT:
        assert source.volume is not None
        return {"source": int(index), "kind": ABSENT, "file": source.volume.file}
    recipe = next(r for r in config.methods if r.key == key)
    volume = run.memo(f"volume:{index}", source.load)
    volume = volume.to(device=config.device)
    field, build = _timed(config, lambda: _field(recipe, volume, config.boundary))
    surface = LevelSet(field, source.level)
    relevant, listing = _timed(config, surface.relevant)
    frames, points = _frames(config, source, surface, run, f"{index}-{key}")
    forms = _forms(config, field, source.level, points, build, relevant.cells)
    return {
        "source": int(index),
        "kind": "spline",
        **recipe.record(),
        "voxels": list(volume.samples.shape[:-4:-1]),
        "cells": relevant.cells,
        "tetrahedra": relevant.pieces,
        "of_cells": _of_domain(field),
        "of_a_cell": len(field.scheme.spline.tetrahedra),
        "listing_seconds": listing,
        "level_seconds": _change(config, surface),
        "forms": forms,
        "frames": frames,
        "files": [frame["image"] for frame in frames],
    }


def _field(recipe: Recipe, volume: fl.Volume, boundary: str) -> FieldOnTetrahedra:
    field = recipe.build(volume, boundary)
    assert isinstance(field, FieldOnTetrahedra)
    return field


def _of_domain(field: FieldOnTetrahedra) -> int:
    """Cells with their centres in the domain: as many as voxels; of octahedra a quarter."""
    return math.prod(field.coefficients.size) // (4 if field.scheme.spline.period == 2 else 1)


def _timed(config: Config, work: Callable[[], Any]) -> tuple[Any, float]:
    """The result, and the seconds that it took by the config's clock."""
    begin = CLOCKS[config.clock]()
    result = work()
    if config.device != "cpu":
        torch.cuda.synchronize()
    return result, CLOCKS[config.clock]() - begin


# --- forms ------------------------------------------------------------------------------------------------------------


def _forms(
    config: Config, field: FieldOnTetrahedra, level: float, points: Tensor, build: float, cells: int
) -> list[Record]:
    """Samples, and numbers of the cells that may hold the level."""
    name, given = NUMBERS[field.scheme.spline.name]
    held, seconds = _timed(config, lambda: Held.of(field, given, torch.float32, level))
    voxels = field.domain.geometry.to_voxel(points.double()).float()
    voxels = voxels.clamp(*(voxels.new_tensor(end) for end in (field.domain.lower, field.domain.upper)))
    times = {"samples": [], name: []}
    if len(points):
        work = {"samples": lambda: field.jet(points, 1), name: lambda: held.jet(voxels, 1)}
        times = take_turns(work, seconds=config.seconds, clock=CLOCKS[config.clock]).seconds
    every = given.spline.period * math.prod(held.extent)
    of_cell = held.numbers.element_size() * len(given.masks)
    numbers, place = held.bytes
    return [
        {
            "form": "samples",
            "bytes": coefficient_bytes(field),
            "seconds": build,
            "ns_per_point": _nanoseconds(times["samples"], len(points)),
        },
        {
            "form": name,
            "numbers": len(given.masks),
            "bytes": every * of_cell,
            "relevant_bytes": cells * of_cell,
            "held_bytes": numbers,
            "place_bytes": place,
            "seconds": seconds,
            "ns_per_point": _nanoseconds(times[name], len(points)),
        },
    ]


def _nanoseconds(seconds: list[float], points: int) -> list[float] | None:
    """Quartiles for each point; None where there was none."""
    return quartile_record(Quartiles.of([1e9 * s / points for s in seconds])) if seconds else None


def _change(config: Config, surface: LevelSet) -> float:
    """Seconds that a new level costs: of one ray at a level that it was never cast at, less those at the same one."""
    domain = surface.domain
    center = torch.tensor([domain.center], dtype=torch.float32, device=config.device)
    direction = torch.tensor([[0.3, 0.5, 1.0]], device=config.device)
    origin = center - domain.diagonal * direction
    level, steps = float(surface.level), count(1)
    step = 1e-9 * max(abs(level), 1.0)
    work = {
        "changed": lambda: LevelSet(surface.field, level + step * next(steps)).hit(origin, direction),
        "kept": lambda: surface.hit(origin, direction),
    }
    found = take_turns(work, seconds=config.seconds, clock=CLOCKS[config.clock]).seconds
    apart = [a - b for a, b in zip(found["changed"], found["kept"], strict=True)]
    return Quartiles.of(apart).median


# --- pictures ---------------------------------------------------------------------------------------------------------


def _frames(config: Config, source: Source, surface: LevelSet, run: Run, stem: str) -> tuple[list[Record], Tensor]:
    """Every view at every size, and points of the surface that are seen in them, evenly chosen."""
    frames, seen = [], []
    _cast(surface, source.camera, (8, 8))  # what is found out about a field once is not the pictures'
    work = [(view, size) for view in source.windows for size in config.sizes]
    for n, (view, size) in enumerate(work):
        camera = magnified(source.camera, source.windows[view])
        image, seconds = _timed(config, partial(_cast, surface, camera, config.measured(size)))
        hit = image["color"][..., 3] > 0
        seen.append(image["position"][hit])
        frames.append(
            {
                "view": view,
                "size": list(size),
                "measured": list(config.measured(size)),
                "seconds": seconds,
                "frames_per_second": hit.numel() / (math.prod(size) * max(seconds, 1e-9)),
                "hit": float(hit.double().mean()),
                "image": run.save_image(f"{stem}-{view}-{n}", image["color"][..., :3].cpu()),
            }
        )
        run.advance((n + 1) / (len(work) + 1))
    points = torch.cat(seen).float()
    chosen = torch.linspace(0, max(len(points) - 1, 0), min(config.points, len(points))).long()
    return frames, points[chosen.to(points.device)]


def _cast(surface: LevelSet, camera: scene.CameraView, size: Size) -> dict[str, Tensor]:
    built = camera.build(surface.domain, size)
    channels = ("color", "position")
    image = raycast(surface, built, size=size, channels=channels, background=(1.0, 1.0, 1.0), device=surface.device)
    assert isinstance(image, dict)
    return image
