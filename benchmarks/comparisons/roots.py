"""Roots of polynomials in Bernstein form, in plain torch: by degree, and quartics against kornia's closed form."""

from __future__ import annotations

import torch

from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, race_item
from benchmarks.records import at_most
from benchmarks.settings import Settings
from filterlab.bernstein import to_monomial
from filterlab.roots import all_roots, first_root

_DEGREES = (2, 3, 4, 6, 9)
_DTYPES = (torch.float64, torch.float32)


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _polynomials(degree: int, settings: Settings, dtype: torch.dtype) -> torch.Tensor:
    """Coefficients from −1 to 1: most have a root, and more than one change of sign."""
    generator = torch.Generator().manual_seed(degree)
    uniform = torch.rand(settings.points // 4, degree + 1, generator=generator, dtype=torch.float64)
    return (2 * uniform - 1).to(dtype)


def _degrees(settings: Settings, dtype: torch.dtype) -> Race:
    contestants = []
    for degree in _DEGREES:
        c = _polynomials(degree, settings, dtype)
        contestants.append(Contestant(f"degree {degree}", lambda c=c: (first_root(c),), samples=len(c)))
    ratios = [Ratio(f"degree {n}", "degree 4") for n in _DEGREES if n != 4]
    return Race(f"first roots, coefficients from −1 to 1, {_name(dtype)}", contestants, ratios)


def _quartics(settings: Settings, dtype: torch.dtype) -> Race:
    """kornia gives all roots of powers of t, unsorted; the powers are made beforehand."""
    from kornia.geometry.solvers import solve_quartic

    c = _polynomials(4, settings, dtype)
    powers = to_monomial(c.double()).to(dtype).flip(-1).contiguous()
    contestants = [
        Contestant("first_root", lambda: (first_root(c),), samples=len(c)),
        Contestant("all_roots", lambda: tuple(all_roots(c)), samples=len(c)),
        Contestant("kornia", lambda: (solve_quartic(powers),), samples=len(c)),
    ]
    ratios = [Ratio("first_root", "kornia", at_most("1")), Ratio("all_roots", "kornia")]
    return Race(f"roots of quartics, coefficients from −1 to 1, {_name(dtype)}", contestants, ratios)


def _items(settings: Settings) -> list[Item]:
    return [
        race_item(f"{what}-{_name(dtype)}", 30, lambda s, build=build, dtype=dtype: build(s, dtype))
        for what, build in (("quartics", _quartics), ("degrees", _degrees))
        for dtype in _DTYPES
    ]


COMPARISON = Comparison("roots", "first roots of polynomials in Bernstein form, against kornia's closed form", _items)
