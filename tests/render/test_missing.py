"""Voxels without a value are transparent: against a loop over samples that leaves them out."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from filterlab.fields.base import Field
from filterlab.fields.grid import GridField
from filterlab.methods import reconstruct
from filterlab.render import Light, PerspectiveCamera, Shading, TransferFunction, bricks, fused, render
from filterlab.render.materials import Phong
from filterlab.render.raycast import raycast
from filterlab.render.rays import check_rays, intersect, jitter
from filterlab.surfaces import LevelSet

SCHEMES = ("fused", "direct")
LIT = Shading((Light((1.0, -2.0, 1.0)), Light(None, (0.3, 0.4, 0.5))), ambient=0.3)
SOFT = TransferFunction(
    [0.1, 0.4, 0.9], [[0.2, 0.3, 0.9], [0.8, 0.5, 0.1], [0.4, 0.9, 0.3]], [0.01, 0.3, 0.1], unit=2.0
)
BEHIND = (0.1, 0.2, 0.3)
METHODS = [("triquadratic", None), ("trilinear", "central"), ("ncrsi", None), ("tricubic", None), ("cubic-c1", None)]


def torn(dtype: torch.dtype = torch.float64) -> Tensor:
    """Noise with a voxel, a corner and a wall that are missing."""
    samples = torch.rand(9, 10, 11, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
    samples[6, 7, 7] = math.nan
    samples[:, :3, :3] = math.nan
    samples[2, 4:, 5] = math.inf
    return samples


def field_of(samples: Tensor, method: str, gradient: str | None, scheme: str) -> GridField:
    field = reconstruct(samples, method, gradient=gradient, scheme=scheme, nan="propagate")
    assert isinstance(field, GridField)
    return field


def rays(position: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """From a place through all of the volume."""
    position = torch.tensor([-9.0, -14.0, 11.0]).double() if position is None else position
    ends = torch.cartesian_prod(*(torch.linspace(0, n, 4, dtype=torch.float64) for n in (10, 9)))
    ends = torch.cat((ends, 4 + 0.1 * ends[:, :1]), 1)
    return position.expand_as(ends), ends - position


def one_by_one(field: Field, transfer: TransferFunction, shading: Shading | None, cut: tuple, step: float) -> Tensor:
    """Pixels, by C += T α c, T *= 1 − α over samples that are no NaN. `cut`: rays, how far into a step each begins."""
    (origins, directions), offsets = cut
    pixels = []
    for o, d, u in zip(*check_rays(origins, directions), offsets, strict=True):
        near, far = (x[0] for x in intersect(o[None], d[None], field.domain))
        ends = torch.cat((near[None], near + step * torch.arange(u, 60.0, dtype=torch.float64)))
        ends = torch.cat((ends[ends < far], far[None]))
        points, lengths = o + (ends[1:] + ends[:-1])[:, None] / 2 * d, ends.diff()
        order = 0 if shading is None else 1
        known = ~torch.cat([x.reshape(len(points), -1).isnan() for x in field.jet(points.detach(), order)], 1).any(1)
        value, *gradient = field.jet(points[known], order)
        colors, opacities = transfer(value)
        if shading is not None:
            colors = shading(colors, gradient[0], d.expand_as(colors))
        rgb, through = torch.zeros(3, dtype=torch.float64), torch.ones((), dtype=torch.float64)
        for color, opacity, length in zip(colors, opacities, lengths[known], strict=True):
            clear = torch.exp(length / transfer.unit * torch.log1p(-opacity))
            rgb, through = rgb + through * (1 - clear) * color, through * clear
        pixels.append(torch.cat((rgb + through * rgb.new_tensor(BEHIND), 1 - through[None])))
    return torch.stack(pixels)


@pytest.mark.parametrize("shading", [None, LIT], ids=["unlit", "lit"])
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("method", "gradient"), METHODS)
def test_samples_that_are_nan_are_left_out(
    method: str, gradient: str | None, scheme: str, shading: Shading | None
) -> None:
    seed, step = 3, 0.7
    field = field_of(torn(), method, gradient, scheme)
    expected = one_by_one(field, SOFT, shading, (rays(), jitter(seed, torch.arange(16)).tolist()), step)
    scene = {"step": step, "shading": shading, "background": BEHIND, "jitter_seed": seed}
    image = render(field, rays(), SOFT, dtype=torch.float64, **scene)
    torch.testing.assert_close(image, expected, rtol=0, atol=1e-12)
    whole = reconstruct(torn(), method, gradient=gradient, nan="fill")
    filled = render(whole, rays(), SOFT, dtype=torch.float64, **scene)
    assert ((filled - image)[:, 3] > 1e-3).sum() > 4  # there was something to leave out
    if method == "triquadratic":
        short = render(field_of(torn(torch.float32), method, gradient, scheme), rays(), SOFT, **scene)
        torch.testing.assert_close(short.double(), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("method", "gradient"), METHODS[:2])
def test_derivatives_are_those_of_the_samples_that_are_there(method: str, gradient: str | None, scheme: str) -> None:
    """By voxels, rays and all else; and derivatives of derivatives are finite."""
    results = []
    for one in (False, True):
        samples, position = torn().requires_grad_(), torch.tensor([-9.0, -14.0, 11.0]).double().requires_grad_()
        tables = [t.clone().requires_grad_() for t in (SOFT.positions, SOFT.colors, SOFT.opacities)]
        shininess = torch.tensor(6.0, dtype=torch.float64, requires_grad=True)
        shading = Shading(LIT.lights, shininess=shininess)
        field, transfer = field_of(samples, method, gradient, scheme), TransferFunction(*tables, SOFT.unit)
        some = tuple(r[::3] for r in rays(position))
        if one:
            image = one_by_one(field, transfer, shading, (some, [1.0] * 6), 0.9)
        else:
            image = render(field, some, transfer, step=0.9, shading=shading, background=BEHIND, dtype=torch.float64)
        leaves = [samples, position, *tables, shininess]
        weights = torch.linspace(0.2, 1, image.numel(), dtype=torch.float64).reshape(image.shape)
        results.append(torch.autograd.grad((image * weights).sum(), leaves, create_graph=not one))
    for found, expected in zip(*results, strict=True):
        assert expected.abs().max() > 1e-4
        torch.testing.assert_close(found.detach(), expected, rtol=0, atol=1e-10 * float(expected.abs().max()))
    second = torch.autograd.grad(sum(x.square().sum() for x in results[0]), leaves_of(results[0]), allow_unused=True)
    assert all(x is None or bool(x.isfinite().all()) for x in second)


def leaves_of(derivatives: tuple[Tensor, ...]) -> list[Tensor]:
    """All tensors that a graph begins at."""
    seen, left, leaves = set(), [x.grad_fn for x in derivatives], []
    while left:
        node = left.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        left += [parent for parent, _ in node.next_functions]
        leaves += [node.variable] if hasattr(node, "variable") else []
    return leaves


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("shading", [None, LIT], ids=["unlit", "lit"])
def test_a_volume_that_is_nearly_all_missing_shows_the_rest(scheme: str, shading: Shading | None) -> None:
    """Rays that meet nothing have the background's bits and opacity 0."""
    samples = torch.full((12, 12, 12), math.nan)
    samples[3:9, 3:9, 3:9] = 0.5
    field = field_of(samples, "triquadratic", None, scheme)
    camera = PerspectiveCamera.framing(field.domain, (0.4, 0.8, -0.45))
    image = render(field, camera, SOFT, size=(24, 24), shading=shading, background=BEHIND, termination=0.01)
    assert image.isfinite().all()
    seen = image[..., 3] > 0
    assert 20 < seen.sum() < 300
    assert torch.equal(image[~seen], torch.tensor([*BEHIND, 0.0]).expand(int((~seen).sum()), 4))


