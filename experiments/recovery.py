"""Two inverse problems of volume rendering: the voxels, or the transfer function, that images were made with.

    views ─▶ rays ─▶ target colours        unknowns ─▶ field, transfer function ─▶ render ─▶ colours ─▶ misfit

Both minimise the mean squared difference of linear RGB over batches of rays (`experiments.descent`), through the
renderer, which is differentiable in either unknown.

Letters: n voxels along an axis, x the voxels, λ the weight of their smoothness; R rays of a batch; M control points,
v a value, α its opacity, c its colour.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor
from torch.nn.functional import conv1d, pad

import filterlab as fl
from experiments.config import Recipe, number
from experiments.descent import Parameters, Stage
from experiments.dvr_signal import displayed
from experiments.runs import Record
from experiments.views import MAX_SAMPLES
from filterlab import metrics
from filterlab.fields.base import Domain
from filterlab.geometry import Geometry
from filterlab.io.config import StrictModel
from filterlab.render.camera import Camera
from filterlab.render.dvr import render
from filterlab.render.image import RayTensors
from filterlab.render.transfer import TransferFunction
from filterlab.scenes import model as scene
from filterlab.signals import Signal

_POINTS = 20_000  # at which fields are compared with the signal
_INNER = 0.9  # the share of the box, along each axis, that these points lie in
_NARROWEST = 0.1  # the least gap between free control points, as a share of the mean one
_GOLDEN = math.pi * (1 + math.sqrt(5))  # radians between neighbours of a Fibonacci spiral


# --- the images -------------------------------------------------------------------------------------------------------


class Views(StrictModel):
    """The images: square, from directions that are spread evenly over the sphere, the whole box in view.

    Attributes:
        training, held_out: how many are matched, and how many are only looked at.
        size: pixels along an edge.
        step: in voxels of the volume.
        projection, field_of_view, lighting, background: as in a scene; without lighting no gradient is computed.
        shown: pixels along an edge of the images for the report, which are rendered anew.
        amplify: of the differences that the report shows.
    """

    training: Annotated[int, Field(ge=1, le=4096)] = 24
    held_out: Annotated[int, Field(ge=1, le=4096)] = 4
    size: Annotated[int, Field(ge=1, le=2048)] = 64
    step: Annotated[float, Field(ge=0.01)] = 1.0
    projection: Literal["perspective", "orthographic"] = "perspective"
    field_of_view: Annotated[float, Field(gt=0, lt=180)] = 30.0
    lighting: scene.Lighting | None = None
    background: scene.Color = (0.0, 0.0, 0.0)
    shown: Annotated[int, Field(ge=1, le=2048)] = 256
    amplify: Annotated[float, Field(gt=0)] = 8.0

    @property
    def pixels(self) -> int:
        """Of all training images."""
        return self.training * self.size**2

    def cameras(self, domain: Domain) -> tuple[list[Camera], list[Camera]]:
        """The training and the held-out cameras; the latter lie evenly among the former."""
        together = self.training + self.held_out
        apart = {int((k + 0.5) * together / self.held_out) for k in range(self.held_out)}
        cameras = [self._camera(domain, direction) for direction in directions(together)]
        return [c for i, c in enumerate(cameras) if i not in apart], [cameras[i] for i in sorted(apart)]

    def _camera(self, domain: Domain, direction: tuple[float, float, float]) -> Camera:
        up = (0.0, 1.0, 0.0) if abs(direction[2]) > 0.9 else (0.0, 0.0, 1.0)
        view = scene.CameraView(
            projection=self.projection, direction=direction, up=up, field_of_view=self.field_of_view
        )
        return view.build(domain, (self.size, self.size))


def directions(count: int) -> list[tuple[float, float, float]]:
    """Unit vectors spread evenly over the sphere: a Fibonacci spiral from pole to pole.

    Source: Vogel, A better way to construct the sunflower head, 1979, on the sphere.
    """
    listed = []
    for k in range(count):
        z = 1 - (2 * k + 1) / count
        radius, angle = math.sqrt(1 - z * z), _GOLDEN * (k + 0.5)
        listed.append((radius * math.cos(angle), radius * math.sin(angle), z))
    return listed


@dataclass(frozen=True)
class Bench:
    """What both problems share: the signal, its samples, all rays, and how images are computed.

    Attributes:
        signal: its voxel size is that of the samples, so that its images have the same step.
        samples: n³ of them.
        views: what the images are.
        recipe, boundary: how voxels become a field.
        images_of: what the target images are of: the `signal` itself, or its `samples`, by the recipe.
        training, held_out: origins and directions `(rays, 3)`, view after view.
        shown: the camera of one training and one held-out view.
        order: a permutation of the training rays; batches are taken along it, round and round.
        points: uniform random points `(P, 3)` of the inner box.
    """

    signal: Signal
    samples: fl.Volume
    views: Views
    recipe: Recipe
    boundary: str
    images_of: str
    training: RayTensors
    held_out: RayTensors
    shown: dict[str, Camera]
    order: Tensor
    points: Tensor

    @classmethod
    def of(
        cls,
        signal: Signal,
        resolution: int,
        views: Views,
        recipe: Recipe,
        boundary: str,
        images_of: str,
        *,
        seed: int,
        dtype: torch.dtype,
        device: str,
    ) -> Bench:
        """Everything for n = `resolution` in `dtype` on `device`; order and points are drawn by the seed."""
        signal = signal.with_voxel_size(min(_geometry(signal.domain, resolution).spacing))
        training, held_out = views.cameras(signal.domain)
        generator = torch.Generator().manual_seed(seed)
        order = torch.randperm(views.pixels, generator=generator)
        unit = torch.rand(_POINTS, 3, generator=generator, dtype=torch.float64)
        low, high = (torch.tensor(corner, dtype=torch.float64) for corner in (signal.domain.lower, signal.domain.upper))
        points = (low + high) / 2 + _INNER * (unit - 0.5) * (high - low)
        return cls(
            signal,
            signal.sample(resolution, dtype=dtype, device=device),
            views,
            recipe,
            boundary,
            images_of,
            training=_rays(training, views.size, device),
            held_out=_rays(held_out, views.size, device),
            shown={"training": training[len(training) // 2], "held_out": held_out[len(held_out) // 2]},
            order=order.to(device),
            points=points.to(device=device, dtype=dtype),
        )

    def field(self, voxels: Tensor) -> fl.Field:
        """The field of voxels `(n', n', n')` that fill the signal's box, for any n'."""
        geometry = _geometry(self.signal.domain, len(voxels))
        return self.recipe.build(fl.Volume.with_geometry(voxels, geometry), self.boundary)

    @property
    def target(self) -> fl.Field:
        """What the target images are of."""
        return self.signal if self.images_of == "signal" else self.field(self.samples.samples)

    def render(self, field: fl.Field, transfer: TransferFunction, rays: RayTensors | Camera, size: int = 0) -> Tensor:
        """Linear RGB of rays `(R, 3)`, or of a camera's image of `size`² pixels; the same step in the world for all."""
        views, dtype = self.views, self.samples.dtype
        return render(
            field,
            rays,
            transfer,
            size=(size, size) if isinstance(rays, Camera) else None,
            step=views.step * self.signal.domain.voxel_size / field.domain.voxel_size,
            shading=views.lighting.build() if views.lighting else None,
            background=views.background,
            dtype=dtype,
            device=self.samples.device,
            max_samples=MAX_SAMPLES,
        )[..., :3]

    @torch.no_grad()
    def image(self, field: fl.Field, transfer: TransferFunction, rays: RayTensors | Camera, size: int = 0) -> Tensor:
        """The same without derivatives."""
        return self.render(field, transfer, rays, size)

    def batch(self, iteration: int, size: int) -> Tensor:
        """The numbers `(size,)` of the training rays that an iteration looks at."""
        first = iteration * size + torch.arange(size, device=self.order.device)
        return self.order[first % len(self.order)]

    @torch.no_grad()
    def field_rms(self, field: fl.Field) -> float | None:
        """RMS difference of a field and the signal at the points."""
        return number(metrics.rms(field(self.points), self.signal(self.points)))


