"""Cameras: pixel centres by hand, windows as crops, framing, mistakes."""

import math

import pytest
import torch

from filterlab.fields.base import Domain
from filterlab.geometry import Geometry
from filterlab.render import OrthographicCamera, PerspectiveCamera

PERSPECTIVE = PerspectiveCamera(position=(1.0, -4.0, 2.0), target=(0.2, 0.1, -0.3), field_of_view=40.0)
ORTHOGRAPHIC = OrthographicCamera(position=(1.0, -4.0, 2.0), target=(0.2, 0.1, -0.3), height=3.0)


def test_pixel_centres_of_a_pinhole_looking_along_y():
    camera = PerspectiveCamera(position=(0, 0, 0), target=(0, 5, 0), up=(0, 0, 2), field_of_view=90.0)
    origins, directions = camera.rays(4, 2)
    assert origins.shape == directions.shape == (2, 4, 3)
    assert origins.dtype == torch.float64
    # half the plane is tan 45° = 1 high and aspect 2 wide: x = -1.5, -0.5, 0.5, 1.5; z = 0.5, -0.5
    expected = torch.tensor([[[x, 1.0, z] for x in (-1.5, -0.5, 0.5, 1.5)] for z in (0.5, -0.5)], dtype=torch.float64)
    torch.testing.assert_close(directions, expected / expected.norm(dim=-1, keepdim=True), rtol=0, atol=1e-15)


def test_pixel_centres_of_parallel_rays():
    camera = OrthographicCamera(position=(0, -3, 1), target=(0, 0, 1), height=2.0)
    origins, directions = camera.rays(2, 4)
    expected = torch.tensor([[[x, -3.0, 1 + z] for x in (-0.25, 0.25)] for z in (0.75, 0.25, -0.25, -0.75)])
    torch.testing.assert_close(origins, expected.double(), rtol=0, atol=1e-15)
    torch.testing.assert_close(directions, torch.tensor([0.0, 1.0, 0.0]).double().expand_as(origins))


@pytest.mark.parametrize("camera", [PERSPECTIVE, ORTHOGRAPHIC])
def test_directions_are_unit_vectors_and_the_centre_looks_at_the_target(camera):
    origins, directions = camera.rays(31, 17)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(17, 31).double(), rtol=0, atol=1e-15)
    to_target = torch.tensor(camera.target, dtype=torch.float64) - origins[8, 15]
    assert torch.linalg.cross(directions[8, 15], to_target).norm() < 1e-14
    assert directions[8, 15] @ to_target > 0


@pytest.mark.parametrize("camera", [PERSPECTIVE, ORTHOGRAPHIC])
@pytest.mark.parametrize("window", [(0.25, 0.5, 0.75, 0.75), (0.0, 0.0, 0.5, 1.0)])
def test_a_window_is_exactly_a_crop_of_the_magnified_view(camera, window):
    width, height = 32, 16
    left, top, right, bottom = (int(a * n) for a, n in zip(window, (width, height, width, height), strict=True))
    whole = camera.rays(width, height)
    zoomed = type(camera)(**{**vars(camera), "window": window}).rays(right - left, bottom - top)
    for a, b in zip(whole, zoomed, strict=True):
        assert torch.equal(a[top:bottom, left:right], b)


