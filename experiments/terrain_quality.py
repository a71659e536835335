"""What does smoothness look like? Splines of heights as normals, lit, as reflection lines (paper 004, figs 9, 14-16).

Franke's function on [0, 1]², as high as `height` says, is sampled for every spline: as often for all of them ("same"),
and as often as each needs for its RMS error to stay below that of one of them ("equal"). Beside them stands the
function itself. All surfaces are hit exactly. Of what is seen

    angle between the spline's normal and that of the function above the same point of the plane, mean and maximum
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator, Field
from torch import Tensor

from experiments.config import ExperimentConfig, number
from experiments.runs import Record, Run, Unit, timed
from experiments.terrain_error import CHUNK, Kind, Truth, distinct_kinds, franke, sampled, spline_of
from filterlab import metrics
from filterlab.io.config import StrictModel
from filterlab.render import ByNormal, Lambertian, PerspectiveCamera, ReflectionLines, Unlit, raycast, sun
from filterlab.render.materials import Material
from filterlab.render.scenery import toward
from filterlab.scenes.model import Positive
from filterlab.surfaces import HeightField

TRUTH, SAME, EQUAL = "function", "same", "equal"
LOOKS = ("normals", "illumination", "reflection lines")
MOST_STEPS = 3072

Look = Literal["normals", "illumination", "reflection lines"]


class Reference(StrictModel):
    """Whose error the others are to stay below, and from how many steps of data."""

    spline: Kind = "linear"
    steps: Annotated[int, Field(ge=12, le=MOST_STEPS)] = 60


class Config(ExperimentConfig):
    """Pictures of splines of heights.

    Attributes:
        steps: of the same data along an axis: a multiple of 12, so that all splines have whole cells.
        reference: of equal errors.
        height: of the function in the pictures, as part of its own.
        points: where errors are measured.
        view: azimuth of the camera from +y clockwise, and how many degrees it looks down.
        lines: stripes of light around the surface.
    """

    experiment: Literal["terrain_quality"]
    splines: Annotated[list[Kind], Field(min_length=1), AfterValidator(distinct_kinds)]
    looks: Annotated[list[Look], Field(min_length=1)] = list(LOOKS)  # noqa: RUF012
    steps: Annotated[int, Field(ge=12, le=1200, multiple_of=12)] = 12
    reference: Reference = Reference()
    height: Positive = 0.4
    points: Annotated[int, Field(ge=10, le=10**7)] = 10**5
    size: tuple[Annotated[int, Field(ge=4, le=4096)], Annotated[int, Field(ge=4, le=4096)]] = (380, 220)
    subpixels: Annotated[int, Field(ge=1, le=8)] = 3
    view: tuple[float, Annotated[float, Field(gt=0, lt=90)]] = (25.0, 38.0)
    lines: Positive = 14.0


def units(config: Config) -> list[Unit]:
    """The numbers of data first, then a picture of every surface in every look."""
    width, height = config.size
    seconds = 2e-6 * width * height * config.subpixels**2
    counts = [Unit(f"data/{kind}", f"data of {kind} for equal errors", 2.0) for kind in config.splines]
    surfaces = [(TRUTH, TRUTH), *((group, kind) for group in (SAME, EQUAL) for kind in config.splines)]
    return counts + [
        Unit(f"{group}/{kind}/{look}", f"{look} of {kind}, {group}", seconds)
        for look in config.looks
        for group, kind in surfaces
    ]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit."""
    group, kind, *look = unit.key.split("/")
    if group == "data":
        return {"kind": "data", "spline": kind, **_enough(config, kind, run)}
    surface, told = run.memo(f"surface:{group}/{kind}", lambda: _surface(config, group, kind, run))
    (image, angles), seconds = timed(lambda: _drawn(config, surface, look[0], run))
    saved = run.save_image(f"{group}-{kind}-{look[0]}".replace(" ", "-"), image)
    common = {"kind": "picture", "group": group, "spline": kind, "look": look[0], "seconds": seconds}
    return {**common, **told, **angles, "image": saved, "files": [saved]}


# --- surfaces ---------------------------------------------------------------------------------------------------------


