"""One page about many pairs: what became of each, with links to the pages of the pairs."""

from __future__ import annotations

import math
import urllib.parse
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import jinja2

from codegen.files import replacing
from codegen.registration.batches.lines import Line
from codegen.registration.batches.outcome import Batch
from codegen.registration.record_text import number

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
    loader = jinja2.FileSystemLoader(Path(__file__).parents[1] / "templates")
    template = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).get_template("batch.html.j2")
    order = sorted(range(len(rows)), key=lambda k: _urgency(done.lines[k]))
    title = f"{len(rows)} pairs, {len(done.failed)} failed"
    text = template.render(title=title, columns=COLUMNS, rows=[rows[k] for k in order])
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
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
