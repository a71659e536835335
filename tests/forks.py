"""Processes of Python that tests start, as forks of this one: to import torch anew takes each of them 3 to 5 s."""

from __future__ import annotations

import os
import runpy
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from multiprocessing import get_context
from typing import IO, Any

import pytest


class Fork:
    """What `subprocess.Popen` is for `python -c CODE` and `python -m MODULE`, with all imported that is imported here.

    What it writes is kept in files. It ends without the functions of `atexit`.
    """

    def __init__(
        self,
        args: Sequence[str],
        *,
        stdout: int | None = None,
        stderr: int | None = None,
        text: bool = True,
        env: Mapping[str, str] | None = None,
        cwd: str | os.PathLike[str] | None = None,
    ) -> None:
        self.args = args
        self._told = tempfile.TemporaryFile("w+"), tempfile.TemporaryFile("w+")  # noqa: SIM115
        self._process = get_context("fork").Process(target=_become, args=(args[1:], self._told, env, cwd))
        with warnings.catch_warnings():  # from Python 3.12 on: other threads of ours are idle, or wait for the fork
            warnings.simplefilter("ignore", DeprecationWarning)
            self._process.start()

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0)
        return self.returncode

    def communicate(self, input: None = None, timeout: float | None = None) -> tuple[str, str]:
        self.wait(timeout)
        out, errors = map(_ended, self._told)
        return out, errors

    def send_signal(self, number: int) -> None:
        os.kill(self._process.pid or 0, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def __enter__(self) -> Fork:
        return self

    def __exit__(self, *_: object) -> None:
        self.wait()


def _ended(file: IO[str]) -> str:
    with file:
        file.seek(0)
        return file.read()


def _become(
    words: Sequence[str],
    told: Sequence[IO[str]],
    env: Mapping[str, str] | None,
    cwd: str | os.PathLike[str] | None,
) -> None:
    """In the child: does what `python WORDS` does."""
    for number, file in enumerate(told, 1):
        os.dup2(file.fileno(), number)
    sys.stdout, sys.stderr = (open(number, "w", buffering=1, closefd=False) for number in (1, 2))  # noqa: SIM115
    if env is not None:
        os.environ.clear()
        os.environ.update(env)
    if cwd is not None:
        os.chdir(cwd)
    warnings.resetwarnings()  # they are no errors there
    kind, what, *arguments = words
    sys.argv = [kind, *arguments]
    if kind == "-m":
        runpy.run_module(what, run_name="__main__", alter_sys=True)
    else:
        exec(compile(what, "<string>", "exec"), {"__name__": "__main__"})


@pytest.fixture
def forks(monkeypatch: pytest.MonkeyPatch) -> None:
    """`subprocess` forks this process where it is asked for Python with -c or -m; other commands are run as ever."""
    usual = subprocess.Popen

    def started(args: Any, **options: Any) -> Any:
        forked = hasattr(os, "fork") and args[0] == sys.executable and args[1] in ("-c", "-m")
        return (Fork if forked else usual)(args, **options)

    monkeypatch.setattr(subprocess, "Popen", started)
