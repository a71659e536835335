"""The command `filterlab`: render | mesh | sdf | resample | recommend | methods | info.

Exit codes: 0 done, 1 a mistake in what was asked (a message on stderr), 2 a command line that makes no sense,
3 `recommend` found nothing within the budget, 130 interrupted.

What is slow to import is imported by the command that needs it.
"""

from __future__ import annotations

import inspect
import json
import math
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Union

import tyro
from tyro.conf import Positional, arg, subcommand

from filterlab.io.warned import VolumeFileWarning
from filterlab.world import RAS, World

if TYPE_CHECKING:
    import torch

    from filterlab.io.bounded import VolumeHeader
    from filterlab.scenes.model import Scene
    from filterlab.signed_distances import Grid, Triangles
    from filterlab.volume import Volume

OK, FAILED, USAGE, NOTHING_FITS, INTERRUPTED = 0, 1, 2, 3, 130
BINS = 16

Triple = tuple[float, float, float]
Output = Annotated[Path, arg(aliases=["-o"], metavar="FILE")]
Frame = Annotated[int | None, arg(metavar="T")]
Channel = Annotated[int | None, arg(metavar="C")]


class UsageError(ValueError):
    """A command line that makes no sense: exit code 2."""


@dataclass(frozen=True)
class Render:
    """Make a picture of a volume or a signal, as a scene file describes it; or of the surface at a level in a volume.

    A scene is a YAML file: what is shown, how it is reconstructed, the transfer function or the surface, the camera,
    the lights. Any of its values can be changed on the command line, after the name of the scene, by its path in the
    file; --frame and --channel choose one of several volumes in a file. In place of a scene, a volume file and --level
    are enough for a surface.

    examples:
      filterlab render engine.yaml -o engine.png
      filterlab render engine.yaml -o notch.png --method notch --size 512 512
      filterlab render engine.yaml -o zoom.png --camera.window 0.4 0.4 0.6 0.6 --volume other.nrrd
      filterlab render engine.yaml --explain
      filterlab render engine.nrrd --level 90 -o surface.png --surface.material toon
    """

    scene: Annotated[Positional[Path], arg(metavar="SCENE.yaml | VOLUME")]
    """The scene, or a volume with --level."""
    output: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE")] = None
    """The picture to write: a name that ends in .png."""
    explain: bool = False
    """Show what the picture would take, and what the scene leaves out; no picture is made."""

    def run(self, overrides: dict[str, str]) -> None:
        _check_asked(self.output, self.explain, ".png")
        if self.output is not None:
            self._check_output(self.output)

        from filterlab.scenes.build import build, render_scene

        scene = _scene(self.scene, overrides, self.output)
        if self.output is None:
            from filterlab.scenes.plan import plan
            from filterlab.scenes.plan_report import table

            _show(table(plan(build(scene))))
            return
        from filterlab.io.images import save_image

        save_image(render_scene(scene, progress=None), self.output)

    def _check_output(self, output: Path) -> None:
        from filterlab.io.atomic import check_writable

        if output.suffix.lower() != ".png":
            raise ValueError(f"expected a picture's name that ends in .png; got {output}")
        check_writable(output)
        _check_not_input(output, self.scene)


@dataclass(frozen=True)
class Mesh:
    """Make triangles of the surface at a level in a volume, with vertices exactly on it.

    What is meshed is said as for `filterlab render`: a volume file and --level, or a scene with a surface; any value of
    the scene can be changed, like --method. Files: .ply, .obj and .stl (pip install 'filterlab[mesh]').

    examples:
      filterlab mesh engine.nrrd --level 90 -o engine.ply
      filterlab mesh engine.nrrd --level 90 -o fine.stl --step 0.5 --method notch
      filterlab mesh surface.yaml -o surface.obj
      filterlab mesh engine.nrrd --level 90 --explain
    """

    scene: Annotated[Positional[Path], arg(metavar="VOLUME | SCENE.yaml")]
    """The volume, with --level; or a scene with a surface."""
    output: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE")] = None
    """The mesh to write: a name that ends in .ply, .obj or .stl."""
    step: float = 1.0
    """Between the points of the grid that triangles are made on, in voxels."""
    outside: str = "lower"
    """Where normals point to: lower values (air in CT), or greater ones."""
    explain: bool = False
    """Show what the mesh would take; no mesh is made."""

    def run(self, overrides: dict[str, str]) -> None:
        from filterlab.io.meshes import check_mesh_file, save_mesh

        _check_asked(self.output, self.explain, ".ply")
        if self.output is not None:
            check_mesh_file(self.output)
            _check_not_input(self.output, self.scene)
        _check_name("outside", self.outside, ("lower", "greater"))
        if not 0 < self.step < math.inf:  # a NaN fails too
            raise ValueError(f"expected --step to be a positive number of voxels; got {self.step:g}")

        from filterlab.scenes.build import PreparedSurface, build
        from filterlab.scenes.plan import plan_of_mesh
        from filterlab.scenes.plan_report import table
        from filterlab.surfaces.meshes import mesh

        scene = _scene(self.scene, overrides, self.output)
        if scene.surface is None:
            raise ValueError(f"expected a scene with a surface; this one shows a medium: {self.scene}")
        prepared = build(scene)
        assert isinstance(prepared, PreparedSurface)
        if self.output is None:
            _show(table(plan_of_mesh(prepared, self.step)))
            return
        with _progress_bar() as progress:
            made = mesh(
                prepared.surface,
                self.step,
                outside=self.outside,  # type: ignore[arg-type]
                progress=lambda done: progress(done, "meshing"),
            )
        if not len(made.faces):
            print(f"filterlab: no triangles: nothing crosses level {float(prepared.surface.level):g}", file=sys.stderr)
        save_mesh(made, self.output)