def _geometry(domain: Domain, n: int) -> Geometry:
    """Where n³ voxels lie that fill the box of a signal."""
    spacing = [(b - a) / n for a, b in zip(domain.lower, domain.upper, strict=True)]
    return Geometry.of(spacing, [a + s / 2 for a, s in zip(domain.lower, spacing, strict=True)])


def _rays(cameras: list[Camera], size: int, device: str) -> RayTensors:
    origins, directions = zip(*(camera.rays(size, size) for camera in cameras), strict=True)
    return tuple(torch.cat(x).reshape(-1, 3).to(device) for x in (origins, directions))  # type: ignore[return-value]


def picked(rays: RayTensors, index: Tensor) -> RayTensors:
    """Some of the rays."""
    return rays[0][index], rays[1][index]


def displayed_psnr(image: Tensor, truth: Tensor) -> float | None:
    """PSNR in dB of linear images as displayed (sRGB); None where they are equal."""
    return number(metrics.psnr(displayed(image), displayed(truth)))


# --- the volume -------------------------------------------------------------------------------------------------------


class Start(StrictModel):
    """The voxels at first: all of one `value`, or the signal's samples blurred by a Gaussian of σ = `blur` voxels."""

    value: float | None = None
    blur: Annotated[float, Field(gt=0, le=100)] | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Start:
        if (self.value is None) == (self.blur is None):
            raise ValueError("expected either value or blur; got " + ("neither" if self.value is None else "both"))
        return self


