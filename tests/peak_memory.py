"""What resampling takes at its peak beyond its input and output, in volumes of the output in float32.

`python -m tests.peak_memory` prints it as JSON for every case.
"""

from __future__ import annotations

import json
import sys

import numpy as np
import torch

import filterlab as fl
from filterlab.volume import Volume
from tests import resident

N, NEW = (80, 90, 100), (120, 135, 150)
TURNED = np.eye(4)
TURNED[:3, :3] = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]


def volume(dtype: torch.dtype, shape: tuple[int, ...] = N, different: int = 90) -> Volume:
    """So many different numbers, or labels in slabs."""
    samples = (torch.arange(np.prod(shape)) // 17 % different).reshape(shape)
    return Volume(samples.to(dtype))


def incomplete() -> Volume:
    samples = volume(torch.float32).samples.clone()
    samples[10:12, 20:30, 30:40] = torch.nan
    return Volume(samples)


def to(shape: tuple[int, ...] = NEW, method: str = "tricubic", **how) -> dict:
    return {"method": method, "shape": shape, **how}


def onto(affine: np.ndarray, method: str = "tricubic", **how) -> dict:
    """A grid of voxels of 2/3."""
    affine = affine @ np.diag([2 / 3, 2 / 3, 2 / 3, 1])
    return {"method": method, "like": Volume(torch.zeros(()).expand(NEW), affine=affine), **how}


def cases() -> dict[str, tuple[Volume, dict]]:
    """Name -> a volume, and how it is resampled."""
    methods = {
        "trilinear": "uint8",
        "triquadratic": "int16",
        "notch": "float32",
        "tricubic": "float64",
        "ncrsi": "float16",
    }
    samples = volume(torch.float32)
    return {
        **{f"{m} {t}": (volume(getattr(torch, t)), to(method=m)) for m, t in methods.items()},
        **{f"tricubic {b}": (samples, to(boundary=b)) for b in ("reflect", "wrap", "border", "zeros")},
        "tricubic int64": (volume(torch.int64), to()),
        "to float16": (samples, to(dtype=torch.float16)),
        "in float64": (samples, to(dtype=torch.float64)),
        "one plane": (volume(torch.float32, (1, 700, 700)), to((1, 1400, 1400), boundary="border")),
        "the same grid": (volume(torch.float32, NEW), to()),
        "a coarser grid": (volume(torch.float32, (160, 180, 200)), to((107, 120, 133), antialias=True)),
        "filled outside": (samples, onto(np.eye(4), fill=0.0)),
        "NaN propagated": (incomplete(), to(nan="propagate")),
        "nearest uint8": (volume(torch.uint8), to(method="nearest")),
        "nearest int64": (volume(torch.int64), to(method="nearest")),
        "labels": (volume(torch.uint8, different=12), to(method="triquadratic", labels=True)),
        "turned": (samples, onto(TURNED, boundary="wrap")),
        "turned and filled": (volume(torch.uint8), onto(TURNED, "trilinear", fill=0.0)),
        "turned, nearest": (volume(torch.uint8), onto(TURNED, "nearest")),
        "on tetrahedra": (samples, to(method="qss")),
        "a batch": (volume(torch.float32, (2, 1, *N)), to()),
    }


def beyond(source: Volume, how: dict) -> float:
    """Of one case, after a small one of its kind."""
    grid = {"shape": (5, 6, 7)} if "shape" in how else {"like": Volume(torch.zeros(5, 6, 7), affine=how["like"].affine)}
    fl.resample(Volume(source.samples[..., :9, :8, :7].contiguous()), **(how | grid))
    before = resident.begin()
    out = fl.resample(source, **how).samples
    taken = resident.highest() - before - out.numel() * out.element_size()
    return taken / (4 * out.numel())


if __name__ == "__main__":
    torch.set_num_threads(1)
    chosen = sys.argv[1:]
    print(json.dumps({name: round(beyond(*case), 3) for name, case in cases().items() if not chosen or name in chosen}))