@pytest.mark.parametrize("kind", [PerspectiveCamera, OrthographicCamera])
@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("direction", [(0.0, 1.0, 0.0), (0.3, -0.4, -0.8)])
def test_framing_has_every_corner_in_view_and_one_on_the_margin(kind, aspect, direction):
    turned = Geometry(((0.0, -2.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.5)), (10.0, 20.0, -30.0))
    domain = Domain.of_grid((8, 9, 20), turned)
    camera = kind.framing(domain, direction, aspect=aspect, margin=1.25)
    position, right, up, forward = camera._frame(torch.device("cpu"))
    torch.testing.assert_close(forward, torch.tensor(direction, dtype=torch.float64) / math.hypot(*direction))
    seen = domain.corners() - position
    depth = seen @ forward
    assert depth.min() > 0
    if kind is PerspectiveCamera:
        half = depth * math.tan(math.radians(camera.field_of_view) / 2)
    else:
        half = torch.tensor(camera.height / 2)
    reach = torch.maximum((seen @ right).abs() / (half * aspect), (seen @ up).abs() / half)
    assert reach.max() == pytest.approx(1 / 1.25)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"target": (1.0, -4.0, 2.0)}, "target"),
        ({"up": (0.0, 0.0, 0.0)}, "up"),
        ({"up": (-0.8, 4.1, -2.3)}, "up"),
        ({"position": (math.nan, 0.0, 0.0)}, "position"),
        ({"position": (0.0, 0.0)}, "position"),
        ({"position": "here"}, "position"),
        ({"field_of_view": 0.0}, "field_of_view"),
        ({"field_of_view": 180.0}, "field_of_view"),
        ({"field_of_view": math.nan}, "field_of_view"),
        ({"window": (0.5, 0.0, 0.5, 1.0)}, "window"),
        ({"window": (0.0, 0.0, 1.0, 1.5)}, "window"),
    ],
)
def test_degenerate_cameras_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        PerspectiveCamera(**{**vars(PERSPECTIVE), **change})


def test_more_mistakes():
    with pytest.raises(ValueError, match="height"):
        OrthographicCamera(position=(0, 0, 0), target=(0, 1, 0), height=0.0)
    with pytest.raises(ValueError, match=r"size must be two positive integers"):
        PERSPECTIVE.rays(0, 5)
    domain = Domain.of_grid((2, 2, 2), Geometry())
    for arguments in ({"direction": (0, 0, 0)}, {"direction": (0, 0, 1)}, {"aspect": 0.0}, {"margin": 0.5}):
        with pytest.raises(ValueError, match=r"direction|up|aspect|margin"):
            PerspectiveCamera.framing(domain, **arguments)


LENGTHS = [5e-324, 1e-300, 1e-170, 1e-46, 1e39, 1e160, 1e300, 1.7e308]


@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize("kind", [PerspectiveCamera, OrthographicCamera])
def test_no_length_of_a_direction_or_an_up_changes_a_view(kind, length):
    domain = Domain.of_grid((2, 3, 4), Geometry())
    for direction, up in (((1.0, 1.0, 0.0), (0.0, 0.0, length)), ((length, length, 0.0), (0.0, 0.0, 1.0))):
        expected = kind.framing(domain, (1.0, 1.0, 0.0), up=(0.0, 0.0, 1.0)).rays(3, 2)
        for a, b in zip(kind.framing(domain, direction, up=up).rays(3, 2), expected, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("length", LENGTHS)
def test_a_pose_may_be_as_far_as_its_numbers_reach(length):
    near = PerspectiveCamera(position=(0.0, -1.0, 0.0), target=(0.0, 0.0, 0.0)).rays(3, 2)[1]
    far = PerspectiveCamera(position=(0.0, -length, 0.0), target=(0.0, 0.0, 0.0)).rays(3, 2)[1]
    torch.testing.assert_close(far, near, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("scale", [1e-200, 1e200])
@pytest.mark.parametrize("kind", [PerspectiveCamera, OrthographicCamera])
def test_a_domain_of_any_size_is_framed(kind, scale):
    one, other = (kind.framing(Domain.of_grid((2, 3, 4), Geometry.of(s))).rays(3, 2) for s in (1.0, scale))
    torch.testing.assert_close(other[1], one[1], rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(other[0] / scale, one[0], rtol=1e-13, atol=1e-13)


def test_an_up_of_any_length_has_finite_derivatives():
    for length in (1e-300, 1e300):
        up = torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64).mul(length).requires_grad_()
        camera = PerspectiveCamera(position=(0.0, -4.0, 0.0), target=(0.0, 0.0, 0.0), up=up)
        (found,) = torch.autograd.grad(camera.rays(3, 2)[1][0, 0, 0], up)
        assert found.isfinite().all()
        assert found.any()


def test_a_view_longer_than_float64_is_refused():
    with pytest.raises(ValueError, match="target − position must be finite in float64"):
        PerspectiveCamera(position=(0.0, -1.7e308, 0.0), target=(0.0, 1.7e308, 0.0))
