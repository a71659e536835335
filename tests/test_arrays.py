"""NumPy arrays are taken wherever tensors are, however they lie in memory, and what comes out is what tensors give."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from typing import Any

import numpy as np
import pytest
import torch

import filterlab as fl
from filterlab import costs, spectrum
from filterlab.arrays import as_tensor
from filterlab.nn import Reconstruction
from filterlab.render import Light, PerspectiveCamera, Phong, Shading, TransferFunction, raycast, render
from filterlab.render.materials import Environment, ReflectionLines, Triplanar
from filterlab.surfaces import LevelSet

RNG = np.random.default_rng(3)
SAMPLES = RNG.random((4, 5, 6))
POINTS = RNG.random((7, 3)) * 3
SIGNAL = fl.signals.sphere()
ORIGINS, TOWARD = np.array([[0.1, -3.0, 0.2], [0.0, -3.0, -0.1]]), np.array([[0.0, 1.0, 0.05], [0.1, 1.0, 0.0]])
TRANSFER = TransferFunction([0.0, 1.0], [[1.0, 0, 0], [0, 1, 0]], [0.0, 0.5])


def read_only(a: np.ndarray) -> np.ndarray:
    b = a.copy()
    b.setflags(write=False)
    return b


def backwards(a: np.ndarray) -> np.ndarray:
    return np.flip(np.flip(a).copy())


def between_others(a: np.ndarray) -> np.ndarray:
    return np.repeat(a, 2, axis=-1)[..., ::2]


def in_a_record(a: np.ndarray) -> np.ndarray:
    """Strides that are no multiple of an item."""
    record = np.zeros(a.shape, dtype=[("tag", "u1"), ("value", a.dtype)])
    record["value"] = a
    return record["value"]


FORMS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "plain": np.copy,
    "read-only": read_only,
    "backwards": backwards,
    "foreign bytes": lambda a: a.astype(a.dtype.newbyteorder()),
    "Fortran's order": np.asfortranarray,
    "between others": between_others,
    "in a record": in_a_record,
    "broadcast": lambda a: np.broadcast_to(a, (2, *a.shape))[0],
}


def field() -> fl.Field:
    return fl.reconstruct(torch.from_numpy(SAMPLES), "triquadratic")


def camera(position: Any) -> PerspectiveCamera:
    return PerspectiveCamera(position=position, target=(0.0, 0.0, 0.0))


def picture(seen: Any, **options: Any) -> torch.Tensor:
    return render(SIGNAL, seen, options.pop("transfer", TRANSFER), step=4.0, **options)


def surface(material: Any) -> Any:
    return raycast(LevelSet(SIGNAL, 0.5), (torch.from_numpy(ORIGINS), torch.from_numpy(TOWARD)), material)


TAKEN: dict[str, tuple[np.ndarray, Callable[[Any], Any]]] = {
    "Volume": (SAMPLES, lambda a: fl.Volume(a).samples),
    "Volume.voxel_to_world": (POINTS, fl.Volume(torch.zeros(2, 2, 2), spacing=2).voxel_to_world),
    "Volume.world_to_voxel": (POINTS, fl.Volume(torch.zeros(2, 2, 2), spacing=2).world_to_voxel),
    "from_grid_sample": (POINTS, lambda a: fl.from_grid_sample(a, (4, 5, 6), align_corners=False)),
    "from_zyx": (POINTS, fl.from_zyx),
    "reconstruct": (SAMPLES, lambda a: fl.reconstruct(a)(torch.from_numpy(POINTS))),
    "resample": (SAMPLES, lambda a: fl.resample(a, shape=(3, 4, 9), antialias=True).samples),
    "Reconstruction": (SAMPLES, lambda a: Reconstruction(a)(POINTS)),
    "Reconstruction's points": (POINTS, lambda a: Reconstruction(SAMPLES).jet(a, 2)),
    "field": (POINTS, lambda a: field()(a)),
    "field.value_and_gradient": (POINTS, lambda a: field().value_and_gradient(a)),
    "field.jet": (POINTS, lambda a: field().jet(a, 2)),
    "field.relative_to": (POINTS, lambda a: field().relative_to((1, 2, 3))(a)),
    "field on tetrahedra": (POINTS, lambda a: fl.reconstruct(SAMPLES, "qss").jet(a, 1)),
    "batched field": (POINTS, lambda a: fl.reconstruct(SAMPLES[None, None])(a[None])),
    "signal": (POINTS, lambda a: SIGNAL.jet(a, 2)),
    "signal relative": (POINTS, lambda a: SIGNAL.relative_to((1, 2, 3))(a)),
    "LevelSet.hit": (ORIGINS, lambda a: LevelSet(SIGNAL, 0.5).hit(a, TOWARD).t),
    "LevelSet.hit, directions": (TOWARD, lambda a: LevelSet(SIGNAL, 0.5).hit(ORIGINS, a).t),
    "LevelSet.hits": (ORIGINS, lambda a: LevelSet(SIGNAL, 0.5).hits(a, TOWARD, 2).t),
    "LevelSet.met": (ORIGINS, lambda a: LevelSet(SIGNAL, 0.5).met(a, TOWARD)),
    "LevelSet.at": (
        ORIGINS,
        lambda a: LevelSet(SIGNAL, 0.5).at(a, TOWARD, LevelSet(SIGNAL, 0.5).hit(ORIGINS, TOWARD)).point,
    ),
    "LevelSet.jet": (POINTS, lambda a: LevelSet(field(), 0.5).jet(a, 1)),
    "render, rays": (ORIGINS, lambda a: picture((a, TOWARD))),
    "render, camera": (ORIGINS[0], lambda a: picture(camera(a), size=(3, 2))),
    "render, background": (TOWARD[0], lambda a: picture((ORIGINS, TOWARD), background=a)),
    "render, light": (TOWARD[0], lambda a: picture((ORIGINS, TOWARD), shading=Shading([Light(a)]))),
    "raycast, rays": (ORIGINS, lambda a: raycast(LevelSet(SIGNAL, 0.5), (a, TOWARD))),
    "framing": (TOWARD[0], lambda a: torch.tensor(PerspectiveCamera.framing(SIGNAL.domain, a).position)),
    "TransferFunction": (
        np.linspace(0, 1, 4),
        lambda a: picture((ORIGINS, TOWARD), transfer=TransferFunction(a, np.ones((4, 3)), a / 2)),
    ),
    "TransferFunction's value": (POINTS, TRANSFER),
    "triangle_peaks": (
        np.array([0.2, 0.5, 0.9]),
        lambda a: TransferFunction.triangle_peaks([(0.5, 0.2, 0.5, a)])(torch.linspace(0, 1, 9)),
    ),
    "Phong": (np.array([0.2, 0.5, 0.9]), lambda a: surface(Phong(a))),
    "ReflectionLines": (TOWARD[0], lambda a: surface(ReflectionLines(axis=a))),
    "Triplanar": (RNG.random((3, 4, 3)), lambda a: surface(Phong(Triplanar(a, size=0.5)))),
    "Environment": (RNG.random((3, 4, 3)), lambda a: surface(Environment(a))),
    "rms": (POINTS, lambda a: fl.metrics.rms(a, POINTS + 1)),
    "max_error": (POINTS, lambda a: fl.metrics.max_error(POINTS + 1, a)),
    "angular_error": (POINTS, lambda a: fl.metrics.angular_error(a, POINTS + 1)),
    "psnr": (RNG.random((9, 12)), lambda a: fl.metrics.psnr(a, torch.zeros(9, 12))),
    "ssim": (RNG.random((12, 13)), lambda a: fl.metrics.ssim(a, torch.zeros(12, 13))),
    "kernel": (POINTS, fl.KERNELS["notch"]),
    "kernel.fourier": (POINTS, fl.KERNELS["notch"].fourier),
    "prefilter.response": (POINTS, fl.PREFILTERS["notch"].response),
    "axis_response": (POINTS[0], lambda a: spectrum.axis_response("notch", a)),
    "response": (POINTS, lambda a: spectrum.response("ncrsi", a)),
    "measured_response": (POINTS[0], lambda a: spectrum.measured_response("trilinear", a)),
    "position_responses": (POINTS, lambda a: spectrum.position_responses("trilinear", a)),
    "costs.measure": (POINTS, lambda a: len(costs.measure({"f": field}, a, seconds=0.01))),
    "costs.measure by name": (POINTS, lambda a: len(costs.measure({"f": field}, {"f": a}, seconds=0.01))),
}


@pytest.mark.parametrize(("name", "dtype"), list(zip(TAKEN, cycle((np.float64, np.float32)), strict=False)))
def test_an_array_gives_what_a_tensor_gives(name: str, dtype: type) -> None:
    array, call = TAKEN[name]
    own = array.astype(dtype)
    want = call(torch.from_numpy(own.copy()))
    for form in (
        np.copy,
        read_only,
        backwards,
        FORMS["foreign bytes"],
        in_a_record,
    ):  # all but one of them torch refuses
        equal(call(form(own)), want)


def equal(got: Any, want: Any) -> None:
    if isinstance(want, tuple):
        assert len(got) == len(want)
        for a, b in zip(got, want, strict=True):
            equal(a, b)
    elif isinstance(want, torch.Tensor):
        assert isinstance(got, torch.Tensor)
        assert got.dtype == want.dtype
        assert torch.equal(got, want)
    else:
        assert got == pytest.approx(want, rel=1e-13)  # sums go in the order of memory


@pytest.mark.parametrize("kind", ["u1", "i1", "i2", "i4", "i8", "f2", "f4", "f8"])
def test_samples_keep_their_type_and_values(kind: str) -> None:
    array = (10 * SAMPLES).astype(kind)
    for form in FORMS.values():
        volume = fl.Volume(form(array))
        assert np.array_equal(volume.samples.numpy(), array)
        assert volume.samples.numpy().dtype == array.dtype


def test_memory_is_shared_where_torch_can() -> None:
    array = SAMPLES.copy()
    shared = as_tensor(array)
    array[0, 0, 0] = 7
    assert shared[0, 0, 0] == 7
    tensor = torch.rand(3, requires_grad=True)
    assert as_tensor(tensor) is tensor


@pytest.mark.parametrize(
    ("array", "told"),
    [
        (np.array(["a"]), "numbers that torch has a type for; got <U1"),
        (np.array([None]), "got object"),
        (np.zeros(3, "M8[s]"), "got datetime64"),
        (np.zeros(3, "f4,i4"), "numbers that torch has a type for"),
        (np.ma.masked_less(np.arange(3.0), 1), "without a mask"),
    ],
)  # fmt: skip
def test_other_arrays_are_refused(array: np.ndarray, told: str) -> None:
    with pytest.raises(TypeError, match=told):
        as_tensor(array)
    with pytest.raises(TypeError, match=told):
        fl.Volume(array)
    with pytest.raises(TypeError, match=told):
        field()(array)


@pytest.mark.skipif(np.dtype(np.longdouble).itemsize == 8, reason="a long double is a double here")
def test_more_digits_than_torch_has_are_refused() -> None:
    with pytest.raises(TypeError, match="got float"):
        as_tensor(np.zeros(3, np.longdouble))


@pytest.mark.parametrize("kind", [np.bool_, np.complex128, np.uint16, np.uint32, np.uint64])
def test_what_no_tensor_may_be_no_array_may_be(kind: type) -> None:
    array = np.zeros((2, 2, 2), kind)
    with pytest.raises(TypeError) as wrong:
        fl.Volume(array)
    with pytest.raises(TypeError, match=r"samples must be real|torch cannot index") as as_told:
        fl.Volume(torch.from_numpy(array))
    assert str(wrong.value) == str(as_told.value)