def _check_asked(output: Path | None, explain: bool, ending: str) -> None:
    """Raises UsageError unless a command makes something, or explains what it would make."""
    if explain == (output is not None):
        raise UsageError(f"expected either -o FILE{ending} or --explain; got " + ("both" if explain else "neither"))


def _scene(path: Path, overrides: dict[str, str], output: Path | None) -> Scene:
    """The scene in a file; or, with a level among the overrides, that of the surface in a volume."""
    from filterlab.scenes.build import load_scene, surface_scene

    part = {name: overrides.pop(name) for name in ("frame", "channel") if name in overrides}
    level = overrides.pop("level", None)
    if level is None and path.suffix.lower() not in (".yaml", ".yml", "") and path.is_file():
        raise ValueError(f"expected a scene, a .yaml file; for the surface in a volume add --level: {path}")
    chosen = overrides | {f"volume.{name}": index for name, index in part.items()}
    scene = load_scene(path, chosen) if level is None else surface_scene(path, level, chosen)
    if scene.volume is not None and output is not None:
        _check_not_input(output, Path(scene.volume.file))
    _check_device(scene.device)
    return scene


@dataclass(frozen=True)
class Resample:
    """Put a volume on another grid: finer, coarser, or that of another volume.

    The volume is reconstructed by the chosen method and sampled anew; it stays where it is in the world. Making it
    coarser does not blur first. Files: NRRD, NIfTI, TIFF stacks, .npy, .npz and .raw with a sidecar are read; .nrrd,
    .nii, .nii.gz, .npy and .npz are written.

    examples:
      filterlab resample engine.nrrd -o fine.nrrd --method notch --spacing 0.5 0.5 0.5
      filterlab resample engine.nrrd -o small.nii.gz --shape 128 128 64 --dtype input
      filterlab resample pet.nii.gz -o pet_on_ct.nii.gz --like ct.nii.gz --fill 0
      filterlab resample cells.ome.tif -o nuclei.nrrd --channel 1 --frame 0 --spacing 0.2 0.2 0.2
      filterlab resample organs.nii.gz -o organs_on_ct.nii.gz --like ct.nii.gz --labels
    """

    input: Annotated[Positional[Path], arg(metavar="IN")]
    """The volume: a file, or a folder of numbered TIFF slices."""
    output: Output
    """The volume to write."""
    method: str = "triquadratic"
    """How values between the voxels are found; `filterlab methods` lists the names."""
    spacing: Annotated[Triple | None, arg(metavar="SX SY SZ")] = None
    """New size of a voxel along x, y, z, in the volume's own units."""
    shape: Annotated[tuple[int, int, int] | None, arg(metavar="NX NY NZ")] = None
    """Instead of it: new number of voxels along x, y, z."""
    like: Annotated[Path | None, arg(metavar="FILE")] = None
    """Instead of it: a volume file whose grid is taken over."""
    boundary: str = "mirror"
    """How the volume goes on beyond its ends: mirror, reflect, wrap, border or zeros."""
    nan: str = "refuse"
    """What becomes of voxels that are NaN: refuse, propagate (NaN near them) or fill (values from around)."""
    frame: Frame = None
    """Which volume of a time series (or entry of a batch), from 0."""
    channel: Channel = None
    """Which of several values per voxel, from 0: components of vectors, colours, dyes."""
    fill: float | None = None
    """The value of voxels outside of IN, for --like; `nan` too. Default: none, the boundary rules there."""
    labels: bool = False
    """The values of IN are names, not amounts: of each the method reconstructs where it is, and the strongest wins."""
    dtype: str | None = None
    """Type of the result: float32, float64, an integer type (rounded and clipped), or `input` for the type of IN.
    Default: `input` for labels and for the method nearest, else float32, or float64 if that is what the values need."""
    nifti2: bool = False
    """Write NIfTI-2, which fewer tools open; NIfTI-1 rounds numbers of the affine, by 6e-8 of themselves at most."""
    max_gigabytes: float = 8.0
    """The most memory that one volume may take: IN as it is read, or the result as it is computed or written."""

    def run(self, overrides: dict[str, str]) -> None:
        from filterlab.io.atomic import check_writable

        asked = [self.spacing is not None, self.shape is not None, self.like is not None]
        if sum(asked) != 1:
            raise UsageError(
                "expected one of --spacing, --shape and --like; got " + ("several" if any(asked) else "none")
            )
        check_writable(self.output)
        for path in (self.input, self.like):
            if path is not None:
                _check_not_input(self.output, path)

        import numpy as np
        import torch

        from filterlab.io.volumes import check_saveable, describe, load_volume, save_volume
        from filterlab.methods import METHODS
        from filterlab.missing_values import CHOICES
        from filterlab.resampling import resample
        from filterlab.volume import Boundary, Volume

        _check_name("method", self.method, METHODS)
        _check_name("boundary", self.boundary, Boundary)
        _check_name("nan", self.nan, CHOICES)
        source = describe(self.input, frame=self.frame, channel=self.channel)
        source.check_choice()
        target = None if self.like is None else describe(self.like)
        keeps = self.labels or self.method == "nearest"
        stored = _result_type(self.dtype or ("input" if keeps else None), source)
        working = _working_type(stored, source)
        check_saveable(self.output, batched=len(source.shape) == 5, nifti2=self.nifti2)
        self._check_fill(stored)
        limit = _limit(self.max_gigabytes)
        shape = [*source.shape[:-3], *self._new_size(source, target)]
        itemsize = max(working.itemsize, source.dtype.itemsize if keeps else 0, np.dtype(stored or "float32").itemsize)
        _check_memory(shape, itemsize, limit)
        volume = load_volume(self.input, frame=self.frame, channel=self.channel, max_bytes=limit)
        grid: dict = {"spacing": self.spacing} if self.spacing else {"shape": self.shape[::-1] if self.shape else None}
        if target is not None:  # a grid without samples: one voxel, shown over and over
            grid = {"like": Volume.with_geometry(torch.zeros(()).expand(target.shape[-3:]), target.geometry)}
        if not keeps:
            _tell_labels(volume, source, self.input)
        asked = {"dtype": None if keeps or stored is None else working, "labels": self.labels, "fill": self.fill}
        result = resample(volume, self.method, boundary=self.boundary, nan=self.nan, **asked, **grid)
        save_volume(_converted(result, stored), self.output, stored=stored, nifti2=self.nifti2)
        _tell_rounding(result, self.output, self.nifti2)

    def _check_fill(self, stored: str | None) -> None:
        """Raises ValueError for a fill that no integer of the result is."""
        import numpy as np

        if self.fill is None or stored is None or stored.startswith("float"):
            return
        info = np.iinfo(stored)
        if not (math.isfinite(self.fill) and self.fill == int(self.fill) and info.min <= self.fill <= info.max):
            raise ValueError(f"expected a --fill that {stored} holds; got {self.fill:g}")

    def _new_size(self, source: VolumeHeader, target: VolumeHeader | None) -> list[float]:
        """Voxels along x, y, z of the result; checks what was asked."""
        if target is not None:
            return list(target.size)
        if self.shape is not None:
            if min(self.shape) < 1:
                raise ValueError(f"expected --shape of 1 or more voxels along every axis; got {self.shape}")
            return [_as_float(n) for n in self.shape]
        assert self.spacing is not None
        if not all(math.isfinite(s) and s > 0 for s in self.spacing):
            raise ValueError(f"expected a --spacing of positive numbers; got {self.spacing}")
        return [max(1.0, n * s / t) for n, s, t in zip(source.size, source.spacing, self.spacing, strict=True)]


