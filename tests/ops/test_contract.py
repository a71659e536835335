"""contract: the fused program and its plain twin against dense matrices, and what does not change a bit."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

from filterlab.ops.contract import Contraction, Rows
from filterlab.ops.cpu import contract as fused
from filterlab.ops.differentiable.contract import IMPLEMENTATIONS, contract
from filterlab.ops.gather import STORAGE
from tests import laws

every_implementation = pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
# samples, result: whole bundles and packs, rests of both, single lines and columns
SHAPES = [
    ((3, 4, 5), (4, 2, 7)),
    ((2, 9, 130), (3, 70, 75)),
    ((1, 1, 40), (1, 1, 90)),
    ((5, 1, 1), (6, 1, 3)),
    ((1, 1, 1),) * 2,
]


def matrix(rows: int, columns: int, rng: np.random.Generator) -> Rows:
    """Rows of up to 4 entries, some of none."""
    chosen = rng.random((rows, columns)) * (rng.random((rows, 1)) > 0.1) > 1 - 2 / columns
    own, places = (torch.from_numpy(index) for index in np.nonzero(chosen))
    return Rows.of_entries(own, places, torch.from_numpy(rng.normal(size=len(own))), (rows, columns))


def contraction(shape: tuple[int, ...], result: tuple[int, ...], terms: int = 1, seed: int = 0) -> Contraction:
    rng = np.random.default_rng(seed)
    own = [[matrix(result[2 - a], shape[2 - a], rng) for a in range(3)] for _ in range(terms)]
    return Contraction([(x, y, z) for x, y, z in own])


def dense(rows: Rows) -> np.ndarray:
    out = np.zeros((rows.count, rows.columns))
    for i, (a, b) in enumerate(zip(rows.starts[:-1], rows.starts[1:], strict=True)):
        np.add.at(out[i], rows.places[a:b].numpy(), rows.weights[a:b].detach().numpy())
    return out


def by_matrices(samples: np.ndarray, given: Contraction) -> np.ndarray:
    terms = [[dense(rows) for rows in term] for term in given.terms]
    return sum(np.einsum("kc,jb,ia,...cba->...kji", z, y, x, samples, optimize=True) for x, y, z in terms)


def random(*shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    samples = torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return samples.to(dtype) if dtype.is_floating_point else (100 * samples).to(dtype)


@every_implementation
@pytest.mark.parametrize(("shape", "result"), SHAPES)
def test_equals_the_product_with_dense_matrices(implementation, shape, result):
    for terms, leading in product((1, 3), ((), (2, 1))):
        given, samples = contraction(shape, result, terms), random(*leading, *shape)
        assert (given.columns, given.shape) == (shape, result)
        kept = samples.clone()
        out = contract(samples, given, torch.float64, implementation)
        laws.assert_close(out, by_matrices(samples.numpy(), given), 1e-13)
        assert torch.equal(samples, kept)
        part = (slice(result[0] // 2, result[0]), slice(0, max(1, result[1] // 2)))
        own, needed = given.part(*part)
        found = contract(samples[(..., *needed, slice(None))], own, torch.float64, implementation)
        laws.assert_close(found, out[(..., *part, slice(None))], 1e-13)


@pytest.mark.parametrize(
    ("storage", "dtype"),
    [*((s, torch.float32) for s in STORAGE), (torch.float32, torch.float64), (torch.float64, torch.float64)],
)
def test_reads_what_is_stored_through_any_strides(storage, dtype):
    given, samples = contraction((3, 6, 21), (5, 4, 30)), random(3, 6, 21, dtype=storage)
    views = [samples, samples.transpose(0, 1).contiguous().transpose(0, 1), samples.mT.contiguous().mT]
    for view in (*views, samples[:1].expand(3, -1, -1)):
        expected = by_matrices(view.double().numpy(), given)
        laws.assert_close(contract(view, given, dtype, "cpu"), expected, 2e-6 if dtype == torch.float32 else 1e-13, 200)


@every_implementation
def test_linear_with_an_exact_adjoint_of_any_order(implementation):
    given = contraction((3, 4, 5), (4, 2, 7), 2)
    transposed = given.transposed
    for rows, other in zip(given.terms[1], transposed.terms[1], strict=True):
        assert np.array_equal(dense(rows).T, dense(other))
    laws.assert_adjoint(lambda f: contract(f, given, torch.float64, implementation), random(3, 4, 5))
    samples = random(3, 4, 5).requires_grad_()
    assert torch.autograd.gradgradcheck(lambda f: contract(f, given, torch.float64, implementation).square(), samples)
    value, moved = torch.func.jvp(lambda f: contract(f, given, torch.float64, implementation), (samples,), (samples,))
    assert torch.equal(value, moved)
    batch = random(3, 2, 4, 5)
    mapped = torch.func.vmap(lambda f: contract(f, given, torch.float64, implementation), in_dims=1, out_dims=1)(batch)
    laws.assert_close(mapped, contract(batch.movedim(1, 0), given, torch.float64).movedim(0, 1), 1e-14)


def test_weights_that_require_grad_are_differentiated_by_the_reference():
    given = contraction((3, 4, 5), (4, 2, 7))
    x, y, z = given.terms[0]
    weights = y.weights.clone().requires_grad_()
    own = Contraction([(x, Rows(y.starts, y.places, weights, y.columns), z)])
    contract(random(3, 4, 5), own, torch.float64).square().sum().backward()
    samples = random(3, 4, 5)
    out = by_matrices(samples.numpy(), given)
    by_lines = np.einsum("kc,ia,cbi->kba", dense(z), np.eye(7), np.einsum("ia,cba->cbi", dense(x), samples.numpy()))
    rows = torch.repeat_interleave(torch.arange(y.count), y.counts)
    expected = [2 * (out[:, j] * by_lines[:, b]).sum() for j, b in zip(rows.tolist(), y.places.tolist(), strict=True)]
    laws.assert_close(weights.grad, np.array(expected), 1e-12)


def test_chunks_and_threads_change_no_bit(monkeypatch):
    given, samples = contraction((9, 50, 33), (12, 90, 70), 2), random(2, 9, 50, 33, dtype=torch.float32)
    expected = contract(samples, given, torch.float32, "cpu")
    for kept, planes, per_thread, threads in ((1, 1, 1 << 30, 1), (1 << 12, 3, 64, 3), (1 << 14, 2, 1000, 2)):
        monkeypatch.setattr(fused, "_KEPT", kept)
        monkeypatch.setattr(fused, "_MOST_PLANES", planes)
        monkeypatch.setattr(fused, "_NUMBERS_PER_THREAD", per_thread)
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            assert torch.equal(contract(samples, given, torch.float32, "cpu"), expected)
        finally:
            torch.set_num_threads(before)


def test_nothing_is_made_of_nothing_and_nan_stays_where_it_is_read():
    given = contraction((3, 4, 5), (4, 2, 7))
    assert contract(random(0, 2, 3, 4, 5), given, torch.float64, "cpu").shape == (0, 2, 4, 2, 7)
    samples = random(3, 4, 5)
    samples[1, 2, 3] = torch.nan
    ones = [Rows(r.starts, r.places, torch.ones_like(r.weights), r.columns) for r in given.terms[0]]
    read = by_matrices(samples.isnan().double().numpy(), Contraction([(ones[0], ones[1], ones[2])]))
    for implementation in IMPLEMENTATIONS:
        assert np.array_equal(contract(samples, given, torch.float64, implementation).isnan().numpy(), read > 0)
