"""Strict YAML configurations: a small, safe part of YAML 1.2, validated by a pydantic model.

    config = load_config("scene.yaml", Scene, {"camera.fov": "30"})

What is refused, always with file and line: duplicate keys, keys that are no text, anchors and aliases, tags, numbers
that are not finite, more than one document, more than 32 levels, 100,000 nodes or 1 MiB. Plain scalars follow the YAML
1.2 core schema: `1e-3` is a number, `yes` and `on` are text. Types are checked strictly: "5" in quotes is no integer,
while an integer is a fine float, a list a fine tuple and a text a fine Path or enum.
"""

from __future__ import annotations

import json
import math
import os
import re
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import to_jsonable_python
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from filterlab.names import shown, unknown_name

MAX_BYTES = 2**20
MAX_DEPTH = 32
MAX_NODES = 100_000

Key = str | int
KeyPath = tuple[Key, ...]
Model = TypeVar("Model", bound=BaseModel)


class StrictModel(BaseModel):
    """A section of a configuration: unknown keys are errors, numbers are finite, values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Problem:
    """One thing wrong with a configuration: where it stands (`file:line` or `--key`), the key's path, the message."""

    place: str
    path: str
    message: str

    def __str__(self) -> str:
        return f"{self.place}: {self.path}: {self.message}" if self.path else f"{self.place}: {self.message}"


class ConfigError(ValueError):
    """A configuration that cannot be used; its text is one line per problem. `problems` holds them one by one."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(map(str, self.problems)))


def load_config(
    path: str | os.PathLike[str],
    model: type[Model],
    overrides: Mapping[str, str] | None = None,
    *,
    max_bytes: int = MAX_BYTES,
) -> Model:
    """The configuration in a YAML file, checked against `model`.

    Args:
        path: the file.
        model: a pydantic model, best a `StrictModel`. Its validators find the folder of the file in
            `info.context["folder"]`, for paths that are relative to it.
        overrides: {"camera.fov": "30", "methods[2]": "notch"}: the dotted path of a key and its new value as YAML text,
            set before validation.
        max_bytes: the most that the file may hold. Parsing takes some 1 kB of memory for every value of two bytes.

    Raises:
        ConfigError: every problem, each with its place, the path of the key, what was expected and what came.
        OSError: the file cannot be read.
    """
    path = Path(path)
    document = _parse(_read(path, max_bytes), str(path))
    for key, text in (overrides or {}).items():
        _override(document, model, key, text)
    return _validated(document, model, path.parent)


def loads_config(
    text: str, model: type[Model], overrides: Mapping[str, str] | None = None, *, name: str = "<text>"
) -> Model:
    """As `load_config`, from a text; `name` stands where the file's name would. The folder is the current one."""
    document = _parse(text, name)
    for key, value in (overrides or {}).items():
        _override(document, model, key, value)
    return _validated(document, model, Path())


def loads_data(data: Any, model: type[Model], overrides: Mapping[str, str] | None = None, *, name: str) -> Model:
    """As `loads_config`, of plain data that stand in no file, so that mistakes in them are told of without a line."""
    document = _parse(dump_data(data), name)
    document.places = dict.fromkeys(document.places, name)
    for key, value in (overrides or {}).items():
        _override(document, model, key, value)
    return _validated(document, model, Path())


def dump_config(config: BaseModel, *, brief: bool = False) -> str:
    """A YAML text that `load_config` reads back to an equal model. Raises ValueError on numbers that are not finite.

    Args:
        brief: leave out what nobody said.
    """
    return dump_data(config.model_dump(mode="json", exclude_unset=brief))


def dump_data(data: Any) -> str:
    """The same of plain data: mappings, lists, texts, numbers."""
    _check_finite(data, ())
    readable = "\x85" not in json.dumps(data, ensure_ascii=False)  # PyYAML would read it back as a line feed
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=readable, width=120)


