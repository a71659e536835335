"""The fused marcher shows what the plain one shows, whatever the scene."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from filterlab import signals
from filterlab.methods import METHODS, reconstruct
from filterlab.ops import march
from filterlab.ops.cpu import march as driver
from filterlab.render import Light, OrthographicCamera, PerspectiveCamera, Shading, TransferFunction, render
from filterlab.render.plain import PlainMarcher
from filterlab.volume import Boundary, Volume
from tests import laws

TOLERANCE = {torch.float32: 8e-6, torch.float64: 5e-14}  # of numbers up to 1; seen: 4e-6 and 1.6e-14
BOUNDARIES = [b.value for b in Boundary]
LIT = Shading((Light((1.0, -2.0, 1.0)), Light(None, (0.3, 0.4, 0.5))), ambient=0.3)
PEAKS = TransferFunction.triangle_peaks([(0.35, 0.1, 0.4, (0.2, 0.4, 1.0)), (0.6, 0.2, 0.9, (1.0, 0.6, 0.2))], 0.2)
SOFT = TransferFunction(
    [0.1, 0.4, 0.9], [[0.2, 0.3, 0.9], [0.8, 0.5, 0.1], [0.4, 0.9, 0.3]], [0.01, 0.3, 0.1], unit=0.2
)
SCENE = {"size": (13, 11), "step": 0.6, "background": (0.1, 0.2, 0.3)}
KINDS = [(name, gradient) for name, method in METHODS.items() for gradient in method.gradients]
TYPED = [(*kind, (torch.float32, torch.float64)[i % 2]) for i, kind in enumerate(KINDS)]
TYPED += [("triquadratic", "analytic", torch.float32), ("ncrsi", "central", torch.float64)]
CASES = list(dict.fromkeys(TYPED))


def samples(dtype: torch.dtype = torch.float32, shape=(9, 12, 10)) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)


def seeded(seed: int, *shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def turned(values: Tensor) -> Volume:
    """Stretched, flipped and turned."""
    c, s = math.cos(0.5), math.sin(0.5)
    affine = np.eye(4)
    affine[:3] = [[0.1 * c, -0.1 * s, 0, 1], [0.1 * s, 0.1 * c, 0, 2], [0, 0, -0.2, 3]]
    return Volume(values, affine=affine)


def camera_for(field, **changes) -> PerspectiveCamera:
    return PerspectiveCamera.framing(field.domain, (0.4, 0.8, -0.45), **changes)


def both(volume, camera=None, transfer=SOFT, method="triquadratic", field=None, **scene) -> tuple[Tensor, Tensor]:
    """The same scene by the fused marcher (and not by the other) and by the plain one."""
    fields = [reconstruct(volume, method, scheme=scheme, **(field or {})) for scheme in ("fused", "direct")]
    scene = {**SCENE, **scene} if not isinstance(camera, tuple) else scene
    camera = camera or camera_for(fields[0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PlainMarcher, "march", None)
        image = render(fields[0], camera, transfer, **scene)
    return image, render(fields[1], camera, transfer, **scene)


def assert_same(images: tuple[Tensor, Tensor], tolerance: float | None = None) -> None:
    image, expected = images
    assert image.dtype == expected.dtype
    tolerance = TOLERANCE[image.dtype] if tolerance is None else tolerance
    torch.testing.assert_close(image, expected, rtol=0, atol=tolerance, equal_nan=True)


@pytest.mark.parametrize(("method", "gradient", "dtype"), CASES)
def test_every_method_gradient_and_boundary(method: str, gradient: str, dtype: torch.dtype) -> None:
    """Boundaries by turns, two of five with each: they change coefficients, and no program."""
    turn = CASES.index((method, gradient, dtype))
    for boundary in (BOUNDARIES[turn % 5], BOUNDARIES[(turn + 2) % 5]):
        images = both(
            turned(samples(dtype)),
            method=method,
            field={"boundary": boundary, "gradient": gradient},
            shading=LIT,
            dtype=dtype,
            jitter_seed=3,
        )
        assert_same(images)
        assert 0.3 < images[0][..., 3].max() < 0.999


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shading", [None, LIT])
def test_peaks_regions_and_steps(shading: Shading | None, dtype: torch.dtype) -> None:
    volume = turned(samples(dtype))
    region = ((-9.0, 2.3, 1.5), (1.4, 9.0, 9.0))
    for step in (0.07, 0.6, 5.0):
        images = both(volume, transfer=PEAKS, step=step, shading=shading, region=region, dtype=dtype)
        assert_same(images)
        assert images[0][..., 3].max() > 0.9


@pytest.mark.parametrize("points", [1, 2, 40, 300])
def test_any_number_of_control_points(points: int) -> None:
    x = torch.linspace(0.2, 0.8, points, dtype=torch.float64)  # not at equal steps exactly, but for 2
    generator = torch.Generator().manual_seed(points)
    rgb, alpha = (torch.rand(points, *more, generator=generator, dtype=torch.float64) for more in ((3,), ()))
    steep = max(points - 1, 1) / 0.6  # a value that is a rounding off moves an opacity by so many of them
    images = both(samples(torch.float64), transfer=TransferFunction(x, rgb, alpha, 9.0), dtype=torch.float64)
    assert_same(images, max(TOLERANCE[torch.float64], 2 * steep * torch.finfo(torch.float64).eps))


def test_buckets_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the image and its derivatives: intervals are found by buckets, or by comparing with every control point."""
    generator = torch.Generator().manual_seed(2)
    x = torch.rand(40, generator=generator).sort().values
    volume = samples(torch.float32).requires_grad_()
    field = reconstruct(volume, "triquadratic", scheme="fused")
    camera = OrthographicCamera.framing(field.domain, (0.2, 1, 0.3))
    results = []
    for fewest in (1, 1000):
        monkeypatch.setattr(march, "_FEWEST_BUCKETED", fewest)
        tables = [
            t.clone().requires_grad_() for t in (x, torch.rand(40, 3, generator=generator.manual_seed(4)), x * 0.2)
        ]
        assert (march._buckets(x, x) is None) == (fewest == 1000)
        image = render(field, camera, TransferFunction(*tables), size=(9, 7), shading=LIT)
        results.append([image, *torch.autograd.grad(image.square().sum(), [volume, *tables], retain_graph=True)])
    for bucketed, searched in zip(*results, strict=True):
        assert torch.equal(bucketed, searched)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equal_steps_give_what_comparing_gives(monkeypatch: pytest.MonkeyPatch, dtype: torch.dtype) -> None:
    """The image and its derivatives: intervals are counted off, or found by comparing with every control point."""
    generator = torch.Generator().manual_seed(2)
    x = torch.linspace(0, 1, 9, dtype=dtype)
    table = (x, *(torch.rand(9, *more, generator=generator, dtype=dtype) for more in ((3,), ())))
    volume = samples(dtype).requires_grad_()
    field = reconstruct(volume, "triquadratic", scheme="fused")
    camera = OrthographicCamera.framing(field.domain, (0.2, 1, 0.3))
    assert march._equal_steps(x) is not None
    results = []
    for found in (march._equal_steps, lambda x: None):
        monkeypatch.setattr(march, "_equal_steps", found)
        leaves = [t.clone().requires_grad_() for t in table]
        image = render(field, camera, TransferFunction(*leaves, 9.0), size=(9, 7), shading=LIT, dtype=dtype)
        results.append([image, *torch.autograd.grad(image.square().sum(), [volume, *leaves], retain_graph=True)])
    for counted, compared in zip(*results, strict=True):
        size = float(compared.detach().abs().max())
        assert float((counted - compared).detach().abs().max()) <= 100 * torch.finfo(dtype).eps * size
        assert size > 0


