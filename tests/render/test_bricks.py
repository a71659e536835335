"""Empty space: bounds hold, what is called empty is, and leaving it out changes no bit."""

from __future__ import annotations

import gc
import itertools

import pytest
import torch
from torch import Tensor

from filterlab import ops
from filterlab.fields.grid import GridField
from filterlab.fields.ncrsi import NCRSI_TERMS
from filterlab.fields.tensor_product import Direct, same_kernel
from filterlab.kernels import KERNELS, bspline
from filterlab.methods import METHODS, reconstruct
from filterlab.ops.differentiable import march
from filterlab.render import Light, PerspectiveCamera, Shading, TransferFunction, bricks, fused, render
from tests.test_methods import TENSOR_PRODUCTS

LIT = Shading((Light((1.0, -2.0, 1.0)), Light()), ambient=0.3)
PEAK = TransferFunction.triangle_peaks([(0.5, 0.2, 0.6, (0.2, 0.4, 1.0))], unit=2.0)


def ball(shape=(23, 19, 30)) -> Tensor:
    """1 inside, falling to 0: nearly all of it is flat."""
    axes = [torch.arange(n, dtype=torch.float64) - n / 2.3 for n in shape]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    return ((8.3 - (x * x + y * y + z * z).sqrt()) / 3).clamp(0, 1)


# --- bounds of the weights --------------------------------------------------------------------------------------------


def all_weights(stencil: ops.Stencil, parts: int = 16) -> Tensor:
    """The weights of all taps at many places in a cell: (places, taps)."""
    s = stencil.supports
    u = torch.cartesian_prod(*[(torch.arange(parts, dtype=torch.float64) + 0.5) / parts] * 3)
    points = u + torch.tensor([n / 2 - 1 for n in s], dtype=torch.float64)
    cotangents = torch.ones(len(u), 1, 1, 1, dtype=torch.float64)
    return ops.scatter(cotangents, points[:, None], stencil, s[::-1]).flatten(1)


STENCILS = {
    name: m.scheme("direct", None, "exact").stencils[0] for name, m in METHODS.items() if name in TENSOR_PRODUCTS
}  # type: ignore[attr-defined]
STENCILS |= {f"kernel {name}": Direct(same_kernel(k)).stencils[0] for name, k in KERNELS.items() if k.support <= 6}


@pytest.mark.parametrize("name", STENCILS)
def test_bounds_of_the_weights(name: str) -> None:
    """Never exceeded, and reached to 1 %."""
    weights = all_weights(STENCILS[name])
    sums, sizes = weights.sum(1), weights.abs().sum(1)
    least, most, norm = bricks.bound(STENCILS[name].lowered)
    assert least <= sums.min() + 1e-12
    assert most >= sums.max() - 1e-12
    assert sizes.max() - 1e-12 <= norm <= 1.01 * sizes.max()
    assert most - least < 1e-12 + 1.1 * float(sums.max() - sums.min())


def test_bounds_that_are_known() -> None:
    for degree in range(1, 6):
        assert bricks.bound(Direct(same_kernel(bspline(degree))).stencils[0].lowered) == pytest.approx((1, 1, 1))
    assert bricks.bound(STENCILS["catmull-rom"].lowered)[2] == pytest.approx(1.25**3)
    assert bricks.bound(Direct(NCRSI_TERMS).stencils[0].lowered)[2] == pytest.approx(1.75)


