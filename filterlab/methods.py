"""Methods: named ways to turn a Volume into a Field. A method is facts, and how to build the field.

`TensorProduct`, a prefilter and a kernel along every axis, is one kind; what only it has (separable terms, a response
in closed form) callers ask of `tensor_product`, and do without where it answers None. To add a method, add an entry to
`METHODS`; the tests, the experiments and the command line read it from there.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib import import_module

import torch
from torch import Tensor

from filterlab import kernels, missing_values, prefilters
from filterlab.arrays import Array
from filterlab.fields.base import Field
from filterlab.fields.grid import Coefficients, GridField, Scheme, Term, implementation_of
from filterlab.fields.ncrsi import NCRSI_TERMS, SevenSamples
from filterlab.fields.storage import named_storage
from filterlab.fields.tensor_product import (
    Direct,
    EightTrilinearCubic,
    EightTrilinearQuadratic,
    Sampled,
    Sampler,
    TrilinearCentral,
    named_sampler,
    same_kernel,
)
from filterlab.fields.tetrahedral import OnTetrahedra, Spline
from filterlab.fields.tetrahedral_pieces import FieldOnTetrahedra
from filterlab.kernels import Kernel, PiecewisePolynomial, TensorKernel
from filterlab.ops.differentiable import gather
from filterlab.prefilters import Prefilter
from filterlab.volume import Boundary, Volume, as_volume, exact_float

SampledScheme = Callable[[Sampler], Sampled]


@dataclass(frozen=True)
class Facts:
    """What a method promises; each is measured by a test.

    Attributes:
        support: width of the kernel along an axis, in voxels.
        taps: coefficients that one value needs (after the notch's averaging: 27).
        approximation_order: L, the error falls as h^L; with the method's own prefilter.
        approximation_order_without_prefilter: the same without it.
        continuity: m, the field is C^m (−1: discontinuous).
        interpolating: the field returns every sample; with the method's own prefilter.
        interpolating_without_prefilter: the same without it.
        prefiltered: the method has a prefilter.
        gradients: the kinds offered, the default first; `analytic` or `central` (differences of the trilinear samples).
        schemes: the ways of evaluating it.
    """

    support: int
    taps: int
    approximation_order: int
    approximation_order_without_prefilter: int
    continuity: int
    interpolating: bool
    interpolating_without_prefilter: bool
    prefiltered: bool
    gradients: tuple[str, ...]
    schemes: tuple[str, ...]


@dataclass(frozen=True)
class Method(ABC):
    """Facts, and how to build a field.

    Attributes:
        name: as in the registry.
        summary: one line for people.
    """

    name: str
    summary: str

    @property
    @abstractmethod
    def facts(self) -> Facts:
        """What the method promises."""

    @property
    @abstractmethod
    def gradients(self) -> tuple[str, ...]:
        """Kinds of gradient offered, the default first."""

    @property
    @abstractmethod
    def schemes(self) -> tuple[str, ...]:
        """The ways of evaluating it; the first one that can run is the default."""

    @abstractmethod
    def scheme(self, name: str | None, gradient: str | None, sampler: str | Sampler) -> Scheme:
        """The scheme of that name with that kind of gradient (None: the first one of either).

        Raises ValueError for a name or a combination that the method does not offer, with those it does.
        """

    def gradient_of(self, scheme: str) -> str:
        """The kind of gradient that a scheme gives when it is not told."""
        return self.gradients[0]

    @property
    def period(self) -> int:
        """By how many voxels along an axis a volume is moved for the same field, moved."""
        return 1

    @abstractmethod
    def reach(self, prefilter: bool) -> int:
        """How far from a sample, in voxels, the field depends on it in float64."""

    @abstractmethod
    def build(self, volume: Volume, asked: Asked) -> Field:
        """The field; see `reconstruct`. Raises ValueError for what the method does not offer."""

    def rebuilt(self, field: Field, asked: Asked) -> Field:
        """A field that it built, of other samples that lie as those did, on the same device; see `build`.

        What does not depend on samples is not asked again.
        """
        return self.build(Volume.with_geometry(asked.samples, field.domain.geometry), asked)

    def _check_offered(self, scheme: str | None, gradient: str | None) -> None:
        if scheme not in (None, *self.schemes):
            raise ValueError(f"method {self.name} offers the schemes {', '.join(self.schemes)}; got {scheme!r}")
        if gradient not in (None, *self.gradients):
            raise ValueError(f"method {self.name} offers the gradients {', '.join(self.gradients)}; got {gradient!r}")


@dataclass(frozen=True)
class Asked:
    """How a field is to be built; see `reconstruct`.

    Attributes:
        samples, unknown: the volume's without those that are missing, and a mask of these or None.
        boundary, prefilter, scheme, gradient, sampler, storage: as for `reconstruct`.
    """

    samples: Tensor
    unknown: Tensor | None = None
    boundary: Boundary = Boundary.MIRROR
    prefilter: bool = True
    scheme: str | None = None
    gradient: str | None = None
    sampler: str | Sampler = "exact"
    storage: str | torch.dtype | None = None

    def coefficients(
        self, prefilter: Prefilter, scheme: Scheme, storage: torch.dtype | None, factor: kernels.Factor | None = None
    ) -> Coefficients:
        """The samples, filtered if that is asked, padded as a scheme needs and stored; see `Coefficients.of`."""
        chosen, unknown = prefilter if self.prefilter else prefilters.IDENTITY, self.unknown
        return Coefficients.of(
            self.samples,
            chosen,
            self.boundary,
            scheme.reach,
            factor,
            storage,
            unknown,
            scheme.single,
            scheme.around,
            scheme.period,
        )


@dataclass(frozen=True)
class TensorProduct(Method):
    """Prefilter + kernel along every axis + ways to evaluate the sum.

    Attributes:
        kernel: φ. For ncrsi, whose 3-D kernel is not separable, the 1-D kernel on grid lines.
        prefilter: samples to coefficients.
        gradients: kinds of gradient offered, the default first.
        sampled: the evaluation by trilinear samples, where there is one.
        sampled_gradient: the kind of gradient it gives.
        terms: the value as separable terms, when it is not one kernel along every axis.
        continuity: of the field, when it is not the kernel's.
        taps: coefficients one value needs, when it is not the evaluated kernel's support cubed.
    """

    kernel: PiecewisePolynomial
    prefilter: Prefilter = prefilters.IDENTITY
    gradients: tuple[str, ...] = ("analytic",)
    sampled: SampledScheme | None = None
    sampled_gradient: str = "analytic"
    terms: tuple[Term, ...] | None = None
    continuity: int | None = None
    taps: int | None = None

    @property
    def factor(self) -> kernels.Factor | None:
        return self.kernel.factor if isinstance(self.kernel, Kernel) else None

    @property
    def value_terms(self) -> tuple[Term, ...]:
        """The value as separable terms over the stored coefficients."""
        return self.terms or same_kernel(self.factor.kernel if self.factor else self.kernel)

    @property
    def separable(self) -> tuple[Term, ...]:
        """The value as separable terms over prefiltered samples: the same, but for a kernel that is factored."""
        return self.terms or same_kernel(self.kernel)

    @cached_property
    def facts(self) -> Facts:
        """What the method promises. Raises TypeError for a kernel given as a tensor: it promises nothing."""
        if not isinstance(self.kernel, Kernel):
            raise TypeError(f"facts come from an exact kernel; {self.kernel.name} is a {type(self.kernel).__name__}")
        evaluated = self.factor.kernel.support if self.factor else self.kernel.support
        quasi_interpolates = (
            self.kernel.direct_order == self.kernel.approximation_order or not self.prefilter.is_identity
        )
        return Facts(
            support=self.kernel.support,
            taps=self.taps or evaluated**3,
            approximation_order=self.kernel.approximation_order if quasi_interpolates else self.kernel.direct_order,
            approximation_order_without_prefilter=self.kernel.direct_order,
            continuity=self.kernel.continuity if self.continuity is None else self.continuity,
            interpolating=_interpolates(self.kernel, self.prefilter),
            interpolating_without_prefilter=self.kernel.interpolating,
            prefiltered=not self.prefilter.is_identity,
            gradients=self.gradients,
            schemes=self.schemes,
        )

    @property
    def schemes(self) -> tuple[str, ...]:
        """The ways of evaluating it; the first one that can run is the default."""
        return ("fused", "direct") if self.sampled is None else ("fused", "direct", "sampled")

    def scheme(self, name: str | None, gradient: str | None, sampler: str | Sampler) -> Direct | Sampled:
        self._check_offered(name, gradient)
        if name == "sampled":
            if (gradient or self.gradients[0]) != self.sampled_gradient:
                raise ValueError(
                    f"sampled gives {self.name} the {self.sampled_gradient} gradient: ask for "
                    f"gradient={self.sampled_gradient!r}, or for scheme='direct'; got gradient={gradient!r}"
                )
            assert self.sampled is not None
            return self.sampled(named_sampler(sampler))
        if sampler != "exact":
            raise ValueError(f"sampler={sampler!r} needs scheme='sampled'; a sum over taps takes no samples")
        return Direct(self.value_terms, name or self.schemes[0], gradient or self.gradients[0])

    def gradient_of(self, scheme: str) -> str:
        return self.sampled_gradient if scheme == "sampled" else self.gradients[0]

    def reach(self, prefilter: bool) -> int:
        return self.kernel.support + (self.prefilter.decay(torch.float64) if prefilter else 0)

    def build(self, volume: Volume, asked: Asked) -> Field:
        scheme = self.scheme(asked.scheme, asked.gradient, asked.sampler).along(volume.size, asked.boundary)
        coefficients = asked.coefficients(self.prefilter, scheme, _storage_for(self, asked.storage), self.factor)
        return GridField(self.name, volume, coefficients, _that_runs(scheme, coefficients, asked))

    def rebuilt(self, field: Field, asked: Asked) -> Field:
        assert isinstance(field, GridField)
        storage = _storage_for(self, asked.storage)
        return field.with_coefficients(asked.coefficients(self.prefilter, field.scheme, storage, self.factor))


@dataclass(frozen=True)
class Tetrahedral(Method):
    """Prefilter + spline on tetrahedra.

    Published, these splines are quasi-interpolants of order 2, Q f = f + h²/8 Δf + O(h⁴), for quadratic f exactly. The
    inverse of the sampled quadratic B-spline, 1 + ω²/8 + … along every axis, cancels that term: order 3.

    Attributes:
        made: gives what is evaluated, `spline`.
        continuity: m, it is C^m everywhere.
        prefilter: samples to coefficients.
    """

    made: Callable[[], Spline]
    continuity: int
    prefilter: Prefilter = prefilters.QUADRATIC
    gradients: tuple[str, ...] = ("analytic",)
    schemes: tuple[str, ...] = ("fused", "direct")

    @cached_property
    def spline(self) -> Spline:
        """What is evaluated, made when it is first asked for."""
        return self.made()

    @cached_property
    def facts(self) -> Facts:
        return Facts(
            support=self.spline.support,
            taps=len(self.spline.samples),
            approximation_order=3,
            approximation_order_without_prefilter=2,
            continuity=self.continuity,
            interpolating=False,
            interpolating_without_prefilter=False,
            prefiltered=True,
            gradients=self.gradients,
            schemes=self.schemes,
        )

    def scheme(self, name: str | None, gradient: str | None, sampler: str | Sampler) -> OnTetrahedra:
        self._check_offered(name, gradient)
        if sampler != "exact":
            raise ValueError(f"sampler={sampler!r} needs scheme='sampled'; {self.name} takes no samples between voxels")
        return OnTetrahedra(self.spline, name or self.schemes[0])

    @property
    def period(self) -> int:
        return self.spline.period

    def reach(self, prefilter: bool) -> int:
        return self.spline.support + (self.prefilter.decay(torch.float64) if prefilter else 0)

    def build(self, volume: Volume, asked: Asked) -> Field:
        scheme = self.scheme(asked.scheme, asked.gradient, asked.sampler).along(volume.size, asked.boundary)
        coefficients = asked.coefficients(self.prefilter, scheme, named_storage(asked.storage))
        return FieldOnTetrahedra(self.name, volume, coefficients, _that_runs(scheme, coefficients, asked))

    def rebuilt(self, field: Field, asked: Asked) -> Field:
        assert isinstance(field, GridField)
        storage = named_storage(asked.storage)
        return field.with_coefficients(asked.coefficients(self.prefilter, field.scheme, storage))


_FORMER_SCHEMES = {"eight_trilinear": "sampled"}


def scheme_named(name: str | None) -> str | None:
    """A scheme by its present name: some files know it by a former one."""
    return _FORMER_SCHEMES.get(name, name) if isinstance(name, str) else name


def tensor_product(method: str | Method | PiecewisePolynomial) -> TensorProduct | None:
    """The method as a tensor product; None for one of another kind, of which nothing is known in closed form."""
    method = as_method(method)
    return method if isinstance(method, TensorProduct) else None


def _interpolates(kernel: Kernel, prefilter: Prefilter) -> bool:
    """Whether the prefilter is the one with which the kernel interpolates (for the notch none exists)."""
    try:
        needed = prefilters.interpolation(kernel)
        return (needed.is_identity or len(needed.poles) > 0) and prefilter.factors == needed.factors
    except ValueError:  # no such prefilter: the kernel is not symmetric, or its samples cannot be inverted
        return False


def _from_masks(module: str, name: str) -> Spline:
    """A spline on tetrahedra; to derive its masks, exact fractions, is put off until one is asked for."""
    return getattr(import_module(f"filterlab.fields.{module}"), name)


_QSS = partial(_from_masks, "type6", "QSS")
_CUBIC_C1 = partial(_from_masks, "type6", "CUBIC_C1")
_QUADRATIC_C1 = partial(_from_masks, "octahedral", "QUADRATIC_C1")

METHODS: dict[str, Method] = {
    m.name: m
    for m in (
        TensorProduct("nearest", "the nearest sample: for labels, and to see the voxels", kernels.bspline(0)),
        TensorProduct(
            "trilinear",
            "linear interpolation along each axis: the de facto standard",
            kernels.LINEAR,
            gradients=("analytic", "central"),
            sampled=TrilinearCentral,
            sampled_gradient="central",
        ),
        TensorProduct("catmull-rom", "interpolating cubic spline along each axis", kernels.CATMULL_ROM),
        TensorProduct(
            "ncrsi",
            "nonseparable Catmull-Rom: order three from the samples of central differences",
            kernels.CATMULL_ROM,
            gradients=("central", "analytic"),
            sampled=SevenSamples,
            sampled_gradient="central",
            terms=NCRSI_TERMS,
            continuity=0,
            taps=32,
        ),
        TensorProduct(
            "triquadratic",
            "prefiltered quadratic B-spline: C1, analytic gradient from the same eight samples",
            kernels.bspline(2),
            prefilters.QUADRATIC,
            sampled=EightTrilinearQuadratic,
        ),
        TensorProduct(
            "notch",
            "prefiltered Mitchell-Netravali notch: least staircase aliasing",
            kernels.NOTCH,
            prefilters.NOTCH,
            sampled=EightTrilinearQuadratic,
        ),
        TensorProduct("mitchell", "Mitchell-Netravali (1/3, 1/3): a compromise of blur and ringing", kernels.MITCHELL),
        TensorProduct(
            "tricubic",
            "prefiltered cubic B-spline: C2, order four",
            kernels.bspline(3),
            prefilters.CUBIC,
            sampled=EightTrilinearCubic,
        ),
        Tetrahedral("qss", "prefiltered quadratic super spline on 24 tetrahedra a cube: C1 across cubes", _QSS, 0),
        Tetrahedral("cubic-c1", "prefiltered cubic spline on the same: C1, degree 3 along any ray", _CUBIC_C1, 1),
        Tetrahedral(
            "quadratic-c1",
            "prefiltered quadratic spline on truncated octahedra: C1, degree 2 along any ray",
            _QUADRATIC_C1,
            1,
        ),
    )
}


def named(name: str, methods: Mapping[str, Method] = METHODS) -> Method:
    """The method of that name. Raises ValueError that lists the known names."""
    if name not in methods:
        raise ValueError(f"unknown method {name!r}; known methods: {', '.join(methods)}")
    return methods[name]


def from_kernel(kernel: PiecewisePolynomial, prefilter: Prefilter | None = None) -> TensorProduct:
    """A method made of any kernel.

    Args:
        kernel: a `Kernel` or a `TensorKernel` (then the field is differentiable in its table).
        prefilter: default: the one with which an exact kernel interpolates; none for a `TensorKernel`.
    """
    if prefilter is None:
        prefilter = prefilters.interpolation(kernel) if isinstance(kernel, Kernel) else prefilters.IDENTITY
    return TensorProduct(kernel.name, "made from a kernel", kernel, prefilter)


def as_method(method: str | Method | PiecewisePolynomial) -> Method:
    """A method by name, as it is, or made from a kernel."""
    if isinstance(method, str):
        return named(method)
    if isinstance(method, PiecewisePolynomial):
        return from_kernel(method)
    if not isinstance(method, Method):
        raise TypeError(f"method must be a name, a Method or a kernel; got {type(method).__name__}")
    return method


def checked(method: str | Method | PiecewisePolynomial, prefilter: bool) -> Method:
    """The method, if it has the prefilter that is asked for. Raises ValueError, and TypeError for what is no bool."""
    if prefilter and isinstance(method, TensorKernel):
        raise ValueError(f"the kernel {method.name} is a TensorKernel and has no prefilter; pass prefilter=False")
    if not isinstance(prefilter, bool):
        raise TypeError(f"prefilter must be True or False; got {prefilter!r} (from_kernel pairs a kernel with another)")
    return as_method(method)


def reconstruct(
    volume: Volume | Array,
    method: str | Method | PiecewisePolynomial = "triquadratic",
    *,
    boundary: str | Boundary = Boundary.MIRROR,
    prefilter: bool = True,
    scheme: str | None = None,
    gradient: str | None = None,
    sampler: str | Sampler = "exact",
    storage: str | torch.dtype | None = None,
    nan: str = "refuse",
) -> Field:
    """A continuous, differentiable field from a sampled volume: f(x) = Σ_k c_k φ(x − k), c = prefilter(samples).

    Args:
        volume: a `Volume`, or bare samples (D, H, W) or (N, C, D, H, W), a tensor or a NumPy array, whose voxel centres
            are the integers.
        method: a name from `METHODS`, a `Method`, or a kernel; an exact kernel that does not interpolate gets the
            prefilter with which it does, a `TensorKernel` has none and needs prefilter=False.
        boundary: how the samples go on beyond the ends: mirror, reflect, wrap, border or zeros.
        prefilter: False to sum the samples themselves (blurs with a kernel that does not interpolate).
        scheme: `fused` (the sum over taps in vector code compiled for this processor), `direct` (the same sum in plain
            torch, on any device) or, where the method offers it, `sampled` (for trilinear, whose gradient it
            takes by central differences, together with gradient="central"). Default: `fused` where it can run, else
            `direct`; `field.scheme.name` says which.
        gradient: `analytic` or `central`, where the method offers both; default: the method's own.
        sampler: for `sampled`: `exact`, `texture_unit` (8-bit fractions) or a callable.
        storage: how coefficients are stored: float64, float32, float16, bfloat16, int16, int8 or uint8 (a torch.dtype
            or its name; integers with a scale and an offset, see `filterlab.fields.storage`). Default: prefiltered
            ones as promote(samples, float32), others as the samples are; float64 for integers that float32 does not
            hold. Arithmetic does not depend on it.
        nan: what becomes of voxels that are NaN or infinite: `refuse`, `propagate` (the field is NaN exactly where its
            kernel reaches one) or `fill` (values from the voxels around); see `filterlab.missing_values`.

    Returns:
        a Field. It is differentiable in the volume's samples (any floating dtype; not with integer storage), in points,
        and in the table of a `TensorKernel`.

    Raises:
        ValueError: unknown name, a combination that the method does not offer, voxels that are not finite (with their
            number), integers beyond 2⁵³, a storage that can't hold the coefficients, or a fused scheme that cannot run
            here (the message says what is missing).
    """
    volume, method, boundary = as_volume(volume), checked(method, prefilter), Boundary.named(boundary)
    scheme = scheme_named(scheme)
    method.scheme(scheme, gradient, sampler)  # refused before the samples are read
    samples, unknown = missing_values.resolved(volume.samples, nan)
    if exact_float(samples) != torch.promote_types(samples.dtype, torch.float32):
        samples = samples.double()
    return method.build(volume, Asked(samples, unknown, boundary, prefilter, scheme, gradient, sampler, storage))


def _storage_for(method: TensorProduct, storage: str | torch.dtype | None) -> torch.dtype | None:
    """The type of that storage. Raises ValueError for integers where an offset would not come back as it is."""
    dtype = named_storage(storage)
    if dtype is not None and not dtype.is_floating_point:
        kernel = method.kernel
        if not isinstance(kernel, Kernel) or kernel.direct_order < 1:
            raise ValueError(
                f"storage={storage!r} stores an offset, which needs a kernel whose weights sum to 1; {kernel.name} "
                "does not promise that: use a floating type"
            )
    return dtype


def _that_runs(scheme: Scheme, coefficients: Coefficients, asked: Asked) -> Scheme:
    """The scheme, or in plain torch where a fused one was not asked for and can't run."""
    if not isinstance(scheme, Direct | OnTetrahedra) or scheme.name != "fused":
        return scheme
    if (why := _missing_for_fused(coefficients, scheme)) is None:
        return scheme
    if asked.scheme is not None:
        raise ValueError(f"scheme='fused' can't run here: {why}; scheme='direct' can")
    return replace(scheme, name="direct")


def _missing_for_fused(coefficients: Coefficients, scheme: Direct | OnTetrahedra) -> str | None:
    """What the fused sum lacks for these coefficients, or None."""
    values = coefficients.values.detach().reshape(-1, 1, *coefficients.values.shape[-3:])
    points = torch.empty(values.shape[0], 0, 3, dtype=torch.float32, device=values.device)
    implementation = implementation_of("fused", values.device)
    return gather.missing(implementation, values, points, scheme.stencils[1], None, coefficients.start)
