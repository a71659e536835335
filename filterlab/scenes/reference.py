"""The reference of scene files, written from their models: every key, what it may be, its unit, its default, examples.

`filterlab scene --reference` prints it; docs/scenes.md is the same text.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import textwrap
import types
import typing
from collections.abc import Iterator, Sequence
from dataclasses import astuple
from functools import cache
from itertools import pairwise
from typing import Any

from annotated_types import Ge, Gt, Le, Lt
from pydantic import AfterValidator, BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined, to_jsonable_python

from filterlab.scenes.model import Scene
from filterlab.scenes.model.colors import SPELLED
from filterlab.scenes.model.quantities import Names, Section, Told

WORDS = {float: "number", int: "whole number", bool: "`true` or `false`", str: "text"}
SIGNS = {Ge: "≥", Gt: ">", Le: "≤", Lt: "<"}

BEGINNING = f"""# Scenes

A scene is a YAML file that says what a picture shows and how; `filterlab render SCENE.yaml -o picture.png` makes it.

This page is written from the code that reads scenes (`filterlab scene --reference` prints it). Every key that has a
default may be left out; keys that nobody knows are mistakes. Any value can be changed on the command line by its path:
`--camera.window 0.25 0.25 0.75 0.75`, `--transfer.peaks[0].color tomato`. `filterlab scene SCENE.yaml` prints a scene
with all that it leaves out.

Lengths and positions are those of the volume's world, x, y, z, in the unit of its file (millimetres for NIfTI); without
geometry a voxel is 1 long and the centre of the first one is the origin.

## Colours

