"""Vector code on threads: memory outlives whoever works on it, whatever is raised; forks find nothing locked."""

from __future__ import annotations

import ctypes
import os
import re
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch

import filterlab
from filterlab import forking
from filterlab.ops.cpu import threads
from filterlab.ops.cpu.job import Job


class Counting(Job):
    _fields_ = (("next", ctypes.c_int64), ("chunks", ctypes.c_int64), ("sums", ctypes.c_void_p))


def job(chunks: int, memory: np.ndarray | None = None) -> Counting:
    made = Counting(next=0, chunks=chunks)
    made.point(sums=np.zeros(1) if memory is None else memory)
    return made


def taken(address: int, most: int) -> int:
    """Takes chunks as a program does; how many."""
    told, done = Counting.from_address(address), 0
    while done < most and told.next < told.chunks:
        told.next, done = told.next + 1, done + 1
    return done


def test_every_job_is_done_once_by_somebody_with_a_number_of_its_own() -> None:
    seen: list[tuple[int, int]] = []
    jobs = [job(1) for _ in range(5)]
    threads.run(lambda address, thread, most: seen.append((thread, taken(address, most))), jobs)
    assert sorted(thread for thread, done in seen if done) == [0, 1, 2, 3, 4]
    assert sum(done for _, done in seen) == 5


def test_a_long_job_is_done_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(threads, "perf_counter", lambda: 0.001 * sum(asked))  # a chunk takes a millisecond

    def program(address: int, _thread: int, most: int) -> None:
        asked.append(taken(address, most))

    threads.run(program, [job(60)])
    assert asked == [1, 1, 2, 4, 8, 16, 16, 12]


def test_memory_lives_as_long_as_a_thread_works_on_it_though_the_caller_is_gone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is raised is raised again while the caller waits, so that it does not."""
    begun, go_on, gone = threading.Event(), threading.Event(), []

    class Array(np.ndarray):
        def __del__(self) -> None:
            gone.append(True)

    def program(address: int, thread: int, most: int) -> None:
        if thread == 0:
            begun.wait(10)
            raise KeyboardInterrupt
        begun.set()
        go_on.wait(10)

    def call() -> None:
        own = [job(1), job(1, np.zeros(3).view(Array))]
        monkeypatch.setattr(threads._Task, "wait", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            threads.run(program, own)

    call()
    assert not gone
    go_on.set()
    limit = time.monotonic() + 10
    while not gone and time.monotonic() < limit:
        time.sleep(0.001)
    assert gone  # and no longer


def test_on_an_exception_nobody_takes_another_chunk_and_all_are_waited_for() -> None:
    begun, ended = threading.Event(), []

    def program(address: int, thread: int, most: int) -> None:
        if thread == 0:
            begun.wait(10)
            raise KeyboardInterrupt
        begun.set()
        while Counting.from_address(address).next < Counting.from_address(address).chunks:
            time.sleep(0.001)
        ended.append(thread)

    jobs = [job(1000), job(1000)]
    with pytest.raises(KeyboardInterrupt):
        threads.run(program, jobs)
    assert ended == [1]
    assert [one.next for one in jobs] == [1000, 1000]


def test_without_threads_to_be_had_the_caller_does_it_all(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threads, "start_new_thread", refuse)
    monkeypatch.setattr(threads, "_threads", threads._Threads())
    seen: list[int] = []
    threads.run(lambda address, thread, most: seen.append(taken(address, most)), [job(1) for _ in range(3)])
    assert sum(seen) == 3
    assert threads.aside(lambda: "done") == "done"


def test_what_is_called_aside_returns_or_raises_here() -> None:
    assert threads.aside(threading.get_ident) != threading.get_ident()
    with pytest.raises(ZeroDivisionError):
        threads.aside(lambda: 1 / 0)


def test_addresses_are_only_taken_where_the_arrays_are_held() -> None:
    """So that no caller can forget to hold them."""
    package = Path(filterlab.__file__).parent
    taking = re.compile(r"= *\w+(\[\w+\])?\.data_ptr\(\)|ctypes\.data\b|addressof")
    found = {p.name for p in package.rglob("*.py") if taking.search(p.read_text(encoding="utf-8"))}
    asking = {"prefilter.py", "operators.py"}  # how memory is aligned, and whether it is the same
    assert found <= {"job.py", "threads.py"} | asking


# --- beside torch's own threads ---------------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux what threads do")
def test_threads_of_torch_do_not_spin_once_there_are_ours() -> None:
    """Else, whenever two share a core, every loop of torch's takes as long as the one that waits in vain."""
    threads.aside(int)  # there is one of ours now
    before = torch.get_num_threads()
    torch.set_num_threads(max(2, len(os.sched_getaffinity(0))))
    values, loops = torch.zeros(1 << 16), 20
    try:
        values.add_(1)  # torch's threads begin
        time.sleep(0.05)
        start = spent_by_others()
        for _ in range(loops):
            values.add_(1)
            time.sleep(0.01)  # in which they sleep, or spin for 3 ms and more
        assert spent_by_others() - start < loops * 0.001
    finally:
        torch.set_num_threads(before)


def spent_by_others() -> float:
    """CPU seconds of all threads but this one."""
    me, total = threading.get_native_id(), 0
    for task in Path("/proc/self/task").iterdir():
        if int(task.name) != me:
            total += int((task / "schedstat").read_text(encoding="ascii").split()[0])
    return total * 1e-9


# --- what must be left alone ------------------------------------------------------------------------------------------


def test_the_grad_mode_is_never_switched_where_ctrl_c_could_leave_it() -> None:
    """Ctrl-C between the lines of `torch.no_grad` leaves it off for good: within a backward pass torch puts it back."""
    package = Path(filterlab.__file__).parent
    switching = re.compile(r"no_grad\(|set_grad_enabled\(|enable_grad\(|inference_mode\(")
    texts = {str(p.relative_to(package)): p.read_text(encoding="utf-8") for p in package.rglob("*.py")}
    found = {name: switching.findall(text) for name, text in texts.items()}
    assert {name: calls for name, calls in found.items() if calls} == {
        "ops/differentiable/march.py": ["enable_grad("],  # within the backward pass
        "surfaces/base.py": ["enable_grad("],  # which leaves derivatives on, where that happens, and loses none
        "costs.py": ["no_grad("],  # which measures for seconds, and is told so
    }


# --- forks ------------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks here")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # newer Pythons warn of forks beside threads
def test_a_fork_waits_for_what_must_not_be_cut_in_two() -> None:
    held, free = threading.Event(), []

    def hold() -> None:
        with forking.lock:
            held.set()
            time.sleep(0.2)
            free.append(True)

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait(10)
    child = os.fork()
    if child == 0:
        os._exit(0 if free and forking.lock.acquire(timeout=5) and forking.gate.acquire(timeout=5) else 1)
    thread.join()
    assert os.waitpid(child, 0)[1] == 0
    assert free
    assert forking.lock.acquire(timeout=5)
    forking.lock.release()
