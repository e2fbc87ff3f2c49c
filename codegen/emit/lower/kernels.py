"""One kernel as strings: inputs read from arrays, common subexpressions, outputs with their meaning.

Tables in kernels: each is looked up once for all derivatives at a point, before the first line that reads one.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count

import sympy
from sympy import Expr, Symbol

from codegen.emit.lower.printer import scalar_code, stabilised, with_decimal_roots
from codegen.errors import ExpressionError
from codegen.symbolic.functions import TableBase
from codegen.symbolic.tables import ORDERS, TableData

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


CACHED = ('@njit(cache=True, error_model="numpy")',)
"""Decorator of functions that Python calls; division by zero gives infinity, as it does in numpy."""
INNER = ('@njit(error_model="numpy")',)
"""Decorator of functions that only compiled functions call: their machine code is kept as part of the caller's."""

KERNEL, VALUE = ("@Kernel",), ("@Value",)
"""Decorators of functions that are called by their address; values are returned."""


@dataclass(frozen=True)
class Line:
    """One assignment `target = code` (or `+=`), with a comment that says what it means."""

    target: str
    code: str
    comment: str = ""
    operator: str = "="


@dataclass(frozen=True)
class Kernel:
    """A numba function: `inputs` unpack arrays, `body` holds the common subexpressions, `outputs` fill arrays.

    `results` holds the code of what is returned, if anything is, `decorators` how the function is compiled.
    """

    name: str
    summary: str
    arguments: tuple[str, ...]
    inputs: tuple[Line, ...]
    body: tuple[Line, ...]
    outputs: tuple[Line, ...]
    results: tuple[str, ...]
    operations_before: int
    operations_after: int
    decorators: tuple[str, ...]


@dataclass(frozen=True)
class Output:
    """An expression that a kernel writes to `target`, by `=` or `+=`."""

    target: str
    value: Expr
    comment: str
    operator: str = "="


def kernel(
    name: str,
    summary: str,
    arguments: Sequence[str],
    codes: Mapping[Symbol, str],
    outputs: Sequence[Output],
    result: Expr | None = None,
    assignments: Sequence[tuple[Symbol, Expr]] = (),
    decorators: tuple[str, ...] = CACHED,
    straight_line: Sequence[tuple[Symbol, Expr]] = (),
) -> Kernel:
    """Lower expressions to a kernel; `codes` tells for each symbol the code that reads it (its own name: argument).

    `assignments` give values to further symbols, each of which later assignments and all outputs may read. Those of a
    `straight_line` program do as well, but hold all common subexpressions already; a kernel has one or the other.
    """
    names = [symbol for symbol, _ in (*assignments, *straight_line)]
    values = [*(value for _, value in (*assignments, *straight_line)), *(output.value for output in outputs)]
    values += [] if result is None else [result]
    expressions = [with_decimal_roots(stabilised(value)) for value in values]
    used = set().union(*(e.free_symbols for e in expressions)) if expressions else set()
    inputs = tuple(Line(s.name, code) for s, code in codes.items() if s in used and code != s.name)
    body, reduced = [*zip(names, expressions, strict=False)], expressions[len(names) :]
    if not straight_line:
        body, reduced = _with_common(names, expressions, {s.name for s in codes} | set(arguments))
    after = [int(e.count_ops()) for e in (*(value for _, value in body), *reduced)]
    count = len(outputs)
    taken = {s.name for s in codes} | set(arguments) | {str(s) for s, _ in body}
    pairs, reduced = with_lookups(body, reduced, taken)
    return Kernel(
        name=name,
        summary=summary,
        arguments=tuple(arguments),
        inputs=inputs,
        body=tuple(Line(target, code) for target, code in pairs),
        outputs=tuple(
            Line(output.target, scalar_code(e), output.comment, output.operator)
            for output, e in zip(outputs, reduced[:count], strict=True)
        ),
        results=tuple(scalar_code(e) for e in reduced[count:]),
        operations_before=_written_out(straight_line, expressions, after)
        if straight_line
        else sum(int(e.count_ops()) for e in expressions),
        operations_after=sum(after),
        decorators=decorators,
    )


def needed(assignments: Sequence[tuple[Symbol, Expr]], read: Iterable[Expr]) -> list[tuple[Symbol, Expr]]:
    """Those assignments that the expressions read, directly or through others."""
    symbols: set[Symbol] = set().union(*(expression.free_symbols for expression in read))
    kept: list[tuple[Symbol, Expr]] = []
    for symbol, value in reversed(assignments):
        if symbol in symbols:
            kept.append((symbol, value))
            symbols |= value.free_symbols
    return kept[::-1]


def _with_common(
    names: Sequence[Symbol], expressions: Sequence[Expr], taken: Collection[str]
) -> tuple[list[tuple[Symbol, Expr]], list[Expr]]:
    """Common subexpressions assigned before those to `names`, the first expressions; and what is left of the others."""
    fresh = (Symbol(f"x{i}", real=True) for i in range(10**9) if f"x{i}" not in taken)
    common, reduced = sympy.cse(expressions, symbols=fresh, order="canonical")
    body = _interleaved(zip(names, reduced[: len(names)], strict=True), common)
    return body, reduced[len(names) :]


def _written_out(assignments: Sequence[tuple[Symbol, Expr]], expressions: Sequence[Expr], own: Sequence[int]) -> int:
    """The operations of all outputs if nothing were assigned; the first expressions are what is assigned."""
    totals: dict[Expr, int] = {}
    outputs = 0
    for index, (expression, operations) in enumerate(zip(expressions, own, strict=True)):
        total = operations + sum(totals.get(part, 0) for part in sympy.preorder_traversal(expression))
        if index < len(assignments):
            totals[assignments[index][0]] = total
        else:
            outputs += total
    return outputs


def _interleaved(
    assignments: Iterable[tuple[Symbol, Expr]], common: Sequence[tuple[Symbol, Expr]]
) -> list[tuple[Symbol, Expr]]:
    """Put each common subexpression before the first assignment that reads it; what none reads comes last."""
    waiting = dict(common)
    order = list(waiting)
    body: list[tuple[Symbol, Expr]] = []

    def supply(value: Expr) -> None:
        for symbol in sorted(value.free_symbols & waiting.keys(), key=order.index):
            if symbol in waiting:
                needed = waiting.pop(symbol)
                supply(needed)
                body.append((symbol, needed))

    for symbol, value in assignments:
        supply(value)
        body.append((symbol, value))
    return [*body, *waiting.items()]
