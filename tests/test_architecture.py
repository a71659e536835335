"""The shape of the house: imports point one way, public names are pinned, nothing depends on this machine."""

from __future__ import annotations

import ast
import itertools
import subprocess
import sys
from functools import cache
from pathlib import Path

import filterlab

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "filterlab"
SOURCES = sorted(PACKAGE.rglob("*.py"))

# each room may import the rooms before it (and itself); the same number: neither imports the other
FLOORS = {
    "names": -2,
    "notices": -2,
    "world": -2,
    "arrays": -1,
    "geometry": -1,
    "forking": 0,
    "heights": 0,
    "volume": 0,
    "kernels": 0,
    "bernstein": 0,
    "roots": 0,
    "prefilters": 1,
    "signed_distances": 1,
    "ops": 2,
    "fields": 3,
    "missing_values": 3,
    "signals": 4,
    "methods": 4,
    "surfaces": 4,
    "labels": 4,
    "resampling_rows": 3,
    "shrinking": 4,
    "sites": 1,
    "resampling": 5,
    "nn": 5,
    "spectrum": 5,
    "costs": 5,
    "metrics": 5,
    "io": 5,
    "prediction": 6,
    "render": 6,
    "recommendation": 7,
    "scenes": 8,
    "cli": 10,
    "__init__": 11,
    "__main__": 11,
}


def room(path: Path) -> str:
    part = path.relative_to(PACKAGE).parts[0]
    return part.removesuffix(".py")


