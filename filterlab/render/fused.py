"""The fused marcher: calls `ops.differentiable.march` for fields that are sums over taps.

What varies along a ray is left to the op; what does not is prepared here in torch: the ray in coordinates of the
coefficients, and the directions to the lights and halfway between each and the viewer.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import TypeGuard

import torch
from torch import Tensor

from filterlab.fields.base import Field
from filterlab.fields.grid import GridField
from filterlab.fields.tensor_product import Direct
from filterlab.fields.tetrahedral import OnTetrahedra
from filterlab.ops.differentiable import march, projection
from filterlab.ops.march import Bricks, Chords, Lighting, March, Transfer
from filterlab.ops.projection import Projection
from filterlab.ops.reference.optics import safe_normalize
from filterlab.ops.tetrahedra import AnyStencil
from filterlab.render.bricks import bricks_of
from filterlab.render.plain import Medium, Report
from filterlab.render.shading import Light, Shading
from filterlab.render.transfer import TransferFunction

_SUMS = (Direct, OnTetrahedra)
"""Schemes that sum a stencil."""

SKIPPING = True
"""Whether empty space is left out; it changes no bit of the image."""


def why_not_fused(medium: Medium) -> str | None:
    """What keeps the fused marcher from running as asked; None: nothing.

    It takes fields of scheme "fused", and no transforms of torch.func. On a GPU derivatives are sums of atomic
    additions, in whatever order they come: where torch is told to be deterministic (when the image is rendered) they
    are the plain marcher's.
    """
    field = medium.field
    if not _is_sum(field):
        scheme = f"scheme {field.scheme.name!r}" if isinstance(field, GridField) else f"a {type(field).__name__}"
        return f"it marches fields of scheme 'fused'; this is {scheme}"
    values, start = field.coefficients.values, field.coefficients.start
    if medium.transfer.positions.device != values.device:
        return f"coefficients are on {values.device}, rays on {medium.transfer.positions.device}"
    on_a_gpu = march.implementation_for(values) == "cuda"
    if on_a_gpu and medium.differentiable and torch.are_deterministic_algorithms_enabled():
        return "its derivatives on a GPU are not deterministic, as torch is told to be"
    if bool((_of_stored(medium).positions.detach().diff() <= 0).any()):
        return "control points fall together when they are rounded to how coefficients are stored"
    lights = len(medium.shading.lights) if medium.shading else 0
    return march.missing(values[(0,) * (values.ndim - 3)], _stencil(medium), start, medium.dtype, lights)


def _is_sum(field: Field) -> TypeGuard[GridField]:
    """Whether a field is one whose taps programs sum along rays."""
    return isinstance(field, GridField) and isinstance(field.scheme, _SUMS) and field.scheme.name == "fused"


def projection_of(field: Field, chords: Chords, step: float, dtype: torch.dtype) -> Projection | None:
    """A maximum intensity projection that a program makes; None where none can.

    Of stored integers the largest is what stands for the largest coefficient sum.
    """
    if not _is_sum(field) or chords.length.device != field.coefficients.values.device:
        return None
    assert isinstance(field.scheme, _SUMS)
    values, start, stencil = field.coefficients.values, field.coefficients.start, field.scheme.stencils[0]
    if projection.missing(values, stencil, start, dtype) is not None:
        return None
    return Projection(values, start, stencil, _in_the_grid(field, chords), step, dtype)


def _stencil(medium: Medium) -> AnyStencil:
    scheme = _grid(medium).scheme
    assert isinstance(scheme, _SUMS)
    return scheme.stencils[medium.order]


def _grid(medium: Medium) -> GridField:
    assert isinstance(medium.field, GridField)
    return medium.field


class FusedMarcher:
    """Fields for which `why_not_fused` has no answer.

    Args:
        memory: bytes that samples of the plain marcher may take, which computes second derivatives.
    """

    def __init__(self, memory: int) -> None:
        self.memory = memory
        self._empty: tuple[Medium, Bricks | None] | None = None

    def march(self, medium: Medium, chords: Chords, report: Report) -> tuple[Tensor, Tensor]:
        """Emitted light (R, 3) and optical depth (R,), float64.

        Differentiable: the backward pass marches once more and keeps nothing of a sample. With create_graph=True it is
        computed by the plain marcher, so that it can be differentiated again.
        """
        empty, samples = self._empty_parts(medium), chords.count.cumsum(0)

        def rays_done(rays: int) -> None:
            report(int(samples[rays - 1]))

        def prepare(tensors: Mapping[str, Tensor]) -> March:
            return _prepared(*_with_tensors(medium, chords, tensors), None)

        if not medium.differentiable:
            return march.run(_prepared(medium, chords, empty), rays_done)
        return march.march(prepare, _named_tensors(medium, chords), empty, self.memory, rays_done)

    def _empty_parts(self, medium: Medium) -> Bricks | None:
        """Of the medium marched through last, found once for all parts of an image."""
        if self._empty is None or self._empty[0] is not medium:
            self._empty = medium, _empty_parts(medium)
        return self._empty[1]


def _empty_parts(medium: Medium) -> Bricks | None:
    if not SKIPPING:
        return None
    return bricks_of(_grid(medium).coefficients.values, _stencil(medium), _of_stored(medium))


@dataclass(frozen=True)
class EmptyBricks:
    """The bricks that a medium has no opacity in, and where points of the world belong among them."""

    bricks: Bricks
    field: GridField
    supports: tuple[int, int, int]

    def empty(self, points: Tensor) -> Tensor:
        """Whether each point `(S, 3)` within the domain lies in an empty brick."""
        located = self.field.domain.geometry.to_voxel(points) - points.new_tensor(self.field.coefficients.shift)
        first = located - located.new_tensor([s / 2 - 1 for s in self.supports])
        sizes = torch.tensor(self.bricks.distance.shape[::-1], device=points.device)
        brick = (first.floor().long() - self.field.coefficients.start) >> self.bricks.edge
        x, y, z = brick.clamp_min(0).minimum(sizes - 1).unbind(-1)
        return self.bricks.distance[z, y, x] > 0


def empty_bricks(medium: Medium) -> EmptyBricks | None:
    """Those of a medium that the fused marcher can march; None: there are none."""
    found = _empty_parts(medium)
    return None if found is None else EmptyBricks(found, _grid(medium), _stencil(medium).supports)


def _of_stored(medium: Medium) -> TransferFunction:
    """The transfer function of what the coefficients' stored numbers sum to; another one only for integers."""
    quantization = _grid(medium).coefficients.quantization
    if quantization is None:
        return medium.transfer
    transfer = copy(medium.transfer)
    transfer.positions = quantization.stored(transfer.positions)
    return transfer


