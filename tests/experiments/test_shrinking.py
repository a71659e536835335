"""What docs/shrinking.md says of prefilters, measured as it was, on a shorter row."""

from __future__ import annotations

import numpy as np

from experiments import shrinking


def test_the_projection_is_nearest_to_the_ideal_low_pass(monkeypatch, capsys):
    monkeypatch.setattr(shrinking, "N", 120)
    for step in shrinking.STEPS:
        for method in shrinking.METHODS_SHOWN:
            *others, (name, last) = [(n, shrinking.measured(m, step)) for n, m in shrinking.matrices(method, step)]
            assert name.startswith("projection")
            assert all(np.less(last[:3], found[:3]).all() for _, found in others)
    monkeypatch.setattr(shrinking, "STEPS", (2.0,))
    shrinking.main()
    assert capsys.readouterr().out.count("| tricubic |") == 6


def test_an_ideal_low_pass_has_no_error(monkeypatch):
    monkeypatch.setattr(shrinking, "N", 120)
    x, n = shrinking.places(4.0), np.arange(120)
    k = np.arange(-14, 15)[:, None, None]  # below the new Nyquist frequency, at 15
    ideal = np.exp(2j * np.pi * k * (x[:, None] - n) / 120).sum(0).real / 120
    found = shrinking.measured(ideal, 4.0)
    assert max(found[:3]) < 1e-12
    assert abs(found[3] - 1) < 1e-12
    assert found[4] < 1e-12
