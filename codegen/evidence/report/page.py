"""What a page consists of, how its sentences write numbers, and its text: one HTML file that needs no other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from codegen.files import rendered

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
"""For str.translate."""


@dataclass(frozen=True)
class Table:
    """A table: what it shows, the names of its columns, rows of texts; `kind` is "words" if these are sentences."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    kind: str = "numbers"


def without_empty_columns(table: Table) -> Table:
    """The table without those columns in which no row says anything."""
    kept = [i for i, _ in enumerate(table.head) if any(row[i] for row in table.rows)]
    rows = tuple(tuple(row[i] for i in kept) for row in table.rows)
    return replace(table, head=tuple(table.head[i] for i in kept), rows=rows)


@dataclass(frozen=True)
class Picture:
    """A figure as SVG, and what it shows."""

    caption: str
    svg: str


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    title: str
    texts: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many digits, as people write it; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
        return f"{value:.{decimals}f}"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}·10{str(int(exponent)).translate(SUPERSCRIPTS)}"


def seconds(value: float | None) -> str:
    """A time in the unit that suits it."""
    if value is None or not math.isfinite(value):
        return "–"
    if value < 1.0:
        return f"{number(1e3 * value)}\N{NO-BREAK SPACE}ms"
    return f"{number(value)}\N{NO-BREAK SPACE}s"


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """The exponent a with which y grows like x^a, by least squares; NaN for fewer than three points."""
    if len(x) < 3:
        return math.nan
    return float(np.polyfit(np.log(x), np.log(np.maximum(y, 1e-300)), 1)[0])


def listed(names: Sequence[str]) -> str:
    """Names joined by commas and a final `and`; `none` for none."""
    if not names:
        return "none"
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def page(title: str, introduction: str, sections: Sequence[Section], environment: Mapping[str, Any]) -> str:
    """One HTML file that needs no other, from any sections."""
    template, named = Path(__file__).parent / "templates/page.html.j2", [*_flat(environment)]
    return rendered(template, title=title, introduction=introduction, sections=sections, environment=named)


def _flat(environment: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Names and values, of records inside the record as well."""
    for name, value in environment.items():
        if isinstance(value, Mapping):
            yield from ((f"{name}, {inner}", entry) for inner, entry in value.items())
        else:
            yield name, value
