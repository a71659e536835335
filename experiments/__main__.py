"""python -m experiments list | run CONFIG [--field value …] | report RUN"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from experiments.errors import RunError
from experiments.headings import known_configs
from experiments.registry import heading_of
from filterlab.cli.imports import importing
from filterlab.cli.outcome import FAILED, OK, USAGE, UsageError, unread
from filterlab.io.atomic import disk_is_full
from filterlab.io.bounded import VolumeFileError
from filterlab.io.config import ConfigError

OWN_OPTIONS = ("--fresh", "--runs", "--help")

USAGE_TEXT = """
  python -m experiments list
  python -m experiments run CONFIG [--field value …] [--fresh] [--runs DIR]
  python -m experiments report RUN"""

EXAMPLES = """examples:
  python -m experiments run demo
  python -m experiments run rms_error --points 10000 --methods.0 notch
  python -m experiments run rms_error --studies.0.resolutions '[8, 16, 32]'
  python -m experiments report runs/demo-0123456789

CONFIG is a YAML file or the bare name of one in configs/. Any field of it can be changed by its dotted path; the new
value is read as YAML. An interrupted run goes on where it stopped when the same command is given again."""


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code: 0 done, 1 failed, 2 wrong usage or config, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        known, overrides = split_overrides(arguments)
        options = _parser().parse_args(known)
        if overrides and options.command != "run":
            raise UsageError(f"only `run` takes fields of a config; got --{next(iter(overrides))}")
        if options.command == "list":
            return _list()
        with importing():
            from experiments import running
        if options.command == "run":
            return running.run(options, overrides, arguments)
        return running.report(options.run)
    except (ConfigError, UsageError) as error:
        print(f"error: {error}", file=sys.stderr)
        return USAGE
    except BrokenPipeError:
        return unread()
    except (RunError, VolumeFileError, OSError) as error:
        print(f"error: {_explained(error)}", file=sys.stderr)
        return FAILED


def split_overrides(arguments: list[str]) -> tuple[list[str], dict[str, str]]:
    """Our own words, and {dotted path: YAML text} of every other `--field value` or `--field=value`."""
    known: list[str] = []
    overrides: dict[str, str] = {}
    rest = iter(arguments)
    for word in rest:
        name, equals, value = word.partition("=")
        if not word.startswith("--") or name in OWN_OPTIONS:
            known.append(word)
            continue
        if not equals:
            value = next(rest, None)
            if value is None or value.startswith("--"):
                raise UsageError(f"{word} needs a value, as in {word} VALUE")
        if name.removeprefix("--") in overrides:
            raise UsageError(f"{name} is given twice")
        overrides[name.removeprefix("--")] = value
    return known, overrides


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m experiments",
        usage=USAGE_TEXT,
        description="Experiments of filterlab: compute records, resume when interrupted, draw one HTML report.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="list | run | report", prog="python -m experiments"
    )
    commands.add_parser("list", help="the configs there are, with what each shows")
    run = commands.add_parser(
        "run",
        help="run a config (or go on with it) and write its report",
        description="Runs a config, or goes on with it, and writes its report.",
        usage="python -m experiments run CONFIG [--field value …] [--fresh] [--runs DIR]",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    run.add_argument("config", metavar="CONFIG", help="a YAML file, or the bare name of one in configs/")
    run.add_argument("--fresh", action="store_true", help="begin anew in a folder of its own, keeping the old one")
    run.add_argument("--runs", type=Path, default=Path("runs"), metavar="DIR", help="where run folders go")
    report = commands.add_parser("report", help="draw the report of a run folder again")
    report.add_argument("run", metavar="RUN", type=Path, help="a run folder, e.g. runs/demo-0123456789")
    return parser


def _list() -> int:
    configs = known_configs()
    width = max(map(len, configs), default=0)
    for name, path in configs.items():
        print(f"{name:<{width}}  {heading_of(path).description}")
    sys.stdout.flush()
    return OK


def _explained(error: Exception) -> str:
    if isinstance(error, OSError) and disk_is_full(error):
        kept = "what was finished is kept: free some space and give the same command again"
        where = f" at {error.filename}" if error.filename else ""
        return f"the disk is full{where} ({error.strerror}); {kept}"
    return str(error)


if __name__ == "__main__":
    sys.exit(main())
