"""Section of `hit_error`: errors of hit distance and normal, and their fitted orders beside declared ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.page import Block, Column, Plot, Section, Table
from experiments.report.rms_error import Errors, curves, of_study, recipes
from experiments.report.style import MISSING, fixed, label, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.hit_error import Config, Study

LEAD = (
    "Each signal is sampled at cell centres on cubic grids and reconstructed; the same rays are cast at a level set of "
    "the reconstruction and at that of the signal, whose own hits are found by dense samples and bisection. Distances "
    "are along the rays in world units, normals are compared by angle. An error of value of order L moves hits by that "
    "order, and normals by one less; normals from central differences have order 2 at most.",
    "marching-cubes is the mesh of the same samples: vertices by linear interpolation along the grid's edges, flat "
    "triangles between, normals of central differences interpolated over them.",
)


def draw(config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    parts = [_study(config, study, i, records) for i, study in enumerate(config.studies)]
    return Section("Error of hits and normals against resolution", LEAD, (), parts)


def _study(config: Config, study: Study, index: int, records: Mapping[str, Record]) -> Section:
    errors, fits = of_study(index, records)
    blocks: list[Block] = []
    if errors:
        blocks += [_curves(config, study, index, errors), _numbers(study, errors)]
        if any(r["elsewhere"] for r in errors.values()):
            blocks.append(_elsewhere(study, errors))
    if fits:
        blocks.append(_orders(fits))
    return Section(f"{study.signal.label}, level {study.level:g}", (), blocks)


def _curves(config: Config, study: Study, index: int, errors: Errors) -> Plot:
    titles = {
        "distance_rms": "RMS error of the hit's distance",
        "normal_rms": "RMS angle of the normal, radians",
    }
    drawn = curves(study, errors, titles, f"hits-{index}")
    some = next(iter(errors.values()))
    caption = (
        f"Level {study.level:g} of {study.signal.label}, boundary {config.boundary}, float64; {some['rays']:,} rays "
        f"from where they enter the box shrunk to {study.inner:g}. {some['left_out']:,} others hit the surface at less "
        f"than 17° or where the signal's gradient has less than {study.regular:g} of its largest length: left out. "
        "Left: distance. Right: normal."
    )
    if any(not r["default_gradient"] for r in errors.values()):
        caption += " Dotted, with wide rings: another kind of gradient than the method's own, with the same hits."
    return Plot(drawn, caption)


def _numbers(study: Study, errors: Errors) -> Table:
    quantities = {"distance": "distance_rms", "normal": "normal_rms"}
    columns = [Column("method", numeric=False)]
    for title in quantities:
        columns += [Column(title if i == 0 else "", f"{n}³") for i, n in enumerate(study.resolutions)]
    rows = []
    for name, found in _by_resolution(study, errors):
        rows.append([name, *(text(r[key]) if r else MISSING for key in quantities.values() for r in found)])
    caption = "RMS errors of distance (world units) and normal (radians)."
    if any(r["elsewhere"] for r in errors.values()):
        caption += " Rays whose hit is elsewhere are left out: they are counted below."
    return Table(columns, rows, caption)


def _elsewhere(study: Study, errors: Errors) -> Table:
    columns = [Column("method", numeric=False), *(Column(f"{n}³") for n in study.resolutions)]
    rows = [
        [name, *(f"{r['elsewhere']:,}" if r else MISSING for r in found)]
        for name, found in _by_resolution(study, errors)
    ]
    caption = "Rays that hit nothing within two voxels of the signal's hit: another piece of surface, or none."
    return Table(columns, rows, caption)


def _by_resolution(study: Study, errors: Errors) -> list[tuple[str, list[Record | None]]]:
    """What each recipe is called, and its records at the study's resolutions."""
    found = [[errors.get((recipe, n)) for n in study.resolutions] for recipe in recipes(errors)]
    return [(label(next(r for r in records if r)), records) for records in found]


def _orders(fits: list[Record]) -> Table:
    columns = [
        Column("method", numeric=False),
        Column("distance", "declared order"),
        Column("", "fitted"),
        Column("", "difference"),
        Column("normal", "declared order"),
        Column("", "fitted"),
        Column("", "difference"),
        Column("gradient", numeric=False),
    ]
    rows = []
    for fit in fits:
        cells = [label(fit)]
        for quantity in ("distance", "normal"):
            declared, found = fit[f"declared_{quantity}"], fit[f"{quantity}_order"]
            cells += [str(declared), fixed(found), fixed(None if found is None else found - declared)]
        rows.append([*cells, fit["gradient"]])
    used = ", ".join(map(str, fits[0]["resolutions"]))
    caption = (
        f"Orders fitted by least squares to the resolutions {used}. An order shows where the signal is resolved well; "
        "what is declared is the least that a method has for every signal: some have more."
    )
    return Table(columns, rows, caption)