@dataclass(frozen=True)
class Sdf:
    """Make a volume of signed distances from a triangle mesh: how far each voxel is from it, < 0 inside.

    The mesh is then the level 0, and greater values are outside. One that is not closed has an inside too, where its
    winding number is above ½; you are told. Voxels are cubes unless --shape or --spacing say otherwise. Files: .ply,
    .obj, .stl, .off and .glb are read (pip install 'filterlab[mesh]'); .nrrd, .nii, .nii.gz, .npy and .npz are written.

    examples:
      filterlab sdf bunny.obj -o bunny.nrrd --size 128
      filterlab sdf part.stl -o part.nii.gz --spacing 0.5 0.5 1 --margin 5
      filterlab render bunny.nrrd --level 0 -o bunny.png
      filterlab mesh bunny.nrrd --level 0 --outside greater -o smooth.ply
    """

    input: Annotated[Positional[Path], arg(metavar="MESH")]
    """The mesh."""
    output: Output
    """The volume to write."""
    size: Annotated[int | None, arg(metavar="N")] = None
    """Voxels along the longest side; default 128."""
    shape: Annotated[tuple[int, int, int] | None, arg(metavar="NX NY NZ")] = None
    """Instead of it: number of voxels along x, y, z, each side divided on its own."""
    spacing: Annotated[Triple | None, arg(metavar="SX SY SZ")] = None
    """Instead of it: size of a voxel along x, y, z, in the mesh's own units."""
    margin: float = 3.0
    """Voxels that are kept free around the mesh, on every side."""
    dtype: str = "float32"
    """Type of the result: float32 or float64."""
    nifti2: bool = False
    """Write NIfTI-2, which fewer tools open; NIfTI-1 rounds numbers of the affine, by 6e-8 of themselves at most."""
    max_gigabytes: float = 8.0
    """The most memory that the volume may take."""

    def run(self, overrides: dict[str, str]) -> None:
        from filterlab.io.atomic import check_writable

        asked = [given is not None for given in (self.size, self.shape, self.spacing)]
        if sum(asked) > 1:
            raise UsageError("expected one of --size, --shape and --spacing; got several")
        _check_name("dtype", self.dtype, ("float32", "float64"))
        check_writable(self.output)
        _check_not_input(self.output, self.input)

        import torch

        from filterlab.io.meshes import load_mesh
        from filterlab.io.volumes import check_saveable, save_volume
        from filterlab.signed_distances import libigl, signed_distance

        check_saveable(self.output, nifti2=self.nifti2)
        libigl()
        limit, dtype = _limit(self.max_gigabytes), getattr(torch, self.dtype)
        triangles = load_mesh(self.input)
        grid = self._grid(triangles)
        _check_memory(grid.size, dtype.itemsize, limit)
        self._tell_open(triangles)
        with _progress_bar() as progress:
            volume = signed_distance(triangles, grid, dtype=dtype, progress=lambda done: progress(done, "measuring"))
        save_volume(volume, self.output, nifti2=self.nifti2)
        _tell_rounding(volume, self.output, self.nifti2)

    def _grid(self, triangles: Triangles) -> Grid:
        from filterlab.signed_distances import Grid

        if self.shape is not None:
            return Grid.with_shape(triangles, self.shape, self.margin)
        if self.spacing is not None:
            return Grid.with_spacing(triangles, self.spacing, self.margin)
        return Grid.with_size(triangles, 128 if self.size is None else self.size, self.margin)

    def _tell_open(self, triangles: Triangles) -> None:
        """That signs are a guess, where they are."""
        count = triangles.unbalanced_edges()
        if count:
            print(
                f"filterlab: {self.input} is not closed: around {count} edges there are holes, or triangles turned "
                "round; inside is where its winding number is above ½",
                file=sys.stderr,
            )


