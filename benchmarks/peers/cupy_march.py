"""The eight-trilinear scheme of the paper within a ray marcher, as one CUDA kernel around the texture units (CuPy).

The same segments, table, headlight and compositing as `filterlab.render`, one ray per thread, tiles of 8×4 rays per
warp. The table is read exactly; samples of the volume have the texture units' fractions of 8 bits. Nothing is skipped
and no ray ends early, as in a scene that has neither empty space nor opaque parts.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.harness import Contestant
from benchmarks.peers.cupy_texture import LIBRARY, missing, texture_of
from benchmarks.scene import LIGHTING, Scene, entering_rays
from filterlab.ops.differentiable.prefilter import prefilter_samples

__all__ = ["NAME", "marching_on_gpu", "missing"]

NAME = "texture-unit marcher"
_WARP = (8, 4)  # rays
_BLOCK = (8, 16)

_SOURCE = (
    LIBRARY
    + r"""
extern "C" __global__ void march(
    cudaTextureObject_t volume, const float* entry, const float* direction, const float* length, const float4* table,
    int rows, int width, int height, float step, int lit, float ambient, float diffuse, float specular, float shininess,
    float4* image
) {
    int px = blockIdx.x * blockDim.x + threadIdx.x, py = blockIdx.y * blockDim.y + threadIdx.y;
    if (px >= width || py >= height) return;
    int ray = py * width + px;
    const float *e = entry + 3 * ray, *d = direction + 3 * ray;
    float end = length[ray], passing = 1, red = 0, green = 0, blue = 0;
    for (int i = 0; i * step < end; i++) {
        float t = i * step, after = fminf(t + step, end), middle = 0.5f * (t + after);
        float4 s = jet(volume, e[0] + middle * d[0], e[1] + middle * d[1], e[2] + middle * d[2]);
        float row = fminf(fmaxf(s.x, 0.0f), 1.0f) * (rows - 1);
        int low = min((int)row, rows - 2);
        float w = row - low;
        float4 a = table[low], b = table[low + 1];
        float alpha = a.w + w * (b.w - a.w), matt = 1, shine = 0;
        if (lit) {
            float squared = s.y * s.y + s.z * s.z + s.w * s.w;
            float facing = squared > 0 ? fabsf(s.y * d[0] + s.z * d[1] + s.w * d[2]) * rsqrtf(squared) : 0;
            matt = ambient + diffuse * facing;
            shine = specular * powf(facing, shininess);
        }
        float left = passing * expf(log1pf(-alpha) * (after - t)), weight = passing - left;
        red += weight * ((a.x + w * (b.x - a.x)) * matt + shine);
        green += weight * ((a.y + w * (b.y - a.y)) * matt + shine);
        blue += weight * ((a.z + w * (b.z - a.z)) * matt + shine);
        passing = left;
    }
    image[ray] = make_float4(red, green, blue, 1 - passing);
}
"""
)


def marching_on_gpu(scene: Scene) -> Contestant:
    """Of a scene whose volume is on the GPU; a call ends when the GPU has."""
    import cupy

    device = scene.volume.device
    texture = texture_of(prefilter_samples(scene.volume, "quadratic", "reflect"))
    kernel = cupy.RawKernel(_SOURCE, "march")
    tensors = [x.to(device, torch.float32).contiguous() for x in (*entering_rays(scene), scene.table)]
    arrays = [cupy.from_dlpack(x) for x in tensors]
    size, numbers = scene.size, (LIGHTING.ambient, LIGHTING.diffuse, LIGHTING.specular, LIGHTING.shininess)
    grid = tuple(-(-size // edge) for edge in _BLOCK)

    def call() -> tuple[Tensor]:
        image = torch.empty(size, size, 4, device=device)
        whole = (cupy.int32(x) for x in (len(scene.table), size, size))
        real = (cupy.float32(x) for x in numbers)
        with cupy.cuda.ExternalStream(torch.cuda.current_stream().cuda_stream):
            kernel(
                grid,
                _BLOCK,
                (
                    texture,
                    *arrays,
                    *whole,
                    cupy.float32(scene.step),
                    cupy.int32(scene.lit),
                    *real,
                    cupy.from_dlpack(image),
                ),
            )
        torch.cuda.synchronize()
        return (image,)

    return Contestant(NAME, call, "triquadratic image", samples=size**2)
