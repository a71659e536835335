"""What the commands say of a full disk and of a folder that must not be written; kills are cases of the extremes."""

import os
import subprocess
import sys

import pytest

from experiments.extremes import full_disk
from tests.experiments.conftest import ROOT


def run(*words, **options):
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    return subprocess.run(words, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=120, **options)


NO_SMALL_DISK = full_disk.missing()
on_a_small_disk = pytest.mark.skipif(NO_SMALL_DISK is not None, reason=str(NO_SMALL_DISK))


COMMANDS = """
import sys, torch
import filterlab as fl
from filterlab.cli import main
from experiments.__main__ import main as experiments
disk, scene, config = sys.argv[1:]
with open(f"{disk}/ballast", "wb") as file:
    file.write(bytes(2**19 - 5 * 4096))
fl.save_volume(torch.rand(4, 4, 4), f"{disk}/in.npy")
for ending in ("nrrd", "nii.gz", "npy", "npz"):
    out = f"{disk}/out.{ending}"
    assert main(["resample", f"{disk}/in.npy", "-o", out, "--shape", "40", "40", "40"]) == 1
with open(f"{disk}/more", "wb") as file:
    file.write(bytes(3 * 4096))
assert main(["render", scene, "-o", f"{disk}/out.png", "--size", "90", "90"]) == 1
assert experiments(["run", config, "--runs", f"{disk}/runs"]) == 1
"""


@on_a_small_disk
def test_the_commands_tell_of_a_full_disk(tmp_path, tiny_rms, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    disk = tmp_path / "disk"
    disk.mkdir()
    scene = ROOT / "configs" / "scenes" / "marschner_lobb.yaml"
    done = full_disk.on_a_small_disk([sys.executable, "-c", COMMANDS, str(disk), str(scene), str(tiny_rms)], disk)
    assert done.returncode == 0, done.stderr
    told = [line for line in done.stderr.splitlines() if "full" in line]
    for line, ending in zip(told, ("nrrd", "nii.gz", "npy", "npz", "png"), strict=False):
        assert line == f"filterlab: cannot write {disk}/out.{ending}: the disk is full (No space left on device)"
    assert told[-1].startswith("error: the disk is full")
    assert "give the same command again" in told[-1]
    assert len(told) == 6
    assert "Traceback" not in done.stderr


LOCKED = """
import sys
from experiments.__main__ import main as experiments
from filterlab.cli import main
locked, config = sys.argv[1:]
assert experiments(["run", config, "--runs", locked]) == 1
assert main(["resample", config, "-o", f"{locked}/a.nrrd", "--shape", "2", "2", "2"]) == 1
"""


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="folders have no modes here")
def test_a_folder_that_this_user_must_not_write(tmp_path, tiny_rms):
    """Modes do not bind root: then in a process without root's rights, where the system has such."""
    root = os.geteuid() == 0
    if root and NO_SMALL_DISK is not None:
        pytest.skip(f"this user may write everywhere (root), and {NO_SMALL_DISK}")
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o555)
    without_rights = ["unshare", "--user"] if root else []
    done = run(*without_rights, sys.executable, "-c", LOCKED, str(locked), str(tiny_rms))
    assert done.returncode == 0, done.stderr
    first, second = done.stderr.splitlines()
    assert first.startswith("error: expected a run folder that can be written; ")
    assert first.endswith("Permission denied")
    assert second == f"filterlab: cannot write {locked}/a.nrrd: expected a writable folder; got {locked}, which is not"
    assert not list(locked.iterdir())
