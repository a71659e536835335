"""Transfer functions: scalar -> linear RGB and opacity per unit distance.

Letters: v a field's value; x_j the control points; α opacity; s a world length; τ optical depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor

from filterlab.arrays import Array, as_numbers, as_tensor
from filterlab.fields.base import Field
from filterlab.geometry import times_matrix
from filterlab.io.images import from_srgb
from filterlab.ops.reference.optics import Table
from filterlab.render import suggestion
from filterlab.render.colormaps import encoded_entries

Numbers = Sequence[float] | Array
Peak = tuple[float | Tensor, float | Tensor, float | Tensor, Numbers]


# a triangle this near to its foot is at its foot: between peaks the opacity is exactly 0, not the rounding of 1 − 1
_FOOT = 1e-12


class TransferFunction(Table):
    """Piecewise linear in the scalar: colour and opacity are interpolated between control points.

    α(v) = (1−w) α_j + w α_{j+1}, w = (v − x_j)/(x_{j+1} − x_j), likewise linear RGB; constant beyond both ends, and
    exact at every control point. What is interpolated is α, the opacity of `unit` world length; the extinction
    −log1p(−α)/unit follows from it. A value of NaN is none: it has opacity 0, colour 0 and no derivative.

    Args:
        positions: `(M,)` increasing scalars x_j.
        colors: `(M, 3)` linear RGB, ≥ 0 (more than 1 is allowed: a glow).
        opacities: `(M,)` opacities per `unit`, 0 … 1; 1 is exactly opaque.
        unit: the world length that the opacities are for.

    All three tables may be tensors that require grad; everything is differentiable in them and in the scalar. At
    α = 1, where the derivative of the transmittance (1−α)^(s/unit) is infinite for s < unit, it is taken as 0.

    Raises:
        ValueError: wrong shapes, not increasing, out of range, not finite.
    """

    def __init__(self, positions: Numbers, colors: Sequence[Numbers] | Array, opacities: Numbers, unit: float = 1.0):
        tables = _table("positions", positions), _table("colors", colors), _table("opacities", opacities)
        super().__init__(*tables, _unit(unit))
        _check_tables(self)

    @classmethod
    def triangle_peaks(cls, peaks: Sequence[Peak], unit: float = 1.0) -> Self:
        """A sum of triangle-shaped peaks (center, width, height, rgb).

        α(v) = Σ height_k · max(0, 1 − |v − center_k| / (width_k/2)): `width` is the width of the base, `height` the
        opacity at the apex. Where peaks overlap the colour is their mean weighted by opacity (at the corners of the
        sum, linear in between); outside all peaks α = 0.

        Raises:
            ValueError: no peak, a width that is not positive, heights whose sum leaves 0 … 1 somewhere.

        Source: Csébfalvi, section 5 ("a transfer function that consists of two triangle-shaped peaks").
        """
        if not len(peaks) or any(len(peak) != 4 for peak in peaks):
            raise ValueError(f"peaks must be one or more (center, width, height, rgb); got {peaks!r}")
        centers, halves, heights = (torch.stack([_scalar(peak[k]) for peak in peaks]) for k in range(3))
        halves = halves / 2
        colors = torch.stack([as_numbers(peak[3]) for peak in peaks])
        if not (halves.detach() > 0).all():
            raise ValueError(f"peak widths must be positive; got {(2 * halves).tolist()}")
        x = torch.cat((centers - halves, centers, centers + halves)).sort().values
        x = x[torch.cat((x.new_ones(1, dtype=torch.bool), x.detach().diff() > _FOOT * float((x[-1] - x[0]).detach())))]
        climb = 1 - (x[:, None] - centers).abs() / halves  # (M, peaks)
        shares = torch.where(climb > _FOOT, heights * climb, torch.zeros_like(climb))
        # at a foot every share is 0: the colour is that of the peaks that end there
        touching = (climb.detach() >= -_FOOT).to(x.dtype)
        total = shares.sum(-1, keepdim=True)
        weights = torch.where(total > 0, shares, touching + torch.finfo(x.dtype).tiny)
        rgb = times_matrix(weights / weights.sum(-1, keepdim=True), colors)
        return cls(x, rgb, total[:, 0], unit)

    @classmethod
    def from_colormap(
        cls,
        name: str,
        opacities: Sequence[tuple[float, float]],
        ends: tuple[float, float] | None = None,
        unit: float = 1.0,
    ) -> Self:
        """The colours of a colormap under a ramp of opacities.

        Control points are the N entries of the colormap, decoded from sRGB, at x_i = a + (b − a) i/(N − 1), and the
        corners of the ramp. There the opacity is that of the ramp, linear between its corners, constant beyond.

        Args:
            name: of a colormap of matplotlib; those of few colours are blended.
            opacities: (value, opacity) corners of the ramp, values increasing.
            ends: the values (a, b) of the colormap's first and last colour; default the ends of the ramp.

        Raises:
            ValueError: no such colormap; no ramp, or one whose values do not increase; ends that do not.
        """
        entries = from_srgb(encoded_entries(name))
        values, alphas = [value for value, _ in opacities], [opacity for _, opacity in opacities]
        ramp = cls(values, [(0.0, 0.0, 0.0)] * len(values), alphas, unit)
        low, high = ends or (float(values[0]), float(values[-1]))
        if not low < high:
            raise ValueError(
                f"expected the value of a colormap's first colour below that of its last; got {low:g}, {high:g}"
            )
        colors = cls(
            torch.linspace(low, high, len(entries), dtype=torch.float64), entries, entries.new_zeros(len(entries))
        )
        x = torch.cat((colors.positions, ramp.positions)).sort().values
        x = x[torch.cat((x.new_ones(1, dtype=torch.bool), x.diff() > _FOOT * (high - low)))]
        return cls(x, colors.color(colors.locate(x)), ramp.opacity(ramp.locate(x)), unit)

    @classmethod
    def suggested(cls, field: Field, samples: suggestion.Sampled | None = None) -> Self:
        """One to begin with, from the histogram of a field: what is around is clear, up to three classes of values are
        not, in blue, tan and ivory; see `filterlab.render.suggestion`. Opacities are for a voxel.

        Args:
            field: unbatched.
            samples: of it, where they are known: `filterlab.render.suggestion.sampled(field)`.

        Raises:
            ValueError: a batched field, or one without a finite value.
        """
        return cls(*suggestion.tables(samples or suggestion.sampled(field)), field.domain.voxel_size)

    @property
    def requires_grad(self) -> bool:
        """True when any table requires grad."""
        return any(t.requires_grad for t in (self.positions, self.colors, self.opacities))

    @property
    def brightest(self) -> float:
        """The largest colour component."""
        return float(self.colors.detach().max())

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> Self:
        """The same function computing in another type; gradients flow back to the original tables."""
        out = object.__new__(type(self))
        for name in ("positions", "colors", "opacities"):
            setattr(out, name, getattr(self, name).to(dtype=dtype, device=device))
        out.unit = self.unit
        _check_fits(self, out)
        if bool((out.positions.detach().diff() <= 0).any()):
            raise ValueError(f"control points of the transfer function coincide in {dtype}: {self.positions.tolist()}")
        _check_tables(out)  # again: an optimizer may have moved them since
        return out

    def __call__(self, value: Array) -> tuple[Tensor, Tensor]:
        """(linear RGB `(..., 3)`, opacity per unit `(...)`) of values `(...)`, in promote(value, float32)."""
        value = as_tensor(value).contiguous()  # torch warns of what it makes contiguous by itself
        value = value.to(torch.promote_types(value.dtype, torch.float32))
        function = self.to(value.dtype, value.device)
        unknown = value.detach().isnan()
        located = function.locate(torch.where(unknown, function.positions[0].detach(), value))
        rgb, alpha = function.color(located), function.opacity(located)
        return torch.where(unknown[..., None], 0, rgb), torch.where(unknown, 0, alpha)


def _scalar(value: Numbers | float) -> Tensor:
    return as_numbers(value).reshape(())


def _unit(value: float) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"unit must be a positive world length; got {value!r}") from None


def _table(name: str, values: Sequence | Array) -> Tensor:
    try:
        return values if isinstance(values, Tensor) else as_numbers(values)
    except (TypeError, ValueError, ArithmeticError, RuntimeError):
        raise ValueError(f"{name} must be numbers; got {values!r}") from None


def _check_fits(transfer: TransferFunction, rounded: TransferFunction) -> None:
    """Raises ValueError for a finite number that the type of `rounded` does not have."""
    for name in ("positions", "colors"):
        given, there = getattr(transfer, name).detach(), getattr(rounded, name).detach()
        if bool((given.isfinite() & ~there.isfinite().to(given.device)).any()):
            kind = str(there.dtype).removeprefix("torch.")
            raise ValueError(
                f"{name} of the transfer function go beyond {kind}, which ends at {torch.finfo(there.dtype).max:.3g}; "
                f"got {given.tolist()}"
            )


def _check_tables(transfer: TransferFunction) -> None:
    x, rgb, alpha = (t.detach() for t in (transfer.positions, transfer.colors, transfer.opacities))
    m = x.numel()
    if x.ndim != 1 or m == 0 or rgb.shape != (m, 3) or alpha.shape != (m,):
        raise ValueError(
            "expected M ≥ 1 control points with positions (M,), colors (M, 3), opacities (M,); "
            f"got {tuple(x.shape)}, {tuple(rgb.shape)}, {tuple(alpha.shape)}"
        )
    if not all(t.dtype.is_floating_point and bool(t.isfinite().all()) for t in (x, rgb, alpha)):
        raise ValueError("positions, colors and opacities must be finite floating-point numbers")
    if m > 1 and not bool((x.diff() > 0).all()):
        raise ValueError(f"positions must increase from one control point to the next; got {x.tolist()}")
    if not bool(x.diff().isfinite().all()):
        kind = str(x.dtype).removeprefix("torch.")
        raise ValueError(f"positions must be less than the largest {kind} apart; got {x.tolist()}")
    if not bool(((alpha >= 0) & (alpha <= 1)).all()):
        raise ValueError(f"opacities must lie in 0 … 1; got {alpha.tolist()}")
    if not bool((rgb >= 0).all()):
        raise ValueError(f"colors must not be negative; got {rgb.tolist()}")
    if not 0 < transfer.unit < float("inf"):
        raise ValueError(f"unit must be a positive world length; got {transfer.unit}")
