"""The file that a command writes: checked before the work, told of when it stands."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
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

    def tell_volume(self, volume: Volume, source: VolumeHeader | None = None) -> None:
        """Says of a volume that was saved what the file does not hold of it (and of its source's header), and what it
        does."""
        from filterlab.io.volumes import describe

        written = describe(self.path)
        for changed in (*_changed(volume, written), *(_changed_type(source, written) if source else ())):
            tell(f"{self.path}: {changed}")
        if lost := [*_lost(volume, written), *(_lost_of_header(source, written) if source else ())]:
            tell(f"{self.path}: not kept: {', '.join(lost)}")
        if not self.quiet:
            self.tell(_contents(written))


def _changed(volume: Volume, written: VolumeHeader) -> Iterator[str]:
    """What is read back of a volume's place as something else, in sentences."""
    before, after = volume.world, written.world
    if (volume.affine != written.affine).any():
        yield _rounded(volume)
    if before.axes != after.axes and after.axes is not None:
        declared = "nothing was declared of them" if before.space is None else f"{before.space} was declared"
        yield f"{written.format} says that its axes are {after.axes}; {declared}"


def _lost(volume: Volume, written: VolumeHeader) -> Iterator[str]:
    """What is declared of a volume's place and is not in the file."""
    before, after = volume.world, written.world
    if before.space is not None and after.space is None:
        yield f"axes ({before.space})"
    if before.unit is not None and before.unit != after.unit:
        yield f"unit ({before.unit})"
    if before.nifti is not None and after.nifti is None:
        place = "" if before.nifti.to_qform is None else ", which is another place"
        yield f"codes of NIfTI (sform {before.nifti.sform}, qform {before.nifti.qform}{place})"


def _rounded(volume: Volume) -> str:
    from filterlab.io import nifti

    return f"the affine is rounded to float32, by {nifti.rounding(volume.affine):.0e} of itself; --nifti2 keeps it"


_KEPT = {
    *("space", "space dimension", "space directions", "space origin", "spacings", "axis mins", "axis maxs", "kinds"),
    *("centerings", "space units", "units", "endian", "byte skip", "line skip", "data file", "affine from", "file"),
    *("byte order", "offset", "order", "array", "kind", "files", "scaling"),
}
"""Lines of headers that say where the voxels lie and how they are stored: they are kept in other words."""


def _changed_type(source: VolumeHeader, written: VolumeHeader) -> Iterator[str]:
    """That values are stored as another type than they were, and why, in a sentence."""
    if "scaling" in source.fields:
        yield f"its values are scaled, {source.fields['scaling']}, and stored as {written.stored}"
    elif source.stored != written.stored:
        yield f"its type is {written.stored}; {source.path} has {source.stored}"


def _lost_of_header(source: VolumeHeader, written: VolumeHeader) -> list[str]:
    """Names of what else a file said, and the new one does not."""
    return [name for name, text in source.fields.items() if name not in _KEPT and written.fields.get(name) != text]


def _contents(header: VolumeHeader) -> str:
    """`64 × 64 × 32 voxels of 0.5 × 0.5 × 1 mm, float32`."""
    size, edges, batch = (" × ".join(f"{n:.6g}" for n in v) for v in (header.size, header.spacing, header.shape[:-3]))
    volumes = f"{batch} volumes of " if batch else ""
    unit = f" {header.world.unit}" if header.world.unit else ""
    return f"{volumes}{size} voxels of {edges}{unit}, {header.stored}"


def _duration(seconds: float) -> str:
    minutes = int(seconds) // 60
    return f"{minutes} min {seconds - 60 * minutes:.0f} s" if minutes else f"{seconds:.1f} s"