class VolumeStage(Stage):
    """Steps on `resolution`³ voxels; they begin with the field of the stage before, at the new voxel centres."""

    resolution: Annotated[int, Field(ge=2, le=512)]


class VolumeFit(StrictModel):
    """The voxels are unknown.

    Attributes:
        transfer: the known transfer function. Voxels are kept between its first and its last control point: it is
            constant beyond, so that a voxel there would have no derivative and never come back.
        start, stages: where the descent begins, and its parts, from coarse to fine.
        rays: R, in a batch.
        smoothness: λ of the penalty λ Σ_d mean (x_{k+1} − x_k)² over neighbours along each axis d.
    """

    transfer: scene.Transfer
    start: Start = Start(value=0.5)
    stages: Annotated[list[VolumeStage], Field(min_length=1)]
    rays: Annotated[int, Field(ge=1)] = 2048
    smoothness: Annotated[float, Field(ge=0)] = 0.0


class VolumeProblem:
    """The voxels whose field makes the target images: min over x of mean |render(field(x)) − target|² + penalty(x)."""

    def __init__(self, bench: Bench, fit: VolumeFit) -> None:
        self.bench, self.fit = bench, fit
        self.transfer = fit.transfer.build(lambda: (0.0, 1.0), bench.signal.domain.voxel_size)
        self.low, self.high = float(self.transfer.positions[0]), float(self.transfer.positions[-1])
        self.training, self.held_out = (
            bench.image(bench.target, self.transfer, rays) for rays in (bench.training, bench.held_out)
        )

    def truth(self, resolution: int) -> Tensor:
        """The signal at the voxel centres."""
        samples = self.bench.samples
        if resolution == len(samples.samples):
            return samples.samples
        return self.bench.signal.sample(resolution, dtype=samples.dtype, device=samples.device).samples

    def start(self) -> Parameters:
        start, truth = self.fit.start, self.truth(self.fit.stages[0].resolution)
        voxels = blurred(truth, start.blur) if start.blur is not None else torch.full_like(truth, start.value or 0.0)
        return {"voxels": voxels.clamp(self.low, self.high)}

    def refine(self, parameters: Parameters, stage: int) -> Parameters:
        n = self.fit.stages[stage].resolution
        grid = torch.stack(torch.meshgrid(*[torch.arange(n, dtype=torch.float64)] * 3, indexing="ij")[::-1], -1)
        voxels = parameters["voxels"].detach()
        points = _geometry(self.bench.signal.domain, n).to_world(grid).to(voxels.device, voxels.dtype)
        with torch.no_grad():
            return {"voxels": self.bench.field(voxels)(points).clamp(self.low, self.high)}

    def first_at_full_resolution(self) -> Tensor:
        """The start, at the voxel centres of the last stage: what it looks like beside the result."""
        first = self.start()
        return first["voxels"] if len(self.fit.stages) == 1 else self.refine(first, len(self.fit.stages) - 1)["voxels"]

    def loss(self, parameters: Parameters, stage: int, iteration: int) -> tuple[Tensor, Tensor]:
        voxels, index = parameters["voxels"], self.bench.batch(iteration, self.fit.rays)
        image = self.bench.render(self.bench.field(voxels), self.transfer, picked(self.bench.training, index))
        return (image - self.training[index]).square().mean(), self.fit.smoothness * roughness(voxels)

    def project(self, parameters: Parameters) -> None:
        parameters["voxels"].clamp_(self.low, self.high)

    def observe(self, parameters: Parameters, stage: int) -> Record:
        voxels = parameters["voxels"].detach()
        field = self.bench.field(voxels)
        return {
            "resolution": len(voxels),
            "psnr": displayed_psnr(self.bench.image(field, self.transfer, self.bench.held_out), self.held_out),
            "voxel_rms": number(metrics.rms(voxels, self.truth(len(voxels)))),
            "field_rms": self.bench.field_rms(field),
        }

    def dependence(self, seed: int, progress: Callable[[float], None]) -> Tensor:
        """How strongly the training images depend on each voxel of the signal's samples, `(n, n, n)`.

        The norm √Σ_p (∂p/∂x_k)² over all pixels p and colours, estimated: with random signs s_p the squared derivative
        of Σ_p s_p p has that sum as its expectation, and every view gives one such draw of its share of the sum.

        Source: Bekas, Kokiopoulou & Saad, An estimator for the diagonal of a matrix, 2007.
        """
        voxels = self.bench.samples.samples.detach().clone().requires_grad_()
        generator = torch.Generator().manual_seed(seed)
        squares = torch.zeros_like(voxels)
        pixels = self.bench.views.size**2
        for view in range(self.bench.views.training):
            index = torch.arange(view * pixels, (view + 1) * pixels, device=voxels.device)
            image = self.bench.render(self.bench.field(voxels), self.transfer, picked(self.bench.training, index))
            signs = (2 * torch.randint(2, image.shape, generator=generator) - 1).to(image)
            squares += torch.autograd.grad((signs * image).sum(), voxels)[0].square()
            progress((view + 1) / self.bench.views.training)
        return squares.sqrt()


