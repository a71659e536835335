"""Section of `stability`: every promise at the extremes, how many inputs tried to break it, and the worst of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.page import Block, Column, Section, Table
from experiments.report.style import MISSING, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.stability import Config

LEAD = (
    "Each row is a promise: what happens for inputs that break other tools. A check tries many of them, for every "
    "method, scheme, boundary and device that the row is about, and reports the worst error that it found beside what "
    "is allowed. Promises that are kept or broken, and know no error, count the inputs that broke them: 0 are allowed.",
)


def draw(_config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    cases = _by_case(records)
    blocks: list[Block] = [_table(cases)]
    if swept := {key: found for key, found in cases.items() if any(r["method"] for r in found)}:
        blocks.append(_by_method_and_scheme(swept))
    if broken := [r for found in cases.values() for r in found if _verdict(r) == "broken"]:
        blocks.insert(0, _details(broken, "Promises that were broken, with the input that broke them worst."))
    if skipped := [r for found in cases.values() for r in found if r["skipped"]]:
        blocks.append(_details(skipped, "What could not be tried here."))
    tried = [r for found in cases.values() for r in found if not r["skipped"]]
    kept, inputs = sum(r["holds"] for r in tried), sum(r["inputs"] for r in tried)
    summary = f"{kept:,} of {len(tried):,} promises were kept, over {inputs:,} inputs."
    return Section("The extremes: what is promised, and what was found", (summary, *LEAD), blocks)


def _by_case(records: Mapping[str, Record]) -> dict[str, list[Record]]:
    found: dict[str, list[Record]] = {}
    for record in records.values():
        found.setdefault(record["case"], []).append(record)
    return found


def _verdict(record: Record) -> str:
    return "skipped" if record["skipped"] else "kept" if record["holds"] else "broken"


COLUMNS = (
    Column("input", numeric=False),
    Column("promise", numeric=False),
    Column("checked for", numeric=False),
    Column("inputs"),
    Column("worst error"),
    Column("allowed"),
    Column("", numeric=False),
)


def _table(cases: Mapping[str, Sequence[Record]]) -> Table:
    caption = "All promises, in the order of the contract; of errors the one that came nearest to what is allowed."
    return Table(COLUMNS, [_row(found) for found in cases.values()], caption, wrapped=True)


def _by_method_and_scheme(cases: Mapping[str, Sequence[Record]]) -> Table:
    """For every case and method the worst share of what is allowed, a line for each scheme."""
    methods = list(dict.fromkeys(r["method"] for found in cases.values() for r in found if r["method"]))
    columns = [Column("input", numeric=False), Column("scheme", numeric=False), *(Column(m) for m in methods)]
    rows = []
    for found in cases.values():
        schemes = list(dict.fromkeys(r["scheme"] for r in found))
        for scheme in schemes:
            cells = [_cell([r for r in found if (r["method"], r["scheme"]) == (m, scheme)]) for m in methods]
            rows.append([found[0]["title"] if scheme == schemes[0] else "", scheme or "any", *cells])
    caption = (
        "By method and scheme, over all boundaries and devices: the worst error in percent of what is allowed; “kept” "
        f"where nothing but keeping the promise counts, “BROKEN” where it was not; {MISSING} where a method does not "
        "offer the scheme."
    )
    return Table(columns, rows, caption, wrapped=True)


def _cell(found: Sequence[Record]) -> str:
    tried = [r for r in found if not r["skipped"]]
    if not tried:
        return "skipped" if found else MISSING
    if not all(r["holds"] for r in tried):
        return "BROKEN"
    if not any(r["bound"] for r in tried):
        return "kept"
    percent = 100 * max(_share(r) for r in tried)
    return "0" if percent == 0 else "< 0.1 %" if percent < 0.1 else f"{text(percent, 2)} %"


def _row(found: Sequence[Record]) -> list[str]:
    """A case over all that it was checked for; of errors and bounds those of the subject that came nearest to it."""
    tried = [r for r in found if not r["skipped"]]
    first, kept = found[0], sum(r["holds"] for r in tried)
    if not tried:
        return [first["title"], first["contract"], subjects(found), "0", MISSING, MISSING, "skipped"]
    worst = max(tried, key=_share)
    verdict = "kept" if kept == len(tried) else f"BROKEN for {len(tried) - kept} of {len(tried)}"
    inputs = f"{sum(r['inputs'] for r in tried):,}"
    return [first["title"], first["contract"], subjects(tried), inputs, *_numbers(worst), verdict]


def _share(record: Record) -> float:
    """The worst error in units of what is allowed."""
    if record["worst"] is None:
        return float("inf")
    return record["worst"] / record["bound"] if record["bound"] else record["worst"] * 1e300


def _numbers(record: Record) -> tuple[str, str]:
    """Worst and allowed; counts where no error is allowed."""
    if record["worst"] is None:
        return "∞", text(record["bound"]) if record["bound"] else "0"
    if not record["bound"]:
        return f"{record['worst']:g}", "0"
    return text(record["worst"]) if record["worst"] else "0", text(record["bound"])


PARTS = {"method": "methods", "scheme": "schemes", "boundary": "boundaries", "device": "devices"}


def subjects(found: Sequence[Record]) -> str:
    """What a case was checked for, in a few words: `7 methods, 3 schemes, 5 boundaries`."""
    parts = []
    for name, plural in PARTS.items():
        values = {r[name] for r in found if r[name]}
        if len(values) == 1 and name != "device":
            parts.append(next(iter(values)))
        elif len(values) > 1:
            parts.append(f"{len(values)} {plural}")
    return ", ".join(parts) or MISSING


def _details(records: Sequence[Record], caption: str) -> Table:
    columns = [Column(n, numeric=False) for n in ("input", *PARTS)]
    columns += [Column("worst error"), Column("allowed"), Column("note", numeric=False)]
    rows = [[r["title"], *(r[n] or MISSING for n in PARTS), *_numbers(r), _note(r)] for r in records]
    return Table(columns, rows, caption, wrapped=True)


def _note(record: Record) -> str:
    return record["skipped"] or record["note"]


def markdown(records: Mapping[str, Record]) -> str:
    """The table of all promises as Markdown, for the documentation."""
    lines = [
        "| " + " | ".join(c.title or "found" for c in COLUMNS) + " |",
        "|" + "|".join("---:" if c.numeric else "---" for c in COLUMNS) + "|",
    ]
    rows = [[cell.replace("|", "\\|") for cell in _row(found)] for found in _by_case(records).values()]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"