def _named_tensors(medium: Medium, chords: Chords) -> dict[str, Tensor]:
    """What a medium and rays can be differentiated in, by name.

    Lit also ambient, diffuse, specular, shininess, and of light i "toward i" (unless it is a headlight) and "color i".
    """
    transfer, shading = medium.transfer, medium.shading
    named = {"coefficients": _grid(medium).coefficients.values}
    named |= {name: getattr(chords, name) for name in ("entry", "direction", "length")}
    named |= {name: getattr(transfer, name) for name in ("positions", "colors", "opacities")}
    if shading is not None:
        numbers = {name: getattr(shading, name) for name in ("ambient", "diffuse", "specular", "shininess")}
        for i, light in enumerate(shading.lights):
            numbers |= {} if light.direction is None else {f"toward {i}": light.direction}
            numbers[f"color {i}"] = light.color
        named |= {name: torch.as_tensor(number, dtype=torch.float64) for name, number in numbers.items()}
    return named


def _with_tensors(medium: Medium, chords: Chords, named: Mapping[str, Tensor]) -> tuple[Medium, Chords]:
    """The same with other tensors under the names of `_named_tensors`."""
    field, transfer, shading = _grid(medium), copy(medium.transfer), None
    field = field.with_coefficients(replace(field.coefficients, values=named["coefficients"]))
    for name in ("positions", "colors", "opacities"):
        setattr(transfer, name, named[name])
    if medium.shading is not None:
        lights = [Light(named.get(f"toward {i}"), named[f"color {i}"]) for i in range(len(medium.shading.lights))]
        shading = Shading(lights, *(named[name] for name in ("ambient", "diffuse", "specular", "shininess")))
    chords = replace(chords, **{name: named[name] for name in ("entry", "direction", "length")})
    return replace(medium, field=field, transfer=transfer, shading=shading), chords


def _prepared(medium: Medium, chords: Chords, empty: Bricks | None) -> March:
    field, transfer, stencil = _grid(medium), _of_stored(medium), _stencil(medium)
    coefficients = field.coefficients
    return March(
        coefficients=coefficients.values,
        start=coefficients.start,
        stencil=stencil,
        chords=_in_the_grid(field, chords),
        transfer=Transfer(transfer.positions, transfer.colors, transfer.opacities, transfer.unit),
        lighting=None if medium.shading is None else _lighting(field, medium.shading, chords.direction, medium.dtype),
        step=medium.step,
        faint=medium.faint,
        bricks=empty,
    )


def _in_the_grid(field: GridField, chords: Chords) -> Chords:
    """Chords in coordinates of the coefficients. They lie within the domain: no boundary folds them."""
    geometry = field.domain.geometry
    entry = geometry.to_voxel(chords.entry) - chords.entry.new_tensor(field.coefficients.shift)
    return Chords(entry, geometry.direction_to_voxel(chords.direction), chords.length, chords.offset, chords.count)


def _lighting(field: GridField, shading: Shading, direction: Tensor, dtype: torch.dtype) -> Lighting:
    """Lights as seen along rays of unit directions `(R, 3)`."""
    view = -direction.to(dtype)

    def number(x) -> Tensor:
        return torch.as_tensor(x, dtype=dtype, device=view.device)

    ambient, diffuse, specular, shininess = map(
        number, (shading.ambient, shading.diffuse, shading.specular, shading.shininess)
    )
    tints, toward, halfway = view.new_zeros(0, 3), [], []
    if shading.lights:
        tints = torch.stack([number(light.color) for light in shading.lights])
    for light in shading.lights:
        if light.direction is None:
            toward.append(view)
            halfway.append(view)
        else:
            to_light = light.toward(view)
            toward.append(to_light.expand_as(view))
            halfway.append(safe_normalize(to_light + view))
    world = field.domain.geometry.gradient_to_world(torch.eye(3, dtype=torch.float64)).to(view)
    if field.coefficients.quantization is not None:
        world = world * field.coefficients.quantization.scale.to(view)
    return Lighting(
        ambient,
        shininess,
        diffuse * tints,
        specular * tints,
        torch.stack(toward, 1) if toward else view[:, None, :][:, :0],
        torch.stack(halfway, 1) if halfway else view[:, None, :][:, :0],
        world,
    )
