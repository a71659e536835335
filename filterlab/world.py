"""Worlds: what is declared of the space that a grid lies in, beside its numbers.

It is kept for the files that a volume is written to. No number depends on it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

# Anatomical space -> the signs that turn its axes into right, anterior, superior.
ANATOMICAL = {
    "right-anterior-superior": (1.0, 1.0, 1.0),
    "left-anterior-superior": (-1.0, 1.0, 1.0),
    "left-posterior-superior": (-1.0, -1.0, 1.0),
}
SPACES = (*ANATOMICAL, "scanner-xyz", "3D-right-handed", "3D-left-handed")
RAS = "right-anterior-superior"
LPS = "left-posterior-superior"
UNIT = r"[!#-~]{1,20}"  # of printable characters, without spaces and quotes


@dataclass(frozen=True)
class NiftiForms:
    """How a NIfTI file says where its grid lies, and what its numbers are.

    Attributes:
        version: 1 or 2.
        sform, qform: codes of the two forms, from 0 (not there) to 5.
        time: the unit of time, as nibabel calls it.
        to_qform: where the two forms tell different places: the affine from the world of the sform, which is the
            volume's, to that of the qform, in rows; else None.
        description: in Latin-1.
        intent: what the numbers mean, a code of the format; 0: not told. 1002: they are labels.
        intent_parameters, intent_name: what belongs to it.
    """

    version: int = 1
    sform: int = 2
    qform: int = 0
    time: str = "unknown"
    to_qform: tuple[tuple[float, ...], ...] | None = None
    description: str = ""
    intent: int = 0
    intent_parameters: tuple[float, float, float] = (0.0, 0.0, 0.0)
    intent_name: str = ""


@dataclass(frozen=True)
class World:
    """What is declared of a world.

    Attributes:
        space: its axes, one of `SPACES`, by the names of NRRD; None: not declared. In an anatomical space
            (`ANATOMICAL`) coordinates are right, anterior, superior in memory, and are written as was declared.
        unit: of length, such as mm or um; None: not declared.
        nifti: how the NIfTI file that the volume comes from says where it is; None: it comes from none.
    """

    space: str | None = None
    unit: str | None = None
    nifti: NiftiForms | None = None

    def __post_init__(self) -> None:
        if self.space not in (None, *SPACES):
            raise ValueError(f"expected a space among {', '.join(SPACES)}; got {self.space!r}")
        if self.unit is not None and not re.fullmatch(UNIT, self.unit):
            raise ValueError(f"expected a unit of 1 to 20 letters of ASCII; got {self.unit!r}")

    @property
    def axes(self) -> str | None:
        """What coordinates are in memory: RAS, or the declared space as it is called; None: not declared."""
        return "RAS" if self.space in ANATOMICAL else self.space


UNDECLARED = World()
