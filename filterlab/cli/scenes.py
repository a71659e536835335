"""The scene that `render` and `mesh` are asked for: a file, a volume and a level, and changes to its values."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from filterlab.cli.imports import importing
from filterlab.cli.options import check_device, check_not_input
from filterlab.cli.outcome import UsageError

if TYPE_CHECKING:
    from filterlab.scenes.model import Scene
    from filterlab.volume import Volume


def scene_asked_for(
    path: Path, overrides: dict[str, str], output: Path | None, *, of_surface: bool = False
) -> tuple[Scene, Volume | None]:
    """The scene in a file; of a surface in a file of its own, or of heights; or of a volume, as overrides ask, its
    surface, greatest values or slice, else as it is.

    With it its volume, if that has been read.

    Raises ValueError for one without a surface where it has to be `of_surface`, of a volume before that is read.
    """
    with importing():
        from filterlab.scenes.build import alone_scene, load_scene, surface_scene, terrain_scene, values_scene
        from filterlab.scenes.default import default_view

    part = {name: overrides.pop(name) for name in ("frame", "channel") if name in overrides}
    level = overrides.pop("level", None)
    volume = None
    chosen = overrides | {f"volume.{name}": index for name, index in part.items()}
    sampled = level is not None or bool({name.partition(".")[0] for name in chosen} & {"mip", "slice", "volume"})
    if key := _alone(path):
        if level is not None or part:
            called = {"slim": "a SLIM surface", "quadrics": "quadrics"}[key]
            raise ValueError(f"expected no --level, --frame and --channel of {called}; got some: {path}")
        scene = alone_scene(path, key, chosen)
    elif (asked := _of_volumes(level, overrides, part)) and _holds_heights(path):
        raise ValueError(f"expected no {asked} of heights, which are a terrain and no volume: {path}")
    elif level is not None and path.suffix.lower() in (".yaml", ".yml"):
        raise ValueError(f"expected a volume with --level; got a scene, whose level is --surface.level: {path}")
    elif level is not None:
        scene = surface_scene(path, level, chosen)
    elif path.suffix.lower() in (".yaml", ".yml", "") or not path.is_file():
        scene = load_scene(path, chosen)
    elif not sampled and not of_surface and _holds_heights(path):
        scene = terrain_scene(path, chosen)
    elif {name.partition(".")[0] for name in chosen} & {"mip", "slice"}:
        scene = values_scene(path, chosen)
    else:
        scene, volume = (None, None) if of_surface else default_view(path, chosen)
    if scene is None or (of_surface and scene.cast is None):
        raise ValueError(f"expected a scene with a surface, or a volume and --level; got neither: {path}")
    if of_surface and scene.alone is not None:
        raise ValueError(f"expected a level set, of which triangles are made; got {scene.alone}: {path}")
    if output is not None:
        for source in scene.sources:
            check_not_input(output, Path(source))
    check_device(scene.device)
    return scene, volume


def _of_volumes(level: str | None, overrides: Iterable[str], part: Iterable[str]) -> str:
    """The options among these that only volumes have; a picture of one page may be looked at as a --slice."""
    names = ["level"] * (level is not None) + ["mip"] * any(name.partition(".")[0] == "mip" for name in overrides)
    return ", ".join(f"--{name}" for name in (*names, *part))


def _alone(path: Path) -> str | None:
    """The key of the surface that an .npz file holds, if it is of one."""
    from filterlab.io.covers import is_slim
    from filterlab.io.quadric_files import is_quadrics

    return next((key for key, holds in (("slim", is_slim), ("quadrics", is_quadrics)) if holds(path)), None)


def _holds_heights(path: Path) -> bool:
    from filterlab.io.heights import holds_heights

    return holds_heights(path)


def split_overrides(command: type, arguments: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """What belongs to the command itself, and the changes to the scene: `--key value …` -> {key: YAML text}.

    `--size 512 512` is {"size": "[512, 512]"}; `--key=value` and `--key value` are the same; a key alone is true.

    Raises UsageError for a key that is given twice.
    """
    own = {f"--{f.name}": f.default is False for f in fields(command) if f.name != "scene"}
    own |= {"-o": False, "-q": True, "--frames": False}
    known: list[str] = []
    overrides: dict[str, str] = {}
    rest = list(arguments)
    while rest:
        token = rest.pop(0)
        name, given, _ = token.partition("=")
        if name in own:
            known.append(token)
            if not (given or own.get(name, False)):
                known += rest[:1]
                del rest[:1]
        elif token.startswith("--") and len(token) > 2 and token != "--help":
            key, equals, value = token[2:].partition("=")
            values = [value] if equals else []
            while not equals and rest and not re.match(r"-[-a-zA-Z]", rest[0]):
                values.append(rest.pop(0))
            if key in overrides:
                raise UsageError(f"expected every field once; got --{key} again")
            overrides[key] = "true" if not values else values[0] if len(values) == 1 else f"[{', '.join(values)}]"
        else:
            known.append(token)
    return known, overrides
