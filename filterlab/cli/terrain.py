"""The command `filterlab terrain`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from filterlab.cli.imports import importing
from filterlab.cli.options import Maybe, Quiet, check_asked, check_name
from filterlab.cli.outcome import UsageError
from filterlab.cli.pictures import Filmed
from filterlab.cli.saving import OutputFile
from filterlab.names import SPLINES

if TYPE_CHECKING:
    from filterlab.io.config import Problem
    from filterlab.scenes.model import Scene

Two = tuple[float, float]
_KEYS = {"view": "camera.compass", "size": "size", "legend": "legend", "seed": "jitter"}
"""Options that are keys of the scene itself; all others are keys of its terrain, of the same names."""
_OPTIONS = (
    *("spline", "exaggeration", "sun", "view", "color", "range", "drape", "material", "sky", "water", "haze", "size"),
    *("subpixels", "shadows", "block", "fill", "legend", "band", "unit", "seed"),
)
_MATERIALS: dict[str, Any] = {
    "reflection_lines": {"kind": "reflection_lines", "axis": [1.0, 0.0, 0.0], "count": 12.0},
    "mirror": {"kind": "environment", "reflectivity": 0.5},
}
"""What suits ground, where a scene may say more."""


@dataclass(frozen=True)
class Terrain:
    """Make a picture of heights, an elevation model in a file: lit by the sun, coloured by height, as a smooth spline.

    A file alone is enough. Files: GeoTIFF, .asc, .hgt (pip install 'filterlab[terrain]'), .npy, .npz, PNG of 16 bits.
    Heights that are missing are holes. Degrees become metres about the middle of the map.

    examples:
      filterlab terrain dem.tif -o view.png
      filterlab terrain dem.tif -o view.png --exaggeration 2 --sun 300 15 --water 420 --legend
      filterlab terrain dem.tif -o map.png --color slope --view 0 89
      filterlab terrain dem.tif -o photo.jpg --drape orthophoto.tif --haze 40000
      filterlab terrain dem.tif -o smooth.png --material reflection_lines --spline c2
      filterlab terrain dem.tif -o turn.gif --frames 60
      filterlab terrain dem.tif -o flight.gif --frames 120 --path flight.yaml
      filterlab terrain dem.tif --water 420 --write-scene lake.yaml
    """

    file: Annotated[Positional[Path], arg(metavar="HEIGHTS")]
    """The heights."""
    output: Annotated[Maybe[Path], arg(aliases=["-o"], metavar="FILE")] = None
    """The picture to write: a name that ends in .png or .jpg; a file of that name is replaced. With --frames .gif, .png
    (animated), or a folder for numbered .png files, which must be new or empty."""
    spline: str = "c1"
    """How heights become a surface: linear, c0, c1 or c2 (smoother, and farther from the heights)."""
    exaggeration: Annotated[Maybe[float], arg(metavar="E")] = None
    """How many times as high as it is the ground stands; default as its relief suggests, 1 for mountains."""
    sun: Annotated[Two, arg(metavar="AZIMUTH ALTITUDE")] = (315.0, 38.0)
    """Where the sun stands: degrees from north, clockwise, and above the horizon."""
    view: Annotated[Two, arg(metavar="AZIMUTH DOWN")] = (20.0, 33.0)
    """Where the camera looks: degrees from north, clockwise, and down."""
    color: str = "hypsometric"
    """A colormap, by height (hypsometric, terrain, viridis, …); slope, aspect, normal, hillshade; or one colour."""
    range: Annotated[Maybe[Two], arg(metavar="LOW HIGH")] = None
    """Heights (slopes, azimuths) at both ends of the colours; default those that there are."""
    drape: Annotated[Maybe[Path], arg(metavar="PICTURE")] = None
    """A picture instead of colours: PNG or JPEG that covers the map, or a GeoTIFF with its own place."""
    material: str = "matt"
    """Of the ground: matt, phong or toon; reflection_lines or mirror, which show how smooth it is."""
    sky: Annotated[Maybe[Path], arg(metavar="PICTURE")] = None
    """What is around: an equirectangular picture; default a clear sky, with the sun in it."""
    water: Annotated[Maybe[float], arg(metavar="LEVEL")] = None
    """The level of still water, in the unit of the heights."""
    haze: Annotated[Maybe[float], arg(metavar="METRES")] = None
    """How far one sees: at that distance 1/e of a colour is left."""
    size: Annotated[tuple[int, int], arg(metavar="WIDTH HEIGHT")] = (960, 600)
    """Of the picture in pixels."""
    subpixels: Annotated[int, arg(metavar="S")] = 2
    """S × S rays for each pixel."""
    shadows: bool = True
    """Whether mountains cast them."""
    block: bool = True
    """Whether there are walls of earth where the ground ends."""
    fill: bool = False
    """Make heights that are missing from those around."""
    legend: bool = False
    """Add the colours and their values to the picture."""
    frames: Annotated[Maybe[int], arg(aliases=["--turntable"], metavar="N")] = None
    """Make N pictures: a whole turn of the camera; or along a --path."""
    path: Annotated[Maybe[Path], arg(metavar="FLIGHT.yaml")] = None
    """The points of a flight: x, y as in the file of heights, and metres above the ground (docs/terrain.md)."""
    band: Annotated[Maybe[int], arg(metavar="B")] = None
    """Which of several bands of a GeoTIFF, from 1."""
    unit: Annotated[Maybe[str], arg(metavar="NAME")] = None
    """Of x and y, where the file declares none: metre, degree, foot, …"""
    seed: int = 0
    """Of the places of rays within pixels."""
    explain: bool = False
    """Show what the picture would take; no picture is made."""
    write_scene: Annotated[Maybe[Path], arg(metavar="SCENE.yaml")] = None
    """Write the scene that these options stand for instead of its picture, which filterlab render SCENE.yaml makes."""
    quiet: Quiet = False
    """Say nothing of what was written, and show no progress."""

    def run(self, overrides: dict[str, str]) -> None:
        if self.write_scene is None:
            check_asked(self.output, self.explain, ".png")
        elif self.output is not None or self.explain:
            raise UsageError("expected --write-scene without -o and --explain: the scene makes the same picture")
        elif self.write_scene.suffix.lower() not in (".yaml", ".yml"):
            raise UsageError(f"expected a name that ends in .yaml for a scene; got {self.write_scene}")
        filmed = Filmed(self.frames, self.path)
        check_name("spline", self.spline, SPLINES)
        sources = (self.file, self.drape, self.sky)
        if self.write_scene is not None:
            self._write_scene(self.write_scene, OutputFile.at(self.write_scene, *sources, quiet=self.quiet))
            return
        output = None if self.output is None else filmed.output(self.output, *sources, quiet=self.quiet)
        filmed.make(self._scene(), None, output, self.quiet)

    def _write_scene(self, path: Path, output: OutputFile) -> None:
        from filterlab.io.atomic import atomic_write
        from filterlab.io.config import dump_config

        text = dump_config(self._scene(), brief=True)
        with atomic_write(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
        output.tell(f"the scene of {self.file}; filterlab render {path} makes the picture")

    def _scene(self) -> Scene:
        """The scene of these options. Raises ConfigError that tells of them by their names here."""
        import json

        from pydantic_core import to_jsonable_python

        with importing():
            from filterlab.io.config import ConfigError
            from filterlab.scenes.build import terrain_scene

        keys = {name: _KEYS.get(name, f"terrain.{name}") for name in _OPTIONS}
        given = {name: getattr(self, name) for name in _OPTIONS}
        given["material"] = _MATERIALS.get(self.material, self.material)
        given["legend"] = self.legend or None
        asked = {keys[name]: json.dumps(to_jsonable_python(v)) for name, v in given.items() if v is not None}
        try:
            return terrain_scene(self.file, asked)
        except ConfigError as error:
            raise ConfigError(_named(problem, keys) for problem in error.problems) from None


def _named(problem: Problem, keys: Mapping[str, str]) -> Problem:
    """The same, of the option that the key is set by."""
    for name, key in keys.items():
        if problem.place == f"--{key}":
            path = problem.path.removeprefix(key.rpartition(".")[0]).removeprefix(".")
            return replace(problem, place=f"--{name}", path=path if name not in _KEYS else "")
    return problem
