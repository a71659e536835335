"""What is shown to a person: tables, and how far a command is."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Timer

PATIENCE = 1.0  # seconds for which nothing is shown: what takes no longer has no bar that flashes


def tell(message: str) -> None:
    """One line on stderr, in the command's name."""
    print(f"filterlab: {message}", file=sys.stderr)


@contextmanager
def progress_bar(quiet: bool = False) -> Iterator[Callable[[float, str], None]]:
    """A bar with the time left on stderr where that is a terminal, after a second; else nothing.

    What is yielded is told how much is done, 0 … 1, and of what. With a part that is smaller than before another work
    begins, whose time is estimated anew.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda done, what: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    task = bar.add_task("reading", total=1.0)

    def update(done: float, what: str) -> None:
        if done < bar.tasks[0].completed:
            bar.reset(task)
        bar.update(task, completed=done, description=what)

    later = Timer(PATIENCE, bar.start)
    later.daemon = True
    later.start()
    try:
        yield update
    finally:
        later.cancel()
        later.join()
        if bar.live.is_started:
            bar.stop()


def show(renderable: object) -> None:
    """Prints a table; wide where the output is a file or a pipe, so that nothing is cut off."""
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(width=200, highlight=False)
    console.print(renderable)
