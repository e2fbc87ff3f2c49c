"""What `codegen warp` prints: the record of one pair as a table, and what became of many."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.registration.batches.lines import Line
from codegen.registration.batches.outcome import Batch
from codegen.registration.record_text import rows

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
