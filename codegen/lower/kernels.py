"""One kernel as strings: inputs read from arrays, common subexpressions, outputs with their meaning."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.lower.lookups import with_lookups
from codegen.lower.printer import scalar_code, stabilised, with_decimal_roots

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
