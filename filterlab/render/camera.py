"""Cameras: where the rays of an image start and where they go.

Letters used in this file: the image plane is measured from its upper left corner, u to the right and v downwards, both
0 … 1 over the *whole* plane; a window picks the part of it that becomes the image. Image sizes are (width, height);
tensors of pixels are (H, W, …). Cameras live in the world and compute in float64.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from filterlab.arrays import Array, as_numbers
from filterlab.fields.base import Domain, Field
from filterlab.geometry import times_matrix
from filterlab.ops.reference.optics import Table
from filterlab.render import suggestion
from filterlab.render.transfer import TransferFunction

Vector = Sequence[float] | Array
Window = tuple[float, float, float, float]
WHOLE: Window = (0.0, 0.0, 1.0, 1.0)

_PASSES = 8  # that bring what is seen to the middle, to a thousandth of the image
_LARGEST_EXPONENT = 1000  # of a power of two that is a number of float64, as its inverse is


@dataclass(frozen=True, kw_only=True)
class Camera(ABC):
    """A camera at `position` that looks at `target`, with `up` pointing up in the image.

    Every vector may be a tensor that requires grad: rays are differentiable in the pose.

    Attributes:
        position, target, up: world vectors of 3 numbers; `up` need neither be a unit vector nor orthogonal to the view.
        window: (left, top, right, bottom), the part of the image plane that becomes the image, in 0 … 1. Pixels are
            always square: the plane's aspect ratio follows from the image size and the window, so that the view through
            a window is exactly a magnified crop: size (W, H) through (¼, ¼, ¾, ¾) are the middle pixels of (2W, 2H).

    Raises:
        ValueError: a vector that is not three finite numbers, `target` at `position`, `up` zero or along the view, or a
            window that is empty or not within 0 … 1.
    """

    position: Vector
    target: Vector
    up: Vector = (0.0, 0.0, 1.0)
    window: Window = WHOLE

    def __post_init__(self) -> None:
        for name in ("position", "target", "up"):
            _check_vector(name, getattr(self, name))
        check_window(self.window)
        _basis(*(_vector(v).detach().cpu() for v in (self.position, self.target, self.up)))

    @property
    def requires_grad(self) -> bool:
        """True when any parameter is a tensor that requires grad."""
        return any(isinstance(v, Tensor) and v.requires_grad for v in vars(self).values())

    @property
    def device(self) -> torch.device | None:
        """The device of the first parameter that is a tensor, else None."""
        return next((v.device for v in vars(self).values() if isinstance(v, Tensor)), None)

    def rays(self, width: int, height: int, device: torch.device | str | None = None) -> tuple[Tensor, Tensor]:
        """World origins and unit directions `(H, W, 3)`, float64, of the rays through all pixel centres."""
        width, height = check_size((width, height))
        device = device or self.device
        pixels = torch.arange(width * height, device=device)
        origins, directions = self.pixel_rays(pixels, width, height)
        return origins.reshape(height, width, 3), directions.reshape(height, width, 3)

    def pixel_rays(
        self, pixels: Tensor, width: int, height: int, place: tuple[Tensor | float, Tensor | float] = (0.5, 0.5)
    ) -> tuple[Tensor, Tensor]:
        """Origins and unit directions `(R, 3)` through `pixels` `(R,)`, numbered row by row from 0.

        A ray depends on nothing but its own pixel, so that an image may be cut into tiles at will.

        Args:
            place: within each pixel, from left and top, in 0 … 1; the centre.
        """
        across, down = place
        left, top, right, bottom = self.window
        number = pixels.double()  # whole numbers are exact, and divided ten times as fast as integers
        row = ((number + 0.5) / width).floor()
        u = left + (number - row * width + across) * ((right - left) / width)
        v = top + (row + down) * ((bottom - top) / height)
        aspect = (width * (bottom - top)) / (height * (right - left))
        return self._rays((2 * u - 1) * aspect, 1 - 2 * v)

    def turned(self, degrees: float, axis: Vector | None = None) -> Self:
        """This camera moved round its target about an axis, counter-clockwise seen from where that points.

        position' = target + v cos φ + (k × v) sin φ + k (k·v)(1 − cos φ),   v = position − target, k = axis / |axis|

        Args:
            axis: None: `up`. Another one turns `up` as well.

        Source: Rodrigues, Des lois géométriques qui régissent les déplacements d'un système solide, 1840.
        """
        position, target, up = (_vector(v, self.device) for v in (self.position, self.target, self.up))
        k = _unit(up if axis is None else _vector(axis, self.device))
        moved = replace(self, position=target + _rotated(position - target, k, degrees))
        return moved if axis is None else replace(moved, up=_rotated(up, k, degrees))

    @abstractmethod
    def _rays(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Rays through plane positions x (right), y (up) `(R,)`, in half heights of the image plane from its centre."""

    def _frame(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """position and the orthonormal right, up, forward, each `(3,)`."""
        position, target, up = (_vector(v, device) for v in (self.position, self.target, self.up))
        return position, *_basis(position, target, up)


@dataclass(frozen=True, kw_only=True)
class PerspectiveCamera(Camera):
    """A pinhole camera.

    Attributes:
        field_of_view: vertical angle of the whole image plane in degrees, between 0 and 180; may require grad.
    """

    field_of_view: float | Tensor = 30.0

    def __post_init__(self) -> None:
        super().__post_init__()
        angle = _number("field_of_view must lie between 0 and 180 degrees", self.field_of_view)
        if not 0 < angle < 180:  # a NaN fails too
            raise ValueError(f"field_of_view must lie between 0 and 180 degrees; got {angle}")

    def _rays(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        position, right, up, forward = self._frame(x.device)
        half = torch.tan(torch.deg2rad(_vector(self.field_of_view, x.device)) / 2)
        direction = forward + (half * x)[:, None] * right + (half * y)[:, None] * up
        # forward, right, up are orthonormal: the length needs no sum over components
        length = (1 + half * half * (x * x + y * y)).sqrt()
        return position.expand_as(direction), direction / length[:, None]

    @classmethod
    def framing(
        cls,
        domain: Domain,
        direction: Vector = (0.0, 1.0, 0.0),
        *,
        up: Vector = (0.0, 0.0, 1.0),
        field_of_view: float = 30.0,
        aspect: float = 1.0,
        margin: float = 1.05,
        window: Window = WHOLE,
    ) -> Self:
        """The camera looking along `direction` at the centre of `domain`, as near as it can while all of it is in view.

        Args:
            domain: what to see.
            direction: the world direction in which the camera looks.
            up, field_of_view, window: as for the camera.
            aspect: width / height of the whole image plane.
            margin: the box fills 1/margin of the image plane in one direction or the other; at least 1.
        """
        seen = _Seen.of(domain.corners(), direction, up, aspect, margin)
        return cls._of(seen, up, field_of_view, window)

    @classmethod
    def suggested(
        cls,
        field: Field,
        transfer: TransferFunction | None = None,
        direction: Vector | None = None,
        *,
        up: Vector = (0.0, 0.0, 1.0),
        field_of_view: float = 25.0,
        aspect: float = 1.0,
        margin: float = 1.05,
        samples: suggestion.Sampled | None = None,
    ) -> Self:
        """The camera with all that is seen of a field in view, as near as it can be, and in the middle.

        Args:
            field: unbatched.
            transfer: what its values look like; None: `TransferFunction.suggested`.
            direction: the world direction in which the camera looks; None: along no axis, somewhat downwards, and of
                anatomical coordinates from the front.
            up, field_of_view, aspect, margin: as in `framing`.
            samples: as for `TransferFunction.suggested`.

        Raises:
            ValueError: as `framing` and `TransferFunction.suggested`.
        """
        given = samples or suggestion.sampled(field)
        table = Table(*suggestion.tables(given), 1.0) if transfer is None else transfer.to(torch.float64, "cpu")
        value = given.values.nan_to_num(float(table.positions.detach()[0]))
        opacity = table.opacity(table.locate(value)).detach().masked_fill(given.values.isnan(), 0)
        points = suggestion.seen(given, opacity)
        direction = suggestion.direction_for(field) if direction is None else direction
        return cls.of_points(points, direction, up=up, field_of_view=field_of_view, aspect=aspect, margin=margin)

    @classmethod
    def of_points(
        cls,
        points: Array,
        direction: Vector,
        *,
        up: Vector = (0.0, 0.0, 1.0),
        field_of_view: float = 25.0,
        aspect: float = 1.0,
        margin: float = 1.05,
        window: Window = WHOLE,
    ) -> Self:
        """The camera with world points (M, 3) in view, as near as it can be, and them in the middle.

        Raises ValueError as `framing`.
        """
        points = _vector(points).cpu()
        seen = _Seen.of(points, direction, up, aspect, margin).centered(_half_height(field_of_view))
        return cls._of(seen, up, field_of_view, window)

    @classmethod
    def _of(cls, seen: _Seen, up: Vector, field_of_view: float, window: Window = WHOLE) -> Self:
        """As near as it can be."""
        distance = seen.distance(_half_height(field_of_view))
        return cls(
            position=(seen.center - distance * seen.forward).tolist(),
            target=seen.center.tolist(),
            up=up,
            window=window,
            field_of_view=field_of_view,
        )


@dataclass(frozen=True, kw_only=True)
class OrthographicCamera(Camera):
    """A camera with parallel rays. They start on the plane through `position`; what lies behind it is not seen.

    Attributes:
        height: world height of the whole image plane, positive; may require grad.
    """

    height: float | Tensor

    def __post_init__(self) -> None:
        super().__post_init__()
        height = _number("height must be a positive world length", self.height)
        if not 0 < height < math.inf:
            raise ValueError(f"height must be a positive world length; got {height}")

    def _rays(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        position, right, up, forward = self._frame(x.device)
        half = _vector(self.height, x.device) / 2
        origin = position + (half * x)[:, None] * right + (half * y)[:, None] * up
        return origin, forward.expand_as(origin)

    @classmethod
    def framing(
        cls,
        domain: Domain,
        direction: Vector = (0.0, 1.0, 0.0),
        *,
        up: Vector = (0.0, 0.0, 1.0),
        aspect: float = 1.0,
        margin: float = 1.05,
        window: Window = WHOLE,
    ) -> Self:
        """The camera looking along `direction` with all of `domain` in view; arguments as for the perspective one."""
        seen = _Seen.of(domain.corners(), direction, up, aspect, margin)
        return cls._of(seen, up, window, domain.diagonal)

    @classmethod
    def of_points(
        cls,
        points: Array,
        direction: Vector,
        *,
        up: Vector = (0.0, 0.0, 1.0),
        aspect: float = 1.0,
        margin: float = 1.05,
        window: Window = WHOLE,
    ) -> Self:
        """The camera with world points (M, 3) in view, as large as can be, and them in the middle.

        Raises ValueError as `framing`.
        """
        points = _vector(points).cpu()
        seen = _Seen.of(points, direction, up, aspect, margin)
        low, high = seen.points.aminmax(dim=0)
        return cls._of(seen.about((low + high) / 2), up, window, float((high - low).norm()) or 1.0)

    @classmethod
    def _of(cls, seen: _Seen, up: Vector, window: Window, distance: float) -> Self:
        """From a distance at which all of it is in front."""
        return cls(
            position=(seen.center - distance * seen.forward).tolist(),
            target=seen.center.tolist(),
            up=up,
            window=window,
            height=2 * float(seen.reach.max()) or 1.0,
        )


def _half_height(field_of_view: float) -> float:
    """Of an image plane at distance 1. Raises ValueError for no angle."""
    if not 0 < field_of_view < 180:
        raise ValueError(f"field_of_view must lie between 0 and 180 degrees; got {field_of_view}")
    return math.tan(math.radians(field_of_view) / 2)


def check_size(size: Sequence[int]) -> tuple[int, int]:
    """(width, height) as two positive integers. Raises ValueError otherwise."""
    values = tuple(size) if isinstance(size, Sequence) else ()
    if len(values) != 2 or not all(isinstance(n, int) and not isinstance(n, bool) and n > 0 for n in values):
        raise ValueError(f"size must be two positive integers (width, height); got {size!r}")
    return values[0], values[1]


def _vector(value: Vector | float, device: torch.device | None = None) -> Tensor:
    return as_numbers(value, device=device)


def _number(expected: str, value: float | Tensor) -> float:
    try:
        return float(_vector(value).detach())
    except (TypeError, ValueError, ArithmeticError, RuntimeError):
        raise ValueError(f"{expected}; got {value!r}") from None


def _check_vector(name: str, value: Vector) -> None:
    try:
        v = _vector(value).detach()
    except (TypeError, ValueError, ArithmeticError, RuntimeError):
        raise ValueError(f"{name} must be three finite numbers; got {value!r}") from None
    if v.shape != (3,) or not v.isfinite().all():
        raise ValueError(f"{name} must be three finite numbers in x, y, z order; got {value!r}")


def check_window(window: Window) -> None:
    """Raises ValueError unless 0 ≤ left < right ≤ 1 and 0 ≤ top < bottom ≤ 1."""
    w = tuple(window)
    if len(w) != 4 or not (0 <= w[0] < w[2] <= 1 and 0 <= w[1] < w[3] <= 1):
        raise ValueError(f"window must be (left, top, right, bottom) with 0 ≤ left < right ≤ 1, likewise down; got {w}")


def _basis(position: Tensor, target: Tensor, up: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Orthonormal right, up, forward of a view."""
    view = target - position
    if not view.any():
        raise ValueError(f"target must differ from position; both are {position.tolist()}")
    if not view.isfinite().all():
        raise ValueError(
            f"target − position must be finite in float64; got target {target.tolist()}, position {position.tolist()}"
        )
    if not up.any():
        raise ValueError("up must not be zero")
    forward = _unit(view)
    side = torch.linalg.cross(forward, _unit(up))
    if not side.norm() > 1e-9:
        raise ValueError(f"up must not lie along the view; got up {up.tolist()}, view {view.tolist()}")
    right = side / side.norm()
    return right, torch.linalg.cross(right, forward), forward


def _rotated(v: Tensor, k: Tensor, degrees: float) -> Tensor:
    """v about the unit vector k."""
    sine, cosine = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    return v * cosine + torch.linalg.cross(k, v) * sine + k * (k * v).sum() * (1 - cosine)


def _unit(vector: Tensor) -> Tensor:
    """vector / |vector| of a finite float64 vector `(3,)` other than 0.

    Its square is taken at a scale where it neither over- nor underflows; a power of two, which changes no digit.
    """
    exponent = math.frexp(float(vector.detach().abs().max()))[1]
    scaled = vector * 2.0 ** -max(min(exponent, _LARGEST_EXPONENT), -_LARGEST_EXPONENT)
    return scaled / scaled.norm()


@dataclass(frozen=True)
class _Seen:
    """Points to be seen from a direction.

    Attributes:
        points: (M, 3) along right, up and forward of the view, from the centre.
        center: what is looked at.
        axes: right, up, forward (3, 3), in rows.
        aspect: width / height of the image plane.
        margin: they fill 1/margin of it in one direction or the other.
    """

    points: Tensor
    center: Tensor
    axes: Tensor
    aspect: float
    margin: float

    @classmethod
    def of(cls, points: Tensor, direction: Vector, up: Vector, aspect: float, margin: float) -> _Seen:
        """World points (M, 3) about their mean. Raises ValueError for numbers out of range."""
        _check_vector("direction", direction)
        _check_vector("up", up)
        if not 0 < aspect < math.inf:
            raise ValueError(f"aspect must be positive (width / height); got {aspect}")
        if not 1 <= margin < math.inf:
            raise ValueError(f"margin must be at least 1; got {margin}")
        if not _vector(direction).any():
            raise ValueError("direction must not be zero")
        axes = torch.stack(_basis(torch.zeros(3, dtype=torch.float64), _vector(direction).cpu(), _vector(up).cpu()))
        center = points.mean(0)
        return cls(times_matrix(points - center, axes.T), center, axes, aspect, margin)

    @property
    def forward(self) -> Tensor:
        return self.axes[2]

    @property
    def reach(self) -> Tensor:
        """(M,): half heights of an image plane that each point asks for."""
        x, y, _ = self.points.unbind(-1)
        return torch.maximum(x.abs() / self.aspect, y.abs()) * self.margin

    def distance(self, half: float) -> float:
        """From the centre to where all points are in view, of half heights `half` at distance 1."""
        return float((self.reach / half - self.points[:, 2]).max())

    def about(self, middle: Tensor) -> _Seen:
        """The same about another point (3,)."""
        return replace(self, points=self.points - middle, center=self.center + times_matrix(middle, self.axes))

    def centered(self, half: float) -> _Seen:
        """The same about what makes their ends in the image, of half heights `half`, as far on all sides."""
        low, high = self.points.aminmax(dim=0)
        seen = self.about((low + high) / 2)
        for _ in range(_PASSES):
            depth = (seen.points[:, 2:] + seen.distance(half)).clamp_min(torch.finfo(torch.float64).tiny)
            low, high = (seen.points[:, :2] / depth).aminmax(dim=0)
            seen = seen.about(torch.cat(((low + high) / 2, low.new_zeros(1))) * depth.mean())
        return seen
