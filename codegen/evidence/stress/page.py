"""What a stress run leaves behind: a table on the terminal, a CSV file of every number, a self-contained HTML page."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from codegen.evidence.stress.cases import DEFECTS, OUTCOMES, Row
from codegen.files import rendered, replacing, write_text
from codegen.machine import versions
from codegen.solving.drivers import DRIVERS

if TYPE_CHECKING:
    from rich.table import Table

COLUMNS = ("case", "scheme", "h ω", "error", "promised", "energy drift", "stable h ω <", "failed", "outcome")
WORDS = ("case", "scheme")  # of several words, and so of several lines where there is little room
STYLES = {"accurate": "green", "bounded": "cyan", "unsuitable": "yellow", "refused": "blue"}


@dataclass(frozen=True)
class Line:
    """A row as text: the cells under COLUMNS, what was found and why it was expected, whether it passed.

    `figure` is the number that an overview shows: the error, or the change of energy where there is no reference, or
    the limit where that is what is measured.
    """

    cells: tuple[str, ...]
    figure: str
    text: str
    reason: str
    outcome: str
    passed: bool


@dataclass(frozen=True)
class Section:
    """The lines of one family, and an overview: cases against schemes, a line or None in each place."""

    family: str
    lines: tuple[Line, ...]
    schemes: tuple[str, ...]
    overview: tuple[tuple[str, tuple[Line | None, ...]], ...]


def number(value: float) -> str:
    """A number in as few characters as say enough; nothing for what was not measured."""
    if math.isnan(value):
        return ""
    if math.isinf(value):
        return "∞"
    if value == 0.0:
        return "0"
    return f"{value:.3g}" if 0.01 <= abs(value) < 1e4 else f"{value:.1e}"


def stable(value: float) -> str:
    """The largest stable step times frequency."""
    return "any" if math.isinf(value) else "none" if value == 0.0 else number(value)


def line(row: Row) -> Line:
    """A row as text."""
    case, seen = row.case, row.measurement
    scheme = case.setup.label if DRIVERS[case.driver].generated else f"{case.setup.label}, {case.driver}"
    cells = (
        case.name, scheme, number(case.h_omega), number(seen.error), number(case.bound), number(seen.drift),
        stable(seen.stable_below), str(seen.failures or ""), row.outcome,
    )  # fmt: skip
    figure = stable(seen.stable_below) if case.reference == "stable_step" else number(seen.error) or number(seen.drift)
    text = row.text if row.text.startswith(row.outcome) else f"{row.outcome}: {row.text}"
    return Line(cells, figure or "–", text, case.reason, row.outcome, row.passed)


def sections(rows: Iterable[Row]) -> tuple[Section, ...]:
    """Rows by family, in the order in which families come."""
    families: dict[str, list[Line]] = {}
    for row in rows:
        families.setdefault(row.case.family, []).append(line(row))
    return tuple(_section(family, lines) for family, lines in families.items())


def _section(family: str, lines: Sequence[Line]) -> Section:
    schemes = tuple(dict.fromkeys(entry.cells[1] for entry in lines))
    placed = {entry.cells[:2]: entry for entry in lines}
    names = dict.fromkeys(entry.cells[0] for entry in lines)
    overview = tuple((name, tuple(placed.get((name, scheme)) for scheme in schemes)) for name in names)
    return Section(family, tuple(lines), schemes, overview)


def counts(rows: Sequence[Row]) -> str:
    """How many rows ended how, in one sentence."""
    found = Counter(row.outcome for row in rows)
    words = [f"{found[word]} {word}" for word in (*OUTCOMES, *DEFECTS) if found[word]]
    return f"{len(rows)} rows: {', '.join(words)}"


def table(rows: Sequence[Row]) -> Table:
    """All rows for a terminal."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    shown = Table(box=box.SIMPLE_HEAD, caption=counts(rows), caption_justify="left", padding=(0, 1, 0, 0))
    for heading in COLUMNS:
        is_number = heading not in (*WORDS, "outcome")
        heading = heading.replace("energy drift", "drift").replace("stable h ω", "stable")
        shown.add_column(
            heading, justify="right" if is_number else "left", no_wrap=heading not in WORDS, overflow="fold"
        )
    for section in sections(rows):
        for entry in section.lines:
            *cells, outcome = entry.cells
            style = STYLES.get(outcome, "bold red")
            shown.add_row(*map(Text, cells), Text(outcome, style=style if entry.passed else "bold red"))
        shown.add_section()
    return shown


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Every number of every row."""
    records = [_record(row) for row in rows]
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(records[0]) if records else [])
        writer.writeheader()
        writer.writerows(records)


def _record(row: Row) -> dict[str, object]:
    """Names and values of a line of the file."""
    case, seen, made = row.case, row.measurement, row.case.setup
    return {
        "family": case.family, "case": case.name, "problem": made.file.stem, "method": made.method or "",
        "scheme": made.scheme or "", "driver": case.driver, "steps": case.steps, "h_omega": case.h_omega,
        "error": seen.error, "promised": case.bound, "announced_error": seen.announced, "residual": seen.residual,
        "tolerance": seen.tolerance, "textbook_rounding_errors": seen.textbook, "energy_drift": seen.drift,
        "stable_below": seen.stable_below, "failures": seen.failures, "iterations": seen.iterations,
        "seconds": seen.seconds, "status": seen.status, "outcome": row.outcome, "expected": " or ".join(case.expected),
        "passed": row.passed, "finding": row.text, "reason": case.reason,
    }  # fmt: skip


def write_page(rows: Sequence[Row], seconds: float, path: Path) -> None:
    """One HTML file without scripts or anything from elsewhere."""
    failed = [line(row) for row in rows if not row.passed]
    text = rendered(
        Path(__file__).parent / "page.html.j2", sections=sections(rows), columns=COLUMNS, counts=counts(rows),
        failed=failed, outcomes=OUTCOMES, defects=DEFECTS, seconds=f"{seconds:.0f}",
        environment=", ".join(f"{name} {value}" for name, value in versions().items()),
    )  # fmt: skip
    write_text(path, text)
