"""The Triton march against the plain marcher: in Triton's interpreter everywhere, on a GPU where there is one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the package triton is not installed")

from filterlab.kernels import LINEAR, bspline
from filterlab.methods import reconstruct
from filterlab.ops import Stencil, march
from filterlab.ops.cuda import compositing, launch, segments
from filterlab.ops.cuda import march as cuda
from filterlab.ops.differentiable import march as op
from filterlab.render import Light, OrthographicCamera, PerspectiveCamera, Shading, TransferFunction, render
from filterlab.render.bricks import bricks_of
from filterlab.volume import Volume

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}
LIT = Shading((Light((1.0, -2.0, 1.0)), Light(None, (0.3, 0.4, 0.5))), ambient=0.3)
SOFT = TransferFunction(
    [0.1, 0.4, 0.9], [[0.2, 0.3, 0.9], [0.8, 0.5, 0.1], [0.4, 0.9, 0.3]], [0.01, 0.3, 0.1], unit=0.2
)
SCENE = {"size": (7, 5), "step": 1.0, "background": (0.1, 0.2, 0.3)}  # 35 rays: more than a program has


def moved(prepared: march.March, device: str) -> march.March:
    """A march with all its tensors on a device."""

    def on_device(part):
        tensors = {k: v.to(device) for k, v in vars(part).items() if isinstance(v, Tensor)}
        return replace(part, **tensors)

    parts = {k: on_device(v) for k in ("chords", "transfer", "lighting", "bricks") if (v := getattr(prepared, k))}
    return replace(prepared, coefficients=prepared.coefficients.to(device), **parts)


def image(field, camera, transfer: TransferFunction, device: str, change=lambda prepared: prepared, **scene) -> Tensor:
    """What the Triton march renders; `change` may change what is marched."""

    def run(prepared: march.March, report=lambda rays: None):
        return tuple(x.cpu() for x in cuda.march(change(moved(prepared, device)), report))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(op, "run", run)
        return render(field, camera, transfer, **{**SCENE, **scene})


def volume(dtype: torch.dtype = torch.float64) -> Volume:
    """Stretched, flipped and turned."""
    c, s = math.cos(0.5), math.sin(0.5)
    affine = np.eye(4)
    affine[:3] = [[0.1 * c, -0.1 * s, 0, 1], [0.1 * s, 0.1 * c, 0, 2], [0, 0, -0.2, 3]]
    values = torch.rand((5, 7, 6), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return Volume(values.to(dtype), affine=affine)


def camera_for(field) -> PerspectiveCamera:
    return PerspectiveCamera.framing(field.domain, (0.4, 0.8, -0.45))


def both(device: str, method: str, transfer=SOFT, samples=None, **scene) -> tuple[Tensor, Tensor]:
    """A scene by the Triton march and by the plain marcher."""
    samples = volume(scene.get("dtype", torch.float64)) if samples is None else samples
    fields = [reconstruct(samples, method, scheme=scheme) for scheme in ("fused", "direct")]
    camera = camera_for(fields[0])
    return image(fields[0], camera, transfer, device, **scene), render(
        fields[1], camera, transfer, **{**SCENE, **scene}
    )


def assert_same(images: tuple[Tensor, Tensor]) -> None:
    actual, expected = images
    assert actual.dtype == expected.dtype
    torch.testing.assert_close(actual, expected, rtol=0, atol=TOLERANCE[actual.dtype])


@pytest.mark.parametrize(
    ("method", "shading", "dtype"),
    [
        ("trilinear", None, torch.float32),
        ("triquadratic", LIT, torch.float32),
        ("ncrsi", LIT, torch.float64),
        ("notch", None, torch.float64),
    ],
)
def test_equals_the_plain_marcher(method: str, shading: Shading | None, dtype: torch.dtype, device: str) -> None:
    images = both(device, method, shading=shading, dtype=dtype, jitter_seed=3)
    assert_same(images)
    assert 0.3 < images[0][..., 3].max() < 0.999
    assert images[0][..., 3].min() == 0  # some rays miss


def test_ends_behind_what_is_opaque(device: str) -> None:
    transfer = TransferFunction([0.2, 0.5, 0.6], [[1.0, 0.5, 0.2]] * 3, [0.0, 1.0, 1.0], unit=0.1)
    read = []

    def noted(prepared: march.March) -> march.March:
        read.append(prepared)
        return prepared

    field = reconstruct(volume(), "trilinear", scheme="fused")
    shown = image(field, camera_for(field), transfer, device, noted, dtype=torch.float64)
    assert_same((shown, render(field, camera_for(field), transfer, **SCENE, dtype=torch.float64)))
    assert shown[..., 3].max() == 1
    _, depth = (x.cpu() for x in cuda.march(read[0]))
    assert (depth == math.inf).any()


@pytest.mark.parametrize("points", [1, 2, 6])
def test_any_number_of_control_points(points: int, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segments, "BLOCK", 4)  # and of programs: one for every row of the image
    x = torch.linspace(0.2, 0.8, points, dtype=torch.float64)
    generator = torch.Generator().manual_seed(points)
    rgb, alpha = (torch.rand(points, *more, generator=generator, dtype=torch.float64) for more in ((3,), ()))
    transfer = TransferFunction(x, rgb, alpha, 0.5)
    images = both(device, "trilinear", transfer, size=(4, 3), dtype=torch.float64)
    assert_same(images)
    assert images[0][1, :, 3].max() > 0.1


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
def test_a_table_of_equal_steps(dtype: torch.dtype, device: str) -> None:
    """As look-up tables have: the interval is computed, also of values at its ends, beyond both, and of NaN."""
    x, generator = torch.linspace(0.25, 0.75, 5, dtype=torch.float64), torch.Generator().manual_seed(5)
    rgb, alpha = (torch.rand(5, *more, generator=generator, dtype=torch.float64) for more in ((3,), ()))
    transfer = TransferFunction(x, rgb, alpha, 0.5)
    samples = torch.randint(0, 9, (5, 6, 7), generator=generator).to(dtype) / 8
    samples[2, 3, 3] = math.nan
    read = []
    field = reconstruct(samples, "trilinear", scheme="fused", nan="propagate")
    scene = {"size": (6, 5), "dtype": dtype, "step": 1.0}
    camera = OrthographicCamera.framing(field.domain, (0, 1, 0))  # samples are met exactly
    shown = image(field, camera, transfer, device, lambda prepared: (read.append(prepared), prepared)[1], **scene)
    assert all(prepared.transfer.even is not None for prepared in read)
    plain = reconstruct(samples, "trilinear", scheme="direct", nan="propagate")
    expected = render(plain, camera, transfer, **{**SCENE, **scene})
    torch.testing.assert_close(shown, expected, rtol=0, atol=TOLERANCE[dtype])
    assert shown.isfinite().all()


@pytest.mark.parametrize(("method", "gradient"), [("triquadratic", "analytic"), ("trilinear", "central")])
@pytest.mark.parametrize("shading", [None, LIT], ids=["unlit", "lit"])
def test_what_is_missing_is_transparent(method: str, gradient: str, shading: Shading | None, device: str) -> None:
    samples = torch.rand((7, 6, 7), generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    samples[4:, 3, 3] = samples[:2, :, :3] = math.nan
    fields = [
        reconstruct(samples, method, scheme=scheme, gradient=gradient, nan=nan)
        for scheme, nan in (("fused", "propagate"), ("direct", "propagate"), ("direct", "fill"))
    ]
    scene = {"size": (6, 5), "dtype": torch.float64, "shading": shading}
    shown = image(fields[0], camera_for(fields[0]), SOFT, device, **scene)
    there, filled = (render(field, camera_for(field), SOFT, **{**SCENE, **scene}) for field in fields[1:])
    assert_same((shown, there))
    assert ((filled - shown)[..., 3] > 1e-3).sum() > 3


def test_faint_segments_have_no_weight(device: str) -> None:
    """As in the other fused march, which has the same rule for every segment, but ends rays pack by pack."""
    field = reconstruct(volume(), "trilinear", scheme="fused")
    scene = {**SCENE, "dtype": torch.float64, "step": 0.5, "size": (4, 3), "termination": 0.2}
    scene["background"] = (0, 0, 0)
    dense = TransferFunction(SOFT.positions, SOFT.colors, SOFT.opacities, unit=0.05)
    shown = image(field, camera_for(field), dense, device, **scene)
    assert_same((shown[..., :3], render(field, camera_for(field), dense, **scene)[..., :3]))
    full = image(field, camera_for(field), dense, device, **{**scene, "termination": None})
    assert 1e-2 < (full - shown)[..., :3].max() < 0.2
    assert 1e-2 < (full - shown)[..., 3].max() < 0.2


@pytest.mark.parametrize("opacity", [1e-9, 1e-6])
def test_a_thin_medium_keeps_its_digits(opacity: float, device: str) -> None:
    """1 − (1 − α)⁴ over 4 voxels, of which 1 − exp(log(1 − α)) in float32 would know little or nothing."""
    field = reconstruct(torch.full((4, 4, 4), 0.5), "trilinear", scheme="fused")
    camera = OrthographicCamera.framing(field.domain, (0, 1, 0))
    transfer = TransferFunction([0.0, 1.0], [[1.0, 1.0, 1.0]] * 2, [opacity] * 2)
    shown = image(field, camera, transfer, device, size=(3, 3), shading=Shading(ambient=0.5), background=(0, 0, 0))
    alpha = -math.expm1(4 * math.log1p(-opacity))
    expected = torch.tensor([alpha / 2] * 3 + [alpha])  # where the gradient is 0 only the ambient part is left
    torch.testing.assert_close(shown[1, 1], expected, rtol=1e-5, atol=0)


def blob() -> Tensor:
    """A bright corner in an empty volume."""
    values = torch.zeros(24, 20, 22, dtype=torch.float64)
    values[2:11, 3:12, 12:20] = 0.2 + torch.rand(9, 9, 8, dtype=torch.float64)
    return values


def test_empty_space_is_left_out_and_changes_no_bit(device: str) -> None:
    field = reconstruct(blob(), "triquadratic", scheme="fused")
    camera = OrthographicCamera.framing(field.domain, (0.5, 0.6, -0.6))
    transfer = TransferFunction([0.0, 0.1, 1.2], SOFT.colors, [0.0, 0.0, 0.9])
    scene = {"size": (5, 4), "step": 2.0, "shading": LIT, "dtype": torch.float64}

    def poisoned(prepared: march.March) -> march.March:
        """Two bricks from all that is not empty no coefficient counts: NaN there shows nowhere."""
        grid = prepared.coefficients.detach().cpu()
        bricks = bricks_of(grid, prepared.stencil, transfer, edge=2)
        assert bricks is not None
        far = bricks.distance >= 2
        assert (bricks.distance > 2).double().mean() > 0.05
        for dim in range(3):
            far = far.repeat_interleave(4, dim)
        grid = grid.clone()
        inside = tuple(slice(n) for n in far.shape)
        grid[inside][far[tuple(slice(n) for n in grid.shape)]] = math.nan
        return moved(replace(prepared, coefficients=grid, bricks=bricks), device)

    skipped = image(field, camera, transfer, device, poisoned, **scene)
    assert skipped[..., 3].max() > 0.5
    everything = image(field, camera, transfer, device, lambda prepared: replace(prepared, bricks=None), **scene)
    assert torch.equal(everything, skipped)


def test_no_rays(device: str) -> None:
    field = reconstruct(volume(), "trilinear", scheme="fused")
    none = torch.zeros(0, 3, dtype=torch.float64)
    assert image(field, (none, none), SOFT, device, size=None).shape == (0, 4)


def test_compiles_for_a_gpu_that_need_not_be_there(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    """The interpreter takes what the compiler would refuse; machine code needs no GPU to be made."""
    from triton.backends.compiler import GPUTarget  # pyright: ignore[reportMissingImports]
    from triton.compiler import ASTSource, compile  # pyright: ignore[reportMissingImports]

    monkeypatch.setenv("TRITON_INTERPRET", "0")
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    types = dict.fromkeys(("coefficients", "inner", "opacities", "colors", "shading", "view", "world"), "*fp32")
    types |= dict.fromkeys(("entry", "direction", "length", "offset", "numbers", "light", "optical_depth"), "*fp64")
    types |= {"count": "*i64", "bricks": "*u8", "BLOCK": "constexpr"}
    written = launch.launchable(
        compositing.MarchVariant(Stencil.jet(LINEAR, 1).lowered, 1, skipping=True, even=True).write()
    )
    source = ASTSource(written, {p.name: types.get(p.name, "i32") for p in written.params}, {"BLOCK": segments.BLOCK})
    made = compile(source, target=GPUTarget("cuda", 80, 32), options={"num_warps": 1})
    assert "bar.sync" not in made.asm["ptx"]  # one warp waits for nobody


def test_what_a_scene_does_not_ask_for_is_not_computed() -> None:
    unlit = str(compositing.MarchVariant(Stencil.jet(LINEAR, 0).lowered, None, skipping=False, even=False).write())
    lit = str(compositing.MarchVariant(Stencil.jet(LINEAR, 1).lowered, 2, skipping=True, even=False).write())
    for word in ("row_1", "world", "view", "shading", "bricks +", "leap"):
        assert word in lit
        assert word not in unlit


def test_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    grid, stencil = torch.zeros(4, 4, 4), Stencil.jet(LINEAR, 1)
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    monkeypatch.setattr(op, "implementation_for", lambda tensor: "cuda")
    assert op.missing(grid, stencil, 0, torch.float32, 1) is None
    assert "up to 8 lights; got 9" in str(op.missing(grid, stencil, 0, torch.float32, 9))
    assert "supports go up to 6; got 7" in str(op.missing(grid, Stencil.jet(bspline(6), 0), 0, torch.float32, 0))
    assert "got torch.float16" in str(op.missing(grid, stencil, 0, torch.float16, 0))
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    assert "tensors of a GPU" in str(op.missing(grid, stencil, 0, torch.float32, 0))


@pytest.mark.parametrize("shading", [None, LIT])
def test_render_marches_there(shading: Shading | None, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """`render` itself, with a volume on the device."""
    if device == "cpu":  # the interpreter's tensors are
        monkeypatch.setattr(op, "implementation_for", lambda tensor: "cuda")
    ran = []
    monkeypatch.setattr(cuda, "march", lambda *a, run=cuda.march: (ran.append(1), run(*a))[1])
    samples = blob().to(device)
    fields = [reconstruct(samples, "triquadratic", scheme=scheme) for scheme in ("fused", "direct")]
    transfer = TransferFunction([0.0, 0.1, 1.2], SOFT.colors, [0.0, 0.0, 0.9])
    scene = {**SCENE, "size": (4, 3), "shading": shading, "dtype": torch.float64, "device": device}
    camera = OrthographicCamera.framing(fields[0].domain, (0.5, 0.6, -0.6))
    fused, plain = (render(field, camera, transfer, **scene) for field in fields)
    assert ran
    assert_same((fused, plain))
    assert fused[..., 3].max() > 0.5
