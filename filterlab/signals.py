"""Signals: closed-form functions of space with exact gradients. They are Fields, so they render as ground truth.

Every signal has a box (its domain); `sample` turns it into a Volume whose voxels tile that box.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import lru_cache
from typing import Literal

import torch
from torch import Tensor

from filterlab.arrays import Array
from filterlab.fields.base import Domain, Field, check_order, check_points, type_of_rays
from filterlab.fields.crossings import Along, Bounds, crossings, stepped
from filterlab.geometry import Geometry, times_matrix
from filterlab.ops.pieces import Pieces
from filterlab.ops.raycast import Candidates
from filterlab.ops.reference import raycast
from filterlab.ops.reference.pieces import inside
from filterlab.volume import Volume

ValueAndGradient = Callable[[Tensor], tuple[Tensor, Tensor]]
Corner = tuple[float, float, float]


class Signal(Field):
    """A closed-form function of space.

    Its level sets are found along rays by what is known of it, the first of these that is given:

        degree   it is one polynomial along a ray: every crossing is a root of that
        bounds   intervals are halved until bounds decide: every crossing (`filterlab.fields.crossings`)
        step     places no farther apart than that are compared: of crossings nearer to each other pairs may be lost

    Args:
        name: what error messages and reports call it.
        value_and_gradient: points `(..., 3)` -> (value `(...)`, exact gradient `(..., 3)`), differentiable torch code,
            of any type: jets are of that of the points.
        lower, upper: corners of the box it is looked at in, x, y, z.
        voxel_size: nominal voxel edge, the unit of a renderer's step; default 1/64 of the longest edge of the box.
        degree: in x, y and z together, if it is a polynomial.
        bounds: of its derivatives in the box.
        step: in world units.

    Raises:
        ValueError: a size or a step that is not positive; a degree below 0.
    """

    def __init__(
        self,
        name: str,
        value_and_gradient: ValueAndGradient,
        lower: Corner = (-1.0, -1.0, -1.0),
        upper: Corner = (1.0, 1.0, 1.0),
        voxel_size: float | None = None,
        *,
        degree: int | None = None,
        bounds: Bounds | None = None,
        step: float | None = None,
    ) -> None:
        self.name = name
        self._function = value_and_gradient
        size = max(b - a for a, b in zip(lower, upper, strict=True)) / 64 if voxel_size is None else voxel_size
        _require_positive(voxel_size=size, **({} if step is None else {"step": step}))
        if degree is not None and (isinstance(degree, bool) or not isinstance(degree, int) or degree < 0):
            raise ValueError(f"degree must be an integer ≥ 0; got {degree!r}")
        self.domain = Domain(lower, upper, Geometry(), size)
        self._degree, self.bounds, self.step = degree, bounds, step

    def with_voxel_size(self, voxel_size: float) -> Signal:
        """The same signal with another nominal voxel edge."""
        _require_positive(voxel_size=voxel_size)
        changed = copy(self)
        changed.domain = replace(self.domain, voxel_size=voxel_size)
        return changed

    # --- along rays ---

    @property
    def degree_along_rays(self) -> int | None:
        return None if self._degree is None else max(self._degree, 1)

    @property
    def search(self) -> str | None:
        if self._degree is not None:
            return super().search
        if self.bounds is not None:
            return f"exact: halved until bounds decide, down to {self.bounds.resolution:.0e} of a ray's way"
        return None if self.step is None else f"in steps of {self.step:g}: pairs of crossings between two may be lost"

    def pieces_along(self, origins: Tensor, directions: Tensor, level: float | None = None) -> Pieces:
        """One piece a ray, through its values at n + 1 places."""
        n = self.degree_along_rays
        if n is None:
            raise self.no_pieces()
        lines, ray, start = inside(origins.double(), directions.double(), self.domain.lower, self.domain.upper)
        places, matrix = (torch.tensor(x, device=origins.device, dtype=torch.float64) for x in _interpolation(n))
        t = lines.far[:, None] * places
        values = self(lines.origins[:, None] + t[..., None] * lines.directions[:, None])
        coefficients = times_matrix(values.detach(), matrix.T).to(type_of_rays(origins, directions))
        return Pieces(ray, lines.near, lines.far, coefficients, start)

    def first_crossing(self, origins: Tensor, directions: Tensor, level: float) -> Tensor:
        if self._degree is not None:
            return super().first_crossing(origins, directions, level)
        return raycast.first_of(self._crossings_at(level, first=True), origins, directions, _INTERVALS)

    def crossing_candidates(self, origins: Tensor, directions: Tensor, level: float) -> Candidates:
        """Each crossing that is no root of a piece, as a piece of no length that begins with its root."""
        if self._degree is not None:
            return super().crossing_candidates(origins, directions, level)
        return raycast.all_of(self._crossings_at(level, first=False), origins, directions, _INTERVALS)

    def _crossings_at(self, level: float, first: bool) -> raycast.Search:
        return lambda origins, directions: self._crossings(origins, directions, level, first)

    def _crossings(self, origins: Tensor, directions: Tensor, level: float, first: bool) -> Candidates:
        lines, met, start = inside(origins.double(), directions.double(), self.domain.lower, self.domain.upper)
        speed = lines.directions.norm(dim=-1)

        def along(ray: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
            d = lines.directions[ray]
            value, gradient = self._function(lines.origins[ray] + t[:, None] * d)
            return value.detach() - level, (gradient.detach() * d).sum(-1)

        ray, t = self._found(along, lines.far, speed, first)
        ray = met[ray]
        root, never = t.new_tensor([0.0, 1.0]).expand(len(t), 2), torch.zeros_like(ray, dtype=torch.bool)
        return Candidates(ray, start[ray], t, t, root, never, never)

    def _found(self, along: Along, length: Tensor, speed: Tensor, first: bool) -> tuple[Tensor, Tensor]:
        if self.bounds is not None:
            return crossings(along, length, speed, self.bounds, first)
        if self.step is not None:
            return stepped(along, length, speed, self.step)
        raise self.no_pieces()

    # --- at points ---

    def jet(self, points: Array, order: int) -> tuple[Tensor, ...]:
        """Value, exact gradient and (by automatic differentiation of the gradient) Hessian."""
        check_order(order, self.max_order)
        points = check_points(points, None)
        if order == 2:
            value, gradient = self._at(points)
            return value, gradient, _jacobian(lambda p: self._at(p)[1], points)
        return self._at(points)[: order + 1]

    def _at(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """In the type of the points, whatever the function computes in."""
        value, gradient = self._function(points)
        return value.to(points.dtype), gradient.to(points.dtype)

    def sample(
        self,
        n: int | Sequence[int],
        *,
        centering: Literal["cell", "node"] = "cell",
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> Volume:
        """The signal sampled on a grid of n (or (nx, ny, nz)) voxels, as a Volume with geometry.

        centering="cell": voxels tile the box, centres half a voxel inside its faces; "node": the first and last voxel
        centres lie on the faces (needs n ≥ 2).
        """
        size = (n, n, n) if isinstance(n, int) else tuple(int(k) for k in n)
        least = 2 if centering == "node" else 1
        if len(size) != 3 or min(size) < least:
            raise ValueError(f"n must be one or three integers ≥ {least} for {centering} centering; got {n!r}")
        if centering not in ("cell", "node"):
            raise ValueError(f"centering must be 'cell' or 'node'; got {centering!r}")
        extent = [b - a for a, b in zip(self.domain.lower, self.domain.upper, strict=True)]
        inset = 0.5 if centering == "cell" else 0.0
        spacing = [e / (k - 1 + 2 * inset) for e, k in zip(extent, size, strict=True)]
        origin = [a + inset * s for a, s in zip(self.domain.lower, spacing, strict=True)]
        axes = [
            o + s * torch.arange(k, dtype=torch.float64, device=device)
            for o, s, k in zip(origin, spacing, size, strict=True)
        ]
        planes = [  # one z-plane at a time: the float64 points of a large grid would be 24 bytes a voxel
            self(torch.stack(torch.broadcast_tensors(axes[0], axes[1][:, None], z), -1)).to(dtype) for z in axes[2]
        ]
        return Volume(torch.stack(planes), spacing=spacing, origin=origin)


_INTERVALS = 125  # that a ray has at a time, about


@lru_cache
def _interpolation(degree: int) -> tuple[tuple[float, ...], tuple[tuple[float, ...], ...]]:
    """Places in [0, 1], and the matrix from values there to the Bernstein coefficients of the one polynomial."""
    angle = (2 * torch.arange(degree + 1, dtype=torch.float64) + 1) * math.pi / (2 * degree + 2)
    places = (1 - angle.cos()) / 2
    powers = torch.arange(degree + 1)
    choose = torch.tensor([math.comb(degree, i) for i in range(degree + 1)], dtype=torch.float64)
    basis = choose * places[:, None] ** powers * (1 - places[:, None]) ** (degree - powers)
    return tuple(places.tolist()), tuple(map(tuple, torch.linalg.inv(basis).tolist()))


def _require_positive(**parameters: float) -> None:
    for name, value in parameters.items():
        if not (isinstance(value, int | float) and 0 < value < math.inf):
            raise ValueError(f"{name} must be a positive number; got {value!r}")


def _distance(d: Tensor) -> Tensor:
    """|d| along the last axis, with derivative 0 (and all that follow finite) at d = 0."""
    squared = (d * d).sum(-1)
    center = squared == 0
    return torch.where(center, 0 * squared, torch.where(center, torch.ones_like(squared), squared).sqrt())


def _unit(d: Tensor) -> Tensor:
    """d / |d|, 0 at d = 0."""
    r = _distance(d)
    return d / torch.where(r == 0, torch.ones_like(r), r)[..., None]


def _jacobian(function: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    """d function_i / d point_j of a pointwise function, `(..., 3)` -> `(..., 3, 3)`; differentiable again."""
    gradient, pull_back = torch.func.vjp(function, points)[:2]
    rows = []
    for axis in range(3):
        direction = torch.zeros_like(gradient)
        direction[..., axis] = 1
        rows.append(pull_back(direction)[0])
    return torch.stack(rows, -2)


def marschner_lobb(frequency: float = 6.0, alpha: float = 0.25, voxel_size: float | None = None) -> Signal:
    """The test signal of Marschner & Lobb on [−1, 1]³.

    ρ(x, y, z) = (1 − sin(πz/2) + α (1 + ρ_r(√(x²+y²)))) / (2 (1 + α)),  ρ_r(r) = cos(2π f_M cos(πr/2)).

    Source: Marschner & Lobb, An evaluation of reconstruction filters for volume rendering, 1994 (f_M = 6, α = 0.25).
    """

    _require_positive(frequency=frequency, alpha=alpha)

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        x, y, z = p.unbind(-1)
        scale = 1 / (2 * (1 + alpha))
        r = _distance(p[..., :2])
        phase = 2 * math.pi * frequency * torch.cos(math.pi / 2 * r)
        # d phase / d r divided by r is finite at r = 0: −2π f (π/2)² sinc(r/2)
        slope_over_r = -2 * math.pi * frequency * (math.pi / 2) ** 2 * torch.sinc(r / 2)
        value = scale * (1 - torch.sin(math.pi / 2 * z) + alpha * (1 + torch.cos(phase)))
        radial = -scale * alpha * torch.sin(phase) * slope_over_r
        along_z = -scale * math.pi / 2 * torch.cos(math.pi / 2 * z)
        return value, torch.stack((radial * x, radial * y, along_z), -1)

    scale, fastest = 1 / (2 * (1 + alpha)), math.pi**2 * frequency
    bounds = Bounds(
        scale * math.hypot(alpha * fastest, math.pi / 2),
        scale * max(alpha * (fastest * fastest + math.pi / 2 * fastest), (math.pi / 2) ** 2),
    )
    return Signal("marschner-lobb", function, voxel_size=voxel_size, bounds=bounds)


def franke(voxel_size: float | None = None) -> Signal:
    """Franke's test function extended to three variables, on [0, 1]³: a sum of four Gaussians.

    f = ¾ e^{−((9x−2)² + (9y−2)² + (9z−2)²)/4} + ¾ e^{−(9x+1)²/49 − (9y+1)/10 − (9z+1)/10}
      + ½ e^{−((9x−7)² + (9y−3)² + (9z−5)²)/4} − ⅕ e^{−(9x−4)² − (9y−7)² − (9z−5)²}

    Source: Renka, Multivariate interpolation of large sets of scattered data, 1988 (its trivariate test function 1).
    """
    # value of each term: height · exp(−Σ_d rate_d (9 x_d − shift_d)^power_d)
    terms = (
        (0.75, (0.25, 0.25, 0.25), (2, 2, 2), (2, 2, 2)),
        (0.75, (1 / 49, 0.1, 0.1), (-1, -1, -1), (2, 1, 1)),
        (0.5, (0.25, 0.25, 0.25), (7, 3, 5), (2, 2, 2)),
        (-0.2, (1.0, 1.0, 1.0), (4, 7, 5), (2, 2, 2)),
    )

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        value, gradient = torch.zeros_like(p[..., 0]), torch.zeros_like(p)
        for height, rates, shifts, powers in terms:
            rate, shift, power = p.new_tensor(rates), p.new_tensor(shifts), p.new_tensor(powers)
            u = 9 * p - shift
            squared = power == 2
            term = height * torch.exp(-(rate * torch.where(squared, u * u, u)).sum(-1))
            value = value + term
            gradient = gradient - 9 * term[..., None] * rate * torch.where(squared, 2 * u, torch.ones_like(u))
        return value, gradient

    bells = [(abs(height), rates[0]) for height, rates, _, powers in terms if powers == (2, 2, 2)]
    flat = (20 / 49) ** 2 + 2 * 0.1**2  # |∇|² of the other exponent where it is greatest, by 9 x, 9 y and 9 z
    bounds = Bounds(
        9 * (sum(h * math.sqrt(2 * rate / math.e) for h, rate in bells) + 0.75 * math.sqrt(flat)),
        81 * (sum(h * 2 * rate for h, rate in bells) + 0.75 * (flat + 2 / 49)),
    )
    return Signal("franke", function, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), voxel_size, bounds=bounds)


def polynomial(
    coefficients: dict[tuple[int, int, int], float],
    lower: Corner = (-1.0, -1.0, -1.0),
    upper: Corner = (1.0, 1.0, 1.0),
    voxel_size: float | None = None,
) -> Signal:
    """Σ c_{ijk} x^i y^j z^k with `coefficients` = {(i, j, k): c}; what a method reproduces is measured with it."""

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        x, y, z = p.unbind(-1)
        value, gradient = torch.zeros_like(x), [torch.zeros_like(x) for _ in range(3)]
        for (i, j, k), c in coefficients.items():
            value = value + c * x**i * y**j * z**k
            if i:
                gradient[0] = gradient[0] + c * i * x ** (i - 1) * y**j * z**k
            if j:
                gradient[1] = gradient[1] + c * j * x**i * y ** (j - 1) * z**k
            if k:
                gradient[2] = gradient[2] + c * k * x**i * y**j * z ** (k - 1)
        return value, torch.stack(gradient, -1)

    degree = max((sum(powers) for powers in coefficients), default=0)
    return Signal("polynomial", function, lower, upper, voxel_size, degree=degree)


def sphere(
    radius: float = 0.6, center: Corner = (0.0, 0.0, 0.0), edge: float = 0.1, voxel_size: float | None = None
) -> Signal:
    """A solid ball with a smooth edge on [−1, 1]³: f = ½ (1 − erf((|p − c| − radius) / edge)).

    `edge` is the width of the blur, in world units. The gradient points to the centre; at the centre itself it is 0.
    """

    _require_positive(radius=radius, edge=edge)

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        d = p - p.new_tensor(center)
        u = (_distance(d) - radius) / edge
        slope = -torch.exp(-u * u) / (math.sqrt(math.pi) * edge)
        return 0.5 * torch.erfc(u), slope[..., None] * _unit(d)

    return Signal("sphere", function, voxel_size=voxel_size, bounds=Bounds(1 / (math.sqrt(math.pi) * edge)))


def sphere_distance(radius: float = 0.6, center: Corner = (0.0, 0.0, 0.0), voxel_size: float | None = None) -> Signal:
    """The signed distance to a sphere on [−1, 1]³, negative inside: |p − c| − radius."""

    _require_positive(radius=radius)

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        d = p - p.new_tensor(center)
        return _distance(d) - radius, _unit(d)

    return Signal("sphere-distance", function, voxel_size=voxel_size, bounds=Bounds(1.0))


def torus(radius: float = 0.55, tube: float = 0.25, voxel_size: float | None = None) -> Signal:
    """A torus about the z axis on [−1, 1]³, as the quartic whose zeros it is; negative inside.

    f = (|p|² + R² − r²)² − 4 R² (x² + y²), with R = `radius` of the circle in the middle of the tube, r of the `tube`.
    It is smooth everywhere, so that level sets of every method show their orders.
    """

    _require_positive(radius=radius, tube=tube)

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        flat = torch.cat((p[..., :2], torch.zeros_like(p[..., 2:])), -1)
        q = (p * p).sum(-1) + radius * radius - tube * tube
        value = q * q - 4 * radius * radius * (flat * flat).sum(-1)
        return value, 4 * q[..., None] * p - 8 * radius * radius * flat

    return Signal("torus", function, voxel_size=voxel_size, degree=4)


def barth_sextic(extent: float = 1.75, voxel_size: float | None = None) -> Signal:
    """Barth's sextic: its zeros are the surface of degree 6 with most double points, 65 of them, 15 at infinity.

    f = 4 (τ²x² − y²)(τ²y² − z²)(τ²z² − x²) − (1 + 2τ) (x² + y² + z² − 1)²,  τ = (1 + √5) / 2,

    on [−1, 1]³, which stands for x, y, z between ± `extent`. At double points the gradient is 0, and spikes end there.

    Source: Barth, Two projective surfaces with many nodes, admitting the symmetries of the icosahedron, 1996.
    """

    _require_positive(extent=extent)
    golden = (1 + math.sqrt(5)) / 2

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        q = extent * p
        squares = q * q
        following = squares.roll(-1, -1)  # y², z², x²
        factors = golden**2 * squares - following
        others = factors.roll(-1, -1) * factors.roll(1, -1)  # of each factor the product of the two others
        ball = squares.sum(-1, keepdim=True) - 1
        weight = 1 + 2 * golden
        value = 4 * factors.prod(-1) - weight * (ball * ball)[..., 0]
        slopes = 8 * (golden**2 * others - others.roll(1, -1)) - 4 * weight * ball
        return value, extent * slopes * q

    return Signal("barth-sextic", function, voxel_size=voxel_size, degree=6)


def gaussian(sigma: float = 0.3, center: Corner = (0.0, 0.0, 0.0), voxel_size: float | None = None) -> Signal:
    """exp(−|p − c|² / (2σ²)) on [−1, 1]³: smooth, so that every method shows its order early."""

    _require_positive(sigma=sigma)

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        d = p - p.new_tensor(center)
        value = torch.exp(-(d * d).sum(-1) / (2 * sigma * sigma))
        return value, -value[..., None] * d / (sigma * sigma)

    bounds = Bounds(math.exp(-0.5) / sigma, (1 / sigma) * (1 / sigma))
    return Signal("gaussian", function, voxel_size=voxel_size, bounds=bounds)


def plane_wave(wave_vector: Corner = (4.0, 2.0, 1.0), phase: float = 0.0, voxel_size: float | None = None) -> Signal:
    """cos(k · p + phase) on [−1, 1]³ with k in radians per world unit: one frequency, for response measurements."""

    def function(p: Tensor) -> tuple[Tensor, Tensor]:
        k = p.new_tensor(wave_vector)
        angle = (p * k).sum(-1) + phase
        return torch.cos(angle), -torch.sin(angle)[..., None] * k

    longest = math.hypot(*wave_vector)
    return Signal("plane-wave", function, voxel_size=voxel_size, bounds=Bounds(longest, longest * longest))


SIGNALS: dict[str, Callable[..., Signal]] = {
    "marschner-lobb": marschner_lobb,
    "franke": franke,
    "sphere": sphere,
    "sphere-distance": sphere_distance,
    "torus": torus,
    "barth-sextic": barth_sextic,
    "gaussian": gaussian,
    "plane-wave": plane_wave,
}


def named(name: str, **parameters: float) -> Signal:
    """The signal of that name. Raises ValueError that lists the known names."""
    if name not in SIGNALS:
        raise ValueError(f"unknown signal {name!r}; known signals: {', '.join(SIGNALS)}")
    return SIGNALS[name](**parameters)
