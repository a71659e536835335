"""Ways to reconstruct a volume, and what each costs on this machine: methods with a scheme and a storage."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from filterlab import costs
from filterlab.fields.base import Field
from filterlab.fields.grid import GridField
from filterlab.methods import Method, reconstruct
from filterlab.volume import Boundary, Volume

STORAGE = ("float16", "int16", "uint8")

_CROP = 160  # voxels along an axis of the part that costs are measured on
_RAYS, _SAMPLES = 128, 64

Way = tuple[str, str, str | None]
"""Method, scheme, storage."""


def ways_of(method: Method, dtype: torch.dtype, all_of_them: bool) -> Iterator[Way]:
    """The first scheme that runs; or every scheme that gives the method's own gradient, and shorter storage."""
    first = _first_scheme(method, dtype)
    yield method.name, first, None
    if all_of_them:
        for scheme in method.schemes:
            if scheme != first and method.gradient_of(scheme) == method.gradients[0]:
                yield method.name, scheme, None
        for storage in STORAGE:
            yield method.name, first, storage


def _first_scheme(method: Method, dtype: torch.dtype) -> str:
    """What `reconstruct` takes for such samples when it is not told."""
    return reconstruct(torch.zeros(2, 2, 2, dtype=dtype), method).scheme.name


@dataclass(frozen=True)
class WayCost:
    """Seconds to build the whole field, nanoseconds per sample, bytes of its coefficients."""

    build: float
    nanoseconds: float
    memory: int


def costs_of(
    samples: Tensor,
    volume: Volume,
    ways: list[Way],
    boundary: Boundary,
    order: int,
    seconds: float,
    tick: Callable[[float], None] = lambda done: None,
) -> dict[Way, WayCost]:
    """Of the ways that can run here: measured on the middle of (D, H, W), and carried over to the whole volume.

    Samples are jets of that order: 0 values, 1 values and gradients.
    """
    part = samples
    for dim, n in enumerate(samples.shape):
        edge = min(n, _CROP)
        part = part.narrow(dim, (n - edge) // 2, edge)
    part = part.contiguous()
    points = _points_along_rays(part)
    fields = {way: _built(part, way, boundary) for way in ways}
    runs = {way: field for way, field in fields.items() if field is not None and not _stored_so_anyway(way, fields)}
    builders = {"/".join(map(str, way)): (lambda way=way: _built(part, way, boundary)) for way in runs}
    taken = costs.measure(builders, points, order=order, seconds=seconds, tick=tick)  # type: ignore[arg-type]
    whole = math.prod(volume.shape) / part.numel()
    found = {}
    for way, field in runs.items():
        cost = taken["/".join(map(str, way))]
        found[way] = WayCost(cost.build.median * whole, cost.sample.median, _memory_of_whole(field, part, volume))
    return found


def _built(part: Tensor, way: Way, boundary: Boundary) -> Field | None:
    """The field, or None where it can't be as asked here (numbers that a short type does not hold, no fused scheme)."""
    method, scheme, storage = way
    try:
        return reconstruct(part, method, boundary=boundary, scheme=scheme, storage=storage)
    except ValueError:
        return None


def _stored_so_anyway(way: Way, fields: dict[Way, Field | None]) -> bool:
    """Whether the storage asked for is the one that coefficients have without it."""
    field = fields.get((way[0], way[1], None))
    return isinstance(field, GridField) and str(field.coefficients.values.dtype) == f"torch.{way[2]}"


def _points_along_rays(part: Tensor) -> Tensor:
    """Points at half a voxel from one another along rays, as a renderer or a resampler visits them."""
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([n - 1 for n in reversed(part.shape)], dtype=torch.float32)
    start = torch.rand(_RAYS, 1, 3, generator=generator, dtype=torch.float32) * size
    direction = torch.randn(_RAYS, 1, 3, generator=generator, dtype=torch.float32)
    along = 0.5 * torch.arange(_SAMPLES, dtype=torch.float32)[:, None]
    points = start + along * direction / direction.norm(dim=-1, keepdim=True)
    return points.clamp_min(0).minimum(size).reshape(-1, 3).to(part.device)


def _memory_of_whole(field: Field, part: Tensor, volume: Volume) -> int:
    """Bytes of the coefficients of all of the volume, padded as those of its part are."""
    if not isinstance(field, GridField):
        return costs.coefficient_bytes(field) * math.prod(volume.shape) // part.numel()
    values = field.coefficients.values
    pads = [n - m for n, m in zip(values.shape, reversed(field.coefficients.size), strict=True)]
    padded = [n + pad for n, pad in zip(volume.shape[-3:], pads, strict=True)]
    return math.prod(volume.shape[:-3]) * math.prod(padded) * values.dtype.itemsize
