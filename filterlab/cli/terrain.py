"""The command `filterlab terrain`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from filterlab.cli.loading import Progress, reading
from filterlab.cli.options import Maybe, Quiet, check_asked, check_name
from filterlab.cli.outcome import UsageError
from filterlab.cli.saving import OutputFile
from filterlab.cli.terminal import progress_bar, show
from filterlab.names import SPLINES

if TYPE_CHECKING:
    from torch import Tensor

    from filterlab.io.heights_header import HeightsHeader
    from filterlab.render.camera import Camera
    from filterlab.scenes.flight import Flight
    from filterlab.scenes.terrain import Terrain as Prepared
    from filterlab.scenes.terrain import TerrainScene

Two = tuple[float, float]
_SECONDS = 0.04  # for which each picture of a flight is shown


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
    """Of the ground: matt; reflection_lines or mirror, which show how smooth it is."""
    sky: Annotated[Maybe[Path], arg(metavar="PICTURE")] = None
    """What is around: an equirectangular picture; default a clear sky."""
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
    frames: Annotated[Maybe[int], arg(metavar="N")] = None
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
    quiet: Quiet = False
    """Say nothing of what was written, and show no progress."""

    def run(self, overrides: dict[str, str]) -> None:
        check_asked(self.output, self.explain, ".png")
        if self.path is not None and self.frames is None:
            raise UsageError("expected --frames N with --path: how many pictures the flight has")
        if self.frames is not None and self.frames < 2:
            raise UsageError(f"expected --frames of at least 2 pictures; got {self.frames}")
        check_name("spline", self.spline, SPLINES)
        output = None if self.output is None else self._output(self.output)

        from filterlab.io.heights import MAX_BYTES, describe_heights

        header = describe_heights(self.file, band=self.band)
        scene, flight = self._scene(), self._flight()
        with progress_bar(self.quiet) as progress:
            prepared = _prepared(scene, header, MAX_BYTES, progress)
            if output is not None:
                pictures = _Pictures(prepared, self._cameras(prepared, flight), self.legend, progress)
                self._write(pictures, output.path)
        if output is None:
            show(_explained(prepared, header, self.frames or 1))
        else:
            output.tell(pictures.told)  # pyright: ignore[reportPossiblyUnboundVariable]

    def _output(self, output: Path) -> OutputFile:
        from filterlab.io.picture_formats import ANIMATIONS, PICTURES, format_of

        sources = (self.file, self.drape, self.sky, self.path)
        if self.frames is not None and not output.suffix:
            return OutputFile.folder(output, *sources, quiet=self.quiet)
        format_of(output, PICTURES if self.frames is None else ANIMATIONS)
        return OutputFile.at(output, *sources, quiet=self.quiet)

    def _scene(self) -> TerrainScene:
        from filterlab.scenes.terrain import TerrainScene, scene_of

        asked = {name: getattr(self, name) for name in TerrainScene.model_fields if hasattr(self, name)}
        return scene_of(asked)

    def _flight(self) -> Flight | None:
        if self.path is None:
            return None
        from filterlab.scenes.flight import load_flight

        return load_flight(self.path)

    def _cameras(self, prepared: Prepared, flight: Flight | None) -> list[Camera]:
        if self.frames is None:
            return [prepared.camera]
        return prepared.around(self.frames) if flight is None else flight.cameras(prepared, self.frames)

    def _write(self, pictures: _Pictures, output: Path) -> None:
        from filterlab.cli.pictures import write_pictures

        write_pictures(pictures, output, moving=self.frames is not None, seconds=_SECONDS)


def _prepared(scene: TerrainScene, header: HeightsHeader, max_bytes: int, progress: Progress) -> Prepared:
    from filterlab.scenes.terrain import Terrain

    with reading(progress):
        heights = header.read(max_bytes)
    return Terrain.of(scene, heights)


@dataclass
class _Pictures:
    """The pictures of all cameras, one after the other; progress is told of.

    Attributes:
        told: what was made, when it is.
    """

    prepared: Prepared
    cameras: list[Camera]
    legend: bool
    progress: Progress
    told: str = ""

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[Tensor]:
        count = len(self.cameras)
        for k, camera in enumerate(self.cameras):
            what = "rendering" if count == 1 else f"rendering {k + 1} of {count}"
            image = self._with_legend(self.prepared.render(self._part(k, what), camera))
            many = "" if count == 1 else f"{count} pictures of "
            high = f"{self.prepared.exaggeration:g} times as high as it is"
            self.told = f"{many}{image.shape[1]} × {image.shape[0]} pixels, 8-bit RGB, {high}"
            yield image

    def _with_legend(self, image: Tensor) -> Tensor:
        legend = self.prepared.legend if self.legend else None
        return image if legend is None else legend.beside(image, (1.0, 1.0, 1.0))

    def _part(self, k: int, what: str) -> Callable[[int, int], None]:
        return lambda done, total: self.progress((k + done / max(total, 1)) / len(self.cameras), what)


def _explained(prepared: Prepared, header: HeightsHeader, pictures: int) -> object:
    """A table of what a picture takes, and of what was not asked for."""
    from rich.table import Table
    from rich.text import Text

    scene, heights = prepared.scene, prepared.heights
    (dx, dy), (width, height) = heights.spacing, scene.size
    left, bottom, right, top = heights.extent
    low, high = prepared.span
    missing = int(heights.missing.sum())
    rays = width * height * scene.subpixels**2
    columns, rows = prepared.surface.cells
    lines = [
        ("heights", f"{heights.size[0]} × {heights.size[1]}, {header.nbytes / 2**20:.4g} MiB, {heights.samples.dtype}"),
        ("missing", f"{missing}, {'made from those around' if scene.fill else 'holes'}" if missing else "none"),
        ("spacing", f"{abs(dx):.6g} × {abs(dy):.6g} m"),
        ("extent", f"{(right - left) / 1000:.4g} × {(top - bottom) / 1000:.4g} km"),
        ("height", f"{low:.6g} … {high:.6g}, but for ½ % at either end"),
        ("spline", f"{scene.spline}, {columns} × {rows} cells of two quartics"),
        ("exaggeration", f"{prepared.exaggeration:g}" + ("" if scene.exaggeration else ", as the relief suggests")),
        ("camera", f"looks to {scene.view[0]:g}° from north, {scene.view[1]:g}° down"),
        ("sun", f"{scene.sun[0]:g}° from north, {scene.sun[1]:g}° high" + (", casts shadows" if scene.shadows else "")),
        ("picture", f"{width} × {height} pixels, {scene.subpixels**2} rays each: {rays / 1e6:.3g} million"),
        *([("pictures", str(pictures))] if pictures > 1 else []),
    ]
    table = Table(show_header=False, box=None)
    for name, value in lines:
        table.add_row(name, Text(value))
    return table
