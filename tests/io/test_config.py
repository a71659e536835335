"""Strict configurations: what is accepted, what is refused, and what the message says."""

from __future__ import annotations

import contextlib
import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field, ValidationInfo, field_validator

from filterlab.io.config import (
    MAX_BYTES,
    ConfigError,
    StrictModel,
    dump_config,
    key_path,
    load_config,
    loads_config,
)
from filterlab.names import unknown_name


class Side(StrEnum):
    LEFT = "left"
    RIGHT = "right"


class Camera(StrictModel):
    fov: float = 30.0
    size: tuple[int, int] = (4, 5)
    side: Side = Side.LEFT


class Ball(StrictModel):
    kind: Literal["ball"]
    radius: Annotated[float, Field(gt=0)] = 1.0


class Cube(StrictModel):
    kind: Literal["cube"]
    edge: float = 1.0


class Scene(StrictModel):
    method: Literal["notch", "trilinear"] = "notch"
    methods: list[Literal["notch", "trilinear"]] = Field(default=[])
    camera: Camera = Camera(fov=20)
    shapes: list[Annotated[Ball | Cube, Field(discriminator="kind")]] = Field(default=[])
    name: str = ""
    count: int = 1
    flag: bool = False
    weights: dict[str, float] = Field(default={})
    anything: Any = None
    folder: Path = Path()

    @field_validator("folder")
    @classmethod
    def _relative(cls, value: Path, info: ValidationInfo) -> Path:
        return info.context["folder"] / value if info.context else value


def problem(text: str, overrides: dict[str, str] | None = None) -> str:
    with pytest.raises(ConfigError) as caught:
        loads_config(text, Scene, overrides, name="a.yaml")
    return str(caught.value)


def anything(text: str) -> Any:
    return loads_config(f"anything: {text}", Scene).anything


def test_reads_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xef\xbb\xbfname: \xc3\xa9\ncamera: {fov: 3, size: [1, 2], side: right}\nfolder: data\n")
    scene = load_config(path, Scene)
    assert (scene.name, scene.camera.fov, scene.camera.size, scene.camera.side) == ("é", 3.0, (1, 2), Side.RIGHT)
    assert scene.folder == tmp_path / "data"
    assert scene.method == "notch"


def test_an_empty_file_is_all_defaults() -> None:
    assert loads_config("# nothing\n", Scene) == Scene()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("1E3", 1e3),
        (".5", 0.5),
        ("5.", 5.0),
        ("-1.5e+2", -150.0),
        ("010", 10),
        ("0x1F", 31),
        ("0o17", 15),
        ("-7", -7),
        ("true", True),
        ("yes", "yes"),
        ("on", "on"),
        ("No", "No"),
        ("1:30", "1:30"),
        ("2024-01-01", "2024-01-01"),
        ("1_000", "1_000"),
        ("'1e-3'", "1e-3"),
        ("~", None),
        ("", None),
        ("null", None),
        ("=", "="),
    ],
)
def test_scalars_follow_yaml_1_2(text: str, value: object) -> None:
    found = anything(text)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("name: a\ncount: 1\nname: b", 3, "name: expected every key once; first at a.yaml:1"),
        ("camera:\n  fov: 1\n  fov: 2", 3, "camera.fov: expected every key once"),
        ("name: a\nanything: &x [1]", 2, "no anchors"),
        ("name: a\nanything: *x", 2, "no anchors"),
        ("anything: !!python/object/apply:os.system [ls]", 1, "no tags"),
        ("anything: !!str 5", 1, "no tags"),
        ("name: a\nanything: [1, .nan]", 2, "anything[1]: expected a finite number; got .nan"),
        ("anything: -.inf", 1, "finite"),
        ('name: a\nanything: "\\ud800"', 2, "anything: expected Unicode text"),
        ("anything: 1e999", 1, "finite"),
        ("anything: " + "9" * 5000, 1, "5000 digits"),
        ("name: a\nanything: 0x" + "f" * 5000, 2, "expected a number; got 5002 digits"),
        ("name: a\ncount: 0o" + "7" * 9000, 2, "expected a number; got 9002 digits"),
        ('name: a\nanything: "\\U00110000"', 2, "a character beyond U+10FFFF"),
        ('name: a\nanything: "\\UFFFFFFFF"', 2, "a character beyond U+10FFFF"),
        ("name: a\n5: b", 2, "keys that are text; got 5"),
        ("camera:\n  true: b", 2, "camera: expected keys that are text; got true"),
        ("? [a]\n: b", 1, "keys that are text"),
        ("<<: {name: a}", 1, "unknown key '<<'"),
        ("name: a\nanything: " + "[" * 32 + "]" * 32, 2, "32 levels"),
        ("name: a\n---\nname: b", 2, "single document"),
        ("name: a\nanything: [1", 2, "expected valid YAML"),
        ("- a", 1, "expected keys and values (key: value); got ['a']"),
        ("name: a\n\tcount: 1", 2, "expected valid YAML"),
    ],
)
def test_refused_with_file_and_line(text: str, line: int, words: str) -> None:
    message = problem(text)
    assert message.startswith(f"a.yaml:{line}: "), message
    assert words in message


