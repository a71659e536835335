"""The marcher as a loop in Dr.Jit (LLVM backend) around Texture3f.eval_cubic_grad: one compiled kernel per image.

The same segments, table, headlight and compositing as `filterlab.render`, rays side by side in the lanes.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.harness import Contestant
from benchmarks.peers.drjit_texture import missing, positions, started, texture_of
from benchmarks.scene import LIGHTING, Scene, entering_rays
from filterlab.ops.differentiable.prefilter import prefilter_samples

__all__ = ["NAME", "marching", "missing"]

NAME = "Dr.Jit loop"


def marching(scene: Scene) -> Contestant:
    drjit = started(scene.threads)
    march = _marcher(scene)

    def call() -> Any:
        image = march()
        drjit.eval(image)
        drjit.sync_thread()
        return image

    return Contestant(
        NAME,
        call,
        "tricubic image",
        lambda image: (np.array(image).T.reshape(scene.size, scene.size, 4),),
        scene.size**2,
    )


def _marcher(scene: Scene) -> Any:
    """A function that renders; everything it reads has been handed to Dr.Jit."""
    import drjit as dr
    from drjit.llvm import Array3f, Array4f, Float, TensorXf, Texture1f

    n, step = scene.volume.shape[-1], scene.step
    volume = texture_of(prefilter_samples(scene.volume, "cubic", "reflect"))
    rows = len(scene.table)
    table = Texture1f(TensorXf(np.ascontiguousarray(scene.table.numpy())), wrap_mode=dr.WrapMode.Clamp)
    entry, direction, length = entering_rays(scene)
    start, ray, end = positions((entry + 0.5) / n), positions(direction), Float(length.float().numpy())
    dr.eval(end)
    rays = len(length)

    def segment(t: Any, thickness: Any) -> tuple[Any, Any]:
        """Colour (Array3f) and optical depth of a homogeneous segment."""
        (value,), (gradient,) = volume.eval_cubic_grad(dr.fma(ray, t / n, start))
        red, green, blue, opacity = table.eval((value * (rows - 1) + 0.5) / rows)
        color: Any = Array3f(red, green, blue)
        if scene.lit:
            squared = dr.squared_norm(gradient)
            facing: Any = dr.select(squared > 0, dr.abs(dr.dot(gradient, ray)) * dr.rsqrt(squared), 0)
            shine: Any = dr.power(facing, int(LIGHTING.shininess))
            color = color * (LIGHTING.ambient + LIGHTING.diffuse * facing) + LIGHTING.specular * shine
        return color, -dr.log(1 - opacity) * thickness

    def body(light: Any, transmittance: Any, t: Any) -> tuple[Any, Any, Any]:
        after = dr.select(t + step < end, t + step, end)  # LLVM before 16 has no vector code for dr.minimum
        color, depth = segment(0.5 * (t + after), after - t)
        passing = transmittance * dr.exp(-depth)
        return dr.fma(transmittance - passing, color, light), passing, t + step

    def march() -> Any:
        light, transmittance, _ = dr.while_loop(
            (dr.zeros(Array3f, rays), dr.ones(Float, rays), dr.zeros(Float, rays)),
            lambda _light, _passing, t: t < end,
            body,
        )
        return Array4f(light.x, light.y, light.z, 1 - transmittance)

    return march
