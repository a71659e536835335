"""Runs compiled programs on as many threads as there are jobs. The programs themselves hand out the chunks.

A signal handler may raise between any two steps of the thread that calls (Ctrl-C does), so that nothing here rests on a
step being reached:

    memory     who works on a job holds it, and it holds its arrays; who calls a program holds its machine code
    threads    are `_thread`'s own and never joined: no lock of theirs can be left locked, none keeps Python from ending
    tasks      are begun by a thread or taken back by the caller, never both; asking twice gives the same answer

Then what is left is to be prompt: a job with much to do is called again and again, a few chunks at a time, in between
handlers run; on an exception nobody takes another chunk, and those that were taken are waited for.
"""

from __future__ import annotations

import ctypes
import os
import sys
from _thread import allocate_lock, start_new_thread
from collections.abc import Callable, Sequence
from functools import cache, partial
from queue import SimpleQueue
from time import perf_counter
from typing import Any, TypeVar

from filterlab.ops.cpu.job import Function, Job

_TURN = 0.01  # seconds; calls that took less do twice as many chunks the next time
_ALL = (1 << 63) - 1  # chunks

_Result = TypeVar("_Result")


def run(function: Function, jobs: Sequence[Job]) -> None:
    """Do every job, the first one here, the others on threads; a job given twice is shared."""
    if len(jobs) == 1:
        _take_turns(function, jobs[0], 0)
        return
    tasks = [_Task(partial(_work, function, job, i)) for i, job in enumerate(jobs) if i > 0]
    try:
        for task in tasks:
            _threads.begin(task)
        _take_turns(function, jobs[0], 0)
        for i, task in enumerate(tasks, 1):
            if task.taken_back():
                _take_turns(function, jobs[i], i)
        for task in tasks:
            task.wait()
    except BaseException:
        for job in jobs:
            job.next = job.chunks
        for task in tasks:
            if not task.taken_back():
                task.wait()
        raise


def aside(call: Callable[[], _Result]) -> _Result:
    """The result of a call that no signal handler can interrupt: another thread makes it, and ends it in any case."""
    task = _Task(call)
    if sys.is_finalizing() or not _threads.begin(task):  # no thread begins any more
        return call()
    task.wait()
    return task.result()


def _work(function: Function, job: Job, thread: int) -> None:
    function(ctypes.addressof(job), thread, _ALL)


def _take_turns(function: Function, job: Job, thread: int) -> None:
    """The same in calls that take no longer than two turns, or one chunk."""
    address, most = ctypes.addressof(job), 1
    function(address, thread, most)
    while job.next < job.chunks:
        start = perf_counter()
        function(address, thread, most)
        if perf_counter() - start < _TURN:
            most *= 2


class _Task:
    """A call that either a thread makes, or, as long as none has begun, the caller takes back."""

    def __init__(self, call: Callable[[], object]) -> None:
        self._call: Callable[[], object] | None = call
        self._owner: dict[None, str] = {}  # what is set first stays
        self._error: BaseException | None = None
        self._value: object = None
        self._ended = False
        self._end = allocate_lock()
        self._end.acquire()

    def work(self) -> None:
        """Make the call, on a thread, unless it was taken back."""
        call = self._call
        if self._owner.setdefault(None, "thread") == "caller" or call is None:
            return
        try:
            self._value = call()
        except BaseException as error:
            self._error = error
        finally:
            self._ended = True
            self._end.release()

    def taken_back(self) -> bool:
        """Whether no thread has begun it; then none will."""
        if self._owner.setdefault(None, "caller") == "thread":
            return False
        self._call = None
        return True

    def wait(self) -> None:
        """Until it has ended; for ever, if no thread was asked. Taken back, it has."""
        while not self._ended and self._call is not None:
            self._end.acquire()

    def result(self) -> Any:
        """What the call returned, or raised."""
        if self._error is not None:
            raise self._error
        return self._value


class _Threads:
    """Threads that wait for tasks; one starts when none is idle.

    Their number does not matter to anybody: tasks that no thread begins are taken back.
    """

    def __init__(self) -> None:
        self._tasks: SimpleQueue[_Task] = SimpleQueue()
        self._idle: list[None] = []  # one for every thread that waits and has no task on its way

    def begin(self, task: _Task) -> bool:
        """Give the task to a thread. False: none can be had."""
        try:
            self._idle.pop()
        except IndexError:
            try:
                start_new_thread(self._serve, ())
            except RuntimeError:  # too many, or the interpreter is shutting down
                return False
        self._tasks.put(task)
        return True

    def _serve(self) -> None:
        _count_one_more()
        while True:
            self._tasks.get().work()  # no name for it: what is done is not held while waiting
            self._idle.append(None)


@cache
def _count_one_more() -> None:
    """Let torch's OpenMP know, once, from a thread of ours, that more threads than its own want the cores.

    At the ends of a loop of torch's, threads of libgomp spin for 3 ms before they sleep, for it takes the cores to be
    theirs. Where two share a core, that one has to wait out the other's spinning at every loop: 143 loops of a render
    make seconds of a fifth of one. libgomp spins a thousandth as long while it counts more of its threads than there
    are cores (its manual, GOMP_SPINCOUNT); of ours it knows nothing. So one of them opens a loop of two threads, whose
    second one sleeps from then on, and is counted.

    Nothing of it is needed where torch uses fewer threads than there are cores: libgomp goes on spinning there.
    """
    if sys.platform != "linux":
        return
    everything = ctypes.CDLL(None)  # torch loads its OpenMP for all to see
    try:
        loop, nothing = everything.GOMP_parallel, everything.omp_get_thread_num
    except AttributeError:
        return
    loop(ctypes.cast(nothing, ctypes.c_void_p), None, 2, 0)


_threads = _Threads()


def _forget() -> None:
    """A fork of this process has none of its threads."""
    global _threads
    _threads = _Threads()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
