"""The Triton adjoint of the march against the other fused one: in Triton's interpreter, on a GPU where there is one."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the package triton is not installed")

from filterlab.kernels import LINEAR, bspline
from filterlab.methods import reconstruct
from filterlab.ops import Stencil, march
from filterlab.ops.cuda import adjoint, launch, segments
from filterlab.ops.cuda import march as cuda
from filterlab.ops.differentiable import march as op
from filterlab.ops.march_derivatives import GRADIENTS
from filterlab.render import Light, PerspectiveCamera, Shading, TransferFunction, render
from filterlab.render.bricks import bricks_of
from filterlab.render.plain import PlainMarcher
from filterlab.volume import Volume
from tests.ops.test_cuda_march import LIT, SCENE, SOFT, blob, camera_for, moved, volume
from tests.ops.test_march import segment_without_length
from tests.render.test_fused import CONTROL_POINTS

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-11}
EVERYTHING = {
    "unlit": {"coefficients", "entry", "direction", "length", "positions", "colors", "opacities"},
    "lit": {"ambient", "shininess", "diffuse", "specular", "toward", "halfway"},
}


def prepared(method: str, transfer=SOFT, samples=None, dtype=torch.float64, **scene) -> march.March:
    """What `render` marches for a scene."""
    read: list[march.March] = []

    def noted(self: march.March, report=None):
        read.append(self)
        rays = self.chords.count.shape[0]
        return torch.zeros(rays, 3, dtype=torch.float64), torch.zeros(rays, dtype=torch.float64)

    field = reconstruct(volume(dtype) if samples is None else samples, method, scheme="fused")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(op, "run", noted)
        render(field, camera_for(field), transfer, **{**SCENE, "dtype": dtype, **scene})
    return replace(read[0], bricks=None)


def results(prepared: march.March) -> tuple[Tensor, Tensor, Tensor]:
    """Light, and cotangents of it and of the depth as an opacity has them: 0 of what is opaque."""
    light, depth = op.run(prepared)
    generator = torch.Generator().manual_seed(7)
    to_light, to_depth = (torch.rand(x.shape, generator=generator, dtype=x.dtype) - 0.3 for x in (light, depth))
    return light, to_light, to_depth * torch.exp(-depth)


def on_device(prepared: march.March, device: str, given: Sequence[Tensor], wanted: Collection[str] = GRADIENTS):
    """What the Triton program finds."""
    moved_to = moved(prepared, device)
    found = op.adjoint(moved_to, *(x.to(device) for x in given), wanted, implementation="cuda")
    return {name: value.cpu() for name, value in found.items()}


def assert_same(found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    assert found.keys() == expected.keys()
    for name, x in expected.items():
        assert found[name].dtype == x.dtype, name
        limit = tolerance * float(x.nan_to_num().abs().max()) if x.numel() else 0
        torch.testing.assert_close(
            found[name], x, rtol=0, atol=limit, equal_nan=True, msg=lambda text, name=name: f"{name}: {text}"
        )


def assert_agrees(prepared: march.March, device: str) -> dict[str, Tensor]:
    """With the CPU's adjoint, by everything."""
    given = results(prepared)
    found = on_device(prepared, device, given)
    expected = op.adjoint(prepared, *given, GRADIENTS)
    assert_same(found, expected, TOLERANCE[prepared.dtype])
    return found


@pytest.mark.parametrize(
    ("method", "shading", "dtype"),
    [
        ("trilinear", None, torch.float32),
        ("triquadratic", LIT, torch.float32),
        ("ncrsi", LIT, torch.float64),
        ("notch", None, torch.float64),
        ("trilinear", Shading((), ambient=0.4), torch.float64),
    ],
)
def test_equals_the_adjoint_on_the_cpu(method: str, shading: Shading | None, dtype: torch.dtype, device: str) -> None:
    found = assert_agrees(prepared(method, shading=shading, dtype=dtype, jitter_seed=3), device)
    names = EVERYTHING["unlit"] | (EVERYTHING["lit"] if shading else set())
    assert found.keys() == names
    of_lights = {"shininess", "diffuse", "specular", "toward", "halfway"} if shading and not shading.lights else set()
    for name in names - of_lights:
        assert found[name].abs().max() > 1e-6, name  # a test of zeros would be none


