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

SOURCE = r"""
extern "C" __global__ void triquadratic(cudaTextureObject_t volume, const float* points, float* rows, int count) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= count) return;
    float at[3][2], weight[3][2];
    for (int axis = 0; axis < 3; axis++) {
        float x = points[3 * i + axis];
        float beta = x - floorf(x + 0.5f);
        at[axis][0] = x - (0.25f + 0.5f * beta) + 0.5f;  // texture coordinates: voxel centres are at halves
        at[axis][1] = x + (0.25f - 0.5f * beta) + 0.5f;
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
    rows[i] = value;
    rows[count + i] = dx;
    rows[2 * count + i] = dy;
    rows[3 * count + i] = dz;
}
"""


def missing() -> str | None:
    return without("cupy", "cupy-cuda12x")


def triquadratic(coefficients: Tensor, points: Tensor) -> Callable[[], Tensor]:
    """A call that gives the rows (4, M) of value and gradient.

    Args:
        coefficients: (D, H, W) float32 on the GPU; copied into a texture now.
        points: (M, 3) float32 on the GPU.
    """
    import cupy

    texture = _texture(cupy, coefficients)
    kernel = cupy.RawKernel(SOURCE, "triquadratic")
    where, count = cupy.from_dlpack(points.contiguous()), len(points)

    def call() -> Tensor:
        rows = torch.empty(4, count, device=points.device)
        stream = cupy.cuda.ExternalStream(torch.cuda.current_stream().cuda_stream)
        with stream:
            kernel((-(-count // THREADS),), (THREADS,), (texture, where, cupy.from_dlpack(rows), cupy.int32(count)))
        return rows

    return call


def _texture(cupy: Any, coefficients: Tensor) -> Any:
    """A 3-D texture with linear filtering, clamped at its faces."""
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