@cache
def parts(path: Path) -> list[ast.AST]:
    """Every node of a file."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@cache
def imported_modules(path: Path) -> set[str]:
    """Dotted names of everything that a file imports, wherever the import stands."""
    names: set[str] = set()
    for node in parts(path):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: relative imports hide which way an import points"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def rooms_imported(path: Path) -> set[str]:
    modules = {m.split(".")[1] for m in imported_modules(path) if m.startswith("filterlab.")}
    return {m for m in modules if (PACKAGE / m).is_dir() or (PACKAGE / f"{m}.py").is_file()}


def test_every_room_has_a_floor():
    rooms = {room(path) for path in SOURCES}
    assert rooms <= set(FLOORS), "a room without a floor: add it to FLOORS where the flow puts it"


def test_imports_point_one_way():
    found = [
        f"{path.relative_to(ROOT)} imports filterlab.{other}, which stands above or beside it"
        for path in SOURCES
        for other in rooms_imported(path) - {room(path)}
        if not FLOORS[other] < FLOORS[room(path)]
    ]
    assert not found


# the rooms of ops, the same way; a file beside them is the description of an op, or what is summed
OPS_FLOORS = {"descriptions": 0, "reference": 1, "cpu": 2, "cuda": 2, "differentiable": 3, "__init__": 4}


def room_of_ops(path: Path) -> str:
    _, *parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[0] if len(parts) > 1 or parts[0] == "__init__" else "descriptions"


def files_imported(path: Path) -> set[Path]:
    """The files of the package that a file imports, wherever the import stands, for type checkers only too."""
    found = set()
    for name in imported_modules(path):
        parts = name.split(".")
        if parts[0] == "filterlab":
            choices = (PACKAGE.parent.joinpath(*parts[:n]) for n in (len(parts), len(parts) - 1))
            files = (f for c in choices for f in (c.with_suffix(".py"), c / "__init__.py") if f.is_file())
            found |= set(itertools.islice(files, 1))
    return found - {path}


def test_imports_within_ops_point_one_way():
    ops = PACKAGE / "ops"
    pairs = [(path, other) for path in ops.rglob("*.py") for other in files_imported(path) if other.is_relative_to(ops)]
    assert len(pairs) > 300
    rooms = [(path, other, room_of_ops(path), room_of_ops(other)) for path, other in pairs]
    found = [
        f"{path.relative_to(ROOT)} imports {other.relative_to(ROOT)}"
        for path, other, own, of_other in rooms
        if of_other != own and not OPS_FLOORS[of_other] < OPS_FLOORS[own]
    ]
    assert not found


def circles(imports: dict[Path, set[Path]]) -> list[Path]:
    """The files that can be reached from themselves."""

    def reached(start: Path) -> set[Path]:
        seen: set[Path] = set()
        left = list(imports[start])
        while left:
            if (at := left.pop()) not in seen:
                seen.add(at)
                left += imports[at]
        return seen

    return sorted(path for path in imports if path in reached(path))


def test_no_files_import_each_other_in_a_circle():
    found = circles({path: files_imported(path) for path in SOURCES})
    assert not found, "in circles: " + ", ".join(str(path.relative_to(PACKAGE)) for path in found)


def test_a_circle_is_found(tmp_path):
    a, b, c, d = (tmp_path / name for name in "abcd")
    assert circles({a: {b}, b: {c}, c: {a}, d: {a}}) == [a, b, c]
    assert circles({a: {b, c}, b: {c}, c: set(), d: {a}}) == []


def test_every_op_has_its_parts():
    """A description, a plain twin, vector code, and what makes it differentiable; on a GPU as far as there is one."""
    cast = ("raycast", "vectors", "hit_points", "quadrics", "slim")
    ops = ("gather", "place", "prefilter", "march", "projection", *cast)
    for op in ops:
        for room in ("", "reference", "cpu", "differentiable"):
            assert (PACKAGE / "ops" / room / f"{op}.py").is_file(), f"{op} has no {room or 'description'}"


def test_what_stands_in_leaves_has_its_parts():
    """A description, a plain twin, vector code, and a program for a GPU; derivatives are those of all surfaces."""
    for op in ("quadrics", "bilinear", "slim"):
        for room in ("", "reference", "cpu", "cuda"):
            assert (PACKAGE / "ops" / room / f"{op}.py").is_file(), f"{op} has no {room or 'description'}"


def test_the_library_imports_neither_experiments_nor_tests():
    outside = {"experiments", "tests", "benchmarks"}
    found = {path: {m for m in imported_modules(path) if m.split(".")[0] in outside} for path in SOURCES}
    assert len(found) > 250
    assert not {path: modules for path, modules in found.items() if modules}


def test_the_floors_say_what_the_drawing_says():
    """kernels, volume, bernstein, roots → prefilters → ops → fields → methods, surfaces → render."""
    for beside in ("methods", "surfaces"):
        flow = [FLOORS[name] for name in ("kernels", "prefilters", "ops", "fields", beside, "render")]
        assert flow == sorted(set(flow))
    assert FLOORS["methods"] == FLOORS["surfaces"], "surfaces see fields, and never what made them"


ORACLES = (
    *("oracles.py", "laws.py", "ray_oracle.py", "tetrahedral_oracle.py", "tetrahedral_ray_oracle.py"),
    "quadric_oracle.py",
    "slim_oracle.py",
)


def test_the_oracle_is_independent():
    for name in ORACLES:
        modules = imported_modules(ROOT / "tests" / name)
        assert not [m for m in modules if m.startswith(("filterlab", "experiments"))]


def test_public_names_are_pinned():
    assert set(filterlab.__all__) == PUBLIC
    assert list(filterlab.__all__) == sorted(filterlab.__all__)
    assert all(hasattr(filterlab, name) for name in filterlab.__all__)


PUBLIC = {
    "KERNELS",
    "METHODS",
    "PREFILTERS",
    "Boundary",
    "Field",
    "Heights",
    "Method",
    "Recommendation",
    "Volume",
    "costs",
    "from_grid_sample",
    "from_zyx",
    "io",
    "kernels",
    "load_heights",
    "load_volume",
    "metrics",
    "nn",
    "prefilters",
    "recommend",
    "reconstruct",
    "render",
    "resample",
    "save_heights",
    "save_volume",
    "signals",
    "spectrum",
}


def project_files() -> list[Path]:
    """Every text file of the project: what git tracks or would track, or the usual folders where git is absent."""
    try:
        listed = subprocess.run(
            ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.splitlines()
        files = [ROOT / name for name in listed]
    except (OSError, subprocess.CalledProcessError):
        folders = ("filterlab", "tests", "experiments", "configs", "benchmarks", "docs")
        files = [p for folder in folders for p in (ROOT / folder).rglob("*")] + list(ROOT.glob("*.*"))
    text = {".py", ".md", ".toml", ".yaml", ".yml", ".txt", ".j2", ".cfg", ""}
    return [p for p in files if p.is_file() and p.suffix in text]


def test_nothing_needs_a_path_of_one_machine():
    """No file reaches out of the repository: the folder beside it, a home folder, a working folder."""
    outside = ["../" + "shared", "/" + "work/", "/" + "root/", "/" + "home/"]
    found = [
        f"{path.relative_to(ROOT)}: {word}"
        for path in project_files()
        for word in outside
        if word in path.read_text(encoding="utf-8", errors="replace")
    ]
    assert not found


def test_words_have_one_meaning():
    """No module is called by a word that says nothing, and nothing is called just `filter`."""
    banned = {"utils", "util", "helpers", "helper", "misc", "common", "filter", "filters"}
    assert not [p for p in SOURCES if p.stem in banned or set(p.relative_to(PACKAGE).parts[:-1]) & banned]
    for path in SOURCES:
        for node in parts(path):
            name = getattr(node, "name", None) or getattr(node, "arg", None)
            assert name not in banned, f"{path.relative_to(ROOT)} calls something {name!r}"


def test_importing_the_library_is_quiet_and_leaves_heavy_optional_packages_alone():
    code = (
        "import sys, warnings; warnings.simplefilter('error'); import filterlab; filterlab.reconstruct; "
        "late = {'nibabel', 'kornia', 'skimage', 'matplotlib', 'scipy', 'jinja2', 'torch._dynamo'} & set(sys.modules); "
        "assert not late, late"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == done.stderr == ""