@pytest.mark.parametrize("stored", [torch.float32, torch.float64])
@pytest.mark.parametrize("shading", [None, LIT], ids=["unlit", "lit"])
def test_empty_bricks_change_no_bit(
    stored: torch.dtype, shading: Shading | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the image and its derivatives: what is missing is empty, too."""
    samples = torch.full((26, 26, 26), math.nan, dtype=stored)
    samples[3:22, 4:20, 5:18] = torch.rand(19, 16, 13, generator=torch.Generator().manual_seed(2)).to(stored) * 0.2
    samples[10:15, 10:15, 9:14] = 0.7
    samples[12, 12, 11] = math.nan
    clear = TransferFunction([0.3, 0.9], [[1.0, 0.5, 0.2], [0.2, 0.5, 1.0]], [0.0, 0.5])
    leaf, results = samples.requires_grad_(), []
    field = field_of(leaf, "triquadratic", None, "fused")
    found = bricks.bricks_of(field.coefficients.values, field.scheme.stencils[0], clear)  # type: ignore[attr-defined]
    assert found is not None
    assert (found.distance > 1).double().mean() > 0.1
    camera = PerspectiveCamera.framing(field.domain, (0.4, 0.8, -0.45))
    for skipping in (False, True):
        monkeypatch.setattr(fused, "SKIPPING", skipping)
        image = render(field, camera, clear, size=(20, 20), shading=shading, dtype=stored, jitter_seed=1)
        results.append((image, *torch.autograd.grad(image.square().sum(), leaf, retain_graph=True)))
    for plain, skipped in zip(*results, strict=True):
        assert plain.abs().max() > 1e-3
        assert plain.isfinite().all()
        assert torch.equal(plain, skipped)


def test_bricks_around_what_is_missing() -> None:
    """NaN is in no range; what has nothing else is empty; what is infinite is not."""
    grid = torch.zeros(16, 16, 16)
    grid[:7, :7, :7] = math.nan
    grid[12, 12, 12] = math.inf
    low, high = bricks._volume(grid, (1, 1, 1), 2).ranges
    assert low.isnan().nonzero().tolist() == high.isnan().nonzero().tolist() == [[0, 0, 0]]
    assert low.nan_to_num(0).eq(0).all()
    stencil = reconstruct(grid[:7], "nearest", scheme="fused", nan="propagate").scheme.stencils[0]  # type: ignore[attr-defined]
    found = bricks.bricks_of(grid, stencil, TransferFunction([0.5, 1.0], [[1.0] * 3] * 2, [0.0, 0.5]), edge=2)
    assert found is not None
    assert (found.distance == 0).nonzero().tolist() == [[3, 3, 3]]


# --- surfaces ---------------------------------------------------------------------------------------------------------


def slope(method: str, scheme: str, levels: int = 10) -> tuple[Tensor, GridField]:
    """f = z, missing from z = 6 on where y < 4; and its samples."""
    samples = torch.arange(float(levels), dtype=torch.float64)[:, None, None].expand(levels, 8, 8).clone()
    samples[6:, :4] = math.nan
    samples.requires_grad_()
    return samples, field_of(samples, method, None, scheme)


def upwards(height: float = -3.0) -> tuple[Tensor, Tensor]:
    y = torch.tensor([0.2, 1.2, 2.0, 3.0, 3.5, 4.2, 5.5], dtype=torch.float64)
    origins = torch.stack((torch.full_like(y, 3.3), y, torch.full_like(y, height)), -1)
    return origins, torch.tensor([[0.0, 0.0, 1.0 if height < 0 else -1.0]]).double().expand_as(origins)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_level_set_ends_where_values_are_missing(scheme: str) -> None:
    """z = 5 is beside what is missing: it is hit, and lit, to its end; of z = 7 a part is left; shadows go through."""
    for level, there in ((5.0, [True] * 7), (5.5, [False] * 5 + [True] * 2), (7.0, [False] * 5 + [True] * 2)):
        samples, field = slope("trilinear", scheme)
        surface = LevelSet(field, level)
        for origins, directions in (upwards(), upwards(20.0)):
            origins = origins.clone().requires_grad_()
            hit = surface.hit(origins, directions)
            assert hit.valid.tolist() == there
            at = surface.at(origins, directions, hit)
            assert at.normal is not None
            assert at.normal[hit.valid].tolist() == [[0.0, 0.0, 1.0]] * sum(there)
            torch.testing.assert_close(at.point[hit.valid][:, 2], torch.full((sum(there),), level).double())
            results = torch.cat((hit.t[hit.valid], at.point.flatten(), at.normal.flatten()))
            for found in torch.autograd.grad(results.square().sum(), (samples, origins), retain_graph=True):
                assert found.isfinite().all()
            (moved,) = torch.autograd.grad(hit.t[hit.valid].sum(), origins)
            assert moved[5:].abs().tolist() == [[0.0, 0.0, 1.0]] * 2
            every = surface.hits(origins, directions, 3)
            assert every.valid.sum(1).tolist() == [int(x) for x in there]


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("method", "gradient"), METHODS)
def test_images_of_torn_surfaces_are_finite(method: str, gradient: str | None, scheme: str) -> None:
    """And so are their derivatives; behind a hole the next sheet is seen, as in a surface without what is in front."""
    samples, sheets = torn().requires_grad_(), 1 if gradient else 3
    surface = LevelSet(field_of(samples, method, gradient, scheme), 0.5)
    scene = {"lights": LIT.lights, "background": BEHIND, "sheets": sheets, "shadows": True, "dtype": torch.float64}
    image = raycast(surface, rays(), Phong((0.8, 0.5, 0.3), opacity=0.7), **scene)
    assert isinstance(image, Tensor)
    assert image.isfinite().all()
    (found,) = torch.autograd.grad(image.square().sum(), samples)
    assert found.isfinite().all()
    assert found.abs().max() > 1e-3
    filled = LevelSet(reconstruct(torn(), method, nan="fill"), 0.5)
    whole, holed = (x.hits(*rays(), 20) for x in (filled, surface))
    known = ~surface.field(filled.at(*rays(), whole, 0).point).isnan() & whole.valid
    kept = [t[own].tolist() for t, own in zip(whole.t, known, strict=True)]
    assert kept == [pytest.approx(t[own].tolist(), rel=1e-12) for t, own in zip(holed.t, holed.valid, strict=True)]
    assert 0 < int((whole.valid & ~known).sum()) < int(whole.valid.sum())
