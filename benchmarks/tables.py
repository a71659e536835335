"""Records as tables: everything as plain text, the figures as Markdown. Computes nothing that is not in the records."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence

from benchmarks.records import Figure, Machine, Outcome, Report, Section, Spread, Timing

Row = tuple[str, ...]

_FIGURES: Row = ("figure", "median", "quartiles", "bar", "")
_TIMINGS: Row = ("contestant", "median", "quartiles", "per sample", "first call", "difference")
_INTERRUPTED = "Interrupted: not everything that was asked for is here."


def as_text(report: Report) -> str:
    """The whole report; at its end all bars once more."""
    parts = [heading(report), *(section_as_text(section) for section in report.sections), bars(report)]
    return "\n\n".join(part for part in (*parts, "" if report.complete else _INTERRUPTED) if part)


def heading(report: Report) -> str:
    return "\n".join(_heading(report))


def section_as_text(section: Section) -> str:
    """One comparison: a table of figures and one of times for every item."""
    title = f"=== {section.name}: {section.summary} ==="
    return "\n\n".join([title, *(_outcome_as_text(outcome) for outcome in section.outcomes)])


def bars(report: Report) -> str:
    """Every figure with a bar, in one table; nothing when there is none."""
    rows = [
        (f"{section.name}/{outcome.name}", *_figure_row(figure))
        for section in report.sections
        for outcome in section.outcomes
        for figure in outcome.figures
        if figure.bar is not None
    ]
    return f"=== bars ===\n\n{table(('item', *_FIGURES), rows)}" if rows else ""


def as_markdown(report: Report) -> str:
    """The figures, one table for each comparison."""
    parts = ["\n".join(f"* {line}" for line in _heading(report))]
    for section in report.sections:
        rows = [(o.name, *_figure_row(figure)) for o in section.outcomes for figure in o.figures]
        remarks = dict.fromkeys(line for outcome in section.outcomes for line in _remarks(outcome))
        parts.append(f"### {section.name}: {section.summary}")
        parts.append(markdown_table(("item", *_FIGURES), rows))
        parts.append("\n".join(f"* {remark}" for remark in remarks))
    return "\n\n".join(part for part in (*parts, "" if report.complete else _INTERRUPTED) if part)


def _outcome_as_text(outcome: Outcome) -> str:
    blocks = [f"{outcome.name}: {outcome.what}{_rounds(outcome)}"]
    if outcome.figures:
        blocks.append(table(_FIGURES, [_figure_row(f) for f in outcome.figures]))
    if outcome.timings:
        blocks.append(table(_TIMINGS, [_timing_row(t) for t in outcome.timings]))
    return "\n".join([*blocks, *_remarks(outcome)])


def _remarks(outcome: Outcome) -> list[str]:
    lines = [f"not taking part: {name} ({why})" for name, why in outcome.absent.items()]
    return lines + [f"ERROR {name}: {why}" for name, why in outcome.errors.items()]


def markdown_table(header: Row, rows: Sequence[Row]) -> str:
    lines = [header, tuple("---" if i < 2 else "---:" for i in range(len(header))), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def table(header: Row, rows: Sequence[Row]) -> str:
    """Columns side by side, as wide as they must be; the first one to the left, the others to the right."""
    widths = [max(_width(line[i]) for line in (header, *rows)) for i in range(len(header))]
    rule = tuple("-" * w for w in widths)
    return "\n".join("  " + _aligned(line, widths) for line in (header, rule, *rows))


def _aligned(line: Row, widths: Sequence[int]) -> str:
    cells = [
        cell + " " * (w - _width(cell)) if i == 0 else " " * (w - _width(cell)) + cell
        for i, (cell, w) in enumerate(zip(line, widths, strict=True))
    ]
    return "  ".join(cells).rstrip()


def _width(text: str) -> int:
    """Columns on a terminal: combining marks take none."""
    return sum(not unicodedata.combining(c) for c in text)


def _heading(report: Report) -> list[str]:
    versions = ", ".join(f"{k} {v}" for k, v in report.machine.versions.items())
    return [_machine(report.machine), versions, ", ".join(f"{key} {value}" for key, value in report.settings.items())]


def _machine(machine: Machine) -> str:
    features = " ".join(machine.features)
    cores = f"{machine.usable_cores} of {machine.cores} cores"
    gpu = f", {machine.gpu}" if machine.gpu else ""
    return f"{machine.cpu} ({machine.llvm_cpu}; {features}), {cores}, {machine.system}{gpu}"


def _rounds(outcome: Outcome) -> str:
    if not outcome.rounds:
        return ""
    rounds = f"{outcome.rounds} round{'s' * (outcome.rounds != 1)}"
    if outcome.share_of_core is None:
        return f" ({rounds})"
    return f" ({rounds}; {100 * outcome.share_of_core:.0f} % of the cores' time was ours)"


def _figure_row(figure: Figure) -> Row:
    verdict = "" if figure.met is None else "met" if figure.met else "MISSED"
    bar = "" if figure.bar is None else str(figure.bar)
    spread, unit = figure.spread, figure.unit
    return figure.name, quantity(spread.median, unit), _range(spread, unit), bar, verdict


def _range(spread: Spread, unit: str) -> str:
    return f"{quantity(spread.low, unit)} … {quantity(spread.high, unit)}"


def _timing_row(t: Timing) -> Row:
    per_sample = quantity(t.spread.median / t.samples, "s") if t.samples > 1 else ""
    off = "" if t.difference is None else f"{t.difference:.1e} from {t.compared_with}"
    return t.name, quantity(t.spread.median, "s"), _range(t.spread, "s"), per_sample, quantity(t.first_call, "s"), off


def quantity(value: float, unit: str) -> str:
    """Three digits; seconds in the unit that suits them, ratios below one half as 1/x too."""
    if unit == "s":
        for scale, name in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns")):
            if value >= scale or name == "ns":
                return f"{_digits(value / scale)} {name}"
    if unit:
        return f"{_digits(value)} {unit}"
    return f"{_digits(value)} (1/{_digits(1 / value)})" if 0 < value < 0.5 else _digits(value)


def _digits(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
