"""The command `filterlab slim`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from filterlab.cli.imports import importing
from filterlab.cli.options import Output, Quiet, check_name
from filterlab.cli.saving import OutputFile
from filterlab.cli.terminal import progress_bar, tell

if TYPE_CHECKING:
    from filterlab.surfaces import Fit


@dataclass(frozen=True)
class Slim:
    """Make a smooth surface from scanned points: balls with quadrics in them, blended where they overlap.

    Balls are as large as the tolerance lets them be, and hold 12 points at least; more where noise is to be smoothed.
    Normals that are in the file, or those of its triangles, say where outside is; else they are found. Files: .ply,
    .obj, .stl (pip install 'filterlab[mesh]') and tables of x y z or x y z nx ny nz (.xyz, .pts, .asc, .txt, .csv) are
    read; .npz is written, which render and info take.

    examples:
      filterlab slim bunny.ply -o bunny.npz
      filterlab slim scan.xyz -o scan.npz --tolerance 5e-4 --least 40
      filterlab render bunny.npz -o bunny.png --camera.up 0 1 0
      filterlab info bunny.npz
    """

    input: Annotated[Positional[Path], arg(metavar="POINTS")]
    """The points, or a triangle mesh of whose vertices they are."""
    output: Output
    """The surface to write, a name that ends in .npz; a file of that name is replaced."""
    tolerance: float = 1e-4
    """Root mean square of distances of points from their ball's quadric, in parts of the diagonal of the box."""
    least: Annotated[int, arg(metavar="N")] = 12
    """Points in a ball, at least."""
    normals: str = "given"
    """given: those of the file or of its triangles, if there are; found: from the points alone."""
    seed: int = 0
    """Of the order in which places are tried."""
    quiet: Quiet = False
    """Say nothing of what was written, and show no progress."""

    def run(self, overrides: dict[str, str]) -> None:
        from filterlab.io.covers import check_slim_file, save_slim

        check_name("normals", self.normals, ("given", "found"))
        check_slim_file(self.output)
        output = OutputFile.at(self.output, self.input, quiet=self.quiet)

        with importing():
            from filterlab.io.points import load_points
            from filterlab.surfaces import fit_slim
            from filterlab.surfaces.fitting import check_settings

        check_settings(self.tolerance, self.least)
        points, normals = load_points(self.input)
        with progress_bar(self.quiet) as progress:
            slim = fit_slim(
                points,
                normals if self.normals == "given" else None,
                self.tolerance,
                least=self.least,
                seed=self.seed,
                progress=lambda done: progress(done, "fitting"),
            )
        save_slim(slim, output.path)
        assert slim.fit is not None
        self._tell(slim.fit)
        fit = slim.fit
        output.tell(f"{fit.balls} balls of {fit.points} points, rms {fit.rms:.3g}, worst {fit.worst:.3g}")

    def _tell(self, fit: Fit) -> None:
        """What a person may want to do something about."""
        if self.quiet:
            return
        for count, what in ((fit.duplicates, "at places of others"), (fit.strays, "far from all surfaces")):
            if count:
                tell(f"{self.input}: {count} points {what} are left out")
        if fit.smallest > fit.balls / 2:
            tell(
                f"{fit.smallest} of {fit.balls} balls hold the least points and miss the tolerance of"
                f" {fit.tolerance:.3g}: noise, or too few points; a larger --least smooths, a larger --tolerance saves"
            )