def roughness(voxels: Tensor) -> Tensor:
    """Σ_d mean (x_{k+1} − x_k)² over neighbours along each axis d."""
    return torch.stack([voxels.diff(dim=d).square().mean() for d in range(3)]).sum()


def blurred(voxels: Tensor, sigma: float) -> Tensor:
    """The volume blurred by a Gaussian of σ voxels, cut off at 3 σ; the first and last voxels go on beyond the ends."""
    reach = math.ceil(3 * sigma)
    weights = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, dtype=voxels.dtype, device=voxels.device) / sigma) ** 2)
    weights = (weights / weights.sum())[None, None]
    for _ in range(3):
        lines = pad(voxels.reshape(-1, 1, voxels.shape[-1]), (reach, reach), mode="replicate")
        voxels = conv1d(lines, weights).reshape(voxels.shape).permute(2, 0, 1)
    return voxels.contiguous()


# --- the transfer function --------------------------------------------------------------------------------------------


def _distinct(names: list[str]) -> list[str]:
    if len(set(names)) < len(names):
        raise ValueError(f"expected each once; got {names}")
    return names


Share = Annotated[float, Field(gt=0, lt=1)]
Positions = Literal["fixed", "free"]


class TransferFit(Stage):
    """Opacities and colours at control points are unknown.

    Attributes:
        target: the transfer function of the images.
        points: M; they lie between the least and the largest sample.
        positions: what is asked for, one recovery each: `fixed`, the points are evenly spaced; `free`, only the first
            and the last are given.
        opacity, color: of all points at first.
        rays: R, in a batch.
    """

    target: scene.Transfer
    points: Annotated[int, Field(ge=2, le=1024)] = 16
    positions: Annotated[list[Positions], Field(min_length=1), AfterValidator(_distinct)] = Field(
        default_factory=lambda: ["fixed"]
    )
    opacity: Share = 0.1
    color: tuple[Share, Share, Share] = (0.5, 0.5, 0.5)
    rays: Annotated[int, Field(ge=1)] = 512


