"""What every command does alike: it says what was written, replaces what was there, shows how far it is."""

from __future__ import annotations

import io
import os
import re
import stat
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from filterlab import METHODS, Volume, load_volume, resample, save_volume, signals
from filterlab.cli import main
from filterlab.cli.terminal import progress_bar
from filterlab.recommendation import recommend
from filterlab.world import World
from tests.test_fitting import sphere

GRID = r"5 × 4 × 3 voxels of 1 × 2 × 3 mm, float32"
WRITERS: dict[str, tuple[str, list[str], str]] = {
    "resample": ("out.nii", ["{in}", "--spacing", "1", "2", "3"], GRID),
    "convert": ("out.npz", ["{in}"], "5 × 4 × 3 voxels of 1 × 2 × 3, float32"),
    "sdf": (
        "out.nrrd",
        ["{ply}", "--shape", "11", "10", "9"],
        r"11 × 10 × 9 voxels of [\d.]+ × [\d.]+ × [\d.]+, float32",
    ),
    "mesh": ("out.ply", ["{in}", "--level", "50"], r"\d+ triangles, \d+ vertices"),
    "render": ("out.png", ["{in}", "--level", "50", "--size", "8", "6"], "8 × 6 pixels, 8-bit RGB"),
    "slim": ("out.npz", ["{xyz}", "--tolerance", "0.01"], r"\d+ balls of 300 points, rms [\d.e-]+, worst [\d.e-]+"),
    "terrain": (
        "out.png",
        ["{dem}", "--size", "8", "6", "--subpixels", "1"],
        r"8 × 6 pixels, 8-bit RGB, [\d.]+ times as high as it is",
    ),
    "recommend": ("out.yaml", ["{in}", "--max-error", "90%"], "a scene"),
}
"""Command -> what it writes, its arguments, and what is said of the output."""