def test_behind_what_is_opaque(device: str) -> None:
    """α = 1 at control points: derivatives stay finite, and nothing behind has any."""
    transfer = TransferFunction([0.2, 0.5, 0.6], [[1.0, 0.5, 0.2]] * 3, [0.0, 1.0, 1.0], unit=0.1)
    marched = prepared("trilinear", transfer, shading=LIT)
    assert (op.run(marched)[1] == math.inf).any()
    assert all(x.isfinite().all() for x in assert_agrees(marched, device).values())


def test_a_coefficient_of_nan_is_nowhere_and_has_no_derivative(device: str) -> None:
    """Also where all is transparent, so that nothing else is computed."""
    samples = torch.rand((9, 9, 9), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    marched = prepared("trilinear", samples=samples, size=(9, 8))
    clear = prepared("trilinear", TransferFunction([0.0, 2.0], [[1.0] * 3] * 2, [0.0, 0.0]), samples, size=(9, 8))
    for one in (marched, clear):
        one.coefficients[tuple(k - one.start for k in (4, 6, 5))] = math.nan
    found = assert_agrees(marched, device)
    assert all(x.isfinite().all() for x in found.values())
    assert found["coefficients"][marched.coefficients.isnan()].tolist() == [0]
    light, *_ = given = results(clear)
    assert not light.any()
    assert not on_device(clear, device, given, ["rays"])["entry"].any()


def test_lanes_without_a_ray_and_rays_that_have_ended_add_nothing(device: str) -> None:
    """The first stand at 0, the others at their end: the volume is NaN there. Neighbours go on."""
    marched = prepared("trilinear")
    nan = tuple(slice(k - marched.start, None) for k in (2, 4, 3))
    marched.coefficients[nan] = math.nan
    marched.coefficients[(-marched.start,) * 3] = math.nan
    entry, along = torch.tensor([[1, 0.5, 1], [3.5, 0, 2.5]]).double(), torch.tensor([[0, 1, 0], [0, 1, 0]]).double()
    length, offset, count = torch.tensor([5.0, 3.0]).double(), torch.ones(2).double(), torch.tensor([5, 3])
    found = assert_agrees(replace(marched, chords=march.Chords(entry, along, length, offset, count), step=1.0), device)
    assert all(x.isfinite().all() for x in found.values())
    assert found["opacities"].abs().min() > 1e-3


@pytest.mark.parametrize("points", [1, 2, 6])
def test_any_number_of_control_points(points: int, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segments, "BLOCK", 4)  # three programs that share two tables
    monkeypatch.setattr(adjoint, "TABLES", 2)
    x = torch.linspace(0.2, 0.8, points, dtype=torch.float64)
    generator = torch.Generator().manual_seed(points)
    rgb, alpha = (torch.rand(points, *more, generator=generator, dtype=torch.float64) for more in ((3,), ()))
    found = assert_agrees(prepared("trilinear", TransferFunction(x, rgb, alpha, 0.5), size=(4, 3)), device)
    assert found["opacities"].shape == (points,)
    assert found["opacities"].abs().min() > 1e-3


@pytest.mark.parametrize("way", CONTROL_POINTS)
def test_at_a_control_point_derivatives_are_those_to_its_right(way: str, device: str) -> None:
    """Where values are exactly those of control points, a slice for each."""
    x = torch.tensor(CONTROL_POINTS[way], dtype=torch.float64)
    alpha = torch.rand(len(x), generator=torch.Generator().manual_seed(4), dtype=torch.float64) / 2
    transfer = TransferFunction(x, torch.rand(len(x), 3).double(), alpha, 2.0)
    marched = prepared("trilinear", transfer, x[:, None, None].expand(-1, 2, 4).clone())
    entry = torch.tensor([[-0.5, 0.5, k] for k in range(len(x))]).double()
    ones = torch.ones(len(x), dtype=torch.float64)
    along = torch.tensor([[1.0, 0.0, 0.0]]).double().expand_as(entry)
    chords = march.Chords(entry, along, 4 * ones, ones, torch.full((len(x),), 4))
    found = assert_agrees(replace(marched, chords=chords, step=1.0), device)
    assert (found["coefficients"].abs().sum((1, 2)) > 1e-3).sum() == len(x)


def test_a_segment_without_length_adds_nothing_however_opaque(device: str) -> None:
    marched = segment_without_length()
    found = assert_agrees(moved(marched, "cpu"), device)
    assert all(x.isfinite().all() for x in found.values())
    light, depth = (x.cpu() for x in op.run(moved(marched, device), implementation="cuda"))
    assert depth.item() == pytest.approx(-3 * math.log1p(-0.25), rel=1e-14)
    assert light.tolist() == [pytest.approx([1 - 0.75**3] * 3, rel=1e-14)]


def test_a_transparent_interval_counts_for_the_table_and_nothing_else(device: str) -> None:
    marched = prepared("trilinear", TransferFunction(SOFT.positions, SOFT.colors, [0.0, 0.0, 0.4], 0.2))
    found = assert_agrees(marched, device)
    assert found["opacities"][0].abs() > 1e-3
    given = results(marched)
    alone = on_device(marched, device, given, ["coefficients"])
    assert_same(alone, {"coefficients": found["coefficients"]}, 1e-14)


def test_what_is_not_asked_is_not_computed(device: str) -> None:
    """One by one the same numbers, from programs that do less."""
    marched = prepared("trilinear", shading=LIT, size=(3, 2))
    given = results(marched)
    everything = on_device(marched, device, given)
    for name, words in {
        "coefficients": ("slope", "held", "_sum_", "to_end", "to_view"),
        "rays": ("atomic_add", "held", "view_sum", "to_end"),
        "table": ("cell, ", "slope", "_sum_", "to_row", "to_view"),
        "shading": ("atomic_add", "slope", "entry_sum", "to_end", "to_tau", "to_row"),
    }.items():
        found = on_device(marched, device, given, [name])
        assert_same(found, {key: everything[key] for key in found}, 1e-14)
        assert found
        text = str(cuda._variant_of_adjoint(marched, (name,)).write())
        assert not [word for word in words if word in text], name
    assert on_device(marched, device, given, []) == {}


def test_empty_space_is_left_out_and_changes_no_derivative(device: str) -> None:
    """Two bricks from all that is not empty no coefficient counts: NaN there shows nowhere."""
    transfer = TransferFunction([0.0, 0.1, 1.2], SOFT.colors, [0.0, 0.0, 0.9])
    marched = prepared("triquadratic", transfer, blob(), size=(4, 3), step=2.0, shading=LIT)
    given = results(marched)
    wanted = ["coefficients", "rays", "shading"]
    expected = on_device(marched, device, given, wanted)
    bricks = bricks_of(marched.coefficients, marched.stencil, transfer, edge=2)
    assert bricks is not None
    far = bricks.distance >= 2
    assert far.double().mean() > 0.05
    for dim in range(3):
        far = far.repeat_interleave(4, dim)
    grid = marched.coefficients.clone()
    grid[tuple(slice(n) for n in far.shape)][far[tuple(slice(n) for n in grid.shape)]] = math.nan
    found = on_device(replace(marched, coefficients=grid, bricks=bricks), device, given, wanted)
    for name, x in expected.items():
        assert torch.equal(found[name], x), name
    assert expected["coefficients"].abs().max() > 1e-3


@pytest.mark.parametrize("stored", [torch.float16, torch.int16])
def test_coefficients_are_read_as_they_are_stored(stored: torch.dtype, device: str) -> None:
    transfer = TransferFunction(SOFT.positions * 200, SOFT.colors, SOFT.opacities, 0.2)
    marched = prepared("trilinear", transfer, dtype=torch.float32, size=(3, 2))
    grid = (torch.rand(marched.coefficients.shape, generator=torch.Generator().manual_seed(2)) * 200).to(stored)
    assert assert_agrees(replace(marched, coefficients=grid), device)["coefficients"].dtype == torch.float32


def test_no_rays(device: str) -> None:
    marched = prepared("trilinear", shading=LIT, size=(3, 2))
    parts = {k: v[:0] for k, v in vars(marched.chords).items()}
    lighting = replace(marched.lighting, toward=marched.lighting.toward[:0], halfway=marched.lighting.halfway[:0])
    none = replace(marched, chords=march.Chords(**parts), lighting=lighting)
    found = on_device(none, device, results(none))
    assert found["entry"].shape == (0, 3)
    assert not any(x.any() for x in found.values())


# --- through render ---------------------------------------------------------------------------------------------------


def _parameters(device: str) -> dict[str, Tensor]:
    values = {
        "volume": torch.rand((4, 5, 4), generator=torch.Generator().manual_seed(1)),
        "position": [-1.0, -3.0, 1.5],
        "positions": SOFT.positions,
        "colors": SOFT.colors,
        "opacities": [0.1, 0.3, 0.8],
        "light": [1.0, -2.0, 1.0],
        "weights": [0.2, 0.7, 0.3],
        "shininess": 6.0,
    }
    return {
        k: torch.as_tensor(v, dtype=torch.float64, device=device).clone().requires_grad_() for k, v in values.items()
    }


def _derivatives(device: str, scheme: str) -> dict[str, Tensor]:
    p = _parameters(device)
    field = reconstruct(Volume(p["volume"], spacing=(0.5, 1.0, 0.8)), "triquadratic", scheme=scheme)
    camera = PerspectiveCamera(position=p["position"], target=(0.7, 2.0, 1.2), field_of_view=30.0)
    shading = Shading((Light(p["light"]), Light(None, (0.3, 0.4, 0.5))), *p["weights"], p["shininess"])
    transfer = TransferFunction(p["positions"], p["colors"], p["opacities"])
    scene = {"size": (4, 3), "shading": shading, "dtype": torch.float64, "device": device}
    image = render(field, camera, transfer, **scene)
    weights = torch.linspace(-0.3, 0.7, image.numel(), dtype=torch.float64, device=device).reshape(image.shape)
    return dict(zip(p, torch.autograd.grad((image * weights).sum(), list(p.values())), strict=True))


def test_derivatives_of_an_image_are_the_plain_marchers(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """And come from it where torch is told to be deterministic: atomic additions are not."""
    expected = _derivatives(device, "direct")
    if device == "cpu":  # the interpreter's tensors are
        monkeypatch.setattr(op, "implementation_for", lambda tensor: "cuda")
    plainly, plain = [], PlainMarcher.march
    monkeypatch.setattr(PlainMarcher, "march", lambda *a: (plainly.append(1), plain(*a))[1])
    found = _derivatives(device, "fused")
    assert not plainly
    assert_same(found, expected, 1e-11)
    assert min(x.abs().max() for x in found.values()) > 1e-3
    monkeypatch.setattr(cuda, "adjoint", None)
    torch.use_deterministic_algorithms(True)
    try:
        assert_same(_derivatives(device, "fused"), expected, 1e-11)
    finally:
        torch.use_deterministic_algorithms(False)
    assert plainly


# --- compilation ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stencil", "lights", "number", "stored", "taps"),
    [
        (Stencil.jet(LINEAR, 1), 1, "fp32", "fp16", 8),
        (Stencil.jet(bspline(2), 0), None, "fp64", "i16", 27),  # in loops over planes
    ],
    ids=["lit", "unlit"],
)
def test_compiles_for_a_gpu_that_need_not_be_there(
    stencil: Stencil, lights: int | None, number: str, stored: str, taps: int, monkeypatch: pytest.MonkeyPatch, tmp_path
) -> None:
    """The interpreter takes what the compiler would refuse; machine code needs no GPU to be made."""
    from triton.backends.compiler import GPUTarget  # pyright: ignore[reportMissingImports]
    from triton.compiler import ASTSource, compile  # pyright: ignore[reportMissingImports]

    monkeypatch.setenv("TRITON_INTERPRET", "0")
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    derivatives, raised = stencil.derivatives
    slopes = (derivatives.lowered, raised)
    variant = adjoint.AdjointVariant(GRADIENTS, stencil.lowered, slopes, lights, skipping=True, even=False)
    types = dict.fromkeys(segments.arrays_of(variant), "*fp64")
    numbers = ("inner", "opacities", "colors", "shading", "view", "world", "coefficient_gradient")
    types |= dict.fromkeys(numbers, f"*{number}")
    types |= {"coefficients": f"*{stored}", "count": "*i64", "bricks": "*u8", "BLOCK": "constexpr"}
    written = launch.launchable(variant.write())
    signature = {p.name: types.get(p.name, "i32") for p in written.params}
    source = ASTSource(written, signature, {"BLOCK": segments.BLOCK})
    made = compile(source, target=GPUTarget("cuda", 80, 32), options={"num_warps": 1})
    lines = made.asm["ptx"].splitlines()
    assert not [line for line in lines if "bar.sync" in line]  # one warp waits for nobody
    assert sum("atom.global" in line for line in lines) == taps + 2 * 10  # what is held is let go in two places