@dataclass(frozen=True)
class Methods:
    """List the reconstruction methods and what each promises.

    support: width of the kernel along an axis, in voxels; with a prefilter the influence of a sample goes on beyond it
    and decays. taps: coefficients that one value is the sum of; the notch, whose kernel has 64 taps, is evaluated with
    27 after averaging neighbours. order: L, the error falls as the L-th power of the voxel size (and without the
    prefilter). smooth: C0 continuous, C1 its gradient too, C2 its curvature too. samples: whether the reconstruction
    returns the samples at the voxel centres (and without the prefilter).
    """

    def run(self, overrides: dict[str, str]) -> None:
        from rich.table import Table

        from filterlab.methods import METHODS

        table = Table("method", "support", "taps", "order", "smooth", "samples", "gradients", "schemes", "what it is")
        for name, method in METHODS.items():
            f = method.facts
            table.add_row(
                name,
                str(f.support),
                str(f.taps),
                _both(str(f.approximation_order), str(f.approximation_order_without_prefilter), f.prefiltered),
                f"C{f.continuity}",
                _both(_yes(f.interpolating), _yes(f.interpolating_without_prefilter), f.prefiltered),
                ", ".join(f.gradients),
                ", ".join(f.schemes),
                method.summary,
            )
        _show(table)


@dataclass(frozen=True)
class Info:
    """Show what is in a volume file: its header, where it lies in the world, and how its values are distributed.

    examples:
      filterlab info engine.nrrd
      filterlab info scan.nii.gz --header-only
      filterlab info series.nii.gz --frame 3
    """

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """The volume: a file, or a folder of numbered TIFF slices."""
    header_only: Annotated[bool, arg(aliases=["-H"])] = False
    """Do not read the voxels."""
    frame: Frame = None
    """Which volume of a time series (or entry of a batch), from 0."""
    channel: Channel = None
    """Which of several values per voxel, from 0."""

    def run(self, overrides: dict[str, str]) -> None:
        from rich.table import Table
        from rich.text import Text

        from filterlab.io.volumes import describe, load_volume

        header = describe(self.file, frame=self.frame, channel=self.channel)
        table = Table(show_header=False, box=None)
        for name, value in _described(header):
            table.add_row(name, Text(value))
        _show(table)
        if not self.header_only and _tell_open_choice(header):
            table = Table(show_header=False, box=None)
            volume = load_volume(self.file, frame=self.frame, channel=self.channel)
            for name, value in _distribution(volume.samples):
                table.add_row(name, Text(value))
            _show(table)