def test_levels_and_nodes_up_to_the_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    assert anything("[" * 31 + "]" * 31)
    monkeypatch.setattr("filterlab.io.config.MAX_NODES", 100)
    assert len(anything("[" + "1," * 97 + "]")) == 97  # and the mapping, its key, the list
    assert "a.yaml:1: expected at most 100 values" in problem("anything: [" + "1," * 98 + "]")


def test_control_characters_and_bytes(tmp_path: Path) -> None:
    assert "expected valid YAML" in problem("name: \x01")
    path = tmp_path / "a.yaml"
    path.write_bytes(b"name: a\nfolder: \xff\xfe")
    with pytest.raises(ConfigError, match=r"a\.yaml:2: expected UTF-8"):
        load_config(path, Scene)
    path.write_bytes(b"#" * (MAX_BYTES + 1))
    with pytest.raises(ConfigError, match="at most 1048576 bytes"):
        load_config(path, Scene)
    with pytest.raises(FileNotFoundError, match="no file"):
        load_config(tmp_path / "b.yaml", Scene)
    with pytest.raises(FileNotFoundError, match="folder"):
        load_config(tmp_path, Scene)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "name: a\ncamera:\n  fovv: 3",
            "a.yaml:3: camera.fovv: unknown key 'fovv'; did you mean 'fov'? known keys: fov, size, side",
        ),
        (
            "methods:\n- notch\n- trilinera",
            "a.yaml:3: methods[1]: unknown name 'trilinera'; did you mean 'trilinear'? known names: notch, trilinear",
        ),
        (
            "camera: {side: rigth}",
            "a.yaml:1: camera.side: unknown name 'rigth'; did you mean 'right'? known names: left, right",
        ),
        (
            "shapes: [{kind: cube, radius: 2}]",
            "a.yaml:1: shapes[0].radius: unknown key 'radius'; known keys: kind",
        ),
        (
            "shapes: [{kind: bal}]",
            "a.yaml:1: shapes[0]: unknown name 'bal'; did you mean 'ball'? known names: ball, cube",
        ),
        ("shapes: [{edge: 1}]", "a.yaml:1: shapes[0]: expected the key 'kind', which tells the kind; it is missing"),
        ("shapes: [{kind: ball, radius: -1}]", "a.yaml:1: shapes[0].radius: expected greater than 0; got -1"),
        ("count: '5'", "a.yaml:1: count: expected a valid integer; got '5'"),
        ("count: 1.5", "a.yaml:1: count: expected a valid integer; got 1.5"),
        ("count: true", "a.yaml:1: count: expected a valid integer; got true"),
        ("flag: 1", "a.yaml:1: flag: expected a valid boolean; got 1"),
        ("flag: yes", "a.yaml:1: flag: expected a valid boolean; got 'yes'"),
        ("name: 5", "a.yaml:1: name: expected a valid string; got 5"),
        ("camera: 5", "a.yaml:1: camera: expected an object; got 5"),
        ("camera:", "a.yaml:1: camera: expected an object; got nothing"),
        ("weights: {a: b}", "a.yaml:1: weights.a: expected a valid number; got 'b'"),
        ("camera: {fov: 1" + 400 * "0" + "}", "a.yaml:1: camera.fov: expected a finite number; got 1"),
    ],
)
def test_messages(text: str, message: str) -> None:
    assert problem(text).startswith(message)


def test_a_missing_key_and_all_problems_at_once() -> None:
    class Needy(StrictModel):
        size: int
        camera: Camera

    with pytest.raises(ConfigError) as caught:
        loads_config("camera:\n  fov: wide\n  x: 1", Needy, name="a.yaml")
    assert [p.path for p in caught.value.problems] == ["size", "camera.fov", "camera.x"]
    assert "a.yaml: size: expected a value; this required key is missing" in str(caught.value).replace(":1:", ":")


def test_overrides() -> None:
    text = "camera: {size: [1, 2]}\nmethods: [notch]"
    scene = loads_config(
        text, Scene, {"camera.fov": "1e1", "camera.size[1]": "7", "methods.0": "trilinear", "count": "3"}
    )
    assert (scene.camera.fov, scene.camera.size, scene.methods, scene.count) == (10.0, (1, 7), ["trilinear"], 3)
    assert loads_config(text, Scene, {"methods": "[trilinear, notch]"}).methods == ["trilinear", "notch"]
    assert loads_config(text, Scene, {"weights.a": "2"}).weights == {"a": 2.0}
    # a section left out begins from its default, not from nothing
    assert loads_config("", Scene, {"camera.size[0]": "9"}).camera == Camera(fov=20, size=(9, 5))
    # what is replaced as a whole has no lines of its own left
    assert problem("camera:\n  size: [1, 2]", {"camera.size": "[1, x]"}).startswith("--camera.size: camera.size[1]:")


