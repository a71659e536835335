"""A scene: everything that one picture shows, and how."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from pydantic import Field, ValidationInfo, field_validator, model_validator

from filterlab.scenes.model.colors import Color
from filterlab.scenes.model.legend import LegendModel
from filterlab.scenes.model.quantities import Pixels, Positive, Section, Told
from filterlab.scenes.model.reconstruction import SceneMethod
from filterlab.scenes.model.sources import SignalSource, VolumeFile, folder_of
from filterlab.scenes.model.surface import Cast, SurfaceModel, SurfaceOfItsOwn
from filterlab.scenes.model.terrain import NO_SKY, TerrainModel
from filterlab.scenes.model.transfer import Transfer
from filterlab.scenes.model.values import MipModel, SliceModel, ValueColors
from filterlab.scenes.model.view import CameraView, Lighting, Region

STEP = 0.5  # voxels

_WITHOUT = {
    "surface": (("step", "termination"), "a surface is hit exactly, not stepped to"),
    "terrain": (("step", "termination"), "a terrain is hit exactly, not stepped to"),
    "mip": (("termination", "lighting"), "a projection looks along all of a ray, without light"),
    "slice": (("step", "jitter", "termination", "lighting"), "a slice has one value a pixel, without light"),
}
"""What keys have no meaning for what is shown, and why."""


class Scene(Section):
    """A picture of a volume or a signal: of a medium, of a surface in it, of its largest values, or of a slice; or a
    picture of a surface of its own, or of a terrain."""

    examples = (
        """description: CT of an engine block, two peaks, lit
volume: engine.nrrd
method: triquadratic
transfer:
  peaks:
    - {center: 130, width: 110, height: 0.05, color: [0.45, 0.65, 0.85]}
    - {center: 230, width: 110, height: 0.7, color: orangered}
camera: {direction: [-0.75, 0.65, 0.5], up: [0, 0, -1]}
lighting: {lights: [{direction: [-0.2, -0.9, -0.9]}], ambient: 0.25, diffuse: 0.85}
region: {lower: [0, 0, 0], upper: [255, 255, 60]}
background: '#181c28'
legend: {side: right, label: X-ray density}
size: [800, 600]
step: 0.5
jitter: 1
termination: 0.002
precision: float32
device: cpu""",
        """signal: {name: marschner-lobb, samples: 40}
surface: {level: 0.5, material: toon, subpixels: 2}""",
        """volume: head.nii.gz
mip: {center: 400, width: 900}
camera: {direction: [0, 1, 0]}""",
        """volume: head.nii.gz
slice: {axis: z, position: 31.5, colormap: bone}""",
        """surface: {slim: bunny.npz, material: {kind: phong, color: sandybrown}}
camera: {direction: [0, 0, -1], up: [0, 1, 0]}""",
        """terrain: {heights: dem.tif, exaggeration: 2, sun: [300, 15], water: 420}
