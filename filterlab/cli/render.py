"""The command `filterlab render`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from filterlab.cli.options import Maybe, Quiet, check_asked
from filterlab.cli.pictures import Filmed
from filterlab.cli.scenes import scene_asked_for


@dataclass(frozen=True)
class Render:
    """Make a picture of a volume, a signal, a surface or a terrain, as a scene file describes it; or of a file alone.

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
    """The scene, or a volume; or a SLIM surface, quadrics or heights."""
    output: Annotated[Maybe[Path], arg(aliases=["-o"], metavar="FILE")] = None
    """The picture to write: a name that ends in .png or .jpg (quality 95); a file of that name is replaced. With
    --turntable .gif, .png (animated), or a folder for numbered .png files, which must be new or empty."""
    turntable: Annotated[Maybe[int], arg(aliases=["--frames"], metavar="N")] = None
    """Make N pictures, a whole turn of the camera about what is up, through its target; or along a --path."""
    path: Annotated[Maybe[Path], arg(metavar="FLIGHT.yaml")] = None
    """Of a terrain, the points of a flight: x, y as in its file, and metres above the ground (docs/terrain.md)."""
    explain: bool = False
    """Show what the picture would take, and what the scene leaves out; no picture is made."""
    quiet: Quiet = False
    """Say nothing of what was written, and show no progress."""

    def run(self, overrides: dict[str, str]) -> None:
        check_asked(self.output, self.explain, ".png")
        filmed = Filmed(self.turntable, self.path)
        output = None if self.output is None else filmed.output(self.output, self.scene, quiet=self.quiet)
        scene, volume = scene_asked_for(self.scene, overrides, self.output)
        filmed.make(scene, volume, output, self.quiet)
