"""`hit_error`: the signal's own hits against closed forms, triangles against all of them, orders, records."""

import math

import numpy as np
import pytest
import torch
import yaml

import filterlab as fl
from experiments import hit_error, rms_error, triangles
from experiments.__main__ import main
from experiments.hit_error import Config, truth_of
from experiments.runs import read_records
from experiments.signal_surface import SignalSurface, first_crossings
from filterlab.surfaces import LevelSet
from tests.laws import assert_close

SPHERE = {"signal": {"name": "sphere", "parameters": {"radius": 0.5, "edge": 0.3}}, "level": 0.5, "inner": 0.8}


def config(**changes) -> Config:
    content = {
        "experiment": "hit_error",
        "description": "tiny",
        "studies": [{**SPHERE, "resolutions": [16, 32]}],
        "methods": ["trilinear", "triquadratic"],
        "rays": 300,
    }
    return Config.model_validate({**content, **changes})


def sphere_hits(origins, directions, radius):
    """The first t ≥ 0 with |o + t d| = radius; ∞ where none."""
    b, c = (origins * directions).sum(-1), (origins**2).sum(-1) - radius**2
    root = (b * b - c).clamp_min(0).sqrt()
    both = torch.stack((-b - root, -b + root))
    both = torch.where((both >= 0) & (b * b > c), both, math.inf)
    return both.amin(0)


def test_the_signals_own_hits_are_those_of_the_closed_form():
    settings = config()
    truth = truth_of(settings, settings.studies[0])
    assert len(truth.t) > 50
    assert_close(truth.t, sphere_hits(truth.origins, truth.directions, 0.5), 1e-14)
    assert_close(truth.origins.abs().amax(-1), np.full(len(truth.t), 0.8), 1e-14)
    normal = -(truth.origins + truth.t[:, None] * truth.directions) / 0.5
    assert_close(truth.normal, normal, 1e-13)
    assert ((truth.normal * truth.directions).sum(-1).abs() >= hit_error.GRAZE).all()


def test_two_crossings_between_samples_are_doubtful():
    signal = fl.signals.sphere(radius=0.5, edge=0.3)
    height = torch.tensor([0.3, 0.49999999, 0.51], dtype=torch.float64)  # the second is inside between two samples
    origins = torch.stack((torch.full_like(height, -1.0005), height, torch.zeros_like(height)), -1)
    directions = torch.tensor([[1.0, 0, 0]], dtype=torch.float64).expand(3, 3)
    t, doubtful = first_crossings(signal, 0.5, origins, directions, torch.full((3,), 2.0, dtype=torch.float64))
    assert t[0] == pytest.approx(0.6005, abs=1e-14)
    assert t[1:].tolist() == [math.inf] * 2
    assert doubtful.tolist() == [False, True, False]


def test_a_signals_surface_is_hit_from_anywhere():
    signal = fl.signals.torus()
    origins = 3 * torch.nn.functional.normalize(torch.randn(300, 3, dtype=torch.float64), dim=-1)
    directions = (0.5 * torch.randn(300, 3, dtype=torch.float64) - origins) * torch.rand(300, 1, dtype=torch.float64)
    surface = SignalSurface(signal, 0.0)
    hit = surface.hit(origins, directions)
    at = surface.at(origins, directions, hit)
    assert 50 < int(hit.valid.sum()) < 290
    assert_close(signal(at.point[hit.valid]), np.zeros(int(hit.valid.sum())), 1e-13)
    assert ((at.normal * directions)[hit.valid].sum(-1) < 0).all()  # from outside, where values are greater


def every_triangle(mesh, origins, directions):
    """t of the nearest of all triangles, by planes and sides of edges; ∞ where none."""
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    n = torch.linalg.cross(b - a, c - a)
    t = ((a[None] - origins[:, None]) * n).sum(-1) / (directions[:, None] * n).sum(-1)
    p = origins[:, None] + t[..., None] * directions[:, None]
    sides = [(torch.linalg.cross((v - u).expand_as(p), p - u) * n).sum(-1) for u, v in ((a, b), (b, c), (c, a))]
    inside = torch.stack(sides).amin(0) >= -1e-12 * (n * n).sum(-1)
    return torch.where(inside & (t >= 0), t, math.inf).nan_to_num(math.inf, posinf=math.inf).amin(-1)


