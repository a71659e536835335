"""Programs kept on disk: found again, never trusted blindly, no obstacle where nothing can be written."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
import time
import tracemalloc
from importlib import resources
from pathlib import Path

import pytest
import torch

import filterlab
from filterlab import ops
from filterlab.kernels import bspline
from filterlab.ops.cpu import cache, compiler
from tests.test_architecture import imported_modules

PROGRAM = """
import torch
from filterlab import ops
from filterlab.kernels import bspline
c = torch.arange(512.0).sin().reshape(1, 1, 8, 8, 8)
p = torch.linspace(2, 5, 30).reshape(1, 10, 3)
print(ops.jet(c, p, bspline(2), 1, implementation="cpu").double().sum().item())
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """An empty cache, nothing in memory; afterwards as before."""
    monkeypatch.setenv("FILTERLAB_CACHE", str(tmp_path / "programs"))
    compiler._programs.clear()
    yield tmp_path / "programs"
    compiler._programs.clear()


@pytest.fixture
def compilations(monkeypatch: pytest.MonkeyPatch) -> list:
    done: list = []
    compile = compiler._compile
    monkeypatch.setattr(compiler, "_compile", lambda variant: (done.append(variant), compile(variant))[1])
    return done


def evaluate() -> None:
    """Evaluates as a fresh process would, and compares with the reference."""
    compiler._programs.clear()
    coefficients, points = torch.randn(1, 1, 4, 4, 4), torch.rand(1, 5, 3) * 3
    expected = ops.jet(coefficients, points, (bspline(2),) * 3, 0)
    assert torch.allclose(ops.jet(coefficients, points, bspline(2), 0, implementation="cpu"), expected, atol=1e-5)


def test_is_compiled_once_and_found_again(folder: Path, compilations: list) -> None:
    evaluate()
    evaluate()
    assert len(compilations) == 1
    (file,) = folder.iterdir()
    assert file.suffix == ".o"


@pytest.mark.parametrize(
    "damage",
    [
        lambda b: b"",
        lambda b: b[:20],
        lambda b: b[:-1],
        lambda b: b[:100] + bytes([b[100] ^ 1]) + b[101:],
        lambda b: b + b"0",
    ],
    ids=["empty", "cut within the checksum", "cut", "one bit", "longer"],
)
def test_a_damaged_file_is_rebuilt(folder: Path, compilations: list, damage) -> None:
    evaluate()
    (file,) = folder.iterdir()
    good = file.read_bytes()
    file.write_bytes(damage(good))
    evaluate()
    assert len(compilations) == 2
    assert cache.read(file.name) is not None
    evaluate()
    assert len(compilations) == 2


# --- what others may have put there -----------------------------------------------------------------------------------

CONTENT = b"machine code"


def _pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def _link(target: str):
    def make(file: Path) -> None:
        file.unlink()
        file.symlink_to(target)

    return make


def _link_to_the_same(file: Path) -> None:
    file.rename(file.with_name("moved"))
    file.symlink_to("moved")


def _folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


def _socket(file: Path) -> None:
    file.unlink()
    with socket.socket(socket.AF_UNIX) as own:
        before = os.getcwd()
        os.chdir(file.parent)  # names of sockets are short
        own.bind(file.name)
        os.chdir(before)


def _with_mode(mode: int):
    return lambda file: file.chmod(mode)


def _folder_with_mode(mode: int):
    return lambda file: file.parent.chmod(mode)


def _endless(file: Path) -> None:
    os.truncate(file, 10 << 30)


def _other_content(file: Path) -> None:
    file.write_bytes(bytes(file.stat().st_size))