@dataclass(frozen=True)
class Recommend:
    """Find the cheapest method whose error on this volume stays within a budget.

    Every method is built as it would be used and compared with the best estimate of the signal; costs are measured on
    this machine. The exit code is 3 when nothing meets the budget (the best there is is shown, and written).

    examples:
      filterlab recommend engine.nrrd --max-error 0.5%
      filterlab recommend scan.nii.gz --max-error 1% --task dvr --max-memory 256MiB -o scene.yaml
      filterlab recommend scan.nii.gz --max-error 0.005 --json
    """

    volume: Annotated[Positional[Path], arg(metavar="VOLUME")]
    """The volume: a file, or a folder of numbered TIFF slices."""
    max_error: Annotated[str, arg(metavar="0.5%")]
    """The error that is allowed, in parts of the range of the volume's values: 0.5% or 0.005."""
    task: str = "resample"
    """What is done with it: resample (values), dvr or isosurface (gradients count as well)."""
    max_memory: Annotated[str | None, arg(metavar="256MiB")] = None
    """What the coefficients may take, like 256MiB or 2GB."""
    max_time: Annotated[str | None, arg(metavar="30s")] = None
    """What prefiltering and doing the task once may take, like 500ms, 30s or 2min."""
    boundary: str = "mirror"
    """How the volume goes on beyond its ends: mirror, reflect, wrap, border or zeros."""
    nan: str = "refuse"
    """What becomes of voxels that are NaN: refuse, propagate or fill."""
    frame: Frame = None
    """Which volume of a time series (or entry of a batch), from 0."""
    channel: Channel = None
    """Which of several values per voxel, from 0."""
    output: Annotated[Path | None, arg(aliases=["-o"], metavar="SCENE.yaml")] = None
    """A scene to write, for `filterlab render`."""
    json: bool = False
    """Print the answer as JSON."""

    def run(self, overrides: dict[str, str]) -> int:
        from filterlab.io.atomic import check_writable

        max_error = quantity("--max-error", self.max_error, {"%": 0.01, "": 1.0})
        max_memory = quantity("--max-memory", self.max_memory, MEMORY)
        max_time = quantity("--max-time", self.max_time, TIME)
        if self.output is not None:
            if self.output.suffix.lower() not in (".yaml", ".yml"):
                raise ValueError(f"expected a scene's name that ends in .yaml; got {self.output}")
            check_writable(self.output)
            _check_not_input(self.output, self.volume)

        from filterlab.io.volumes import describe, load_volume
        from filterlab.missing_values import CHOICES, resolved
        from filterlab.recommendation import TASKS, recommend, report
        from filterlab.volume import Boundary

        for what, name, known in (
            ("task", self.task, TASKS),
            ("boundary", self.boundary, Boundary),
            ("nan", self.nan, CHOICES),
        ):
            _check_name(what, name, known)
        part = {"frame": self.frame, "channel": self.channel}
        if self.output is not None and len(shape := describe(self.volume, **part).shape) != 3:
            raise ValueError(f"expected one volume (D, H, W) to write a scene of; {self.volume} has {tuple(shape)}")
        volume = load_volume(self.volume, frame=self.frame, channel=self.channel)
        file: str | dict[str, Any] = str(self.volume.resolve())
        if chosen := {name: index for name, index in part.items() if index is not None}:
            file = {"file": file, **chosen}
        voxel = min(volume.spacing)
        if self.output is not None:  # what would not render is refused before the work
            samples, unknown = resolved(volume.samples, self.nan)
            if unknown is not None:
                raise ValueError("expected --nan fill to write a scene with; with propagate its picture has NaN in it")
            low, high = samples.aminmax()
            _check_scene(self.output, report.shown(file, (float(low), float(high)), voxel))
        with _progress_bar() as progress:
            found = recommend(
                volume,
                max_error,
                task=self.task,
                max_memory=max_memory,
                max_time=max_time,
                boundary=self.boundary,
                nan=self.nan,
                progress=progress,
            )
        if self.json:
            print(json.dumps(report.data(found), indent=2))
        else:
            _show(report.text(found))
        if self.output is not None:
            _write_yaml(self.output, report.scene(found, file, voxel))
        return OK if found.pick is not None else NOTHING_FITS


MEMORY = {"": 1.0, "B": 1.0} | {
    f"{letter}{ending}": base**power
    for power, letter in enumerate("KMGT", start=1)
    for ending, base in (("B", 1000.0), ("iB", 1024.0))
}
TIME = {"": 1.0, "s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}


def quantity(option: str, text: str | None, units: dict[str, float]) -> float:
    """A positive number with one of the units; infinite for None. Raises UsageError for anything else."""
    if text is None:
        return math.inf
    match = re.fullmatch(r"\s*([0-9.eE+-]+)\s*([A-Za-z%]*)\s*", text)
    known = {unit.lower(): factor for unit, factor in units.items()}
    try:
        value = float(match[1]) * known[match[2].lower()] if match else math.nan
    except (ValueError, KeyError):
        value = math.nan
    if not 0 < value < math.inf:
        listed = ", ".join(unit for unit in units if unit)
        raise UsageError(f"expected {option} to be a positive number, with or without a unit ({listed}); got {text!r}")
    return value


@contextmanager
def _progress_bar() -> Iterator[Callable[[float, str], None]]:
    """A bar on stderr where that is a terminal, else nothing."""
    if not sys.stderr.isatty():
        yield lambda done, what: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=1.0)
        yield lambda done, what: bar.update(task, completed=done, description=what)