# --- bricks -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("edge", [0, 2, 3])
def test_ranges_against_a_loop(edge: int) -> None:
    grid = torch.randn(9, 14, 6)
    low, high = bricks._volume(grid, (3, 2, 4), edge).ranges
    size = 1 << edge
    for z, y, x in itertools.product(*map(range, low.shape)):
        own = grid[z * size : (z + 1) * size + 3, y * size : (y + 1) * size + 1, x * size : (x + 1) * size + 2]
        assert low[z, y, x] == own.min()
        assert high[z, y, x] == own.max()
    assert low.shape == tuple(-(-n // size) for n in (6, 13, 4))


def test_ranges_are_kept_until_the_volume_changes_or_goes() -> None:
    grid = torch.randn(9, 9, 9)
    first = bricks._volume(grid, (2, 2, 2), 2).ranges
    assert bricks._volume(grid, (2, 2, 2), 2).ranges is first
    assert bricks._volume(grid, (3, 3, 3), 2).ranges is not first
    grid[4, 4, 4] = 50.0
    assert float(bricks._volume(grid, (2, 2, 2), 2).ranges[1].max()) == 50
    batch = torch.randn(2, 9, 9, 9)
    assert float(bricks._volume(batch[0], (2, 2, 2), 2).ranges[1].max()) == batch[0].max()
    assert float(bricks._volume(batch[1], (2, 2, 2), 2).ranges[1].max()) == batch[1].max()
    known = len(bricks._known)
    del grid, batch
    gc.collect()
    assert len(bricks._known) == known - 2


def test_bricks_are_kept_until_volume_or_opacities_change() -> None:
    grid, stencil = ball(), ops.Stencil.jet((bspline(2),) * 3, 0)

    def peak(low: float, high: float, color: float = 0.2) -> TransferFunction:
        return TransferFunction.triangle_peaks([(low + 0.05, 0.05, high, (color, 0.4, 1.0))])

    found = bricks.bricks_of(grid, stencil, peak(0.5, 0.6))
    assert bricks.bricks_of(grid, stencil, peak(0.5, 0.3, color=0.9)) is found  # where it is clear is all that counts
    elsewhere = bricks.bricks_of(grid, stencil, peak(0.2, 0.6))
    assert found is not None
    assert elsewhere is not None
    assert not torch.equal(elsewhere.distance, found.distance)
    assert torch.equal(bricks.bricks_of(grid, stencil, peak(0.5, 0.6)).distance, found.distance)
    grid.fill_(0.55)
    assert bricks.bricks_of(grid, stencil, peak(0.5, 0.6)) is None


def test_bricks_are_those_of_the_type_that_samples_have() -> None:
    """What rounding may add is less in float64: a control point just above the samples leaves them empty there only."""
    stencil = ops.Stencil.jet((bspline(2),) * 3, 0)
    edge = float(torch.tensor(0.1) * (1 + 8 * torch.finfo(torch.float32).eps))
    exact = TransferFunction(torch.tensor([edge, 0.5]).double(), [[1.0] * 3] * 2, [0.0, 0.5])
    for order in ((torch.float32, torch.float64), (torch.float64, torch.float32)):
        grid = torch.full((9, 9, 9), 0.1)
        found = {dtype: bricks.bricks_of(grid, stencil, exact.to(dtype)) for dtype in order}
        assert found[torch.float32] is None
        assert found[torch.float64] is not None


def test_ranges_of_integers_halves_and_nan() -> None:
    grid = torch.randn(8, 8, 8) * 50
    for stored in (torch.uint8, torch.int16, torch.float16, torch.bfloat16):
        low, high = bricks._volume(grid.abs().to(stored), (2, 2, 2), 2).ranges
        assert float(low.min()) == float(grid.abs().to(stored).double().min())
        assert float(high.max()) == float(grid.abs().to(stored).double().max())
    grid[3, 3, 3] = torch.nan
    low, high = bricks._volume(grid, (2, 2, 2), 2).ranges
    own = grid[:5, :5, :5]
    assert (low[0, 0, 0], high[0, 0, 0]) == (own[own == own].min(), own[own == own].max())
    grid[:5, :5, :5] = torch.nan
    low, high = bricks._volume(grid, (2, 2, 2), 2).ranges
    assert low.isnan().nonzero().tolist() == high.isnan().nonzero().tolist() == [[0, 0, 0]]


def test_transparent_means_flat_at_zero() -> None:
    transfer = TransferFunction([0.0, 1.0, 2.0, 3.0], [[1.0] * 3] * 4, [0.5, 0.0, 0.0, 0.5])
    cases = {
        (1.1, 1.9): True,
        (1.0, 1.9): False,  # to the left of 1 the opacity rises
        (1.1, 2.0): False,
        (0.9, 1.1): False,
        (-2.0, -1.0): False,
        (4.0, 5.0): False,
        (1.1, float("nan")): False,
        (float("-inf"), 1.1): False,
    }
    low, high = (torch.tensor(ends, dtype=torch.float64) for ends in zip(*cases, strict=True))
    assert bricks.transparent(low, high, transfer).tolist() == list(cases.values())
    low, high = torch.tensor([-2.0, 0.1, 0.9, -2.0]).double(), torch.tensor([-1.0, 0.3, 5.0, 0.39]).double()
    assert bricks.transparent(low, high, PEAK).tolist() == [True, True, True, True]
    assert bricks.transparent(low, high + 0.2, PEAK).tolist() == [True, False, True, False]
    constant = TransferFunction([0.5], [[1.0] * 3], [0.0])
    assert bricks.transparent(low, high, constant).all()


def test_distances_against_a_loop() -> None:
    empty = torch.rand(7, 9, 25) < 0.995
    empty[0, 0, 0] = False
    solid = (~empty).nonzero()
    expected = (torch.cartesian_prod(*map(torch.arange, empty.shape))[:, None] - solid).abs().amax(-1).amin(-1)
    assert bricks.distances(empty).flatten().tolist() == expected.clamp_max(15).tolist()
    assert bricks.distances(torch.ones(2, 2, 2, dtype=torch.bool)).unique().tolist() == [15]


@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_nothing_is_seen_in_an_empty_brick(method: str) -> None:
    """Values at random points of empty bricks lie where the transfer function is 0."""
    field = reconstruct(ball(), method, scheme="fused")
    assert isinstance(field, GridField)
    values, start = field.coefficients.values, field.coefficients.start
    stencil = field.scheme.stencils[0]  # type: ignore[attr-defined]
    found = bricks.bricks_of(values, stencil, PEAK)
    assert found is not None
    empty = (found.distance > 0).nonzero().flip(-1)
    assert len(empty) > 0.2 * found.distance.numel()
    low = empty * (1 << found.edge)
    size = torch.tensor(values.shape[::-1]) - torch.tensor(stencil.supports) + 1
    width = torch.minimum(low + (1 << found.edge), size) - low
    points = low + torch.rand(len(low), 3, dtype=torch.float64) * width
    points = points + start + torch.tensor([n / 2 - 1 for n in stencil.supports])
    value = ops.gather(values[None, None], points[None], stencil, start)[0, 0, 0]
    assert not PEAK(value)[1].any()


def test_rounding_is_within_the_bounds() -> None:
    """A constant volume: its values are not quite constant."""
    for dtype, width in ((torch.float32, 1e-4), (torch.float64, 1e-12)):
        varying = 0
        for stencil in STENCILS.values():
            constant = torch.full((1, 1, 8, 8, 8), 0.1, dtype=dtype)
            value = ops.gather(constant, torch.rand(1, 4000, 3, dtype=dtype) * 2 + 3, stencil).double()
            one = constant.double().amax().reshape(1)
            low, high = bricks.values(one, one, stencil.lowered, dtype)
            varying += bool(value.min() < value.max())
            assert low < value.min()
            assert value.max() < high
            assert high - low < width
        assert varying > len(STENCILS) / 2


# --- in the march -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "dtype"),
    [("trilinear", torch.float64), ("catmull-rom", torch.float32), ("ncrsi", torch.float64), ("notch", torch.float32)],
)
def test_skipping_changes_no_bit(method: str, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    volume = ball().to(dtype)
    camera = PerspectiveCamera.framing(reconstruct(volume).domain, (0.4, 0.8, -0.45))
    used: list[bool] = []
    run = march.run
    monkeypatch.setattr(march, "run", lambda self, *rest: used.append(self.bricks is not None) or run(self, *rest))
    for shading, step, jitter_seed in ((None, 0.5, None), (LIT, 0.13, 4), (None, 2.5, 1)):
        images = []
        for skipping in (False, True):
            monkeypatch.setattr(fused, "SKIPPING", skipping)
            scene = {"size": (33, 31), "step": step, "shading": shading, "jitter_seed": jitter_seed, "dtype": dtype}
            images.append(render(reconstruct(volume, method, scheme="fused"), camera, PEAK, **scene))
        assert torch.equal(*images)
        assert images[0][..., 3].max() > 0.5
    assert used == [False, True] * 3


@pytest.mark.parametrize("method", ["catmull-rom", "ncrsi"])
def test_overshoot_is_not_empty(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """All samples are 0 or 1, and only values that are neither are seen."""
    volume = (ball() > 0.5).double()
    edges = TransferFunction([-0.2, -0.01, 1.01, 1.2], [[1.0] * 3] * 4, [0.9, 0.0, 0.0, 0.9])
    camera = PerspectiveCamera.framing(reconstruct(volume).domain, (0.4, 0.8, -0.45))
    images = []
    for skipping in (False, True):
        monkeypatch.setattr(fused, "SKIPPING", skipping)
        field = reconstruct(volume, method, scheme="fused")
        images.append(render(field, camera, edges, size=(33, 31), dtype=torch.float64))
    assert torch.equal(*images)
    assert (images[0][..., 3] > 0.05).sum() > 50
    coefficients = field.coefficients.values  # type: ignore[attr-defined]
    assert bricks.bricks_of(coefficients, STENCILS[method], edges) is not None


def test_leaps_end_where_something_may_be() -> None:
    """A leap that is a few segments too long would pass over the only voxel that is seen, for some start."""
    shown = TransferFunction([0.01, 0.02], [[1.0] * 3] * 2, [0.0, 0.9])
    origins = torch.tensor([4.0, 4.0, 0.0]).double() + torch.arange(0, 8, 0.25)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    directions = torch.tensor([0.0, 0.0, 1.0]).double().expand_as(origins)
    for place in range(30, 190, 3):
        volume = torch.zeros(200, 8, 8)
        volume[place, 4, 4] = 1.0
        field = reconstruct(volume, "trilinear", scheme="fused")
        image = render(field, (origins, directions), shown, step=0.9)
        assert (image[:, 3] > 0.5).all()


def test_every_entry_of_a_batch_has_its_own_empty_space() -> None:
    volumes = torch.stack((ball(), ball().roll(11, 2))).float()[:, None]
    field = reconstruct(volumes, "trilinear", scheme="fused")
    camera = PerspectiveCamera.framing(field.domain, (0.4, 0.8, -0.45))
    images = render(field, camera, PEAK, size=(33, 31))
    for image, volume in zip(images[:, 0], volumes[:, 0], strict=True):
        alone = render(reconstruct(volume, "trilinear", scheme="fused"), camera, PEAK, size=(33, 31))
        assert torch.equal(image, alone)


def test_rays_along_axes_and_edges_of_bricks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a point's brick is a matter of the last digit."""
    grid = torch.tensor([float(k) for k in range(0, 24, 2)], dtype=torch.float64) - 0.5
    a, b = torch.meshgrid(grid, grid, indexing="ij")
    origins = torch.stack((a, b, torch.full_like(a, -3.0)), -1).reshape(-1, 3)
    rays = torch.cat([origins.roll(k, -1) for k in range(3)])
    directions = torch.cat([torch.tensor([0.0, 0.0, 1.0]).double().roll(k).expand_as(origins) for k in range(3)])
    for dtype in (torch.float32, torch.float64):
        images = []
        for skipping in (False, True):
            monkeypatch.setattr(fused, "SKIPPING", skipping)
            field = reconstruct(ball((24, 24, 24)).to(dtype), "trilinear", scheme="fused")
            images.append(render(field, (rays, directions), PEAK, step=0.5, dtype=dtype))
        assert torch.equal(*images)
        assert images[0][..., 3].max() > 0.3


def test_derivatives_with_skipping_are_those_without(monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for skipping in (False, True):
        monkeypatch.setattr(fused, "SKIPPING", skipping)
        volume = ball().requires_grad_()
        opacities = PEAK.opacities.clone().requires_grad_()
        transfer = TransferFunction(PEAK.positions, PEAK.colors, opacities, PEAK.unit)
        field = reconstruct(volume, "triquadratic", scheme="fused")
        camera = PerspectiveCamera.framing(field.domain, (0.4, 0.8, -0.45))
        for function, inputs in ((PEAK, [volume]), (transfer, [volume, opacities])):
            image = render(field, camera, function, size=(20, 20), shading=LIT, dtype=torch.float64)
            results.append(torch.autograd.grad(image.square().sum(), inputs))
            assert results[-1][0].abs().max() > 1e-4
    for a, b in zip(results[:2], results[2:], strict=True):
        assert all(torch.equal(p, q) for p, q in zip(a, b, strict=True))
