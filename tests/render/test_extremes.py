"""Rendering at its ends: opacities, steps, units, lengths of directions and of voxels, from the least to the most."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from filterlab.fields.base import Domain, Field
from filterlab.geometry import Geometry
from filterlab.methods import reconstruct
from filterlab.ops.reference.optics import absorbed
from filterlab.render import Light, OrthographicCamera, PerspectiveCamera, Shading, TransferFunction, render
from filterlab.render.rays import jitter
from filterlab.volume import Volume

SCHEMES = ("direct", "fused")
EPS = {torch.float32: 2.0**-23, torch.float64: 2.0**-52}
RGB = (1.0, 0.5, 0.25)
N = 12
some = settings(deadline=None, max_examples=30)
few = settings(deadline=None, max_examples=10)


samples = torch.rand(N, N, N, generator=torch.Generator().manual_seed(3))


def along(length: float, unit: float = 1.0, count: int = 1) -> dict:
    """Arguments of `render`: parallel rays along x of which so much is inside, in voxels of that world length."""
    y = torch.linspace(1.0, N - 2.0, count, dtype=torch.float64)
    origins = unit * torch.stack((torch.full_like(y, -5.0), y, torch.full_like(y, 5.5)), -1)
    directions = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(count, 3)
    box = ((0.0, -unit, -unit), (length * unit, N * unit, N * unit))
    return {"camera": (origins, directions), "region": box}


def medium(opacity: float | Tensor, unit: float = 1.0) -> TransferFunction:
    """The same colour and opacity for every value, by two control points."""
    alpha = torch.as_tensor(opacity, dtype=torch.float64).expand(2)
    return TransferFunction(torch.tensor([0.0, 1.0]).double(), torch.tensor([RGB, RGB]).double(), alpha, unit)


# --- a constant medium ------------------------------------------------------------------------------------------------

opacities = st.sampled_from([0.0, 5e-324, 1e-300, 1e-12, 1 - 2.0**-23, 1 - 2.0**-52, 1.0]) | st.floats(0, 1)
steps = st.sampled_from([0.01, 0.5, 8.0, 1e30, 1.7e308]) | st.floats(0.01, 8)


def closed_form(alpha: float, exponent: float) -> tuple[float, float]:
    """1 − (1 − α)^e and its derivative by α; at α = 1 that is taken as 0."""
    if alpha == 1:
        return 1.0, 0.0
    depth = -math.log1p(-alpha) * exponent
    return -math.expm1(-depth), exponent * math.exp(-depth) / (1 - alpha)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@some
@given(
    opacity=opacities, step=steps, exponent=st.floats(-6, 6), length=st.floats(0.05, 11), seed=st.none() | st.just(5)
)
def test_value_and_derivative_by_opacity(
    scheme: str, dtype: torch.dtype, opacity: float, step: float, exponent: float, length: float, seed: int | None
) -> None:
    unit, alpha = 10.0**exponent, torch.tensor(opacity, dtype=torch.float64, requires_grad=True)
    field = reconstruct(torch.full((N, N, N), 0.5, dtype=dtype), "triquadratic", scheme=scheme)
    image = render(field, transfer=medium(alpha, unit), step=step, dtype=dtype, jitter_seed=seed, **along(length))[0]
    used = float(torch.tensor(opacity, dtype=torch.float64).to(dtype))  # the table is in the type of the samples
    value, slope = closed_form(used, length / unit)
    # a segment's length is what is cut off its step at both ends, and the whole length a difference of coordinates
    tolerance = 16 * EPS[dtype] * (1 + min(step, 2 * field.domain.diagonal) / length)
    tolerance += EPS[torch.float64] * field.domain.diagonal / length
    assert image[3].item() == pytest.approx(value, rel=tolerance * max(1, length / unit), abs=1e-37)
    assert image[:3].tolist() == pytest.approx(
        [c * value for c in RGB], rel=2e-4 if used > 0.9 else 64 * tolerance, abs=1e-37
    )
    by_opacity, by_red = (torch.autograd.grad(image[k], alpha, retain_graph=True)[0].item() for k in (3, 0))
    lost = tolerance * (1 + length / unit * (1 + math.log1p(1 / (1 - used + 1e-16)))) * 64
    assert by_opacity == pytest.approx(slope, rel=lost, abs=1e-30)
    # the light of a ray is the difference of what is before and behind: it keeps what 1/(1 − α) leaves of its digits
    bound = 64 * (1 + length / min(step, length)) * EPS[dtype] * (1 + length / unit) / max(1 - used, EPS[dtype] / 2)
    assert abs(by_red - slope) <= bound + lost * slope


def test_opacity_of_optical_depths_keeps_its_digits_and_its_derivatives() -> None:
    depth = torch.logspace(-300, 2.8, 400, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(absorbed(depth).sum(), depth, create_graph=True)
    (curvature,) = torch.autograd.grad(slope.sum(), depth)
    x = depth.detach()
    torch.testing.assert_close(absorbed(x), -torch.expm1(-x), rtol=4e-16, atol=0)
    torch.testing.assert_close(slope.detach(), torch.exp(-x), rtol=1e-15, atol=0)
    torch.testing.assert_close(curvature, -torch.exp(-x), rtol=1e-15, atol=0)
    assert absorbed(torch.tensor(math.inf)) == 1


@pytest.mark.parametrize("scheme", SCHEMES)
@some
@given(low=opacities, high=opacities, step=steps)
def test_more_opacity_lets_less_through(scheme: str, low: float, high: float, step: float) -> None:
    low, high = sorted((low, high))
    field = reconstruct(samples, "triquadratic", scheme=scheme)
    tables = (TransferFunction([0.0, 1.0], [RGB, RGB], [0.3 * a, a]) for a in (low, high))
    less, more = (render(field, transfer=t, step=step, **along(9.0, count=5))[:, 3] for t in tables)
    assert ((more >= less - 2e-7) & (less >= 0) & (more <= 1)).all()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_hundred_thousand_steps(scheme: str) -> None:
    """Value and derivatives stay finite, and those of the closed form."""
    for opacity in (0.0, 1e-6, 0.5, 1 - 2.0**-52, 1.0):
        alpha = torch.tensor(opacity, dtype=torch.float64, requires_grad=scheme == "fused")
        volume = torch.full((N, N, N), 0.5, dtype=torch.float64, requires_grad=scheme == "fused")
        field = reconstruct(volume, "triquadratic", scheme=scheme)
        step = 1e-4 if scheme == "fused" else 5e-3  # the plain one takes 30 times as long
        image = render(field, transfer=medium(alpha), step=step, dtype=torch.float64, **along(10.0))[0]
        value, slope = closed_form(opacity, 10.0)
        assert image[3].item() == pytest.approx(value, rel=1e-12, abs=0)
        if scheme == "fused":
            (by_opacity,) = torch.autograd.grad(image[3], alpha, retain_graph=True)
            assert by_opacity.item() == pytest.approx(slope, rel=1e-10, abs=1e-30)
            assert torch.autograd.grad(image.sum(), volume)[0].isfinite().all()


# --- steps, directions, voxels ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("seed", [None, 4])
def test_a_step_longer_than_every_ray_is_one_segment(scheme: str, dtype: torch.dtype, seed: int | None) -> None:
    """However much longer: the first segment ends where the ray does, or where jitter ends it."""
    field = reconstruct(samples.to(dtype), "triquadratic", scheme=scheme)
    steps, scene = (1e2, 1e4, 1e8, 1e20, 1e300, 1.7e308), along(10.0)
    images = [render(field, transfer=medium(0.3), step=s, dtype=dtype, jitter_seed=seed, **scene) for s in steps]
    table = TransferFunction([0.0, 1.0], [RGB, (0.1, 0.2, 0.9)], [0.1, 0.6])
    images += [render(field, transfer=table, step=s, dtype=dtype, jitter_seed=seed, **scene) for s in steps]
    offset = 1.0 if seed is None else jitter(seed, torch.tensor([0])).item()
    assert offset * 1e2 > 10  # this ray is one segment at every one of these steps
    middle = torch.tensor([[5.0, 1.0, 5.5]], dtype=torch.float64)
    rgb, alpha = table(field(middle.to(dtype)))
    opacity = -torch.expm1(10 * torch.log1p(-alpha))
    expected = torch.cat((opacity[:, None] * rgb, opacity[:, None]), -1)
    for image in images[len(steps) :]:
        torch.testing.assert_close(image, expected, rtol=0, atol=16 * EPS[dtype])
    for image in images[1 : len(steps)]:
        torch.testing.assert_close(image, images[0], rtol=0, atol=16 * EPS[dtype])


def test_jitter_cuts_long_steps_where_it_would() -> None:
    """A step as long as the box and one that is longer differ, where the first segment ends inside."""
    field = reconstruct(samples, "triquadratic", scheme="direct")
    table = TransferFunction([0.0, 1.0], [RGB, (0.1, 0.2, 0.9)], [0.1, 0.6])
    scene, seed, step = along(10.0, count=40), 7, 60.0
    image = render(field, transfer=table, step=step, jitter_seed=seed, dtype=torch.float64, **scene)
    ends = jitter(seed, torch.arange(40)) * step
    assert 3 < int((ends < 10).sum()) < 37
    origins, _ = scene["camera"]
    for ray, end in enumerate(ends.clamp_max(10).tolist()):
        points = origins[ray].expand(2, 3).clone()
        points[:, 0] = torch.tensor([end / 2, (end + 10) / 2], dtype=torch.float64)
        expected = composited(table, field(points), [end, 10 - end])
        assert image[ray].tolist() == pytest.approx(expected, rel=0, abs=1e-12)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_step_is_what_it_is_as_far_as_the_domain_reaches(scheme: str) -> None:
    """Along its diagonals, both ways: no ray is longer."""
    field = reconstruct(samples.double(), "triquadratic", scheme=scheme)
    table = TransferFunction([0.0, 1.0], [RGB, (0.1, 0.2, 0.9)], [0.1, 0.6], 5.0)
    corners = field.domain.corners()
    directions = (corners.mean(0) - corners) / (field.domain.diagonal / 2)
    whole, seed = field.domain.diagonal, 7
    for step in (1.001 * whole, 1.5 * whole, 1e3 * whole, 1e300):
        for places in (None, jitter(seed, torch.arange(8)) * step):
            scene = {"step": step, "dtype": torch.float64, "jitter_seed": None if places is None else seed}
            image = render(field, (corners - directions, directions), table, **scene)
            for ray, place in enumerate([whole] * 8 if places is None else places.tolist()):
                end = min(place, whole)
                segments = [(0.0, end), (end, whole)]
                points = [corners[ray] + (start + stop) / 2 * directions[ray] for start, stop in segments]
                expected = composited(table, field(torch.stack(points)), [stop - start for start, stop in segments])
                assert image[ray].tolist() == pytest.approx(expected, rel=0, abs=1e-12)


def composited(table: TransferFunction, values: Tensor, lengths: list[float]) -> list[float]:
    """Colour and opacity of segments of these values and lengths, by C += T α c, T *= 1 − α."""
    light, through = torch.zeros(3, dtype=torch.float64), 1.0
    for color, opacity, length in zip(*table(values), lengths, strict=True):
        alpha = -math.expm1(length / table.unit * math.log1p(-opacity.item()))
        light, through = light + through * alpha * color, through * (1 - alpha)
    return [*light.tolist(), 1 - through]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_directions_may_have_any_length(scheme: str) -> None:
    field = reconstruct(samples, "triquadratic", scheme=scheme)
    scene = along(10.0, count=3)
    origins, _ = scene["camera"]
    slanted = torch.tensor([[1.0, 0.25, 0.125]], dtype=torch.float64).expand(3, 3)

    def image(length: float) -> Tensor:
        return render(field, (origins, length * slanted), medium(0.2), dtype=torch.float64)

    assert image(1.0)[:, 3].min() > 0.2
    for exponent in (-1000, -500, -70, 3, 500, 1000):
        assert torch.equal(image(2.0**exponent), image(1.0))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_voxels_may_have_any_size(scheme: str) -> None:
    def image(size: float) -> Tensor:
        field = reconstruct(Volume(samples, spacing=(size, size, size)), "triquadratic", scheme=scheme)
        return render(field, transfer=medium(0.2, size), **along(10.0, size, count=3))

    assert image(1.0)[:, 3].min() > 0.5
    for exponent in (-100, -60, -10, 10, 60, 100):
        assert torch.equal(image(2.0**exponent), image(1.0))


# --- NaN --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
@some
@given(voxel=st.tuples(*[st.integers(0, N - 1)] * 3), step=st.sampled_from([0.1, 0.5, 3.0]))
def test_a_voxel_of_nan_is_transparent_to_rays_near_it_and_changes_no_other(
    scheme: str, voxel: tuple[int, int, int], step: float
) -> None:
    torn = samples.clone()
    torn[voxel] = math.nan
    scene = {"transfer": medium(0.05), "step": step, **along(11.0, count=10)}
    whole, image = (
        render(reconstruct(v, "triquadratic", prefilter=False, scheme=scheme, nan="propagate"), **scene)
        for v in (samples, torn)
    )
    z, y, x = voxel
    distance = (scene["camera"][0][:, 1:] - torch.tensor([y, z], dtype=torch.float64)).abs().amax(-1)
    far = distance > 1.5  # half the support of the quadratic B-spline
    assert torch.equal(image[far], whole[far])
    assert image.isfinite().all()
    # 3 voxels fewer, but for those outside of the volume, and what a step has more or less at both ends
    missing = min(x + 1.5, 11.0) - max(x - 1.5, 0.0)
    left = torch.log1p(-image[distance < 1.5, 3].double()) / math.log1p(-0.05)
    assert ((left - (11 - missing)).abs() <= step + 1e-5).all()


# --- how much is asked ------------------------------------------------------------------------------------------------


class Untouched(Field):
    """A field that must not be evaluated, but for the one point by which render asks whether it is differentiable."""

    domain = Domain((-0.5,) * 3, (N - 0.5,) * 3, Geometry(), 1.0)

    def jet(self, points: Tensor, order: int) -> tuple[Tensor, ...]:
        pytest.fail("nothing must be evaluated")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"step": 1e-10}, r"would take 1e\+11 samples; the limit is max_samples=1.72e\+10"),
        ({"step": 5e-324}, r"would take more than 4.61e\+18 samples"),
        ({"step": 0.1, "max_samples": 99}, "would take 100 samples; the limit is max_samples=99"),
        ({"step": 0.0}, "step must be a positive number of voxels; got 0.0"),
        ({"step": -0.0}, "step must be"),
        ({"step": -5e-324}, "step must be"),
        ({"step": math.nan}, "step must be a positive number of voxels; got nan"),
        ({"step": math.inf}, "step must be"),
        ({"step": None}, "step must be"),
        ({"step": torch.tensor([0.5, 0.5])}, "step must be"),
        ({"step": 10**400}, "step must be"),
        ({"termination": torch.tensor([0.5, 0.5])}, "termination must be"),
        ({"termination": 0.0}, "termination must be"),
        ({"termination": math.nan}, "termination must be"),
        ({"max_samples": math.nan}, "max_samples must be a positive number; got nan"),
        ({"max_samples": "many"}, "max_samples must be a positive number; got 'many'"),
        ({"memory": math.inf}, "memory must be a positive whole number of bytes; got inf"),
        ({"memory": "much"}, "memory must be a positive whole number of bytes; got 'much'"),
    ],
)
def test_what_cannot_be_done_is_refused_before_it_begins(changes: dict, message: str) -> None:
    with torch.no_grad(), pytest.raises(ValueError, match=message):
        render(Untouched(), transfer=medium(0.5), **{**along(10.0), **changes})


@pytest.mark.parametrize("scheme", SCHEMES)
def test_early_termination_is_off_where_derivatives_are_asked(scheme: str) -> None:
    def image(termination: float | None, requires_grad: bool) -> Tensor:
        volume = samples.clone().requires_grad_(requires_grad)
        field = reconstruct(volume, "triquadratic", scheme=scheme)
        return render(field, transfer=medium(0.4), termination=termination, **along(10.0, count=3))

    assert torch.equal(image(0.5, True), image(None, True))
    assert (image(0.5, False) - image(None, False)).abs().max() > 0.01


@pytest.mark.parametrize("scheme", SCHEMES)
@few
@given(
    limit=st.sampled_from([0.9, 0.3, 0.01, 1e-5]),
    opacity=st.floats(0.01, 1),
    glow=st.floats(0, 4),
    step=st.floats(0.1, 3),
    behind=st.sampled_from([0.0, 2.0, 50.0]),
)
def test_early_termination_keeps_its_bound(
    scheme: str, limit: float, opacity: float, glow: float, step: float, behind: float
) -> None:
    field = reconstruct(samples, "triquadratic", scheme=scheme)
    table = TransferFunction([0.0, 1.0], [(glow, 0.1, 1.0), (0.3, glow, 0.0)], [0.2 * opacity, opacity])
    scene = {"transfer": table, "step": step, "background": (0.5, 1.0, behind), **along(11.0, count=7)}
    full, short = (render(field, termination=t, **scene) for t in (None, limit))
    assert (full - short).abs().max() <= limit * (1 + 1e-5) + 1e-6 * (1 + behind)


# --- how the work is cut up -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
@few
@given(
    memory=st.sampled_from([1, 2**12, 2**17, 2**21, 2**40]),
    threads=st.integers(1, 3),
    first=st.integers(0, 50),
    count=st.integers(1, 20),
    seed=st.none() | st.integers(0, 2**63 - 1),
)
def test_the_same_bits_for_any_tile_batch_and_number_of_threads(
    scheme: str, memory: int, threads: int, first: int, count: int, seed: int | None
) -> None:
    field = reconstruct(samples, "notch", scheme=scheme)
    scene = {"transfer": medium(0.1), "step": 0.7, **along(10.0, count=70)}
    origins, directions = scene.pop("camera")
    whole = _with_threads(1, lambda: render(field, (origins, directions), jitter_seed=seed, **scene))
    assert whole[:, 3].min() > 0.3
    again = _with_threads(
        threads, lambda: render(field, (origins, directions), jitter_seed=seed, memory=memory, **scene)
    )
    assert torch.equal(again, whole)
    if seed is None:  # jitter is of a pixel's number
        part = slice(first, first + count)
        assert torch.equal(render(field, (origins[part], directions[part]), memory=memory, **scene), whole[part])


def _with_threads(threads: int, action: Callable[[], Tensor]) -> Tensor:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return action()
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("length", [5e-324, 1e-46, 1e39, 1.7e308])
def test_lights_of_any_length_give_the_same_image(length: float, scheme: str) -> None:
    field = reconstruct(samples, scheme=scheme)
    camera = along(N - 1.0, count=5)
    images = [
        render(field, transfer=medium(0.3), shading=Shading([Light((s, -s, 0.0))]), **camera) for s in (1.0, length)
    ]
    assert torch.equal(*images)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_light_of_any_length_has_finite_derivatives(scheme: str) -> None:
    for length in (1e-200, 1e200):
        direction = torch.tensor([1.0, -0.5, 0.2], dtype=torch.float64).mul(length).requires_grad_()
        field = reconstruct(samples, scheme=scheme)
        image = render(field, transfer=medium(0.3), shading=Shading([Light(direction)]), **along(N - 1.0, count=5))
        (found,) = torch.autograd.grad(image[:, :3].sum(), direction)
        assert found.isfinite().all()
        assert found.any()


# --- numbers that an image cannot be computed with --------------------------------------------------------------------

BLACK = {"ambient": 0.0, "diffuse": 0.0, "specular": 0.0}
WEIGHTS = {
    "ambient": lambda x: Shading(**{**BLACK, "ambient": x}),
    "diffuse": lambda x: Shading(**{**BLACK, "diffuse": x}),
    "specular": lambda x: Shading(**{**BLACK, "specular": x}),
    "light": lambda x: Shading([Light(None, (x, x, x)), Light((1.0, 0.5, 0.0), (x, x, x))]),
}


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", WEIGHTS)
def test_weights_of_light_are_refused_by_name_or_scale_the_image(name: str, scheme: str) -> None:
    field, rays = reconstruct(samples.double(), scheme=scheme), along(N - 1.0, count=5)
    make = WEIGHTS[name]
    for size in (1e39, 1e300):
        with pytest.raises(ValueError, match=f"an image in float32 .* up to 1.7e.38; .*{name}.* is .*e.*; float64"):
            render(field, transfer=medium(0.3), shading=make(size), **rays)
        bright = render(field, transfer=medium(0.3), shading=make(size), dtype=torch.float64, **rays)
        expected = render(field, transfer=medium(0.3), shading=make(1.0), dtype=torch.float64, **rays)
        ambient = 0.0 if name != "light" else 0.2 * torch.tensor(RGB).double() * expected[:, 3:]
        expected = expected[:, :3] - ambient  # which does not grow with the lights
        torch.testing.assert_close(bright[:, :3] / size, expected, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match="an image in float64"):
        render(field, transfer=medium(0.3), shading=make(1.7e308), dtype=torch.float64, **rays)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_backgrounds_colours_units_and_voxels_are_refused_by_name(scheme: str) -> None:
    field, rays = reconstruct(samples, scheme=scheme), along(N - 1.0)
    glow = TransferFunction([0.0, 1.0], [[1e39, 0, 0], [1, 1, 1]], [0.1, 0.2])
    with pytest.raises(ValueError, match=r"brightest colour is 1e.39"):
        render(field, transfer=glow, **rays)
    with pytest.raises(ValueError, match=r"brightest colour is 1e.39"):
        render(field, transfer=medium(0.3), background=(1e39, 0, 0), **rays)
    with pytest.raises(ValueError, match=r"1 / unit of the transfer function is 1e.300"):
        render(field, transfer=medium(0.3, 1e-300), **rays)
    with pytest.raises(ValueError, match=r"shininess is 1e.39"):
        render(field, transfer=medium(0.3), shading=Shading(shininess=1e39), **rays)
    for x in (1e-200, 1e200):
        small = reconstruct(Volume(samples, spacing=x), scheme=scheme)
        with pytest.raises(
            ValueError, match=r"(1 / voxel size|length of a ray|step) is .*e.*; float64 reaches further"
        ):
            render(small, transfer=medium(0.3, x), shading=Shading(), **along(N - 1.0, x))
        lit = render(small, transfer=medium(0.3, x), shading=Shading(), dtype=torch.float64, **along(N - 1.0, x))
        expected = render(field, transfer=medium(0.3), shading=Shading(), dtype=torch.float64, **along(N - 1.0))
        torch.testing.assert_close(lit, expected, rtol=1e-5, atol=1e-5)


def test_control_points_beyond_the_type_are_refused() -> None:
    far = TransferFunction([-1e39, 1e39], [[1, 1, 1]] * 2, [0.1, 0.2])
    with pytest.raises(ValueError, match=r"positions of the transfer function go beyond float32, which ends at 3.4e"):
        far.to(torch.float32)
    with pytest.raises(ValueError, match="positions must be less than the largest float32 apart"):
        TransferFunction([-3e38, 3e38], [[1, 1, 1]] * 2, [0.1, 0.2]).to(torch.float32)
    with pytest.raises(ValueError, match="positions must be less than the largest float64 apart"):
        TransferFunction([-1.7e308, 1.7e308], [[1, 1, 1]] * 2, [0.1, 0.2])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_cosine_that_is_rounded_to_more_than_one_is_one(dtype: torch.dtype) -> None:
    """(1 + ε)^shininess would be infinite."""
    generator = torch.Generator().manual_seed(5)
    rays = torch.randn(2000, 3, generator=generator, dtype=dtype)
    rays = rays / rays.norm(dim=-1, keepdim=True)
    white = torch.ones(2000, 3, dtype=dtype)
    for shininess in (1e9, 1e18, 1e38):
        lit = Shading(ambient=0.0, diffuse=0.0, specular=1.0, shininess=shininess)(white, -rays, rays)
        assert lit.isfinite().all()
        assert lit.max() == 1


def test_a_highlight_of_any_shininess_is_finite_when_it_is_fused() -> None:
    x, y, z = torch.meshgrid(*[torch.arange(float(N))] * 3, indexing="ij")
    generator = torch.Generator().manual_seed(5)
    for _ in range(10):
        slope = torch.randn(3, generator=generator)
        field = reconstruct(slope[2] * x + slope[1] * y + slope[0] * z, boundary="border", scheme="fused")
        direction = slope[None].double()
        origin = torch.tensor([[5.5, 5.5, 5.5]]).double() - 20 * direction
        for shininess in (1e9, 1e38):
            shading = Shading(ambient=0.0, diffuse=0.0, specular=1.0, shininess=shininess)
            image = render(field, (origin, direction), medium(0.3), shading=shading)
            assert image.isfinite().all()
            assert image.max() <= 1.001


sizes = st.sampled_from([0.0, 5e-324, 1e-300, 1e-46, 1e-30, 1.0, 1e30, 1e37, 3e38, 1e39, 1e300, 1.7e308])
positive = sizes.filter(bool)


@few
@given(
    weights=st.tuples(sizes, sizes, sizes),
    light=st.tuples(sizes, sizes, sizes),
    shininess=positive.map(lambda x: max(x, 1.0)),
    color=sizes,
    background=sizes,
    unit=positive,
    step=positive,
    spacing=st.sampled_from([1e-300, 1e-39, 1e-30, 1.0, 1e30, 1e39, 1e300]),
    span=st.tuples(sizes, sizes).filter(lambda pair: pair[0] < pair[1]),
    scheme=st.sampled_from(SCHEMES),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_an_image_is_finite_or_refused(
    weights, light, shininess, color, background, unit, step, spacing, span, scheme, dtype
) -> None:
    """Whatever numbers are given, no NaN and no infinity comes out of them."""
    field, refusal = reconstruct(Volume(samples, spacing=spacing), scheme=scheme), ""
    try:
        transfer = TransferFunction(span, [[color, 0.5, 1.0], [1.0, 0.5, color]], [0.0, 0.5], unit)
        shading = Shading([Light((1.0, 1.0, 0.0), light), Light()], *weights, shininess)
        rays = along(N - 1.0, spacing, count=3)
        image = render(
            field,
            transfer=transfer,
            shading=shading,
            background=(background, 0.0, 1.0),
            step=step,
            dtype=dtype,
            max_samples=10**5,
            **rays,
        )
    except ValueError as error:
        image, refusal = torch.zeros(1), str(error)
    assert image.isfinite().all()
    assert re.search(r"^$|image in float|image would take|transfer function|positions|step must be", refusal)


@pytest.mark.parametrize(
    "make",
    [
        lambda x: Light((x, 0.0, 0.0)),
        lambda x: Light(None, (x, 0.0, 0.0)),
        lambda x: Shading(ambient=x),
        lambda x: TransferFunction([0.0, x], [[1.0] * 3] * 2, [0.1, 0.2]),
        lambda x: TransferFunction([0.0, 1.0], [[1.0] * 3] * 2, [0.1, 0.2], unit=x),
        lambda x: PerspectiveCamera(position=(x, 0.0, 0.0), target=(0.0, 0.0, 0.0)),
        lambda x: PerspectiveCamera(position=(1.0, 0.0, 0.0), target=(0.0, 0.0, 0.0), field_of_view=x),
        lambda x: OrthographicCamera(position=(1.0, 0.0, 0.0), target=(0.0, 0.0, 0.0), height=x),
        lambda x: Volume(samples, spacing=x),
        lambda x: Volume(samples, origin=(x, 0.0, 0.0)),
        lambda x: render(reconstruct(samples), transfer=medium(0.3), background=(x, 0.0, 0.0), **along(3.0)),
        lambda x: render(reconstruct(samples), transfer=medium(0.3), step=x, **along(3.0)),
        lambda x: render(
            reconstruct(samples), transfer=medium(0.3), **{**along(3.0), "region": ((0, 0, 0), (x, x, x))}
        ),
    ],
)
def test_integers_beyond_all_floats_are_refused(make: Callable[[int], object]) -> None:
    with pytest.raises(ValueError, match=r"must|region"):
        make(10**400)
