"""Section of `dvr_signal`: the signal and every method side by side, their differences, and the numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.page import Block, Column, Gallery, Section, Table, picture
from experiments.report.style import MISSING, fixed, label, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.dvr_signal import Config

LEAD = (
    "The first image is the signal itself, rendered without any sampling of it. The others are reconstructed from its "
    "samples and rendered by the same marcher with the same camera, step and transfer function: what differs is the "
    "reconstruction of value and gradient.",
)


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    truth = next((r for r in records.values() if r["kind"] == "signal"), None)
    methods = [records[r.key] for r in config.methods if r.key in records]
    blocks: list[Block] = []
    if truth is not None:
        blocks.append(_images(config, truth, methods, folder))
    if methods:
        blocks += [_differences(config, methods, folder), _numbers(config, methods)]
    return Section(f"Rendering a known signal: {config.signal.label} at {config.resolution}³", LEAD, blocks)


def _images(config: Config, truth: Record, methods: Sequence[Record], folder: Path) -> Gallery:
    pictures = [picture(folder, truth["image"], f"{config.signal.name} itself", "ground truth")]
    pictures += [picture(folder, r["image"], label(r), quality(r)) for r in methods]
    caption = (
        f"{config.signal.label}, sampled at {config.resolution}³ cell centres, boundary {config.boundary}; "
        f"{_view(config)}. PSNR and SSIM against the image of the signal itself, both as displayed (sRGB)."
    )
    return Gallery(pictures, caption, columns=3)


def _view(config: Config) -> str:
    width, height = config.view.size
    return f"{width} × {height} pixels, step {config.view.step:g} voxels, {config.dtype}"


def quality(record: Record) -> str:
    """How near an image is to the one it is compared with."""
    psnr = MISSING if record["psnr"] is None else f"{fixed(record['psnr'], 1)} dB"
    return f"{psnr} · SSIM {fixed(record['ssim'], 3)}"


def _differences(config: Config, methods: Sequence[Record], folder: Path) -> Gallery:
    pictures = [picture(folder, r["difference"], label(r), quality(r)) for r in methods]
    caption = (
        f"Absolute differences to the image of the signal itself, as displayed, amplified {config.amplify:g} times; "
        "black is no difference, and what exceeds white is cut off."
    )
    return Gallery(pictures, caption, columns=3)


def _numbers(config: Config, methods: Sequence[Record]) -> Table:
    columns = [
        Column("method", numeric=False),
        Column("PSNR", "dB"),
        Column("SSIM"),
        Column("RMS", "of 1"),
        Column("largest", "of 1"),
        Column("build", "s"),
        Column("render", "s"),
    ]
    rows = [
        [
            label(r),
            fixed(r["psnr"]),
            fixed(r["ssim"], 4),
            text(r["rms"]),
            text(r["max"]),
            fixed(r["build_seconds"]),
            fixed(r["render_seconds"]),
        ]
        for r in methods
    ]
    caption = (
        "Image errors against the image of the signal itself (displayed values from 0 to 1), and wall-clock seconds to "
        f"build the field and to render it on {config.device}; times depend on what else ran."
    )
    return Table(columns, rows, caption)