@pytest.mark.parametrize(
    ("key", "text", "message"),
    [
        ("camra.size", "1", "--camra.size: camra: unknown key 'camra'; did you mean 'camera'? known keys: method"),
        ("camera.fovv", "1", "--camera.fovv: camera.fovv: unknown key 'fovv'; did you mean 'fov'?"),
        ("camera.size[2]", "1", "--camera.size[2]: camera.size: expected an index from 0 to 1; got 2"),
        ("camera.size.x", "1", "--camera.size.x: camera.size: expected an index into the list"),
        ("count.x", "1", "--count.x: count: expected keys below it; got 1"),
        ("method", "noch", "--method: method: unknown name 'noch'; did you mean 'notch'?"),
        ("camera.fov", "wide", "--camera.fov: camera.fov: expected a valid number; got 'wide'"),
        ("camera.fov", "", "--camera.fov: camera.fov: expected a valid number; got nothing"),
        ("camera.fov", "[1", "--camera.fov: camera.fov: expected valid YAML"),
        ("camera.fov", "&a 1", "--camera.fov: camera.fov: expected no anchors"),
        ("camera.fov", "1\ncount: 2", "--camera.fov: camera.fov: expected valid YAML"),
        ("a..b", "1", "--a..b: a..b: expected the path of a key"),
        ("", "1", "--: expected the path of a key"),
    ],
)
def test_bad_overrides(key: str, text: str, message: str) -> None:
    assert problem("count: 1\ncamera: {size: [1, 2]}", {key: text}).startswith(message)


def test_unknown_name_and_key_path() -> None:
    assert unknown_name("method", "noch", ["notch", "ncrsi"]) == (
        "unknown method 'noch'; did you mean 'notch'? known methods: notch, ncrsi"
    )
    assert unknown_name("method", "zzzzz", ["notch"]) == "unknown method 'zzzzz'; known methods: notch"
    assert key_path(("a", "b", 2, 0, "c")) == "a.b[2][0].c"


def test_dump_reads_back() -> None:
    scene = Scene(
        name="1e-3", weights={"yes": 1e-5, "1": 2.0}, shapes=[Ball(kind="ball"), Cube(kind="cube")], anything="true"
    )
    text = dump_config(scene)
    assert loads_config(text, Scene) == scene
    assert "size: [4, 5]" in text
    shared = [1, 2]
    assert loads_config(dump_config(Scene(anything=[shared, shared])), Scene).anything == [[1, 2], [1, 2]]


def test_dump_refuses_what_could_not_be_read() -> None:
    class Loose(StrictModel, allow_inf_nan=True):
        values: list[float]

    with pytest.raises(ValueError, match=r"values\[1\]: expected a finite number; got inf"):
        dump_config(Loose(values=[1.0, math.inf]))


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@given(plain)
@settings(max_examples=40)
def test_anything_plain_survives_dump_and_load(value: Any) -> None:
    assert loads_config(dump_config(Scene(anything=value)), Scene).anything == value


# Controls of both sets (U+0085 ends a line), blanks, what Unicode and YAML call the end of a line, byte order marks.
ODD = [*map(chr, (*range(0x21), *range(0x7F, 0xA1), 0x2028, 0x2029, 0xFEFF, 0xFFFD, 0xFFFE, 0xFFFF)), "é", "水", "😀"]


@pytest.mark.parametrize("shape", ["{}", "a{}", "{}a", "a {} b", "a\n{}\nb"])
def test_every_character_survives_wherever_it_stands(shape: str) -> None:
    for odd in ODD:
        value = [shape.format(odd), {shape.format(odd): 1}]
        assert loads_config(dump_config(Scene(anything=value)), Scene).anything == value
    assert "é水😀" in dump_config(Scene(anything="é水😀"))


# pieces of YAML and of what people write in it, put together at random
pieces = st.sampled_from(
    [
        *(
            "name: ",
            "anything: ",
            "camera: ",
            "shapes: ",
            "- ",
            "? ",
            ": ",
            "{",
            "}",
            "[",
            "]",
            ", ",
            "\n",
            "\n  ",
            "\t",
        ),
        *(
            "'",
            '"',
            "#",
            "&a ",
            "*a",
            "!!python/object:os.system ",
            "!x ",
            "<<: ",
            "---\n",
            "...\n",
            "%YAML 1.1\n",
            ">-\n",
        ),
        *(
            "\\n",
            "\\x41",
            "\\ud800",
            "\\U00110000",
            "\\UFFFFFFFF",
            ".nan",
            "-.inf",
            "1e999",
            "0x",
            "0o7",
            "9" * 20,
            "true",
        ),
        *("null", "~", "=", "\0", "\x85", "\u2028", "\ufeff", "é", "a", "b"),
    ]
)
texts = st.text(max_size=60) | st.text("{}[]:-,&*!|>'\"#% \n\tab1.?\\xuU0", max_size=40)


@given(texts | st.lists(pieces, max_size=25).map("".join))
def test_any_text_is_a_config_or_a_config_error(text: str) -> None:
    with contextlib.suppress(ConfigError):
        assert isinstance(loads_config(text, Scene), Scene)


@given(st.dictionaries(st.text(max_size=8), texts, max_size=3))
def test_any_override_is_a_config_or_a_config_error(overrides: dict[str, str]) -> None:
    with contextlib.suppress(ConfigError):
        assert isinstance(loads_config("count: 1", Scene, overrides), Scene)
