"""Pictures of values, not of light: the largest one along every ray, and those on a plane.

    rays ─▶ samples, or where they meet the plane ─▶ one value a pixel, NaN where there is none ─▶ `colored`

Values are the field's own, of any method; which sample is the largest is found by a program where the field's scheme is
fused. A band of pixels is in work at a time. A NaN of the field is a voxel without a value: it is passed over.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from filterlab.fields.base import Domain, Field
from filterlab.ops.differentiable import projection
from filterlab.ops.march import Chords
from filterlab.ops.reference.optics import dot, safe_normalize
from filterlab.ops.reference.projection import (
    BLOCK,
    BYTES_PER_SAMPLE,
    OnChords,
    middles,
    number_of_largest,
    rays_at_once,
)
from filterlab.render.camera import WHOLE, Camera, OrthographicCamera, Vector, Window
from filterlab.render.dvr import Cut
from filterlab.render.fused import projection_of
from filterlab.render.image import (
    CENTER,
    Canvas,
    PixelRays,
    Progress,
    View,
    as_view,
    check_background,
    check_field,
    device_of,
    reporting,
    unbatched,
)
from filterlab.render.rays import Region, check_region
from filterlab.render.sampling import Sampling

_PART = 1 << 15  # pixels at a time
_BYTES_PER_RAY = 256  # of a part: origins, directions, chords or points, values
_EDGE = 1e-9  # of the box, by which a plane on one of its faces may be beside it
_BESIDE = 1e-12  # cosine of a ray that runs beside a plane
_ALONG = 1e-3  # sine of the angle to a normal that lies along what is up


def maximum_projection(
    field: Field,
    camera: View,
    *,
    size: Sequence[int] | None = None,
    step: float = 0.5,
    region: Region | None = None,
    jitter_seed: int | None = None,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
    max_samples: int = 2**34,
    memory: int = 2**28,
    progress: Progress = False,
) -> Tensor:
    """The largest value along every ray (maximum intensity projection).

    M = max_i f(x_i), x_i the midpoints of the segments into which `render` cuts the ray. Samples that are NaN are
    passed over.

    Args:
        field, camera, size, region, jitter_seed, dtype, device, max_samples, memory, progress: as for `render`.
        step: in voxels of the field; with the step the error falls as its square where the maximum is smooth.

    Returns:
        `(H, W)` (or `(...)` for rays) values, NaN where a ray has none; `(N, C, H, W)` of a batched field.
        Differentiable in whatever the field was built from and in the rays, through the sample that is largest.

    Raises:
        TypeError, ValueError: as `render`.

    Source: Wallis et al., Three-dimensional display in nuclear medicine, 1989.
    """
    check_field(field)
    sampling = Sampling(step, jitter_seed, None, dtype, max_samples, memory)
    seen = _seen(camera, size, device)
    cut = _cut(field.domain, seen, sampling, region)
    total = sampling.check_count(_count(cut, seen) * len(unbatched(field)))

    def values(one: Field, part: range, report: Callable[[int], None]) -> Tensor:
        chords = cut(seen, seen.pixels(part))
        found = _largest(one, chords, cut.step, sampling)
        report(int(chords.count.sum()))
        return found

    return _filled(field, seen, values, dtype, progress, total)


def samples_of_projection(
    domain: Domain, camera: Camera, size: Sequence[int], sampling: Sampling, region: Region | None = None
) -> int:
    """How many samples `maximum_projection` takes of one field."""
    seen = _seen(camera, size, None)
    return sampling.check_count(_count(_cut(domain, seen, sampling, region), seen))


def _cut(domain: Domain, seen: PixelRays, sampling: Sampling, region: Region | None) -> Cut:
    asked = sampling.step_in(domain.voxel_size)
    step = min(asked, 2 * domain.diagonal)  # beyond that there is nothing to cut
    box = None if region is None else check_region(region)
    differentiable = torch.is_grad_enabled() and seen.requires_grad
    return Cut(domain, box, step, asked / step, sampling.jitter_seed, differentiable)


def _count(cut: Cut, seen: PixelRays) -> float:
    return sum(cut.count(seen, seen.pixels(part)) for part in seen.parts(_PART))


def _largest(field: Field, chords: Chords, step: float, sampling: Sampling) -> Tensor:
    """The largest value on every chord `(R,)`."""
    number = _number_of_largest(field.detached(), chords, step, sampling)
    some = (number >= 0).nonzero()[:, 0]
    found = torch.full_like(chords.length, math.nan, dtype=sampling.dtype)
    there = chords.at(some)
    values = _along(field, sampling.dtype)(there, middles(there, step, number[some, None]))
    return found.index_put((some,), values[:, 0])


def _number_of_largest(field: Field, chords: Chords, step: float, sampling: Sampling) -> Tensor:
    """The number of the first of the largest samples of every chord `(R,)`; −1 where none has a value."""
    if (given := projection_of(field, chords, step, sampling.dtype)) is not None:
        return projection.largest(given)
    return number_of_largest(_along(field, sampling.dtype), chords, step, sampling.dtype, sampling.memory)


def _along(field: Field, dtype: torch.dtype) -> OnChords:
    """Values in a type; points are measured from the first voxel, so that they keep their digits."""
    origin = field.domain.geometry.origin
    near = field.relative_to(origin)

    def values(chords: Chords, t: Tensor) -> Tensor:
        entry, direction = (chords.entry - chords.entry.new_tensor(origin)).to(dtype), chords.direction.to(dtype)
        return near(torch.addcmul(entry[:, None], t.to(dtype)[..., None], direction[:, None]))

    return values


def work_of_projection(rays: int, memory: int) -> int:
    """Bytes that samples and rays in work take at most, roughly."""
    part = min(rays, _PART)
    return min(part, rays_at_once(memory)) * BLOCK * BYTES_PER_SAMPLE + part * _BYTES_PER_RAY


def work_of_plane(rays: int) -> int:
    """Bytes that points in work take at most, roughly."""
    return min(rays, _PART) * _BYTES_PER_RAY


# --- planes -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plane:
    """The points x with normal · (x − point) = 0; seen from the side to which the normal points.

    Attributes:
        point: of the world.
        normal: world vector of any length. Both may be tensors that require grad.

    Raises:
        ValueError: not three finite numbers each, or a normal of zero.
    """

    point: Vector
    normal: Vector

    def __post_init__(self) -> None:
        for name in ("point", "normal"):
            vector = torch.as_tensor(getattr(self, name), dtype=torch.float64).detach()
            if vector.shape != (3,) or not vector.isfinite().all() or (name == "normal" and not vector.any()):
                zero = ", not all zero" if name == "normal" else ""
                raise ValueError(f"{name} of a plane must be three finite numbers{zero}; got {getattr(self, name)!r}")

    @classmethod
    def across(cls, axis: str, domain: Domain, position: float | None = None) -> Self:
        """The plane on which a world axis (x, y, z) has a value; default the middle of the domain.

        Its normal points to where the other two axes go to the right and up: +x, −y, +z.
        """
        if axis not in _NORMALS:
            raise ValueError(f"axis must be x, y or z; got {axis!r}")
        point = list(domain.center)
        if position is not None:
            point["xyz".index(axis)] = float(position)
        return cls(point, _NORMALS[axis])

    def camera(
        self,
        domain: Domain,
        *,
        up: Vector = (0.0, 0.0, 1.0),
        aspect: float = 1.0,
        margin: float = 1.05,
        window: Window = WHOLE,
    ) -> OrthographicCamera:
        """The camera that looks at it from the front, with all of `domain` in view.

        Args:
            up: what is up in the image; where it lies along the normal, z, and y where that does.
            aspect, margin, window: as for `OrthographicCamera.framing`.
        """
        normal, up = (torch.as_tensor(v, dtype=torch.float64).detach().cpu() for v in (self.normal, up))
        if torch.linalg.cross(normal, up).norm() < _ALONG * normal.norm() * up.norm():
            up = (0.0, 1.0, 0.0) if normal[:2].norm() < _ALONG * normal.norm() else (0.0, 0.0, 1.0)
        return OrthographicCamera.framing(domain, -normal, up=up, aspect=aspect, margin=margin, window=window)

    def met(self, origins: Tensor, directions: Tensor) -> Tensor:
        """How far along rays `(R, 3)` it is `(R,)`; NaN for those beside it or behind their origin."""
        point, normal = (
            torch.as_tensor(v, dtype=torch.float64, device=origins.device) for v in (self.point, self.normal)
        )
        normal = safe_normalize(normal)
        speed = dot(directions, normal)
        beside = speed.detach().abs() < _BESIDE
        t = dot(point - origins, normal) / torch.where(beside, torch.ones_like(speed), speed)
        return torch.where(beside | (t.detach() < 0), torch.nan, t)


_NORMALS = {"x": (1.0, 0.0, 0.0), "y": (0.0, -1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def plane_values(
    field: Field,
    plane: Plane,
    camera: View,
    *,
    size: Sequence[int] | None = None,
    region: Region | None = None,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
    progress: Progress = False,
) -> Tensor:
    """The field's values on a plane, as a camera sees it; `plane.camera(field.domain)` does from the front.

    Args:
        field, camera, size, region, dtype, device, progress: as for `render`.
        plane: what is cut.

    Returns:
        `(H, W)` (or `(...)` for rays) values, NaN where a ray does not meet the plane within the domain and the region;
        `(N, C, H, W)` of a batched field. Differentiable in whatever the field was built from, plane and rays.

    Raises:
        TypeError, ValueError: as `render`.
    """
    check_field(field)
    if not isinstance(plane, Plane):
        raise TypeError(f"plane must be a Plane; got {type(plane).__name__}")
    Sampling(dtype=dtype)  # which checks the type
    seen = _seen(camera, size, device)
    box = None if region is None else check_region(region)

    def values(one: Field, part: range, report: Callable[[int], None]) -> Tensor:
        found = _on_plane(one, plane, *seen.rays(seen.pixels(part), CENTER), box, dtype)
        report(len(part))
        return found

    return _filled(field, seen, values, dtype, progress, seen.count * len(unbatched(field)))


def _on_plane(
    field: Field, plane: Plane, origins: Tensor, directions: Tensor, box: Region | None, dtype: torch.dtype
) -> Tensor:
    """Values where rays meet the plane `(R,)`."""
    t = plane.met(origins, directions)
    points = origins + torch.where(t.isnan(), 0, t)[:, None] * directions
    domain = field.domain
    inside = ~t.isnan() & _within(domain.geometry.to_voxel(points.detach()), domain.lower, domain.upper)
    if box is not None:
        inside &= _within(points.detach(), *box)
    found = torch.full_like(t, math.nan, dtype=dtype, requires_grad=False)
    origin = domain.geometry.origin
    near = (points[inside] - points.new_tensor(origin)).to(dtype)
    return found.index_put((inside,), field.relative_to(origin)(near))


def _within(points: Tensor, lower: Sequence[float], upper: Sequence[float]) -> Tensor:
    low, high = points.new_tensor(lower), points.new_tensor(upper)
    edge = _EDGE * (high - low)
    return ((points >= low - edge) & (points <= high + edge)).all(-1)


# --- both -------------------------------------------------------------------------------------------------------------


def _seen(camera: View, size: Sequence[int] | None, device: torch.device | str | None) -> PixelRays:
    camera = as_view(camera)
    return PixelRays.of(camera, size, torch.device(device or device_of(camera) or "cpu"))


def _filled(
    field: Field,
    seen: PixelRays,
    values: Callable[[Field, range, Callable[[int], None]], Tensor],
    dtype: torch.dtype,
    progress: Progress,
    total: int,
) -> Tensor:
    """The image of what `values(field, places, report)` finds, part by part."""
    canvas = Canvas(seen, field.channels, torch.is_grad_enabled(), width=1)
    done = 0
    with reporting(progress, total) as report:

        def more(count: int) -> None:
            nonlocal done
            done += count
            report(done)

        def found() -> Iterator[tuple[int, range, Tensor]]:
            for number, one in enumerate(unbatched(field)):
                for part in seen.parts(_PART):
                    yield number, part, values(one, part, more)[:, None]

        image = canvas.filled(found(), torch.zeros(0, dtype=dtype, device=seen.pixels(range(0)).device))
    return image[..., 0]


Colors = Callable[[Tensor], Tensor]
"""Linear RGB (..., 3) of values (...), as of a `ColorScale`."""


def colored(values: Tensor, colors: Colors, background: Sequence[float] | Tensor = (0.0, 0.0, 0.0)) -> Tensor:
    """The image `(..., 4)` of values `(...)`: linear RGB, and opacity 1; over the background and 0 where they are NaN.

    Differentiable in the values, the background and what the colours depend on.
    """
    nothing = values.detach().isnan()
    rgb = colors(torch.where(nothing, torch.zeros_like(values), values))
    behind = check_background(background, values.device).to(rgb)
    rgb = torch.where(nothing[..., None], behind, rgb)
    return torch.cat((rgb, (~nothing)[..., None].to(rgb)), -1)
