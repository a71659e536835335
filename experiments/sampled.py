"""What experiments on surfaces are of: a sampled signal, or a scan."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from experiments.config import VolumeChoice, check_signal
from filterlab.fields.base import Domain
from filterlab.io.config import StrictModel
from filterlab.scenes import model as scene


class Sampled(StrictModel):
    """A volume of an experiment.

    Attributes:
        signal, resolution: what is sampled, on how many voxels along each axis; or
        volume: a scan. An optional one that is not there is skipped.
    """

    signal: scene.SignalModel | None = None
    resolution: Annotated[int, Field(ge=2, le=1024)] | None = None
    volume: VolumeChoice | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Sampled:
        if (self.signal is None) == (self.volume is None) or (self.signal is None) != (self.resolution is None):
            raise ValueError("expected either a signal and its resolution, or a volume")
        return self

    @property
    def present(self) -> bool:
        """Whether there is something to show."""
        return self.volume is None or self.volume.present

    def check(self, path: str) -> Domain | None:
        """The domain; None of an optional scan that is not there. Raises ConfigError for what is wrong at `path`."""
        if self.signal is not None:
            return check_signal(self.signal, f"{path}.signal").domain
        if self.volume is not None and self.present:
            return self.volume.check(f"{path}.volume")
        return None
