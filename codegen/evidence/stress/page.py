"""The output of a stress run: a table on the terminal, a CSV file of all numbers, and a self-contained HTML page."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from codegen.evidence.stress.cases import DEFECTS, OUTCOMES, Row, promised_error
from codegen.evidence.stress.own import verdict
from codegen.files import rendered, replacing, write_text
from codegen.machine import versions
from codegen.solving.drivers import DRIVERS

if TYPE_CHECKING:
    from rich.table import Table

COLUMNS = ("case", "scheme", "h ω", "error", "promised", "energy drift", "stable h ω <", "failed", "outcome")
WORDS = ("case", "scheme")  # the columns of text, whose cells may be wrapped
STYLES = {"accurate": "green", "bounded": "cyan", "unsuitable": "yellow", "refused": "blue"}


@dataclass(frozen=True)
class Line:
    """A row as text: the cells under COLUMNS, the finding, the reason for the expectation, True if the case passed.

    `figure` is the number in the overview: the stability limit if it is measured, else the error, else the energy
    drift.
    """

    cells: tuple[str, ...]
    figure: str
    text: str
    reason: str
    outcome: str
    passed: bool


@dataclass(frozen=True)
class Section:
    """The lines of one family, and an overview: for each case, one line for each scheme, or None without a line."""

    family: str
    lines: tuple[Line, ...]
    schemes: tuple[str, ...]
    overview: tuple[tuple[str, tuple[Line | None, ...]], ...]


def _number(value: float) -> str:
    """Return a number as short text, which is empty for NaN."""
    if math.isnan(value):
        return ""
    if math.isinf(value):
        return "∞"
    if value == 0.0:
        return "0"
    return f"{value:.3g}" if 0.01 <= abs(value) < 1e4 else f"{value:.1e}"


def _sections(rows: Iterable[Row]) -> list[Section]:
    """Return one section for each family, in the order of the families."""
    families: dict[str, list[Line]] = {}
    for row in rows:
        case, run = row.case, row.measurement
        scheme = case.setup.label if DRIVERS[case.driver].generated else f"{case.setup.label}, {case.driver}"
        limit = run.stable_below
        stable = "any" if math.isinf(limit) else "none" if limit == 0.0 else _number(limit)
        cells = (
            case.name, scheme, _number(case.h_omega), _number(run.error), _number(promised_error(case, run)),
            _number(run.drift),
            stable, str(run.failures or ""), row.outcome,
        )  # fmt: skip
        of_limit = case.reference == "stable_step" or (case.limit and case.truth is not None)
        figure = stable if of_limit else _number(run.error) or _number(run.drift)
        text = row.text if row.text.startswith(row.outcome) else f"{row.outcome}: {row.text}"
        families.setdefault(row.case.family, []).append(
            Line(cells, figure or "–", text, case.reason, row.outcome, row.passed)
        )
    sections = []
    for family, lines in families.items():
        schemes = tuple(dict.fromkeys(line.cells[1] for line in lines))
        by_cells = {line.cells[:2]: line for line in lines}
        names = dict.fromkeys(line.cells[0] for line in lines)
        overview = tuple((name, tuple(by_cells.get((name, scheme)) for scheme in schemes)) for name in names)
        sections.append(Section(family, tuple(lines), schemes, overview))
    return sections


def _counts(rows: Sequence[Row]) -> str:
    """Return a sentence with the number of rows for each outcome."""
    counts = Counter(row.outcome for row in rows)
    words = [f"{counts[word]} {word}" for word in (*OUTCOMES, *DEFECTS) if counts[word]]
    return f"{len(rows)} rows: {', '.join(words)}"


def table(rows: Sequence[Row]) -> Table:
    """Return all rows as a table for a terminal."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    shown = Table(box=box.SIMPLE_HEAD, caption=_counts(rows), caption_justify="left", padding=(0, 1, 0, 0))
    for heading in COLUMNS:
        is_number = heading not in (*WORDS, "outcome")
        heading = heading.replace("energy drift", "drift").replace("stable h ω", "stable")
        shown.add_column(
            heading, justify="right" if is_number else "left", no_wrap=heading not in WORDS, overflow="fold"
        )
    for section in _sections(rows):
        for line in section.lines:
            *cells, outcome = line.cells
            style = STYLES.get(outcome, "bold red") if line.passed else "bold red"
            shown.add_row(*map(Text, cells), Text(outcome, style=style))
        shown.add_section()
    return shown


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Write all numbers of all rows into a CSV file."""
    records = []
    for row in rows:
        case, run, setup = row.case, row.measurement, row.case.setup
        records.append({
            "family": case.family, "case": case.name, "problem": setup.problem, "method": setup.method or "",
            "scheme": setup.scheme or "", "driver": case.driver, "steps": case.steps, "h_omega": case.h_omega,
            "error": run.error, "promised": case.bound, "announced_error": run.announced, "residual": run.residual,
            "tolerance": run.tolerance, "textbook_rounding_errors": run.textbook, "energy_drift": run.drift,
            "stable_below": run.stable_below, "failures": run.failures, "iterations": run.iterations,
            "seconds": run.seconds, "status": run.status, "outcome": row.outcome,
            "expected": " or ".join(case.expected), "passed": row.passed, "finding": row.text, "reason": case.reason,
        })  # fmt: skip
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(records[0]) if records else [])
        writer.writeheader()
        writer.writerows(records)


def write_page(rows: Sequence[Row], seconds: float, path: Path) -> None:
    """Write one HTML file without scripts and links to other files; `seconds` is the duration of the run."""
    own = any(row.case.truth is not None for row in rows)
    text = rendered(
        Path(__file__).parent / "page.html.j2", sections=_sections(rows), columns=COLUMNS, counts=_counts(rows),
        first=verdict(rows) if own else "", failed=[row for row in rows if not row.passed], outcomes=OUTCOMES,
        defects=DEFECTS, seconds=f"{seconds:.0f}",
        environment=", ".join(f"{name} {value}" for name, value in versions().items()),
    )  # fmt: skip
    write_text(path, text)
