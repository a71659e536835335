"""resample: separable passes give what the field gives point by point, on the grid that was asked for."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from itertools import product

import numpy as np
import pytest
import torch

from filterlab.kernels import bc
from filterlab.methods import METHODS, reconstruct
from filterlab.resampling import resample
from filterlab.volume import Boundary, Volume
from tests import laws, oracles, resident
from tests.pairs import in_pairs
from tests.test_volume import rotated

every_method = pytest.mark.parametrize("method", METHODS)
every_boundary = pytest.mark.parametrize("boundary", Boundary)
pytestmark = pytest.mark.filterwarnings("ignore::filterlab.resampling.AliasingWarning")  # grids are coarser on purpose


def volume(*shape: int) -> torch.Tensor:
    return torch.as_tensor(np.random.default_rng(0).uniform(-1, 1, shape or (5, 7, 6)))


def centres(grid: Volume) -> torch.Tensor:
    """World positions of all voxel centres, (D, H, W, 3)."""
    z, y, x = np.indices(grid.shape[-3:])
    return grid.voxel_to_world(torch.as_tensor(np.stack([x, y, z], -1).astype(float)))


@pytest.mark.parametrize(("method", "boundary", "prefilter"), in_pairs(product(METHODS, Boundary, (True, False))))
def test_separable_equals_the_field_point_by_point(method, boundary, prefilter):
    source = Volume(volume(), spacing=(1.0, 0.5, 2.0), origin=(3.0, -1.0, 0.0))
    like = Volume(torch.zeros(3, 9, 8), spacing=(1.7, 0.4, 9.0), origin=(-4.0, -0.7, -6.0))  # well beyond the box
    field = reconstruct(source, method, boundary=boundary, prefilter=prefilter)
    for target in ({"shape": (4, 11, 9)}, {"spacing": (0.7, 0.9, 1.3)}, {"like": like}):
        out = resample(source, method, boundary=boundary, prefilter=prefilter, **target)
        assert out.dtype == torch.float64
        laws.assert_close(out.samples, field(centres(out)), 1e-12)


@every_boundary
@pytest.mark.parametrize("method", ["trilinear", "notch", "tricubic", "ncrsi"])
def test_equals_the_oracle(method, boundary):
    f = volume(4, 3, 5)
    like = Volume(torch.zeros(6, 7, 8), spacing=(0.9, 0.55, 0.8), origin=(-1.1, -0.3, -0.4))
    out = resample(f, method, boundary=boundary, like=like)
    (expected,) = oracles.reconstruct(method, f.numpy(), centres(like).reshape(-1, 3).numpy(), str(boundary), order=0)
    laws.assert_close(out.samples, expected.reshape(6, 7, 8), 1e-12)


@pytest.mark.parametrize("rotation", [False, True], ids=["aligned", "rotated"])
def test_geometry_of_a_new_shape_and_of_a_new_spacing(rotation):
    """The box of voxels stays (shape), or its centre does (spacing)."""
    geometry = {"affine": rotated((0.5, 1.0, 2.0))} if rotation else {"spacing": (0.5, 1.0, 2.0), "origin": (1, 2, 3)}
    source = Volume(volume(5, 8, 6), **geometry)

    def corners(v):
        ends = [(-0.5, n - 0.5) for n in v.size]
        return v.voxel_to_world(torch.tensor(list(product(*ends)), dtype=torch.float64))

    out = resample(source, "trilinear", shape=(10, 4, 9))
    assert out.shape == (10, 4, 9)
    assert out.spacing == pytest.approx((0.5 * 6 / 9, 1.0 * 8 / 4, 2.0 * 5 / 10))
    laws.assert_close(corners(out), corners(source), 1e-12, 10)
    out = resample(source, "trilinear", spacing=(0.8, 0.7, 0.6))
    assert out.spacing == pytest.approx((0.8, 0.7, 0.6))
    assert out.size == (4, 11, 17)  # 3 / 0.8 = 3.75, 8 / 0.7 = 11.4, 10 / 0.6 = 16.7
    laws.assert_close(corners(out).mean(0), corners(source).mean(0), 1e-12, 10)
    direction = out.affine[:3, :3] / out.spacing
    laws.assert_close(direction, source.affine[:3, :3] / source.spacing, 1e-13)


@every_method
def test_resampling_onto_its_own_grid_returns_the_samples_of_an_interpolating_method(method):
    source = Volume(volume(), affine=rotated())
    for target in ({"like": source}, {"shape": source.shape}, {"spacing": source.spacing}):
        out = resample(source, method, **target)
        laws.assert_close(out.affine, source.affine, 1e-13, 10)
        if METHODS[method].facts.interpolating:
            laws.assert_close(out.samples, source.samples, 1e-12)
        else:
            assert float((out.samples - source.samples).abs().max()) > 1e-3


@pytest.mark.parametrize("method", ["triquadratic", "ncrsi", "notch"])
def test_a_rotated_grid_is_sampled_point_by_point(method):
    source = Volume(volume(), spacing=(1.0, 0.5, 2.0), origin=(3.0, -1.0, 0.0))
    like = Volume(torch.zeros(3, 4, 5), affine=rotated(origin=(4.0, 1.0, 2.0)))
    out = resample(source, method, like=like)
    laws.assert_close(out.affine, like.affine, 0.0)
    laws.assert_close(out.samples, reconstruct(source, method)(centres(like)), 1e-12)
    batched = resample(Volume(volume(2, 3, 5, 7, 6), affine=source.affine), method, like=like)
    assert batched.shape == (2, 3, 3, 4, 5)
    laws.assert_close(
        batched.samples[1, 2],
        resample(Volume(volume(2, 3, 5, 7, 6)[1, 2], affine=source.affine), method, like=like).samples,
        1e-13,
    )


def test_grids_that_are_permuted_or_flipped_are_right_too():
    source = Volume(volume(5, 7, 6))
    affine = np.array([[0, 0, 1, 0], [0, -1, 0, 6], [1, 0, 0, 0], [0, 0, 0, 1.0]])  # x and z exchanged, y flipped
    out = resample(source, "triquadratic", like=Volume(torch.zeros(6, 7, 5), affine=affine))
    laws.assert_close(out.samples, source.samples.permute(2, 1, 0).flip(1), 1e-12)


@every_method
def test_a_batch_is_a_loop(method):
    f = volume(2, 2, 4, 3, 5)
    out = resample(f, method, shape=(5, 6, 4))
    assert out.shape == (2, 2, 5, 6, 4)
    for n, c in product(range(2), range(2)):
        laws.assert_close(out.samples[n, c], resample(f[n, c], method, shape=(5, 6, 4)).samples, 1e-13)


@pytest.mark.parametrize(
    "storage", [torch.uint8, torch.int16, torch.float16, torch.bfloat16, torch.float32, torch.float64]
)
def test_types(storage):
    f = (volume() * 100 + 120).to(storage)
    kept = f.clone()
    out = resample(f, "notch", shape=(7, 7, 7))
    assert out.dtype == torch.promote_types(storage, torch.float32)
    exact = resample(f.double(), "notch", shape=(7, 7, 7)).samples
    laws.assert_close(out.samples, exact, 1e-12 if storage == torch.float64 else 5e-6, 240)
    assert torch.equal(f, kept)
    assert resample(f, "notch", shape=(7, 7, 7), dtype=torch.float64).dtype == torch.float64


def test_differentiable_with_an_exact_adjoint():
    for method in ("trilinear", "ncrsi", "notch", "tricubic"):
        laws.assert_adjoint(lambda f, method=method: resample(f, method, shape=(5, 2, 4)).samples, volume(3, 4, 3))
        laws.assert_adjoint(
            lambda f, method=method: resample(f, method, boundary="zeros", spacing=(0.6, 1.1, 0.8)).samples,
            volume(3, 2, 3),
        )
    b, c = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.3, 0.2))

    def function(b, c, f):
        return resample(f, bc(b, c), shape=(3, 2, 2), prefilter=False).samples

    f = volume(2, 2, 1).requires_grad_()
    assert torch.autograd.gradcheck(function, (b, c, f))
    mapped = torch.func.vmap(lambda f: resample(f, "tricubic", shape=(2, 5, 3)).samples)(volume(2, 3, 4, 3))
    laws.assert_close(mapped[1], resample(volume(2, 3, 4, 3)[1], "tricubic", shape=(2, 5, 3)).samples, 1e-13)


def test_float32_positions_do_not_drift_on_long_axes():
    f = volume(1, 1, 3000).float()
    out = resample(f, "tricubic", shape=(1, 1, 4096))
    exact = resample(f.double(), "tricubic", shape=(1, 1, 4096))
    laws.assert_close(out.samples, exact.samples, 5e-6, 2.0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-6, 5e-4])
def test_grids_that_are_aligned_or_nearly_so_are_sampled_where_they_lie(angle):
    """5e-4 are more than a voxel at the end of 2800, and seen in which sample is nearest; 1e-9 are 3e-6 of one."""
    source, affine = Volume(volume(1, 3, 2800)), np.eye(4)
    affine[:2, :2] = [[0.7 * math.cos(angle), -math.sin(angle)], [0.7 * math.sin(angle), math.cos(angle)]]
    like = Volume(torch.zeros(1, 1, 4000), affine=affine)
    at = centres(like)
    laws.assert_close(resample(source, "tricubic", like=like).samples, reconstruct(source, "tricubic")(at), 2e-12)
    x, y, _ = (at + 0.5 + 1e-9).floor().long().clamp_max(2799).unbind(-1)
    assert torch.equal(resample(source, "nearest", boundary="border", like=like).samples, source.samples[0, y, x])
    assert int(y.max()) == (1 if angle == 5e-4 else 0)


@pytest.mark.parametrize("turned", [False, True], ids=["aligned", "axes exchanged"])
@pytest.mark.parametrize(("tenths", "count"), [(21, 4001), (12, 3411)])  # float32 has 2.1 too small and 1.2 too large
def test_voxel_numbers_keep_their_digits_on_long_axes(tenths, count, turned):
    """Every tenth new voxel is halfway between two samples, where the later is taken; the last is on the box."""
    size = tenths * (count - 1) // 10
    source = Volume(torch.arange(size, dtype=torch.int32)[None, None])
    affine = np.diag([tenths / 10, 1, 1, 1])[:, [1, 0, 2, 3] if turned else [0, 1, 2, 3]]
    affine[0, 3] = -0.5
    like = Volume(torch.zeros(1, count, 1) if turned else torch.zeros(1, 1, count), affine=affine)
    found = resample(source, "nearest", like=like, boundary="border", fill=-1).samples.flatten()
    assert found.tolist() == [min(tenths * i // 10, size - 1) for i in range(count)]


@pytest.mark.parametrize(
    ("target", "match"),
    [
        ({}, "exactly one"),
        ({"shape": (2, 2, 2), "spacing": 1.0}, "exactly one"),
        ({"shape": (2, 2)}, "shape"),
        ({"shape": (2, 0, 2)}, "shape"),
        ({"shape": (2, 2.5, 2)}, "shape"),
        ({"spacing": (1, -1, 1)}, "positive"),
        ({"shape": (2, 2, 2), "method": "sinc"}, "known methods"),
        ({"shape": (2, 2, 2), "boundary": "clamp"}, "mirror"),
    ],
)
def test_callers_mistakes(target, match):
    with pytest.raises(ValueError, match=match):
        resample(torch.zeros(3, 3, 3), **target)


def test_dtypes():
    volume = Volume((255 * torch.rand(6, 6, 6)).to(torch.uint8))
    with pytest.raises(ValueError, match="floating type"):
        resample(volume, spacing=0.5, dtype=torch.uint8)
    exact = resample(volume.to(torch.float64), "tricubic", spacing=0.5)
    laws.assert_close(resample(volume, "tricubic", spacing=0.5, dtype=torch.float64).samples, exact.samples, 1e-14)
    half = resample(volume, "tricubic", spacing=0.5, dtype=torch.float16)
    assert half.dtype == torch.float16
    assert (half.samples - exact.samples).abs().max() < 0.13  # overshoot above 256 has float16 units of 0.25


def test_mistaken_targets():
    x = torch.rand(3, 4, 5)
    assert resample(torch.rand(6, 6, 6), like=x).shape == (3, 4, 5)
    with pytest.raises(ValueError, match="three integers"):
        resample(x, shape=5)
    with pytest.raises(TypeError, match=r"expected a Volume, a torch\.Tensor or a NumPy array; got str"):
        resample(x, like="x")


# --- outside ----------------------------------------------------------------------------------------------------------


def inside(source: Volume, like: Volume) -> torch.Tensor:
    """Which voxel centres of `like` lie in the box of voxels of `source`, one by one."""
    upper = torch.tensor(source.size) - 0.5
    voxels = source.world_to_voxel(centres(like))
    return ((voxels >= -0.5 - 1e-9) & (voxels <= upper + 1e-9)).all(-1)


@pytest.mark.parametrize("fill", [0.0, -1000.0, math.nan, math.inf])
@pytest.mark.parametrize("options", [{"method": "tricubic"}, {"method": "nearest"}, {"labels": True}])
@pytest.mark.parametrize("turned", [False, True])
def test_what_lies_outside_has_the_value_of_fill(fill, options, turned):
    source = Volume(volume(5, 6, 7).round(decimals=0), spacing=(1.0, 0.5, 2.0), origin=(3.0, -1.0, 0.0))
    affine = rotated(origin=(2.0, -2.0, -1.0)) if turned else np.array(source.affine)
    affine[:3, 3] -= 0 if turned else source.spacing  # half of the box, to the voxel
    like = Volume(torch.zeros(6, 7, 8), affine=affine)
    within = inside(source, like)
    assert 0.1 < float(within.double().mean()) < 0.9
    plain, found = resample(source, like=like, **options), resample(source, like=like, fill=fill, **options)
    assert torch.equal(found.samples[within], plain.samples[within])
    assert torch.equal(
        found.samples[~within].nan_to_num(7.0), torch.full_like(found.samples[~within], fill).nan_to_num(7.0)
    )
    batch = Volume(source.samples.expand(2, 3, 5, 6, 7), affine=source.affine)
    assert torch.equal(resample(batch, like=like, fill=fill, **options).samples[1, 2].isnan(), found.samples.isnan())


def test_fill_leaves_what_has_no_outside_and_is_differentiable():
    samples = volume(4, 5, 6).requires_grad_()
    assert torch.equal(resample(samples, shape=(3, 7, 9), fill=9.0).samples, resample(samples, shape=(3, 7, 9)).samples)
    like = Volume(torch.zeros(4, 5, 6), origin=(3, 0, 0))
    resample(samples, "nearest", like=like, fill=5.0).samples.sum().backward()
    assert samples.grad[..., :3].abs().max() == 0
    assert (samples.grad[..., 3:] == 1).all()
    for wrong in (0.5, math.nan, 256, -1):
        with pytest.raises(ValueError, match=r"a fill that uint8 holds; got"):
            resample(torch.zeros(2, 3, 4, dtype=torch.uint8), "nearest", like=like, fill=wrong)


def test_grids_that_do_not_overlap_are_refused():
    source = Volume(volume(4, 5, 6))
    for affine in (np.diag([1.0, 1, 1, 1]), rotated()):
        affine[:3, 3] = (100, 0, 0)
        far = Volume(torch.zeros(3, 3, 3), affine=affine)
        with pytest.raises(ValueError, match="grids that overlap"):
            resample(source, like=far)
        assert (resample(source, like=far, fill=2.0).samples == 2).all()
        assert resample(source, like=far, boundary="wrap").samples.std() > 0
    touching = Volume(torch.zeros(3, 3, 3), origin=(5.5, 0, 0))  # on the face of the box
    assert resample(source, like=touching, fill=7.0).samples[0, 0].tolist()[1:] == [7, 7]
    assert resample(source, like=touching).shape == (3, 3, 3)


# --- far away, and memory ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("method", ["nearest", "trilinear", "tricubic", "qss"])
def test_what_is_far_from_the_origin_loses_no_digits(method, turned):
    """Grids at UTM coordinates, in float32, against the same grids at the origin in float64."""
    far = np.array([5e5, 4e6, 120.0])
    source = Volume(volume(9, 10, 11), affine=rotated(spacing=(0.5, 0.25, 1.0), origin=(0, 0, 0)))
    step = rotated(spacing=(0.9, 0.8, 0.7), origin=(1.5, 2.5, 3.5)) if turned else np.diag([0.7, 0.6, 0.9, 1.0])
    like = Volume(torch.zeros(7, 8, 9), affine=source.affine @ step)
    exact = resample(source, method, like=like, boundary="reflect")

    def moved(grid):
        affine = np.array(grid.affine)
        affine[:3, 3] += far
        return Volume(grid.samples.float(), affine=affine)

    found = resample(moved(source), method, like=moved(like), boundary="reflect")
    laws.assert_close(found.samples, exact.samples, 3e-6)


@pytest.mark.skipif(not resident.CAN_BE_TOLD, reason="the system does not tell the peak of a part")
def test_memory_beyond_input_and_output_is_less_than_a_volume():
    """By any method, type and boundary, on coarser and turned grids too; a tenth where nothing but sums is needed."""
    command = [sys.executable, "-W", "ignore", "-m", "tests.peak_memory"]
    done = subprocess.run(command, env=resident.ENVIRONMENT, capture_output=True, text=True, check=True)
    taken = json.loads(done.stdout)
    assert len(taken) == 25
    assert max(taken.values()) <= 1, taken
    assert max(taken[f"{m}"] for m in ("trilinear uint8", "triquadratic int16", "tricubic border")) <= 0.25, taken
