"""What prefilters leave of each frequency when a grid is made coarser, beside the ideal low-pass.

`python -m experiments.shrinking` prints the table of docs/shrinking.md. A wave cos ωx on a long periodic row is taken
to a grid of steps s; the ideal keeps it below the new Nyquist frequency π/s and leaves it out above. Errors are root
mean squares over all waves of a spectrum, relative to what is to be kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch

from filterlab.methods import tensor_product
from filterlab.ops.contract import Rows
from filterlab.resampling_rows import Given, rows_of
from filterlab.shrinking import projected
from filterlab.volume import Boundary

N = 600  # voxels of a period
STEPS = (1.5, 2.0, 4.0)
METHODS_SHOWN = ("trilinear", "triquadratic", "tricubic")
GAUSSIANS = {"0.35 s": lambda s: 0.35 * s, "0.5 s": lambda s: 0.5 * s, "(s − 1)/2": lambda s: (s - 1) / 2}
SPECTRA = {"white": 0, "1/ω": 1, "1/ω²": 2}  # of power


def dense(rows: Rows) -> np.ndarray:
    """The matrix."""
    out = np.zeros((rows.count, rows.columns))
    own = torch.repeat_interleave(torch.arange(rows.count), rows.counts)
    np.add.at(out, (own.numpy(), rows.places.numpy()), rows.weights.numpy())
    return out


def gaussian(sigma: float) -> np.ndarray:
    """Periodic convolution with samples of a Gaussian."""
    apart = np.minimum(np.arange(N), N - np.arange(N))
    weights = np.exp(-(apart**2) / (2 * sigma**2))
    return np.stack([np.roll(weights / weights.sum(), i) for i in range(N)])


def matrices(method: str, step: float) -> Iterator[tuple[str, np.ndarray]]:
    """From samples to the coarser grid: without prefilter, and by each of them."""
    own = tensor_product(method)
    assert own is not None
    given = Given(own.kernel, own.prefilter, Boundary.WRAP, torch.float64)
    x = torch.from_numpy(places(step))
    plain = dense(rows_of(x, N, given))
    yield "none", plain
    yield "block means", block_means(step)
    for name, sigma in GAUSSIANS.items():
        yield f"Gaussian, σ = {name}", plain @ gaussian(sigma(step))
    yield "projection (`antialias=True`)", dense(projected(x, step, N, given))


def block_means(step: float) -> np.ndarray:
    """Means over the new voxels, by the parts of old ones that they cover."""
    edge, old = np.arange(round(N / step))[:, None] * step, np.arange(N)
    return np.clip(np.minimum(edge + step, old + 1) - np.maximum(edge, old), 0, None) / step


def places(step: float) -> np.ndarray:
    return (np.arange(round(N / step)) + 0.5) * step - 0.5


def measured(matrix: np.ndarray, step: float) -> list[float]:
    """Errors by spectrum; the share kept of a wave at 0.6, and left of one at 1.4 of the new Nyquist frequency."""
    omega, x = 2 * np.pi * np.arange(1, int(0.45 * N)) / N, places(step)
    waves, found = np.exp(1j * np.outer(np.arange(N), omega)), np.exp(1j * np.outer(x, omega))
    made, kept = matrix @ waves, omega < np.pi / step - 1e-9
    error = (np.abs(made - found * kept) ** 2).mean(0)
    errors = [math.sqrt((error * omega**-p).sum() / (kept * omega**-p).sum()) for p in map(float, SPECTRA.values())]
    low, high = (int(np.abs(omega - f * np.pi / step).argmin()) for f in (0.6, 1.4))
    share = float(np.abs((made[:, low] / found[:, low]).mean()))
    return [*errors, share, float(np.sqrt((np.abs(made[:, high]) ** 2).mean()))]


def main() -> None:
    head = [*(f"error, {name}" for name in SPECTRA), "kept at 0.6", "left at 1.4"]
    for step in STEPS:
        print(f"\n### s = {step:g}\n\n| method | prefilter | {' | '.join(head)} |\n|---|---|{'---|' * len(head)}")
        for method in METHODS_SHOWN:
            for name, matrix in matrices(method, step):
                print(f"| {method} | {name} | {' | '.join(f'{v:.3f}' for v in measured(matrix, step))} |")


if __name__ == "__main__":
    main()
