"""The page: sections of text, figures, tables and images, put into one self-contained HTML file."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from experiments.report.plots import themed_colors
from experiments.runs import Record, run_file

TEMPLATE = "page.html.j2"


@dataclass(frozen=True)
class Plot:
    """An inline SVG with a caption."""

    svg: Markup
    caption: str
    kind: str = "plot"


@dataclass(frozen=True)
class Column:
    """A column of a table: its title, the unit below it, and whether it holds numbers (right-aligned)."""

    title: str
    unit: str = ""
    numeric: bool = True


@dataclass(frozen=True)
class Table:
    """Rows of text cells under columns, with a caption; `wrapped`: cells of words, which break into lines."""

    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]
    caption: str
    wrapped: bool = False
    kind: str = "table"


@dataclass(frozen=True)
class Picture:
    """An image of the run folder: PNG bytes as a data URI, a label and a line of figures below it.

    `boxes` are frames drawn over it: (left, top, right, bottom) in 0 … 1 of the image.
    """

    source: str
    label: str
    detail: str = ""
    boxes: Sequence[Sequence[float]] = ()


@dataclass(frozen=True)
class Gallery:
    """Images side by side, all at the same size."""

    pictures: Sequence[Picture]
    caption: str
    columns: int = 3
    pixelated: bool = False
    kind: str = "gallery"


Block = Plot | Table | Gallery


@dataclass(frozen=True)
class Section:
    """A part of the report: what was asked, how to read the answer, and the answer."""

    title: str
    lead: Sequence[str] = ()
    blocks: Sequence[Block] = ()
    sections: Sequence[Section] = field(default_factory=tuple)


def picture(folder: Path, name: str, label: str, detail: str = "", boxes: Sequence[Sequence[float]] = ()) -> Picture:
    """A picture from an image file that a record names."""
    content = base64.b64encode(run_file(folder, name).read_bytes()).decode()
    return Picture(f"data:image/png;base64,{content}", label, detail, boxes)


def render(
    *,
    title: str,
    config: Any,
    section: Section,
    done: int,
    total: int,
    seconds: float,
    config_text: str,
    starts: Sequence[Record],
) -> str:
    """The HTML of a report."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("experiments", "report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(TEMPLATE).render(
        title=title,
        description=config.description,
        section=section,
        done=done,
        total=total,
        duration=_duration(seconds),
        config_text=config_text,
        provenance=_provenance_table(starts),
        inputs=_inputs_table(starts),
        started=starts[0]["started"].partition("T")[0] if starts else "",
        colors=themed_colors(),
    )


def _duration(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 100 else f"{seconds / 60:.1f} min"


def _provenance_table(starts: Sequence[Mapping[str, Any]]) -> Table:
    """One row for each start, newest last; records name theirs."""
    versions = ("filterlab", "commit", "torch", "numpy", "python", "system")
    names = ("start", "started", *versions, "device", "threads", "seed")
    columns = [Column(name, numeric=False) for name in names]
    rows = [[str(s.get(name) or "–") if s.get(name) != 0 else "0" for name in names] for s in starts]
    return Table(columns, rows, "By what the records were computed: one row for each start of the run.")


def _inputs_table(starts: Sequence[Mapping[str, Any]]) -> Table | None:
    """The files that volumes were read from, the same for every start; None where there are none."""
    inputs = starts[-1].get("inputs") if starts else None
    if not inputs:
        return None
    columns = [Column("file", numeric=False), Column("SHA-256", numeric=False)]
    return Table(columns, [[path, digest] for path, digest in inputs.items()], "From what volumes were read.")