class TransferProblem:
    """The control points that make the target images: min of mean |render(field, points) − target|².

    With s(t) = 1 / (1 + e^{−t}), opacities are s(a_k) and colours s(b_k), so that they stay within 0 … 1 whatever the
    unknown a `(M,)` and b `(M, 3)` are. Free positions lie at the sums of gaps proportional to ε + softmax(g) with the
    unknown g `(M−1,)` and ε a tenth of the mean gap, so that they keep their order.
    """

    def __init__(self, bench: Bench, fit: TransferFit, positions: Positions) -> None:
        self.bench, self.fit, self.positions = bench, fit, positions
        self.unit = fit.target.unit or bench.signal.domain.voxel_size
        self.target = fit.target.build(lambda: (0.0, 1.0), bench.signal.domain.voxel_size)
        low, high = bench.samples.samples.aminmax()
        self.low, self.high = float(low), float(high)
        self.field = bench.field(bench.samples.samples)
        self.training, self.held_out = (
            bench.image(bench.target, self.target, rays) for rays in (bench.training, bench.held_out)
        )
        with torch.no_grad():
            self.values = bench.signal(bench.points)

    def start(self) -> Parameters:
        opacities = self.values.new_full((self.fit.points,), self.fit.opacity)
        colors = self.values.new_tensor(self.fit.color).expand(self.fit.points, 3)
        parameters = {"opacities": opacities.logit(), "colors": colors.logit()}
        if self.positions == "free":
            parameters["gaps"] = self.values.new_zeros(self.fit.points - 1)
        return parameters

    def transfer(self, parameters: Parameters) -> TransferFunction:
        """The transfer function of the unknowns; differentiable in them."""
        opacities, colors = parameters["opacities"], parameters["colors"]
        gaps = parameters.get("gaps", opacities.new_zeros(len(opacities) - 1)).softmax(0) + _NARROWEST / (
            len(opacities) - 1
        )
        shares = torch.cat((gaps.new_zeros(1), (gaps / gaps.sum()).cumsum(0)))
        positions = self.low + (self.high - self.low) * shares
        return TransferFunction(positions, colors.sigmoid(), opacities.sigmoid(), self.unit)

    def refine(self, parameters: Parameters, stage: int) -> Parameters:
        raise AssertionError("there is one stage")

    def loss(self, parameters: Parameters, stage: int, iteration: int) -> tuple[Tensor, Tensor]:
        index = self.bench.batch(iteration, self.fit.rays)
        image = self.bench.render(self.field, self.transfer(parameters), picked(self.bench.training, index))
        misfit = (image - self.training[index]).square().mean()
        return misfit, torch.zeros_like(misfit)

    def project(self, parameters: Parameters) -> None:
        """Nothing: every number is allowed."""

    @torch.no_grad()
    def observe(self, parameters: Parameters, stage: int) -> Record:
        transfer = self.transfer(parameters)
        image = self.bench.image(self.field, transfer, self.bench.held_out)
        return {"psnr": displayed_psnr(image, self.held_out), **self.errors(transfer)}

    @torch.no_grad()
    def observe_exact(self) -> Record:
        """What the target itself comes to on the method's field: the rest is the field's error."""
        image = self.bench.image(self.field, self.target, self.bench.held_out)
        return {"psnr": displayed_psnr(image, self.held_out)}

    @torch.no_grad()
    def errors(self, transfer: TransferFunction) -> Record:
        """How far a transfer function is from the target, over the values that occur in the volume.

        opacity: √mean (α − α*)²; color: √(Σ α* |c − c*|² / (3 Σ α*)), because what is transparent has no colour. The
        mean and the sums are over the values of the signal at uniform random points.
        """
        (color, opacity), (true_color, true_opacity) = (t(self.values) for t in (transfer, self.target))
        total = 3 * true_opacity.sum()
        squares = (true_opacity[:, None] * (color - true_color).square()).sum()
        return {
            "opacity_rms": number(metrics.rms(opacity, true_opacity)),
            "color_rms": number((squares / total).sqrt()),
        }
