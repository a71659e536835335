"""Section of `dvr_volume`: whole view and zooms of a scan, every method at the same size, and times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.dvr_signal import quality
from experiments.report.page import Block, Column, Gallery, Section, Table, picture
from experiments.report.style import MISSING, fixed, label
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.dvr_volume import Config

LEAD = (
    "A scan has no ground truth; look for staircases along smooth surfaces (postaliasing) and for detail that is gone "
    "(smoothing). All images share camera, step, transfer function and lights.",
)


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    blocks: list[Block] = []
    for name in config.windows:
        found = [records[f"{r.key}/{name}"] for r in config.methods if f"{r.key}/{name}" in records]
        if found:
            blocks.append(_gallery(config, name, found, folder))
            blocks += _differences(config, found, folder)
    if records:
        blocks.append(_times(config, records))
    return Section(f"Rendering a scan: {_name(config)}", LEAD, blocks)


def _name(config: Config) -> str:
    return config.volume.file.rpartition("/")[2].rpartition(":")[2]


def _gallery(config: Config, name: str, records: Sequence[Record], folder: Path) -> Gallery:
    window = config.windows[name]
    boxes = [z.window for z in config.zooms] if window is None else ()
    pictures = [picture(folder, r["image"], label(r), f"{r['render_seconds']:.1f} s", boxes) for r in records]
    width, height = config.view.size
    settings = f"{width} × {height} pixels, step {config.view.step:g} voxels, boundary {config.boundary}"
    if window is None:
        frames = " Frames mark what is magnified below." if boxes else ""
        caption = f"The whole view of {_name(config)}; {settings}.{frames}"
    else:
        zoom = next(z for z in config.zooms if z.window == window)
        factor = 1 / (window[2] - window[0])
        caption = f"{zoom.title}, magnified {factor:.3g} times by rendering (not by enlarging an image)."
    return Gallery(pictures, caption, columns=3 if len(pictures) > 4 else 2)


def _differences(config: Config, records: Sequence[Record], folder: Path) -> list[Block]:
    """Where the images are not that of the reference."""
    others = [r for r in records if "difference" in r]
    if not others:
        return []
    pictures = [picture(folder, r["difference"], label(r), quality(r)) for r in others]
    caption = (
        f"Absolute differences to the image of {config.reference}, as displayed, amplified {config.amplify:g} times; "
        "black is no difference. Which of two is nearer to the object, they do not tell."
    )
    return [Gallery(pictures, caption, columns=3 if len(pictures) > 4 else 2)]


def _times(config: Config, records: Mapping[str, Record]) -> Table:
    names = list(config.windows)
    titles = ["whole view", *(zoom.title for zoom in config.zooms)]
    columns = [Column("method", numeric=False), Column("build", "s"), *(Column(title, "s") for title in titles)]
    rows = []
    for recipe in config.methods:
        found = {name: records[f"{recipe.key}/{name}"] for name in names if f"{recipe.key}/{name}" in records}
        if not found:
            continue
        first = next(iter(found.values()))
        times = [fixed(found[n]["render_seconds"], 1) if n in found else MISSING for n in names]
        rows.append([label(first), fixed(first["build_seconds"]), *times])
    caption = (
        f"Wall-clock seconds on {config.device}, without what is compiled at a first image; they depend on what else "
        "ran."
    )
    return Table(columns, rows, caption)
