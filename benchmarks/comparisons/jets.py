"""Value and gradient: the fused sum against plain torch and against eight trilinear samples."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from benchmarks import workloads
from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, race_item
from benchmarks.records import at_most
from benchmarks.settings import Settings
from filterlab import ops
from filterlab.methods import METHODS, Tetrahedral, reconstruct

# key: method, kind of gradient (None: the method's own)
_CASES: dict[str, tuple[str, str | None]] = {
    "triquadratic": ("triquadratic", None),
    "tricubic": ("tricubic", None),
    "notch": ("notch", None),
    "mitchell": ("mitchell", None),
    "trilinear": ("trilinear", None),
    "trilinear-central": ("trilinear", "central"),
    "ncrsi": ("ncrsi", None),
}
_IMPLEMENTATIONS = {"fused": "cpu", "direct": "reference"}
_BARS = {"triquadratic-coherent": at_most("1/25")}


def field_contestant(
    method: str,
    scheme: str,
    volume: Tensor,
    where: Tensor,
    *,
    gradient: str | None = None,
    name: str | None = None,
    computes: str | None = "value and gradient",
) -> Contestant:
    """value_and_gradient of a field of that scheme: boundary, folding of points and all."""
    field = reconstruct(volume, method, scheme=scheme, gradient=gradient)
    return Contestant(name or scheme, lambda: field.value_and_gradient(where), computes, samples=len(where))


def op_contestant(
    method: str, scheme: str, volume: Tensor, where: Tensor, computes: str | None = "value and gradient of the op"
) -> Contestant:
    """`ops.jet` of order 1 of a method's kernel on bare coefficients: no boundary, no folding."""
    (term,) = workloads.terms_of(method)
    coefficients, located = volume[None, None], where[None]

    def call() -> Tensor:
        return ops.jet(coefficients, located, term.kernels, 1, 0, _IMPLEMENTATIONS[scheme])

    return Contestant(f"op {scheme}", call, computes, lambda rows: (rows[0, 0, 0], rows[0, 0, 1:]), len(where))


def schemes_of(method: str, gradient: str | None) -> Sequence[str]:
    """The schemes that give a method that kind of gradient, the fused one first."""
    m, kind = METHODS[method], gradient or METHODS[method].gradients[0]
    return [s for s in m.schemes if s in ("fused", "direct") or m.gradient_of(s) == kind]


def _race(settings: Settings, case: str, arrangement: str) -> Race:
    method, gradient = _CASES[case]
    volume = workloads.noise(settings.voxels)
    where = workloads.points(arrangement, settings.voxels, settings.points)
    schemes = schemes_of(method, gradient)
    contestants = [field_contestant(method, s, volume, where, gradient=gradient) for s in schemes]
    bar = _BARS.get(f"{case}-{arrangement}")
    ratios = [Ratio("fused", other, bar if other == "direct" else None) for other in schemes[1:]]
    if len(workloads.terms_of(method)) == 1 and gradient is None:
        contestants += [op_contestant(method, s, volume, where) for s in ("fused", "direct")]
        ratios.append(Ratio("op fused", "op direct", bar))
    kind = f"{gradient or METHODS[method].gradients[0]} gradient"
    return Race(f"{method} value + {kind}, {_at(settings, arrangement)}", contestants, ratios, tolerance=2e-5)


def _on_tetrahedra(settings: Settings, arrangement: str) -> Race:
    """Splines on tetrahedra against the tensor product of the same accuracy, fused both."""
    volume = workloads.noise(settings.voxels)
    where = workloads.points(arrangement, settings.voxels, settings.points)
    splines = [name for name, method in METHODS.items() if isinstance(method, Tetrahedral)]
    contestants = [
        field_contestant(name, "fused", volume, where, name=name, computes=f"{name} value and gradient")
        for name in ("triquadratic", *splines)
    ]
    bar = at_most("2") if arrangement == "coherent" else None
    ratios = [Ratio(name, "triquadratic", bar) for name in splines]
    return Race(f"splines on tetrahedra, value + gradient, {_at(settings, arrangement)}", contestants, ratios)


def _at(settings: Settings, arrangement: str) -> str:
    """The workload in words."""
    order = "along rays" if arrangement == "coherent" else "at random"
    return f"{settings.points:,} points {order}, {settings.voxels}³ float32"


def _items(settings: Settings) -> list[Item]:
    return [
        race_item(f"{case}-{arrangement}", 15, lambda s, case=case, order=arrangement: _race(s, case, order))
        for case in _CASES
        for arrangement in workloads.ARRANGEMENTS
    ] + [
        race_item(f"tetrahedra-{arrangement}", 15, lambda s, order=arrangement: _on_tetrahedra(s, order))
        for arrangement in workloads.ARRANGEMENTS
    ]


COMPARISON = Comparison(
    "jets", "value + gradient: fused against the plain sum and eight trilinear samples, as an op and as a field", _items
)