def test_values_at_control_points_are_exact() -> None:
    """Constant volumes at, between and beyond control points: opacity 0 between peaks, the control point's at one."""
    for value, opacity in ((0.5, 0.25), (0.75, 1.0), (0.25, 0.0), (0.1, 0.0), (0.0, 0.0), (2.0, 0.0)):
        transfer = TransferFunction([0.25, 0.5, 0.75, 0.875], [[1.0, 0.5, 0.25]] * 4, [0.0, 0.25, 1.0, 0.0], unit=4.0)
        volume = torch.full((4, 4, 4), value)
        camera = OrthographicCamera.framing(reconstruct(volume).domain, (0, 1, 0))
        image, _ = both(volume, camera, transfer, method="trilinear", size=(3, 3), background=(0, 0, 0))
        expected = torch.tensor([opacity, opacity / 2, opacity / 4, opacity])
        if opacity in (0, 1):
            assert torch.equal(image[1, 1], expected)
        else:
            torch.testing.assert_close(image[1, 1], expected, rtol=0, atol=1e-6)


def test_the_last_control_point_is_exact_too() -> None:
    """Where low + (high − low) is not high; and α = 1 is opaque, however long the unit."""
    transfer = TransferFunction([0.25, 0.875], [[0.1, 0.7, 0.2], [1e-9, 0.3, 1.0]], [0.3, 1.0], unit=1e6)
    volume = torch.full((4, 4, 4), 0.875)
    camera = OrthographicCamera.framing(reconstruct(volume).domain, (0, 1, 0))
    image, _ = both(volume, camera, transfer, method="trilinear", size=(3, 3))
    assert torch.equal(image[1, 1], torch.tensor([1e-9, 0.3, 1.0, 1.0]))


