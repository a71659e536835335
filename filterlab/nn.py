"""Reconstructions as modules of torch: samples that are learned, saved in a state, moved as parameters are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from filterlab.arrays import Array
from filterlab.fields.base import Field
from filterlab.fields.grid import GridField
from filterlab.kernels import PiecewisePolynomial
from filterlab.methods import Asked, Method, as_method, reconstruct
from filterlab.ops.differentiable.recording import transformed
from filterlab.volume import Boundary, Volume, as_volume, exact_float


class Reconstruction(torch.nn.Module):
    """A field whose samples are a parameter: f(x) = Σ_k c_k φ(x − k), c = prefilter(samples); see `reconstruct`.

    Args:
        volume: a `Volume`, bare samples `(D, H, W)` or `(N, C, D, H, W)`, or the shape of samples that begin as zeros.
        method: a name from `METHODS`, a `Method` or a kernel.
        learnable: whether samples are a `torch.nn.Parameter`, a copy of those given, integers as `exact_float`; else a
            buffer, as it is.
        boundary, prefilter, scheme, gradient: as for `reconstruct`.

    The state (`state_dict`) has the samples, and what they mean: method, boundary, prefilter and where the grid lies.
    A state that says otherwise is not loaded. `.to` moves and converts the samples.

    The field is made anew at every call, as samples may have changed: a prefilter and padding. For many calls in
    between of two changes, take `field()` once. Where no derivatives by the samples are asked, it is kept until they
    change, by anything but writing to their `.data`. Samples are looked through for NaN when the module is made, not
    afterwards: then NaN gives NaN.

    Values and derivatives are differentiable in samples and points. torch.compile takes calls whole, as does
    `torch.func.functional_call`.

    Raises:
        ValueError, TypeError: as `Volume` and `reconstruct` do.
    """

    samples: Tensor

    def __init__(
        self,
        volume: Volume | Array | Sequence[int],
        method: str | Method | PiecewisePolynomial = "triquadratic",
        *,
        learnable: bool = True,
        boundary: str | Boundary = Boundary.MIRROR,
        prefilter: bool = True,
        scheme: str | None = None,
        gradient: str | None = None,
    ) -> None:
        super().__init__()
        given = as_volume(volume if isinstance(volume, Volume | Array) else torch.zeros(_checked_shape(volume)))
        samples = given.samples.detach()
        self.method, self.boundary = as_method(method), Boundary.named(boundary)
        self.geometry = given.geometry
        self._prefilter, self._scheme, self._gradient = prefilter, scheme, gradient
        if learnable:
            dtype = samples.dtype if samples.dtype.is_floating_point else exact_float(samples)
            self.samples = torch.nn.Parameter(samples.to(dtype, copy=True))
        else:
            self.register_buffer("samples", samples)
        self._blank = _without_memory(self._built())
        self._kept: tuple[Tensor, int, Field] | None = None

    @property
    def volume(self) -> Volume:
        """The samples, where they lie."""
        return Volume.with_geometry(self.samples, self.geometry)

    def field(self) -> Field:
        """The field of the samples as they are now."""
        if transformed() or self.samples.requires_grad or self.samples.is_inference():
            return self._made()
        key = self.samples, self.samples._version
        if self._kept is None or self._kept[0] is not key[0] or self._kept[1] != key[1]:
            self._kept = *key, self._made()
        return self._kept[2]

    if TYPE_CHECKING:  # torch says that modules give anything

        def __call__(self, points: Array) -> Tensor: ...

    def forward(self, points: Array) -> Tensor:
        """Values at world points; see `Field`."""
        return self.field()(points)

    def value_and_gradient(self, points: Array) -> tuple[Tensor, Tensor]:
        """Values and gradients (per world unit) at world points, in one pass; see `Field`."""
        return self.field().value_and_gradient(points)

    def jet(self, points: Array, order: int) -> tuple[Tensor, ...]:
        """(value,), (value, gradient) or (value, gradient, Hessian) at world points; see `Field`."""
        return self.field().jet(points, order)

    def extra_repr(self) -> str:
        kind = "learnable" if isinstance(self.samples, torch.nn.Parameter) else "fixed"
        return f"{self.method.name}, boundary={self.boundary}, {kind} {self.volume}"

    def _built(self) -> Field:
        return reconstruct(
            Volume.with_geometry(self.samples.detach(), self.geometry),
            self.method,
            boundary=self.boundary,
            prefilter=self._prefilter,
            scheme=self._scheme,
            gradient=self._gradient,
        )

    def _made(self) -> Field:
        """The blank field with coefficients of the samples; all else about it is decided."""
        samples = self.samples
        asked = Asked(samples, None, self.boundary, self._prefilter, self._scheme, self._gradient)
        return self.method.rebuilt(self._blank, asked)

    def _apply(self, fn: Any, recurse: bool = True) -> Reconstruction:
        """What `.to`, `.double` and the like do."""
        super()._apply(fn, recurse)
        self._settle()
        return self

    def _settle(self) -> None:
        self._kept = None
        if self.samples.device.type != "meta":
            self._blank = _without_memory(self._built())

    # --- what is saved ---

    def get_extra_state(self) -> dict[str, Any]:
        """What the samples mean, as plain values."""
        return {
            "method": self.method.name,
            "boundary": str(self.boundary),
            "prefilter": self._prefilter,
            "affine": self.geometry.affine.tolist(),
        }

    def set_extra_state(self, state: Any) -> None:
        """It was found to be the same before samples were loaded."""

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """As torch's, but nothing is overwritten by a state that means something else."""
        *_, errors = rest
        found = _disagreements(self, state_dict.get(f"{prefix}samples"), state_dict.get(f"{prefix}_extra_state"))
        if found:
            errors.extend(found)
            return
        super()._load_from_state_dict(state_dict, prefix, *rest)  # type: ignore[misc]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kept": None, "_blank": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._settle()


def _checked_shape(shape: Sequence[int]) -> tuple[int, ...]:
    if not isinstance(shape, tuple | list):
        raise TypeError(f"expected a Volume, a torch.Tensor, a NumPy array or a shape; got {type(shape).__name__}")
    sizes = tuple(shape)
    if not all(isinstance(n, int) and n > 0 for n in sizes) or len(sizes) not in (3, 5):
        raise ValueError(f"a shape must be (D, H, W) or (N, C, D, H, W), integers ≥ 1; got {sizes}")
    return sizes


def _without_memory(field: Field) -> Field:
    """The field with coefficients that are a single number: to be built again of others."""
    if not isinstance(field, GridField):
        return field
    values = field.coefficients.values
    return field.with_coefficients(replace(field.coefficients, values=values.new_zeros(()).expand(values.shape)))


def _disagreements(own: Reconstruction, samples: Tensor | None, state: dict[str, Any] | None) -> list[str]:
    """What a state says of samples that is not so here."""
    found = []
    if samples is not None and samples.shape != own.samples.shape:
        found.append(f"expected samples of shape {tuple(own.samples.shape)}; the state has {tuple(samples.shape)}")
    if state is not None:
        here = own.get_extra_state()
        different = [name for name in here if state.get(name) != here[name]]
        found += [f"expected a state of {name} {here[name]!r}; it is of {state.get(name)!r}" for name in different]
    return found
