"""Blinn-Phong shading of samples by their gradients, with directional lights.

Letters: n the normal, the gradient made a unit vector; l the direction to a light, v to the viewer, h halfway between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from filterlab.arrays import Array, as_numbers
from filterlab.ops.reference.optics import dot, power, safe_normalize


@dataclass(frozen=True)
class Light:
    """A light infinitely far away.

    Attributes:
        direction: world vector from the scene *to* the light, any length but zero; None is a headlight, which always
            shines along the ray.
        color: linear RGB of the light, ≥ 0.

    Both may be tensors that require grad.
    """

    direction: Sequence[float] | Array | None = None
    color: Sequence[float] | Array = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if self.direction is not None:
            d = _checked("a light's direction", "three finite numbers, or None", self.direction).detach()
            if d.shape != (3,) or not d.isfinite().all() or not d.any():
                raise ValueError(
                    f"a light's direction must be three finite numbers, not all zero; got {self.direction!r}"
                )
        c = _checked("a light's color", "three finite numbers ≥ 0 (linear RGB)", self.color).detach()
        if c.shape != (3,) or not c.isfinite().all() or (c < 0).any():
            raise ValueError(f"a light's color must be three finite numbers ≥ 0 (linear RGB); got {self.color!r}")

    def toward(self, example: Tensor) -> Tensor:
        """The unit vector to a light with a direction, `(3,)`, in the dtype and on the device of `example`.

        It is made a unit vector in float64, which has every length of it, and only then rounded to a shorter type.
        """
        assert self.direction is not None
        return like(safe_normalize(as_numbers(self.direction)), example)


@dataclass(frozen=True)
class Shading:
    """Two-sided Blinn-Phong.

    lit = rgb · (ambient + diffuse Σ_k I_k |n·l_k|) + specular Σ_k I_k |n·h_k|^shininess

    with l_k to light k of colour I_k, h_k = (l_k + v)/|l_k + v|. A zero gradient has no normal: only the ambient term
    is left, and derivatives (the second too) are finite there. Directions are world directions and the gradient is per
    world unit, so that stretched voxels are lit as the stretched object would be.

    Attributes:
        lights: one or more; a single white headlight by default.
        ambient, diffuse, specular: weights ≥ 0.
        shininess: exponent of the highlight, ≥ 1.

    Numbers may be tensors that require grad; differentiable in them, the colour, the gradient and the ray.

    Source: Blinn, Models of light reflection for computer synthesized pictures, 1977.
    """

    lights: Sequence[Light] = field(default_factory=lambda: (Light(),))
    ambient: float | Tensor = 0.2
    diffuse: float | Tensor = 0.7
    specular: float | Tensor = 0.3
    shininess: float | Tensor = 32.0

    def __post_init__(self) -> None:
        for name, least in (("ambient", 0), ("diffuse", 0), ("specular", 0), ("shininess", 1)):
            number = _checked(name, f"a finite number ≥ {least}", getattr(self, name)).detach()
            if number.ndim:
                raise ValueError(f"{name} must be a finite number ≥ {least}; got shape {tuple(number.shape)}")
            value = number.item()
            if not least <= value < float("inf"):
                raise ValueError(f"{name} must be a finite number ≥ {least}; got {value}")
        lights = self.lights
        if not isinstance(lights, Sequence) or not all(isinstance(light, Light) for light in lights):
            raise TypeError(f"lights must be a sequence of Light objects; got {lights!r}")

    @property
    def requires_grad(self) -> bool:
        """True when any parameter is a tensor that requires grad."""
        values = [self.ambient, self.diffuse, self.specular, self.shininess]
        values += [v for light in self.lights for v in (light.direction, light.color)]
        return any(isinstance(v, Tensor) and v.requires_grad for v in values)

    def brightest(self, color: float) -> float:
        """An upper bound of every lit component for colours of at most `color`."""
        bounds = self.numbers
        return color * bounds["ambient + diffuse · light"] + bounds["specular · light"]

    @property
    def numbers(self) -> dict[str, float]:
        """The largest numbers that shading is computed with, by what they are; light is that of all lights together."""
        light = torch.stack([as_numbers(light.color).detach().cpu() for light in self.lights] or [torch.zeros(3)])
        total = float(light.sum(0).max())
        return {
            "light": total,
            "diffuse": _plain(self.diffuse),
            "specular": _plain(self.specular),
            "shininess": _plain(self.shininess),
            "ambient + diffuse · light": _plain(self.ambient) + _plain(self.diffuse) * total,
            "specular · light": _plain(self.specular) * total,
        }

    def __call__(
        self, color: Tensor, gradient: Tensor, direction: Tensor, shadows: Sequence[Tensor | None] = ()
    ) -> Tensor:
        """Lit colours `(..., 3)`, of colours `(..., 3)`, gradients `(..., 3)` and unit ray directions `(..., 3)`.

        Args:
            shadows: how much of each light arrives, `(...)` in 0 … 1; None: all of it.
        """
        normal, view = safe_normalize(gradient), -direction
        matt, shine = self._sums(normal, view, shadows or [None] * len(self.lights))
        ambient, diffuse, specular = (like(x, color) for x in (self.ambient, self.diffuse, self.specular))
        return color * (ambient + diffuse * matt) + specular * shine

    def _sums(self, normal: Tensor, view: Tensor, shadows: Sequence[Tensor | None]) -> tuple[Tensor, Tensor]:
        """Σ I |n·l| and Σ I |n·h|^shininess, `(..., 3)` each."""
        matt, shine = torch.zeros((), dtype=view.dtype, device=view.device), torch.zeros_like(normal[..., :1])
        shininess = like(self.shininess, view)
        for light, arriving in zip(self.lights, shadows, strict=True):
            tint = like(light.color, view)
            tint = tint if arriving is None else tint * arriving[..., None]
            if light.direction is None:
                facing = half = dot(normal, view).abs()
            else:
                to_light = light.toward(view)
                facing = dot(normal, to_light).abs()
                half = dot(normal, safe_normalize(to_light + view)).abs()
            matt = matt + tint * facing[..., None]
            shine = shine + tint * power(half, shininess)[..., None]
        return matt, shine


def _plain(value: float | Tensor) -> float:
    return float(value.detach() if isinstance(value, Tensor) else value)


def _checked(name: str, expected: str, value: Sequence[float] | float | Array) -> Tensor:
    """The value as float64. Raises ValueError that says what was expected."""
    try:
        return as_numbers(value)
    except (TypeError, ValueError, ArithmeticError, RuntimeError):
        raise ValueError(f"{name} must be {expected}; got {value!r}") from None


def like(value: Sequence[float] | float | Array, example: Tensor) -> Tensor:
    """Numbers in the dtype and on the device of a tensor."""
    return as_numbers(value, example.dtype, example.device)
