"""`filterlab COMMAND …`: which command is meant, and how it ends."""

from __future__ import annotations

import inspect
import shutil
import sys
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from filterlab.cli.imports import importing
from filterlab.cli.outcome import (
    FAILED,
    INTERRUPTED,
    OK,
    USAGE,
    UsageError,
    message_of,
    out_of_memory,
    shortage,
    unread,
)
from filterlab.cli.terminal import tell
from filterlab.names import unknown_name
from filterlab.notices import Notice

DESCRIPTION = (
    "Reconstruction filters for sampled volumes: look at scans, resample and convert them, compare methods.",
    "filterlab COMMAND --help tells more, with examples. filterlab --version tells the version.",
)
COMMANDS = (
    *("render", "mesh", "scene", "terrain", "sdf", "slim"),
    *("resample", "convert", "recommend", "methods", "info"),
)
"""Each is the class of its name in the module of its name, imported when it is asked for."""

SHOWING = ("render", "mesh", "scene")
"""Those that take a scene, and changes to it."""


def kind_of(command: str) -> Any:
    """The class of a command."""
    return getattr(import_module(f"filterlab.cli.{command}"), command.capitalize())


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments in (["--version"], ["-V"]):
        from importlib.metadata import version

        print(f"filterlab {version('filterlab')}")
        return OK
    if not arguments or arguments[0] in ("--help", "-h"):
        _show_help()
        return OK
    try:
        with importing():
            kind = kind_of(_command(arguments[0]))
        arguments, overrides = _split(kind, arguments)
        with _warnings_told():
            code = _parse(kind, arguments).run(overrides) or OK
            sys.stdout.flush()
            return code
    except SystemExit as exit:  # tyro: --help, or usage
        return exit.code if isinstance(exit.code, int) else USAGE
    except UsageError as error:
        tell(f"{error} (see filterlab {arguments[0]} --help)")
        return USAGE
    except BrokenPipeError:
        return unread()
    except (ValueError, OSError) as error:
        tell(message_of(error))
        return FAILED
    except MemoryError as error:
        tell(f"expected more memory than there is; {error}")
        return FAILED
    except RuntimeError as error:  # torch has no type of its own for an allocation that fails on the CPU
        if not out_of_memory(error):
            raise
        tell(f"expected more memory than there is; {shortage(error)}")
        return FAILED
    except KeyboardInterrupt:
        tell("interrupted")
        return INTERRUPTED


@contextmanager
def _warnings_told() -> Iterator[None]:
    """Tells what filterlab warns of in one line each on stderr."""

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if isinstance(message, Notice):
            tell(message.on_command_line)
        else:
            usual(message, category, *where, **more)

    with warnings.catch_warnings():
        warnings.simplefilter("always", Notice)
        usual, warnings.showwarning = warnings.showwarning, show
        yield


def _command(name: str) -> str:
    """The name of a command. Raises SystemExit for any other."""
    if name not in COMMANDS:
        tell(
            f"expected a command first; got {name}" if name.startswith("-") else unknown_name("command", name, COMMANDS)
        )
        raise SystemExit(USAGE)
    return name


def _split(kind: Any, arguments: list[str]) -> tuple[list[str], dict[str, str]]:
    """What a command takes itself, its name first, and changes to the scene that it is given."""
    if arguments[0] == "convert":
        from filterlab.cli.convert import with_output_last

        return with_output_last(arguments), {}
    if arguments[0] in SHOWING:
        from filterlab.cli.scenes import split_overrides

        return split_overrides(kind, arguments)
    return arguments, {}


def _parse(kind: Any, arguments: list[str]) -> Any:
    """The command that was asked for. tyro prints help and mistakes of usage, and exits."""
    import tyro

    prog, description = f"filterlab {arguments[0]}", inspect.cleandoc(kind.__doc__)
    return tyro.cli(kind, prog=prog, description=description, args=arguments[1:])


def _show_help() -> None:
    """Prints what there is, a sentence for every command."""
    width = min(shutil.get_terminal_size().columns, 100)
    print("usage: filterlab COMMAND ...\n")
    for paragraph in DESCRIPTION:
        print(textwrap.fill(paragraph, width), end="\n\n")
    print("commands:")
    for name in COMMANDS:
        sentence = kind_of(name).__doc__.split("\n")[0]
        print(textwrap.fill(sentence, width, initial_indent=f"  {name:<11}", subsequent_indent=13 * " "))
