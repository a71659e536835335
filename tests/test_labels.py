"""Volumes whose numbers are names: the nearest sample, the strongest label, and how they are told from amounts."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch

from filterlab import Volume, reconstruct, resample, signals
from filterlab.labels import look_like_labels
from filterlab.volume import Boundary
from tests import laws
from tests.pairs import in_pairs

RNG = np.random.default_rng(3)
TURNED = np.eye(4)
TURNED[:3, :3] = np.linalg.qr(RNG.normal(size=(3, 3)))[0] * [0.7, 0.9, 0.6]
TURNED[:3, 3] = [1.0, 2.0, 0.5]
pytestmark = pytest.mark.filterwarnings("ignore::filterlab.resampling.AliasingWarning")  # grids are coarser on purpose
INTEGERS = [torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64]


def patches(*shape: int, labels: int = 5, edge: int = 3) -> torch.Tensor:
    """Random labels in cubes of so many voxels."""
    coarse = torch.from_numpy(RNG.integers(0, labels, [-(-n // edge) for n in shape]))
    for dim in range(3):
        coarse = coarse.repeat_interleave(edge, dim)
    return coarse[: shape[0], : shape[1], : shape[2]].contiguous()


# --- nearest ----------------------------------------------------------------------------------------------------------


def nearest_by_definition(samples: np.ndarray, points: np.ndarray, boundary: str) -> np.ndarray:
    """The sample whose centre is nearest, on the samples extended by NumPy."""
    mode = {"mirror": "reflect", "reflect": "symmetric", "wrap": "wrap", "border": "edge", "zeros": "constant"}
    extended = np.pad(samples, 30, mode=mode[boundary])  # type: ignore[call-overload]
    i = np.floor(points + 0.5).astype(int) + 30
    return extended[i[..., 2], i[..., 1], i[..., 0]]


@pytest.mark.parametrize("boundary", Boundary)
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("dtype", [*INTEGERS, torch.float16, torch.float32, torch.float64])
def test_nearest_is_the_nearest_sample_to_the_bit(boundary: Boundary, turned: bool, dtype: torch.dtype) -> None:
    samples = torch.from_numpy(RNG.integers(0, 100, (5, 6, 7))).to(dtype)
    samples[0, 0, 0] = torch.iinfo(dtype).max if not dtype.is_floating_point else 0.1
    source = Volume(samples, spacing=(1.0, 0.5, 2.0), origin=(3, -1, 0))
    affine = source.affine @ (TURNED if turned else np.diag([0.37, 0.61, 0.53, 1.0]))
    affine[:3, 3] -= 1.234
    like = Volume(torch.zeros(9, 8, 10), affine=affine)
    found = resample(source, "nearest", like=like, boundary=boundary)
    assert found.dtype == dtype
    z, y, x = np.indices((9, 8, 10))
    world = np.stack([x, y, z, np.ones_like(x)], -1) @ affine.T
    points = (world @ np.linalg.inv(source.affine).T)[..., :3]
    assert np.array_equal(found.samples.numpy(), nearest_by_definition(samples.numpy(), points, boundary))
    field = reconstruct(source.to(torch.float64), "nearest", boundary=boundary)
    assert np.array_equal(field(torch.from_numpy(world[..., :3])).numpy(), found.samples.double().numpy())


def test_nearest_keeps_its_grid_and_doubles_voxels() -> None:
    samples = torch.arange(2 * 3 * 4, dtype=torch.int64).reshape(2, 3, 4) + 2**60
    assert torch.equal(resample(samples, "nearest", shape=(2, 3, 4)).samples, samples)
    twice = resample(samples, "nearest", shape=(4, 6, 8)).samples
    expected = samples
    for dim in range(3):
        expected = expected.repeat_interleave(2, dim)
    assert torch.equal(twice, expected)
    half = resample(torch.arange(8).reshape(1, 1, 8), "nearest", shape=(1, 1, 4)).samples
    assert half.flatten().tolist() == [1, 3, 5, 7]  # halfway between two: the later one, wherever


def test_nearest_is_differentiable_in_its_samples_and_takes_batches() -> None:
    batch = torch.rand(2, 3, 4, 5, 6, dtype=torch.float64, requires_grad=True)
    out = resample(batch, "nearest", shape=(5, 7, 6), boundary="zeros")
    assert torch.equal(out.samples[1, 2], resample(batch[1, 2], "nearest", shape=(5, 7, 6), boundary="zeros").samples)
    out.samples.sum().backward()
    assert batch.grad is not None
    assert float(batch.grad.sum()) == 2 * 3 * 5 * 7 * 6
    assert set(batch.grad.unique().tolist()) <= {0.0, 1.0, 2.0, 4.0, 8.0}


def test_nearest_and_labels_keep_their_type_or_say_so() -> None:
    samples = patches(4, 5, 6)
    for options in ({"method": "nearest"}, {"labels": True}):
        with pytest.raises(ValueError, match=r"and labels keep their type, torch\.int64; got dtype=torch\.float32"):
            resample(samples, shape=(3, 3, 3), dtype=torch.float32, **options)
        assert resample(samples, shape=(3, 3, 3), dtype=torch.int64, **options).dtype == torch.int64
    missing = torch.tensor([[[1.0, torch.nan, 3.0]]])
    for options in ({"method": "nearest"}, {"labels": True, "method": "trilinear"}):
        with pytest.raises(ValueError, match="NaN"):
            resample(missing, shape=(1, 1, 3), **options)
    assert resample(missing, "nearest", shape=(1, 1, 3), nan="propagate").samples.isnan().sum() == 1
    with pytest.raises(ValueError, match="labels must be finite numbers; got nan"):
        resample(missing, labels=True, shape=(1, 1, 3), nan="propagate")


# --- labels -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("boundary", "how", "turned", "dtype"),
    in_pairs(
        product(
            Boundary,
            (("trilinear", True), ("triquadratic", True), ("tricubic", False)),
            (False, True),
            (torch.uint8, torch.int32, torch.int64, torch.float32),
        )
    ),
)
def test_the_strongest_label_wins(boundary: Boundary, how: tuple[str, bool], turned: bool, dtype: torch.dtype) -> None:
    """argmax over all indicators at once, in float64, where the first two are further apart than float32 rounds."""
    method, prefilter = how
    samples = patches(6, 7, 8).to(dtype) * 20
    offset = 2**60 if dtype == torch.int64 else 0
    source = Volume(samples + offset, affine=np.diag([1.0, 2.0, 0.5, 1.0]))
    affine = source.affine @ (TURNED if turned else np.diag([0.6, 0.7, 0.8, 1.0]))
    like = Volume(torch.zeros(9, 8, 10), affine=affine)
    found = resample(source, method, like=like, boundary=boundary, prefilter=prefilter, labels=True)
    assert found.dtype == dtype
    names = source.samples.unique()
    indicators = [Volume.with_geometry((source.samples == n).double(), source.geometry) for n in names]
    weights = torch.stack(
        [resample(i, method, like=like, boundary=boundary, prefilter=prefilter).samples for i in indicators]
    )
    if boundary == "zeros":  # 0 stands out there
        names, weights = torch.cat((names.new_zeros(1), names)), torch.cat((1 - weights.sum(0, keepdim=True), weights))
        if 0 in names[1:]:
            names, weights = names[1:], torch.cat((weights[:1] + weights[1:2], weights[2:]))
    first, second = weights.topk(2, 0).values
    clear = first - second > 1e-5
    assert float(clear.float().mean()) > 0.95
    assert torch.equal(found.samples[clear], names[weights.argmax(0)][clear])
    assert set(found.samples.unique().tolist()) <= set(names.tolist())


def test_two_labels_are_a_threshold_at_one_half() -> None:
    """What a method makes of {0, 1}, at ½, and names play no part."""
    samples = patches(6, 7, 8, labels=2)
    for a, b in ((0, 1), (-7, 300), (5, 2**40)):
        named = torch.where(samples == 0, a, b)
        found = resample(named, "tricubic", shape=(11, 9, 13), labels=True).samples
        value = resample(samples.double(), "tricubic", shape=(11, 9, 13)).samples
        clear = (value - 0.5).abs() > 1e-5
        assert torch.equal(found[clear], torch.where(value > 0.5, b, a)[clear])


def test_of_equal_labels_the_least_wins() -> None:
    row = torch.tensor([[[3, 1]]])
    assert resample(row, "trilinear", shape=(1, 1, 1), labels=True).samples.tolist() == [[[1]]]
    assert resample(row.flip(-1), "trilinear", shape=(1, 1, 1), labels=True).samples.tolist() == [[[1]]]


def test_labels_take_the_memory_of_one_label() -> None:
    """Numbers per voxel do not grow with the number of labels; a batch is a loop."""
    peaks = []
    for count in (3, 60):
        samples = patches(24, 24, 24, labels=count)
        tensors: list[int] = []

        class Counted(torch.utils._python_dispatch.TorchDispatchMode):
            def __torch_dispatch__(self, function, types, args=(), kwargs=None):
                out = function(*args, **(kwargs or {}))
                tensors.append(out.numel() if isinstance(out, torch.Tensor) else 0)  # noqa: B023
                return out

        with Counted():
            resample(samples, "triquadratic", shape=(24, 24, 24), labels=True)
        peaks.append(max(tensors))
    assert peaks[0] == peaks[1]
    batch = torch.stack([patches(4, 5, 6) for _ in range(6)]).reshape(2, 3, 4, 5, 6)
    found = resample(batch, "notch", shape=(5, 6, 7), labels=True).samples
    for n, c in product(range(2), range(3)):
        assert torch.equal(found[n, c], resample(batch[n, c], "notch", shape=(5, 6, 7), labels=True).samples)


# --- integers that floats do not hold ---------------------------------------------------------------------------------


@pytest.mark.parametrize("top", [2**24, 2**24 + 1, -(2**24) - 1, 2**53, 2**53 + 1])
def test_integers_are_held_or_refused(top: int) -> None:
    samples = torch.full((2, 3, 4), top, dtype=torch.int64)
    if abs(top) > 2**53:
        for work in (lambda: resample(samples, shape=(2, 3, 4)), lambda: reconstruct(samples, "tricubic")):
            with pytest.raises(ValueError, match=rf"integers that float64 holds, up to 2⁵³.*; got {top}"):
                work()
        return
    found = resample(samples, "trilinear", shape=(2, 3, 4))
    assert found.dtype == (torch.float32 if abs(top) <= 2**24 else torch.float64)
    assert (found.samples == top).all()
    if abs(top) > 2**24:
        with pytest.raises(ValueError, match=r"torch\.float32 does not hold the integers .*; float64 does"):
            resample(samples, "trilinear", shape=(2, 3, 4), dtype=torch.float32)
    point = torch.tensor([[1.25, 1.5, 0.5]], dtype=torch.float64)
    for method in ("trilinear", "tricubic"):
        tolerance = 1e-15 if abs(top) > 2**24 else 3e-7
        laws.assert_close(reconstruct(samples, method)(point), np.array([float(top)]), tolerance, abs(top))


# --- what looks like labels -------------------------------------------------------------------------------------------


def ball_labels(dtype: torch.dtype = torch.uint8) -> torch.Tensor:
    z, y, x = torch.meshgrid(*(torch.arange(24.0) - 11.5,) * 3, indexing="ij")
    radius = (x**2 + y**2 + z**2).sqrt()
    return (2 * (radius < 9).to(dtype) + 2 * (radius < 5).to(dtype)).contiguous()


def test_labels_are_told_from_amounts() -> None:
    balls = ball_labels()
    assert look_like_labels(balls)
    assert look_like_labels((balls > 0).to(torch.uint8) * 255)
    assert look_like_labels(patches(12, 24, 24, labels=200, edge=6) * 17)
    assert look_like_labels(balls.expand(2, 2, 24, 24, 24))
    amounts = [
        torch.zeros(4, 5, 6, dtype=torch.uint8),
        balls.float(),
        torch.from_numpy(RNG.integers(0, 4, (12, 24, 24))),
        torch.from_numpy(RNG.integers(-1000, 3000, (12, 24, 24))).to(torch.int16),
        (255 * signals.marschner_lobb().sample(40).samples).to(torch.uint8),
        (25 * signals.torus().sample(96).samples).round().to(torch.int16),  # many equal neighbours, small steps
        sum(torch.meshgrid(*(torch.arange(48),) * 3, indexing="ij")) // 8,
    ]
    assert [look_like_labels(samples) for samples in amounts] == [False] * len(amounts)
