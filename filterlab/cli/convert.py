"""The command `filterlab convert`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from filterlab.cli.loading import load
from filterlab.cli.memory import limit_in_bytes
from filterlab.cli.options import Channel, Frame, Quiet, result_type
from filterlab.cli.saving import OutputFile
from filterlab.cli.terminal import progress_bar

if TYPE_CHECKING:
    from filterlab.io.bounded import VolumeHeader


def with_output_last(arguments: list[str]) -> list[str]:
    """`IN -o OUT`, as other commands take it, as `IN OUT`."""
    place = next((i for i, argument in enumerate(arguments[:-1]) if argument in ("-o", "--output")), None)
    if place is None:
        return arguments
    return [*arguments[:place], *arguments[place + 2 :], arguments[place + 1]]


@dataclass(frozen=True)
class Convert:
    """Write a volume as a file of another format: the same voxels at the same place.

    Values are kept bit for bit, in their type where the format has it, else in a wider one; so are the affine, and the
    axes, unit and codes that are declared, as far as the format has a place for them. What is not kept is told. Files:
    what `filterlab info` shows is read; .nrrd, .nii, .nii.gz, .npy and .npz are written.

    examples:
      filterlab convert scan.nii.gz scan.nrrd
      filterlab convert series/ scan.nii.gz
      filterlab convert cells.ome.tif nuclei.nrrd --frame 0 --channel 1
      filterlab convert labels.nrrd labels.nii.gz --dtype uint8
    """

    input: Annotated[Positional[Path], arg(metavar="IN")]
    """The volume: a file, or a folder of DICOM files or numbered TIFF slices."""
    output: Annotated[Positional[Path], arg(metavar="OUT")]
    """The volume to write, also as `-o OUT`; its ending tells the format. A file of that name is replaced."""
    frame: Frame = None
    """Which volume of a time series (or entry of a batch), from 0."""
    channel: Channel = None
    """Which of several values per voxel, from 0: components of vectors, colours, dyes."""
    dtype: str = "input"
    """Type of the values: an integer type, float32, float64, or `input` for that of IN. It has to hold every value
    exactly; else nothing is written."""
    nifti2: bool = False
    """Write NIfTI-2, which fewer tools open; NIfTI-1 rounds numbers of the affine, by 6e-8 of themselves at most."""
    max_gigabytes: float = 8.0
    """The most memory that the volume may take."""
    quiet: Quiet = False
    """Say nothing of what was written, and show no progress."""

    def run(self, overrides: dict[str, str]) -> None:
        output = OutputFile.at(self.output, self.input, quiet=self.quiet)

        from filterlab.io.volumes import check_saveable, describe

        source = describe(self.input, frame=self.frame, channel=self.channel)
        source.check_choice()
        check_saveable(self.output, batched=len(source.shape) == 5, nifti2=self.nifti2)
        limit = limit_in_bytes(self.max_gigabytes)
        stored = None if self._keeps(source) else result_type(self.dtype, source)
        with progress_bar(self.quiet) as progress:
            volume = load(self.input, self.frame, self.channel, progress, limit)
            output.save(volume, progress, stored=stored, nifti2=self.nifti2)
        output.tell_volume(volume, source)

    def _keeps(self, source: VolumeHeader) -> bool:
        """Whether values are written as they are read, which is in a wider type where a format lacks theirs."""
        return self.dtype == "input" and source.sample_type.kind == "f"
