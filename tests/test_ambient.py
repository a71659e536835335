"""What torch is told elsewhere changes no bit: autocast, TF32, the default type, inference mode."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import filterlab as fl
from filterlab.kernels import bspline
from filterlab.methods import METHODS
from filterlab.ops.differentiable.prefilter import prefilter_samples
from filterlab.render import (
    Light,
    OrthographicCamera,
    PerspectiveCamera,
    Phong,
    Shading,
    Silhouettes,
    TransferFunction,
    materials,
    raycast,
    render,
)
from filterlab.signals import SIGNALS
from filterlab.surfaces import LevelSet, mesh
from filterlab.volume import Boundary, Volume
from tests.pairs import covering
from tests.test_methods import kind_of
from tests.test_volume import rotated

FAR = (5e5, 4e6, 120.0)
Case = Callable[[], Sequence[Tensor]]


@contextmanager
def default_type(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def few_digits() -> Iterator[None]:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@contextmanager
def all_short() -> Iterator[None]:
    """Autocast, TF32 and a default type that holds little, all at once."""
    with torch.autocast("cpu", torch.bfloat16), few_digits(), default_type(torch.bfloat16):
        yield


STATES = {"all short": all_short, "default float64": partial(default_type, torch.float64)}


def random(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64).to(dtype)


def volume(*shape: int, origin: Sequence[float] = FAR, dtype: torch.dtype = torch.float32) -> Volume:
    return Volume(random(*(shape or (7, 8, 9)), dtype=dtype), affine=rotated(origin=origin))


def near(domain, count: int = 40) -> Tensor:
    """World points in and about a domain, float64."""
    corners = domain.corners()
    low, high = corners.amin(0), corners.amax(0)
    return low + (random(count, 3, dtype=torch.float64) * 1.4 - 0.2) * (high - low)


# --- cases ------------------------------------------------------------------------------------------------------------


def jets(method: str, scheme: str, inference: bool = False) -> Sequence[Tensor]:
    """Values, derivatives by points and by samples; of points in float64, and in float32 from nearby."""
    source = volume()
    source.samples.requires_grad_(not inference)
    field = fl.reconstruct(source, method, scheme=scheme, gradient=METHODS[method].gradient_of(scheme))
    points = near(field.domain)
    found: list[Tensor] = []
    for own, at in ((field, points), (field.relative_to(FAR), (points - points.new_tensor(FAR)).float())):
        at = at.requires_grad_(not inference)
        rows = own.jet(at, field.max_order)
        found += rows
        if not inference:
            total = sum(row.square().sum() for row in rows[:2])
            found += torch.autograd.grad(total, [source.samples, at], create_graph=True)
    return found


def moved_points(method: str) -> Sequence[Tensor]:
    field = fl.reconstruct(volume(origin=(0, 0, 0)), method)
    points = near(field.domain).float()
    return torch.func.jvp(field, (points,), (torch.ones_like(points),))


def geometry() -> Sequence[Tensor]:
    grid = volume(origin=(3.0, 4.0, 5.0)).geometry
    points, hessian = random(50, 3) * 10, random(50, 3, 3)
    maps = (grid.to_world, grid.to_voxel, grid.direction_to_voxel, grid.gradient_to_world)
    return [*(change(points) for change in maps), grid.hessian_to_world(hessian)]


def prefilters(boundary: str, implementation: str) -> Sequence[Tensor]:
    return [prefilter_samples(random(5, 6, 7), "cubic", boundary, 3, implementation)]


def resampled(method: str) -> Sequence[Tensor]:
    source, turned = volume(), Volume(torch.zeros(6, 7, 8), affine=rotated((0.6, 0.9, 1.7), FAR) @ TURN)
    aligned = Volume(torch.zeros(5, 9, 11), affine=source.affine @ np.diag([0.7, 1, 1.2, 1]))
    source.samples.requires_grad_()
    out = [fl.resample(source, method, like=like).samples for like in (turned, aligned)]
    if method != "nearest":
        out.append(fl.resample(source.samples.detach().round(), method, labels=True, shape=(6, 7, 8)).samples)
    return [*out, torch.autograd.grad(out[0].sum() + out[1].square().sum(), source.samples)[0]]


TURN = torch.tensor([[0.8, -0.6, 0, 1], [0.6, 0.8, 0, 1], [0, 0, 1, 0.5], [0, 0, 0, 1]], dtype=torch.float64).numpy()


def missing() -> Sequence[Tensor]:
    samples = random(7, 8, 9)
    samples[2:4, 3, 3:5] = torch.nan
    field = fl.reconstruct(samples, "tricubic", nan="fill")
    return [field(near(field.domain).float())]


def signal(name: str) -> Sequence[Tensor]:
    own = SIGNALS[name]()
    points = near(own.domain).float()
    origins = points[:20] * 3
    found = [*own.value_and_gradient(points), own.sample(5).samples]
    if own.search is not None:
        found.append(own.first_crossing(origins, -origins, 0.3))
    return found


def balls(
    method: str = "triquadratic", scheme: str | None = None, origin: Sequence[float] = FAR
) -> fl.fields.base.Field:
    z, y, x = torch.meshgrid(*(torch.arange(10.0, dtype=torch.float32) - 4.5,) * 3, indexing="ij")
    samples = 20 - (x**2 + y**2 + 1.3 * z**2) + 2 * random(10, 10, 10)
    return fl.reconstruct(Volume(samples, affine=rotated(origin=origin)), method, scheme=scheme)


def views(field) -> list:
    direction, up = (0.5, 0.7, -0.4), (0, 0.2, 1)
    return [
        camera.framing(field.domain, direction=direction, up=up) for camera in (PerspectiveCamera, OrthographicCamera)
    ]


def cameras() -> Sequence[Tensor]:
    return [x for view in views(balls()) for x in view.rays(9, 7)]


def images(method: str, scheme: str) -> Sequence[Tensor]:
    field = balls(method, scheme)
    transfer = TransferFunction.triangle_peaks([(12, 10, 0.2, (0.3, 0.5, 0.6)), (5, 6, 0.5, (1, 0.4, 0.1))])
    options = {"size": (9, 7), "shading": Shading(lights=[Light((-0.2, -1, 0.8))])}
    found = [render(field, view, transfer, jitter_seed=1, **options) for view in views(field)]
    values = field.coefficients.values.clone().requires_grad_()
    image = render(field.with_tensors([values]), views(field)[0], transfer, **options)
    return [*found, *torch.autograd.grad(image.square().sum(), values)]


MATERIALS = {
    "phong": Phong((0.8, 0.7, 0.5)),
    "toon": materials.Toon(contour=2.0),
    "lines": materials.ReflectionLines(),
    "environment": materials.Environment(),
    "curvature": Phong(materials.ByCurvature(TransferFunction([-1, 1], [(1, 0, 0), (0, 0, 1)], [1, 1]))),
}


def surfaces(method: str, material: str) -> Sequence[Tensor]:
    field = balls(method)
    view = views(field)[0]
    lights = [Light((-0.2, -1, 0.8)), Light(None, (0.3, 0.3, 0.3))]
    channels = ("color", "depth", "normal", "position")
    options = {"size": (9, 7), "lights": lights, "channels": channels, "shadows": True}
    return list(raycast(LevelSet(field, 8.0), view, MATERIALS[material], **options).values())


def edges() -> Sequence[Tensor]:
    level = torch.tensor(8.0, dtype=torch.float64, requires_grad=True)
    field = balls()
    image = raycast(LevelSet(field, level), views(field)[1], size=(5, 4), silhouettes=Silhouettes(1))
    return [image, *torch.autograd.grad(image[..., 3].sum(), level)]


def triangles() -> Sequence[Tensor]:
    made = mesh(LevelSet(balls(), 8.0))
    return [made.vertices, made.faces, made.normals]


EVALUATIONS = covering(
    ((m, s) for m, method in METHODS.items() for s in method.schemes), lambda m, s: (m, (kind_of(m), s))
)
KINDS = ("trilinear", "ncrsi", "tricubic", "quadratic-c1")

CASES: dict[str, Case] = {
    "geometry": geometry,
    "cameras": cameras,
    "missing": missing,
    "edges": edges,
    "mesh": triangles,
    "kernels": lambda: [bspline(3).fourier(random(5, 4))],
    "responses": lambda: [
        fl.spectrum.axis_response("notch", random(4)),
        fl.spectrum.measured_response("notch", random(4)),
    ],
    **{f"prefilter-{b}-{i}": partial(prefilters, b, i) for b in Boundary for i in ("reference", "cpu")},
    **{f"jets-{m}-{s}": partial(jets, m, s) for m, s in EVALUATIONS},
    **{f"jvp-{m}": partial(moved_points, m) for m in KINDS},
    **{f"resample-{m}": partial(resampled, m) for m in METHODS},
    **{f"signal-{name}": partial(signal, name) for name in SIGNALS},
    **{f"image-{m}-{s}": partial(images, m, s) for m in ("triquadratic", "qss") for s in ("direct", "fused")},
    **{f"surface-{m}-phong": partial(surfaces, m, "phong") for m in KINDS},
    **{f"surface-triquadratic-{material}": partial(surfaces, "triquadratic", material) for material in MATERIALS},
}


PRODUCTS = ("mm", "bmm", "addmm", "baddbmm", "addbmm", "mv", "addmv", "dot", "vdot", "linear", "convolution")


class NoProducts(TorchDispatchMode):
    """No matrix product of numbers that autocast or TF32 would shorten: TF32 does so on GPUs only."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.__name__.split(".")[0]
        short = any(isinstance(a, Tensor) and a.dtype == torch.float32 for a in args)
        assert not (name in PRODUCTS and short), f"a matrix product: {function}"
        return function(*args, **(kwargs or {}))


