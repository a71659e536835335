"""Casting rays in Triton against its plain twin: in Triton's interpreter everywhere, on a GPU where there is one."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the package triton is not installed")

import filterlab as fl
from filterlab.fields.grid import GridField
from filterlab.kernels import KERNELS
from filterlab.methods import from_kernel
from filterlab.ops.cuda import crossings, launch
from filterlab.ops.cuda import raycast as cuda
from filterlab.ops.differentiable import raycast
from filterlab.ops.raycast import Raycast, Sheets
from tests.ops.front_end import intermediate
from tests.ops.test_raycast import (
    AFFINE,
    described,
    rays,
    rays_on_the_last_faces,
    rays_through_a_level_between_cells,
    samples,
)
from tests.ops.test_sheets import along_z, parabola, up_and_down
from tests.test_methods import TENSOR_PRODUCTS

FEW, MANY = 33, 20_000  # the interpreter takes 50 ms for a ray; 33 are more than a program has


def on(device: str, given: Raycast) -> Raycast:
    lattice = replace(given.lattice, coefficients=given.lattice.coefficients.to(device))
    return replace(given, lattice=lattice, marks=given.marks.to(device))


def cast(field: GridField, device: str, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """t of first hits by plain torch, and by the program."""
    given, (o, d) = described(field, dtype), rays(field, FEW if device == "cpu" else MANY, dtype)
    return raycast.first(given, o, d, "reference"), cuda.first(on(device, given), o.to(device), d.to(device)).cpu()


def assert_the_same_hits(field: GridField, device: str) -> None:
    expected, found = cast(field, device)
    hit = expected < torch.inf
    assert 0.2 < hit.double().mean() < 1
    assert torch.equal(hit, found < torch.inf)
    assert float((expected - found)[hit].abs().max()) <= 1e-11


def assert_the_same_candidates(field: GridField, device: str) -> None:
    given, (o, d) = described(field), rays(field, FEW if device == "cpu" else MANY // 10)
    expected = raycast.candidates(given, o, d, "reference")
    found = cuda.candidates(on(device, given), o.to(device), d.to(device))
    order = found.ray.argsort(stable=True)  # those with many come later
    for name, column in expected._asdict().items():
        own = getattr(found, name)[order].cpu()
        if column.is_floating_point():
            assert float((own - column).abs().max()) <= 1e-11, name
        else:
            assert torch.equal(own, column), name


@pytest.mark.parametrize("boundary", ["mirror", "zeros"])
@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_the_same_hits(method: str, boundary: str, device: str) -> None:
    if device == "cpu" and (method, boundary) not in {("triquadratic", "mirror"), ("ncrsi", "zeros")}:
        pytest.skip("the interpreter takes one method of each kind")
    assert_the_same_hits(fl.reconstruct(fl.Volume(samples(), affine=AFFINE), method, boundary=boundary), device)


@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_the_same_pieces(method: str, device: str) -> None:
    if device == "cpu" and method != "trilinear":
        pytest.skip("the interpreter takes the smallest")
    assert_the_same_candidates(fl.reconstruct(fl.Volume(samples(), affine=AFFINE), method), device)


@pytest.mark.parametrize("name", [name for name, kernel in KERNELS.items() if kernel.degree <= 3])
def test_kernels(name: str, device: str) -> None:
    """Those that jump as well: there every cell is looked into, and a jump over the level is a hit."""
    if device == "cpu" and (name == "linear" or KERNELS[name].continuity >= 0 or KERNELS[name].degree > 1):
        pytest.skip("the interpreter takes what jumps")
    field = fl.reconstruct(samples(), from_kernel(KERNELS[name]), prefilter=False)
    assert_the_same_hits(field, device)
    if device == "cuda":
        assert_the_same_candidates(field, device)


@pytest.mark.parametrize("storage", ["float16", "bfloat16", "float32", "int16", "uint8"])
def test_storage(storage: str, device: str) -> None:
    if device == "cpu" and storage != "uint8":
        pytest.skip("the interpreter takes what is scaled")
    assert_the_same_hits(fl.reconstruct(samples(), "trilinear", storage=storage), device)


@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_float32_is_rounded_only(method: str, device: str) -> None:
    if device == "cpu" and method != "trilinear":
        pytest.skip("the interpreter takes the smallest")
    expected, found = cast(fl.reconstruct(samples(), method), device, torch.float32)
    both = (expected < torch.inf) & (found < torch.inf)
    assert float(((expected < torch.inf) == (found < torch.inf)).double().mean()) > 0.998
    assert float(((expected - found)[both].abs() < 1e-4).double().mean()) > 0.998


def test_a_piece_that_begins_where_one_ended_on_the_level_is_told_of(device: str) -> None:
    given, o, d = rays_through_a_level_between_cells()
    found = cuda.candidates(on(device, given), o.to(device), d.to(device))
    order = found.ray.argsort(stable=True)
    assert found.ray[order].tolist() == [0, 0, 1, 1]
    assert found.repeated[order].tolist() == [False, True] * 2


def test_rays_on_the_last_faces_of_the_domain(device: str) -> None:
    field, o, d = rays_on_the_last_faces()
    given = field._raycast(3.0, o, d)
    found = cuda.first(on(device, given), o.to(device), d.to(device)).cpu()
    assert torch.allclose(found, raycast.first(given, o, d, "reference"), rtol=0, atol=1e-12)


def assert_the_same_sheets(given: Raycast, o: Tensor, d: Tensor, asked: Sheets, device: str) -> Tensor:
    expected = raycast.sheets(given, o, d, asked, "reference")
    found = cuda.sheets(on(device, given), o.to(device), d.to(device), asked).cpu()
    hit = expected < torch.inf
    assert torch.equal(hit, found < torch.inf)
    assert float((expected - found)[hit].abs().max()) <= 1e-11
    return found


@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_the_same_sheets(method: str, device: str) -> None:
    if device == "cpu" and method != "trilinear":
        pytest.skip("the interpreter takes the smallest")
    field = fl.reconstruct(fl.Volume(samples(), affine=AFFINE), method)
    given, (o, d) = described(field), rays(field, 12 if device == "cpu" else MANY // 10)
    found = assert_the_same_sheets(given, o, d, Sheets(3, False, 20.0), device)
    assert torch.equal(found[:, 0], cuda.first(on(device, given), o.to(device), d.to(device)).cpu())
    assert_the_same_sheets(given, o, d, Sheets(2, True, 20.0), device)


@pytest.mark.parametrize("values", [[0.0, 1, 2, 2, 2, 3], [0.0, 2, 0, 2, 3, 2]])
def test_sheets_on_stretches_and_corners(values: list[float], device: str) -> None:
    assert_the_same_sheets(*up_and_down(along_z(values), 2.0), Sheets(5, False, 20.0), device)


@pytest.mark.parametrize("depth", [1e-16, 1e-10, -1e-10])
def test_sheets_at_two_roots_that_are_nearly_one(depth: float, device: str) -> None:
    given, o, d = up_and_down(along_z(parabola(), "triquadratic", boundary="border"), depth)
    expected = raycast.sheets(given, o, d, Sheets(3, False, 20.0), "cpu")
    found = cuda.sheets(on(device, given), o.to(device), d.to(device), Sheets(3, False, 20.0)).cpu()
    assert torch.equal(found < torch.inf, expected < torch.inf)
    assert torch.allclose(found, expected, rtol=0, atol=1e-7)


def test_no_rays(device: str) -> None:
    field = fl.reconstruct(samples(), "trilinear")
    given, (o, d) = described(field), rays(field, 0)
    assert cuda.first(on(device, given), o.to(device), d.to(device)).shape == (0,)
    assert cuda.candidates(on(device, given), o.to(device), d.to(device)).coefficients.shape == (0, 4)


def test_a_field_on_a_gpu_is_cast_there(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By default, for a field whose coefficients lie there."""
    field = fl.reconstruct(samples(), "trilinear")
    o, d = (x[:3].to(device) for x in rays(field))
    given = on(device, described(field))
    monkeypatch.setattr(raycast, "_implementation_for", lambda given: "cuda")
    asked: list[int] = []
    monkeypatch.setattr(cuda, "first", lambda given, o, d: asked.append(len(o)))
    assert raycast.missing(given, o) is None
    raycast.first(given, o, d)
    assert asked == [3]