def test_triangles_are_met_as_if_all_were_tried():
    affine = np.array([[0.5, 0.1, 0, 3], [0, 0.7, 0.2, 1], [0.1, 0, -1.3, 5], [0, 0, 0, 1.0]])
    inner = torch.randn(6, 5, 7, dtype=torch.float64)
    volume = fl.Volume(torch.nn.functional.pad(inner, (2,) * 6, value=-2.0), affine=affine)
    surface = triangles.marching_cubes(volume, 0.2, "mirror")
    center = torch.tensor(surface.domain.center)
    origins = center + 12 * torch.nn.functional.normalize(torch.randn(200, 3, dtype=torch.float64), dim=-1)
    directions = center + 2 * torch.randn(200, 3, dtype=torch.float64) - origins
    hit = surface.hit(origins, directions)
    expected = every_triangle(surface.mesh, origins, directions)
    assert_close(hit.t.nan_to_num(posinf=-1), expected.nan_to_num(posinf=-1), 1e-12)
    assert 50 < int(hit.valid.sum()) < 190
    at = surface.at(origins, directions, hit)
    assert_close(at.point[hit.valid], (origins + hit.t[:, None] * directions)[hit.valid], 1e-12)
    assert_close(at.normal[hit.valid].norm(dim=-1), np.ones(int(hit.valid.sum())), 1e-13)
    assert not at.normal[~hit.valid].any()


def test_marching_cubes_interpolates_samples_along_edges():
    """Three voxels in a row, the level a quarter of the way between two: planes there, and central differences."""
    volume = fl.Volume(torch.tensor([0.0, 4, 8]).double().expand(3, 3, 3).contiguous())
    surface = triangles.marching_cubes(volume, 1.0, "border")
    ray = torch.tensor([[-5.0, 1.2, 0.9]], dtype=torch.float64), torch.tensor([[1.0, 0, 0]], dtype=torch.float64)
    hit = surface.hit(*ray)
    assert float(hit.t) == pytest.approx(5.25)
    assert_close(surface.at(*ray, hit).normal, np.array([[1.0, 0, 0]]), 1e-14)


@pytest.mark.parametrize(
    ("name", "distance", "normal"),
    [("trilinear", 2, 1), ("triquadratic", 3, 2), ("tricubic", 4, 3), (triangles.NAME, 2, 2)],
)
def test_hits_have_the_order_of_the_method(name, distance, normal):
    settings = config()
    truth, signal = truth_of(settings, settings.studies[0]), settings.studies[0].signal.build()
    found = []
    for n in (24, 48):
        volume = signal.sample(n)
        if name == triangles.NAME:
            surface = triangles.marching_cubes(volume, 0.5, "reflect")
        else:
            surface = LevelSet(fl.reconstruct(volume, name, boundary="reflect"), 0.5)
        found.append(truth.errors(surface, 4 / n))
    assert found[1]["elsewhere"] == 0
    assert rms_error.slope([24, 48], [r["distance_rms"] for r in found]) == pytest.approx(distance, abs=0.3)
    assert rms_error.slope([24, 48], [r["normal_rms"] for r in found]) == pytest.approx(normal, abs=0.3)


def test_records_are_those_of_the_definition(undrawn, tmp_path):
    path = tmp_path / "hits.yaml"
    studies = [{**SPHERE, "resolutions": [8, 16], "fit_from": 8}]
    path.write_text(yaml.safe_dump(config(methods=["notch"], studies=studies).model_dump(mode="json")))
    assert main(["run", str(path), "--runs", str(tmp_path / "runs")]) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    records = read_records(folder)[0]
    assert set(records) == {f"0/{n}/{name}" for n in (8, 16, "fit") for name in ("notch", triangles.NAME)}
    truth = truth_of(config(), config().studies[0])
    field = fl.reconstruct(fl.signals.sphere(radius=0.5, edge=0.3).sample(8), "notch", boundary="reflect")
    t = LevelSet(field, 0.5).hit(truth.origins, truth.directions).t
    near = (t - truth.t).abs() < 4 / 8
    record = records["0/8/notch"]
    assert record["distance_rms"] == pytest.approx(float((t - truth.t)[near].square().mean().sqrt()), rel=1e-9)
    g = field.value_and_gradient(truth.origins + t[:, None] * truth.directions)[1][near]
    cosine = (torch.nn.functional.normalize(g, dim=-1) * truth.normal[near]).sum(-1)
    assert record["normal_rms"] == pytest.approx(float(cosine.clamp(-1, 1).acos().square().mean().sqrt()), rel=1e-6)
    assert record["elsewhere"] == int((~near).sum())
    assert records["0/fit/notch"]["declared_distance"] == 3
    assert records[f"0/fit/{triangles.NAME}"]["declared_normal"] == 2


def test_what_is_elsewhere_counts_and_does_not_enter_the_mean():
    settings = config()
    truth = truth_of(settings, settings.studies[0])
    other = fl.reconstruct(fl.signals.sphere(radius=0.3, edge=0.3).sample(24), "tricubic", boundary="reflect")
    found = truth.errors(LevelSet(other, 0.5), 0.25)
    closed = sphere_hits(truth.origins, truth.directions, 0.3)
    assert found["elsewhere"] == int(((closed - truth.t).abs() >= 0.25).sum())
    assert 0 < found["elsewhere"] < found["rays"]
    assert found["distance_max"] < 0.25