def _check_scene(path: Path, content: dict[str, Any]) -> str:
    """A scene as YAML. Raises ValueError for what `filterlab render` would refuse, or no file can hold."""
    from filterlab.io.config import dump_data, loads_config
    from filterlab.scenes.model import Scene

    try:
        str(content["volume"]).encode()
    except UnicodeEncodeError:
        raise ValueError(f"expected a name in UTF-8 to write into a scene; got {content['volume']!r}") from None
    text = dump_data(content)
    loads_config(text, Scene, name=str(path))
    return text


def _write_yaml(path: Path, content: dict[str, Any]) -> None:
    """A scene, checked, then written."""
    from filterlab.io.atomic import atomic_write

    text = _check_scene(path, content)
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


DESCRIPTION = """Reconstruction filters for sampled volumes: look at scans, resample them, compare methods.

filterlab COMMAND --help tells more, with examples. filterlab --version tells the version."""

COMMANDS: dict[str, Any] = {
    "render": Render,
    "mesh": Mesh,
    "sdf": Sdf,
    "resample": Resample,
    "recommend": Recommend,
    "methods": Methods,
    "info": Info,
}
SHOWING: dict[str, Any] = {"render": Render, "mesh": Mesh}
"""Those that take a scene, and changes to it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments in (["--version"], ["-V"]):
        print(f"filterlab {version('filterlab')}")
        return OK
    overrides: dict[str, str] = {}
    try:
        if arguments and arguments[0] in SHOWING:
            arguments, overrides = split_overrides(arguments)
        with _warnings_told():
            return _parse(arguments or ["--help"]).run(overrides) or OK
    except SystemExit as exit:  # tyro: --help, or usage
        return exit.code if isinstance(exit.code, int) else USAGE
    except UsageError as error:
        print(f"filterlab: {error} (see filterlab {arguments[0]} --help)", file=sys.stderr)
        return USAGE
    except BrokenPipeError:  # the reader of our output has gone, as in `filterlab methods | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (ValueError, OSError) as error:
        print(f"filterlab: {_message(error)}", file=sys.stderr)
        return FAILED
    except MemoryError as error:
        print(f"filterlab: expected more memory than there is; {error}", file=sys.stderr)
        return FAILED
    except RuntimeError as error:  # torch has no type of its own for an allocation that fails on the CPU
        if not _out_of_memory(error):
            raise
        print(f"filterlab: expected more memory than there is; {_shortage(error)}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("filterlab: interrupted", file=sys.stderr)
        return INTERRUPTED


@contextmanager
def _warnings_told() -> Iterator[None]:
    """Tells what is odd about volume files in one line each on stderr."""

    def tell(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, VolumeFileWarning):
            print(f"filterlab: {message}", file=sys.stderr)
        else:
            usual(message, category, *where, **more)

    with warnings.catch_warnings():
        warnings.simplefilter("always", VolumeFileWarning)
        usual, warnings.showwarning = warnings.showwarning, tell
        yield


def _parse(arguments: list[str]) -> Any:
    """The command that was asked for. tyro prints help and mistakes of usage, and exits."""
    name = arguments[0]
    if name in COMMANDS:
        kind = COMMANDS[name]
        return tyro.cli(kind, prog=f"filterlab {name}", description=inspect.cleandoc(kind.__doc__), args=arguments[1:])
    kinds = (Annotated[k, subcommand(n, description=k.__doc__.split("\n")[0])] for n, k in COMMANDS.items())
    any_of_them: Any = Union[tuple(kinds)]  # noqa: UP007
    return tyro.cli(any_of_them, prog="filterlab", description=DESCRIPTION, args=arguments)


def split_overrides(arguments: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """What belongs to the command itself, and the changes to the scene: `--key value …` -> {key: YAML text}.

    `--size 512 512` is {"size": "[512, 512]"}; `--key=value` and `--key value` are the same; a key alone is true.

    Raises UsageError for a key that is given twice.
    """
    own = {f"--{f.name}": f.name == "explain" for f in fields(SHOWING[arguments[0]]) if f.name != "scene"}
    known: list[str] = []
    overrides: dict[str, str] = {}
    rest = list(arguments)
    while rest:
        token = rest.pop(0)
        name, given, _ = token.partition("=")
        if token == "-o" or name in own:
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


def _message(error: ValueError | OSError) -> str:
    """The text of an error; for the operating system's own, what it says about which file."""
    from filterlab.io.atomic import disk_is_full

    if disk_is_full(error):
        where = f"cannot write {error.filename}: " if error.filename else ""  # type: ignore[union-attr]
        return f"{where}the disk is full ({error.strerror})"  # type: ignore[union-attr]
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or ''}: {error.strerror}".removeprefix(": ")
    return str(error)


