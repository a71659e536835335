"""The fused marcher: calls `ops.march` for fields that are sums over taps, and makes it differentiable.

What varies along a ray is left to the op; what does not is prepared here in torch: the ray in coordinates of the
coefficients, and the directions to the lights and halfway between each and the viewer.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.autograd import forward_ad

from filterlab.fields.grid import GridField
from filterlab.fields.tensor_product import Direct
from filterlab.ops import march
from filterlab.ops.autograd import differentiating
from filterlab.ops.march import Bricks
from filterlab.ops.stencil import Stencil
from filterlab.render.bricks import bricks_of
from filterlab.render.plain import Chords, Medium, PlainMarcher, Report
from filterlab.render.shading import Light, Shading, safe_normalize
from filterlab.render.transfer import TransferFunction

SKIPPING = True
"""Whether empty space is left out; it changes no bit of the image."""


def why_not_fused(medium: Medium) -> str | None:
    """What keeps the fused marcher from running as asked; None: nothing.

    It takes fields of scheme "fused", and no transforms of torch.func. On a GPU derivatives are sums of atomic
    additions, in whatever order they come: where torch is told to be deterministic (when the image is rendered) they
    are the plain marcher's.
    """
    field = medium.field
    if not isinstance(field, GridField) or not isinstance(field.scheme, Direct) or field.scheme.name != "fused":
        scheme = f"scheme {field.scheme.name!r}" if isinstance(field, GridField) else f"a {type(field).__name__}"
        return f"it marches fields of scheme 'fused'; this is {scheme}"
    if torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0:
        return "it has no transforms of torch.func"
    values, start = field.coefficients.values, field.coefficients.start
    if medium.transfer.positions.device != values.device:
        return f"coefficients are on {values.device}, rays on {medium.transfer.positions.device}"
    if medium.differentiable and march.on_gpu(values) and torch.are_deterministic_algorithms_enabled():
        return "its derivatives on a GPU are not deterministic, as torch is told to be"
    if bool((_of_stored(medium).positions.detach().diff() <= 0).any()):
        return "control points fall together when they are rounded to how coefficients are stored"
    lights = len(medium.shading.lights) if medium.shading else 0
    return march.missing(values[(0,) * (values.ndim - 3)], _stencil(medium), start, medium.dtype, lights)


def _stencil(medium: Medium) -> Stencil:
    field = medium.field
    assert isinstance(field, GridField)
    assert isinstance(field.scheme, Direct)
    return field.scheme.stencils[medium.order]


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
        if not medium.differentiable:
            return _run(medium, chords, report, self._empty_parts(medium))
        given = _Given(medium, chords)
        return _Differentiable.apply(given, self.memory, report, *given.parameters)  # type: ignore[return-value]

    def _empty_parts(self, medium: Medium) -> Bricks | None:
        """Of the medium marched through last, found once for all parts of an image."""
        if self._empty is None or self._empty[0] is not medium:
            self._empty = medium, _empty_parts(medium)
        return self._empty[1]


def _run(medium: Medium, chords: Chords, report: Report, empty: Bricks | None) -> tuple[Tensor, Tensor]:
    samples = chords.count.cumsum(0)
    return _prepared(medium, chords, empty).run(lambda rays: report(int(samples[rays - 1])))


def _empty_parts(medium: Medium) -> Bricks | None:
    if not SKIPPING:
        return None
    assert isinstance(medium.field, GridField)
    return bricks_of(medium.field.coefficients.values, _stencil(medium), _of_stored(medium))


@dataclass(frozen=True)
class EmptyBricks:
    """The bricks that a medium has no opacity in, and where points of the world belong among them."""

    bricks: Bricks
    field: GridField
    supports: tuple[int, int, int]

    def empty(self, points: Tensor) -> Tensor:
        """Whether each point `(S, 3)` within the domain lies in an empty brick."""
        located = self.field.domain.geometry.to_voxel(points) - self.field.coefficients.shift
        first = located - located.new_tensor([s / 2 - 1 for s in self.supports])
        sizes = torch.tensor(self.bricks.distance.shape[::-1], device=points.device)
        brick = (first.floor().long() - self.field.coefficients.start) >> self.bricks.edge
        x, y, z = brick.clamp_min(0).minimum(sizes - 1).unbind(-1)
        return self.bricks.distance[z, y, x] > 0


def empty_bricks(medium: Medium) -> EmptyBricks | None:
    """Those of a medium that the fused marcher can march; None: there are none."""
    found = _empty_parts(medium)
    assert isinstance(medium.field, GridField)
    return None if found is None else EmptyBricks(found, medium.field, _stencil(medium).supports)


def _of_stored(medium: Medium) -> TransferFunction:
    """The transfer function of what the coefficients' stored numbers sum to; another one only for integers."""
    assert isinstance(medium.field, GridField)
    quantization = medium.field.coefficients.quantization
    if quantization is None:
        return medium.transfer
    transfer = copy(medium.transfer)
    transfer.positions = quantization.stored(transfer.positions)
    return transfer


