"""The command `filterlab scene`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from filterlab.cli.options import Maybe
from filterlab.cli.outcome import UsageError
from filterlab.cli.scenes import scene_asked_for


@dataclass(frozen=True)
class Scene:
    """Tell what scene files may say; or show one with everything that it leaves out, or that of a volume or of heights.

    Values of a scene can be changed as for `filterlab render`, after its name.

    examples:
      filterlab scene --reference
      filterlab scene engine.yaml --method notch
      filterlab scene engine.nrrd > engine.yaml
      filterlab scene dem.tif --terrain.sun 300 15 > dem.yaml
    """

    scene: Annotated[Positional[Maybe[Path]], arg(metavar="SCENE.yaml | VOLUME")] = None
    """The scene that is shown, or a volume: then the scene that shows it."""
    reference: bool = False
    """Print the reference of scene files instead: every key, what it may be, its unit, its default (Markdown)."""

    def run(self, overrides: dict[str, str]) -> None:
        if self.reference == (self.scene is not None):
            raise UsageError("expected either a scene or --reference; got " + ("both" if self.reference else "neither"))
        if self.scene is None:
            from filterlab.scenes.reference import reference

            print(reference(), end="")
            return
        from filterlab.io.config import dump_config

        print(dump_config(scene_asked_for(self.scene, overrides, None)[0]), end="")
