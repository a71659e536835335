"""The oracle of splines on tetrahedra against exact values, figures that are published, scipy, and itself."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from scipy import ndimage

from tests import laws
from tests import tetrahedral_oracle as oracle
from tests.oracles import BOUNDARIES
from tests.tetrahedral_oracle import SPLINES

every_spline = pytest.mark.parametrize("name", SPLINES)

# quadratic-c1 of ((7x + 13y + 29z + 3xy + 5yz + 11zx + xyz) mod 17) − 8, 8³ samples: x y z, value, gradient, exactly
VECTORS = """
7/2 7/2 7/2 -3/4 9/2 -2 -1/2
5/2 5/2 5/2 1/4 -7 1 3
7/2 3 5/2 -5/16 85/16 1/8 9/16
3 3 3 -7/8 -19/12 -5/6 11/12
3 4 4 -19/32 -61/24 91/24 31/24
7/2 5/2 5/2 -3/8 23/4 1/8 13/8
13/4 13/4 5/2 -37/32 61/32 11/32 1/8
26/5 501/100 271/50 175321/80000 1051/2400 227/300 -811/480
227/100 283/100 99/20 -124349/72000 4543/3600 -127/225 9539/3600
19/4 201/100 317/100 17983/8000 2749/1200 -139/300 2863/1200
443/100 59/25 163/100 448179/160000 -1203/800 -1/800 -91/25
18/5 179/50 47/25 14671/10000 67/16 339/200 -1337/400
101/50 107/50 313/100 6279/5000 -701/600 2281/600 -493/150
98/25 447/100 19/5 16571/8000 13/5 133/24 -83/50
18/5 64/25 63/25 3739/20000 241/50 -1/200 34/25
78/25 47/10 249/50 153757/120000 431/1200 283/60 179/1200
321/100 159/50 92/25 -118351/80000 1427/400 -541/400 -17/30
197/100 471/100 83/20 2532223/720000 6419/3600 481/360 121/450
401/100 357/100 191/100 162913/80000 -763/1200 -19/120 -1799/600
51/20 443/100 137/50 -15977/20000 -81/100 127/25 -243/200
167/100 253/100 99/50 181431/160000 72/25 -2951/800 17/800
48/25 247/100 279/100 25927/10000 179/300 203/120 377/600
101/20 541/100 59/20 220561/80000 -193/50 -1007/1200 171/50
153/50 503/100 281/100 1254343/480000 6089/2400 8633/2400 11/240
233/100 469/100 21/10 1131433/720000 8351/3600 53/45 -6511/3600
161/100 143/50 511/100 -22973/16000 -959/600 -233/1200 2431/1200
269/100 131/50 443/100 -2879599/1440000 19237/7200 -1051/1440 8203/3600
271/100 89/50 39/25 -7/40000 -671/200 -681/200 -533/200
24/5 233/50 303/100 2247/625 -1891/600 2839/1200 907/300
293/100 11/5 101/20 -1103/20000 51/25 239/300 93/100
481/100 321/100 457/100 66581/30000 503/600 -857/300 -67/24
519/100 379/100 57/25 -189447/80000 -1457/800 623/800 3/100
119/25 29/10 217/50 176939/60000 323/120 -859/1200 829/1200
371/100 23/10 117/50 15137/40000 109/25 89/800 309/160
357/100 511/100 211/100 27493/6000 427/240 299/150 -517/1200
503/100 107/50 549/100 79203/160000 -259/800 -837/800 -1699/400
447/100 369/100 163/50 266743/160000 77/200 1977/800 379/800
66/25 209/100 461/100 -66343/40000 117/50 23/16 207/80
44/25 83/20 249/100 1981/40000 -54/25 87/200 -229/100
373/100 119/50 119/50 21767/40000 813/200 143/800 1251/800
"""


def test_exact_values_on_truncated_octahedra():
    x, y, z = np.meshgrid(*[np.arange(8)] * 3, indexing="ij")
    samples = ((7 * x + 13 * y + 29 * z + 3 * x * y + 5 * y * z + 11 * z * x + x * y * z) % 17 - 8).T
    rows = np.array([[float(Fraction(word)) for word in line.split()] for line in VECTORS.strip().splitlines()])
    value, gradient = oracle.reconstruct("quadratic-c1", samples, rows[:, :3], prefilter=False)
    laws.assert_close(value, rows[:, 3], 2e-14)
    laws.assert_close(gradient, rows[:, 4:], 5e-14)


@pytest.mark.parametrize(("name", "count"), {"qss": 24, "cubic-c1": 24, "quadratic-c1": 144}.items())
def test_tetrahedra_fill_the_cell_and_are_located(name, count):
    spline = SPLINES[name]
    assert len(spline.tetrahedra) == count
    volumes = [abs(_determinant(t.vertices)) / 6 for t in spline.tetrahedra]
    assert sum(volumes) == (4 if spline.body_centred else 1)
    points = np.random.default_rng(0).uniform(-9, 9, (500, 3))
    local = points - spline.centres(points) - float(spline.shift)
    table = oracle._table(name)
    barycentric = np.einsum("tnc,pc->ptn", table.to_barycentric, np.insert(local, 0, 1, axis=-1))
    assert barycentric.min(-1).max(-1).min() >= -1e-14


def _determinant(vertices) -> Fraction:
    a, b, c = ([p - q for p, q in zip(v, vertices[0], strict=True)] for v in vertices[1:])
    return sum((a[i] * (b[i - 2] * c[i - 1] - b[i - 1] * c[i - 2]) for i in range(3)), Fraction())


@every_spline
def test_splines_add_an_eighth_of_the_laplacian_to_quadratics(name):
    """Published: Q f = f + Δf/8 for |degree| ≤ 2, so that x² is off by 1/4 everywhere, and nothing else is."""
    rng = np.random.default_rng(1)
    points, grid = rng.uniform(1.5, 7.5, (300, 3)), np.moveaxis(np.indices((10, 10, 10))[::-1], 0, -1)
    for power in [(0, 0, 0), (1, 0, 0), (0, 0, 1), (1, 1, 0), (0, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2)]:
        samples = _monomial(grid, power)
        value, gradient = oracle.reconstruct(name, samples, points, prefilter=False)
        laws.assert_close(value, _monomial(points, power) + (0.25 if max(power) == 2 else 0), 2e-13)
        lower = [tuple(max(power[i] - (i == d), 0) for i in range(3)) for d in range(3)]
        slopes = [power[d] * _monomial(points, lower[d]) for d in range(3)]
        laws.assert_close(gradient, np.stack(slopes, -1), 5e-13)


def _monomial(points: np.ndarray, power: tuple[int, ...]) -> np.ndarray:
    return np.prod(points ** np.array(power), axis=-1)


@pytest.mark.parametrize(("name", "norm"), {"qss": (9, 8), "cubic-c1": (1, 1), "quadratic-c1": (5, 4)}.items())
def test_norms_of_masks_are_the_published_ones(name, norm):
    sums = [sum(map(abs, mask.values())) for t in SPLINES[name].tetrahedra for mask in t.masks.values()]
    assert max(sums) == Fraction(*norm)


@every_spline
def test_every_order_of_vertices_gives_the_same_masks(name):
    """A symmetry that maps a tetrahedron to itself maps its masks to themselves, or the orbit was ambiguous."""
    spline = SPLINES[name]
    points = {_domain_point(t, a): m for t in spline.tetrahedra for a, m in t.masks.items()}
    for matrix in list(oracle.signed_permutations())[::3]:
        for t in spline.tetrahedra[:: len(spline.tetrahedra) // 3]:
            image = t.image(matrix)
            assert all(points[_domain_point(image, a)] == m for a, m in image.masks.items())


def _domain_point(t: oracle.Tetrahedron, alpha: oracle.Index) -> tuple[Fraction, ...]:
    n = sum(alpha)
    return tuple(
        sum((Fraction(a, n) * v[d] for a, v in zip(alpha, t.vertices, strict=True)), Fraction()) for d in range(3)
    )


@pytest.mark.parametrize(("boundary", "mode"), {"mirror": "mirror", "reflect": "reflect", "wrap": "grid-wrap"}.items())
def test_prefiltered_samples_equal_scipys(boundary, mode):
    samples = np.random.default_rng(2).uniform(-1, 1, (24, 25, 26))
    expected = ndimage.spline_filter(samples, 2, mode=mode)
    points = np.array([[0.0, 0, 0], [25, 24, 23]])
    filtered = oracle.Samples.continued(samples, boundary, True, points)
    z, y, x = np.indices(samples.shape)
    laws.assert_close(filtered.at(np.stack([x, y, z], -1)), expected, 1e-13)


@every_spline
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_derivatives_equal_differences(name, boundary):
    samples, rng = np.random.default_rng(3).uniform(-1, 1, (5, 7, 6)), np.random.default_rng(4)
    points, h = rng.uniform(-2.5, 3.5, (300, 3)) * (6, 7, 5), 1e-5

    def difference(order: int) -> np.ndarray:
        ahead, behind = (
            [oracle.reconstruct(name, samples, points + s * h * e, boundary)[order] for e in np.eye(3)] for s in (1, -1)
        )
        return (np.stack(ahead, -1) - np.stack(behind, -1)) / (2 * h)

    _, gradient, hessian = oracle.reconstruct(name, samples, points, boundary, order=2)
    laws.assert_close(gradient, difference(0), 1e-9)
    laws.assert_close(hessian, difference(1), 1e-9)
