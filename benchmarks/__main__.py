"""python -m benchmarks [names …] [--quick] [--threads N] [--repeats K] [--output FILE.json] [--list]"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.settings import CLOCKS, Settings

if TYPE_CHECKING:
    from benchmarks.harness import Comparison, Item, Tick
    from benchmarks.records import Outcome, Report, Section

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
# read when these libraries are loaded: nothing of numpy, scipy or torch may be imported before
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")

EXAMPLES = """examples:
  python -m benchmarks                       everything that can run here
  python -m benchmarks jets peers --quick    two comparisons with small sizes
  python -m benchmarks jets/tricubic         the items of one that begin so
  python -m benchmarks --show FILE.json --markdown

Ratios are medians over interleaved rounds of one run. docs/benchmarks.md says what the rows mean."""


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code: 0 done, 1 a row failed, 2 wrong usage, 130 interrupted."""
    options = _parser().parse_args(arguments)
    for name in _THREAD_VARIABLES:
        os.environ.setdefault(name, str(options.threads))
    try:
        if options.show is not None:
            return _show(options.show, options.markdown)
        return _run(options)
    except (_UsageError, FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError) as error:
        print(f"error: {error}", file=sys.stderr)
        return USAGE


class _UsageError(ValueError):
    pass


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Times operations and renderers against each other and against peers that happen to be installed.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("names", nargs="*", metavar="name", help="comparisons, or items as in jets/tricubic; all")
    parser.add_argument("--list", action="store_true", help="the comparisons and their items")
    parser.add_argument("--quick", action="store_true", help="small sizes: a look, no figures to quote")
    parser.add_argument("--threads", type=_positive, default=1, metavar="N", help="threads of each contestant (1)")
    parser.add_argument("--repeats", type=_positive, default=Settings.repeats, metavar="K", help="rounds (%(default)s)")
    parser.add_argument(
        "--clock", choices=CLOCKS, default="wall", help="cpu: without the time in which a core worked for others (wall)"
    )
    parser.add_argument(
        "--output", type=Path, metavar="FILE.json", help="where the record goes (runs/benchmarks-….json)"
    )
    parser.add_argument("--markdown", action="store_true", help="at the end, the figures in Markdown")
    parser.add_argument("--show", type=Path, metavar="FILE.json", help="print the tables of a record and run nothing")
    return parser


def _positive(text: str) -> int:
    value = int(text) if text.isdigit() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected an integer from 1 on; got {text!r}")
    return value


def _show(path: Path, markdown: bool) -> int:
    from pydantic import ValidationError

    from benchmarks.records import Report
    from benchmarks.tables import as_markdown, as_text

    try:
        report = Report.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        raise _UsageError(f"{path} is no record of this program: {where}: {first['msg']}") from None
    print(as_markdown(report) if markdown else as_text(report))
    return OK


def _run(options: argparse.Namespace) -> int:
    from benchmarks.registry import UnknownNameError, chosen

    make = Settings.small if options.quick else Settings
    settings = make(threads=options.threads, repeats=options.repeats, clock=options.clock)
    try:
        work = chosen(options.names, settings)
    except UnknownNameError as error:
        raise _UsageError(str(error)) from None
    if options.list:
        return _list(work)
    output = _output(options.output)
    _check_threads(settings)
    return _race_all(work, settings, output, options.markdown)


def _list(work: list[tuple[Comparison, list[Item]]]) -> int:
    for comparison, items in work:
        print(f"{comparison.name}: {comparison.summary}")
        for item in items:
            print(f"    {comparison.name}/{item.name}")
    return OK


def _output(asked: Path | None) -> Path:
    """Where the record goes, checked before anything runs."""
    from datetime import datetime

    from filterlab.io.atomic import check_writable

    if asked is not None:
        return check_writable(asked)
    folder = Path("runs")
    folder.mkdir(exist_ok=True)
    return check_writable(folder / f"benchmarks-{datetime.now():%Y%m%d-%H%M%S}.json")


def _check_threads(settings: Settings) -> None:
    from benchmarks.harness import usable_cores

    if settings.threads > usable_cores():
        raise _UsageError(f"--threads must not exceed the {usable_cores()} cores there are; got {settings.threads}")
    if settings.threads > 1 and settings.clock == "cpu":
        raise _UsageError(f"--clock cpu adds up all threads, expected --threads 1 with it; got {settings.threads}")


def _race_all(work: list[tuple[Comparison, list[Item]]], settings: Settings, output: Path, markdown: bool) -> int:
    """Run, print tables after every comparison and all bars at the end; keep the record after every item."""
    from benchmarks.machine import describe
    from benchmarks.records import Report, Section
    from benchmarks.tables import as_markdown, bars, heading, section_as_text

    report = Report(machine=describe(), settings=settings.record(), complete=False, sections=())
    print(heading(report), flush=True)
    try:
        with _progress(work) as begin:
            for comparison, items in work:
                section = Section(name=comparison.name, summary=comparison.summary)
                for item in items:
                    outcome = _outcome(item, settings, begin(comparison, item))
                    section = section.model_copy(update={"outcomes": (*section.outcomes, outcome)})
                    _keep(_with(report, section), output)
                report = _with(report, section)
                print(f"\n{section_as_text(section)}", flush=True)
    except KeyboardInterrupt:
        print(f"\nstopped; what was finished is in {output}", file=sys.stderr)
        return INTERRUPTED
    report = report.model_copy(update={"complete": True})
    _keep(report, output)
    print(f"\n{as_markdown(report) if markdown else bars(report)}".rstrip(), flush=True)
    print(f"record: {output}", file=sys.stderr)
    return FAILED if any(o.errors for s in report.sections for o in s.outcomes) else OK


def _outcome(item: Item, settings: Settings, tick: Tick) -> Outcome:
    """An item that cannot even be built is a row with an error, too."""
    from benchmarks.harness import explained, limited
    from benchmarks.records import Outcome

    try:
        if item.threads is not None:  # CPU time would add up its threads
            settings = replace(settings, threads=item.threads, clock="wall")
        with limited(settings.threads):
            return item.run(settings, tick)
    except Exception as error:
        return Outcome(name=item.name, what="could not be run", errors={item.name: explained(error)})


def _with(report: Report, section: Section) -> Report:
    return report.model_copy(update={"sections": (*report.sections, section)})


def _keep(report: Report, output: Path) -> None:
    from filterlab.io.atomic import atomic_write

    with atomic_write(output) as temporary:
        temporary.write_text(report.model_dump_json(indent=1) + "\n", encoding="utf-8")


@contextmanager
def _progress(work: list[tuple[Comparison, list[Item]]]) -> Iterator:
    """(comparison, item) -> a function to be told the fraction of the item that is done; a bar on a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _comparison, _item: lambda _fraction: None
        return
    columns = (
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    total = sum(item.seconds for _, items in work for item in items)
    with Progress(*columns, console=console, transient=True) as bar:
        task, done = bar.add_task("", total=total), 0.0

        def begin(comparison: Comparison, item: Item) -> Tick:
            nonlocal done
            before, done = done, done + item.seconds
            bar.update(task, completed=before, description=f"{comparison.name}/{item.name}")
            return lambda fraction: bar.update(task, completed=before + fraction * item.seconds)

        yield begin


if __name__ == "__main__":
    sys.exit(main())
