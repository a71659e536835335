"""The command `filterlab render`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from filterlab.cli.options import check_asked, check_not_input
from filterlab.cli.scenes import scene_asked_for
from filterlab.cli.terminal import show


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
        check_asked(self.output, self.explain, ".png")
        if self.output is not None:
            self._check_output(self.output)

        from filterlab.scenes.build import build, render_scene

        scene = scene_asked_for(self.scene, overrides, self.output)
        if self.output is None:
            from filterlab.scenes.plan import plan
            from filterlab.scenes.plan_report import table

            show(table(plan(build(scene))))
            return
        from filterlab.io.images import save_image

        save_image(render_scene(scene, progress=None), self.output)

    def _check_output(self, output: Path) -> None:
        from filterlab.io.atomic import check_writable

        if output.suffix.lower() != ".png":
            raise ValueError(f"expected a picture's name that ends in .png; got {output}")
        check_writable(output)
        check_not_input(output, self.scene)
