"""Parts of volumes: every voxel keeps its place in the world, exactly."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
import torch

import filterlab as fl
from tests.laws import assert_close

PLACED = {
    "plain": fl.Volume(torch.rand(5, 6, 7, dtype=torch.float64)),
    "spaced": fl.Volume(torch.rand(5, 6, 7), spacing=(0.1, 2, 0.3), origin=(1e5, -3, 0.7)),
    "flipped": fl.Volume(torch.rand(2, 1, 5, 6, 7), affine=np.diag([-0.3, 1.1, -2.0, 1.0])),
    "oblique": fl.Volume(
        torch.rand(5, 6, 7),
        affine=((0.9, -0.4, 0.1, 3.0), (0.3, 1.1, 0.0, -2.0), (0.0, 0.2, 0.7, 5.0), (0.0, 0.0, 0.0, 1.0)),
    ),
}
PARTS = {
    "box": (slice(1, 4), slice(2, None), slice(-5, -1)),
    "steps": (slice(None, None, 2), slice(1, None, 3), slice(None)),
    "turned": (slice(None, None, -1), slice(4, 0, -2), slice(None)),
    "planes": (2, slice(None), -1),
    "first axis": slice(1, 3),
    "rest": (..., 3),
    "middle": (1, ..., slice(0, 6, 4)),
    "all": ...,
}


def every_voxel(volume: fl.Volume) -> torch.Tensor:
    d, h, w = volume.shape[-3:]
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (d, h, w)), indexing="ij")
    return torch.stack((x, y, z), -1)


@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS)
@pytest.mark.parametrize("volume", PLACED.values(), ids=PLACED)
def test_every_voxel_of_a_part_stays_where_it_was(volume: fl.Volume, part) -> None:
    given = part if isinstance(part, tuple) else (part,)
    kept = tuple(slice(i, i + 1 or None) if isinstance(i, int) else i for i in given)
    shape = every_voxel(volume).shape
    numbers = np.arange(math.prod(shape[:3])).reshape(shape[:3])[kept]
    cut = volume[part]
    assert np.array_equal(cut.samples.numpy(), volume.samples.numpy()[(..., *_padded(kept))])
    where = volume.voxel_to_world(every_voxel(volume).reshape(-1, 3)[torch.from_numpy(numbers.copy()).reshape(-1)])
    found = cut.voxel_to_world(every_voxel(cut).reshape(-1, 3))
    assert_close(found, where, 4e-16, float(where.abs().max()))
    assert cut.origin == tuple(exact_origin(volume, numbers))


def _padded(index: tuple) -> tuple:
    if ... in index:
        place = index.index(...)
        return (*index[:place], *[slice(None)] * (4 - len(index)), *index[place + 1 :])
    return (*index, *[slice(None)] * (3 - len(index)))


def exact_origin(volume: fl.Volume, numbers: np.ndarray) -> list[float]:
    """World position of the first voxel, in exact arithmetic, rounded once."""
    d, h, w = volume.shape[-3:]
    z, y, x = np.unravel_index(int(numbers[0, 0, 0]), (d, h, w))
    rows = volume.affine[:3].tolist()
    return [float(sum(Fraction(c) * int(k) for c, k in zip(row, (x, y, z, 1), strict=True))) for row in rows]


def test_a_part_is_a_view_and_differentiable() -> None:
    samples = torch.rand(4, 5, 6, requires_grad=True)
    volume = fl.Volume(samples)
    assert volume[1:].samples.data_ptr() == samples[1:].data_ptr()
    volume[1:3, ::-1].samples.sum().backward()
    assert samples.grad is not None
    assert samples.grad.sum() == 2 * 5 * 6


@pytest.mark.parametrize(
    ("index", "error", "told"),
    [
        (slice(3, 3), ValueError, r"voxels along z; got slice\(3, 3, None\) of 5"),
        ((0, slice(9, None)), ValueError, "voxels along y"),
        (5, IndexError, "index along z of 5 voxels; got 5"),
        ((0, 0, -8), IndexError, "index along x of 7 voxels; got -8"),
        ((0, 0, 0, 0), IndexError, "three indices"),
        ((..., ...), IndexError, "one ellipsis"),
        (None, TypeError, "slices and integers; got NoneType along z"),
        (True, TypeError, "got bool"),
        ([0, 1], TypeError, "got list"),
        (slice(None, None, 0), ValueError, "zero"),
    ],
)
def test_other_parts_are_refused(index, error: type[Exception], told: str) -> None:
    with pytest.raises(error, match=told):
        PLACED["plain"][index]


@pytest.mark.parametrize("volume", PLACED.values(), ids=PLACED)
def test_a_crop_is_the_least_part_with_every_centre_in_the_box(volume: fl.Volume) -> None:
    centres = volume.voxel_to_world(every_voxel(volume))
    middle, extent = centres.reshape(-1, 3).mean(0), centres.reshape(-1, 3).amax(0) - centres.reshape(-1, 3).amin(0)
    for fraction in (0.2, 0.3, 0.45, 2.0):
        lower, upper = middle - fraction * extent, middle + fraction * extent
        within = ((centres >= lower) & (centres <= upper)).all(-1).nonzero()
        (z, y, x), (c, b, a) = within.amin(0).tolist(), (within.amax(0) + 1).tolist()
        cut = volume.crop(lower.tolist(), upper.numpy())
        want = volume[z:c, y:b, x:a]
        assert torch.equal(cut.samples, want.samples)
        assert cut.geometry == want.geometry


def test_centres_on_the_faces_of_a_box_are_in_the_crop() -> None:
    volume = fl.Volume(torch.rand(5, 6, 7), spacing=0.1, origin=(0.3, 0.0, 0.0))
    assert volume.crop((0.4, 0.1, 0.3), (0.6, 0.3, 0.4)).size == (3, 3, 2)  # 3 · 0.1 is not 0.3
    infinite = (-math.inf, -math.inf, 0.15), (math.inf, math.inf, math.inf)
    assert volume.crop(*infinite).size == (7, 6, 3)


def test_boxes_without_a_centre_are_refused() -> None:
    volume = PLACED["spaced"]
    with pytest.raises(ValueError, match=r"no voxel's centre lies from .* those of the grid lie from \[100000\.0"):
        volume.crop((0, 0, 0), (1, 1, 1))
    with pytest.raises(ValueError, match="no voxel's centre"):
        PLACED["oblique"].crop((1e3, 0, 0), (1e4, 1, 1))
    with pytest.raises(ValueError, match="lower must not be above upper"):
        volume.crop((0, 2, 0), (1, 1, 1))
    for wrong in ((0, 0), (0, math.nan, 0)):
        with pytest.raises(ValueError, match="upper must be three numbers"):
            volume.crop((0, 0, 0), wrong)


def test_numpy_is_the_samples() -> None:
    samples = torch.rand(2, 3, 4)
    array = fl.Volume(samples).numpy()
    samples[0, 0, 0] = 7
    assert array[0, 0, 0] == 7
    assert fl.Volume(torch.rand(2, 3, 4, requires_grad=True)).numpy().shape == (2, 3, 4)
    halved = fl.Volume(samples.to(torch.bfloat16)).numpy()
    assert halved.dtype == np.float32
    assert np.array_equal(halved, samples.to(torch.bfloat16).float())


def test_to_keeps_the_geometry() -> None:
    volume = PLACED["oblique"]
    for moved in (volume.to(torch.float64), volume.to("cpu", torch.float64), volume.to(torch.empty(0).double())):
        assert moved.dtype == torch.float64
        assert moved.geometry == volume.geometry
