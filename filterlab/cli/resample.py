"""The command `filterlab resample`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from filterlab import names
from filterlab.cli.imports import importing
from filterlab.cli.loading import load
from filterlab.cli.memory import as_float, check_memory, limit_in_bytes
from filterlab.cli.options import Channel, Frame, Maybe, Output, Quiet, Triple, check_name, result_type
from filterlab.cli.outcome import UsageError
from filterlab.cli.saving import OutputFile
from filterlab.cli.terminal import progress_bar, tell

if TYPE_CHECKING:
    import numpy as np
    import torch

    from filterlab.io.bounded import VolumeHeader
    from filterlab.volume import Volume


@dataclass(frozen=True)
class Resample:
    """Put a volume on another grid: finer, coarser, or that of another volume.

    The volume is reconstructed by the chosen method and sampled anew; it stays where it is in the world, or is moved by
    --affine first. On a coarser grid --antialias leaves out what it does not hold. Files: NRRD, NIfTI, TIFF stacks,
    .npy, .npz and .raw with a sidecar are read; .nrrd, .nii, .nii.gz, .npy and .npz are written.

    examples:
      filterlab resample engine.nrrd -o fine.nrrd --method notch --spacing 0.5 0.5 0.5
      filterlab resample engine.nrrd -o small.nii.gz --shape 128 128 64 --antialias --dtype input
      filterlab resample pet.nii.gz -o pet_on_ct.nii.gz --like ct.nii.gz --fill 0
      filterlab resample cells.ome.tif -o nuclei.nrrd --channel 1 --frame 0 --spacing 0.2 0.2 0.2
      filterlab resample organs.nii.gz -o organs_on_ct.nii.gz --like ct.nii.gz --labels
      filterlab resample pet.nii.gz -o pet_on_ct.nii.gz --like ct.nii.gz --affine pet_to_ct.mat --convention fsl
      filterlab resample pet.nii.gz -o pet_on_ct.nii.gz --like ct.nii.gz --affine 0GenericAffine.mat --convention itk
    """

    input: Annotated[Positional[Path], arg(metavar="IN")]
    """The volume: a file, or a folder of numbered TIFF slices."""
    output: Output
    """The volume to write; a file of that name is replaced."""
    method: str = "triquadratic"
    """How values between the voxels are found; `filterlab methods` lists the names."""
    spacing: Annotated[Maybe[Triple], arg(metavar="SX SY SZ")] = None
    """New size of a voxel along x, y, z, in the volume's own units."""
    shape: Annotated[Maybe[tuple[int, int, int]], arg(metavar="NX NY NZ")] = None
    """Instead of it: new number of voxels along x, y, z."""
    like: Annotated[Maybe[Path], arg(metavar="FILE")] = None
    """Instead of it: a volume file whose grid is taken over."""
    affine: Annotated[Maybe[Path], arg(metavar="FILE")] = None
    """A 4×4 matrix as text that moves IN first. With none of --spacing, --shape, --like onto the grid that IN had."""
    convention: str = "world"
    """What the matrix means. world: it leads points of IN to where they go, in world coordinates as `filterlab info`
    shows them. itk: a matrix, or a file of ITK, ANTs or 3D Slicer, that leads points of the result to points of IN, in
    LPS. fsl: FLIRT's -omat, from -in to -ref, in voxels times their sizes."""
    inverse: bool = False
    """The matrix was made the other way round, to move onto IN what is moved back now."""
    flirt_in: Annotated[Maybe[Path], arg(metavar="FILE")] = None
    """For fsl: the volume that was FLIRT's -in. Default: IN (with --inverse that of --like)."""
    flirt_ref: Annotated[Maybe[Path], arg(metavar="FILE")] = None
    """For fsl: the volume that was FLIRT's -ref. Default: that of --like (with --inverse IN)."""
    boundary: str = "mirror"
    """How the volume goes on beyond its ends: mirror, reflect, wrap, border or zeros."""
    nan: str = "refuse"
    """What becomes of voxels that are NaN: refuse, propagate (NaN near them) or fill (values from around)."""
    frame: Frame = None
    """Which volume of a time series (or entry of a batch), from 0."""
    channel: Channel = None
    """Which of several values per voxel, from 0: components of vectors, colours, dyes."""
    fill: Maybe[float] = None
    """The value of voxels outside of IN, for --like, --affine; `nan` too. Default: none, the boundary rules there."""
    labels: bool = False
    """The values of IN are names, not amounts: of each the method reconstructs where it is, and the strongest wins."""
    antialias: bool = False
    """Leave out what a coarser grid does not hold; without it fine detail comes back as coarse patterns."""
    dtype: Maybe[str] = None
    """Type of the result: float32, float64, an integer type (rounded and clipped), or `input` for the type of IN.
    Default: `input` for labels and for the method nearest, else float32, or float64 if that is what the values need."""
    nifti2: bool = False
    """Write NIfTI-2, which fewer tools open; NIfTI-1 rounds numbers of the affine, by 6e-8 of themselves at most."""
    max_gigabytes: float = 8.0
    """The most memory that one volume may take: IN as it is read, or the result as it is computed or written."""
    quiet: Quiet = False
    """Say nothing of what was written, and show no progress."""

    def run(self, overrides: dict[str, str]) -> None:
        grids = [self.spacing is not None, self.shape is not None, self.like is not None]
        if sum(grids) > 1 or (self.affine is None and not any(grids)):
            raise UsageError(
                "expected one of --spacing, --shape and --like; got " + ("several" if any(grids) else "none")
            )
        self._check_convention()
        output = OutputFile.at(self.output, self.input, self.like, self.affine, quiet=self.quiet)

        check_name("method", self.method, names.methods())
        check_name("boundary", self.boundary, names.BOUNDARIES)
        check_name("nan", self.nan, names.NAN_CHOICES)
        if self.antialias and self.method == "nearest" and not self.labels:
            raise UsageError("expected another method, or --labels, for --antialias; nearest takes samples as they are")

        import numpy as np

        from filterlab.io.volumes import check_saveable, describe

        source = describe(self.input, frame=self.frame, channel=self.channel)
        source.check_choice()
        target = None if self.like is None else describe(self.like)
        affine = self._affine(source, target)
        keeps = self.labels or self.method == "nearest"
        stored = None if self.dtype is None and not keeps else result_type(self.dtype or "input", source)

        with importing():
            import torch

            from filterlab.resampling import check_fill, resample
            from filterlab.volume import Volume

        working = _working_type(stored, source)
        check_saveable(self.output, batched=len(source.shape) == 5, nifti2=self.nifti2)
        check_fill(self.fill, stored or "float32", "--fill")
        limit = limit_in_bytes(self.max_gigabytes)
        shape = [*source.shape[:-3], *self._new_size(source, target)]
        itemsize = max(working.itemsize, source.dtype.itemsize if keeps else 0, np.dtype(stored or "float32").itemsize)
        check_memory(shape, itemsize, limit)
        grid: dict = {"spacing": self.spacing} if self.spacing else {"shape": self.shape[::-1] if self.shape else None}
        if target is not None:  # a grid without samples: one voxel, shown over and over
            grid = {"like": Volume.with_geometry(torch.zeros(()).expand(target.shape[-3:]), target.geometry)}
        grid |= {"affine": affine, "boundary": self.boundary}
        asked: dict = {"dtype": None if keeps or stored is None else working, "labels": self.labels, "fill": self.fill}
        asked["antialias"] = self.antialias or None
        with progress_bar(self.quiet) as progress:
            volume = load(self.input, self.frame, self.channel, progress, limit)
            if not keeps:
                _tell_labels(volume, source, self.input)
            asked["progress"] = lambda done: progress(done, "resampling")
            result = resample(volume, self.method, nan=self.nan, **asked, **grid)
            as_asked = None if stored == "float16" else stored  # which widens where a format lacks it
            output.save(_converted(result, stored), progress, stored=as_asked, nifti2=self.nifti2)
        output.tell_volume(result)

    def _check_convention(self) -> None:
        """Raises UsageError for what is said of a matrix that is not there, or that does not ask for it."""
        from filterlab.io.affines import CONVENTIONS

        check_name("convention", self.convention, CONVENTIONS)
        about = {"--convention": self.convention != "world", "--inverse": self.inverse}
        flirt = {"--flirt-in": self.flirt_in is not None, "--flirt-ref": self.flirt_ref is not None}
        if self.affine is None and (given := [name for name, there in (about | flirt).items() if there]):
            raise UsageError(f"expected --affine FILE with {given[0]}; got none")
        if self.convention != "fsl" and any(flirt.values()):
            raise UsageError(f"expected --convention fsl with --flirt-in and --flirt-ref; got {self.convention}")

    def _affine(self, source: VolumeHeader, target: VolumeHeader | None) -> np.ndarray | None:
        """The matrix that moves IN; None: there is none."""
        from filterlab.io.affines import load_affine
        from filterlab.io.volumes import describe

        if self.affine is None:
            return None
        moved, onto = (self.flirt_ref, self.flirt_in) if self.inverse else (self.flirt_in, self.flirt_ref)
        if self.convention == "fsl" and onto is None and target is None:
            raise UsageError(f"expected --like or --flirt-{'in' if self.inverse else 'ref'} with --convention fsl")
        volume = source if moved is None else describe(moved)
        onto_grid = (target or source) if onto is None else describe(onto)
        return load_affine(self.affine, self.convention, volume=volume, target=onto_grid, inverse=self.inverse)

    def _new_size(self, source: VolumeHeader, target: VolumeHeader | None) -> list[float]:
        """Voxels along x, y, z of the result; checks what was asked."""
        if target is not None:
            return list(target.size)
        if self.shape is not None:
            if min(self.shape) < 1:
                raise ValueError(f"expected --shape of 1 or more voxels along every axis; got {self.shape}")
            return [as_float(n) for n in self.shape]
        if self.spacing is None:
            return list(source.size)
        if not all(math.isfinite(s) and s > 0 for s in self.spacing):
            raise ValueError(f"expected a --spacing of positive numbers; got {self.spacing}")
        return [max(1.0, n * s / t) for n, s, t in zip(source.size, source.spacing, self.spacing, strict=True)]