@pytest.fixture
def line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """The command line of a command that writes. Of all methods `recommend` would measure each, for a while."""
    monkeypatch.setitem(recommend.__kwdefaults__, "seconds", 0.02)
    monkeypatch.setattr("filterlab.recommendation.choice.METHODS", {"trilinear": METHODS["trilinear"]})
    samples = (100 * signals.marschner_lobb().sample((5, 4, 3)).samples).float()
    path, ply = tmp_path / "in.nii", tmp_path / "in.ply"
    save_volume(Volume(samples, spacing=(1, 2, 3), world=World(unit="mm")), path)
    assert main(["mesh", str(path), "--level", "50", "-q", "-o", str(ply)]) == 0
    np.savetxt(xyz := tmp_path / "in.xyz", sphere(300))
    np.save(dem := tmp_path / "in.npy", np.linspace(0, 9, 63, dtype=np.float32).reshape(7, 9) ** 2)
    given = {"{in}": str(path), "{ply}": str(ply), "{xyz}": str(xyz), "{dem}": str(dem)}

    def made(command: str, *more: str) -> list[str]:
        output, arguments, _ = WRITERS[command]
        option = [] if command == "convert" else ["-o"]
        return [command, *(given.get(a, a) for a in arguments), *option, str(tmp_path / output), *more]

    return made


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("command", WRITERS)
def test_success_says_what_was_written_and_what_was_replaced(
    command: str, line: Callable[..., list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, _, what = WRITERS[command]
    for verb in ("wrote", "replaced"):
        assert main(line(command)) == 0
        told = capsys.readouterr().err.splitlines()[-1]
        assert re.fullmatch(
            rf"filterlab: {verb} {re.escape(str(tmp_path / output))}: {what}, (\d+ min )?[\d.]+ s", told
        ), told
    before = (tmp_path / output).read_bytes()
    for quiet in ("--quiet", "-q"):
        assert main(line(command, quiet)) == 0
        assert "replaced" not in capsys.readouterr().err
    if command != "recommend":  # which measures
        assert (tmp_path / output).read_bytes() == before


def test_every_command_that_writes_is_tried_here(capsys: pytest.CaptureFixture[str]) -> None:
    from filterlab.cli.command import COMMANDS, kind_of

    for name in COMMANDS:
        kind = kind_of(name)
        writes = "output" in kind.__dataclass_fields__
        assert writes == (name in WRITERS)
        assert writes == ("quiet" in kind.__dataclass_fields__)


def test_nothing_is_said_to_be_written_where_nothing_is(
    line: Callable[..., list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("mesh", "render"):
        explained = line(command, "--explain")
        del explained[explained.index("-o") : explained.index("-o") + 2]
        assert main(explained) == 0
        assert capsys.readouterr().err == ""
    assert main(line("resample", "--method", "noch")) == 1
    assert "wrote" not in capsys.readouterr().err
    assert not (tmp_path / "out.nii").exists()


def test_a_file_that_is_protected_is_not_replaced(
    line: Callable[..., list[str]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whoever runs the tests may write anywhere: what the system would say to others is asked of the modes."""
    out = tmp_path / "out.nii"
    out.write_bytes(b"precious")
    out.chmod(0o444)

    def access(path: os.PathLike[str], mode: int, **_: object) -> bool:
        return not mode & os.W_OK or bool(os.stat(path).st_mode & stat.S_IWUSR)

    monkeypatch.setattr("os.access", access)
    assert main(line("resample")) == 1
    assert "expected a file that may be replaced; got one that is write-protected" in capsys.readouterr().err
    assert out.read_bytes() == b"precious"
    out.chmod(0o644)
    tmp_path.chmod(0o555)
    assert main(line("resample")) == 1
    assert "expected a writable folder" in capsys.readouterr().err
    tmp_path.chmod(0o755)
    assert main(line("resample")) == 0


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def at_a_terminal(monkeypatch: pytest.MonkeyPatch, patience: float = 0.0) -> Terminal:
    """What a person sees on stderr from now on (a fixture could not set it: pytest sets its own after that)."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("filterlab.cli.terminal.PATIENCE", patience)
    monkeypatch.setattr("sys.stderr", screen := Terminal())
    return screen


def test_work_that_takes_long_shows_how_far_it_is_and_what_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = at_a_terminal(monkeypatch)
    with progress_bar() as progress:
        for done in (0.0, 0.25, 0.5):
            time.sleep(0.1)
            progress(done, "working")
        time.sleep(0.3)
    shown = terminal.getvalue()
    assert "working" in shown
    assert "50%" in shown
    assert "0:00:0" in shown


def test_work_that_is_short_or_quiet_shows_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = at_a_terminal(monkeypatch, patience=60.0)
    with progress_bar() as progress:
        progress(0.5, "working")
    monkeypatch.setattr("filterlab.cli.terminal.PATIENCE", 0.0)
    with progress_bar(quiet=True) as progress:
        time.sleep(0.05)
        progress(0.5, "working")
    assert terminal.getvalue() == ""


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("command", [*WRITERS, "info"])
def test_every_command_shows_its_work(
    command: str, line: Callable[..., list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is told of progress grows from 0 to 1 in each part of the work, and names it."""
    seen: list[tuple[float, str]] = []

    class Bar:
        def __enter__(self) -> Callable[[float, str], None]:
            return lambda done, what: seen.append((done, what))

        def __exit__(self, *_: object) -> None:
            pass

    own = {"render": "pictures", "terrain": "pictures"}.get(command, command)
    monkeypatch.setattr(f"filterlab.cli.{own}.progress_bar", lambda quiet=False: Bar())
    assert main([command, line("resample")[1]] if command == "info" else line(command)) == 0
    parts: dict[str, list[float]] = {}
    for done, what in seen:
        parts.setdefault(what, []).append(done)
    assert set(parts) == EXPECTED[command]
    for what, dones in parts.items():
        assert dones == sorted(dones), what
        assert dones[-1] == pytest.approx(1) or what == "errors"
        assert all(0 <= done <= 1 for done in dones)


EXPECTED = {
    "resample": {"reading", "resampling", "writing"},
    "convert": {"reading", "writing"},
    "sdf": {"measuring", "writing"},
    "mesh": {"reading", "meshing"},
    "slim": {"fitting"},
    "terrain": {"reading", "rendering"},
    "render": {"reading", "rendering"},
    "recommend": {"reading", "errors", "costs"},
    "info": {"reading", "counting"},
}


def test_shrinking_is_told_of_or_antialiased(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    volume = Volume(torch.rand(8, 8, 8))
    save_volume(volume, tmp_path / "in.nrrd")
    line = ["resample", str(tmp_path / "in.nrrd"), "--shape", "3", "3", "3", "-o", str(tmp_path / "out.nrrd"), "-q"]
    assert main(line) == 0
    assert capsys.readouterr().err.count("--antialias leaves them out") == 1
    assert main([*line, "--antialias"]) == 0
    assert capsys.readouterr().err == ""
    found = load_volume(tmp_path / "out.nrrd").samples
    assert torch.equal(found, resample(volume, shape=(3, 3, 3), antialias=True).samples)
    assert main([*line, "--antialias", "--method", "nearest"]) == 2
    assert "nearest takes samples as they are" in capsys.readouterr().err


def test_only_warnings_of_our_own_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another one keeps what is said of it elsewhere: here that it is an error."""
    save_volume(Volume(torch.rand(4, 4, 4)), tmp_path / "in.nrrd")

    def warning(*_: object, **__: object) -> None:
        exec(compile("import warnings; warnings.warn('of torch')", "x", "exec"), {"__name__": "filterlab.resampling"})

    monkeypatch.setattr("filterlab.resampling.resample", warning)
    with pytest.raises(UserWarning, match="of torch"):
        main(["resample", str(tmp_path / "in.nrrd"), "-o", str(tmp_path / "out.nrrd"), "--shape", *"444"])