def test_early_termination_stays_within_its_bound() -> None:
    dense = TransferFunction(PEAKS.positions, PEAKS.colors, PEAKS.opacities, unit=0.05)
    for dtype in (torch.float32, torch.float64):
        volume = turned(samples(dtype))
        field = reconstruct(volume, scheme="fused")
        scene = {**SCENE, "shading": LIT, "dtype": dtype, "step": 0.2, "background": (0, 0, 0)}
        full, short = (render(field, camera_for(field), dense, **scene, termination=t) for t in (None, 0.1))
        assert 0 < (full - short).abs().max() <= 0.1
        assert (full[..., 3] > short[..., 3]).any()  # rays ended
        image, expected = both(volume, transfer=dense, **scene, termination=0.1)
        assert (image - expected).abs().max() <= 0.1
        if dtype == torch.float64:  # what is seen is the same; how far a ray goes on in the dark is not
            assert_same((image[..., :3], expected[..., :3]))


def test_too_many_samples_are_refused_however_many() -> None:
    field = reconstruct(samples(), scheme="fused")
    for step in (1e-10, 1e-25, 1e-300):
        with pytest.raises(ValueError, match=r"the image would take .* samples; the limit is max_samples"):
            render(field, camera_for(field), SOFT, size=(4, 4), step=step)


def test_rays_along_axes_on_faces_from_inside_and_missing() -> None:
    origins = torch.tensor([[0, -5, 0], [-0.5, -5, 3], [2, 3, 4], [0, 15, 0], [30, -5, 0], [0, -1, 0]]).double()
    directions = torch.tensor([[0.0, 3.0, 0.0]]).double().expand(6, 3)
    for dtype in (torch.float32, torch.float64):
        rays = (origins, directions)
        images = both(samples(dtype), rays, shading=LIT, step=0.3, dtype=dtype)
        assert_same(images)
        assert (images[0][:, 3] > 0).tolist() == [True, True, True, False, False, True]


def test_a_voxel_of_nan_is_transparent_in_the_same_pixels() -> None:
    values = samples()
    values[4, 6, 5] = torch.nan
    scene = {"method": "catmull-rom", "shading": LIT, "size": (20, 18)}
    images = both(turned(values), field={"nan": "propagate"}, **scene)
    assert_same(images)
    assert images[0].isfinite().all()
    clearer = both(turned(values), field={"nan": "fill"}, **scene)[0][..., 3] - images[0][..., 3]
    assert 0 < (clearer > 1e-3).sum() < 180


def test_nothing_behind_the_end_of_a_ray_is_seen() -> None:
    """A pack goes on behind the region, where the volume is NaN."""
    values = samples(torch.float64, (12, 12, 12))
    values[:, 7:] = torch.nan
    kept = {"nan": "propagate"}
    camera = OrthographicCamera.framing(reconstruct(values, **kept).domain, (0, 1, 0))
    for stop in torch.linspace(3.2, 5.9, 9).tolist():
        region = ((-9.0, -9.0, -9.0), (20.0, stop, 20.0))
        scene = {"region": region, "shading": LIT, "dtype": torch.float64}
        image, expected = both(values, camera, method="trilinear", field=kept, **scene)
        assert image.isfinite().all()
        assert_same((image, expected))