def program_of(method: str, asked: str):
    """What Triton compiles, for numbers of 32 bits."""
    from triton.compiler import ASTSource  # pyright: ignore[reportMissingImports]

    lattice = fl.reconstruct(samples(), method).lattice
    stencil = lattice.stencil.lowered
    variant = crossings.RaycastVariant(asked, stencil, lattice.degree, lattice.continuous, "float32")
    types = dict.fromkeys(("coefficients", "origins", "directions", "pieces"), "*fp32")
    types |= dict.fromkeys(("numbers", "t", "places"), "*fp64")
    types |= {"marks": "*i16", "flags": "*u8", "count": "*i64", "BLOCK": "constexpr"}
    written = launch.launchable(variant.write())
    return ASTSource(written, {p.name: types.get(p.name, "i32") for p in written.params}, {"BLOCK": cuda.BLOCK})


@pytest.mark.parametrize(
    ("method", "asked", "taps"),
    [("trilinear", "first", 8), ("trilinear", "candidates", 8), ("qss", "first", 27)],
)
def test_compiles_for_a_gpu_that_need_not_be_there(method: str, asked: str, taps: int, compiling: None) -> None:
    from triton.backends.compiler import GPUTarget  # pyright: ignore[reportMissingImports]
    from triton.compiler import compile  # pyright: ignore[reportMissingImports]

    made = compile(program_of(method, asked), target=GPUTarget("cuda", 80, 32), options={"num_warps": 1})
    lines = made.asm["ptx"].splitlines()
    assert not [line for line in lines if "bar.sync" in line]  # one warp waits for nobody
    assert sum("ld.global.b32" in line for line in lines) == 6 + taps  # of a ray, and of a cell or a cube


@pytest.mark.parametrize(
    ("method", "asked", "loops"),
    [("cubic-c1", "candidates", 3), ("quadratic-c1", "first", 5), ("trilinear", "sheets", 7)],
)
def test_is_taken_by_the_compilers_front_end(method: str, asked: str, loops: int, compiling: None) -> None:
    """That of types and loops: what comes behind it takes 6 to 12 s for these programs."""
    made = intermediate(program_of(method, asked))
    assert made.count("scf.while") == loops
