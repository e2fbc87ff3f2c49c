"""What `codegen warp` prints: the record of one pair as a table, and what became of many."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.registration.batch import Batch, Line
from codegen.registration.job import MOST_LEFT_OUT

if TYPE_CHECKING:
    from rich.table import Table


def table(record: Mapping[str, Any]) -> Table:
    """The record of one pair for people."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    shown = Table(box=box.SIMPLE_HEAD, show_header=False)
    shown.add_column(style="cyan", no_wrap=True)
    shown.add_column(overflow="fold")
    style = "green" if record["status"] == "solved" else "bold red"
    shown.add_row("image", Text(f"{record['moving']} ({record['direction']})"))
    shown.add_row("status", Text(record["status"], style=style))
    shown.add_row("", Text(record["message"]))
    for name, text in rows(record):
        shown.add_row(name, Text(text))
    seconds = ", ".join(f"{name} {value:.3g} s" for name, value in record["seconds"].items())
    shown.add_row("time", Text(seconds))
    if record["status"] == "solved":
        shown.add_row("written", Text(record["out"]))
    return shown


def rows(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What was found, in words and numbers; distances in pixels."""
    seen = record["summary"]
    found = [("landmarks", str(seen["landmarks"]))]
    if "det_min" not in seen:
        return found
    sigma = f", sigma {record['sigma']:.3g} px" if record["sigma"] or seen["sigma_chosen"] else ""
    sigma += " by leave-one-out" if seen["sigma_chosen"] else ""
    x, y = seen["det_min_at"]
    found += [
        ("method", f"{record['align']} alignment, {record['scheme']}, {record['steps']} steps{sigma}"),
        ("residual", f"{number(record['residual'])} px at most"),
        ("det J", f"{number(seen['det_min'])} at ({x:g}, {y:g}) to {number(seen['det_max'])}"),
        ("folded", f"{seen['folded']} pixels"),
        ("round trip", f"{number(seen['round_trip'])} px"),
    ]
    if seen["scheme_error"] is not None:
        found.append(("error of the scheme", f"{number(seen['scheme_error'])} px"))
    if seen.get("leave_one_out"):
        finite = [error for error in seen["leave_one_out"] if error is not None]
        found.append(("leave one out", f"{number(statistics.median(finite)) if finite else '–'} px (median)"))
        found.append(("outliers", ", ".join(seen["outliers"]) or "none"))
    elif seen["landmarks"] > MOST_LEFT_OUT:
        found.append(("leave one out", f"not done for more than {MOST_LEFT_OUT} landmarks"))
    if seen.get("spacing", 1) != 1:
        text = f"every {seen['spacing']} pixels, error below {number(seen['spacing_bound'])} px"
        found.append(("grid", text))
    return found


def number(value: float | None) -> str:
    """A number in few characters."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.4g}"


def record(done: Batch, summary: Path) -> dict[str, Any]:
    """The JSON object of a batch."""
    return {
        "problem": "image_registration", "task": "warp", "pairs": len(done.lines), "unchanged": done.unchanged,
        "failed": [_brief(line) for line in done.failed], "status": "failed" if done.failed else "solved",
        "message": _outcome(done), "summary": str(summary),
    }  # fmt: skip


def _brief(line: Line) -> dict[str, str]:
    return {name: line[name] for name in ("moving", "out", "status", "message")}


def overview(done: Batch, summary: Path) -> str:
    """One line about a batch."""
    return f"{_outcome(done)}; see {summary}"


def _outcome(done: Batch) -> str:
    solved = len(done.lines) - len(done.failed) - done.unchanged
    return f"{solved} pairs warped, {done.unchanged} unchanged, {len(done.failed)} failed"