def test_flat_fields_have_only_the_ambient_term() -> None:
    for dtype in (torch.float32, torch.float64):
        images = both(torch.full((5, 5, 5), 0.4, dtype=dtype), method="trilinear", shading=LIT, dtype=dtype)
        assert_same(images)


def test_normals_do_not_depend_on_the_scale_of_the_field() -> None:
    for scale in (1e-30, 1e30):
        transfer = TransferFunction(SOFT.positions * scale, SOFT.colors, SOFT.opacities, 9.0)
        assert_same(both(samples() * scale, transfer=transfer, shading=LIT))


@pytest.mark.parametrize("lights", [0, 1, 3])
def test_any_number_of_lights(lights: int) -> None:
    chosen = [Light((0.0, 1.0, 0.2), (0.2, 0.3, 0.4)), Light(None, (0.5, 0.1, 0.2)), Light((1.0, 0.0, 0.0))][:lights]
    shading = Shading(chosen, ambient=0.4, diffuse=0.5, specular=0.6, shininess=5.3)
    assert_same(both(samples(torch.float64), shading=shading, dtype=torch.float64))


@pytest.mark.parametrize("stored", [torch.float16, torch.bfloat16, torch.uint8, torch.int16, torch.float64])
def test_coefficients_are_read_as_they_are_stored(stored: torch.dtype) -> None:
    values = (samples() * 200).to(stored)
    transfer = TransferFunction(SOFT.positions * 200, SOFT.colors, SOFT.opacities, 9.0)
    assert_same(both(values, transfer=transfer, method="catmull-rom"))


def test_batched_fields_give_their_images() -> None:
    batch = torch.stack([samples() * s for s in (1.0, 0.8, 0.6, 0.4)]).reshape(2, 2, 9, 12, 10)
    images = both(turned(batch), shading=LIT)
    assert images[0].shape == (2, 2, 11, 13, 4)
    assert_same(images)
    one, _ = both(turned(batch[1, 0]), shading=LIT)
    assert torch.equal(images[0][1, 0], one)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_memory_threads_and_neighbours_change_no_bit(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    field = reconstruct(turned(samples(dtype)), scheme="fused")
    scene = {**SCENE, "shading": LIT, "dtype": dtype, "jitter_seed": 9, "termination": 0.01}
    expected = render(field, camera_for(field), PEAKS, **scene)
    monkeypatch.setattr(driver, "RAYS_AT_ONCE", 37)
    threads = torch.get_num_threads()
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            for memory in (2**28, 2**16):
                assert torch.equal(render(field, camera_for(field), PEAKS, **scene, memory=memory), expected)
    finally:
        torch.set_num_threads(threads)
    zoomed = camera_for(field, window=(0.25, 0.25, 0.75, 0.75))
    whole = render(field, camera_for(field), PEAKS, **{**scene, "size": (24, 16), "jitter_seed": None})
    part = render(field, zoomed, PEAKS, **{**scene, "size": (12, 8), "jitter_seed": None})
    assert torch.equal(part, whole[4:12, 6:18])


def test_progress_is_reported_along_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "RAYS_AT_ONCE", 50)
    seen: list[tuple[int, int]] = []
    field = reconstruct(samples(), scheme="fused")
    render(field, camera_for(field), SOFT, **SCENE, progress=lambda done, total: seen.append((done, total)))
    assert len(seen) >= 3
    assert seen == sorted(seen)
    assert seen[-1][0] == seen[-1][1] > 143


def test_what_cannot_be_fused_is_marched_plainly(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bool] = []
    march = PlainMarcher.march
    monkeypatch.setattr(PlainMarcher, "march", lambda self, *rest: asked.append(True) or march(self, *rest))
    many = Shading([Light((1.0, float(k), 0.0)) for k in range(9)])
    fields = [
        (reconstruct(samples(), scheme="direct"), None),
        (reconstruct(samples(), scheme="sampled"), None),
        (signals.gaussian(), None),
        (reconstruct(samples(), scheme="fused"), many),
    ]
    for count, (field, shading) in enumerate(fields, 1):
        assert render(field, camera_for(field), SOFT, **SCENE, shading=shading).isfinite().all()
        assert len(asked) == count
    render(reconstruct(samples(), scheme="fused"), camera_for(fields[0][0]), SOFT, **SCENE)
    assert len(asked) == len(fields)


# --- derivatives ------------------------------------------------------------------------------------------------------

