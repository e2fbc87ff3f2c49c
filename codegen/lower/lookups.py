"""Tables in kernels: each is looked up once for all derivatives at a point, before the first line that reads one."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import count

from sympy import Expr, Symbol

from codegen.errors import ExpressionError
from codegen.expressions.table_functions import TableBase
from codegen.lower.printer import scalar_code
from codegen.tables.data import TableData
from codegen.tables.evaluation import ORDERS

Assignment = tuple[Symbol, Expr]
Pairs = list[tuple[str, str]]
"""Targets and code."""


def with_lookups(
    body: Sequence[Assignment], outputs: Sequence[Expr], taken: Collection[str]
) -> tuple[Pairs, list[Expr]]:
    """The lines of a kernel as code, with look-ups where tables are first read, and what is left of its outputs.

    `taken` are names that the kernel has given already.
    """
    lookups, values, same = _Lookups(taken), list[Expr](), dict[Symbol, Expr]()
    for line, (symbol, value) in enumerate(body):
        values.append(lookups.without_tables(value.xreplace(same), line))
        if isinstance(value, TableBase):
            same[symbol] = values[-1]
    left = [lookups.without_tables(value.xreplace(same), len(body)) for value in outputs]
    pairs: Pairs = []
    for line, ((symbol, _), value) in enumerate(zip(body, values, strict=True)):
        pairs += lookups.before(line)
        pairs += [] if symbol in same else [(str(symbol), scalar_code(value))]
    return [*pairs, *lookups.before(len(body))], left


@dataclass(frozen=True)
class _Point:
    """A table at a point: the code of the point, the line before which it is looked up, the names of derivatives."""

    table: TableData
    code: str
    line: int
    names: dict[tuple[int, ...], Symbol]


class _Lookups:
    """Collects the tables that the lines of a kernel read, in their order."""

    def __init__(self, taken: Collection[str]) -> None:
        self._taken = set(taken)
        self._points: dict[tuple[TableData, tuple[Expr, ...]], _Point] = {}

    def without_tables(self, expression: Expr, line: int) -> Expr:
        """The expression of a line with names in place of tables."""
        while functions := expression.atoms(TableBase):
            inner = [f for f in functions if not any(a.has(TableBase) for a in f.args)]
            expression = expression.xreplace({f: self._name(f, line) for f in sorted(inner, key=str)})
        return expression

    def _name(self, function: TableBase, line: int) -> Symbol:
        table, key = function.table, (function.table, function.args)
        if key not in self._points:
            self._points[key] = _Point(table, ", ".join(map(scalar_code, function.args)), line, {})
        names = self._points[key].names
        if function.order not in ORDERS[len(function.args)]:
            raise ExpressionError(
                f"the derived equations have a derivative of table {table.shape.name} beyond the third",
                "let the table act as a force, or in dynamics, instead of in a Lagrangian or Hamiltonian",
            )
        if function.order not in names:
            by = "".join(str(i + 1) * o for i, o in enumerate(function.order))
            names[function.order] = self._fresh(f"{table.shape.name}_{by}" if by else table.shape.name)
        return names[function.order]

    def _fresh(self, stem: str) -> Symbol:
        name = next(f"{stem}_at_{n}" for n in count() if f"{stem}_at_{n}" not in self._taken)
        self._taken.add(name)
        return Symbol(name, real=True)

    def before(self, line: int) -> Pairs:
        """The look-ups that come before a line, once all lines have been asked for."""
        return [self._written(point) for point in self._points.values() if point.line == line]

    def _written(self, point: _Point) -> tuple[str, str]:
        shape = point.table.shape
        targets = [str(point.names.get(order, "_")) for order in ORDERS[len(shape.inputs)]]
        while targets[-1] == "_" and len(targets) > 1:
            targets.pop()
        part = "" if len(targets) == len(ORDERS[len(shape.inputs)]) else f"[:{len(targets)}]"
        code = f"{shape.lookup}(parameters, {point.code}){part if len(targets) > 1 else '[0]'}"
        return ", ".join(targets), code