def same(found: Sequence[Tensor], expected: Sequence[Tensor]) -> None:
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == b.dtype
        torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("case", CASES)
def test_what_torch_is_told_elsewhere_changes_no_bit(case: str) -> None:
    with NoProducts():
        expected = CASES[case]()
    assert all(x.numel() for x in expected)
    for name, state in STATES.items():
        with state():
            found = CASES[case]()
        try:
            same(found, expected)
        except AssertionError as error:
            raise AssertionError(f"{case} under {name}: {error}") from None


def test_the_states_are_what_they_are_called_and_products_are_seen() -> None:
    a = random(4, 4)
    for product in (torch.matmul, lambda a, b: torch.einsum("ij,jk->ik", a, b), lambda a, b: a @ b[0]):
        with pytest.raises(AssertionError, match="a matrix product"), NoProducts():
            product(a, a)
        with STATES["all short"]():
            assert product(a, a).dtype == torch.bfloat16
    with STATES["default float64"]():
        assert torch.tensor(0.5).dtype == torch.float64


@pytest.mark.parametrize("method", METHODS)
def test_inference_mode_changes_no_bit_and_leaves_nothing_behind(method: str) -> None:
    """What is kept between calls must not be a tensor that derivatives can't be taken by."""
    for scheme in METHODS[method].schemes:
        with torch.inference_mode():
            found = jets(method, scheme, inference=True)
        same(found, jets(method, scheme, inference=True))
        jets(method, scheme)
