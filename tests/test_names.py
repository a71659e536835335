"""Names that are known before torch is there are those of what they name."""

import subprocess
import sys

from filterlab import METHODS, Boundary, names
from filterlab.surfaces.quartic import SPLINES


def test_names_are_those_of_the_registries():
    assert tuple(METHODS) == names.METHODS == names.methods()
    assert tuple(Boundary) == names.BOUNDARIES
    assert tuple(SPLINES) == names.SPLINES


def test_methods_that_a_program_registers_are_known(monkeypatch):
    monkeypatch.setitem(METHODS, "own", METHODS["notch"])
    assert names.methods() == (*names.METHODS, "own")


def test_names_do_not_wait_for_torch():
    code = "import sys; from filterlab import names; names.methods(); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
