"""Text that describes a problem object, for the key of the build cache.

The text is the same in every process, and differs between different problems. It begins with the declared quantities
in the order of their declaration, on which modules depend. Declarations that the problem does not use have no effect.
Expressions follow unchanged; every subexpression has a line, and is referred to by its number. Numbers of different
types differ, because sympy treats 1 and 1.0 differently.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from fractions import Fraction
from pathlib import PurePath

import numpy as np
import sympy

from codegen.errors import ExpressionError, clause
from codegen.problem.particles import Connect, Pairwise
from codegen.problem.symbols import Quantity
from codegen.problem.tables import Measurements, Table, Trajectory
from codegen.symbolic.functions import TableBase

_LINKS = ("partner", "past", "end_values", "declared", "sphere")
"""Attributes of symbols that are not written in the text.

They link symbols to each other, or express the order of declaration, which is the order of the lines.
"""


def described(problem: object, name: str = "problem") -> str:
    """Return the text that describes a problem.

    Raise ExpressionError for a part that is no expression, number, list or mapping. Its message begins with `name`.
    """
    description = _Description(name)
    body = description.of(problem, type(problem).__name__)
    order = {symbol: number for number, symbol in enumerate(quantities_in(problem))}
    declared = [f"{symbol.name}: {description.declaration(symbol, order)}" for symbol in order]
    return "\n".join([*declared, *description.lines, body])


def quantities_in(problem: object) -> list[Quantity]:
    """Return the declared quantities in a problem in the order of their declaration.

    The partners of quantities are included, for example the velocity of a coordinate.
    """
    found: dict[Quantity, None] = {}
    waiting, seen = [problem], set[int]()
    while waiting:
        part = waiting.pop()
        if isinstance(part, Quantity):
            if part not in found:
                found[part] = None
                waiting += [value for name, value in _slots(part) if name not in ("past", "end_values", "sphere")]
        elif isinstance(part, sympy.Basic):
            if id(part) not in seen:  # a subexpression may occur in many expressions
                seen.add(id(part))
                waiting += part.args
        else:
            waiting += [value for _, value in _parts(part)]
    return sorted(found, key=lambda symbol: symbol.declared)


def _slots(symbol: Quantity) -> Iterator[tuple[str, object]]:
    """Yield the names and values of all attributes of a symbol, such as its value, guess, bounds, partner or lag."""
    for kind in type(symbol).__mro__:
        for name in vars(kind).get("__slots__", ()) if issubclass(kind, Quantity) else ():
            if hasattr(symbol, name):
                yield name, getattr(symbol, name)


def _parts(value: object) -> Iterator[tuple[str, object]]:
    """Yield the names and values of the parts of a problem object, mapping or list; nothing for other values."""
    if isinstance(value, Connect):
        yield from ((part.name, getattr(value, part.name)) for part in fields(value) if part.name != "path")
        yield "path", _path(value)
    elif isinstance(value, Pairwise):
        yield "particles", value.pair
        yield "pair_term", value.term_of_pair
        yield from (("self_term", value.self_term), ("domain", value.domain))
    elif isinstance(value, Measurements):
        yield from (("values", value.values), ("loss", value.loss), ("data", repr(value.data)))
    elif isinstance(value, Table):
        yield "data", repr(value.data)
    elif isinstance(value, Trajectory):
        yield from (("file", value.file), *((name, repr(table)) for name, table in value.tables.items()))
    elif is_dataclass(value) and not isinstance(value, type):
        yield from ((part.name, getattr(value, part.name)) for part in fields(value))
    elif isinstance(value, Mapping):
        for key, entry in value.items():
            yield from (("a key", key), (str(key), entry))
    elif isinstance(value, (list, tuple)):
        yield from ((str(number), entry) for number, entry in enumerate(value))


def _path(problem: Connect) -> object:
    """Return the expressions of the guessed path of particles for symbolic ends; None for a straight line."""
    if problem.path is None or not isinstance(problem.hamiltonian, Pairwise):
        return None
    names = [symbol.name for symbol in problem.hamiltonian.pair[0].q]
    ends = ([f"{name} at the {end}" for name in names] for end in ("start", "end"))
    start, target = (tuple(sympy.Symbol(name, real=True) for name in of_one) for of_one in ends)
    return problem.path(start, target, sympy.Symbol("the fraction", real=True))


class _Description:
    """The text of a problem with `name`, written line by line.

    `lines` has a line for each expression, and `numbers` has the index of its line.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.lines: list[str] = []
        self.numbers: dict[sympy.Basic, int] = {}

    def of(self, value: object, where: str) -> str:
        """Return the text of a value; `where` names its position in the problem for messages of errors."""
        kind = type(value).__name__
        if isinstance(value, sympy.Basic):
            return f"#{self._expression(value)}"
        if value is None or isinstance(value, (bool, int, float, str, PurePath, Fraction)):
            return f"{kind} {str(value)!r}" if isinstance(value, PurePath) else f"{kind} {value!r}"
        if isinstance(value, (np.ndarray, np.generic)) and value.dtype != object:
            return f"{kind} {value.dtype} {value.tolist()!r}"
        if isinstance(value, (Mapping, list, tuple, Measurements, Table, Trajectory)) or is_dataclass(value):
            parts = [f"{part}={self.of(entry, f'{where}.{part}')}" for part, entry in _parts(value)]
            return f"{kind}({', '.join(parts)})"
        try:
            return f"{kind} #{self._expression(sympy.sympify(value, strict=True))}"
        except (sympy.SympifyError, TypeError, ValueError):
            remedy = "give numbers, expressions of sympy, or lists and mappings of them"
            raise ExpressionError(clause(f"{self.name}: {where} is a {kind}"), remedy) from None

    def declaration(self, symbol: Quantity, order: Mapping[Quantity, int]) -> str:
        """Return the text of a declared quantity; `order` has the numbers of all quantities, which denote partners."""
        own = [f"{name}={self.of(value, symbol.name)}" for name, value in _slots(symbol) if name not in _LINKS]
        if (partner := getattr(symbol, "partner", None)) is not None:
            own.append(f"partner {order[partner]}")
        return " ".join([type(symbol).__name__, *own])

    def _expression(self, expression: sympy.Basic) -> int:
        """Return the number of the line of an expression; add lines for the expression and its parts if necessary."""
        waiting = [expression]
        while waiting:
            part = waiting[-1]
            missing = [argument for argument in part.args if argument not in self.numbers]
            if part in self.numbers or missing:
                waiting.pop() if part in self.numbers else waiting.extend(missing)
                continue
            self.numbers[waiting.pop()] = len(self.lines)
            self.lines.append(f"{_function(part)} {' '.join(str(self.numbers[own]) for own in part.args)}")
        return self.numbers[expression]


def _function(part: sympy.Basic) -> str:
    """Return the text of the outermost function of an expression without its arguments, or of a symbol or number."""
    kind = type(part)
    if isinstance(part, Quantity):
        return f"{kind.__name__} {part.name}"
    if isinstance(part, TableBase):
        return f"table {part.order} {part.table!r}"
    if not part.args:
        return str(sympy.srepr(part))
    return f"{kind.__module__}.{kind.__qualname__}"
