"""Mitsuba 3's shape `sdfgrid` (LLVM backend): rays and the level set of a trilinear interpolant, with its normals."""

# pyright: reportMissingImports=false

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from benchmarks.harness import Contestant
from benchmarks.peers import drjit_texture
from benchmarks.peers.task import Casting, without

NAME = "Mitsuba sdfgrid"

_LEAST_LLVM = 19  # with 15 and 16 LLVM itself ends the process: it cannot select an instruction; 17, 18 were not tried


@cache
def missing() -> str | None:
    if why := without("mitsuba") or drjit_texture.missing():
        return why
    version = drjit_texture.llvm_version()
    if int(version.split(".")[0]) < _LEAST_LLVM:
        return f"LLVM {version} fails at it; set DRJIT_LIBLLVM_PATH to one from {_LEAST_LLVM} on"
    return None


def casting(task: Casting) -> Contestant:
    import mitsuba

    drjit = drjit_texture.started(task.threads)
    mitsuba.set_variant("llvm_ad_rgb")
    scene = mitsuba.load_dict({"type": "scene", "surface": _shape(mitsuba, task)})
    columns = (np.ascontiguousarray(x.T) for x in task.flat())
    origins, directions = (kind(x) for kind, x in zip((mitsuba.Point3f, mitsuba.Vector3f), columns, strict=True))
    drjit.eval(origins, directions)

    def call() -> Any:
        found = scene.ray_intersect(mitsuba.Ray3f(origins, directions))
        drjit.eval(found.t, found.n)
        drjit.sync_thread()
        return found

    return Contestant(NAME, call, task.computes, lambda found: task.summary(np.array(found.t)), task.rays)


def _shape(mitsuba: Any, task: Casting) -> dict[str, Any]:
    """The samples lie at the corners of the cells of a unit cube."""
    size = task.volume.shape[-1] - 1
    grid = np.ascontiguousarray((task.level - task.volume).numpy()[..., None])
    return {
        "type": "sdfgrid",
        "grid": mitsuba.TensorXf(grid),
        "normals": "analytic",
        "to_world": mitsuba.ScalarTransform4f().scale(size),
    }