def _working_type(stored: str | None, source: VolumeHeader) -> torch.dtype:
    """What is computed in: float64 where that comes in or goes out, or wide integers do."""
    import torch

    wide = ("float64", "int32", "uint32", "int64", "uint64")
    if source.dtype == torch.float64 or stored == "float64":
        return torch.float64
    return torch.float64 if source.stored in wide and stored != "float32" else torch.float32


def _tell_labels(volume: Volume, source: VolumeHeader, path: Path) -> None:
    """Warns of a volume whose values are likely to be names, between which nothing lies."""
    from filterlab.labels import look_like_labels

    if source.fields.get("intent") == "labels" or look_like_labels(volume.samples):
        what = "its values look like labels, and are mixed like amounts; --labels or --method nearest keeps them"
        tell(f"{path}: {what}")


def _converted(volume: Volume, stored: str | None) -> Volume:
    """The volume in a type that holds what is stored; integers are rounded, and clipped to what that holds."""
    import numpy as np
    import torch

    from filterlab.io.bounded import SAMPLE_TYPES

    if stored is None or not volume.dtype.is_floating_point:  # integers are written as they are, or refused
        return volume
    dtype = getattr(torch, SAMPLE_TYPES[stored])
    if dtype.is_floating_point:
        return volume.to(dtype)
    least, most = int(np.iinfo(stored).min), min(int(np.iinfo(stored).max), torch.iinfo(dtype).max)
    samples = volume.samples.round().clamp(least, most)
    top = samples >= float(most)  # the largest int64 is no float: converting it would wrap round
    return type(volume).with_geometry(samples.to(dtype).masked_fill(top, most), volume.geometry)
