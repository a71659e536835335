"""Section of `terrain_views`: every place, seen in all its ways."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.page import Gallery, Section, picture
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.terrain_views import Config, Place

LEAD = (
    "Quartic splines of elevation models, hit exactly: no mesh, no levels of detail. Tints go from the lowest height "
    "of each map to its highest.",
)


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    parts = [
        _place(place, [r for r in records.values() if r["place"] == i], folder) for i, place in enumerate(config.places)
    ]
    return Section("Terrains", LEAD, (), parts)


def _place(place: Place, records: Sequence[Record], folder: Path) -> Section:
    if absent := next((r for r in records if r["kind"] == "absent"), None):
        return Section(place.title, (f"Skipped: there is no file {absent['file']} here.",))
    pictures = [picture(folder, r["image"], _name(place, r), _detail(r)) for r in records]
    return Section(place.title, (), [Gallery(pictures, _caption(records[0]), columns=2)] if records else ())


def _name(place: Place, record: Record) -> str:
    view = place.views[record["view"]]
    return view.title if view.flight is None else f"{view.title}, {record['frame'] + 1} of {view.frames}"


def _detail(record: Record) -> str:
    high = f"{record['exaggeration']:g} times as high as it is" if record["exaggeration"] != 1 else "as high as it is"
    return f"{high}; {record['seconds']:.1f} s"


def _caption(record: Record) -> str:
    (columns, rows), (across, down), (low, high) = (record[name] for name in ("size", "kilometres", "span"))
    missing = f", {record['missing']:,} of them missing" if record["missing"] else ""
    return (
        f"{columns} × {rows} heights{missing}, {across:.3g} × {down:.3g} km; {low:.0f} … {high:.0f} m but for half a "
        "percent at either end. Wall-clock seconds on the CPU depend on what else ran."
    )