camera: {compass: [20, 33]}
legend: true
size: [960, 600]""",
    )

    description: str = ""
    """For people."""
    volume: VolumeFile | None = None
    """What is shown: a volume file; or a `signal`."""
    signal: SignalSource | None = None
    """Instead of a volume, a closed-form signal."""
    method: SceneMethod | None = None
    """How samples are reconstructed; left out, `triquadratic`."""
    transfer: Transfer | None = None
    """Of a medium: what its values look like."""
    surface: SurfaceModel | None = None
    """Instead of a medium: the level set that is shown; or, without a volume, a surface of its own."""
    terrain: TerrainModel | None = None
    """Instead of a medium, without a volume: heights on a grid, out of doors."""
    mip: MipModel | None = None
    """Instead of a medium: the largest value along every ray."""
    slice: SliceModel | None = None
    """Instead of a medium: the values on a plane."""
    camera: CameraView = CameraView()
    """Where it is seen from."""
    size: Annotated[tuple[Pixels, Pixels], Told("[width, height]", "pixels")] = (512, 512)
    """Of the picture."""
    step: Annotated[Positive, Told(unit="voxels")] | None = None
    """From sample to sample along the rays; left out, half a voxel, or what `method: auto` finds."""
    lighting: Lighting | None = None
    """Lights. Without it a medium's colours are shown as they are, a surface has a headlight, a terrain its sun."""
    background: Color = (0.0, 0.0, 0.0)
    """Behind everything; of a terrain only where its `sky` is none."""
    legend: LegendModel | None = None
    """What colours stand for what values, beside the picture; of a surface there is none, of a terrain that of its
    heights, slopes or aspects."""
    region: Region | None = None
    """The part that is shown; left out, all of the volume."""
    jitter: Annotated[int, Field(ge=0, lt=2**63), Told("whole number from 0 to 2⁶³ − 1")] | None = None
    """A seed: moves the samples of every pixel by its own part of a step, noise instead of rings. Of a surface and a
    terrain it is the seed of their subpixels."""
    termination: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Rays through a medium end where no more than this can change; left out, only behind what is exactly opaque."""
    precision: Literal["float32", "float64"] = "float32"
    """Of samples and arithmetic."""
    device: Annotated[str, Told("a device of torch: cpu, cuda, cuda:1")] = "cpu"
    """Where it is computed."""

    @field_validator("volume")
    @classmethod
    def _found(cls, volume: VolumeFile | None, info: ValidationInfo) -> VolumeFile | None:
        """Looked for when the scene is read: nothing is computed before every file is known to be there."""
        return None if volume is None else volume.model_copy(update={"file": str(volume.path(folder_of(info)))})

    @model_validator(mode="after")
    def _consistent(self) -> Scene:
        if self.alone is not None:
            self._check_without_field(self.alone)
        elif (self.volume is None) == (self.signal is None):
            raise ValueError("expected either a volume or a signal" + ("; got both" if self.volume else ""))
        if self.signal is not None and self.signal.samples is None and self.method is not None:
            raise ValueError("a signal that is not sampled needs no method: give signal.samples, or leave method out")
        self._check_shown()
        if self.surface is not None and self.signal is not None and self.signal.samples is None:
            raise ValueError("a surface is that of samples: give signal.samples, a signal itself has no exact pieces")
        if self.transfer is not None and self.transfer.axis == "raw":  # else the values are known with the volume
            self.transfer.build(lambda: (0.0, 1.0), 1.0).to(self.dtype)
        if self.terrain is not None:
            self._check_around(self.terrain)
        return self

    def _check_without_field(self, what: str) -> None:
        """Raises ValueError if there is what only a field has."""
        if unused := [name for name in ("volume", "signal", "method") if getattr(self, name) is not None]:
            raise ValueError(f"{' and '.join(unused)}: {what} is no part of a volume; leave it out")

    def _check_around(self, terrain: TerrainModel) -> None:
        """Raises ValueError for what a terrain of this kind has no use for."""
        if terrain.sky != NO_SKY and self.background != (0.0, 0.0, 0.0):
            raise ValueError("background: behind a terrain is its sky; leave it out, or give terrain.sky: none")
        if self.region is not None and (terrain.block or terrain.water is not None):
            raise ValueError("region: walls and water reach to the ends of the map; leave it out, or block: false")
        if self.legend is not None and not terrain.shows_values:
            raise ValueError("legend: the colours of this terrain stand for no values; leave it out")

    def _check_shown(self) -> None:
        """Raises ValueError unless one thing is shown, and every key has a meaning for it."""
        instead = [name for name in _WITHOUT if getattr(self, name) is not None]
        if len(instead) > 1:
            raise ValueError(f"expected one of {', '.join(_WITHOUT)}; got {' and '.join(instead)}")
        if self.cast is not None and self.transfer is not None:
            what = "surface" if self.terrain is None else "terrain"
            raise ValueError(f"expected either a transfer function (a medium) or a {what}; got both")
        if self.transfer is None and not instead:
            raise ValueError(
                "expected a transfer function (a medium), a surface, a terrain, a mip or a slice; got none of them"
            )
        if self.surface is not None and self.legend is not None:
            raise ValueError("legend: the colours of a surface stand for no values; leave it out")
        for kind in instead:
            keys, why = _WITHOUT[kind]
            if unused := [name for name in keys if getattr(self, name) is not None]:
                raise ValueError(f"{' and '.join(unused)}: {why}; leave it out")
            shown = getattr(self, kind)
            if isinstance(shown, ValueColors) and shown.chosen and self.transfer is not None:
                raise ValueError(f"expected the colours of a {kind} once; got a transfer function and its own")

    @property
    def cast(self) -> Cast | None:
        """What rays are cast at, if it is that."""
        return self.surface or self.terrain

    @property
    def alone(self) -> str | None:
        """What is shown, in words, where that is no part of a volume or a signal."""
        if isinstance(self.surface, SurfaceOfItsOwn):
            return self.surface.called
        return None if self.terrain is None else "a terrain"

    @property
    def sources(self) -> list[str]:
        """The files that it is made of, beside pictures that materials mirror."""
        own = [self.volume.file] if self.volume is not None else []
        if isinstance(self.surface, SurfaceOfItsOwn) and self.surface.source is not None:
            own.append(self.surface.source)
        return own + ([] if self.terrain is None else self.terrain.sources)

    @property
    def stepped(self) -> bool:
        """Whether rays are sampled in steps."""
        return self.cast is None and self.slice is None

    @property
    def legend_label(self) -> str:
        """Of the values in the legend."""
        return "" if self.legend is None else self.legend.label

    @property
    def dtype(self) -> torch.dtype:
        """Of samples and arithmetic."""
        return torch.float64 if self.precision == "float64" else torch.float32

    @property
    def step_or_default(self) -> float:
        """In voxels."""
        return STEP if self.step is None else self.step
