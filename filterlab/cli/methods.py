"""The command `filterlab methods`."""

from __future__ import annotations

from dataclasses import dataclass

from filterlab.cli.terminal import show


@dataclass(frozen=True)
class Methods:
    """List the reconstruction methods and what each promises.

    support: width of the kernel along an axis, in voxels; with a prefilter the influence of a sample goes on beyond it
    and decays. taps: coefficients that one value is the sum of; the notch, whose kernel has 64 taps, is evaluated with
    27 after averaging neighbours. order: L, the error falls as the L-th power of the voxel size (and without the
    prefilter). smooth: C0 continuous, C1 its gradient too, C2 its curvature too. samples: whether the reconstruction
    returns the samples at the voxel centres (and without the prefilter).
    """

    def run(self, overrides: dict[str, str]) -> None:
        from rich.table import Table

        from filterlab.methods import METHODS

        table = Table("method", "support", "taps", "order", "smooth", "samples", "gradients", "schemes", "what it is")
        for name, method in METHODS.items():
            f = method.facts
            table.add_row(
                name,
                str(f.support),
                str(f.taps),
                _both(str(f.approximation_order), str(f.approximation_order_without_prefilter), f.prefiltered),
                f"C{f.continuity}",
                _both(_yes(f.interpolating), _yes(f.interpolating_without_prefilter), f.prefiltered),
                ", ".join(f.gradients),
                ", ".join(f.schemes),
                method.summary,
            )
        show(table)


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def _both(with_prefilter: str, without: str, prefiltered: bool) -> str:
    return f"{with_prefilter} ({without})" if prefiltered else with_prefilter
