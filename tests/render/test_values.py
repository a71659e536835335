"""Pictures of values: the largest along a ray, and those on a plane, beside what is found point by point."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from filterlab import METHODS, Volume, reconstruct, signals
from filterlab.fields.base import Field
from filterlab.render import ColorScale, OrthographicCamera, PerspectiveCamera, Plane, colored, plane_values
from filterlab.render import maximum_projection as project
from filterlab.render.rays import jitter

AFFINE = torch.tensor([[0.8, 0.3, 0, 5], [-0.4, 0.9, 0.2, -3], [0, 0.1, 1.5, 7], [0, 0, 0, 1]], dtype=torch.float64)


def volume(size: tuple[int, int, int] = (7, 6, 5), seed: int = 0, **more: object) -> Volume:
    samples = torch.rand(*size, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return Volume(samples, **more)  # type: ignore[arg-type]


def camera_of(field: Field, direction: tuple[float, float, float] = (0.3, 0.9, -0.4)) -> PerspectiveCamera:
    return PerspectiveCamera.framing(field.domain, direction)


def by_hand(field: Field, camera: PerspectiveCamera, size: tuple[int, int], step: float, seed: int | None = None):
    """The largest of the midpoints, ray by ray: a ray is followed in steps so small that its ends are found."""
    origins, directions = (r.reshape(-1, 3) for r in camera.rays(*size))
    length = step * field.domain.voxel_size
    lower, upper = (torch.tensor(c, dtype=torch.float64) for c in (field.domain.lower, field.domain.upper))
    found = []
    for pixel, (o, d) in enumerate(zip(origins, directions, strict=True)):
        a, b = (
            field.domain.geometry.to_voxel(o),
            field.domain.geometry.to_voxel(o + d) - field.domain.geometry.to_voxel(o),
        )
        times = torch.stack(((lower - a) / b, (upper - a) / b))
        near, far = max(0.0, float(times.amin(0).max())), float(times.amax(0).min())
        if far <= near:
            found.append(math.nan)
            continue
        first = length * (1.0 if seed is None else float(jitter(seed, torch.tensor([pixel]))))
        ends = [0.0, first]
        while ends[-1] < far - near:
            ends.append(ends[-1] + length)
        ends[-1] = far - near
        middles = torch.tensor([near + (x + y) / 2 for x, y in pairwise(ends)], dtype=torch.float64)
        found.append(float(field(o + middles[:, None] * d).max()))
    return torch.tensor(found, dtype=torch.float64).reshape(size[1], size[0])


@pytest.mark.parametrize("method", METHODS)
def test_the_largest_of_the_samples_of_every_method(method: str) -> None:
    field = reconstruct(volume(affine=AFFINE), method)
    camera = camera_of(field)
    image = project(field, camera, size=(9, 8), step=0.7, dtype=torch.float64)
    expected = by_hand(field, camera, (9, 8), 0.7)
    assert 10 < int(expected.isnan().sum()) < 60
    assert torch.equal(image.isnan(), expected.isnan())
    torch.testing.assert_close(image, expected, rtol=0, atol=0 if method == "nearest" else 1e-12, equal_nan=True)


@pytest.mark.parametrize("storage", [None, "float16", "uint8"])
def test_programs_and_plain_torch_make_the_same_projection(
    storage: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    field = reconstruct(volume(affine=AFFINE), "tricubic", storage=storage, scheme="fused")
    seen = {"camera": camera_of(field), "size": (19, 18), "step": 0.3, "jitter_seed": 3, "dtype": torch.float64}
    region = tuple((field.domain.corners()[0] * a + field.domain.corners()[-1] * (1 - a)).tolist() for a in (0.8, 0.2))
    seen["region"] = tuple(zip(*(sorted(pair) for pair in zip(*region, strict=True)), strict=True))
    image = project(field, **seen)
    assert 50 < int(image.isnan().sum()) < 300
    monkeypatch.setattr("filterlab.render.values.projection_of", lambda *given: None)
    torch.testing.assert_close(image, project(field, **seen), rtol=0, atol=1e-14, equal_nan=True)


def test_jitter_moves_the_samples() -> None:
    field = reconstruct(volume(), "triquadratic")
    camera = camera_of(field)
    image = project(field, camera, size=(6, 5), step=1.1, jitter_seed=7, dtype=torch.float64)
    torch.testing.assert_close(image, by_hand(field, camera, (6, 5), 1.1, seed=7), rtol=0, atol=1e-12, equal_nan=True)
    assert not torch.equal(image, project(field, camera, size=(6, 5), step=1.1, dtype=torch.float64))


def test_a_region_is_the_part_that_is_looked_at() -> None:
    samples = torch.zeros(9, 9, 9, dtype=torch.float64)
    samples[4, 4, 2], samples[4, 4, 6] = 2, 1
    field = reconstruct(samples, "trilinear")
    camera = OrthographicCamera(position=(-5.0, 4, 4), target=(4.0, 4, 4), height=2)
    values = [
        project(field, camera, size=(1, 1), region=r, dtype=torch.float64).item()
        for r in (None, ((4, 0, 0), (8, 8, 8)))
    ]
    assert values == [pytest.approx(1.5, abs=0.3), pytest.approx(0.8, abs=0.21)]
    assert project(field, camera, size=(1, 1), region=((0, 7, 7), (1, 8, 8))).isnan().all()


def test_what_is_cut_up_does_not_change_a_bit_and_batches_are_their_images() -> None:
    batch = Volume(torch.rand(2, 2, 5, 6, 7, generator=torch.Generator().manual_seed(3)))
    field = reconstruct(batch, "triquadratic")
    camera = camera_of(field)
    told: list[tuple[int, int]] = []
    whole = project(field, camera, size=(40, 31), step=0.1, progress=lambda done, total: told.append((done, total)))
    assert torch.equal(whole.nan_to_num(-1), project(field, camera, size=(40, 31), step=0.1, memory=1).nan_to_num(-1))
    assert whole.shape == (2, 2, 31, 40)
    assert told[-1][0] == told[-1][1] > 1000
    alone = reconstruct(batch.samples[1, 0], "triquadratic")
    assert torch.equal(whole[1, 0].nan_to_num(-1), project(alone, camera, size=(40, 31), step=0.1).nan_to_num(-1))


def test_derivatives_are_those_of_the_largest_sample() -> None:
    samples = volume((3, 4, 3)).samples.requires_grad_()
    camera = camera_of(reconstruct(samples.detach(), "tricubic"))

    def image(samples: torch.Tensor, position: torch.Tensor) -> torch.Tensor:
        seen = PerspectiveCamera(position=position, target=camera.target)
        values = project(reconstruct(samples, "tricubic"), seen, size=(3, 3), step=0.9, dtype=torch.float64)
        return values[~values.isnan()]

    position = torch.tensor(camera.position, dtype=torch.float64, requires_grad=True)
    assert len(image(samples, position)) > 4
    assert torch.autograd.gradcheck(image, (samples, position))


@pytest.mark.parametrize("kind", ["projection", "plane"])
def test_voxels_without_a_value_are_passed_over(kind: str) -> None:
    samples = volume((6, 6, 6)).samples
    samples[2:4, 2:4, 2:4] = math.nan
    field = reconstruct(samples, "trilinear", nan="propagate")
    if kind == "projection":
        camera = OrthographicCamera.framing(field.domain)
        image = project(field, camera, size=(12, 12), dtype=torch.float64)
        assert int(image.isnan().sum()) < 40  # beside the volume
        assert image[4:8, 4:8].isfinite().all()
        beside = project(reconstruct(torch.full((3, 3, 3), 5.0), "trilinear"), camera, size=(12, 12))
        assert beside.isnan().any()
    else:
        plane = Plane.across("z", field.domain)
        image = plane_values(field, plane, plane.camera(field.domain), size=(12, 12))
        assert image[5:7, 5:7].isnan().all()
        assert image[1, 1].isfinite()


def test_float32_keeps_its_digits_far_from_the_origin() -> None:
    near, far = (volume(origin=(shift, 0.0, 0.0), spacing=(0.5, 0.5, 0.5)) for shift in (0.0, 4e6))
    images = []
    for v in (near, far):
        field = reconstruct(v, "triquadratic")
        camera = camera_of(field)
        plane = Plane.across("x", field.domain)
        images.append(
            (project(field, camera, size=(8, 8)), plane_values(field, plane, plane.camera(field.domain), size=(8, 8)))
        )
    for a, b in zip(*images, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=2e-5, equal_nan=True)


# --- planes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("axis", "right", "up"), [("x", 1, 2), ("y", 0, 2), ("z", 0, 1)])
def test_across_an_axis_the_others_go_right_and_up(axis: str, right: int, up: int) -> None:
    """The coordinates themselves are the values of the field."""
    domain = reconstruct(volume((5, 5, 5), spacing=(1, 1, 1), origin=(10, 20, 30)), "trilinear").domain
    for along, growing in ((right, (0, 1)), (up, (-1, 0))):
        values = torch.arange(5.0)
        shape = [1, 1, 1]
        shape[2 - along] = 5
        field = reconstruct(
            Volume(values.reshape(shape).expand(5, 5, 5).contiguous(), origin=(10, 20, 30)), "trilinear"
        )
        plane = Plane.across(axis, domain)
        image = plane_values(field, plane, plane.camera(field.domain, margin=1.0), size=(5, 5), dtype=torch.float64)
        expected = values.double() if growing[1] else values.double().flip(0)[:, None]
        torch.testing.assert_close(image, expected.expand(5, 5), rtol=0, atol=1e-9)


def test_an_oblique_plane_shows_the_field_where_rays_meet_it() -> None:
    field = reconstruct(volume(affine=AFFINE), "notch")
    center = torch.tensor(field.domain.center, dtype=torch.float64)
    plane = Plane(center + 0.3, (1.0, -2.0, 0.5))
    camera = camera_of(field)
    image = plane_values(field, plane, camera, size=(11, 9), dtype=torch.float64)
    origins, directions = camera.rays(11, 9)
    normal = torch.tensor(plane.normal, dtype=torch.float64)
    t = ((center + 0.3 - origins) @ normal) / (directions @ normal)
    points = origins + t[..., None] * directions
    voxel = torch.linalg.solve(AFFINE[:3, :3], (points - AFFINE[:3, 3])[..., None])[..., 0]
    inside = ((voxel >= -0.5) & (voxel <= torch.tensor([4.5, 5.5, 6.5]))).all(-1)
    assert 10 < int(inside.sum()) < 90
    assert torch.equal(~image.isnan(), inside)
    torch.testing.assert_close(image[inside], field(points[inside]), rtol=0, atol=1e-10)


def test_planes_on_a_face_are_whole_and_rays_beside_or_behind_see_nothing() -> None:
    field = reconstruct(volume((5, 5, 5), spacing=(0.1, 0.1, 0.1)), "triquadratic")
    for position in (-0.05, 0.45):
        plane = Plane.across("z", field.domain, position)
        image = plane_values(field, plane, plane.camera(field.domain, margin=1.0), size=(5, 5))
        assert image.isfinite().all()
    plane = Plane.across("z", field.domain)
    origins = torch.tensor([[0.2, 0.2, 5.0]] * 3, dtype=torch.float64)
    directions = torch.tensor([[0, 0, -1.0], [0, 0, 1], [0, 1, 0]], dtype=torch.float64)
    assert plane_values(field, plane, (origins, directions)).isnan().tolist() == [False, True, True]
    region = ((0.3, 0.0, 0.0), (0.4, 0.4, 0.4))
    assert plane_values(field, plane, (origins, directions), region=region).isnan().all()


def test_planes_are_differentiable_in_where_they_lie() -> None:
    samples = volume((4, 4, 4)).samples.requires_grad_()
    rays = (
        torch.tensor([[1.2, 1.7, 9.0], [2.1, 0.6, 9.0]], dtype=torch.float64),
        torch.tensor([[0.1, 0.0, -1.0]] * 2, dtype=torch.float64),
    )

    def values(samples: torch.Tensor, point: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
        return plane_values(reconstruct(samples, "tricubic"), Plane(point, normal), rays, dtype=torch.float64)

    point = torch.tensor([1.5, 1.5, 1.4], dtype=torch.float64, requires_grad=True)
    normal = torch.tensor([0.1, 0.3, 1.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(values, (samples, point, normal))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda f: Plane((0, 0, 0), (0, 0, 0)), "normal of a plane must be three finite numbers, not all zero"),
        (lambda f: Plane((0, math.nan, 0), (0, 0, 1)), "point of a plane must be three finite numbers; got"),
        (lambda f: Plane.across("w", f.domain), "axis must be x, y or z; got 'w'"),
        (lambda f: plane_values(f, (0, 0, 1), camera_of(f), size=(2, 2)), "plane must be a Plane; got tuple"),
        (lambda f: plane_values(f, Plane.across("x", f.domain), camera_of(f)), "size="),
        (lambda f: project(f, camera_of(f), size=(2, 2), step=-1), "step must be a positive number"),
        (lambda f: project(f, camera_of(f), size=(2, 2), max_samples=3), "limit is max_samples=3"),
        (lambda f: project(f, camera_of(f), size=(2, 2), dtype=torch.float16), "dtype must be"),
        (lambda f: project(3, camera_of(f), size=(2, 2)), "field must be a Field"),
    ],
)
def test_mistakes(call, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        call(reconstruct(volume(), "trilinear"))


def test_colours_lie_over_the_background_and_derivatives_are_finite() -> None:
    values = torch.tensor([[0.0, 5.0, math.nan], [10.0, math.inf, -3.0]], dtype=torch.float64, requires_grad=True)
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64, requires_grad=True)
    image = colored(values, ColorScale(0.0, 10.0), background)
    assert image[..., 3].tolist() == [[1, 1, 0], [1, 1, 1]]
    assert image[0, 2, :3].tolist() == [0.1, 0.2, 0.3]
    assert image[:, :, 0].tolist()[1] == [1.0, 1.0, 0.0]
    (gradient,) = torch.autograd.grad(image.sum(), values, retain_graph=True)
    assert gradient.isfinite().all()
    assert gradient[0, 1] > 0
    assert torch.autograd.grad(image.sum(), background)[0].tolist() == [1, 1, 1]


def test_a_signal_is_a_field_too() -> None:
    signal = signals.sphere()
    image = project(signal, camera_of(signal), size=(5, 5), step=0.3)
    assert float(image.nan_to_num(0).max()) == pytest.approx(1, abs=0.05)
