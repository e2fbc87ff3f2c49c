"""Tables in HTML that a notebook shows in its own style, light or dark, and that need no script."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from codegen.checks.base import Finding

_LEFT = 'style="text-align:left"'


def table(rows: Iterable[Sequence[str]], headings: Sequence[str] = (), caption: str = "") -> str:
    """A table of texts, which are escaped, with the first column as heading of each row."""
    head = "".join(f'<th scope="col" {_LEFT}>{escape(text)}</th>' for text in headings)
    lines = [f"<caption {_LEFT}>{escape(caption)}</caption>"] if caption else []
    lines += [f"<thead><tr>{head}</tr></thead>"] if headings else []
    for first, *others in rows:
        cells = "".join(f"<td {_LEFT}>{escape(text)}</td>" for text in others)
        lines.append(f'<tr><th scope="row" {_LEFT}>{escape(first)}</th>{cells}</tr>')
    return f"<table>{''.join(lines)}</table>"


def findings_html(findings: Sequence[Finding]) -> str:
    """What was checked, of what, and with what outcome, in words and not in colours alone."""
    silent = sum(not finding.applies for finding in findings)
    failed = sum(not finding.passed for finding in findings)
    rows = [(own.check, own.subject, _verdict(own), own.detail) for own in findings]
    caption = f"{len(findings) - silent - failed} passed, {failed} failed, {silent} do not apply"
    return table(rows, ("check", "subject", "outcome", "detail"), caption)


def _verdict(finding: Finding) -> str:
    if not finding.applies:
        return "does not apply"
    return "passed" if finding.passed else "FAILED"


def number(value: float | None, digits: int = 6) -> str:
    """A number as text, or that there is none."""
    return "not available" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"