ATTACKS = {
    "a named pipe": _pipe,
    "a socket": _socket,
    "a link to an endless file": _link("/dev/zero"),
    "a link to a device that waits": _link("/dev/tty"),
    "a link to a good entry": _link_to_the_same,
    "a link to itself": _link("entry"),
    "a folder": _folder,
    "a file that its group may write": _with_mode(0o620),
    "a file that all may write": _with_mode(0o606),
    "a folder that its group may write": _folder_with_mode(0o770),
    "a folder that all may write": _folder_with_mode(0o777),
    "a folder like /tmp": _folder_with_mode(0o1777),
    "a sparse file of 10 GiB": _endless,
    "other content of the same length": _other_content,
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no POSIX files here")
@pytest.mark.parametrize("attack", ATTACKS)
def test_what_others_may_have_put_there_is_not_read(folder: Path, attack: str) -> None:
    cache.write("entry", CONTENT)
    assert cache.read("entry") == CONTENT
    ATTACKS[attack](folder / "entry")
    seconds, peak = _cost(lambda: cache.read("entry"))
    assert cache.read("entry") is None
    assert seconds < 5
    assert peak < 2 * cache.LARGEST


def _cost(call) -> tuple[float, int]:
    """Time and memory, by the alarm that ends what hangs."""

    def hangs(*_: object) -> None:
        raise TimeoutError("it hangs")

    before = signal.signal(signal.SIGALRM, hangs)
    signal.alarm(20)
    tracemalloc.start()
    start = time.monotonic()
    try:
        call()
        return time.monotonic() - start, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no POSIX files here")
@pytest.mark.parametrize("attack", [name for name in ATTACKS if "folder" not in name])
def test_what_is_not_read_is_replaced(folder: Path, attack: str) -> None:
    cache.write("entry", CONTENT)
    ATTACKS[attack](folder / "entry")
    cache.write("entry", CONTENT)
    assert cache.read("entry") == CONTENT
    assert (folder / "entry").stat().st_mode & 0o777 == 0o600


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="files have no owner here")
@pytest.mark.parametrize("whose", ["file", "folder"])
def test_what_is_another_users_is_not_read(folder: Path, whose: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root's is; of another one's the owner is simulated where nobody may give files away."""
    cache.write("entry", CONTENT)
    asked = stat.S_ISREG if whose == "file" else stat.S_ISDIR
    status = os.fstat

    def of_another(handle: int, owner: int) -> os.stat_result:
        found = status(handle)
        fields = list(found)
        fields[stat.ST_UID] = owner if asked(found.st_mode) else found.st_uid
        return os.stat_result(fields)

    monkeypatch.setattr(os, "fstat", lambda handle: of_another(handle, 0))
    assert cache.read("entry") == CONTENT
    monkeypatch.setattr(os, "fstat", lambda handle: of_another(handle, os.geteuid() + 1))
    assert cache.read("entry") is None


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give files away")
def test_a_file_that_was_given_away_is_not_read(folder: Path) -> None:
    cache.write("entry", CONTENT)
    os.chown(folder / "entry", 12345, -1)
    assert cache.read("entry") is None


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="folders have no modes here")
@pytest.mark.parametrize("mode", [0o770, 0o707, 0o1777])
def test_nothing_is_written_where_others_may_write(folder: Path, mode: int) -> None:
    folder.mkdir()
    folder.chmod(mode)
    cache.write("entry", CONTENT)
    assert list(folder.iterdir()) == []


@pytest.mark.skipif(not hasattr(os, "symlink"), reason="no links here")
def test_temporary_files_are_not_written_through_links(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even where their name was guessed."""
    folder.mkdir(mode=0o700)
    monkeypatch.setattr(cache.secrets, "token_hex", lambda _: "guessed")
    (tmp_path / "precious").write_text("precious")
    (folder / "guessed.part").symlink_to(tmp_path / "precious")
    cache.write("entry", CONTENT)
    assert (tmp_path / "precious").read_text() == "precious"
    assert cache.read("entry") is None


def test_the_folder_is_made_for_its_owner_alone_and_may_be_a_link(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    cache.write("entry", CONTENT)
    if hasattr(os, "geteuid"):
        assert folder.stat().st_mode & 0o777 == 0o700
    shutil.rmtree(folder)
    folder.symlink_to(tmp_path / "elsewhere")
    cache.write("entry", CONTENT)
    assert cache.read("entry") == CONTENT
    assert [file.name for file in (tmp_path / "elsewhere").iterdir()] == ["entry"]


def test_a_file_under_another_ones_name_is_not_read(folder: Path) -> None:
    cache.write("entry", CONTENT)
    cache.write("other", b"other code")
    (folder / "other").rename(folder / "entry")
    assert cache.read("entry") is None


def test_what_is_too_large_to_be_read_is_not_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "LARGEST", 1 << 20)
    cache.write("fits", bytes((1 << 20) - 32))
    cache.write("does not", bytes((1 << 20) - 31))
    assert cache.read("fits") == bytes((1 << 20) - 32)
    assert [file.name for file in folder.iterdir()] == ["fits"]


def test_works_where_folders_cannot_be_opened_and_files_have_no_owner(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on Windows."""
    monkeypatch.setattr(os, "supports_dir_fd", set())
    monkeypatch.delattr(os, "geteuid", raising=False)
    cache.write("entry", CONTENT)
    assert cache.read("entry") == CONTENT
    (folder / "entry").write_bytes(b"damaged")
    assert cache.read("entry") is None
    (folder / "entry").unlink()
    (folder / "entry").mkdir()
    assert cache.read("entry") is None


# --- where nothing can be written -------------------------------------------------------------------------------------


def test_works_where_nothing_can_be_written(tmp_path: Path, compilations: list, monkeypatch) -> None:
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("FILTERLAB_CACHE", str(tmp_path / "file" / "programs"))
    evaluate()
    assert len(compilations) == 1
    assert (tmp_path / "file").read_text() == "not a folder"
    monkeypatch.setattr(cache, "folder", lambda: None)
    evaluate()
    assert len(compilations) == 2


def test_a_failed_write_leaves_nothing_behind(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", refuse)
    evaluate()
    assert list(folder.iterdir()) == []


def test_the_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("FILTERLAB_CACHE", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.folder() == tmp_path / "filterlab" / "programs"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache.folder() == tmp_path / ".cache" / "filterlab" / "programs"

    def homeless() -> Path:
        raise RuntimeError("no home")

    monkeypatch.setattr(Path, "home", homeless)
    assert cache.folder() is None


# --- what a program is found by ---------------------------------------------------------------------------------------


def test_the_name_depends_on_all_that_the_code_depends_on(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    evaluate()
    for surroundings in (("other source",), ("other LLVM",)):
        monkeypatch.setattr(compiler, "_surroundings", lambda s=surroundings: s)
        evaluate()
    assert len(list(folder.iterdir())) == 3


def test_whatever_ops_imports_is_a_source() -> None:
    files = {path for path, _ in compiler._files(resources.files("filterlab"))}
    package = Path(filterlab.__file__).parent
    left = sorted((package / "ops").rglob("*.py"))
    seen = set(left)
    while left:
        path = left.pop()
        name = path.relative_to(package).as_posix()
        assert name in files or name == "forking.py", f"{name} is imported by ops, and may change a program"
        for module in imported_modules(path):
            for parts in (module.split(".")[1:], module.split(".")[1:-1]):
                found = package.joinpath(*parts).with_suffix(".py")
                if module.startswith("filterlab.") and parts and found.is_file() and found not in seen:
                    seen.add(found)
                    left.append(found)
    assert not [file for file in files if "__pycache__" in file]


MARCH = """
import torch
import filterlab as fl
from filterlab.ops.cpu import compiler
from filterlab.ops.march_derivatives import TABLE_ROW
from filterlab.render import PerspectiveCamera, TransferFunction, render

torch.set_num_threads(1)  # sums of several threads are rounded otherwise

def told():
    # how many programs are compiled when none is in memory, and some derivatives
    made, compile = [], compiler._compile
    compiler._compile = lambda variant: (made.append(variant), compile(variant))[1]
    compiler._programs.clear()
    samples = torch.linspace(0, 9, 216, dtype=torch.float64).sin().abs().reshape(6, 6, 6).requires_grad_()
    opacities = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64).requires_grad_()
    transfer = TransferFunction([0.0, 0.5, 1.0], [[0.9, 0.2, 0.1], [0.1, 0.7, 0.2], [0.3, 0.1, 0.8]], opacities)
    field = fl.reconstruct(samples, "triquadratic")
    image = render(field, PerspectiveCamera.framing(field.domain, (0.4, 0.8, -0.45)), transfer, size=(6, 6))
    grad = torch.autograd.grad(image.square().sum(), [samples, opacities])
    compiler._compile = compile
    return TABLE_ROW, len(made), [g.flatten()[:5].tolist() for g in grad]
"""


def test_programs_of_another_memory_layout_are_not_found(folder: Path, tmp_path: Path) -> None:
    """By a copy of the package in which the rows of the adjoint's table really are wider, nor its own by this one."""
    shutil.copytree(
        Path(filterlab.__file__).parent, tmp_path / "filterlab", ignore=shutil.ignore_patterns("__pycache__")
    )
    layout = tmp_path / "filterlab" / "ops" / "march_derivatives.py"
    text = layout.read_text(encoding="utf-8")
    assert text.count("TABLE_ROW = 12") == 1
    layout.write_text(text.replace("TABLE_ROW = 12", "TABLE_ROW = 16"), encoding="utf-8")
    here: dict = {}
    exec(MARCH, here)

    row, made, expected = here["told"]()
    assert row == 12
    assert made > 0
    assert here["told"]() == (12, 0, expected)
    done = subprocess.run(
        [sys.executable, "-c", f"{MARCH}\nimport json; print(json.dumps([told(), told()]))"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [[16, made, expected], [16, 0, expected]]
    assert here["told"]() == (12, 0, expected)


FAR_APART = """
import ctypes
from filterlab.ops.cpu import compiler
libc = ctypes.CDLL(None)
libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
libc.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]

def mapped(size):
    return libc.mmap(None, size, 0, 0x4022, -1, 0)  # private, anonymous, not reserved

print(value())
vast, pages = mapped(3 << 30), []
while not pages or pages[-1] > vast:
    pages.append(mapped(4096))
libc.munmap(pages[-2], 4096)
kept = dict(compiler._programs)
compiler._programs.clear()
print(value())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="memory is mapped without being reserved on Linux only")
def test_a_program_is_loaded_where_its_parts_lie_far_apart(folder: Path, forks: None) -> None:
    """One page of room above 3 GiB that are taken, the rest below: once this ended the process."""
    once = PROGRAM.replace("print(", "value = lambda: (")
    done = subprocess.run([sys.executable, "-c", once + FAR_APART], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    first, again = done.stdout.split()
    assert first == again


def test_two_processes_at_once(folder: Path, forks: None) -> None:
    command = [sys.executable, "-c", PROGRAM]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    (first, errors), (second, other_errors) = (process.communicate() for process in both)
    assert [process.returncode for process in both] == [0, 0], errors + other_errors
    assert first == second != ""
    assert [file.suffix for file in folder.iterdir()] == [".o"]
