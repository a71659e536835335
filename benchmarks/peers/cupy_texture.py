"""The eight-trilinear scheme of the paper on the texture units of an NVIDIA GPU, as one CUDA kernel (CuPy).

With β = x − ⌊x + ½⌋ per axis: samples at x − ¼ − β/2 and x + ¼ − β/2, weighted by ½ − β and ½ + β for the value, by −2
and 2 for the derivative along that axis (eqs. 7, 24, 25). A texture unit rounds the fractions of its samples to 1/256,
which is why its numbers are not compared with exact ones.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from benchmarks.peers.task import without

NAME = "eight trilinear, texture units"
THREADS = 128  # of a block

LIBRARY = r"""
__device__ float4 jet(cudaTextureObject_t volume, float x, float y, float z) {  // value and gradient
    float at[3][2], weight[3][2], point[3] = {x, y, z};
    for (int axis = 0; axis < 3; axis++) {
        float beta = point[axis] - floorf(point[axis] + 0.5f);
        at[axis][0] = point[axis] - (0.25f + 0.5f * beta) + 0.5f;  // texture coordinates: voxel centres are at halves
        at[axis][1] = point[axis] + (0.25f - 0.5f * beta) + 0.5f;
        weight[axis][0] = 0.5f - beta;
        weight[axis][1] = 0.5f + beta;
    }
    float value = 0, dx = 0, dy = 0, dz = 0;
    for (int k = 0; k < 2; k++) {
        float plane = 0, plane_dx = 0, plane_dy = 0;
        for (int j = 0; j < 2; j++) {
            float low = tex3D<float>(volume, at[0][0], at[1][j], at[2][k]);
            float high = tex3D<float>(volume, at[0][1], at[1][j], at[2][k]);
            float line = weight[0][0] * low + weight[0][1] * high;
            plane += weight[1][j] * line;
            plane_dx += weight[1][j] * 2 * (high - low);
            plane_dy += (j ? 2 : -2) * line;
        }
        value += weight[2][k] * plane;
        dx += weight[2][k] * plane_dx;
        dy += weight[2][k] * plane_dy;
        dz += (k ? 2 : -2) * plane;
    }
    return make_float4(value, dx, dy, dz);
}
"""

_SOURCE = (
    LIBRARY
    + r"""
extern "C" __global__ void triquadratic(cudaTextureObject_t volume, const float* points, float* rows, int count) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= count) return;
    float4 found = jet(volume, points[3 * i], points[3 * i + 1], points[3 * i + 2]);
    rows[i] = found.x;
    rows[count + i] = found.y;
    rows[2 * count + i] = found.z;
    rows[3 * count + i] = found.w;
}
"""
)


def missing() -> str | None:
    return without("cupy", "cupy-cuda12x")


def triquadratic(coefficients: Tensor, points: Tensor) -> Callable[[], Tensor]:
    """A call that gives the rows (4, M) of value and gradient.

    Args:
        coefficients: (D, H, W) float32 on the GPU; copied into a texture now.
        points: (M, 3) float32 on the GPU.
    """
    import cupy

    texture = texture_of(coefficients)
    kernel = cupy.RawKernel(_SOURCE, "triquadratic")
    where, count = cupy.from_dlpack(points.contiguous()), len(points)

    def call() -> Tensor:
        rows = torch.empty(4, count, device=points.device)
        stream = cupy.cuda.ExternalStream(torch.cuda.current_stream().cuda_stream)
        with stream:
            kernel((-(-count // THREADS),), (THREADS,), (texture, where, cupy.from_dlpack(rows), cupy.int32(count)))
        return rows

    return call


def texture_of(coefficients: Tensor) -> Any:
    """A 3-D texture of (D, H, W) float32 with linear filtering, clamped at its faces."""
    import cupy

    runtime, texture = cupy.cuda.runtime, cupy.cuda.texture
    depth, height, width = coefficients.shape
    channel = texture.ChannelFormatDescriptor(32, 0, 0, 0, runtime.cudaChannelFormatKindFloat)
    array = texture.CUDAarray(channel, width, height, depth)
    array.copy_from(cupy.ascontiguousarray(cupy.from_dlpack(coefficients.contiguous())))
    return texture.TextureObject(
        texture.ResourceDescriptor(runtime.cudaResourceTypeArray, cuArr=array),
        texture.TextureDescriptor(
            (runtime.cudaAddressModeClamp,) * 3, runtime.cudaFilterModeLinear, runtime.cudaReadModeElementType
        ),
    )