class _Given:
    """A medium and rays as a list of what they can be differentiated in, and the way back.

    Attributes:
        parameters: coefficients; entry, direction, length; positions, colors, opacities; lit also ambient, diffuse,
            specular, shininess, and of every light its direction (unless it is a headlight) and color.
    """

    def __init__(self, medium: Medium, chords: Chords) -> None:
        self.medium, self.chords = medium, chords
        field, transfer, shading = medium.field, medium.transfer, medium.shading
        assert isinstance(field, GridField)
        self.parameters = [field.coefficients.values, chords.entry, chords.direction, chords.length]
        self.parameters += [transfer.positions, transfer.colors, transfer.opacities]
        if shading is not None:
            numbers = [shading.ambient, shading.diffuse, shading.specular, shading.shininess]
            for light in shading.lights:
                numbers += [light.color] if light.direction is None else [light.direction, light.color]
            self.parameters += [torch.as_tensor(number, dtype=torch.float64) for number in numbers]

    def rebuilt(self, parameters: Sequence[Tensor]) -> tuple[Medium, Chords]:
        """The same with other parameters."""
        values, entry, direction, length, positions, colors, opacities, *numbers = parameters
        field, transfer, shading = copy(self.medium.field), copy(self.medium.transfer), self.medium.shading
        assert isinstance(field, GridField)
        field.coefficients = replace(field.coefficients, values=values)
        transfer.positions, transfer.colors, transfer.opacities = positions, colors, opacities
        if shading is not None:
            ambient, diffuse, specular, shininess, *rest = numbers
            left = iter(rest)
            lights = [Light(None if light.direction is None else next(left), next(left)) for light in shading.lights]
            shading = Shading(lights, ambient, diffuse, specular, shininess)
        chords = replace(self.chords, entry=entry, direction=direction, length=length)
        return replace(self.medium, field=field, transfer=transfer, shading=shading), chords

    def wanted(self, needed: Sequence[bool]) -> set[str]:
        """What `ops.march` has to differentiate by, for the parameters that need it."""
        values, entry, direction, length, *others = needed
        lit = self.medium.shading is not None
        asked = {
            "coefficients": values,
            "rays": entry or direction or length,
            "table": any(others[:3]),
            "shading": lit and (direction or any(others[3:])),
        }
        return {name for name, yes in asked.items() if yes}


class _Differentiable(torch.autograd.Function):
    """(what is given, memory, report, *parameters) -> (light, depth)."""

    @staticmethod
    def forward(ctx, given: _Given, memory: int, report: Report, *parameters: Tensor):
        medium, chords = given.rebuilt(parameters)
        light, depth = _run(medium, chords, report, _empty_parts(medium))
        ctx.given, ctx.memory = given, memory
        ctx.save_for_backward(*parameters, light)
        return light, depth

    @staticmethod
    def backward(ctx, *cotangents: Tensor):
        *parameters, light = ctx.saved_tensors
        needed = ctx.needs_input_grad[3:]
        if torch.is_grad_enabled():
            found = _plain_derivatives(ctx.given, ctx.memory, parameters, needed, cotangents)
        else:
            found = _derivatives(ctx.given, parameters, needed, light, cotangents)
        return None, None, None, *found


