"""Quartic splines on triangulated squares: what each makes of heights on a grid, in exact rationals.

A cell is m × m steps of the data. It is cut into two triangles, which a half turn about its middle maps onto one
another, so that one set of masks serves both. On a triangle (V0, V1, V2), with barycentric coordinates λ,

    s(λ) = Σ_|α|=4  b_α · 4!/α! · λ^α,        b_α = Σ_(a, b) mask_α(a, b) · f(V0 + (a (V1 − V0) + b (V2 − V0)) / m)

Everything else is derived from the masks, and the masks from their rules: no number is copied.

| name | m | continuity | reproduces | order | what it is |
|---|---|---|---|---|---|
| linear | 1 | C⁰ | degree 1 | 2 | the plane through the data at the corners, written with degree 4 |
| c0 | 4 | C⁰ | degree 4 | 5 | the quartic through the data at the 15 domain points: interpolates all of them |
| c1 | 3 | C¹ | degree 3 | 4 | a quasi-interpolant: interpolates the data at the corners |
| c2 | 1 | C² | degree 1 | 2 | the box spline of three doubled directions, of control values |
| c2, prefiltered | 1 | C² | degree 3 | 4 | the same, of control values 3/2 f − 1/12 Σ of the six neighbours |

Source: High-quality rendering of quartic spline surfaces on the GPU, section IV, figures 4 to 8: S⁰₄, S¹₄, S²₄.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache, cached_property
from itertools import pairwise, product

from filterlab.bernstein import Index, multi_indices, multinomial
from filterlab.names import unknown_name
from filterlab.ops.heights import Pattern, Triangle

DEGREE = 4

Offset = tuple[int, int]
"""(a, b): a steps from V0 towards V1 and b towards V2; also a place of domain points, in steps of 1/degree."""

Mask = Mapping[Offset, Fraction]
"""Where data lie -> their weights."""

Corners = tuple[Offset, Offset, Offset]
"""Of a triangle."""

RING: tuple[Offset, ...] = ((1, 0), (0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1))
"""The six edges at a vertex, in order around it."""


@dataclass(frozen=True)
class QuarticSpline:
    """A spline of degree 4 on triangles.

    Attributes:
        name: of the spline.
        steps: m, of the data along an edge of a cell.
        continuity: r, of the derivatives that are continuous.
        reproduces: the largest degree of polynomials that are returned as they are.
        order: of approximation: errors of smooth functions fall as (step)^order.
        masks: for every α, |α| = 4, the weights of the data for b_α.
        prefiltered: whether `masks` hold the prefilter too.

    Raises ValueError where a coefficient has no mask, or weights don't add up to 1.
    """

    name: str
    steps: int
    continuity: int
    reproduces: int
    order: int
    masks: Mapping[Index, Mask]
    prefiltered: bool = False

    degree = DEGREE

    def __post_init__(self) -> None:
        if set(self.masks) != set(multi_indices(self.degree, 2)):
            raise ValueError(f"{self.name}: expected a mask for every coefficient of degree {self.degree}")
        if any(sum(mask.values()) != 1 for mask in self.masks.values()):
            raise ValueError(f"{self.name}: expected masks whose weights add up to 1")

    @cached_property
    def samples(self) -> tuple[Offset, ...]:
        """Where the data lie that a triangle needs."""
        return tuple(sorted({offset for mask in self.masks.values() for offset in mask}))

    @cached_property
    def rows_outside(self) -> int:
        """How many rows of data beyond a cell its triangles need."""
        return max(max(-a, -b, a - self.steps, b - self.steps) for a, b in self.samples)

    @cached_property
    def norm(self) -> Fraction:
        """max_α Σ |mask_α|: no height is larger than this times the largest datum."""
        return max(sum(map(abs, mask.values()), Fraction(0)) for mask in self.masks.values())

    def pattern(self, diagonal: str) -> Pattern:
        """Both triangles of a cell in numbers, as `ops` sums them.

        Args:
            diagonal: "main" joins the corners (0, 0) and (1, 1) of a cell (column, row), "anti" (1, 0) and (0, 1).
        """
        return _pattern(self.name, self.prefiltered, diagonal)

    def with_prefilter(self) -> QuarticSpline:
        """Of data f what this one is of control values 3/2 f − 1/12 Σ of the six neighbours.

        It makes the box spline reproduce degree 3. Raises ValueError for another spline.
        """
        if self.name != "c2" or self.prefiltered:
            raise ValueError(f"the prefilter is that of the spline c2; got {self.name}")
        masks = {alpha: _composed(mask, PREFILTER) for alpha, mask in self.masks.items()}
        return replace(self, masks=masks, reproduces=3, order=4, prefiltered=True)


PREFILTER: Mask = {(0, 0): Fraction(3, 2)} | {edge: Fraction(-1, 12) for edge in RING}


def quartic_spline(name: str, prefilter: bool = False) -> QuarticSpline:
    """The spline of that name. Raises ValueError that lists the known names, or for a prefilter that is not its own."""
    if name not in SPLINES:
        raise ValueError(unknown_name("spline", name, SPLINES))
    return SPLINES[name].with_prefilter() if prefilter else SPLINES[name]


# --- sums of masks ----------------------------------------------------------------------------------------------------


def weighted(*parts: tuple[Fraction | int, Mask]) -> dict[Offset, Fraction]:
    """Σ factor · mask, without the data whose weights cancel."""
    total: dict[Offset, Fraction] = {}
    for factor, mask in parts:
        for offset, weight in mask.items():
            total[offset] = total.get(offset, Fraction(0)) + factor * weight
    return {offset: weight for offset, weight in total.items() if weight}


def _composed(mask: Mask, filtered: Mask) -> Mask:
    """Of the data what a mask is of the filtered data."""
    return weighted(*((weight, _moved(filtered, offset)) for offset, weight in mask.items()))


def _moved(mask: Mask, by: Offset) -> Mask:
    return {(a + by[0], b + by[1]): weight for (a, b), weight in mask.items()}


def _on(corners: Corners, steps: int, mask: Mask) -> Mask:
    """The mask of the triangle (0, 0), (m, 0), (0, m) on another one."""
    (x, y), (u, v), (p, q) = corners
    along = (u - x) // steps, (v - y) // steps
    across = (p - x) // steps, (q - y) // steps
    return {
        (x + a * along[0] + b * across[0], y + a * along[1] + b * across[1]): weight for (a, b), weight in mask.items()
    }


def _by_symmetry(steps: int, rule: Callable[[Index, Corners], Mask]) -> dict[Index, Mask]:
    """Every mask from those of α_0 ≥ α_1 ≥ α_2, with the corners in the order in which α falls."""
    corners, masks = ((0, 0), (steps, 0), (0, steps)), {}
    for alpha in multi_indices(DEGREE, 2):
        first, second, third = sorted(range(3), key=lambda k: -alpha[k])
        falling = (alpha[first], alpha[second], alpha[third])
        masks[alpha] = rule(falling, (corners[first], corners[second], corners[third]))
    return masks


# --- the quartic, or cubic, through its domain points -----------------------------------------------------------------


@cache
def _interpolation(degree: int) -> Mapping[Index, Mask]:
    """b_α by the data at the domain points: the inverse of the matrix B_α((j V0 + …) / n)."""
    indices = multi_indices(degree, 2)
    rows = [[_bernstein(alpha, point) for alpha in indices] for point in indices]
    inverse = _inverse(rows)
    places = [(b, c) for _, b, c in indices]
    return {
        alpha: {place: w for place, w in zip(places, row, strict=True) if w}
        for alpha, row in zip(indices, inverse, strict=True)
    }


def _bernstein(alpha: Index, point: Index) -> Fraction:
    """B_α at the domain point of another index."""
    value = Fraction(multinomial(alpha), sum(point) ** sum(point))
    for a, p in zip(alpha, point, strict=True):
        value *= p**a
    return value


def _inverse(rows: list[list[Fraction]]) -> list[list[Fraction]]:
    """By elimination."""
    size = len(rows)
    left = [[*row, *(Fraction(i == j) for j in range(size))] for i, row in enumerate(rows)]
    for k in range(size):
        pivot = next(i for i in range(k, size) if left[i][k])
        left[k], left[pivot] = left[pivot], left[k]
        left[k] = [x / left[k][k] for x in left[k]]
        for i in range(size):
            if i != k and left[i][k]:
                left[i] = [x - left[i][k] * y for x, y in zip(left[i], left[k], strict=True)]
    return [row[size:] for row in left]


# --- c1 ---------------------------------------------------------------------------------------------------------------


def _c1(alpha: Index, corners: Corners) -> Mask:
    """With C the centre coefficient of the cubic through the ten data of a triangle, and g the mean of the gradients of
    the six cubics at V0: v = f(V0), u = v + g·(V1 − V0)/4, e = (C_left + C_right)/2, z = C/2 + (u_1 + u_2)/3 − v/6."""
    first, second, third = corners
    vertex: Mask = {first: Fraction(1)}
    match alpha:
        case (4, 0, 0):
            return vertex
        case (3, 1, 0):
            return weighted((1, vertex), (Fraction(1, 4), _slope(first, second)))
        case (2, 2, 0):
            other = (first[0] + second[0] - third[0], first[1] + second[1] - third[1])
            return weighted((Fraction(1, 2), _centre(corners)), (Fraction(1, 2), _centre((first, second, other))))
        case _:
            rise = [weighted((1, vertex), (Fraction(1, 4), _slope(first, end))) for end in (second, third)]
            thirds = [(Fraction(1, 3), mask) for mask in rise]
            return weighted((Fraction(1, 2), _centre(corners)), *thirds, (Fraction(-1, 6), vertex))


def _centre(corners: Corners) -> Mask:
    """c_111 of the cubic through the ten data."""
    return _on(corners, 3, _interpolation(3)[1, 1, 1])


def _slope(start: Offset, end: Offset) -> Mask:
    """g·(V1 − V0): every cubic gives its gradient by its derivatives along its two edges at V0."""
    p, q = (end[0] - start[0]) // 3, (end[1] - start[1]) // 3
    parts = []
    for (a, b), (c, d) in pairwise((*RING, RING[0])):  # (p, q) = first (a, b) + second (c, d); the determinant is 1
        first, second = p * d - q * c, a * q - b * p
        parts += [(Fraction(first, 6), _along(start, (a, b))), (Fraction(second, 6), _along(start, (c, d)))]
    return weighted(*parts)


def _along(start: Offset, edge: Offset) -> Mask:
    """3 (c_210 − c_300): the derivative at its start of the cubic through the four data of an edge."""
    cubic = _interpolation(3)
    line = weighted((3, cubic[2, 1, 0]), (-3, cubic[3, 0, 0]))
    return {(start[0] + a * edge[0], start[1] + a * edge[1]): weight for (a, _), weight in line.items()}


# --- c2: the box spline -----------------------------------------------------------------------------------------------


def _box_spline() -> dict[Index, Mask]:
    """From the hat function by three averages M(x) = ∫₀¹ q(x − t ξ) dt, along each direction of edges once.

    D_ξ M = q − q(· − ξ), and derivatives in Bernstein form are differences: along ξ coefficients are running sums.
    Between averages the net is turned by 60°, which maps the triangulation onto itself.
    """
    net: dict[Offset, Fraction] = {(0, 0): Fraction(1)}
    for degree in (2, 3, 4):
        net = {(-y, x + y): value for (x, y), value in _averaged(net, degree).items()}
    middle_x, middle_y = ((min(xs) + max(xs)) // 2 for xs in zip(*net, strict=True))
    masks = {}
    for alpha in multi_indices(DEGREE, 2):
        x, y = middle_x + alpha[1], middle_y + alpha[2]
        near = product(range(-2, 4), repeat=2)
        masks[alpha] = {(a, b): net[p] for a, b in near if (p := (x - DEGREE * a, y - DEGREE * b)) in net}
    return masks


def _averaged(net: Mapping[Offset, Fraction], degree: int) -> dict[Offset, Fraction]:
    """Coefficients, at (x, y) / n, of the average along (1, 0) of a continuous spline of degree n − 1.

    The step from (x, y) lies in an up triangle that starts at (i, j), or in a down one whose edge starts at (i, j + 1).
    """
    reach = 4 * degree
    found: dict[Offset, Fraction] = {}
    for y in range(-reach, reach + 1):
        value, (j, k) = Fraction(0), divmod(y, degree)
        for x in range(-reach, reach + 1):
            if value:
                found[x, y] = value
            i, within = divmod(x, degree)
            at = (x - i, y - j) if within < degree - k else (x - i, y - j - 1)
            before = (at[0] - (degree - 1), at[1])
            value += (net.get(at, Fraction(0)) - net.get(before, Fraction(0))) / degree
    return found


# --- all of them ------------------------------------------------------------------------------------------------------


def _linear(alpha: Index) -> Mask:
    ends = ((0, 0), (1, 0), (0, 1))
    return {end: Fraction(a, DEGREE) for end, a in zip(ends, alpha, strict=True) if a}


SPLINES: dict[str, QuarticSpline] = {
    spline.name: spline
    for spline in (
        QuarticSpline("linear", 1, 0, 1, 2, {alpha: _linear(alpha) for alpha in multi_indices(DEGREE, 2)}),
        QuarticSpline("c0", 4, 0, 4, 5, _interpolation(4)),
        QuarticSpline("c1", 3, 1, 3, 4, _by_symmetry(3, _c1)),
        QuarticSpline("c2", 1, 2, 1, 2, _box_spline()),
    )
}


@cache
def _pattern(name: str, prefiltered: bool, diagonal: str) -> Pattern:
    spline = quartic_spline(name, prefiltered)
    m, turned = spline.steps, diagonal == "main"
    up = _triangle(spline, lambda a, b: (m - a if turned else a, b))
    down = _triangle(spline, lambda a, b: (a if turned else m - a, m - b))
    return Pattern(name, diagonal, m, up, down)


def _triangle(spline: QuarticSpline, place: Callable[[int, int], Offset]) -> Triangle:
    """Data row after row, wherever they are: sums over an edge are the same, to the bit, from both sides."""
    order = sorted(spline.samples, key=lambda offset: place(*offset)[::-1])
    weights = tuple(tuple(float(mask.get(o, 0)) for o in order) for mask in spline.masks.values())
    return Triangle(tuple(place(*offset) for offset in order), weights)
