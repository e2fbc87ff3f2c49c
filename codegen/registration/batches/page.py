"""One page about many pairs: what became of each, with links to the pages of the pairs."""

from __future__ import annotations

import math
import urllib.parse
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.files import rendered, write_text
from codegen.registration.batches.outcome import Batch
from codegen.registration.batches.work import Line
from codegen.registration.pair_report import number, rows

if TYPE_CHECKING:
    from rich.table import Table


NAME = "index.html"
COLUMNS = (
    "pair", "", "landmarks", "steps", "residual", "least det J", "largest det J", "round trip", "left out", "outliers",
    "seconds",
)  # fmt: skip
_NUMBERS = ("residual", "det_min", "det_max", "round_trip", "leave_one_out")


@dataclass(frozen=True)
class Row:
    """A pair: its name and page, what became of it, why it failed, and the other cells under COLUMNS."""

    name: str
    page: str
    status: str
    text: str
    cells: tuple[str, ...]


def write_batch_report(folder: Path, done: Batch, pages: Iterable[Path | None]) -> Path:
    """Write the page beside the pages of the pairs, which come in the order of the batch; its path."""
    path = folder / NAME
    rows = [_row(line, page) for line, page in zip(done.lines, pages, strict=True)]
    template = Path(__file__).parents[1] / "templates/batch.html.j2"
    order = sorted(range(len(rows)), key=lambda k: _urgency(done.lines[k]))
    title = f"{len(rows)} pairs, {len(done.failed)} failed"
    write_text(path, rendered(template, title=title, columns=COLUMNS, rows=[rows[k] for k in order]))
    return path


def _urgency(line: Line) -> tuple[bool, float]:
    return line["status"] == "solved", float(line["det_min"] or math.inf)


def _row(line: Line, page: Path | None) -> Row:
    values = {name: number(float(line[name])) if line[name] else "–" for name in _NUMBERS}
    outliers = len(line["outliers"].split(";")) if line["outliers"] else 0
    cells = (
        line["count"],
        line["steps"],
        *values.values(),
        str(outliers) if line["det_min"] else "–",
        number(float(line["seconds"] or 0)),
    )
    solved = line["status"] == "solved"
    href = urllib.parse.quote(page.name) if page is not None and page.is_file() else ""
    return Row(Path(line["moving"]).name, href, line["status"], "" if solved else line["message"], cells)


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
