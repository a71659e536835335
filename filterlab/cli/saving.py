"""The volume that a command writes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from filterlab.cli.terminal import tell

if TYPE_CHECKING:
    from filterlab.volume import Volume


def tell_rounding(volume: Volume, output: Path, nifti2: bool) -> None:
    """What is lost of the affine, where something is: NIfTI-1 holds it in float32."""
    from filterlab.io import nifti
    from filterlab.io.volumes import format_of

    if format_of(output).name == "NIfTI" and nifti.version_for(volume, nifti2) == 1:
        lost = nifti.rounding(volume.affine)
        if lost > 0:
            what = f"{output}: the affine is rounded to float32, by {lost:.0e} of itself; --nifti2 keeps it"
            tell(what)
