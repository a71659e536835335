"""The command `filterlab recommend`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from filterlab import names
from filterlab.cli.imports import importing
from filterlab.cli.loading import load
from filterlab.cli.options import MEMORY, TIME, Channel, Frame, Maybe, Quiet, check_name, quantity
from filterlab.cli.outcome import NOTHING_FITS, OK
from filterlab.cli.saving import OutputFile
from filterlab.cli.terminal import progress_bar, show


@dataclass(frozen=True)
class Recommend:
    """Find the cheapest method whose error on this volume stays within a budget.

    Every method is built as it would be used and compared with the best estimate of the signal; costs are measured on
    this machine. The exit code is 3 when nothing meets the budget (the best there is is shown, and written).

    examples:
      filterlab recommend engine.nrrd --max-error 0.5%
      filterlab recommend scan.nii.gz --max-error 1% --task dvr --max-memory 256MiB -o scene.yaml
      filterlab recommend engine.nrrd --max-error 1% --task isosurface --level 90
      filterlab recommend scan.nii.gz --max-error 0.005 --json
    """

    volume: Annotated[Positional[Path], arg(metavar="VOLUME")]
    """The volume: a file, or a folder of numbered TIFF slices."""
    max_error: Annotated[str, arg(metavar="0.5%")]
    """The error that is allowed, in parts of the range of the volume's values: 0.5% or 0.005."""
    task: str = "resample"
    """What is done with it: resample (values), dvr or isosurface (gradients count as well)."""
    level: Annotated[Maybe[float], arg(metavar="90")] = None
    """Of the isosurface: errors are those next to it, not of the whole volume."""
    max_memory: Annotated[Maybe[str], arg(metavar="256MiB")] = None
    """What the coefficients may take, like 256MiB or 2GB."""
    max_time: Annotated[Maybe[str], arg(metavar="30s")] = None
    """What prefiltering and doing the task once may take, like 500ms, 30s or 2min."""
    boundary: str = "mirror"
    """How the volume goes on beyond its ends: mirror, reflect, wrap, border or zeros."""
    nan: str = "refuse"
    """What becomes of voxels that are NaN: refuse, propagate or fill."""
    frame: Frame = None
    """Which volume of a time series (or entry of a batch), from 0."""
    channel: Channel = None
    """Which of several values per voxel, from 0."""
    output: Annotated[Maybe[Path], arg(aliases=["-o"], metavar="SCENE.yaml")] = None
    """A scene to write, for `filterlab render`; a file of that name is replaced."""
    json: bool = False
    """Print the answer as JSON."""
    quiet: Quiet = False
    """Say nothing of what was written, and show no progress."""

    def run(self, overrides: dict[str, str]) -> int:
        max_error = quantity("--max-error", self.max_error, {"%": 0.01, "": 1.0})
        max_memory = quantity("--max-memory", self.max_memory, MEMORY)
        max_time = quantity("--max-time", self.max_time, TIME)
        output = None
        if self.output is not None:
            if self.output.suffix.lower() not in (".yaml", ".yml"):
                raise ValueError(f"expected a scene's name that ends in .yaml; got {self.output}")
            output = OutputFile.at(self.output, self.volume, quiet=self.quiet)

        for what, name, known in (
            ("task", self.task, names.TASKS),
            ("boundary", self.boundary, names.BOUNDARIES),
            ("nan", self.nan, names.NAN_CHOICES),
        ):
            check_name(what, name, known)

        if self.level is not None and self.task != "isosurface":
            raise ValueError(f"--level is that of an isosurface; expected --task isosurface, got {self.task}")

        with importing():
            from filterlab.io.volumes import describe
            from filterlab.methods import reconstruct
            from filterlab.recommendation import recommend, report
            from filterlab.scenes.default import suggested

        part = {"frame": self.frame, "channel": self.channel}
        if self.output is not None and len(shape := describe(self.volume, **part).shape) != 3:
            raise ValueError(f"expected one volume (D, H, W) to write a scene of; {self.volume} has {tuple(shape)}")
        with progress_bar(self.quiet) as progress:
            volume = load(self.volume, self.frame, self.channel, progress)
        file: str | dict[str, Any] = str(self.volume.resolve())
        if chosen := {name: index for name, index in part.items() if index is not None}:
            file = {"file": file, **chosen}
        look: dict[str, Any] = {}
        if self.output is not None:  # what would not render is refused before the work
            look = suggested(reconstruct(volume, "trilinear", boundary=self.boundary, nan=self.nan), level=self.level)
            _check_scene(self.output, {"volume": file, **look})
        with progress_bar(self.quiet) as progress:
            found = recommend(
                volume,
                max_error,
                task=self.task,
                level=self.level,
                max_memory=max_memory,
                max_time=max_time,
                boundary=self.boundary,
                nan=self.nan,
                progress=progress,
            )
        if self.json:
            print(json.dumps(report.data(found), indent=2))
        else:
            show(report.text(found))
        if output is not None:
            _write_yaml(output.path, report.scene(found, file, look))
            output.tell("a scene")
        return OK if found.pick is not None else NOTHING_FITS


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
