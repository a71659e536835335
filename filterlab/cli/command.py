"""`filterlab COMMAND …`: which command is meant, and how it ends."""

from __future__ import annotations

import inspect
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any, Union

import tyro
from tyro.conf import subcommand

from filterlab.cli.convert import Convert, with_output_last
from filterlab.cli.info import Info
from filterlab.cli.mesh import Mesh
from filterlab.cli.methods import Methods
from filterlab.cli.outcome import FAILED, INTERRUPTED, OK, USAGE, UsageError, message_of, out_of_memory, shortage
from filterlab.cli.recommend import Recommend
from filterlab.cli.render import Render
from filterlab.cli.resample import Resample
from filterlab.cli.scene import Scene
from filterlab.cli.scenes import split_overrides
from filterlab.cli.sdf import Sdf
from filterlab.cli.slim import Slim
from filterlab.cli.terminal import tell
from filterlab.cli.terrain import Terrain
from filterlab.names import unknown_name
from filterlab.notices import Notice

DESCRIPTION = """Reconstruction filters for sampled volumes: look at scans, resample and convert them, compare methods.

filterlab COMMAND --help tells more, with examples. filterlab --version tells the version."""

COMMANDS: dict[str, Any] = {
    "render": Render,
    "mesh": Mesh,
    "scene": Scene,
    "terrain": Terrain,
    "sdf": Sdf,
    "slim": Slim,
    "resample": Resample,
    "convert": Convert,
    "recommend": Recommend,
    "methods": Methods,
    "info": Info,
}
SHOWING: dict[str, Any] = {"render": Render, "mesh": Mesh, "scene": Scene}
"""Those that take a scene, and changes to it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments in (["--version"], ["-V"]):
        from importlib.metadata import version

        print(f"filterlab {version('filterlab')}")
        return OK
    overrides: dict[str, str] = {}
    try:
        if arguments[:1] == ["convert"]:
            arguments = with_output_last(arguments)
        if arguments and arguments[0] in SHOWING:
            arguments, overrides = split_overrides(SHOWING[arguments[0]], arguments)
        with _warnings_told():
            return _parse(arguments or ["--help"]).run(overrides) or OK
    except SystemExit as exit:  # tyro: --help, or usage
        return exit.code if isinstance(exit.code, int) else USAGE
    except UsageError as error:
        tell(f"{error} (see filterlab {arguments[0]} --help)")
        return USAGE
    except BrokenPipeError:  # the reader of our output has gone, as in `filterlab methods | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
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


def _parse(arguments: list[str]) -> Any:
    """The command that was asked for. tyro prints help and mistakes of usage, and exits."""
    name = arguments[0]
    if name not in COMMANDS and not name.startswith("-"):
        tell(unknown_name("command", name, COMMANDS))
        raise SystemExit(USAGE)
    if name in COMMANDS:
        kind = COMMANDS[name]
        return tyro.cli(kind, prog=f"filterlab {name}", description=inspect.cleandoc(kind.__doc__), args=arguments[1:])
    kinds = (Annotated[k, subcommand(n, description=k.__doc__.split("\n")[0])] for n, k in COMMANDS.items())
    any_of_them: Any = Union[tuple(kinds)]  # noqa: UP007
    return tyro.cli(any_of_them, prog="filterlab", description=DESCRIPTION, args=arguments)
