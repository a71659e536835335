"""Puts the table of a run of `stability` into the documentation: python -m experiments.extremes.document RUN [FILE]."""

from __future__ import annotations

import sys
from pathlib import Path

from experiments.report.stability import markdown
from experiments.runs import read_provenance, read_records
from filterlab.io.atomic import atomic_write

BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "extremes.md"


def main(arguments: list[str]) -> int:
    """Exit code 0, or 1 with a message."""
    if len(arguments) not in (1, 2):
        print(__doc__, file=sys.stderr)
        return 1
    folder, document = Path(arguments[0]), Path(arguments[1]) if len(arguments) > 1 else DOCUMENT
    records, _ = read_records(folder)
    if not records:
        print(f"expected a folder of a run of stability; {folder} has no records", file=sys.stderr)
        return 1
    try:
        text = with_table(document.read_text(encoding="utf-8"), table(folder))
    except ValueError as error:
        print(f"{document}: {error}", file=sys.stderr)
        return 1
    with atomic_write(document) as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(document)
    return 0


def table(folder: Path) -> str:
    """What a run measured, as Markdown: the table, and by what it was computed."""
    records, _ = read_records(folder)
    kept, inputs = sum(r["holds"] for r in records.values()), sum(r["inputs"] for r in records.values())
    start = read_provenance(folder)[-1]
    versions = f"torch {start['torch']}, Python {start['python']}, {start['system']}"
    made = f"{versions}, {start['device']}, seed {start['seed']}"
    tried = sum(not r["skipped"] for r in records.values())
    return f"{kept:,} of {tried:,} checks kept, over {inputs:,} inputs ({made}).\n\n{markdown(records)}"


def with_table(text: str, measured: str) -> str:
    """The document with what stands between its markers replaced. Raises ValueError without one pair of markers."""
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise ValueError(f"expected one line {BEGIN} and, after it, one line {END}")
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    return f"{before}{BEGIN}\n{measured}{END}{after}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
