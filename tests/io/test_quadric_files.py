"""Quadrics in files: what is saved comes back to the bit; what is not theirs is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from filterlab.io import is_quadrics, load_quadrics, save_quadrics
from filterlab.surfaces import BilinearQuads, Quadrics, Tetrahedra, molecular_skin


def rows(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def tetrahedra() -> Quadrics:
    return Quadrics(rows(5, 3, 3).float(), rows(5, 3), rows(5), Tetrahedra(rows(5, 4, 3, seed=1)), faces="front")


KINDS = {
    "balls": lambda: Quadrics.ellipsoids(rows(6, 3), torch.full((6,), 0.7)),
    "tubes": lambda: Quadrics.cylinders(rows(6, 3), rows(6, 3, seed=1), torch.full((6,), 0.2).double(), caps=True),
    "tetrahedra": tetrahedra,
    "skin": lambda: molecular_skin(rows(8, 3), torch.ones(8).double(), faces="back"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_they_come_back_to_the_bit(kind, tmp_path):
    path = tmp_path / "surface.npz"
    save_quadrics(surface := KINDS[kind](), path)
    again = load_quadrics(path)
    assert is_quadrics(path)
    assert again.faces == surface.faces
    for one, two in zip(again.tensors, surface.tensors, strict=True):
        assert one.dtype == two.dtype
        assert torch.equal(one, two)
    o, d = 5 * rows(300, 3, seed=2), rows(300, 3, seed=3) - 5 * rows(300, 3, seed=2)
    one, two = (s.hits(o, d, 4) for s in (again, surface))
    assert torch.equal(one.t, two.t)
    assert torch.equal(one.piece, two.piece)
    eye = torch.tensor([9.0, 0, 0])
    assert torch.equal(again.seen_from(eye).hit(o, d).t, surface.seen_from(eye).hit(o, d).t)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"planes": None}, "expected quadrics with planes; got no such arrays"),
        ({"quadrics": np.array(2)}, "expected version 1 of quadrics; got 2"),
        ({"faces": np.array(-1)}, "expected faces from 0 to 2; got -1"),
        ({"A": np.zeros((6, 9))}, r"expected numbers of shape \(…, 3, 3\) as A; got float64 of shape \(6, 9\)"),
        ({"c": np.zeros(6, np.int64)}, "c must be a floating-point torch.Tensor; got torch.int64"),
        ({"radii": np.zeros(6)}, "radii must be positive; 6 of 6 are not"),
        ({"centers": np.full((6, 3), math.nan)}, "centers must be finite"),
        ({"upper": np.full((6, 3), -99.0)}, "lower corners of boxes must not lie beyond upper ones; 18 numbers do"),
        ({"b": np.zeros((5, 3))}, r"b must have shape \(6, 3\); got \(5, 3\)"),
    ],
)
def test_bad_files_are_refused(tmp_path, changed, message):
    path = tmp_path / "surface.npz"
    save_quadrics(KINDS["balls"](), path)
    with np.load(path) as given:
        arrays = {name: given[name] for name in given}
    np.savez(path, **{name: x for name, x in (arrays | changed).items() if x is not None})
    with pytest.raises(ValueError, match=message):
        load_quadrics(path)


def test_what_is_not_theirs_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"expected a name that ends in \.npz for quadrics"):
        save_quadrics(KINDS["balls"](), tmp_path / "a.ply")
    quads = BilinearQuads(rows(4, 3), torch.tensor([[0, 1, 2, 3]]))
    with pytest.raises(TypeError, match="expected Quadrics; got BilinearQuads"):
        save_quadrics(quads, tmp_path / "a.npz")  # type: ignore[arg-type]
    with pytest.raises(FileNotFoundError):
        load_quadrics(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", samples=np.zeros((3, 3, 3)))
    assert not is_quadrics(tmp_path / "b.npz")
