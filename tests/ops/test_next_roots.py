"""The search of one root after the other, as vector code, on polynomials alone: against roots known beforehand."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from llvmlite import ir

from filterlab.ops.cpu import compiler, frame, job, threads
from filterlab.ops.cpu.lanes import ARITHMETIC, I1, I64, Lanes
from filterlab.ops.cpu.polynomials import NextRoots, Part
from filterlab.roots import all_roots

FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,
    "rows": ctypes.c_void_p,  # (chunks, n + 1, P) numbers, positive at 0
    "t": ctypes.c_void_p,  # (chunks, n + 2, P) numbers, written
    "chunks": ctypes.c_int64,
}


class RootsJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class RootsVariant:
    degree: int
    arithmetic: str
    lanes: int = 4

    def write(self, function: ir.Function) -> None:
        """Roots in the order in which they are found; what is beyond the last one stays as it is."""
        b = ir.IRBuilder(function.append_basic_block("entry"))
        e, n = Lanes(b, self.arithmetic, self.lanes), self.degree
        number = ARITHMETIC[self.arithmetic]
        told = frame.load_job(e, function.args[0], FIELDS)
        search, part, rank = NextRoots(e, n), Part.of(e, n), e.variable(I64(0))
        whole = ir.Constant(ir.VectorType(I1, self.lanes), [True] * self.lanes)
        left = e.variable(whole)
        with frame.every_chunk(e, told) as chunk:
            own = e.advance(told.rows, b.mul(chunk, I64((n + 1) * self.lanes)), number)
            rows = [e.load(e.advance(own, I64(i * self.lanes), number), number, self.lanes) for i in range(n + 1)]
            left.value, rank.value = whole, I64(0)
            tiny = float(np.finfo(self.arithmetic).tiny)
            ends = b.fcmp_ordered("==", rows[-1], e.constant(tiny))
            search.begin(left.value, rows, e.constant(1), ends)
            with e.repeat_while(lambda: e.any(left.value)):
                found, over = search.next_part(left.value, lambda *own: part.assign(e, *own))
                within = search.root([r.value for r in part.rows], found)
                t = e.multiply_add(within, part.h.value, part.a.value)
                place = b.add(b.mul(chunk, I64(n + 2)), rank.value)
                place = e.advance(told.t, b.mul(place, I64(self.lanes)), number)
                at_end = b.and_(b.and_(over, ends), b.and_(search.above(), b.not_(found)))
                e.store(e.where(found, t, e.where(at_end, e.constant(1), e.constant(float("inf")))), place)
                left.value, rank.value = b.and_(left.value, b.not_(over)), b.add(rank.value, I64(1))
        b.ret_void()


def roots_of(coefficients: np.ndarray) -> list[list[float]]:
    """Of polynomials (B, n + 1), B a multiple of four."""
    count, size = coefficients.shape
    packs = np.ascontiguousarray(coefficients.reshape(-1, 4, size).swapaxes(1, 2))
    t = np.full((count // 4, size + 1, 4), np.inf, coefficients.dtype)
    work = RootsJob(next=0, chunks=count // 4)
    work.point(rows=packs, t=t)
    threads.run(compiler.compiled(RootsVariant(size - 1, str(coefficients.dtype))), [work])
    return [[x for x in row if x < np.inf] for row in t.swapaxes(1, 2).reshape(count, size + 1)]


def bernstein(roots: np.ndarray) -> np.ndarray:
    """Coefficients of Π (1 − t / root), or of Π (root − t) for roots in [0, 1], 1 at most."""
    c = np.ones(1)
    for root in roots:
        n = len(c)
        lower, upper = np.append(c, 0) * (n - np.arange(n + 1)), np.insert(c, 0, 0) * np.arange(n + 1)
        c = (lower * root + upper * (root - 1)) / n
    return c / np.abs(c).max()


def polynomials(rng: np.random.Generator, degree: int, count: int, twice: bool) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients, positive at 0, and their roots, those in (0, 1) no two nearer than 0.05; one of them twice."""
    roots = np.sort(rng.uniform(0.03, 0.97, (8 * count, degree)), 1)
    roots[rng.random(roots.shape) < 0.4] += 1.5
    if twice:
        roots[:, -1] = roots[:, -2]  # behind a single one it is met from below
    inside = np.sort(np.where(roots < 1, roots, np.inf), 1)
    apart = np.diff(np.where(inside < 1, inside, 2 + np.arange(degree)), axis=1)
    good = roots[((apart > 0.05) | (apart == 0)).all(1)][:count]
    assert len(good) == count
    return np.stack([bernstein(r) * np.sign(bernstein(r)[0]) for r in good]), good


@pytest.mark.parametrize("arithmetic", ["float64", "float32"])
@pytest.mark.parametrize("degree", [1, 3, 6])
def test_every_root_in_order(degree, arithmetic):
    c, roots = polynomials(np.random.default_rng(degree), degree, 200, twice=False)
    found = roots_of(c.astype(arithmetic))
    for own, known in zip(found, roots, strict=True):
        assert own == pytest.approx(sorted(r for r in known if r < 1), abs=1e-9 if arithmetic == "float64" else 2e-2)


@pytest.mark.parametrize("near", [1e-1, 1e-3, 1e-6, 1e-9])
def test_a_root_at_the_end_is_met_behind_those_before_it(near):
    """From above, behind a root from below in the same part, however near that is; from below it is found as others."""
    roots = [[0.3, 0.7], [0.3, 1 - near], [0.8, 1.6], [1.3, 1.7]]
    c = np.stack([bernstein(np.array([*own, 1.0])) for own in roots])
    c *= np.sign(c[:, :1])
    assert (np.abs(c[:, -1]) < 1e-16).all()
    c[:, -1] = np.finfo(float).tiny
    for own, known in zip(roots_of(c), roots, strict=True):
        assert own == pytest.approx([r for r in [*known, 1.0] if r <= 1], abs=1e-7)


@pytest.mark.parametrize("degree", [2, 3, 4, 6])
def test_double_roots_are_met_once_from_either_side(degree):
    """As often as by plain torch: what rounding hides may be one root, two, or none for both."""
    c, roots = polynomials(np.random.default_rng(degree), degree, 400, twice=True)
    found, every = roots_of(c), all_roots(torch.from_numpy(c))
    alike = 0
    for own, known, count in zip(found, roots, every.count.tolist(), strict=True):
        expected = sorted({r for r in known if r < 1})
        assert abs(len(own) - len(expected)) <= 1
        assert all(min(abs(t - r) for r in known) < 1e-6 for t in own)
        alike += len(own) == count
    assert alike >= 390
