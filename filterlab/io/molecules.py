"""Atoms of molecules in files: elements, places and radii.

| ending | what is read |
|---|---|
| .xyz | how many atoms there are, a line of text, then a line `element x y z` for each; the first of several |
| .pdb, .ent | records ATOM and HETATM of the first model, of alternate places the first |

Places are in ångström. Radii are those of van der Waals.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.io.bounded import regular_file
from filterlab.names import unknown_name

MAX_BYTES = 2**26

RADII = {
    **{"H": 1.10, "He": 1.40, "Li": 1.81, "Be": 1.53, "B": 1.92, "C": 1.70, "N": 1.55, "O": 1.52, "F": 1.47},
    **{"Ne": 1.54, "Na": 2.27, "Mg": 1.73, "Al": 1.84, "Si": 2.10, "P": 1.80, "S": 1.80, "Cl": 1.75, "Ar": 1.88},
    **{"K": 2.75, "Ca": 2.31, "Ni": 1.63, "Cu": 1.40, "Zn": 1.39, "Ga": 1.87, "Ge": 2.11, "As": 1.85, "Se": 1.90},
    **{"Br": 1.83, "Kr": 2.02, "Rb": 3.03, "Sr": 2.49, "Pd": 1.63, "Ag": 1.72, "Cd": 1.58, "In": 1.93, "Sn": 2.17},
    **{"Sb": 2.06, "Te": 2.06, "I": 1.98, "Xe": 2.16, "Cs": 3.43, "Ba": 2.68, "Pt": 1.75, "Au": 1.66, "Hg": 1.55},
    **{"Tl": 1.96, "Pb": 2.02, "Bi": 2.07, "U": 1.86},
}
"""Of van der Waals, in ångström.

Source: Mantina et al., Consistent van der Waals radii for the whole main group, J. Phys. Chem. A 113, 2009, table 12;
of the other metals Bondi, van der Waals volumes and radii, J. Phys. Chem. 68, 1964.
"""


class Molecule(NamedTuple):
    """Atoms.

    Attributes:
        elements: their symbols, N of them. centers: (N, 3) float64. radii: (N,) float64.
    """

    elements: tuple[str, ...]
    centers: Tensor
    radii: Tensor


def check_molecule_file(path: Path) -> None:
    """Raises ValueError unless its name has the ending of one that `load_molecule` reads."""
    if path.suffix.lower() not in _READERS:
        raise ValueError(f"{path}: expected atoms: {unknown_name('ending', path.suffix, _READERS, alike=0.8)}")


def load_molecule(path: str | os.PathLike[str]) -> Molecule:
    """The atoms in a file.

    Raises:
        FileNotFoundError: no such file. ValueError: another ending, no atoms, a line that is none of an atom, an
            element whose radius is not known here.
    """
    path = Path(path)
    check_molecule_file(path)
    regular_file(path, "a file of atoms")
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path}: expected at most {MAX_BYTES} bytes of atoms; got {path.stat().st_size}")
    lines = path.read_bytes().decode("utf-8", "replace").splitlines()
    atoms = list(_READERS[path.suffix.lower()](path, lines))
    if not atoms:
        raise ValueError(f"{path}: expected atoms; got none")
    elements = tuple(element for element, _ in atoms)
    centers = torch.tensor([place for _, place in atoms], dtype=torch.float64)
    return Molecule(elements, centers, torch.tensor([RADII[e] for e in elements], dtype=torch.float64))


Atom = tuple[str, tuple[float, float, float]]


def _of_xyz(path: Path, lines: list[str]) -> Iterator[Atom]:
    count = lines[0].strip() if lines else ""
    if not re.fullmatch(r"[0-9]{1,9}", count):
        raise ValueError(f"{path}:1: expected how many atoms there are; got {count[:40]!r}")
    rows = lines[2 : 2 + int(count)]
    if len(rows) < int(count):
        raise ValueError(f"{path}: expected {count} atoms, one a line from the third on; got {len(rows)}")
    for number, line in enumerate(rows, 3):
        element, *numbers = line.split()[:4] or [""]
        yield _atom(f"{path}:{number}", "element x y z", line, element, numbers)


def _of_pdb(path: Path, lines: list[str]) -> Iterator[Atom]:
    for number, line in enumerate(lines, 1):
        if line.startswith("ENDMDL"):
            return
        if line.startswith(("ATOM  ", "HETATM")) and line[16:17] in (" ", "A", "1"):
            numbers = [line[k : k + 8].strip() for k in (30, 38, 46)]
            element = line[76:78].strip() or re.sub("[^A-Za-z]", "", line[12:14])
            yield _atom(f"{path}:{number}", "x, y, z in columns 31 to 54", line, element, numbers)


def _atom(place: str, expected: str, line: str, element: str, numbers: list[str]) -> Atom:
    try:
        x, y, z = map(float, numbers)
    except ValueError:
        raise ValueError(f"{place}: expected {expected}; got {line.strip()[:60]!r}") from None
    name = element.capitalize()
    if name not in RADII:
        raise ValueError(f"{place}: {unknown_name('element', element, RADII)}")
    return name, (x, y, z)


_READERS = {".xyz": _of_xyz, ".pdb": _of_pdb, ".ent": _of_pdb}
