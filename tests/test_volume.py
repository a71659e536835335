"""Volumes, geometry and boundaries against numpy and the oracle."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest
import torch

from filterlab.fields.base import Domain
from filterlab.geometry import Geometry
from filterlab.volume import Boundary, Volume, as_volume, from_grid_sample, from_zyx
from tests import laws, oracles

every_boundary = pytest.mark.parametrize("boundary", Boundary)


def rotated(spacing=(0.5, 1.0, 2.0), origin=(10.0, -3.0, 0.25)) -> np.ndarray:
    """A rotated, flipped and stretched affine."""
    a, b = 0.7, -0.4
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    affine = np.eye(4)
    affine[:3, :3] = about_z @ about_x @ np.diag(spacing) @ np.diag([1, -1, 1])
    affine[:3, 3] = origin
    return affine


@every_boundary
@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_extension_equals_the_oracle(boundary, n):
    index = np.arange(-25, n + 25)
    expected = oracles.source(boundary, n, index)
    source = boundary.source(torch.as_tensor(index), n).numpy()
    assert np.array_equal(source[expected >= 0], expected[expected >= 0])
    f = torch.arange(1.0, n + 1)
    extended = boundary.extend(f, 0, 25, 25)
    laws.assert_close(extended, oracles.extension_matrix(boundary, n, index) @ f.numpy(), 0.0)


@every_boundary
def test_extending_along_any_axis_is_linear_with_an_exact_adjoint(boundary):
    x = torch.arange(24.0, dtype=torch.float64).reshape(2, 3, 4).cos()
    for dim in (-1, 0, 1, 2):
        laws.assert_adjoint(lambda v, dim=dim: boundary.extend(v, dim, 3, 5), x)
        moved = boundary.extend(x.movedim(dim, 0), 0, 3, 5).movedim(0, dim)
        assert torch.equal(boundary.extend(x, dim, 3, 5), moved)


@pytest.mark.parametrize("boundary", ["mirror", "reflect", "wrap"])
@pytest.mark.parametrize("n", [1, 2, 5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_folding_does_not_change_the_extended_function(boundary, n, dtype, rng):
    """With T the linear interpolant of the extended samples: T(x) = T(folded), and T' = sign · T'(folded)."""
    x = torch.as_tensor(rng.uniform(-30, 30, 300)).to(dtype)
    folded, sign = Boundary.named(boundary).fold(x, n, 0)
    f = rng.uniform(-1, 1, n)

    def interpolant(x, derivative):
        return oracles.axis_weights(oracles.PIECES["linear"], (), boundary, n, x.double().numpy(), derivative) @ f

    rounding = 1e-12 if dtype == torch.float64 else 2e-5
    laws.assert_close(interpolant(folded, 0), interpolant(x, 0), rounding)
    if n > 1:
        laws.assert_close(sign.double().numpy() * interpolant(folded, 1), interpolant(x, 1), 1e-12)
    low, high = {"mirror": (0, n - 1), "reflect": (-0.5, n - 0.5), "wrap": (0, n)}[boundary]
    assert float(folded.min()) >= low
    assert float(folded.max()) <= high
    inside = x.clamp(low, high)
    assert torch.equal(Boundary.named(boundary).fold(inside, n, 0)[0], inside)


@pytest.mark.parametrize("boundary", ["border", "zeros"])
def test_border_and_zeros_clamp_to_the_stored_tail(boundary):
    x = torch.tensor([-9.0, -4.0, -3.9, 2.0, 8.0, 8.1, float("inf")])
    folded, sign = Boundary.named(boundary).fold(x, 5, 4)
    laws.assert_close(folded, np.array([-4, -4, -3.9, 2, 8, 8, 8]), 1e-6)
    assert sign.tolist() == [0, 1, 1, 1, 1, 0, 0]


@pytest.mark.parametrize("boundary", ["mirror", "reflect", "wrap"])
def test_far_away_folds_exactly_and_nan_stays_nan(boundary):
    n, period = 5, {"mirror": 8, "reflect": 10, "wrap": 5}[boundary]
    x = torch.tensor([1.25, 3.5, 0.0], dtype=torch.float64)
    folded, _ = Boundary.named(boundary).fold(x + period * 10**9, n, 0)
    laws.assert_close(folded, x, 0.0)
    assert torch.isnan(Boundary.named(boundary).fold(torch.tensor([torch.nan, torch.inf]), n, 0)[0]).all()


def test_boundary_names():
    assert [str(b) for b in Boundary] == list(oracles.BOUNDARIES)
    assert Boundary.named("wrap") is Boundary.WRAP
    with pytest.raises(ValueError, match="mirror, reflect, wrap, border, zeros"):
        Boundary.named("clamp")


def test_a_bare_volume_has_voxel_indices_for_world_coordinates():
    volume = as_volume(torch.zeros(2, 3, 4))
    assert volume.size == (4, 3, 2)
    assert volume.spacing == (1, 1, 1)
    assert volume.geometry.is_identity
    points = torch.rand(5, 3)
    assert volume.voxel_to_world(points) is points
    assert as_volume(volume) is volume


def test_spacing_and_origin_are_in_x_y_z_order():
    volume = Volume(torch.zeros(2, 3, 4), spacing=(1, 2, 4), origin=(10, 20, 30))
    laws.assert_close(volume.voxel_to_world(torch.tensor([[3.0, 2.0, 1.0]])), np.array([[13, 24, 34]]), 0.0)
    laws.assert_close(volume.world_to_voxel(torch.tensor([[13.0, 24.0, 34.0]])), np.array([[3, 2, 1]]), 0.0)
    laws.assert_close(volume.affine, np.array([[1, 0, 0, 10], [0, 2, 0, 20], [0, 0, 4, 30], [0, 0, 0, 1]]), 0.0)


def test_a_rotated_affine_maps_there_and_back_and_turns_gradients(rng):
    affine = rotated()
    volume = Volume(torch.zeros(2, 3, 4), affine=affine)
    assert volume.spacing == pytest.approx((0.5, 1, 2))
    voxels = torch.as_tensor(rng.uniform(-5, 5, (20, 3)))
    world = volume.voxel_to_world(voxels)
    laws.assert_close(world, voxels.numpy() @ affine[:3, :3].T + affine[:3, 3], 1e-13, 10)
    laws.assert_close(volume.world_to_voxel(world), voxels, 1e-13, 10)
    laws.assert_close(volume.geometry.direction_to_voxel(world - world[:1]), voxels - voxels[:1], 1e-13, 10)

    def f(p):  # a function of voxel coordinates
        return p[..., 0] ** 2 + 2 * p[..., 1] * p[..., 2] - p[..., 2] + 3 * p[..., 0] * p[..., 1]

    g = torch.stack(
        [2 * voxels[:, 0] + 3 * voxels[:, 1], 2 * voxels[:, 2] + 3 * voxels[:, 0], 2 * voxels[:, 1] - 1], -1
    )
    h = torch.tensor([[2.0, 3, 0], [3, 0, 2], [0, 2, 0]], dtype=torch.float64).expand(20, 3, 3)
    along = laws.finite_difference(lambda p: f(volume.world_to_voxel(p)), world)
    laws.assert_close(volume.geometry.gradient_to_world(g), along, 1e-8)
    twice = laws.finite_difference(
        lambda p: laws.finite_difference(lambda q: f(volume.world_to_voxel(q)), p, 0.1), world, 0.1
    )
    laws.assert_close(volume.geometry.hessian_to_world(h), twice, 1e-8)


def test_samples_are_kept_and_gradients_flow_back():
    samples = torch.rand(2, 3, 4, requires_grad=True)
    assert Volume(samples).samples is samples
    moved = Volume(samples, spacing=2.0).to(torch.float64)
    assert moved.dtype == torch.float64
    assert moved.spacing == (2, 2, 2)
    moved.samples.sum().backward()
    assert samples.grad is not None


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"samples": torch.zeros(3, 4)}, ValueError, "shape"),
        ({"samples": torch.zeros(0, 3, 4)}, ValueError, "voxel"),
        ({"samples": torch.zeros(2, 2, 2, dtype=torch.bool)}, TypeError, "real"),
        ({"samples": torch.zeros(2, 2, 2, dtype=torch.complex64)}, TypeError, "real"),
        ({"samples": [[[1.0]]]}, TypeError, "Tensor or a NumPy array"),
        ({"spacing": (1, 0, 1)}, ValueError, "positive"),
        ({"spacing": (1, -1, 1)}, ValueError, "positive"),
        ({"spacing": (1, float("nan"), 1)}, ValueError, "finite"),
        ({"spacing": (1, 1)}, ValueError, "three"),
        ({"origin": (0, 0, float("inf"))}, ValueError, "finite"),
        ({"affine": np.eye(3)}, ValueError, "4×4"),
        ({"affine": np.diag([1.0, 0, 1, 1])}, ValueError, "invertible"),
        ({"affine": np.eye(4), "spacing": 1.0}, ValueError, "not both"),
    ],
)
def test_callers_mistakes(arguments, error, match):
    with pytest.raises(error, match=match):
        Volume(**{"samples": torch.zeros(2, 2, 2), **arguments})


@pytest.mark.parametrize("align_corners", [True, False])
def test_grid_sample_points_are_converted(align_corners, rng):
    f = torch.as_tensor(rng.uniform(-1, 1, (4, 5, 6)))
    grid = torch.as_tensor(rng.uniform(-0.6, 0.6, (30, 3)))
    expected = torch.nn.functional.grid_sample(f[None, None], grid[None, None, None], align_corners=align_corners)
    points = from_grid_sample(grid, f.shape, align_corners=align_corners)
    (value,) = oracles.trilinear(f.numpy(), points.numpy(), "border")
    laws.assert_close(value, expected.flatten(), 1e-13)


def test_zyx_points_are_converted():
    assert from_zyx(torch.tensor([[3.0, 2.0, 1.0]])).tolist() == [[1, 2, 3]]


def test_the_domain_of_a_grid_is_its_whole_cells():
    domain = Domain.of_grid((4, 3, 2), Geometry.of((1.0, 2.0, 4.0), (10, 20, 30)))
    corners = domain.corners()
    laws.assert_close(corners.min(0).values, np.array([9.5, 19, 28]), 1e-14)
    laws.assert_close(corners.max(0).values, np.array([13.5, 25, 36]), 1e-14)
    assert domain.voxel_size == 1
    assert domain.center == pytest.approx((11.5, 22, 32))
    assert domain.diagonal == pytest.approx((16 + 36 + 64) ** 0.5)


@pytest.mark.parametrize(
    "matrix", [[[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9]], [[1, 0, 0], [0, 0, 0], [0, 0, 1]]]
)
def test_a_singular_affine_is_refused(matrix):
    affine = np.eye(4)
    affine[:3, :3] = matrix
    with pytest.raises(ValueError, match="finite and invertible"):
        Volume(torch.zeros(2, 2, 2), affine=affine)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("scale", [1e-50, 1.0, 1e50])
def test_columns_that_nearly_coincide_span_nothing(side, scale):
    """1e-12 apart they do to no purpose, whatever the sign of the determinant and the unit; 1e-6 apart they do."""
    for apart, regular in ((1e-6, True), (1e-12, False)):
        affine = np.eye(4)
        affine[:3, :3] = scale * np.array([[1, 1, 0], [0, side * apart, 0], [0, 0, 1]])
        if regular:
            assert Volume(torch.zeros(2, 2, 2), affine=affine).affine.tolist() == affine.tolist()
        else:
            with pytest.raises(ValueError, match="finite and invertible"):
                Volume(torch.zeros(2, 2, 2), affine=affine)


def test_a_tiny_spacing_is_no_singular_affine():
    assert Volume(torch.zeros(2, 2, 2), spacing=1e-101).spacing == pytest.approx((1e-101,) * 3)


ACCEPTED = ["uint8", "int8", "int16", "int32", "int64", "float16", "bfloat16", "float32", "float64"]
REFUSED = {
    "real numbers": ["bool", "complex32", "complex64", "complex128"],
    r"convert: samples\.to\(torch\.int32\)": ["uint16", "uint32", "uint64"],
    r"convert: samples\.to\(torch\.float16\)": ["float8_e4m3fn", "float8_e4m3fnuz", "float8_e5m2", "float8_e5m2fnuz"],
}


def types_of_torch() -> set[torch.dtype]:
    """All that a tensor can have, those that are new to these tests included."""
    found = set()
    for dtype in {v for v in vars(torch).values() if isinstance(v, torch.dtype)}:
        with contextlib.suppress(NotImplementedError, RuntimeError):
            torch.ones(1).to(dtype)
            found.add(dtype)
    return found


@pytest.mark.filterwarnings("ignore:ComplexHalf support is experimental")
def test_every_type_is_accepted_or_refused_at_once():
    """What is accepted is used in test_methods; what is not says what to convert it to."""
    refused = {getattr(torch, name): match for match, names in REFUSED.items() for name in names}
    for dtype in types_of_torch() - {getattr(torch, name) for name in ACCEPTED}:
        match = refused.get(dtype, "convert: ")
        with pytest.raises(TypeError, match=match):
            Volume(torch.ones(2, 2, 2).to(dtype))
    for name in ACCEPTED:
        assert Volume(torch.ones(2, 2, 2).to(getattr(torch, name))).dtype == getattr(torch, name)


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_a_grid_may_be_as_small_or_large_as_its_numbers(scale):
    turned = np.eye(4)
    turned[:3, :3] = scale * np.array([[3.0, -4.0, 0.0], [4.0, 3.0, 0.0], [0.0, 0.0, 1.0]])
    geometry = Geometry.of(affine=turned)
    assert geometry.spacing == pytest.approx((5 * scale, 5 * scale, scale))
    domain = Domain.of_grid((2, 2, 2), geometry)
    assert domain.diagonal == pytest.approx(scale * math.sqrt(10**2 + 10**2 + 2**2))