A colour is written as {SPELLED.removeprefix("a colour: ")}.
Numbers are linear light, 0 … 1 and more;
[names](https://www.w3.org/TR/css-color-4/#named-colors) and hexadecimal digits are sRGB as everywhere else, and are
decoded. A picture is computed in linear light and encoded by sRGB when it is written, so that an unlit, opaque
`'#ff8800'` is (255, 136, 0) in it. The last two digits of `'#rrggbbaa'` (one of `'#rgba'`) are the opacity that
stands beside the colour; where none does, they are refused.
"""


def reference() -> str:
    """The whole page, Markdown."""
    parts = [BEGINNING]
    for heading, model in sections():
        parts.append("\n".join(_section(heading, model)))
    return "\n".join(parts)


def sections() -> list[tuple[str, type[Section]]]:
    """(heading, model) of every section of a scene, each before those in it; the scene itself has no path."""
    found: dict[type[Section], str] = {Scene: "The scene"}
    for model, path in _below(Scene, ""):
        found.setdefault(model, path)
    return [(heading, model) for model, heading in found.items()]


def _below(model: type[Section], path: str) -> Iterator[tuple[type[Section], str]]:
    for name, field in model.model_fields.items():
        here = f"{path}.{name}" if path else name
        inside = _models(field.annotation)
        for below in inside:
            listed = "[]" if _is_list(field.annotation) else ""
            yield below, f"{here}: {_tag(below)}" if len(inside) > 1 else here + listed
            yield from _below(below, here)


def _is_list(annotation: Any) -> bool:
    arguments = typing.get_args(annotation)
    return typing.get_origin(annotation) is list or Ellipsis in arguments or any(map(_is_list, arguments))


def _tag(model: type[Section]) -> str:
    """What it is told from others by: its kind, or the first key of its own."""
    kind = model.model_fields.get("kind")
    return keys_of(model)[0] if kind is None else typing.get_args(kind.annotation)[0]


def keys_of(model: type[Section]) -> list[str]:
    """All keys, those of its own before those that others have too."""
    return sorted(model.model_fields, key=lambda name: name not in model.__annotations__)


def _models(annotation: Any) -> list[type[Section]]:
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [model for inner in typing.get_args(annotation) for model in _models(inner)]


# --- one section ------------------------------------------------------------------------------------------------------


def _section(heading: str, model: type[Section]) -> Iterator[str]:
    level = "#" * (2 + heading.count("."))
    yield f"{level} {heading}\n"
    yield _text(inspect.getdoc(model) or "") + "\n"
    yield "| key | what it is | value | default |"
    yield "|---|---|---|---|"
    for name in keys_of(model):
        field = model.model_fields[name]
        yield f"| `{name}` | {described(model)[name]} | {value_of(field)} | {default_of(field)} |"
    yield ""
    key = heading.split(":")[0].split(".")[-1]
    for example in model.examples:
        yield "```yaml"
        yield example if model is Scene else _placed(key, example)
        yield "```\n"


def _placed(key: str, example: str) -> str:
    text = f"{key[:-2]}: [{example}]" if key.endswith("[]") else f"{key}: {example}"
    together = text.replace(": ", ":\N{NO-BREAK SPACE}")  # a key and its value stay on one line
    lines = textwrap.wrap(together, 118, subsequent_indent="  ", break_on_hyphens=False)
    return "\n".join(lines).replace("\N{NO-BREAK SPACE}", " ")


@cache
def described(model: type[BaseModel]) -> dict[str, str]:
    """The text under each key of a model and its bases."""
    found: dict[str, str] = {}
    for owner in reversed(model.__mro__):
        if owner is not Section and issubclass(owner, Section):
            found |= _written_under(owner)
    return found


def _written_under(model: type[BaseModel]) -> dict[str, str]:
    body = typing.cast(ast.ClassDef, ast.parse(textwrap.dedent(inspect.getsource(model))).body[0]).body
    pairs = pairwise(body)
    return {
        key.target.id: _text(text.value.value)
        for key, text in pairs
        if isinstance(key, ast.AnnAssign) and isinstance(key.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant) and isinstance(text.value.value, str)
    }


def _text(docstring: str) -> str:
    """On one line, as a cell of a table is."""
    return re.sub(r"\s+", " ", docstring.strip()).replace("|", "\\|")


def default_of(field: FieldInfo) -> str:
    """What a key is when it is left out; nothing where it may be absent."""
    if field.is_required():
        return "*required*"
    default = field.get_default(call_default_factory=True, validated_data={})
    if default is None or default is PydanticUndefined or default in ("", {}):
        return ""
    if isinstance(default, Section):
        return f"`{default.kind}`" if hasattr(default, "kind") else "its defaults"  # type: ignore[attr-defined]
    if isinstance(default, tuple) and isinstance(default[0], Section):
        return "one, its defaults"
    return f"`{json.dumps(to_jsonable_python(default)).strip(chr(34))}`"


def value_of(field: FieldInfo) -> str:
    """What a key may be, with its unit."""
    unit = next((m.unit for m in _told(field.annotation, field.metadata) if m.unit), None)
    return _written(field.annotation, field.metadata) + (f"; {unit}" if unit else "")


def _told(annotation: Any, metadata: Sequence[Any] = ()) -> Iterator[Told]:
    yield from (m for m in metadata if isinstance(m, Told))
    for inner in typing.get_args(annotation):
        if isinstance(inner, Told):
            yield inner
        else:
            yield from _told(inner)


def _written(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """The type in words."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return _written(arguments[0], (*metadata, *_flat(arguments[1:])))
    told = next((m.written for m in metadata if isinstance(m, Told) and m.written), None)
    names = next((m.func for m in metadata if isinstance(m, AfterValidator) and isinstance(m.func, Names)), None)
    if told or isinstance(names, Names):
        return told or _listed(names.known())  # type: ignore[union-attr]
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_written(a, metadata) for a in arguments if a is not types.NoneType))
    if origin is typing.Literal:
        return _listed(arguments)
    if origin is tuple and Ellipsis not in arguments:
        return f"{len(arguments)} {_plural(_written(arguments[0]))}"
    if origin in (list, tuple):
        return f"a list of {_written(arguments[0])}"
    if isinstance(annotation, type) and issubclass(annotation, Section):
        heading = next(h for h, model in sections() if model is annotation)
        return f"[{heading.removesuffix('[]')}](#{anchor(heading)})"
    return WORDS[annotation] + _limits(metadata)


def _flat(metadata: Sequence[Any]) -> list[Any]:
    return [inner for m in metadata for inner in (m.metadata if isinstance(m, FieldInfo) else [m])]


def _limits(metadata: Sequence[Any]) -> str:
    limits = [f"{SIGNS[type(m)]} {astuple(m)[0]}" for m in metadata if type(m) in SIGNS]
    return f" {', '.join(limits)}" if limits else ""


def _listed(names: Any) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _plural(words: str) -> str:
    return re.sub("number", "numbers", words, count=1)


def anchor(heading: str) -> str:
    """What a link to a heading says, on GitHub as elsewhere."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