def key_path(keys: Iterable[Key]) -> str:
    """("experiment", "methods", 2) -> "experiment.methods[2]"."""
    text = ""
    for key in keys:
        text += f"[{key}]" if isinstance(key, int) else f".{key}" if text else key
    return text


# --- text -> data -----------------------------------------------------------------------------------------------------


@dataclass
class _Document:
    """Plain data, where each of its keys came from, and what to say where nothing better is known."""

    data: Any
    places: dict[KeyPath, str]
    name: str

    def place(self, path: KeyPath) -> str:
        """Where the key stands; of a key that is missing, where its nearest parent stands."""
        while path and path not in self.places:
            path = path[:-1]
        return self.places.get(path, self.name)


class _RefusedError(Exception):
    def __init__(self, node_or_event: Any, message: str) -> None:
        self.line = node_or_event.start_mark.line + 1
        super().__init__(message)


# The YAML 1.2 core schema. Order matters: the first that matches wins.
_RESOLVERS = (
    ("tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), "tTfF"),
    ("tag:yaml.org,2002:int", re.compile(r"^(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$"), "-+0123456789"),
    (
        "tag:yaml.org,2002:float",
        re.compile(
            r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
            r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
        ),
        "-+.0123456789",
    ),
    ("tag:yaml.org,2002:null", re.compile(r"^(?:~|null|Null|NULL|)$"), ["~", "n", "N", ""]),
)


class _Loader(yaml.SafeLoader):
    """Composes nodes only: bounded, without anchors, aliases and tags."""

    yaml_implicit_resolvers: typing.ClassVar[dict] = {}
    depth = 0
    nodes = 0

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        event: Any = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            raise _RefusedError(event, f"expected no anchors and aliases (& and *); got {event.anchor!r}")
        if event.tag is not None:
            raise _RefusedError(event, f"expected no tags; got {event.tag!r}")
        self.nodes += 1
        self.depth += 1
        if self.nodes > MAX_NODES:
            raise _RefusedError(event, f"expected at most {MAX_NODES} values; got more")
        if self.depth > MAX_DEPTH:
            raise _RefusedError(event, f"expected at most {MAX_DEPTH} levels; got more")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


class _Dumper(yaml.SafeDumper):
    """Quotes what `_Loader` would not read as text, and never writes anchors."""

    yaml_implicit_resolvers: typing.ClassVar[dict] = {}

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_list(dumper: yaml.SafeDumper, data: list) -> Node:
    """Short lists of scalars on one line, as people write points and colours."""
    flat = all(not isinstance(v, list | dict) for v in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=flat)


_Dumper.add_representer(list, _represent_list)
for _tag, _pattern, _first in _RESOLVERS:
    _Loader.add_implicit_resolver(_tag, _pattern, list(_first))
    _Dumper.add_implicit_resolver(_tag, _pattern, list(_first))


def _read(path: Path, max_bytes: int) -> str:
    if not path.is_file():
        problem = "a folder or device" if path.exists() else "no file"
        raise FileNotFoundError(f"cannot read {path}: expected a YAML file; got {problem}")
    with path.open("rb") as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise ConfigError([Problem(str(path), "", f"expected at most {max_bytes} bytes; got more")])
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ConfigError([Problem(f"{path}:{line}", "", "expected UTF-8 text; got other bytes")]) from None


def _parse(text: str, name: str) -> _Document:
    data, places = _parse_value(text, name)
    data = {} if data is None else data
    if not isinstance(data, dict):
        raise ConfigError([Problem(f"{name}:1", "", f"expected keys and values (key: value); got {shown(data)}")])
    return _Document(data, places, name)


def _parse_value(text: str, name: str) -> tuple[Any, dict[KeyPath, str]]:
    """The one value of a YAML text as plain data (None if there is nothing), and the places of its keys."""
    places: dict[KeyPath, str] = {}
    loader = None
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        return (None if node is None else _construct(node, (), name, places)), places
    except _RefusedError as refused:
        raise ConfigError([Problem(f"{name}:{refused.line}", "", str(refused))]) from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{name}:{mark.line + 1}" if mark else name
        reason = ", ".join(part for part in (error.context, error.problem) if part)
        raise ConfigError([Problem(place, "", f"expected valid YAML; got a mistake {reason}")]) from None
    except yaml.YAMLError as error:  # control characters
        raise ConfigError([Problem(name, "", f"expected valid YAML; got {str(error).splitlines()[0]}")]) from None
    except (ValueError, OverflowError):  # "\\U99999999": PyYAML asks Python for a character that there is not
        place = f"{name}:{loader.line + 1}" if loader else name
        raise ConfigError([Problem(place, "", "expected valid YAML; got a character beyond U+10FFFF")]) from None
    finally:
        if loader is not None:
            loader.dispose()


def _construct(node: Node, path: KeyPath, name: str, places: dict[KeyPath, str]) -> Any:
    """Plain data of a node; fills `places` with file:line of every key."""
    places.setdefault(path, f"{name}:{node.start_mark.line + 1}")
    if isinstance(node, ScalarNode):
        return _scalar(node, path)
    if isinstance(node, SequenceNode):
        return [_construct(item, (*path, i), name, places) for i, item in enumerate(node.value)]
    assert isinstance(node, MappingNode)
    data: dict[str, Any] = {}
    for key_node, value_node in node.value:
        key = _scalar(key_node, path) if isinstance(key_node, ScalarNode) else None
        if not isinstance(key, str):
            got = shown(key) if isinstance(key_node, ScalarNode) else "a list or mapping"
            raise _RefusedError(key_node, f"{_prefix(path)}expected keys that are text; got {got}")
        here = (*path, key)
        if key in data:
            raise _RefusedError(key_node, f"{key_path(here)}: expected every key once; first at {places[here]}")
        places[here] = f"{name}:{key_node.start_mark.line + 1}"
        data[key] = _construct(value_node, here, name, places)
    return data


def _scalar(node: ScalarNode, path: KeyPath) -> str | int | float | bool | None:
    text = node.value
    match node.tag.rpartition(":")[2]:
        case "null":
            return None
        case "bool":
            return text.lower() == "true"
        case "int":
            try:
                value = int(text, 0) if text[:2] in ("0o", "0x") else int(text)
                str(value)  # as it is handed on; of a long hexadecimal number only this fails
                return value
            except ValueError:  # Python's limit on the digits of an integer
                raise _RefusedError(node, f"{_prefix(path)}expected a number; got {len(text)} digits") from None
        case "float":
            value = math.nan if text.lower().endswith(("inf", "nan")) else float(text)
            if not math.isfinite(value):
                raise _RefusedError(node, f"{_prefix(path)}expected a finite number; got {text}")
            return value
        case _:
            if re.search("[\ud800-\udfff]", text):  # "\\ud800" in quotes: half a character
                raise _RefusedError(node, f"{_prefix(path)}expected Unicode text; got a lone surrogate")
            return text


def _prefix(path: KeyPath) -> str:
    return f"{key_path(path)}: " if path else ""


def _check_finite(data: Any, path: KeyPath) -> None:
    if isinstance(data, dict):
        for key, value in data.items():
            _check_finite(value, (*path, key))
    elif isinstance(data, list):
        for i, value in enumerate(data):
            _check_finite(value, (*path, i))
    elif isinstance(data, float) and not math.isfinite(data):
        raise ValueError(f"{key_path(path)}: expected a finite number; got {data}")


# --- overrides --------------------------------------------------------------------------------------------------------


def _split(key: str) -> KeyPath | None:
    """ "experiment.methods[2]" or "experiment.methods.2" -> ("experiment", "methods", 2); None if it is no path."""
    if not re.fullmatch(r"[^.\[\]]+(?:\.[^.\[\]]+|\[[0-9]{1,9}\])*", key):
        return None
    parts = re.findall(r"[^.\[\]]+", key)
    return (parts[0], *(int(p) if p.isascii() and p.isdigit() and len(p) <= 9 else p for p in parts[1:]))


def _override(document: _Document, model: type[BaseModel], key: str, text: str) -> None:
    """Sets one value of the document, in place."""
    place, keys = f"--{key}", _split(key)
    if keys is None:
        raise ConfigError([Problem(place, key, "expected the path of a key, like camera.fov or methods[2]")])
    value = _override_value(text, place, key)
    target, parents = document.data, ()
    for i, (part, following) in enumerate(zip(keys, (*keys[1:], None), strict=True)):
        part = _existing(target, part, keys[:i], place)
        parents = (*parents, part)
        document.places = {p: v for p, v in document.places.items() if p[: len(keys)] != keys}
        if following is None:
            target[part] = value
        elif isinstance(target, dict) and target.get(part) is None:
            target[part] = _default(model, parents)
            document.places[parents] = place
        elif isinstance(target, dict):
            target[part] = _unfolded(model, parents, target[part])
        target = target[part]
    document.places[keys] = place


def _unfolded(model: type[BaseModel], path: KeyPath, value: Any) -> Any:
    """A section that stands as a bare value, with its key (`bare` of its model), so that another key can be set.

    An empty `bare` stands for a section that `true` stands for, with every default.
    """
    for owner in _types_at(model, path):
        bare = getattr(owner, "bare", None) if _is_model(owner) else None
        if bare == "" and value is True:
            return {}
        if bare and isinstance(value, str | int | float) and not isinstance(value, bool):
            return {bare: value}
    return value


def _override_value(text: str, place: str, key: str) -> Any:
    if len(text) > MAX_BYTES:
        raise ConfigError([Problem(place, key, f"expected at most {MAX_BYTES} characters; got more")])
    if text.startswith("#"):  # a colour: as YAML it would be a comment, and no value at all
        return text
    try:
        return _parse_value(text, place)[0]
    except ConfigError as error:
        raise ConfigError([Problem(place, key, p.message) for p in error.problems]) from None


def _existing(target: Any, part: Key, parents: KeyPath, place: str) -> Key:
    """The key under which `target` can hold `part`; any text in a mapping, an existing index in a list."""
    if isinstance(target, dict):
        return str(part)
    if isinstance(target, list) and isinstance(part, int):
        if part < len(target):
            return part
        message = f"expected an index from 0 to {len(target) - 1}; got {part}"
    elif isinstance(target, list):
        message = f"expected an index into the list, like [0]; got {part!r}"
    else:
        message = f"expected keys below it; got {shown(target)}"
    raise ConfigError([Problem(place, key_path(parents), message)])


def _default(model: type[BaseModel], path: KeyPath) -> Any:
    """The default of a section or list that the file leaves out, as plain data, so that a part of it can be set."""
    *parents, name = path
    for owner in _types_at(model, tuple(parents)):
        if _is_model(owner) and name in owner.model_fields:
            field = owner.model_fields[name]
            default = None if field.is_required() else field.get_default(call_default_factory=True, validated_data={})
            if isinstance(default, BaseModel | list | tuple | dict):
                return to_jsonable_python(default)
    return {}


# --- validation -------------------------------------------------------------------------------------------------------


def _validated(document: _Document, model: type[Model], folder: Path) -> Model:
    """Strict as JSON is: a list may be a tuple and a text an enum, but a text is never a number."""
    try:
        return model.model_validate_json(json.dumps(document.data), strict=True, context={"folder": folder})
    except ValidationError as error:
        problems = dict.fromkeys(_problem(document, model, details) for details in error.errors(include_url=False))
        raise ConfigError(problems) from None


def _problem(document: _Document, model: type[BaseModel], details: Any) -> Problem:
    keys = _data_path(document.data, details["loc"], details["type"])
    kind, message, value = details["type"], details["msg"], details["input"]
    context = details.get("ctx", {})
    if kind == "extra_forbidden":
        message = unknown_name("key", keys[-1], _known_keys(model, details["loc"][:-1]))
    elif kind == "missing":
        message = "expected a value; this required key is missing"
    elif kind in ("literal_error", "enum", "union_tag_invalid"):
        names = re.findall(r"'([^']*)'", str(context.get("expected") or context.get("expected_tags")))
        shown = value if kind != "union_tag_invalid" else context.get("tag")
        message = unknown_name("name", shown, names) if isinstance(shown, str) and names else _expected(message, value)
    elif kind == "union_tag_not_found":
        message = f"expected the key {context.get('discriminator')}, which tells the kind; it is missing"
    elif kind in ("tuple_type", "list_type"):
        message = _expected("Input should be a list, [ … ]", value)
    elif kind in ("value_error", "assertion_error"):
        message = str(context.get("error", message))
    else:
        message = _expected(message, value)
    return Problem(document.place(keys), key_path(keys), message)


def _expected(message: str, value: Any) -> str:
    head = "Input should be "
    text = message.removeprefix(head) if message.startswith(head) else message[:1].lower() + message[1:]
    return f"expected {text}; got {shown(value)}"


def _data_path(data: Any, location: tuple[Key, ...], kind: str) -> KeyPath:
    """The location without what pydantic adds for unions: only keys that are in the data (or missing there)."""
    path: list[Key] = []
    for i, key in enumerate(location):
        last = i == len(location) - 1
        if isinstance(data, dict) and key in data:
            data = data[key]  # type: ignore[index]
        elif isinstance(data, list) and isinstance(key, int) and key < len(data):
            data = data[key]
        elif not (last and kind == "missing"):
            continue
        path.append(key)
    return tuple(path)


def _is_model(kind: Any) -> typing.TypeGuard[type[BaseModel]]:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _alternatives(annotation: Any) -> list[Any]:
    """The types an annotation allows, unions and Annotated taken apart."""
    origin = typing.get_origin(annotation)
    if isinstance(annotation, typing.TypeAliasType if hasattr(typing, "TypeAliasType") else ()):  # type: ignore[arg-type]
        return _alternatives(annotation.__value__)
    if origin is typing.Annotated:
        return _alternatives(typing.get_args(annotation)[0])
    if origin in (typing.Union, types.UnionType):
        return [kind for part in typing.get_args(annotation) for kind in _alternatives(part)]
    return [annotation]


def _types_at(model: type[BaseModel], location: tuple[Key, ...]) -> list[Any]:
    """The types that may stand at a location as pydantic reports it (tags of unions included)."""
    kinds: list[Any] = [model]
    for key in location:
        below: list[Any] = []
        for kind in kinds:
            arguments = typing.get_args(kind)
            if _is_model(kind):
                if key in kind.model_fields:
                    below += _alternatives(kind.model_fields[key].annotation)  # type: ignore[index]
            elif isinstance(key, int) and arguments:
                fixed = typing.get_origin(kind) is tuple and Ellipsis not in arguments and key < len(arguments)
                below += _alternatives(arguments[key if fixed else 0])
            elif len(arguments) == 2:
                below += _alternatives(arguments[1])
        kinds = below or [k for k in kinds if _tagged(k, key)] or kinds
    return kinds


def _tagged(kind: Any, tag: Key) -> bool:
    """Whether pydantic's name of a branch of a union means this type: its class name or the value of its tag."""
    if not _is_model(kind):
        return False
    literals = [v for f in kind.model_fields.values() for v in typing.get_args(f.annotation)]
    return tag == kind.__name__ or tag in literals


def _known_keys(model: type[BaseModel], location: tuple[Key, ...]) -> list[str]:
    names = [name for kind in _types_at(model, location) if _is_model(kind) for name in kind.model_fields]
    return list(dict.fromkeys(names))