def _out_of_memory(error: RuntimeError) -> bool:
    """Whether it is torch that could not allocate, on the CPU or on a device."""
    signs = ("can't allocate memory", "not enough memory", "out of memory", "Storage size calculation overflowed")
    return any(sign in str(error) for sign in signs)


def _shortage(error: RuntimeError) -> str:
    asked = re.search(r"[Tt]ried to allocate ([\d.]+ \w+)", str(error))
    return f"torch could not get another {asked[1]}" if asked else _first_line(error)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _check_not_input(output: Path, source: Path) -> None:
    if os.path.realpath(output) == os.path.realpath(source):
        raise ValueError(f"expected an output other than the input; got {output} for both")


def _check_name(what: str, name: str, known: object) -> None:
    from filterlab.io.config import unknown_name

    names = [str(k) for k in known]  # type: ignore[attr-defined]
    if name not in names:
        raise ValueError(unknown_name(what, name, names))


def _check_device(name: str) -> None:
    import torch

    try:  # rays are float64, and a value must come back (`meta` has none)
        torch.ones(1, dtype=torch.float64, device=name).item()
    except (RuntimeError, AssertionError, TypeError) as error:
        raise ValueError(
            f"device: expected a device that torch can use here, like cpu; got {name!r} ({_first_line(error)})"
        ) from None


INTEGERS = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64")


def _result_type(name: str | None, source: VolumeHeader) -> str | None:
    """The type in the file, by NumPy's name; None: what the values need."""
    if name is None:
        return None
    _check_name("dtype", name, ["float32", "float64", *INTEGERS, "input"])
    if name != "input":
        return name
    if source.dtype.is_floating_point:
        return str(source.dtype).removeprefix("torch.")
    return source.stored if source.stored in INTEGERS else "uint8"  # bool


def _working_type(stored: str | None, source: VolumeHeader) -> torch.dtype:
    """What is computed in: float64 where that comes in or goes out, or wide integers do."""
    import torch

    wide = ("float64", "int32", "uint32", "int64", "uint64")
    if source.dtype == torch.float64 or stored == "float64":
        return torch.float64
    return torch.float64 if source.stored in wide and stored != "float32" else torch.float32


def _tell_labels(volume: Volume, source: VolumeHeader, path: Path) -> None:
    """Warns of a volume whose values are likely to be names, between which nothing lies."""
    from filterlab.labels import look_like_labels

    if source.fields.get("intent") == "labels" or look_like_labels(volume.samples):
        what = "its values look like labels, and are mixed like amounts; --labels or --method nearest keeps them"
        print(f"filterlab: {path}: {what}", file=sys.stderr)


def _limit(gigabytes: float) -> int:
    """Bytes that one volume may take."""
    if not 0 < gigabytes < math.inf:  # a NaN fails too
        raise ValueError(f"expected --max-gigabytes to be a positive number; got {gigabytes}")
    return int(min(gigabytes * 2**30, sys.maxsize))  # beyond that there is nothing to limit


def _tell_rounding(volume: Volume, output: Path, nifti2: bool) -> None:
    """What is lost of the affine, where something is: NIfTI-1 holds it in float32."""
    from filterlab.io import nifti
    from filterlab.io.volumes import format_of

    if format_of(output).name == "NIfTI" and nifti.version_for(volume, nifti2) == 1:
        lost = nifti.rounding(volume.affine)
        if lost > 0:
            what = f"{output}: the affine is rounded to float32, by {lost:.0e} of itself; --nifti2 keeps it"
            print(f"filterlab: {what}", file=sys.stderr)


def _check_memory(shape: Sequence[float], itemsize: int, limit: int) -> None:
    """Raises ValueError for a result (N, C and voxels along x, y, z) above the limit or what the machine has."""
    needed = math.prod(shape) * itemsize
    got = f"{' × '.join(f'{n:.6g}' for n in shape)} voxels of {itemsize} bytes, {needed / 2**30:.3g} GiB"
    if needed > limit:
        raise ValueError(f"expected a result of at most {limit / 2**30:g} GiB (--max-gigabytes); got {got}")
    if needed > (installed := _installed_memory()):
        raise ValueError(f"expected a result that fits in the {installed / 2**30:.3g} GiB of this machine; got {got}")


def _as_float(n: int) -> float:
    """The number; ∞ for one that is beyond all floats."""
    try:
        return float(n)
    except OverflowError:
        return math.inf


