"""Pictures that a command writes: one, an animation, or a folder of them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from torch import Tensor


class Pictures(Protocol):
    """Pictures (H, W, 3), linear RGB, made when they are asked for, so many of them."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Tensor]: ...


def write_pictures(pictures: Pictures, output: Path, *, moving: bool, seconds: float) -> None:
    """The first one, or all of them where they move: as GIF or animated PNG, or numbered in a folder."""
    from filterlab.io.atomic import atomic_folder
    from filterlab.io.images import save_animation, save_image

    if not moving:
        save_image(next(iter(pictures)), output)
    elif output.suffix:
        save_animation(pictures, output, seconds=seconds)
    else:
        with atomic_folder(output) as folder:
            for k, picture in enumerate(pictures):
                save_image(picture, folder / f"{k:0{max(3, len(str(len(pictures) - 1)))}d}.png")
