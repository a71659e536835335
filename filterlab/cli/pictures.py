"""Pictures that a command makes of a scene and writes: one, an animation, or a folder of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from filterlab.cli.loading import Progress, reading
from filterlab.cli.outcome import UsageError
from filterlab.cli.saving import OutputFile
from filterlab.cli.terminal import progress_bar, show

if TYPE_CHECKING:
    from torch import Tensor

    from filterlab.scenes.build import AnyPrepared
    from filterlab.scenes.flight import Flight
    from filterlab.scenes.model import Scene
    from filterlab.volume import Volume


@dataclass(frozen=True)
class Filmed:
    """How many pictures are made of a scene, and from where.

    Attributes:
        frames: so many, a whole turn; None: one picture.
        path: of a flight, instead of a turn.

    Raises:
        UsageError: a path without a number of pictures, or fewer than two of them.
    """

    frames: int | None = None
    path: Path | None = None

    def __post_init__(self) -> None:
        if self.path is not None and self.frames is None:
            raise UsageError("expected --frames N with --path: how many pictures the flight has")
        if self.frames is not None and self.frames < 2:
            raise UsageError(f"expected at least 2 pictures of a turn or a flight; got {self.frames}")

    def output(self, output: Path, *sources: Path | None, quiet: bool) -> OutputFile:
        """The file or folder, once it is known that it can be written. Raises as `OutputFile.at`, ValueError."""
        from filterlab.io.picture_formats import ANIMATIONS, PICTURES, format_of

        if self.frames is not None and not output.suffix:
            return OutputFile.folder(output, *sources, self.path, quiet=quiet)
        format_of(output, PICTURES if self.frames is None else ANIMATIONS)
        return OutputFile.at(output, *sources, self.path, quiet=quiet)

    def make(self, scene: Scene, volume: Volume | None, output: OutputFile | None, quiet: bool) -> None:
        """Writes the pictures, or shows what they would take where there is no output."""
        flight = self._checked(scene)
        with progress_bar(quiet) as progress:
            with reading(progress):
                views = self._views(scene, volume, flight)
            if output is not None:
                pictures = _Pictures(views, progress)
                self._write(pictures, output.path, flight)
        if output is None:
            _explain(views)
        else:
            output.tell(pictures.told)  # pyright: ignore[reportPossiblyUnboundVariable]

    def _checked(self, scene: Scene) -> Flight | None:
        """The flight, if there is one. Raises ValueError for a scene that has no such views, before it is built."""
        from filterlab.scenes.flight import check_flight, load_flight
        from filterlab.scenes.turntable import check_turn

        if self.frames is None:
            return None
        if self.path is None:
            check_turn(scene, self.frames)
            return None
        check_flight(scene)
        return load_flight(self.path)

    def _views(self, scene: Scene, volume: Volume | None, flight: Flight | None) -> list[AnyPrepared]:
        from filterlab.scenes.build import build
        from filterlab.scenes.turntable import turntable

        prepared = build(scene, volume)
        if self.frames is None:
            return [prepared]
        return turntable(prepared, self.frames) if flight is None else flight.views(prepared, self.frames)

    def _write(self, pictures: _Pictures, output: Path, flight: Flight | None) -> None:
        """The first one, or all of them where they move: as GIF or animated PNG, or numbered in a folder."""
        from filterlab.io.atomic import atomic_folder
        from filterlab.io.images import save_animation, save_image
        from filterlab.scenes.flight import SECONDS
        from filterlab.scenes.turntable import seconds_of_each

        if self.frames is None:
            save_image(next(iter(pictures)), output)
        elif output.suffix:
            seconds = seconds_of_each(len(pictures)) if flight is None else SECONDS
            save_animation(pictures, output, seconds=seconds)
        else:
            with atomic_folder(output) as folder:
                for k, picture in enumerate(pictures):
                    save_image(picture, folder / f"{k:0{max(3, len(str(len(pictures) - 1)))}d}.png")


def _explain(views: list[AnyPrepared]) -> None:
    from filterlab.scenes.plan import plan
    from filterlab.scenes.plan_report import table

    show(table(plan(views[0]), pictures=len(views)))


@dataclass
class _Pictures:
    """The pictures (H, W, 3) of all views, linear RGB, made one after the other; progress is told of.

    Attributes:
        told: what was made, when it is.
    """

    views: list[AnyPrepared]
    progress: Progress
    told: str = ""

    def __len__(self) -> int:
        return len(self.views)

    def __iter__(self) -> Iterator[Tensor]:
        from filterlab.scenes.build import picture

        count = len(self.views)
        for k, view in enumerate(self.views):
            what = "rendering" if count == 1 else f"rendering {k + 1} of {count}"
            image = picture(view, partial(self._part, k, what))
            many = "" if count == 1 else f"{count} pictures of "
            more = f", {view.told}" if view.told else ""
            self.told = f"{many}{image.shape[1]} × {image.shape[0]} pixels, 8-bit RGB{more}"
            yield image

    def _part(self, k: int, what: str, done: int, total: int) -> None:
        self.progress((k + done / max(total, 1)) / len(self.views), what)