def _surface(config: Config, group: str, kind: str, run: Run) -> tuple[HeightField, Record]:
    """One of the splines, or the function as the best of them makes it of 768² steps: off by 3e-10 and less."""
    if group == TRUTH:
        return _raised(config, "c0", 768), {}
    steps = config.steps if group == SAME else run.records[f"data/{kind}"]["steps"]
    terrain = sampled(franke, kind, steps)
    told = {"steps": steps, "data": (steps + 1) ** 2, "rms": number(_rms(terrain, _truth(config, run)))}
    return _raised(config, kind, steps), told


def _raised(config: Config, kind: str, steps: int) -> HeightField:
    return sampled(lambda x, y: config.height * franke(x, y), kind, steps)


def _truth(config: Config, run: Run) -> Truth:
    return run.memo("truth", lambda: Truth.of(franke, config.points, config.seed, config.device))


def _rms(terrain: HeightField, truth: Truth) -> float:
    """As part of the greatest value of the function."""
    with torch.no_grad():
        found = torch.cat([terrain.jet(points, 0)[0] for points in truth.points.split(CHUNK)])
    return float(metrics.rms(found, truth.value)) / truth.greatest


def _enough(config: Config, kind: str, run: Run) -> Record:
    """The fewest steps, in whole cells, of which the error is no larger than the reference's."""
    truth, reference = _truth(config, run), config.reference
    goal = _rms(sampled(franke, reference.spline, reference.steps), truth)
    cell = spline_of(kind).steps
    enough = lambda cells: _rms(sampled(franke, kind, cells * cell), truth) <= goal * (1 + 1e-12)  # noqa: E731
    high = 1
    while not enough(high):
        high *= 2
        if high * cell > MOST_STEPS:
            return {"steps": MOST_STEPS // cell * cell, "goal": number(goal), "reached": False}
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return {"steps": high * cell, "goal": number(goal), "reached": True}


# --- pictures ---------------------------------------------------------------------------------------------------------


@torch.no_grad()
def _drawn(config: Config, surface: HeightField, look: str, run: Run) -> tuple[Tensor, dict[str, Any]]:
    """(linear RGB (H, W, 3), angles of the normals that are seen)."""
    top = 1.3 * config.height
    given: dict[str, Any] = {
        "camera": _camera(config, top),
        "size": config.size,
        "region": ((0.0, 0.0, -top), (1.0, 1.0, top)),
        "dtype": torch.float64,
    }
    image = raycast(
        surface,
        material=_material(config, look),
        lights=[sun(-60.0, 35.0, (1.0, 0.97, 0.92))],
        background=(1.0, 1.0, 1.0),
        subpixels=config.subpixels,
        seed=config.seed,
        progress=lambda done, total: run.advance(done / max(total, 1)),
        **given,
    )
    assert isinstance(image, Tensor)
    seen = raycast(surface, channels=("position", "normal", "sheets"), **given)
    assert isinstance(seen, dict)
    hit = seen["sheets"][..., 0] > 0
    return image[..., :3].float(), _angles(config, seen["position"][hit], seen["normal"][hit])


def _camera(config: Config, top: float) -> PerspectiveCamera:
    corners = torch.cartesian_prod(*(torch.tensor([0.0, 1.0]),) * 2, torch.tensor([0.0, 0.8 * top]))
    azimuth, down = config.view
    width, height = config.size
    return PerspectiveCamera.of_points(corners, toward(azimuth, -down), aspect=width / height, margin=1.0)


def _material(config: Config, look: str) -> Material:
    if look == "normals":
        return Unlit(ByNormal())
    if look == "illumination":
        return Lambertian((0.75, 0.62, 0.42), (0.18, 0.2, 0.25))
    return ReflectionLines((1.0, 0.4, 0.0), config.lines, 6.0)


def _angles(config: Config, points: Tensor, normals: Tensor) -> dict[str, Any]:
    """Degrees between normals (M, 3) and those of the function above the same places."""
    if not len(points):
        return {}
    with torch.enable_grad():
        x, y = (points[:, k].clone().requires_grad_() for k in range(2))
        slopes = torch.autograd.grad((config.height * franke(x, y)).sum(), (x, y))
    own = torch.stack((-slopes[0], -slopes[1], torch.ones_like(x)), -1)
    away = torch.linalg.cross(own, normals).norm(dim=-1).atan2((own * normals).sum(-1)).rad2deg()
    return {"angle_mean": number(away.mean()), "angle_max": number(away.max())}
