"""Rays at splines on tetrahedra in Triton: in Triton's interpreter everywhere, on a GPU where there is one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the package triton is not installed")

import filterlab as fl
from filterlab.fields.grid import GridField
from filterlab.ops.cuda import raycast as cuda
from filterlab.ops.differentiable import raycast
from filterlab.surfaces import LevelSet
from tests import tetrahedral_rays
from tests.level_set_rays import FAULTS
from tests.ops.test_raycast import AFFINE, samples
from tests.tetrahedral_oracle import SPLINES
from tests.tetrahedral_rays import CLASSES, Case, Rays, judged, of_a_vertex

every_spline = pytest.mark.parametrize("name", SPLINES)
OF_EACH = {"qss": ("wrap", [3, 2, 3]), "cubic-c1": ("border", [3, 2, 2]), "quadratic-c1": ("reflect", [2, 2, 2])}
"""A boundary, and voxels along x, y, z for the interpreter, which takes its time."""
OTHERS = {"from far away", "thin shells"}  # have other tolerances, other samples


@pytest.fixture
def asked(device: str, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is asked to cast rays. The interpreter takes as long for many rays at a time as for a few."""
    if device == "cpu":
        monkeypatch.setattr(raycast, "_implementation_for", lambda lattice: "cuda")
        monkeypatch.setattr(cuda, "BLOCK", 128)
    found: list[str] = []
    monkeypatch.setattr(raycast, "driver", lambda name, op: found.append(name) or driver(name, op))
    return found


driver = raycast.driver


def every_class(rng: np.random.Generator, case: Case, rays: int) -> Rays:
    made = (make(rng, case, rays) for kind, (_, make) in CLASSES.items() if kind not in OTHERS)
    origins, directions = (np.concatenate(parts) for parts in zip(*made, strict=True))
    return origins, directions


@every_spline
def test_every_crossing_is_found_and_no_other(name: str, device: str, asked: list[str], monkeypatch) -> None:
    """First hits and all of them, of rays of all classes at a level that a vertex has."""
    boundary, size = OF_EACH[name]
    if device == "cpu":
        monkeypatch.setattr(tetrahedral_rays, "SIZE", np.array(size))
    rng = np.random.default_rng(2)
    case = of_a_vertex(rng, name, boundary, True)
    verdict = judged(case, every_class(rng, case, 12 if device == "cpu" else 500), device=device)
    assert not any(verdict[fault] for fault in FAULTS), verdict
    assert verdict["hits"] > verdict["rays"] / 5  # of rays that are decided
    assert asked == ["cuda", "cuda"]


@every_spline
def test_the_same_hits_as_by_vector_code(name: str, device: str, asked: list[str]) -> None:
    """Of integers that stand for values, in an oblique grid, in float32; the first, and from the last one on."""
    if device == "cpu" and name != "qss":
        pytest.skip("the interpreter takes the smallest")
    found = []
    for where, way in (("cpu", "cpu"), (device, "cuda")):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(raycast, "_implementation_for", lambda lattice, way=way: way)
            volume = fl.Volume(samples(shape=(2, 1, 3)).to(where), affine=AFFINE)
            field = fl.reconstruct(volume, name, storage="int16")
            surface, rays = LevelSet(field, 0.6), (x.to(where) for x in across(field, 90))
            o, d = rays
            found.append((surface.hit(o, d).t.cpu()[:, None], surface.hits(o, d, 2, farthest=True).t.cpu()))
    assert asked == ["cpu", "cpu", "cuda", "cuda"]
    for expected, own in zip(*found, strict=True):
        hit = expected < torch.inf
        assert hit[:, 0].double().mean() > 0.3
        assert torch.equal(hit, own < torch.inf)
        assert float((expected - own)[hit].abs().max()) < 1e-4


def across(field: GridField, count: int) -> tuple[Tensor, Tensor]:
    """Rays of float32 between places in the domain, from a way before."""
    size = torch.tensor(field.coefficients.size, dtype=torch.float64)
    a, b = torch.rand(2, count, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * size - 0.5
    a, b = (field.domain.geometry.to_world(x) for x in (2 * a - b, b))
    return a.float(), (b - a).float()
