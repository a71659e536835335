"""What a scene will take: derived from the very frame that `render` would run, and from a small part of it that is run.

scene ──▶ Prepared ──▶ Frame (dvr.prepare) ──▶ rays, segments, derivative order, marcher
                           │
                           └─ some of the rays, marched ──▶ time;   their segments in empty bricks ──▶ what is skipped
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import Any

import torch

from filterlab.costs import Quartiles, coefficient_bytes
from filterlab.fields.grid import GridField
from filterlab.methods import METHODS
from filterlab.ops.march import Chords
from filterlab.ops.reference.march import segments
from filterlab.render.dvr import Frame
from filterlab.render.fused import FusedMarcher, empty_bricks, why_not_fused
from filterlab.render.plain import Medium
from filterlab.scenes.build import Prepared
from filterlab.scenes.model import Scene

_PROBE_RAYS = 4096
_PROBE_SEGMENTS = 1 << 21
_REPEATS = 5
_DERIVATIVES = ("values", "values and gradients", "values, gradients and Hessians")


@dataclass(frozen=True)
class Plan:
    """What rendering a scene takes.

    Attributes:
        method, scheme, storage: of the field; the method of a signal that is not sampled is `exact`.
        taps: coefficients that one value needs; None where there are none.
        order: the highest derivative that is asked of the field: 1 with lighting, else 0.
        marcher: fused or plain.
        not_fused: why the marcher is plain.
        rays, samples: of the whole image; samples before any is skipped or left out behind what is opaque.
        empty_bricks: which part of the bricks has no opacity; None: no brick is known, as none is looked for.
        skipped: which part of the samples lies in them.
        step: in voxels.
        volume_bytes, coefficient_bytes, image_bytes, ray_bytes: memory; rays are those that are in work or kept.
        seconds: of the march, from the median and the quartiles of a few runs of some rays.
        absent: what the scene leaves out and is therefore not computed.
        chosen: how `method: auto` came to its choice, or nothing.
    """

    method: str
    scheme: str
    storage: str
    taps: int | None
    order: int
    marcher: str
    not_fused: str | None
    rays: int
    samples: int
    empty_bricks: float | None
    skipped: float | None
    step: float
    volume_bytes: int
    coefficient_bytes: int
    image_bytes: int
    ray_bytes: int
    seconds: Quartiles
    absent: tuple[str, ...]
    chosen: tuple[str, ...] = ()

    @property
    def derivatives(self) -> str:
        """The order in words."""
        return _DERIVATIVES[self.order]

    def data(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


def plan(prepared: Prepared) -> Plan:
    """The plan of a scene that is built; some of its rays are marched, the picture is not.

    Takes as long as a few thousand rays do, five times over.
    """
    frame = prepared.frame()
    medium, some = frame.media[0], _some_rays(frame)
    seconds = _seconds(frame, medium, some)
    empty, skipped = _skipped(frame, medium, some)
    field = prepared.field
    known = isinstance(field, GridField)
    return Plan(
        method=field.method if known else "exact",
        scheme=field.scheme.name,
        storage=str(field.coefficients.values.dtype).removeprefix("torch.") if known else "–",
        taps=METHODS[field.method].facts.taps if known and field.method in METHODS else None,
        order=medium.order,
        marcher="fused" if isinstance(frame.marcher, FusedMarcher) else "plain",
        not_fused=why_not_fused(medium),
        rays=frame.pixels,
        samples=frame.samples,
        empty_bricks=empty,
        skipped=skipped,
        step=prepared.scene.step_or_default,
        volume_bytes=prepared.volume_bytes,
        coefficient_bytes=coefficient_bytes(field),
        image_bytes=frame.image_bytes,
        ray_bytes=frame.ray_bytes,
        seconds=seconds,
        absent=_absent(prepared.scene),
        chosen=prepared.chosen,
    )


def _some_rays(frame: Frame) -> Chords:
    """Every k-th ray, so many that a few thousand rays or a few million segments are marched."""
    fewest = max(frame.samples // _PROBE_SEGMENTS, frame.pixels // _PROBE_RAYS, 1)
    first = fewest // 2
    device = frame.media[0].transfer.positions.device
    return frame.chords(torch.arange(min(first, frame.pixels - 1), frame.pixels, fewest, device=device))


def _seconds(frame: Frame, medium: Medium, some: Chords) -> Quartiles:
    """Of all rays of all images, from runs of some; the first run, which compiles, does not count."""
    share = len(some.count) / (frame.pixels * len(frame.media))
    taken = []
    for _ in range(_REPEATS + 1):
        start = time.perf_counter()
        light, _ = frame.marcher.march(medium, some, lambda done: None)
        if light.device.type == "cuda":
            torch.cuda.synchronize(light.device)
        taken.append((time.perf_counter() - start) / share)
    return Quartiles.of(taken[1:])


def _skipped(frame: Frame, medium: Medium, some: Chords) -> tuple[float | None, float | None]:
    """(part of the bricks that is empty, part of the segments of some rays whose middles lie in them)."""
    if not isinstance(frame.marcher, FusedMarcher):
        return None, None
    found = empty_bricks(medium)
    if found is None:
        return 0.0, 0.0
    empty = found.bricks.distance > 0
    longest = int(some.count.max()) if len(some.count) else 0
    inside = total = 0
    for first in range(0, longest, 64):
        middle, _ = segments(some.length, medium.step, first, 64, some.offset)
        real = torch.arange(first, first + 64, device=middle.device) < some.count[:, None]
        points = some.entry[:, None] + middle[..., None] * some.direction[:, None]
        inside += int(found.empty(points[real]).sum())
        total += int(real.sum())
    return float(empty.double().mean()), inside / max(total, 1)


def _absent(scene: Scene) -> tuple[str, ...]:
    """What is not computed, because the scene does not ask for it."""
    parts = []
    if scene.lighting is None:
        parts.append("lighting: no gradient is computed")
    if scene.region is None:
        parts.append("region: rays are cut to the volume only")
    if scene.jitter is None:
        parts.append("jitter")
    if scene.termination is None:
        parts.append("termination: rays end only behind what is exactly opaque")
    return tuple(parts)
