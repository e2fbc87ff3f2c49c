"""The page on the thesis: statements of the thesis, commands, and recorded values."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

from references import ROOT
from thesis import ENTRIES
from thesis.entries import Agreement, Entry, Kind

RECORD = ROOT / "docs" / "measured" / "thesis.json"
_NOUNS = {
    Kind.FIGURE: "entries for figures", Kind.TABLE: "tables", Kind.CLAIM: "claims",
    Kind.QUESTION: "open questions", Kind.ERRATUM: "errata",
}  # fmt: skip
_INTRODUCTIONS = {
    Kind.QUESTION: "Chapter 6 asks these questions.",
    Kind.ERRATUM: "Each erratum has a proof: a measure of error that is zero for the corrected statement and not for "
    "the printed one. `tests/test_thesis.py` runs all proofs.",
}


def page() -> str:
    """Return the page, in MyST."""
    front = (ROOT / "docs" / "thesis.in").read_text(encoding="utf-8")
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    entries = tuple(ENTRIES.values())
    counts = Counter(entry.kind for entry in entries)
    *names, last = (f"{counts[kind]} {_NOUNS[kind]}" for kind in Kind)
    parts = {
        "COUNTS": f"{', '.join(names)} and {last}",
        "MEASURED": measured(record),
        "SUMMARY": summary(record),
        "ENTRIES": "\n".join(line for kind in Kind for line in section(kind, entries, record)),
    }
    for name, text in parts.items():
        front = front.replace(f"@{name}@", text)
    return front


def measured(record: dict[str, Any]) -> str:
    """Return the sentence with date, machine and versions."""
    own = record["machine"]
    days = sorted({entry["date"] for entry in record["entries"].values()})
    when = days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"
    minutes = sum(entry["seconds"] for entry in record["entries"].values()) / 60
    return (
        f"Measured on {when} with codegen {own['codegen']} on {own['processors']} cores of {own['processor']}. "
        f"Versions: Python {own['python']}, numba {own['numba']}, numpy {own['numpy']}, scipy {own['scipy']}, sympy "
        f"{own['sympy']}. All entries together took {minutes:.1f} minutes of processor time, with cached modules."
    )


def summary(record: dict[str, Any]) -> str:
    """Return a table with the numbers of entries of each kind, by agreement, and of values outside their limits."""
    head = ["section", *Agreement, "values", "outside their limits"]
    rows = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for kind in Kind:
        entries = [entry for entry in ENTRIES.values() if entry.kind is kind]
        counts = Counter(entry.agreement for entry in entries)
        values = [row for entry in entries for row in rows_of(entry, record)]
        outside = sum(not holds(row) for row in values)
        cells = [f"[{kind}](#{kind.lower().replace(' ', '-')})", *(str(counts[own] or "") for own in Agreement)]
        rows.append(f"| {' | '.join([*cells, str(len(values)), str(outside)])} |")
    return "\n".join(rows)


def section(kind: Kind, entries: tuple[Entry, ...], record: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of all entries of a kind."""
    yield f"## {kind}\n"
    if kind in _INTRODUCTIONS:
        yield f"{_INTRODUCTIONS[kind]}\n"
    for entry in entries:
        if entry.kind is not kind:
            continue
        yield f"### `{entry.name}`: {entry.place}\n\n{entry.says} **{entry.agreement.capitalize()}.**\n"
        yield "```text"
        for command in record["entries"][entry.name]["commands"]:
            others = command["runs"] - 1
            yield command["last"] + (f"  # and {others} similar run{'s' * (others > 1)}" if others else "")
        yield "```\n"
        yield "| quantity | thesis | here | limits | |\n|---|---|---|---|---|"
        yield from (table_row(row) for row in rows_of(entry, record))
        yield f"\n{entry.remark}\n" if entry.remark else ""


def rows_of(entry: Entry, record: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the recorded rows of an entry."""
    rows: list[dict[str, Any]] = record["entries"][entry.name]["rows"]
    return rows


def holds(row: dict[str, Any]) -> bool:
    """Return True if a recorded value is within its limits."""
    return bool(row.get("low", -math.inf) <= row["here"] <= row.get("high", math.inf))


def table_row(row: dict[str, Any]) -> str:
    """Return a recorded row as a row of a table."""
    low, high = row.get("low"), row.get("high")
    if low is None and high is None:
        limits = ""
    elif low is None:
        limits = f"at most {number(high)}"
    elif high is None:
        limits = f"at least {number(low)}"
    else:
        limits = number(low) if low == high else f"{number(low)} to {number(high)}"
    mark = "" if not limits else "yes" if holds(row) else "**no**"
    return f"| {row['quantity']} | {row['there']} | {number(row['here'])} | {limits} | {mark} |"


def number(value: float) -> str:
    """Return a number with up to 9 digits if it is near 1, else with 4."""
    if value == int(value) and abs(value) < 1e6:
        return str(int(value))
    return f"{value:.9g}" if 0.1 < abs(value) < 1e4 else f"{value:.4g}"
