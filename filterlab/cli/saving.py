"""The file that a command writes: checked before the work, told of when it stands."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from filterlab.cli.options import check_not_input
from filterlab.cli.terminal import tell

if TYPE_CHECKING:
    from filterlab.io.bounded import VolumeHeader
    from filterlab.volume import Volume


@dataclass(frozen=True)
class OutputFile:
    """Where a command writes to.

    Attributes:
        replaces: whether there is a file of that name, which the new one takes the place of.
        began: when the command did, in seconds of the clock that only goes forward.
        quiet: nothing is said of success.
    """

    path: Path
    replaces: bool
    began: float
    quiet: bool

    @classmethod
    def folder(cls, path: Path, *sources: Path | None, quiet: bool = False) -> OutputFile:
        """A folder of files that is new, or empty; raises as `at` does."""
        from filterlab.io.atomic import check_new_folder

        check_new_folder(path)
        return cls._apart(path, sources, False, quiet)

    @classmethod
    def at(cls, path: Path, *sources: Path | None, quiet: bool = False) -> OutputFile:
        """The file, once it is known that it can be written and is none of the sources.

        Raises:
            OSError: no file can be there. ValueError: it is a source.
        """
        from filterlab.io.atomic import check_writable

        check_writable(path)
        return cls._apart(path, sources, path.exists(), quiet)

    @classmethod
    def _apart(cls, path: Path, sources: Sequence[Path | None], replaces: bool, quiet: bool) -> OutputFile:
        for source in sources:
            if source is not None:
                check_not_input(path, source)
        return cls(path, replaces, time.perf_counter(), quiet)

    def tell(self, what: str) -> None:
        """Says in one line that it stands, what is in it, and how long that took."""
        if not self.quiet:
            verb = "replaced" if self.replaces else "wrote"
            tell(f"{verb} {self.path}: {what}, {_duration(time.perf_counter() - self.began)}")

    def save(
        self,
        volume: Volume,
        progress: Callable[[float, str], None],
        *,
        stored: str | None = None,
        nifti2: bool = False,
    ) -> None:
        """Writes a volume, as `save_volume` does; tells how far it is."""
        from filterlab.io.volumes import save_volume
        from filterlab.io.watching import watched

        with watched(lambda done: progress(done, "writing")):
            save_volume(volume, self.path, stored=stored, nifti2=nifti2)

    def tell_volume(self, volume: Volume, nifti2: bool = False) -> None:
        """Says of a volume that was saved what of it the file does not hold, and what its header says."""
        from filterlab.io.volumes import describe

        tell_rounding(volume, self.path, nifti2)
        if not self.quiet:
            self.tell(_contents(describe(self.path)))


def _contents(header: VolumeHeader) -> str:
    """`64 × 64 × 32 voxels of 0.5 × 0.5 × 1 mm, float32`."""
    size, edges, batch = (" × ".join(f"{n:.6g}" for n in v) for v in (header.size, header.spacing, header.shape[:-3]))
    volumes = f"{batch} volumes of " if batch else ""
    unit = f" {header.world.unit}" if header.world.unit else ""
    return f"{volumes}{size} voxels of {edges}{unit}, {header.stored}"


def _duration(seconds: float) -> str:
    minutes = int(seconds) // 60
    return f"{minutes} min {seconds - 60 * minutes:.0f} s" if minutes else f"{seconds:.1f} s"


def tell_rounding(volume: Volume, output: Path, nifti2: bool) -> None:
    """What is lost of the affine, where something is: NIfTI-1 holds it in float32."""
    from filterlab.io import nifti
    from filterlab.io.volumes import format_of

    if format_of(output).name == "NIfTI" and nifti.version_for(volume, nifti2) == 1:
        lost = nifti.rounding(volume.affine)
        if lost > 0:
            what = f"{output}: the affine is rounded to float32, by {lost:.0e} of itself; --nifti2 keeps it"
            tell(what)