X = [0.0, 0.4, 1.0]
RGB = [[0.2, 0.3, 0.9], [0.8, 0.5, 0.1], [0.4, 0.9, 0.3]]
ALPHA = [0.1, 0.3, 0.8]


def parameter(value) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64).clone().requires_grad_()


def scene_parameters(alpha=ALPHA, volume: Tensor | None = None) -> dict[str, Tensor]:
    values = {
        "volume": samples(torch.float64, (5, 6, 7)) if volume is None else volume,
        "position": [-1.0, -3.0, 1.5],
        "target": [1.6, 1.1, -0.3],
        "positions": X,
        "colors": RGB,
        "opacities": alpha,
        "background": [0.3, 0.6, 0.9],
        "light": [1.0, -2.0, 1.0],
        "tint": [1.0, 0.8, 0.6],
        "weights": [0.2, 0.7, 0.3],
        "shininess": 6.0,
    }
    return {name: parameter(value) for name, value in values.items()}


def image_of(p: dict[str, Tensor], method="triquadratic", scheme="fused", lit=True, dtype=torch.float64, **changes):
    volume = Volume(p["volume"].to(dtype), spacing=(0.5, 1.0, 0.8), origin=(1.0, 0.0, -1.0))
    gradient = changes.pop("gradient", None)
    field = reconstruct(volume, method, scheme=scheme, gradient=gradient)
    camera = PerspectiveCamera(position=p["position"], target=p["target"], field_of_view=40.0)
    lights = (Light(p["light"], p["tint"]), Light(None, (0.3, 0.4, 0.5)))
    shading = Shading(lights, *p["weights"], p["shininess"])
    return render(
        field,
        camera,
        TransferFunction(p["positions"], p["colors"], p["opacities"]),
        **{"size": (9, 8), "step": 0.6, "jitter_seed": 2, **changes},
        dtype=dtype,
        background=p["background"],
        shading=shading if lit else None,
    )


def derivatives(p: dict[str, Tensor], names: list[str], **scene) -> dict[str, Tensor]:
    """Of a sum of all numbers of the image with fixed random weights."""
    image = image_of(p, **scene)
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(1)) - 0.3
    found = torch.autograd.grad((image * weights).sum(), [p[name] for name in names])
    return dict(zip(names, found, strict=True))


UNLIT = ["volume", "position", "target", "positions", "colors", "opacities", "background"]
ALL = [*UNLIT, "light", "tint", "weights", "shininess"]


def only_fused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PlainMarcher, "march", None)


@pytest.mark.parametrize(
    ("method", "gradient", "lit"),
    [
        ("trilinear", "central", True),
        ("ncrsi", "analytic", True),
        ("triquadratic", "analytic", True),
        ("tricubic", "analytic", False),
    ],
)
def test_derivatives_in_everything(method, gradient, lit, monkeypatch) -> None:
    p, names = scene_parameters(), ALL if lit else UNLIT
    scene = {"method": method, "gradient": gradient, "lit": lit}
    expected = derivatives(p, names, **scene, scheme="direct")
    only_fused(monkeypatch)
    found = derivatives(p, names, **scene)
    for name in names:
        scale = expected[name].abs().max()
        assert scale > 1e-4
        torch.testing.assert_close(found[name], expected[name], rtol=0, atol=float(1e-12 * scale), msg=name)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("method", "lit"), [("trilinear", False), ("triquadratic", True)])
def test_float32_derivatives_are_those_of_numbers_a_few_roundings_off(method, lit, seed, monkeypatch) -> None:
    """4 at most; of 48 scenes the worst took 1.6. Near a zero gradient normals turn, and a rounding moves much."""
    only_fused(monkeypatch)
    p, names = scene_parameters(volume=seeded(seed, 5, 6, 7)), ALL if lit else UNLIT

    def exact(*values: Tensor) -> list[Tensor]:
        return list(
            derivatives(dict(zip(p, map(parameter, values), strict=True)), names, method=method, lit=lit).values()
        )

    found = derivatives(p, names, method=method, lit=lit, dtype=torch.float32)
    moved = laws.moved_by_rounding(exact, [value.detach() for value in p.values()])
    for name, (expected, limit) in zip(names, moved, strict=True):
        assert limit < 1e-4 * float(expected.abs().max())
        torch.testing.assert_close(found[name], expected, rtol=0, atol=4 * limit, msg=name)


