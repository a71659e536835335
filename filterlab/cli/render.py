"""The command `filterlab render`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from filterlab.cli.loading import reading
from filterlab.cli.options import Quiet, check_asked
from filterlab.cli.saving import OutputFile
from filterlab.cli.scenes import scene_asked_for
from filterlab.cli.terminal import progress_bar, show


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
    """The picture to write: a name that ends in .png; a file of that name is replaced."""
    explain: bool = False
    """Show what the picture would take, and what the scene leaves out; no picture is made."""
    quiet: Quiet = False
    """Say nothing of what was written, and show no progress."""

    def run(self, overrides: dict[str, str]) -> None:
        check_asked(self.output, self.explain, ".png")
        output = None if self.output is None else self._output(self.output)

        from filterlab.scenes.build import build, render_scene

        scene = scene_asked_for(self.scene, overrides, self.output)
        if output is None:
            from filterlab.scenes.plan import plan
            from filterlab.scenes.plan_report import table

            show(table(plan(build(scene))))
            return
        from filterlab.io.images import save_image

        with progress_bar(self.quiet) as progress, reading(progress):
            image = render_scene(scene, lambda done, total: progress(done / max(total, 1), "rendering"))
        save_image(image, output.path)
        output.tell(f"{image.shape[1]} × {image.shape[0]} pixels, 8-bit RGB")

    def _output(self, output: Path) -> OutputFile:
        if output.suffix.lower() != ".png":
            raise ValueError(f"expected a picture's name that ends in .png; got {output}")
        return OutputFile.at(output, self.scene, quiet=self.quiet)
