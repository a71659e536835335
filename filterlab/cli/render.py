"""The command `filterlab render`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from filterlab.cli.loading import Progress, reading
from filterlab.cli.options import Maybe, Quiet, check_asked
from filterlab.cli.saving import OutputFile
from filterlab.cli.scenes import scene_asked_for
from filterlab.cli.terminal import progress_bar, show

if TYPE_CHECKING:
    from torch import Tensor

    from filterlab.scenes.build import AnyPrepared
    from filterlab.scenes.model import Scene
    from filterlab.volume import Volume


@dataclass(frozen=True)
class Render:
    """Make a picture of a volume or a signal, as a scene file describes it; or of a volume as it is.

    A scene is a YAML file: what is shown, how it is reconstructed, the transfer function or the surface, the camera,
    the lights (filterlab scene --reference). Any of its values can be changed on the command line, after the name of
    the scene, by its path in the file; --frame and --channel choose one of several volumes in a file. In place of a
    scene, a volume file is enough: it is shown by colours and a camera that its values suggest (filterlab scene VOLUME
    prints that scene), or as the surface at a --level, its largest values (--mip) or a slice (--slice z). --legend adds
    the colours and their values to the picture.

    examples:
      filterlab render engine.nrrd -o engine.png
      filterlab render engine.yaml -o engine.png
      filterlab render engine.yaml -o notch.png --method notch --size 512 512
      filterlab render engine.yaml -o zoom.jpg --camera.window 0.4 0.4 0.6 0.6 --volume other.nrrd
      filterlab render engine.yaml --explain
      filterlab render engine.yaml --turntable 36 -o spin.gif
      filterlab render engine.nrrd --level 90 -o surface.png --surface.material toon
      filterlab render head.nii.gz --slice.axis z --slice.center 40 --slice.width 400 -o slice.png
    """

    scene: Annotated[Positional[Path], arg(metavar="SCENE.yaml | VOLUME")]
    """The scene, or a volume."""
    output: Annotated[Maybe[Path], arg(aliases=["-o"], metavar="FILE")] = None
    """The picture to write: a name that ends in .png or .jpg (quality 95); a file of that name is replaced. With
    --turntable .gif, .png (animated), or a folder for numbered .png files, which must be new or empty."""
    turntable: Annotated[Maybe[int], arg(metavar="N")] = None
    """Make N pictures, a whole turn of the camera about what is up, through its target."""
    explain: bool = False
    """Show what the picture would take, and what the scene leaves out; no picture is made."""
    quiet: Quiet = False
    """Say nothing of what was written, and show no progress."""

    def run(self, overrides: dict[str, str]) -> None:
        check_asked(self.output, self.explain, ".png")
        output = None if self.output is None else self._output(self.output)
        scene, volume = scene_asked_for(self.scene, overrides, self.output)
        if self.turntable is not None:
            from filterlab.scenes.turntable import check_turn

            check_turn(scene, self.turntable)
        if output is None:
            self._explain(scene, volume)
            return
        with progress_bar(self.quiet) as progress, reading(progress):
            pictures = _Pictures(self._views(scene, volume), progress)
            self._write(pictures, output.path)
        output.tell(pictures.told)

    def _views(self, scene: Scene, volume: Volume | None) -> list[AnyPrepared]:
        from filterlab.scenes.build import build
        from filterlab.scenes.turntable import turntable

        prepared = build(scene, volume)
        return [prepared] if self.turntable is None else turntable(prepared, self.turntable)

    def _explain(self, scene: Scene, volume: Volume | None) -> None:
        from filterlab.scenes.plan import plan
        from filterlab.scenes.plan_report import table

        views = self._views(scene, volume)
        show(table(plan(views[0]), pictures=len(views)))

    def _write(self, pictures: _Pictures, output: Path) -> None:
        from filterlab.cli.pictures import write_pictures
        from filterlab.scenes.turntable import seconds_of_each

        write_pictures(pictures, output, moving=self.turntable is not None, seconds=seconds_of_each(len(pictures)))

    def _output(self, output: Path) -> OutputFile:
        from filterlab.io.picture_formats import ANIMATIONS, PICTURES, format_of

        if self.turntable is not None and not output.suffix:
            return OutputFile.folder(output, self.scene, quiet=self.quiet)
        format_of(output, PICTURES if self.turntable is None else ANIMATIONS)
        return OutputFile.at(output, self.scene, quiet=self.quiet)


@dataclass
class _Pictures:
    """The pictures of all views, one after the other; progress is told of.

    Attributes:
        told: what was made, when it is.
    """

    views: list[AnyPrepared]
    progress: Progress
    told: str = ""

    def __len__(self) -> int:
        return len(self.views)

    def __iter__(self) -> Iterator[Tensor]:
        from filterlab.scenes.build import picture

        count = len(self.views)
        for k, view in enumerate(self.views):
            what = "rendering" if count == 1 else f"rendering {k + 1} of {count}"
            image = picture(view, partial(self._part, k, what))
            many = "" if count == 1 else f"{count} pictures of "
            self.told = f"{many}{image.shape[1]} × {image.shape[0]} pixels, 8-bit RGB"
            yield image

    def _part(self, k: int, what: str, done: int, total: int) -> None:
        self.progress((k + done / max(total, 1)) / len(self.views), what)
