"""Section of `speed_accuracy`: what is worth its cost, what the paper says, and what schemes and precisions do."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.claims import claims_table
from experiments.report.page import Block, Column, Gallery, Section, Table, picture
from experiments.report.style import MISSING, fixed, label, memory, text, times
from experiments.report.trade_plots import (
    fronts_plot,
    images_plot,
    memory_plot,
    precision_plot,
    same_method,
    schemes_plot,
)
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.speed_accuracy import Config

USUAL = "trilinear+central"
QUANTITIES = {"value_rms": "value", "gradient_rms": "gradient"}


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    middle = config.sizes[len(config.sizes) // 2]
    blocks: list[Block] = []
    if f"cost/{middle}/gradient-rays" in records:
        blocks += _overview(config, records, 0, middle)
    parts = [
        _paper(config, records),
        *(_fronts(config, records, i) for i in range(len(config.subjects))),
        *(_images(config, records, i, folder) for i in range(len(config.subjects))),
        _schemes(config, records, middle),
        _precision(config, records),
    ]
    title = "Speed against accuracy"
    return Section(
        title,
        [*_lead(config), *_in_short(config, records, middle)],
        blocks,
        [p for p in parts if p.blocks or p.sections],
    )


def _lead(config: Config) -> list[str]:
    names = " and ".join(s.label for s in config.subjects)
    return [
        f"{len(config.methods)} methods in {len(config.variants)} variants (scheme, arithmetic, storage), at "
        f"{', '.join(f'{n}³' for n in config.sizes)}, are compared with {_known(config, names)}. A candidate is worth "
        "its cost, on the front, where nobody who costs less is as accurate (by 2 %).",
        f"All candidates of one resolution are timed in turn, round after round ({config.timed_by}): medians over "
        "rounds, ratios within rounds. Points lie along slanted parallel rays, half a voxel apart, unless said "
        "otherwise.",
    ]


def _known(config: Config, names: str) -> str:
    if config.volume is None:
        return f"the signals {names}, which are known exactly"
    return (
        f"{names}: the low-passed scan, by its quintic B-spline, is what is true of a cube of every second voxel of "
        "it. Values are in parts of the range of the cube, lengths in voxels of the scan"
    )


def _in_short(config: Config, records: Mapping[str, Record], n: int) -> list[str]:
    """The front of the gradient of the first signal, and how many claims hold, in words."""
    said, costs = [], _costs(records, n, "gradient-rays")
    members = [k for k in _in_order(records, 0, n) if "gradient" in _on_front(records, 0, n)[k]]
    if members:
        listed = "; ".join(
            f"{name(config, costs[k])} for {fixed(costs[k]['ns_per_sample'][1], 1)} ns "
            f"({text(records[f'error/0/{n}/{k}']['gradient_rms'])})"
            for k in members
        )
        said.append(
            f"In short, {config.subjects[0].label} at {n}³: worth their cost for value and gradient (RMS error "
            f"of the gradient) are {listed}."
        )
    claims = [c["verdict"] for c in records.get("claims", {}).get("claims", ())]
    if claims:
        holds, partly, fails = (claims.count(v) for v in ("holds", "in part", "does not hold"))
        said.append(
            f"Of {len(claims)} claims of the paper about cost and quality {holds} hold on this machine, {partly} do in "
            f"part, {fails} do not."
        )
    return said


def _costs(records: Mapping[str, Record], n: int, work: str) -> Mapping[str, Record]:
    return records.get(f"cost/{n}/{work}", {}).get("costs", {})


def name(config: Config, record: Record, *, gradient: bool = True) -> str:
    """A candidate in words: method, and variant where it is not the first one."""
    method = label({**record, "sampler": "exact"}, gradient=gradient)
    return method if record["variant"] == config.variants[0].name else f"{method}, {record['variant']}"


def _on_front(records: Mapping[str, Record], index: int, n: int) -> dict[str, list[str]]:
    """Candidate -> the quantities of whose front against time it is at that resolution."""
    found: dict[str, list[str]] = {}
    for f in records.get(f"front/{index}", {}).get("fronts", ()):
        if f["cost"] == "time" and f["resolution"] == n and f["error"] in QUANTITIES:
            for member in f["members"]:
                found.setdefault(member.partition("/")[2], []).append(QUANTITIES[f["error"]])
    return found


def _overview(config: Config, records: Mapping[str, Record], index: int, n: int) -> list[Block]:
    """Every method in the first variant, and the fronts that it is on in any."""
    costs = _costs(records, n, "gradient-rays")
    first = [k for k, r in costs.items() if r["variant"] == config.variants[0].name]
    if not first:
        return []
    caption = (
        f"At a glance: {config.subjects[index].label} at {n}³, {config.variants[0].name}, fastest scheme. "
        "Gradients are per world unit, timed together with the value; angles where the gradient is longer than 1 % of "
        "the longest. Last column: the fronts of error against time that the method is on, and in which precision "
        "where it is another."
    )
    table = _table(config, records, index, [(n, k) for k in first], caption)
    build = [column.title for column in table.columns].index("build")
    fronts = _on_front(records, index, n)
    rows = []
    for key, row in zip(first, table.rows, strict=True):
        own = {k: costs[k]["variant"] for k in fronts if same_method(costs[k], costs[key])}
        said = [f"{q}{'' if k == key else f' ({v})'}" for k, v in own.items() for q in fronts[k]]
        rows.append([*row[:build], ", ".join(said) or MISSING])
    return [replace(table, columns=[*table.columns[:build], table.columns[-1]], rows=rows)]


def _table(
    config: Config, records: Mapping[str, Record], index: int, chosen: Sequence[tuple[int, str]], caption: str
) -> Table:
    columns = [
        Column("method", numeric=False),
        Column("value", "ns"),
        Column("and gradient", "ns"),
        Column("", "÷ usual"),
        Column("value", "RMS"),
        Column("gradient", "RMS"),
        Column("angle", "mean, °"),
        Column("memory"),
        Column("build", "ms"),
        Column("on the front of", numeric=False),
    ]
    several = len({n for n, _ in chosen}) > 1
    rows, last = [], None
    for n, key in chosen:
        cells = _row(config, records, index, n, key)
        rows.append([f"{n}³" if n != last else "", *cells] if several else cells)
        last = n
    return Table([Column("", numeric=False), *columns] if several else columns, rows, caption, wrapped=True)


def _row(config: Config, records: Mapping[str, Record], index: int, n: int, key: str) -> list[str]:
    value, both = _costs(records, n, "value-rays")[key], _costs(records, n, "gradient-rays")[key]
    usual = _costs(records, n, "gradient-rays").get(USUAL)
    error = records.get(f"error/{index}/{n}/{key}", {})
    share = both["ns_per_sample"][1] / usual["ns_per_sample"][1] if usual else None
    return [
        name(config, both),
        fixed(value["ns_per_sample"][1], 1),
        fixed(both["ns_per_sample"][1], 1),
        times(share),
        text(error.get("value_rms")),
        text(error.get("gradient_rms")),
        text(error.get("angle_mean"), 2),
        memory(both["bytes"]),
        text(1e3 * both["build_seconds"][1], 2),
        _both(_on_front(records, index, n).get(key, ())),
    ]


def _both(quantities: Sequence[str]) -> str:
    return "both" if len(quantities) == len(QUANTITIES) else ", ".join(quantities) or MISSING


def _paper(config: Config, records: Mapping[str, Record]) -> Section:
    found = records.get("claims", {}).get("claims", [])
    lead = (
        "Csébfalvi, One Step Further Beyond Trilinear Interpolation and Central Differences: what it says about cost "
        "was measured on a GPU (GeForce GT 720M) in frames per second, where a texture unit gives trilinear samples. "
        "Here every sentence is a ratio with a limit, on this machine.",
    )
    return Section(
        "What the paper says, and what holds here", lead, [claims_table(found, config.sizes)] if found else []
    )


def _fronts(config: Config, records: Mapping[str, Record], index: int) -> Section:
    front = records.get(f"front/{index}")
    if front is None:
        return Section("")
    blocks: list[Block] = [fronts_plot(config, records, index, name)]
    chosen = [(n, key) for n in config.sizes for key in _in_order(records, index, n)]
    caption = (
        "The members of the fronts of error against time, cheapest first. ÷ usual: time of value and gradient in units "
        "of trilinear interpolation with central differences. Build: prefilter and padding."
    )
    blocks += [_table(config, records, index, chosen, caption), memory_plot(config, records, index, name)]
    return Section(f"The front: {config.subjects[index].label}", (), blocks)


def _in_order(records: Mapping[str, Record], index: int, n: int) -> list[str]:
    costs = _costs(records, n, "gradient-rays")
    return sorted(_on_front(records, index, n), key=lambda key: costs[key]["ns_per_sample"][1])


def _images(config: Config, records: Mapping[str, Record], index: int, folder: Path) -> Section:
    studies = [r for r in records.values() if r["kind"] == "images" and r["source"] == index]
    if not studies:
        return Section("")
    source = config.subjects[index]
    assert source.view is not None
    blocks: list[Block] = [images_plot(config, records, index, studies)]
    width, height = source.view.size
    shown = [(r, e) for r in studies for e in r["entries"] if "image" in e]
    truth = records.get(f"truth/{index}")
    if shown and truth is not None:
        blocks += _galleries(config, truth, shown, folder)
    blocks += [_image_table(config, r) for r in studies if len(config.studies[r["study"]].steps) == 1]
    lead = (
        f"{width} × {height} pixels, compared as displayed (sRGB) with an image of the signal itself of "
        f"{config.finest} samples across its box. An image is wrong because of its reconstruction and because of its "
        "step; where the step decides, a better method buys nothing.",
    )
    return Section(f"Images: {source.label}", lead, blocks)


def _galleries(config: Config, truth: Record, shown: Sequence[tuple[Record, Record]], folder: Path) -> list[Block]:
    n, step = shown[0][0]["resolution"], shown[0][1]["step"]
    pictures = [picture(folder, truth["image"], "the signal itself", f"{config.finest} samples across")]
    for _, entry in shown:
        detail = f"{_decibels(entry)} · SSIM {fixed(entry['ssim'], 3)} · {text(entry['milliseconds'][1], 2)} ms"
        pictures.append(picture(folder, entry["image"], label(entry), detail))
    differences = [picture(folder, e["difference"], label(e), _decibels(e)) for _, e in shown]
    amplified = f"Differences from the signal's own image, amplified {config.amplify:g} times; black is none."
    return [
        Gallery(pictures, f"At {n}³ with a step of {step:g} voxels.", columns=3),
        Gallery(differences, amplified, columns=4),
    ]


def _decibels(entry: Record) -> str:
    return MISSING if entry["psnr"] is None else f"{fixed(entry['psnr'], 1)} dB"


def _image_table(config: Config, record: Record) -> Table:
    columns = [
        Column("method", numeric=False),
        Column("PSNR", "dB"),
        Column("SSIM"),
        Column("largest", "of 1"),
        Column("time", "ms"),
        Column("quartiles", "ms"),
    ]
    rows = []
    for e in record["entries"]:
        low, median, high = (text(t, 3) for t in e["milliseconds"])
        how = [e["scheme"].replace("_", " ")] * (e["scheme"] != "default") + [e["storage"]] * (
            e["storage"] != "default"
        )
        cells = [fixed(e["psnr"], 2), fixed(e["ssim"], 4), text(e["max"], 2), median, f"{low} … {high}"]
        rows.append([", ".join([label(e), *how]), *cells])
    study = config.studies[record["study"]]
    caption = f"{study.title.capitalize()}: images at {record['resolution']}³, step {study.steps[0]:g} (voxels)."
    return Table(columns, rows, caption)


def _schemes(config: Config, records: Mapping[str, Record], n: int) -> Section:
    costs = _costs(records, n, "gradient-rays")
    if len({r["scheme"] for r in costs.values()}) < 2:
        return Section("")
    lead = (
        "The eight-trilinear scheme trades 27 taps for eight samples that a texture unit gives at the price of one "
        "each. Where trilinear samples are computed, each costs eight taps, and the scheme loses: it reads 64 numbers "
        "in place of 27. Sums over taps in compiled code (fused, the default) are what this machine wants.",
    )
    return Section("Schemes", lead, [schemes_plot(config, records, n), _scheme_table(config, records, n)])


def _scheme_table(config: Config, records: Mapping[str, Record], n: int) -> Table:
    of: Callable[[str], bool] = lambda v: next(x for x in config.variants if x.name == v).storage is None  # noqa: E731
    costs = _costs(records, n, "gradient-rays")
    variants = [v for v in dict.fromkeys(r["variant"] for r in costs.values()) if of(v)]
    columns = [Column("method", numeric=False), *(Column(v, "ns") for v in variants)]
    rows = []
    for recipe in config.methods:
        own = {r["variant"]: r for r in costs.values() if same_method(r, recipe.record())}
        cells = [fixed(own[v]["ns_per_sample"][1], 1) if v in own else MISSING for v in variants]
        rows.append([label(recipe.record()), *cells])
    caption = f"Nanoseconds per value and gradient at {n}³, points along rays. A dash: the method does not offer it."
    return Table(columns, rows, caption)


def _precision(config: Config, records: Mapping[str, Record]) -> Section:
    plot = precision_plot(config, records)
    lead = (
        "Storage rounds every coefficient once; arithmetic stays in float32 (float64: samples, points and arithmetic). "
        "Shorter storage always saves memory. It saves time only where reading takes most of it, because stored "
        "numbers must be widened before they are summed.",
    )
    return Section("Precision", lead, [] if plot is None else [plot])