def _derivatives(
    given: _Given, parameters: Sequence[Tensor], needed: Sequence[bool], light: Tensor, cotangents: Sequence[Tensor]
) -> list[Tensor | None]:
    """By the fused adjoint, and from what was prepared for it back to the parameters by autograd."""
    wanted = given.wanted(needed)
    with differentiating(True):
        leaves = [p.detach().requires_grad_(need) for p, need in zip(parameters, needed, strict=True)]
        medium, chords = given.rebuilt(leaves)
        # where opacity is 0 it changes with the control points nevertheless
        prepared = _prepared(medium, chords, None if "table" in wanted else _empty_parts(medium))
    to_light, to_depth = cotangents
    found = prepared.adjoint(light, to_light, to_depth, wanted)
    tensors = _differentiated(prepared)
    outputs = [name for name in found if tensors[name].requires_grad]
    back = torch.autograd.grad(
        [tensors[name] for name in outputs],
        [leaf for leaf in leaves if leaf.requires_grad],
        [found[name].to(tensors[name].dtype) for name in outputs],
        allow_unused=True,
    )
    return _in_place_of(needed, back)


def _differentiated(prepared: march.March) -> dict[str, Tensor]:
    """What `March.adjoint` gives derivatives by, under the same names."""
    parts = [prepared.rays, prepared.transfer, prepared.lighting]
    return {"coefficients": prepared.coefficients} | {k: v for part in parts if part for k, v in vars(part).items()}


def _plain_derivatives(
    given: _Given, memory: int, parameters: Sequence[Tensor], needed: Sequence[bool], cotangents: Sequence[Tensor]
) -> list[Tensor | None]:
    """By the plain marcher, with a graph; in aliases of the parameters, as one may depend on another."""
    aliases = [p.view_as(p) for p in parameters]
    outputs = PlainMarcher(memory).march(*given.rebuilt(aliases), lambda done: None)
    inputs = [p for p, need in zip(aliases, needed, strict=True) if need]
    pairs = [(x, g) for x, g in zip(outputs, cotangents, strict=True) if x.requires_grad]  # lights change no depth
    tensors, gradients = zip(*pairs, strict=True)
    back = torch.autograd.grad(tensors, inputs, gradients, create_graph=True, allow_unused=True)
    return _in_place_of(needed, back)


def _in_place_of(needed: Sequence[bool], derivatives: Sequence[Tensor | None]) -> list[Tensor | None]:
    """The derivatives where they are needed, None elsewhere."""
    left = iter(derivatives)
    return [next(left) if need else None for need in needed]


def _prepared(medium: Medium, chords: Chords, empty: Bricks | None) -> march.March:
    field, transfer, stencil = medium.field, _of_stored(medium), _stencil(medium)
    assert isinstance(field, GridField)
    coefficients = field.coefficients
    return march.March(
        coefficients=coefficients.values,
        start=coefficients.start,
        stencil=stencil,
        rays=_in_the_grid(field, chords),
        transfer=march.Transfer(transfer.positions, transfer.colors, transfer.opacities, transfer.unit),
        lighting=None if medium.shading is None else _lighting(field, medium.shading, chords.direction, medium.dtype),
        step=medium.step,
        faint=medium.faint,
        bricks=empty,
    )


def _in_the_grid(field: GridField, chords: Chords) -> march.Rays:
    """Rays in coordinates of the coefficients. They lie within the domain: no boundary folds them."""
    geometry = field.domain.geometry
    entry = geometry.to_voxel(chords.entry) - field.coefficients.shift
    return march.Rays(entry, geometry.direction_to_voxel(chords.direction), chords.length, chords.offset, chords.count)


def _lighting(field: GridField, shading: Shading, direction: Tensor, dtype: torch.dtype) -> march.Lighting:
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
            to_light = safe_normalize(number(light.direction))
            toward.append(to_light.expand_as(view))
            halfway.append(safe_normalize(to_light + view))
    world = field.domain.geometry.gradient_to_world(torch.eye(3, dtype=torch.float64)).to(view)
    if field.coefficients.quantization is not None:
        world = world * field.coefficients.quantization.scale.to(view)
    return march.Lighting(
        ambient,
        shininess,
        diffuse * tints,
        specular * tints,
        torch.stack(toward, 1) if toward else view[:, None, :][:, :0],
        torch.stack(halfway, 1) if halfway else view[:, None, :][:, :0],
        world,
    )