@pytest.mark.parametrize("name", ALL)
def test_derivatives_in_one_thing_alone(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs that compute less give the same."""
    p = scene_parameters()
    expected = derivatives(p, ALL)[name]
    alone = {other: value if other == name else value.detach() for other, value in p.items()}
    only_fused(monkeypatch)
    torch.testing.assert_close(derivatives(alone, [name])[name], expected, rtol=1e-12, atol=1e-13)


def test_gradcheck_of_the_fused_adjoint(monkeypatch: pytest.MonkeyPatch) -> None:
    only_fused(monkeypatch)
    p = scene_parameters(volume=samples(torch.float64, (2, 3, 2)))

    def image(*values: Tensor) -> Tensor:
        return image_of(dict(zip(p, values, strict=True)), size=(2, 2), method="tricubic")

    assert image(*p.values())[..., 3].max() > 0.1
    assert torch.autograd.gradcheck(image, tuple(p.values()))


def test_second_derivatives_come_from_the_plain_marcher() -> None:
    p = scene_parameters()

    def second(scheme: str) -> tuple[Tensor, ...]:
        image = image_of(p, scheme=scheme)
        first = torch.autograd.grad(image.square().sum(), [p[n] for n in ALL], create_graph=True)
        return torch.autograd.grad(sum((g * g.detach().cos()).sum() for g in first), [p[n] for n in ALL])

    for a, b in zip(second("fused"), second("direct"), strict=True):
        assert b.abs().max() > 1e-5
        torch.testing.assert_close(a, b, rtol=0, atol=1e-11 * float(b.abs().max()))


def test_derivatives_in_transparent_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is seen there, but a control point's opacity could be raised."""
    p = scene_parameters([0.0, 0.0, 0.8])
    expected = derivatives(p, ALL, scheme="direct")
    assert expected["opacities"][0].abs() > 1e-2
    only_fused(monkeypatch)
    for name, found in derivatives(p, ALL).items():
        torch.testing.assert_close(found, expected[name], rtol=1e-10, atol=1e-12, msg=name)


def test_derivatives_at_opaque_control_points_and_in_flat_fields(monkeypatch: pytest.MonkeyPatch) -> None:
    """α = 1 and zero gradients, as `TransferFunction` and `Shading` say; values beyond both ends of the table."""
    for volume in (torch.full((4, 4, 4), 0.5), samples(torch.float64, (4, 4, 4)) * 3 - 1):
        p = scene_parameters([0.0, 1.0, 0.9], volume)
        expected = derivatives(p, ALL, scheme="direct", method="trilinear")
        with monkeypatch.context() as patch:
            only_fused(patch)
            found = derivatives(p, ALL, method="trilinear")
        for name in ALL:
            assert found[name].isfinite().all()
            torch.testing.assert_close(found[name], expected[name], rtol=1e-9, atol=1e-11, msg=name)


def test_derivatives_at_a_control_point_are_those_to_its_right(monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for scheme in ("direct", "fused"):
        volume, positions = parameter(torch.full((4, 4, 4), 0.5)), parameter([0.0, 0.5, 1.0])
        transfer = TransferFunction(positions, RGB, ALPHA)
        field = reconstruct(volume, "trilinear", scheme=scheme)
        camera = OrthographicCamera.framing(field.domain, (0, 1, 0))
        with monkeypatch.context() as patch:
            if scheme == "fused":
                only_fused(patch)
            image = render(field, camera, transfer, size=(4, 4), step=0.5, dtype=torch.float64)
            results.append(torch.autograd.grad(image.square().sum(), (volume, positions)))
    for found, expected in zip(*results, strict=True):
        assert expected.abs().max() > 1e-3
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-13)


CONTROL_POINTS = {
    "even": [0.0, 0.25, 0.5, 0.75, 1.0],
    "compared": [-0.5, 0.25, 0.5, 1.0],
    "bucketed": [k * (k + 1) / 512 for k in range(20)],
}
"""Numbers that float32 has, found in each of the ways of `ops.cpu.optics.WAYS`."""


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scheme", ["direct", "fused"])
@pytest.mark.parametrize("way", CONTROL_POINTS)
def test_the_slope_at_every_control_point_is_that_to_its_right(way: str, scheme: str, dtype: torch.dtype) -> None:
    """At the last one it is that to its left. A slice for each: its rays meet that value alone, over 4 voxels."""
    x = torch.tensor(CONTROL_POINTS[way], dtype=dtype)
    alpha = torch.rand(len(x), generator=torch.Generator().manual_seed(4), dtype=torch.float64).to(dtype) / 2
    assert driver._way_to_intervals(march.Transfer(x, x.new_zeros(len(x), 3), alpha, 2.0).steps) == way
    volume = x[:, None, None].expand(-1, 2, 4).clone().requires_grad_()
    origins = torch.tensor([[-5.0, 0.5, k] for k in range(len(x))]).double()
    rays = origins, torch.tensor([[1.0, 0.0, 0.0]]).double().expand_as(origins)
    transfer = TransferFunction(x, [[1.0, 1.0, 1.0]] * len(x), alpha, 2.0)
    image = render(reconstruct(volume, "trilinear", scheme=scheme), rays, transfer, step=1.0, dtype=dtype)
    (found,) = torch.autograd.grad(image[:, 3].sum(), volume)
    exact = alpha.double()
    right = exact.diff() / x.double().diff()
    expected = 2 * (1 - exact) * torch.cat((right, right[-1:]))  # of 1 − (1 − α)²
    limit = 100 * torch.finfo(dtype).eps * float(expected.abs().max())
    torch.testing.assert_close(found.sum((1, 2)).double(), expected, rtol=0, atol=limit)


def test_derivatives_of_a_single_control_point(monkeypatch: pytest.MonkeyPatch) -> None:
    p = scene_parameters()
    p |= {name: parameter(p[name].detach()[:1]) for name in ("positions", "colors", "opacities")}
    names = ["colors", "opacities", "position"]
    expected = derivatives(p, names, scheme="direct", lit=False)
    only_fused(monkeypatch)
    for name, found in derivatives(p, names, lit=False).items():
        torch.testing.assert_close(found, expected[name], rtol=1e-11, atol=1e-12, msg=name)


@pytest.mark.parametrize("stored", [torch.float16, torch.float32])
def test_derivatives_of_stored_halves_and_batches(stored, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a volume a few roundings off; those of coefficients are rounded as they are stored, before up to eight of
    them add up to that of a sample."""

    def of(values: Tensor, dtype: torch.dtype, scheme: str = "fused") -> Tensor:
        leaf = values.clone().requires_grad_()
        field = reconstruct(turned(leaf), "catmull-rom", scheme=scheme)
        image = render(field, camera_for(field), SOFT, **SCENE, shading=LIT, dtype=dtype)
        return torch.autograd.grad(image.square().sum(), leaf)[0]

    batch = seeded(1, 2, 2, 4, 5, 4).to(stored)
    expected = of(batch.double(), torch.float64, "direct")
    only_fused(monkeypatch)
    found = of(batch, torch.float32)
    ((again, limit),) = laws.moved_by_rounding(lambda values: [of(values, torch.float64)], [batch.double()])
    scale = float(expected.abs().max())
    torch.testing.assert_close(again, expected, rtol=0, atol=1e-12 * scale)
    assert found.dtype == stored
    assert limit < 1e-4 * scale
    rounded = 8 * torch.finfo(stored).eps / 2 * scale if stored == torch.float16 else 0.0
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=4 * limit + rounded)


def test_derivatives_are_the_same_bits_for_a_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    p = scene_parameters()
    threads = torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            first, second = derivatives(p, ALL), derivatives(p, ALL)
            assert all(torch.equal(first[name], second[name]) for name in ALL)
        other = first
        torch.set_num_threads(1)
        for name, expected in derivatives(p, ALL).items():
            torch.testing.assert_close(other[name], expected, rtol=1e-11, atol=1e-13)
    finally:
        torch.set_num_threads(threads)


def test_nothing_of_a_sample_is_kept_for_the_backward_pass() -> None:
    """What autograd keeps does not grow with the number of steps."""
    kept = []
    for step in (0.6, 0.006):
        total = 0

        def pack(x: Tensor) -> Tensor:
            nonlocal total
            total += x.numel() * x.element_size()
            return x

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
            image_of(scene_parameters(), step=step)
        kept.append(total)
    assert kept[0] == kept[1] > 0
