"""What people call, on a GPU against the CPU: nothing here runs where there is none. `tests/ops` has the programs."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the package triton is not installed")

from experiments.covers import torus
from filterlab import reconstruct, resample
from filterlab.methods import METHODS
from filterlab.ops.differentiable.prefilter import implementation_for, prefilter_samples
from filterlab.prefilters import PREFILTERS
from filterlab.render import Light, PerspectiveCamera, Phong, Shading, Silhouettes, TransferFunction, raycast, render
from filterlab.roots import all_roots, first_root
from filterlab.surfaces import BilinearQuads, HeightField, LevelSet, Quadrics, Slim, Surface
from filterlab.surfaces.quartic import SPLINES as QUARTIC
from filterlab.volume import Boundary, Volume
from tests.test_methods import CONTINUOUS
from tests.tetrahedral_oracle import SPLINES

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU that torch can use")

TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-11}
BOUNDARIES = [str(b.value) for b in Boundary]
CASES = [(method, scheme) for method, m in METHODS.items() for scheme in m.facts.schemes]


def assert_same(on_gpu: Tensor, on_cpu: Tensor) -> None:
    """In units of the largest magnitude."""
    assert on_gpu.device.type == "cuda"
    assert on_gpu.dtype == on_cpu.dtype
    limit = TOLERANCE[on_cpu.dtype] * float(on_cpu.detach().abs().max() + 1e-30)
    torch.testing.assert_close(on_gpu.cpu(), on_cpu, rtol=0, atol=limit)


def samples(dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand((2, 3, 9, 8, 10), generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)


def points(dtype: torch.dtype = torch.float64) -> Tensor:
    """Inside and outside of the volume."""
    return torch.rand((2, 501, 3), generator=torch.Generator().manual_seed(2), dtype=torch.float64).to(dtype) * 16 - 4


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize(("method", "scheme"), CASES)
def test_values_gradients_and_derivatives(method: str, scheme: str, boundary: str) -> None:
    """Of every method, in every way of evaluating it: value, gradient, and both derivatives of them."""
    for dtype in TOLERANCE:
        results = []
        for device in ("cpu", "cuda"):
            gradient = "central" if (method, scheme) == ("trilinear", "sampled") else None
            x = samples(dtype).to(device).requires_grad_()
            p = points(dtype).to(device).requires_grad_()
            field = reconstruct(x, method, boundary=boundary, scheme=scheme, gradient=gradient)
            jet = field.value_and_gradient(p)
            weighed = jet[0].sin().sum() + jet[1].square().sum()
            results.append((*jet, *torch.autograd.grad(weighed, (x, p))))
        for of_cpu, of_gpu in zip(*results, strict=True):
            assert_same(of_gpu, of_cpu)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("prefilter", [name for name, p in PREFILTERS.items() if not p.is_identity])
def test_prefilters_and_their_derivatives(prefilter: str, boundary: str) -> None:
    """By what is chosen on each device."""
    for shape in ((1, 2, 3), (2, 17, 16, 33), (3, 3, 70, 5)):
        for dtype in TOLERANCE:
            results = []
            for device in ("cpu", "cuda"):
                x = torch.rand(shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64).to(dtype)
                x = (2 * x - 1).to(device).requires_grad_()
                assert implementation_for(x) == device
                c = prefilter_samples(x, prefilter, boundary, 2, implementation_for(x))
                results.append((c, *torch.autograd.grad(c.square().sum(), x)))
            for of_cpu, of_gpu in zip(*results, strict=True):
                assert_same(of_gpu, of_cpu)


def test_a_prefilter_takes_the_result_and_a_copy_of_memory() -> None:
    """While an axis is filtered, what it is filtered from and what it gives."""
    x = torch.rand(128, 96, 160, device="cuda")
    prefilter_samples(x, "cubic", implementation="cuda")  # tables and programs stay
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    c = prefilter_samples(x, "cubic", implementation="cuda")
    assert torch.cuda.max_memory_allocated() - before <= 2 * c.nbytes + (1 << 20)


@pytest.mark.parametrize("method", METHODS)
def test_the_default_runs_there(method: str) -> None:
    """Also without a copy of what is stored in fewer bytes."""
    for storage in (None, "float16"):
        fields = [reconstruct(samples().to(d), method, storage=storage) for d in ("cpu", "cuda")]
        on_cpu, on_gpu = (field.jet(points().to(d), 1) for field, d in zip(fields, ("cpu", "cuda"), strict=True))
        for of_cpu, of_gpu in zip(on_cpu, on_gpu, strict=True):
            assert_same(of_gpu, of_cpu)


def test_resampling() -> None:
    volumes = [Volume(samples(torch.float32)[0, 0].to(d), spacing=(1.0, 2.0, 0.5)) for d in ("cpu", "cuda")]
    on_cpu, on_gpu = (resample(v, "tricubic", shape=(13, 7, 9)).samples for v in volumes)
    assert_same(on_gpu, on_cpu)


def _image(device: str, method: str, scheme: str | None, dtype: torch.dtype) -> dict[str, Tensor]:
    """An image and its derivatives by volume and transfer function."""
    x = samples(dtype)[0, 0].to(device).requires_grad_()
    options = {} if scheme is None else {"scheme": scheme}
    field = reconstruct(Volume(x, spacing=(0.5, 1.0, 0.8)), method, **options)
    # gradients of qss jump at x = y and the like, in voxels, where rounding must not decide
    camera = PerspectiveCamera.framing(field.domain, (0.37, 0.81, -0.46))
    opacities = torch.tensor([0.01, 0.3, 0.1], dtype=dtype, device=device, requires_grad=True)
    colors = [[0.2, 0.3, 0.9], [0.8, 0.5, 0.1], [0.4, 0.9, 0.3]]
    transfer = TransferFunction([0.1, 0.4, 0.9], colors, opacities, unit=0.2)
    shading = Shading((Light((1.0, -2.0, 1.0)), Light(None, (0.3, 0.4, 0.5))), ambient=0.3)
    image = render(field, camera, transfer, size=(33, 21), shading=shading, dtype=dtype, device=device)
    weights = torch.linspace(-0.3, 0.7, image.numel(), dtype=dtype, device=device).reshape(image.shape)
    found = torch.autograd.grad((image * weights).sum(), (x, opacities))
    return {"image": image, "volume": found[0], "opacities": found[1]}


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize("method", METHODS)
def test_images_and_their_derivatives(method: str, dtype: torch.dtype) -> None:
    expected = _image("cpu", method, None, dtype)
    found = _image("cuda", method, None, dtype)
    for name, x in expected.items():
        limit = {torch.float32: 3e-4, torch.float64: 1e-10}[dtype] * float(x.detach().abs().max())
        torch.testing.assert_close(found[name].cpu(), x, rtol=0, atol=limit, msg=lambda t, name=name: f"{name}: {t}")
    assert expected["image"][..., 3].max() > 0.3


@pytest.mark.parametrize("degree", range(1, 10))
def test_roots(degree: int) -> None:
    c = 2 * torch.rand((5000, degree + 1), generator=torch.Generator().manual_seed(degree), dtype=torch.float64) - 1
    found, expected = first_root(c.cuda()).cpu(), first_root(c)
    assert torch.equal(found.isfinite(), expected.isfinite())
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
    assert torch.equal(all_roots(c.cuda()).count.cpu(), all_roots(c).count)


def _hits(device: str, method: str, dtype: torch.dtype) -> dict[str, Tensor]:
    """First hits of rays with a rough level set, its geometry, all crossings, and derivatives."""
    n = 3000
    x = samples(dtype)[0, 0].to(device).requires_grad_()
    gradient = "analytic" if method == "trilinear" else None
    field = reconstruct(Volume(x, spacing=(0.5, 1.0, 0.8)), method, gradient=gradient)
    surface = LevelSet(field, 0.5)
    ends = torch.rand((2, n, 3), generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    origins = (ends[0] * 20 - 8).to(dtype).to(device).requires_grad_()
    directions = ((ends[1] * 5).to(dtype).to(device) - origins.detach()).requires_grad_()
    hit = surface.hit(origins, directions)
    at = surface.at(origins, directions, hit, order=1)
    depth = torch.where(hit.valid, hit.t, 0)
    steep = hit.valid & ((at.normal * directions).sum(-1).abs() > 0.2)  # derivatives grow without bound on grazing rays
    weighed = torch.where(steep, depth, 0).square().sum() + torch.where(steep[:, None], at.normal, 0).sin().sum()
    found = torch.autograd.grad(weighed, (x, origins))
    counts = surface.hits(origins.detach(), directions.detach(), sheets=6).valid.sum(-1)
    normal = torch.where(steep[:, None], at.normal, 0)
    return {"t": depth, "normal": normal, "volume": found[0], "origins": found[1], "counts": counts, "steep": steep}


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize("method", [*CONTINUOUS, *SPLINES])
def test_hits_and_their_derivatives(method: str, dtype: torch.dtype) -> None:
    """A ray or two of float32 may graze the level, and pass on one device."""
    expected, found = _hits("cpu", method, dtype), _hits("cuda", method, dtype)
    assert expected["steep"].sum() > 500
    other = (expected["counts"] != found["counts"].cpu()) | (expected["steep"] != found["steep"].cpu())
    exact = dtype == torch.float64
    assert other.sum() <= (0 if exact else 6)
    for name in ("t", "normal", "origins") + (("volume",) if exact else ()):
        a, b = expected[name].double(), found[name].cpu().double()
        if name != "volume":
            a, b = a[~other], b[~other]
        limit = (1e-9 if exact else 2e-3) * float(a.detach().abs().max())
        torch.testing.assert_close(b, a, rtol=0, atol=limit, msg=lambda t, name=name: f"{name}: {t}")


def _assert_sheets_are_those_of_the_cpu(
    build: Callable[[Tensor], Surface], given: Tensor, rays: tuple[Tensor, Tensor]
) -> None:
    """Hits, in order, and derivatives to what a surface is built of."""
    found = []
    for device in ("cpu", "cuda"):
        x = given.to(device).requires_grad_()
        surface = build(x)
        o, d = (r.to(device) for r in rays)
        hits = surface.hits(o, d, 3)
        at = surface.at(o, d, hits)
        steep = hits.valid & ((at.normal * d[:, None]).sum(-1).abs() > 0.2)
        (gradient,) = torch.autograd.grad(torch.where(steep, hits.t, 0).sum(), x)
        found.append((hits.piece, torch.where(hits.valid, hits.t, 0), gradient))
    (piece, t, gradient), on_gpu = found
    assert torch.equal(on_gpu[0].cpu(), piece)
    assert_same(on_gpu[1], t)
    limit = TOLERANCE[rays[0].dtype] * float(gradient.abs().max())  # t is rounded to it
    torch.testing.assert_close(on_gpu[2].cpu(), gradient, rtol=0, atol=limit)


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
def test_quadrics(dtype: torch.dtype) -> None:
    rng = torch.Generator().manual_seed(2)
    centers, radii = 5 * torch.rand(300, 3, generator=rng).double(), 0.1 + 0.4 * torch.rand(300, generator=rng).double()
    origins, ends = (8 * torch.rand(2, 2000, 3, generator=rng).double() - 1.5).to(dtype)
    build = lambda x: Quadrics.ellipsoids(x, radii.to(x))  # noqa: E731
    _assert_sheets_are_those_of_the_cpu(build, centers, (origins, ends - origins))


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
def test_bilinear_quads(dtype: torch.dtype) -> None:
    rng = torch.Generator().manual_seed(9)
    quads = torch.arange(1200).view(300, 4)
    square = torch.tensor([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]).double()
    places = 5 * torch.rand(300, 1, 3, generator=rng) + 0.3 * torch.randn(300, 4, 3, generator=rng)
    origins, ends = (8 * torch.rand(2, 2000, 3, generator=rng).double() - 1.5).to(dtype)
    build = lambda x: BilinearQuads(x, quads.to(x.device))  # noqa: E731
    _assert_sheets_are_those_of_the_cpu(build, (square + places).view(-1, 3), (origins, ends - origins))


def _of_surface(surface: Surface, x: Tensor, origins: Tensor, directions: Tensor) -> dict[str, Tensor]:
    """First hits, what is known of them, all sheets, and derivatives to what the surface is made of and to rays."""
    o = origins.clone().requires_grad_()
    hit = surface.hit(o, directions)
    at = surface.at(o, directions, hit)
    steep = hit.valid & ((at.normal * directions).sum(-1).abs() > 0.2 * directions.norm(dim=-1))
    depth, normal = torch.where(steep, hit.t, 0), torch.where(steep[:, None], at.normal, 0)
    to_numbers, to_origins = torch.autograd.grad(depth.square().sum() + normal.sin().sum(), (x, o))
    sheets = surface.hits(origins, directions, 3)
    assert int(steep.sum()) > 300
    return {
        "t": depth,
        "normal": normal,
        "sheets": torch.where(sheets.valid, sheets.t, -1.0),
        "met": surface.met(origins, directions).double(),
        "numbers": to_numbers,
        "origins": to_origins,
    }


def _assert_all_same(on_cpu: dict[str, Tensor], on_gpu: dict[str, Tensor], limit: float) -> None:
    for name, x in on_cpu.items():
        most = limit * float(x.detach().abs().max())
        torch.testing.assert_close(on_gpu[name].cpu(), x, rtol=0, atol=most, msg=lambda t, name=name: f"{name}: {t}")


@pytest.mark.parametrize("spline", QUARTIC)
def test_terrains(spline: str) -> None:
    rng = torch.Generator().manual_seed(8)
    heights = torch.rand(150, 200, generator=rng, dtype=torch.float64) * 3
    origins, ends = torch.rand(2, 4000, 3, generator=rng, dtype=torch.float64) * torch.tensor([220.0, 170.0, 30.0])
    ends[:, 2] *= 0.03
    points = torch.rand(3000, 2, generator=rng, dtype=torch.float64) * 220 - 10
    results = []
    for device in ("cpu", "cuda"):
        x = heights.to(device).requires_grad_()
        surface = HeightField(x, spline)
        jet = surface.jet(points.to(device), 2)
        found = _of_surface(surface, x, origins.to(device), (ends - origins).to(device))
        found |= {f"jet {k}": part for k, part in enumerate(jet)}
        (found["splat"],) = torch.autograd.grad(sum(part.square().sum() for part in jet), x)
        found["viewshed"] = surface.viewshed((70.0, 60.0), 2.0).double()
        results.append(found)
    _assert_all_same(*results, 1e-9)


@pytest.mark.parametrize("faces", ["front", "both"])
def test_covers(faces: str) -> None:
    rng = torch.Generator().manual_seed(9)
    centers, *rest = torus(1500)
    low, high = centers.amin(0), centers.amax(0)
    origins, ends = torch.rand(2, 4000, 3, generator=rng, dtype=torch.float64) * (high - low).double() + low.double()
    origins = origins + 3 * (origins - (low + high) / 2)
    results = []
    for device in ("cpu", "cuda"):
        c = centers.to(device).requires_grad_()
        surface = Slim(c, *(x.to(device) for x in rest), faces=faces)
        results.append(_of_surface(surface, c, origins.to(device), (ends - origins).to(device)))
    _assert_all_same(*results, 1e-8)


def _surface_of(kind: str, device: str) -> tuple[Surface, Tensor]:
    """A surface, and the numbers that it is made of."""
    rng = torch.Generator().manual_seed(4)
    if kind == "terrain":
        x = (torch.rand(40, 50, generator=rng, dtype=torch.float64) * 8).to(device).requires_grad_()
        return HeightField(x), x
    if kind == "cover":
        x, *rest = (part.to(device) for part in torus(300))
        return Slim(x.requires_grad_(), *rest), x
    x = samples()[0, 0].to(device).requires_grad_()
    return LevelSet(reconstruct(x, kind), 0.5), x


@pytest.mark.parametrize("kind", ["triquadratic", "cubic-c1", "terrain", "cover"])
def test_pictures_of_surfaces_and_their_derivatives(kind: str) -> None:
    """With lights, shadows and what edges sweep over."""
    results = []
    for device in ("cpu", "cuda"):
        surface, x = _surface_of(kind, device)
        camera = PerspectiveCamera.framing(surface.domain, (0.37, 0.81, -0.46))
        lights = (Light((1.0, -2.0, 1.5)), Light(None, (0.3, 0.4, 0.5)))
        options = {"size": (24, 20), "dtype": torch.float64, "device": device, "lights": lights, "shadows": True}
        image = raycast(surface, camera, Phong((0.8, 0.6, 0.4)), silhouettes=Silhouettes(2), **options)
        assert isinstance(image, Tensor)
        weights = torch.linspace(-0.3, 0.7, image.numel(), dtype=image.dtype, device=device).reshape(image.shape)
        (found,) = torch.autograd.grad((image * weights).sum(), x)
        results.append({"image": image, "numbers": found})
    _assert_all_same(*results, 1e-7)
    assert float(results[0]["image"].detach()[..., 3].mean()) > 0.1
