"""A scene: everything that one picture shows, and how."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from pydantic import Field, ValidationInfo, field_validator, model_validator

from filterlab.scenes.model.colors import Color
from filterlab.scenes.model.quantities import Pixels, Positive, Section, Told
from filterlab.scenes.model.reconstruction import SceneMethod
from filterlab.scenes.model.sources import SignalSource, VolumeFile, folder_of
from filterlab.scenes.model.surface import SurfaceModel
from filterlab.scenes.model.transfer import Transfer
from filterlab.scenes.model.view import CameraView, Lighting, Region

STEP = 0.5  # voxels


class Scene(Section):
    """A picture of a volume or a signal: of a medium, or of a surface in it."""

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
size: [800, 600]
step: 0.5
jitter: 1
termination: 0.002
precision: float32
device: cpu""",
        """signal: {name: marschner-lobb, samples: 40}
surface: {level: 0.5, material: toon, subpixels: 2}""",
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
    """Instead of a medium: the level set that is shown."""
    camera: CameraView = CameraView()
    """Where it is seen from."""
    size: Annotated[tuple[Pixels, Pixels], Told("[width, height]", "pixels")] = (512, 512)
    """Of the picture."""
    step: Annotated[Positive, Told(unit="voxels")] | None = None
    """From sample to sample along the rays through a medium; left out, half a voxel, or what `method: auto` finds."""
    lighting: Lighting | None = None
    """Lights. Without it a medium's colours are shown as they are, and a surface has a headlight."""
    background: Color = (0.0, 0.0, 0.0)
    """Behind everything."""
    region: Region | None = None
    """The part that is shown; left out, all of the volume."""
    jitter: Annotated[int, Field(ge=0, lt=2**63), Told("whole number from 0 to 2⁶³ − 1")] | None = None
    """A seed: moves the samples of every pixel by its own part of a step, noise instead of rings. Of a surface it is
    the seed of its subpixels."""
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
        if (self.volume is None) == (self.signal is None):
            raise ValueError("expected either a volume or a signal" + ("; got both" if self.volume else ""))
        if self.signal is not None and self.signal.samples is None and self.method is not None:
            raise ValueError("a signal that is not sampled needs no method: give signal.samples, or leave method out")
        if (self.transfer is None) == (self.surface is None):
            both = "; got both" if self.transfer else "; got neither"
            raise ValueError(f"expected either a transfer function (a medium) or a surface{both}")
        if self.surface is not None:
            self._check_surface()
        elif self.transfer is not None and self.transfer.axis == "raw":  # else the values are known with the volume
            self.transfer.build(lambda: (0.0, 1.0), 1.0).to(self.dtype)
        return self

    def _check_surface(self) -> None:
        stepped = [name for name in ("step", "termination") if getattr(self, name) is not None]
        if stepped:
            raise ValueError(f"{' and '.join(stepped)}: a surface is hit exactly, not stepped to; leave it out")
        if self.signal is not None and self.signal.samples is None:
            raise ValueError("a surface is that of samples: give signal.samples, a signal itself has no exact pieces")

    @property
    def dtype(self) -> torch.dtype:
        """Of samples and arithmetic."""
        return torch.float64 if self.precision == "float64" else torch.float32

    @property
    def step_or_default(self) -> float:
        """In voxels."""
        return STEP if self.step is None else self.step
