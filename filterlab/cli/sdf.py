"""The command `filterlab sdf`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from filterlab.cli.imports import importing
from filterlab.cli.memory import check_memory, limit_in_bytes
from filterlab.cli.options import Maybe, Output, Quiet, Triple, check_name
from filterlab.cli.outcome import UsageError
from filterlab.cli.saving import OutputFile
from filterlab.cli.terminal import progress_bar, tell

if TYPE_CHECKING:
    from filterlab.signed_distances import Grid, Triangles


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
    """The volume to write; a file of that name is replaced."""
    size: Annotated[Maybe[int], arg(metavar="N")] = None
    """Voxels along the longest side; default 128."""
    shape: Annotated[Maybe[tuple[int, int, int]], arg(metavar="NX NY NZ")] = None
    """Instead of it: number of voxels along x, y, z, each side divided on its own."""
    spacing: Annotated[Maybe[Triple], arg(metavar="SX SY SZ")] = None
    """Instead of it: size of a voxel along x, y, z, in the mesh's own units."""
    margin: float = 3.0
    """Voxels that are kept free around the mesh, on every side."""
    dtype: str = "float32"
    """Type of the result: float32 or float64."""
    nifti2: bool = False
    """Write NIfTI-2, which fewer tools open; NIfTI-1 rounds numbers of the affine, by 6e-8 of themselves at most."""
    max_gigabytes: float = 8.0
    """The most memory that the volume may take."""
    quiet: Quiet = False
    """Say nothing of what was written, and show no progress."""

    def run(self, overrides: dict[str, str]) -> None:
        asked = [given is not None for given in (self.size, self.shape, self.spacing)]
        if sum(asked) > 1:
            raise UsageError("expected one of --size, --shape and --spacing; got several")
        check_name("dtype", self.dtype, ("float32", "float64"))
        output = OutputFile.at(self.output, self.input, quiet=self.quiet)

        with importing():
            import torch

            from filterlab.io.meshes import load_mesh
            from filterlab.io.volumes import check_saveable
            from filterlab.signed_distances import libigl, signed_distance

        check_saveable(self.output, nifti2=self.nifti2)
        libigl()
        limit, dtype = limit_in_bytes(self.max_gigabytes), getattr(torch, self.dtype)
        triangles = load_mesh(self.input)
        grid = self._grid(triangles)
        check_memory(grid.size, dtype.itemsize, limit)
        self._tell_open(triangles)
        with progress_bar(self.quiet) as progress:
            volume = signed_distance(triangles, grid, dtype=dtype, progress=lambda done: progress(done, "measuring"))
            output.save(volume, progress, nifti2=self.nifti2)
        output.tell_volume(volume)

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
            tell(
                f"{self.input} is not closed: around {count} edges there are holes, or triangles turned "
                "round; inside is where its winding number is above ½"
            )