def _installed_memory() -> float:
    """Bytes of main memory; ∞ where the system does not tell."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):
        return math.inf


def _converted(volume: Volume, stored: str | None) -> Volume:
    """The volume in a type that holds what is stored; integers are rounded, and clipped to what that holds."""
    import numpy as np
    import torch

    from filterlab.io.bounded import SAMPLE_TYPES

    if stored is None or not volume.dtype.is_floating_point:  # integers are written as they are, or refused
        return volume
    dtype = getattr(torch, SAMPLE_TYPES[stored])
    if dtype.is_floating_point:
        return volume.to(dtype)
    least, most = int(np.iinfo(stored).min), min(int(np.iinfo(stored).max), torch.iinfo(dtype).max)
    samples = volume.samples.round().clamp(least, most)
    top = samples >= float(most)  # the largest int64 is no float: converting it would wrap round
    return type(volume).with_geometry(samples.to(dtype).masked_fill(top, most), volume.geometry)


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def _both(with_prefilter: str, without: str, prefiltered: bool) -> str:
    return f"{with_prefilter} ({without})" if prefiltered else with_prefilter


def _show(renderable: object) -> None:
    """Prints a table; wide where the output is a file or a pipe, so that nothing is cut off."""
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(width=200, highlight=False)
    console.print(renderable)


def _described(header: VolumeHeader) -> list[tuple[str, str]]:
    """Lines about a volume's header."""
    import numpy as np

    def numbers(values: Sequence[float]) -> str:
        return " ".join(f"{v:.6g}" for v in values)

    dtype = str(header.dtype).removeprefix("torch.")
    extent = [n * s for n, s in zip(header.size, header.spacing, strict=True)]
    lines = [
        ("file", f"{header.path} ({header.format}, {header.encoding})"),
        ("size (x, y, z)", " × ".join(map(str, header.size))),
        ("type", header.stored if header.stored == dtype else f"{header.stored}, read as {dtype}"),
        ("memory", f"{header.nbytes / 2**20:.4g} MiB"),
        ("spacing", numbers(header.spacing)),
        ("origin", numbers(header.origin)),
        ("extent", numbers(extent)),
        ("world axes", _axes(header.world)),
        *([("unit", header.world.unit)] if header.world.unit else []),
        *_forms(header.world),
    ]
    lines[2:2] = _choice(header)
    if np.count_nonzero(header.affine[:3, :3] - np.diag(header.spacing)):
        lines += [("affine" if i == 0 else "", numbers(row)) for i, row in enumerate(header.affine)]
    return lines + list(header.fields.items())


def _axes(world: World) -> str:
    """What the axes of a world are, and what they are called in the file where that is something else."""
    if world.axes is None:
        return "not declared"
    return world.axes if world.space in (world.axes, RAS) else f"{world.axes} (declared {world.space})"


def _forms(world: World) -> list[tuple[str, str]]:
    """What a NIfTI file says of its place."""
    forms = world.nifti
    if forms is None:
        return []
    elsewhere = "; they tell different places" if forms.to_qform else ""
    time = "" if forms.time == "unknown" else f", time in {forms.time}"
    return [("codes", f"NIfTI-{forms.version}, sform {forms.sform}, qform {forms.qform}{elsewhere}{time}")]


def _choice(header: VolumeHeader) -> list[tuple[str, str]]:
    """How many frames and channels there are, where there are several, and which one this is."""
    choice, lines = header.choice, []
    for name, count, index in (
        ("frames", choice.frames, choice.frame),
        ("channels", choice.channels, choice.channel),
    ):
        if count > 1:
            lines.append((name, f"{count}" if index is None else f"{count}; this is {index}"))
    return lines


def _tell_open_choice(header: VolumeHeader) -> bool:
    """Whether the voxels are those of one volume; if not, says on stderr what to choose."""
    try:
        header.check_choice()
    except ValueError as error:
        print(f"filterlab: no voxels are read: {error}", file=sys.stderr)
        return False
    return True


def _distribution(samples: torch.Tensor) -> list[tuple[str, str]]:
    """Range, mean and a histogram of the finite values."""
    import torch

    values = samples.flatten()
    lines = []
    if values.dtype.is_floating_point:
        finite = values[values.isfinite()]
        lines += [("not finite", str(values.numel() - finite.numel()))] if finite.numel() < values.numel() else []
        values = finite
    if values.numel() == 0:
        return [*lines, ("range", "no finite values")]
    low, high = (float(v) for v in values.aminmax())
    lines += [("range", f"{low:.6g} … {high:.6g}"), ("mean", f"{values.double().mean():.6g}")]
    if high == low:
        return lines
    span = high - low
    bins = min(BINS, int(span) + 1) if not values.dtype.is_floating_point else BINS
    place = ((values.double() - low) * (bins / (span + (0 if values.dtype.is_floating_point else 1)))).long()
    counts = torch.bincount(place.clamp_(0, bins - 1), minlength=bins)
    return lines + _bars(counts.tolist(), low, span + (0 if values.dtype.is_floating_point else 1))


def _bars(counts: list[int], low: float, span: float) -> list[tuple[str, str]]:
    """One line per bin: where it begins, its share, and a bar on a logarithmic scale (1 voxel to all of them)."""
    total, width = sum(counts), span / len(counts)
    lines = []
    for i, count in enumerate(counts):
        bar = "█" * (1 + round(29 * math.log(count) / max(math.log(total), 1e-9))) if count else ""
        lines.append((f"from {low + i * width:.6g}", f"{100 * count / total:6.2f} %  {bar}"))
    return lines
