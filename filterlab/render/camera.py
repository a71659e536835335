"""Cameras: where the rays of an image start and where they go.

Letters used in this file: the image plane is measured from its upper left corner, u to the right and v downwards, both
0 … 1 over the *whole* plane; a window picks the part of it that becomes the image. Image sizes are (width, height);
tensors of pixels are (H, W, …). Cameras live in the world and compute in float64.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from filterlab.arrays import Array, as_tensor
from filterlab.fields.base import Domain

Vector = Sequence[float] | Array
Window = tuple[float, float, float, float]
WHOLE: Window = (0.0, 0.0, 1.0, 1.0)

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
        if not 0 < field_of_view < 180:
            raise ValueError(f"field_of_view must lie between 0 and 180 degrees; got {field_of_view}")
        center, x, y, z, forward = _seen_corners(domain, direction, up, aspect, margin)
        half = math.tan(math.radians(field_of_view) / 2)
        distance = float((torch.maximum(x.abs() / aspect, y.abs()) * margin / half - z).max())
        return cls(
            position=(center - distance * forward).tolist(),
            target=center.tolist(),
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
        center, x, y, _, forward = _seen_corners(domain, direction, up, aspect, margin)
        height = 2 * margin * float(torch.maximum(x.abs() / aspect, y.abs()).max())
        position = center - domain.diagonal * forward
        return cls(position=position.tolist(), target=center.tolist(), up=up, window=window, height=height)


def check_size(size: Sequence[int]) -> tuple[int, int]:
    """(width, height) as two positive integers. Raises ValueError otherwise."""
    values = tuple(size) if isinstance(size, Sequence) else ()
    if len(values) != 2 or not all(isinstance(n, int) and not isinstance(n, bool) and n > 0 for n in values):
        raise ValueError(f"size must be two positive integers (width, height); got {size!r}")
    return values[0], values[1]


def _vector(value: Vector | float, device: torch.device | None = None) -> Tensor:
    return torch.as_tensor(as_tensor(value), dtype=torch.float64, device=device)


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


def _unit(vector: Tensor) -> Tensor:
    """vector / |vector| of a finite float64 vector `(3,)` other than 0.

    Its square is taken at a scale where it neither over- nor underflows; a power of two, which changes no digit.
    """
    exponent = math.frexp(float(vector.detach().abs().max()))[1]
    scaled = vector * 2.0 ** -max(min(exponent, _LARGEST_EXPONENT), -_LARGEST_EXPONENT)
    return scaled / scaled.norm()


def _seen_corners(
    domain: Domain, direction: Vector, up: Vector, aspect: float, margin: float
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The box's centre, its corners along right, up and forward of the view (from the centre), and forward."""
    _check_vector("direction", direction)
    _check_vector("up", up)
    if not 0 < aspect < math.inf:
        raise ValueError(f"aspect must be positive (width / height); got {aspect}")
    if not 1 <= margin < math.inf:
        raise ValueError(f"margin must be at least 1; got {margin}")
    corners = domain.corners()
    center = corners.mean(0)
    if not _vector(direction).any():
        raise ValueError("direction must not be zero")
    right, upward, forward = _basis(torch.zeros(3, dtype=torch.float64), _vector(direction).cpu(), _vector(up).cpu())
    x, y, z = ((corners - center) @ torch.stack((right, upward, forward), -1)).unbind(-1)
    return center, x, y, z, forward
