"""Families of alike rows: rows of expressions that differ only in their symbols, such as the equations of a chain.

The symbols of a row are in natural order, in which x9 precedes x10. Two rows belong to one family if they are equal
after the symbols of both, in this order, are replaced by the same slots. So alike rows are found only if the names of
their symbols are alike. Only one row of a family is differentiated, or printed as code.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from itertools import count

from sympy import Expr, Symbol


@dataclass(frozen=True)
class Member:
    """The number of a row, and the symbols of the row in the order of the slots of its family."""

    row: int
    symbols: tuple[Symbol, ...]


@dataclass(frozen=True)
class Family:
    """Rows that are equal to a `template` with the symbols of a member in place of `slots`."""

    template: tuple[Expr, ...]
    slots: tuple[Symbol, ...]
    members: tuple[Member, ...]

    @property
    def is_large(self) -> bool:
        """True if one text for all members is worthwhile."""
        return len(self.members) >= _FEWEST


MANY = 40
"""Number of rows from which a program treats alike rows as one."""
_FEWEST = 4
"""Least number of members of a large family."""


def are_many(found: Sequence[Family]) -> bool:
    """Return True if there are many rows, and most of them belong to large families."""
    rows = sum(len(family.members) for family in found)
    return rows >= MANY and 2 * sum(len(family.members) for family in found if family.is_large) > rows


def families(rows: Sequence[Sequence[Expr]], kind: Callable[[Symbol], Hashable] = lambda _: None) -> list[Family]:
    """Return the families of rows, in the order of their first members.

    Symbols in the same slot have the same `kind`, such as the array in which a kernel finds them.
    """
    names = {symbol.name for row in rows for value in row for symbol in value.free_symbols}
    slots: list[Symbol] = []
    fresh = (Symbol(f"s{i}", real=True) for i in count() if f"s{i}" not in names)
    found: dict[Hashable, list[Member]] = {}
    templates: dict[Hashable, tuple[tuple[Expr, ...], int]] = {}
    for number, row in enumerate(rows):
        symbols = sorted(set[Symbol]().union(*(value.free_symbols for value in row)), key=_natural)
        while len(slots) < len(symbols):
            slots.append(next(fresh))
        places = dict(zip(symbols, slots, strict=False))
        template = tuple(value.xreplace(places) for value in row)
        key = template, tuple(map(kind, symbols))
        templates[key] = template, len(symbols)
        found.setdefault(key, []).append(Member(number, tuple(symbols)))
    return [Family(templates[key][0], tuple(slots[: templates[key][1]]), tuple(found[key])) for key in found]


def _natural(symbol: Symbol) -> tuple[tuple[str, int], ...]:
    """Return a key for the order of names in which digits count as numbers."""
    return tuple((text, int(digits or -1)) for text, digits in re.findall(r"(\D*)(\d*)", symbol.name))
