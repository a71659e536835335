"""The command `filterlab mesh`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from filterlab.cli.imports import importing
from filterlab.cli.loading import reading
from filterlab.cli.options import Maybe, Quiet, check_asked, check_name
from filterlab.cli.saving import OutputFile
from filterlab.cli.scenes import scene_asked_for
from filterlab.cli.terminal import progress_bar, show, tell


@dataclass(frozen=True)
class Mesh:
    """Make triangles of the surface at a level in a volume, with vertices exactly on it.

    What is meshed is said as for `filterlab render`: a volume file and --level, or a scene with a surface; any value of
    the scene can be changed, like --method. Files: .ply, .obj and .stl (pip install 'filterlab[mesh]').

    examples:
      filterlab mesh engine.nrrd --level 90 -o engine.ply
      filterlab mesh engine.nrrd --level 90 -o fine.stl --step 0.5 --method notch
      filterlab mesh surface.yaml -o surface.obj
      filterlab mesh engine.nrrd --level 90 --explain
    """

    scene: Annotated[Positional[Path], arg(metavar="VOLUME | SCENE.yaml")]
    """The volume, with --level; or a scene with a surface."""
    output: Annotated[Maybe[Path], arg(aliases=["-o"], metavar="FILE")] = None
    """The mesh to write: a name that ends in .ply, .obj or .stl; a file of that name is replaced."""
    step: float = 1.0
    """Between the points of the grid that triangles are made on, in voxels."""
    outside: str = "lower"
    """Where normals point to: lower values (air in CT), or greater ones."""
    explain: bool = False
    """Show what the mesh would take; no mesh is made."""
    quiet: Quiet = False
    """Say nothing of what was written, and show no progress."""

    def run(self, overrides: dict[str, str]) -> None:
        from filterlab.io.meshes import check_mesh_file, save_mesh

        check_asked(self.output, self.explain, ".ply")
        output = None
        if self.output is not None:
            check_mesh_file(self.output)
            output = OutputFile.at(self.output, self.scene, quiet=self.quiet)
        check_name("outside", self.outside, ("lower", "greater"))
        if not 0 < self.step < math.inf:  # a NaN fails too
            raise ValueError(f"expected --step to be a positive number of voxels; got {self.step:g}")

        with importing():
            from filterlab.scenes.build import PreparedSurface, build
            from filterlab.scenes.plan import plan_of_mesh
            from filterlab.scenes.plan_report import table
            from filterlab.surfaces.meshes import mesh

        scene, _ = scene_asked_for(self.scene, overrides, self.output, of_surface=True)
        with progress_bar(self.quiet) as progress, reading(progress):
            prepared = build(scene)
        assert isinstance(prepared, PreparedSurface)
        if output is None:
            show(table(plan_of_mesh(prepared, self.step)))
            return
        with progress_bar(self.quiet) as progress:
            made = mesh(
                prepared.surface,
                self.step,
                outside=self.outside,  # type: ignore[arg-type]
                progress=lambda done: progress(done, "meshing"),
            )
        if not len(made.faces):
            tell(f"no triangles: nothing crosses level {float(prepared.surface.level):g}")
        save_mesh(made, output.path)
        output.tell(f"{len(made.faces)} triangles, {len(made.vertices)} vertices")
