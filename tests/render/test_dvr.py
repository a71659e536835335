"""The marcher against closed forms, a per-ray loop in plain Python, and laws of cutting up work."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from filterlab import signals
from filterlab.fields.base import Domain, Field
from filterlab.fields.grid import GridField
from filterlab.geometry import Geometry
from filterlab.methods import reconstruct
from filterlab.render import Light, OrthographicCamera, PerspectiveCamera, Shading, TransferFunction, render
from filterlab.render.rays import intersect, jitter
from filterlab.volume import Volume

GREY = [[0.5, 0.5, 0.5]]
BOX = Domain((-0.5, -0.5, -0.5), (7.5, 5.5, 9.5), Geometry.of((0.5, 1.0, 0.75), (1.0, 2.0, 3.0)), 0.5)


class Constant(Field):
    """The same value everywhere in a domain."""

    def __init__(self, value=0.0, domain=BOX):
        self.domain, self.value = domain, value

    def jet(self, points, order):
        value = torch.full_like(points[..., 0], self.value)
        return (value, torch.zeros_like(points))[: order + 1]


class Counting(Field):
    """Another field that remembers which orders were asked of it, and of how many points."""

    def __init__(self, field):
        self.field, self.domain, self.asked = field, field.domain, {0: 0, 1: 0, 2: 0}

    def jet(self, points, order):
        self.asked[order] += points.shape[:-1].numel()
        return self.field.jet(points, order)


def camera_for(field, **changes):
    return PerspectiveCamera.framing(field.domain, (0.4, 0.8, -0.45), **changes)


MARSCHNER_LOBB = signals.marschner_lobb()
PEAKS = TransferFunction.triangle_peaks([(0.35, 0.1, 0.4, (0.2, 0.4, 1.0)), (0.6, 0.2, 0.9, (1.0, 0.6, 0.2))], unit=0.1)
LIT = Shading((Light((1.0, -2.0, 1.0)), Light(None, (0.3, 0.4, 0.5))), ambient=0.3)
SCENE = {"size": (24, 18), "step": 0.9, "shading": LIT, "background": (0.1, 0.2, 0.3)}


# --- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("step", [0.05, 0.33, 0.5, 1.0, 2.7, 8.0])
@pytest.mark.parametrize("seed", [None, 11])
def test_constant_medium_at_any_step(step, dtype, seed):
    field, alpha, unit = Constant(), 0.2, 1.5
    transfer = TransferFunction([0.0], [[1.0, 0.5, 0.25]], [alpha], unit=unit)
    camera = camera_for(field)
    image = render(field, camera, transfer, size=(9, 7), step=step, dtype=dtype, background=(0, 0, 1), jitter_seed=seed)
    near, far = intersect(*camera.rays(9, 7), BOX)
    expected = -torch.expm1(math.log1p(-alpha) * (far - near).clamp_min(0) / unit)
    tolerance = 1e-6 if dtype == torch.float32 else 1e-13
    torch.testing.assert_close(image[..., 3].double(), expected, rtol=0, atol=tolerance)
    torch.testing.assert_close(image[..., 1].double(), 0.5 * expected, rtol=0, atol=tolerance)
    torch.testing.assert_close(image[..., 2].double(), 1 - 0.75 * expected, rtol=0, atol=tolerance)
    assert expected.max() > 0.5
    assert (expected == 0).any()


def test_thin_medium_keeps_its_digits():
    transfer = TransferFunction([0.0], [[1.0, 1.0, 1.0]], [1e-12])
    camera = OrthographicCamera.framing(BOX, (0, 1, 0))
    image = render(Constant(), camera, transfer, size=(3, 3), step=0.7, dtype=torch.float32)
    assert image[1, 1].tolist() == pytest.approx([6e-12] * 4, rel=1e-5)  # 6 voxels of 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_opaque_medium_is_exactly_opaque(dtype):
    transfer = TransferFunction([0.0, 0.5], [[0.25, 0.5, 1.0], [1.0, 1.0, 1.0]], [1.0, 1.0])
    camera = OrthographicCamera.framing(BOX, (0, 1, 0))
    image = render(Constant(), camera, transfer, size=(3, 3), step=0.01, dtype=dtype, background=(1, 1, 1))
    assert image[1, 1].tolist() == [0.25, 0.5, 1.0, 1.0]


RAMP = signals.polynomial({(1, 0, 0): 0.5, (0, 0, 0): 0.5})  # 0 … 1 along x


def ramp_reference(a, b, color, unit):
    """Colour and opacity of a ray along a ramp whose opacity goes from a to b over a length of 2, by quadrature."""
    u, slope = (lambda x: 1 - (a + (b - a) * x / 2)), -(b - a) / 2

    def depth(x):  # ∫ −ln u dx = −[u ln u − u] / (du/dx)
        primitive = [v * math.log(v) - v for v in (u(0.0), u(x))]
        return -(primitive[1] - primitive[0]) / slope / unit

    emitted = [
        quad(lambda x, c=c: (c[0] + (c[1] - c[0]) * x / 2) * -math.log(u(x)) / unit * math.exp(-depth(x)), 0, 2)[0]
        for c in color
    ]
    return [*emitted, -math.expm1(-depth(2.0))]


def ramp_image(step):
    transfer = TransferFunction([0.0, 1.0], [[1.0, 0.2, 0.4], [0.0, 0.9, 0.4]], [0.05, 0.9], unit=0.7)
    camera = OrthographicCamera(position=(-3, 0.1, 0.2), target=(0, 0.1, 0.2), height=1.0)
    return render(RAMP, camera, transfer, size=(2, 2), step=step, dtype=torch.float64)


def test_linear_ramp_against_its_closed_form_and_second_order():
    reference = torch.tensor(ramp_reference(0.05, 0.9, [(1.0, 0.0), (0.2, 0.9), (0.4, 0.4)], 0.7), dtype=torch.float64)
    errors = [(ramp_image(step) - reference).abs().amax((0, 1)) for step in (4.0, 2.0, 1.0, 0.5, 0.1)]
    assert errors[-1].max() < 2e-6
    orders = torch.stack([(a / b).log2() for a, b in pairwise(errors[:-1])])
    assert ((orders > 1.9) & (orders < 2.1)).all()


def test_image_error_falls_with_the_square_of_the_step():
    field = signals.gaussian(sigma=0.4)
    transfer = TransferFunction([0.0, 1.0], [[0.2, 0.4, 0.9], [1.0, 0.7, 0.1]], [0.01, 0.8], unit=0.3)
    camera = camera_for(field)

    def image(step, seed=None):
        return render(
            field, camera, transfer, size=(13, 11), step=step, shading=LIT, dtype=torch.float64, jitter_seed=seed
        )

    reference = image(1 / 32)
    for seed in (None, 3):
        errors = [(image(step, seed) - reference).square().mean().sqrt().log2() for step in (1.0, 0.25)]
        assert abs((errors[0] - errors[1]) / 2 - 2) < 0.15


# --- an independent loop ----------------------------------------------------------------------------------------------


def marschner_lobb_in_python(x, y, z):
    r = math.hypot(x, y)
    phase = 12 * math.pi * math.cos(math.pi * r / 2)
    value = (1 - math.sin(math.pi * z / 2) + 0.25 * (1 + math.cos(phase))) / 2.5
    radial = 0.25 / 2.5 * math.sin(phase) * 12 * math.pi * math.pi / 2 * math.sin(math.pi * r / 2)
    return value, [radial * x / r, radial * y / r, -math.pi / 2 * math.cos(math.pi * z / 2) / 2.5]


def unit(v):
    n = math.sqrt(sum(x * x for x in v))
    return [x / n for x in v]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def loop(o, d, step, u, region):
    """One ray of SCENE, by the textbook recurrence C += T α c, T *= 1 − α."""
    near, far = 0.0, math.inf
    for k in range(3):
        low, high = max(-1, region[0][k]), min(1, region[1][k])
        a, b = sorted(((low - o[k]) / d[k], (high - o[k]) / d[k]))
        near, far = max(near, a), min(far, b)
    rgb, t, start, end = [0.0, 0.0, 0.0], 1.0, near, near + u * step
    while start < far:
        end = min(end, far)
        p = [o[k] + (start + end) / 2 * d[k] for k in range(3)]
        value, gradient = marschner_lobb_in_python(*p)
        alpha = np.interp(value, PEAKS.positions, PEAKS.opacities)
        alpha = 1 - (1 - alpha) ** ((end - start) / 0.1)
        n, v = unit(gradient), [-x for x in d]
        for k in range(3):
            c = np.interp(value, PEAKS.positions, PEAKS.colors[:, k])
            lit = 0.3 * c
            for direction, color in (((1.0, -2.0, 1.0), (1.0, 1.0, 1.0)), (v, (0.3, 0.4, 0.5))):
                towards = unit(direction)
                h = unit([x + y for x, y in zip(towards, v, strict=True)])
                lit += 0.7 * c * color[k] * abs(dot(n, towards)) + 0.3 * color[k] * abs(dot(n, h)) ** 32
            rgb[k] += t * alpha * lit
        t *= 1 - alpha
        start, end = end, end + step
    return [c + t * b for c, b in zip(rgb, (0.1, 0.2, 0.3), strict=True)] + [1 - t]


@pytest.mark.parametrize("seed", [None, 5])
def test_marcher_equals_a_loop_per_ray(seed):
    region = ((-0.7, -2.0, -0.9), (0.8, 0.6, 0.5))
    camera = camera_for(MARSCHNER_LOBB)
    origins, directions = (r.reshape(-1, 3) for r in camera.rays(24, 18))
    image = render(
        MARSCHNER_LOBB, camera, PEAKS, **SCENE, region=region, jitter_seed=seed, dtype=torch.float64
    ).reshape(-1, 4)
    offset = torch.ones(432).double() if seed is None else jitter(seed, torch.arange(432))
    step = 0.9 * MARSCHNER_LOBB.domain.voxel_size
    for pixel in range(0, 432, 29):
        o, d, u = origins[pixel].tolist(), directions[pixel].tolist(), offset[pixel].item()
        assert image[pixel].tolist() == pytest.approx(loop(o, d, step, u, region), rel=0, abs=1e-12)


def test_float32_is_close_to_float64():
    camera = camera_for(MARSCHNER_LOBB)
    a = render(MARSCHNER_LOBB, camera, PEAKS, **SCENE)
    b = render(MARSCHNER_LOBB, camera, PEAKS, **SCENE, dtype=torch.float64)
    torch.testing.assert_close(a.double(), b, rtol=0, atol=2e-4)  # the signal's own phase loses 3 digits


# --- cutting up work --------------------------------------------------------------------------------------------------


def turned_volume():
    c, s = math.cos(0.5), math.sin(0.5)
    affine = np.eye(4)
    affine[:3] = [[0.1 * c, -0.1 * s, 0, 1], [0.1 * s, 0.1 * c, 0, 2], [0, 0, -0.2, 3]]
    generator = torch.Generator().manual_seed(1)
    return Volume(torch.rand(9, 12, 10, generator=generator), affine=affine)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("termination", [None, 0.01])
@pytest.mark.parametrize("kind", ["signal", "turned volume"])
def test_memory_and_threads_change_no_bit(dtype, termination, kind):
    field = MARSCHNER_LOBB if kind == "signal" else reconstruct(turned_volume(), "triquadratic")
    camera = camera_for(field)

    def image(memory):
        return render(field, camera, PEAKS, **SCENE, dtype=dtype, termination=termination, jitter_seed=9, memory=memory)

    threads = torch.get_num_threads()
    expected = image(2**28)
    assert expected[..., 3].max() > 0.9
    for memory in (2**17, 2**20, 2**23):
        assert torch.equal(image(memory), expected)
    try:
        torch.set_num_threads(1 if threads > 1 else 2)
        assert torch.equal(image(2**22), expected)
    finally:
        torch.set_num_threads(threads)


def test_a_pixel_does_not_depend_on_the_others():
    camera = camera_for(MARSCHNER_LOBB)
    image = render(MARSCHNER_LOBB, camera, PEAKS, **SCENE)
    rays = camera.rays(24, 18)
    scene = {k: v for k, v in SCENE.items() if k != "size"}
    rows = render(MARSCHNER_LOBB, tuple(r[7:9, 3:] for r in rays), PEAKS, **scene)
    assert rows.shape == (2, 21, 4)
    torch.testing.assert_close(rows, image[7:9, 3:], rtol=0, atol=1e-6)  # unit vectors are normalised once more


def test_a_zoomed_view_is_a_magnified_crop():
    whole = render(MARSCHNER_LOBB, camera_for(MARSCHNER_LOBB), PEAKS, **{**SCENE, "size": (48, 32)})
    zoomed = camera_for(MARSCHNER_LOBB, window=(0.25, 0.25, 0.75, 0.75))
    zoomed = render(MARSCHNER_LOBB, zoomed, PEAKS, **{**SCENE, "size": (24, 16)})
    assert torch.equal(zoomed, whole[8:24, 12:36])


@pytest.mark.parametrize("termination", [0.3, 0.05, 1e-3])
@pytest.mark.parametrize(
    ("glow", "background"), [(1.5, (0.0, 0.0, 0.0)), (1.5, (1.0, 30.0, 0.0)), (0.05, (0.0, 0.0, 0.0))]
)
def test_termination_changes_the_image_by_no_more_than_it_says(termination, glow, background):
    """Of any component: lit colours, what shines through from behind, and opacity."""
    bright = TransferFunction(PEAKS.positions, glow * PEAKS.colors, PEAKS.opacities, unit=0.05)
    scene = {"size": (24, 18), "shading": LIT, "background": background, "dtype": torch.float64}
    field = Counting(MARSCHNER_LOBB)
    full = render(field, camera_for(field), bright, **scene)
    samples, field.asked = field.asked[0], {0: 0, 1: 0, 2: 0}
    short = render(field, camera_for(field), bright, **scene, termination=termination)
    assert 0 < (short - full).abs().max() <= termination
    assert field.asked[0] < samples


def test_jitter_changes_the_image_a_little_and_repeats():
    camera = camera_for(MARSCHNER_LOBB)
    plain, a, b, c = (render(MARSCHNER_LOBB, camera, PEAKS, **SCENE, jitter_seed=seed) for seed in (None, 1, 1, 2))
    assert torch.equal(a, b)
    assert 1e-4 < (a - c).abs().mean() < 0.05
    assert 1e-4 < (a - plain).abs().mean() < 0.05


# --- only what the scene needs ----------------------------------------------------------------------------------------


def total_samples(field, camera, step):
    near, far = intersect(*camera.rays(24, 18), field.domain)
    return int(torch.ceil((far - near).clamp_min(0) / (step * field.domain.voxel_size)).sum())


def test_no_light_no_gradient():
    field = Counting(MARSCHNER_LOBB)
    camera = camera_for(field)
    with torch.no_grad():
        render(field, camera, PEAKS, **{**SCENE, "shading": None})
    assert field.asked == {0: total_samples(field, camera, 0.9), 1: 0, 2: 0}


def test_gradients_only_where_something_is_seen():
    field = Counting(MARSCHNER_LOBB)
    camera = camera_for(field)
    with torch.no_grad():
        render(field, camera, PEAKS, **SCENE)
    assert field.asked[0] == total_samples(field, camera, 0.9)
    assert 0 < field.asked[1] < field.asked[0] / 3
    assert field.asked[2] == 0
    nothing = TransferFunction([0.0], GREY, [0.0])
    field.asked = {0: 0, 1: 0, 2: 0}
    with torch.no_grad():
        assert not render(field, camera, nothing, **{**SCENE, "background": (0, 0, 0)}).any()
    assert field.asked[1] == 0


def test_one_pass_where_everything_is_seen():
    field = Counting(MARSCHNER_LOBB)
    camera = camera_for(field)
    fog = TransferFunction([0.0, 1.0], GREY * 2, [0.01, 0.02])
    with torch.no_grad():
        render(field, camera, fog, **SCENE)
    assert field.asked == {0: 0, 1: total_samples(field, camera, 0.9), 2: 0}


def test_opaque_rays_end_without_being_asked_to():
    field = Counting(Constant(domain=Domain((0, 0, 0), (100, 100, 100))))
    camera = OrthographicCamera.framing(field.domain, (0, 1, 0), margin=1.0)
    opaque = TransferFunction([0.0], GREY, [1.0])
    image = render(field, camera, opaque, size=(4, 4), step=0.1)
    assert torch.equal(image, torch.tensor([0.5, 0.5, 0.5, 1.0]).expand(4, 4, 4))
    assert field.asked[0] < 16 * 1000 / 10


# --- anisotropic and turned geometry ----------------------------------------------------------------------------------


def stretched_sphere(spacing, rotation):
    """A ball sampled on 40³ voxels of the given spacing, turned: as a volume, and as the signal it should be."""
    n, radius, edge = 40, 13.0, 3.0
    ball = signals.sphere(radius, (0, 0, 0), edge)
    i = torch.arange(n, dtype=torch.float64) - (n - 1) / 2
    z, y, x = torch.meshgrid(i, i, i, indexing="ij")
    matrix = torch.tensor(rotation, dtype=torch.float64) @ torch.diag(torch.tensor(spacing, dtype=torch.float64))
    affine = torch.eye(4, dtype=torch.float64)
    affine[:3, :3] = matrix
    affine[:3, 3] = -matrix @ torch.full((3,), (n - 1) / 2, dtype=torch.float64)
    volume = Volume(ball(torch.stack((x, y, z), -1)), affine=affine)
    inverse = torch.linalg.inv(matrix)

    def world(p):
        value, gradient = ball.value_and_gradient(p @ inverse.T.to(p.dtype))
        return value, gradient @ inverse.to(p.dtype)

    return volume, signals.Signal("ellipsoid", world)


TURN = [[math.cos(0.7), -math.sin(0.7), 0.0], [math.sin(0.7), math.cos(0.7), 0.0], [0.0, 0.0, 1.0]]
STRAIGHT = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize("rotation", [STRAIGHT, TURN])
def test_a_stretched_sphere_is_lit_as_the_ellipsoid_it_is(rotation):
    volume, ellipsoid = stretched_sphere((1.0, 2.0, 0.5), rotation)
    field = reconstruct(volume, "tricubic")
    ellipsoid.domain = field.domain
    camera = PerspectiveCamera.framing(field.domain, (0.5, 0.8, -0.3))
    shell = TransferFunction.triangle_peaks([(0.5, 0.3, 0.9, (0.8, 0.5, 0.3))])
    scene = {"size": (32, 32), "step": 0.5, "shading": LIT, "dtype": torch.float64}
    image, expected = (render(f, camera, shell, **scene) for f in (field, ellipsoid))
    assert expected[..., 3].max() > 0.9
    assert (image - expected).abs().max() < 2e-3

    class Crooked(Field):  # the error that this test is for: gradients per voxel
        domain = field.domain

        def jet(self, points, order):
            jet = field.jet(points, order)
            return jet[:1] + tuple(g * g.new_tensor([1.0, 4.0, 0.25]) for g in jet[1:])

    assert (render(Crooked(), camera, shell, **scene) - expected).abs().max() > 0.05


def test_a_flipped_axis_shows_the_same_object():
    volume, _ = stretched_sphere((1.0, 2.0, 0.5), STRAIGHT)
    samples = volume.samples + 0.1 * torch.arange(40, dtype=torch.float64)[:, None, None] / 40
    affine = volume.affine.copy()
    affine[:3, 3] += affine[:3, 2] * 39
    affine[:3, 2] *= -1
    a = reconstruct(Volume(samples, affine=volume.affine), "triquadratic")
    b = reconstruct(Volume(samples.flip(0), affine=affine), "triquadratic")
    shell = TransferFunction.triangle_peaks([(0.5, 0.3, 0.9, (0.8, 0.5, 0.3))])
    camera = PerspectiveCamera.framing(a.domain, (0.5, 0.8, -0.3))
    images = [render(f, camera, shell, size=(16, 16), shading=LIT, dtype=torch.float64) for f in (a, b)]
    torch.testing.assert_close(images[0], images[1], rtol=0, atol=1e-10)


# --- rays that go wrong, and mistakes ---------------------------------------------------------------------------------


def test_axis_parallel_face_inside_and_missing_rays():
    origins = torch.tensor([[0, -5, 0], [1, -5, 0], [0, 0, 0], [0, 5, 0], [3, -5, 0], [0, -1, 0]]).double()
    directions = torch.tensor([[0.0, 1.0, 0.0]]).double().expand(6, 3)
    image = render(
        Constant(domain=Domain((-1, -1, -1), (1, 1, 1))),
        (origins, 3 * directions),
        TransferFunction([0.0], [[1.0, 1.0, 1.0]], [0.5]),
        step=0.3,
        dtype=torch.float64,
    )
    expected = [1 - 0.5**length for length in (2, 2, 1, 0, 0, 2)]
    assert image[:, 3].tolist() == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize("order", [0, 1])
def test_nothing_is_where_a_field_or_the_gradient_that_lights_it_is_nan(order):
    class Torn(Constant):
        def jet(self, points, order):
            jet = [torch.full_like(points[..., 0], 0.5), torch.ones_like(points)]
            jet[torn] = jet[torn] + torch.where(points[..., :1] > 3, torch.nan, 0.0).reshape(*jet[torn].shape[:-1], -1)
            return tuple(jet[: order + 1])

    torn, camera = order, OrthographicCamera.framing(BOX, (0, 1, 0))
    for clear in (0.0, 0.1):  # values first, and gradients where one is seen; or both in one pass
        transfer = TransferFunction([0.0, 0.4], GREY * 2, [clear, 0.1])
        image = render(Torn(), camera, transfer, size=(8, 8), shading=LIT, background=(0.1, 0.2, 0.3))
        origins, _ = camera.rays(8, 8)
        near, far = intersect(*camera.rays(8, 8), BOX)
        assert torch.equal(image[..., 3] > 0, (origins[..., 0] <= 3) & (far > near))
        assert torch.equal(image[origins[..., 0] > 3], torch.tensor([0.1, 0.2, 0.3, 0.0]).expand(32, 4))


def test_mistakes_are_found_before_anything_is_evaluated():
    field = Counting(MARSCHNER_LOBB)
    camera = camera_for(field)
    rays = camera.rays(2, 2)
    nan = torch.full((2, 2, 3), math.nan)
    for error, message, camera_or_rays, changes in (
        (ValueError, "step must be a positive", camera, {"step": 0.0}),
        (ValueError, "step must be a positive", camera, {"step": math.nan}),
        (ValueError, "step must be a positive", camera, {"step": -1.0}),
        (ValueError, r"would take \d.* samples.*max_samples", camera, {"step": 1e-9}),
        (ValueError, "max_samples", camera, {"max_samples": 100}),
        (ValueError, "size=", camera, {"size": None}),
        (ValueError, "size must be", camera, {"size": (0, 4)}),
        (ValueError, "size goes with a camera", rays, {}),
        (ValueError, "finite", (rays[0], nan), {"size": None}),
        (ValueError, "background", camera, {"background": (0, 0)}),
        (ValueError, "background", camera, {"background": (0, 0, math.nan)}),
        (ValueError, "region", camera, {"region": ((0, 0, 0), (0, 1, 1))}),
        (ValueError, "termination", camera, {"termination": 1.0}),
        (ValueError, "dtype", camera, {"dtype": torch.float16}),
        (ValueError, "memory", camera, {"memory": 0}),
        (ValueError, "jitter_seed", camera, {"jitter_seed": -1}),
        (ValueError, "step must be a positive .* got 'a'", camera, {"step": "a"}),
        (ValueError, "termination must be .* got 'a'", camera, {"termination": "a"}),
        (ValueError, "size must be two positive integers .* got 4", camera, {"size": 4}),
        (ValueError, "background must be three finite numbers .* got 'white'", camera, {"background": "white"}),
        (TypeError, "shading must be a Shading, or None for unlit; got bool", camera, {"shading": True}),
        (TypeError, "camera must be", "camera", {}),
    ):
        with torch.no_grad(), pytest.raises(error, match=message):
            render(field, camera_or_rays, PEAKS, **{**SCENE, **changes})
    assert field.asked == {0: 0, 1: 0, 2: 0}
    with pytest.raises(TypeError, match="field must be a Field"):
        render(torch.zeros(4, 4, 4), camera, PEAKS, size=(4, 4))  # type: ignore[arg-type]
    with torch.no_grad(), pytest.raises(TypeError, match="transfer must be a TransferFunction; got function"):
        render(field, camera, lambda v: v, size=(4, 4))  # type: ignore[arg-type]
    empty = reconstruct(torch.rand(0, 1, 4, 4, 4), "trilinear")
    with pytest.raises(ValueError, match=r"at least one entry and channel; got \(N, C\) = \(0, 1\)"):
        render(empty, camera, PEAKS, size=(4, 4))
    for voxel_size in (0.0, -1.0, math.nan, math.inf):
        crooked = Constant(domain=Domain((-0.5, -0.5, -0.5), (3.5, 3.5, 3.5), Geometry(), voxel_size))
        with pytest.raises(ValueError, match="voxel_size must be a positive world length; got"):
            render(crooked, camera, PEAKS, size=(4, 4))
    assert field.asked == {0: 0, 1: 0, 2: 0}


# --- batches ----------------------------------------------------------------------------------------------------------


class Batch(Field):
    """Any batched field that is no GridField: (N, C) = (2, 3) scaled Gaussians."""

    signal = signals.gaussian()
    domain = signal.domain
    channels = (2, 3)

    def jet(self, points, order):
        scale = torch.tensor([[1.0, 0.8, 0.6], [0.9, 0.7, 0.5]], dtype=points.dtype)
        assert points.shape[0] in (1, 2)
        jet = self.signal.jet(points.expand(2, *points.shape[1:]), order)
        return tuple(x[:, None] * scale.reshape(2, 3, *(1 for _ in x.shape[1:])) for x in jet)


@pytest.mark.parametrize("method", ["triquadratic", "notch", "ncrsi"])
def test_a_batch_gives_the_bits_of_each_volume_alone(method):
    batch = torch.rand(2, 3, 7, 6, 8, generator=torch.Generator().manual_seed(2))
    field = reconstruct(Volume(batch, spacing=(0.1, 0.2, 0.1)), method)
    camera = camera_for(field)
    scene = {**SCENE, "jitter_seed": 3, "termination": 0.01}
    images = render(field, camera, PEAKS, **scene)
    assert images.shape == (2, 3, 18, 24, 4)
    for n in range(2):
        for c in range(3):
            one = reconstruct(Volume(batch[n, c], spacing=(0.1, 0.2, 0.1)), method)
            assert torch.equal(images[n, c], render(one, camera, PEAKS, **scene))
    assert images.reshape(6, -1).unique(dim=0).shape[0] == 6
    rays = tuple(r[3, 4:9] for r in camera.rays(24, 18))
    assert render(field, rays, PEAKS).shape == (2, 3, 5, 4)  # type: ignore[arg-type]


def test_a_batch_of_any_field_and_one_channel_of_a_grid():
    field = Batch()
    camera = camera_for(field)
    fog = TransferFunction([0.0, 1.0], [[1.0, 0.5, 0.2], [0.2, 0.5, 1.0]], [0.01, 0.3], unit=0.1)
    images = render(field, camera, fog, size=(6, 5), shading=LIT, dtype=torch.float64)
    for n, c, scale in ((0, 0, 1.0), (0, 2, 0.6), (1, 1, 0.7)):
        scaled = TransferFunction(fog.positions / scale, fog.colors, fog.opacities, unit=0.1)
        expected = render(field.signal, camera, scaled, size=(6, 5), shading=LIT, dtype=torch.float64)
        torch.testing.assert_close(images[n, c], expected, rtol=0, atol=1e-12)
    grid = reconstruct(torch.rand(2, 3, 4, 4, 4), "triquadratic")
    assert isinstance(grid, GridField)
    one = grid.select(1, 2)
    assert one.channels is None
    assert one.coefficients.values.data_ptr() == grid.coefficients.values[1, 2].data_ptr()
    points = 3 * torch.rand(5, 3)
    for a, b in zip(one.jet(points, 2), grid.jet(points[None], 2), strict=True):
        torch.testing.assert_close(a, b[1, 2])
    assert grid.channels == (2, 3)
    with pytest.raises(ValueError, match="batched"):
        one.select(0, 0)
    with pytest.raises(IndexError):
        grid.select(2, 0)


def test_a_batch_counts_all_of_its_samples():
    field = Batch()
    camera = camera_for(field)
    seen = []
    with torch.no_grad():
        render(field, camera, PEAKS, **SCENE, progress=lambda done, total: seen.append((done, total)))
    one = total_samples(field, camera, 0.9)
    assert seen[-1] == (6 * one, 6 * one)
    assert all(a[0] <= b[0] for a, b in pairwise(seen))
    with pytest.raises(ValueError, match="max_samples"):
        render(field, camera, PEAKS, **SCENE, max_samples=6 * one - 1)


def test_progress_counts_samples_up_to_the_total():
    seen = []
    camera = camera_for(MARSCHNER_LOBB)
    render(
        MARSCHNER_LOBB, camera, PEAKS, **SCENE, memory=2**20, progress=lambda done, total: seen.append((done, total))
    )
    total = total_samples(MARSCHNER_LOBB, camera, 0.9)
    assert seen[-1] == (total, total)
    assert len(seen) > 10
    assert all(a[0] <= b[0] for a, b in pairwise(seen))
