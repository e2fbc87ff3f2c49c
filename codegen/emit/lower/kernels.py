"""Lowering of expressions to a kernel as strings: inputs from arrays, common subexpressions, outputs with comments.

A kernel looks up each table once for all derivatives at a point, before the first line that reads a derivative. A
table may have a range that a solution must not leave. Kernels then return the least and greatest values of the inputs
with which each such table is read.
"""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count

import sympy
from sympy import Expr, Symbol

from codegen.emit.lower.printer import scalar_code, stabilised, with_decimal_roots
from codegen.errors import ExpressionError
from codegen.runtime.record import TableRecord
from codegen.symbolic.functions import TableBase, tables_of
from codegen.symbolic.graph import Assignment
from codegen.symbolic.tables import KINDS, ORDERS, OUTSIDE, TableData

CACHED = ('@njit(cache=True, error_model="numpy")',)
"""Decorator of functions that Python code calls; division by zero gives infinity, as in numpy."""
INNER = ("@inner_kernel",)
"""Decorator of functions that only compiled functions call: their machine code is cached with the caller's."""

KERNEL, VALUE = ("@Kernel",), ("@Value",)
"""Decorators of functions that are called by their address: a `Kernel` fills arrays, a `Value` returns a number."""


@dataclass(frozen=True)
class Line:
    """One assignment `target = code` (or another `operator`), with a comment on its meaning."""

    target: str
    code: str
    comment: str = ""
    operator: str = "="


@dataclass(frozen=True)
class Loop:
    """Lines that are repeated `count` times; their code may contain the number i of the repetition."""

    count: int
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Kernel:
    """A numba function: `inputs` unpack arrays, `body` holds the common subexpressions, `outputs` fill arrays.

    `results` has the code of the returned value, if any; `decorators` are lines above the function. `loops` fill arrays
    after `outputs`, and read the `tables`, which are constants of the module.
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
    loops: tuple[Loop, ...] = ()
    tables: tuple[Line, ...] = ()


@dataclass(frozen=True)
class Output:
    """An expression that a kernel assigns (`=`) or adds (`+=`) to an array entry or variable `target`."""

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
    assignments: Sequence[Assignment] = (),
    decorators: tuple[str, ...] = CACHED,
    straight_line: Sequence[Assignment] = (),
) -> Kernel:
    """Return a kernel that evaluates expressions: the `outputs`, and the returned value `result` if there is one.

    `codes` has the code that reads each symbol; a symbol whose code is its own name is an argument. `assignments` give
    values to further symbols, which later assignments and all outputs may read. Assignments of a `straight_line`
    program are used instead if common subexpressions have been found already.
    """
    names = [symbol for symbol, _ in (*assignments, *straight_line)]
    values = [*(value for _, value in (*assignments, *straight_line)), *(output.value for output in outputs)]
    values += [] if result is None else [result]
    expressions = [with_decimal_roots(stabilised(value)) for value in values]
    used = set[Symbol]().union(*(e.free_symbols for e in expressions))
    taken = {s.name for s in codes} | set(arguments)
    body: list[Assignment] = []
    if straight_line:
        body += zip(names, expressions, strict=False)
        reduced = expressions[len(names) :]
    else:
        fresh = (Symbol(f"x{i}", real=True) for i in range(10**9) if f"x{i}" not in taken)
        common, shared = sympy.cse(expressions, symbols=fresh, order="canonical")
        # Each common subexpression precedes the first assignment that reads it; those of outputs alone come last.
        waiting, order = dict(common), [symbol for symbol, _ in common]

        def supply(value: Expr) -> None:
            for symbol in sorted(value.free_symbols & waiting.keys(), key=order.index):
                if symbol in waiting:
                    part = waiting.pop(symbol)
                    supply(part)
                    body.append((symbol, part))

        for symbol, value in zip(names, shared[: len(names)], strict=True):
            supply(value)
            body.append((symbol, value))
        body += waiting.items()
        reduced = shared[len(names) :]
    operations = [int(e.count_ops()) for e in (*(value for _, value in body), *reduced)]
    before = sum(int(e.count_ops()) for e in expressions)
    if straight_line:  # operations if each output were one expression without assignments
        totals: dict[Expr, int] = {}
        before = 0
        for index, (expression, count) in enumerate(zip(expressions, operations, strict=True)):
            total = count + sum(totals.get(part, 0) for part in sympy.preorder_traversal(expression))
            if index < len(names):
                totals[names[index]] = total
            else:
                before += total
    pairs, reduced = _with_lookups(body, reduced, taken | {str(s) for s, _ in body})
    return Kernel(
        name=name,
        summary=summary,
        arguments=tuple(arguments),
        inputs=tuple(Line(s.name, code) for s, code in codes.items() if s in used and code != s.name),
        body=tuple(Line(target, code) for target, code in pairs),
        outputs=tuple(
            Line(output.target, scalar_code(e), output.comment, output.operator)
            for output, e in zip(outputs, reduced, strict=False)
        ),
        results=tuple(scalar_code(e) for e in reduced[len(outputs) :]),
        operations_before=before,
        operations_after=sum(operations),
        decorators=decorators,
    )


def needed(assignments: Sequence[Assignment], read: Iterable[Expr]) -> list[Assignment]:
    """Return the assignments to symbols that the expressions `read` contain, directly or through other assignments."""
    symbols: set[Symbol] = set().union(*(expression.free_symbols for expression in read))
    kept: list[Assignment] = []
    for symbol, value in reversed(assignments):
        if symbol in symbols:
            kept.append((symbol, value))
            symbols |= value.free_symbols
    return kept[::-1]


@dataclass(frozen=True)
class _Lookup:
    """The look-up of a table at a point: code of the point, number of the next line, and symbols of derivatives."""

    table: TableData
    code: str
    line: int
    names: dict[tuple[int, ...], Symbol]


def _with_lookups(
    body: Sequence[Assignment], outputs: Sequence[Expr], taken: Collection[str]
) -> tuple[list[tuple[str, str]], list[Expr]]:
    """Return pairs (target, code) of a kernel's body, with look-ups of tables, and outputs that read these look-ups."""
    lookups: dict[tuple[TableData, tuple[Expr, ...]], _Lookup] = {}
    used = set(taken)

    def name_of(function: TableBase, line: int) -> Symbol:
        """Return the symbol of a table's derivative at a point; the table is looked up before the given line."""
        table, key = function.table, (function.table, function.args)
        if key not in lookups:
            lookups[key] = _Lookup(table, ", ".join(map(scalar_code, function.args)), line, {})
        names = lookups[key].names
        if function.order not in ORDERS[len(function.args)]:
            raise ExpressionError(
                f"the derived equations have a derivative of table {table.shape.name} beyond the third",
                "let the table act as a force, or in dynamics, instead of in a Lagrangian or Hamiltonian",
            )
        if function.order not in names:
            by = "".join(str(i + 1) * o for i, o in enumerate(function.order))
            stem = f"{table.shape.name}_{by}" if by else table.shape.name
            name = next(f"{stem}_at_{n}" for n in count() if f"{stem}_at_{n}" not in used)
            used.add(name)
            names[function.order] = Symbol(name, real=True)
        return names[function.order]

    def without_tables(expression: Expr, line: int) -> Expr:
        while functions := expression.atoms(TableBase):
            inner = [f for f in functions if not any(a.has(TableBase) for a in f.args)]
            expression = expression.xreplace({f: name_of(f, line) for f in sorted(inner, key=str)})
        return expression

    values, same = list[Expr](), dict[Symbol, Expr]()
    for line, (symbol, value) in enumerate(body):
        values.append(without_tables(value.xreplace(same), line))
        if isinstance(value, TableBase):
            same[symbol] = values[-1]
    reduced = [without_tables(value.xreplace(same), len(body)) for value in outputs]
    written: dict[int, list[tuple[str, str]]] = {}
    for lookup in lookups.values():
        orders = ORDERS[len(lookup.table.shape.inputs)]
        targets = [str(lookup.names.get(order, "_")) for order in orders]
        while targets[-1] == "_" and len(targets) > 1:
            targets.pop()
        part = "" if len(targets) == len(orders) else f"[:{len(targets)}]"
        code = f"{lookup.table.shape.lookup}(parameters, {lookup.code}){part if len(targets) > 1 else '[0]'}"
        written.setdefault(lookup.line, []).append((", ".join(targets), code))
    pairs: list[tuple[str, str]] = []
    for line, ((symbol, _), value) in enumerate(zip(body, values, strict=True)):
        pairs += written.get(line, [])
        pairs += [] if symbol in same else [(str(symbol), scalar_code(value))]
    return [*pairs, *written.get(len(body), [])], reduced


# Tables

FORCED = ('@njit(error_model="numpy", forceinline=True)',)
"""Decorator of functions that are inlined in their callers, where the compiler removes unused derivatives."""


def table_kernels(tables: Sequence[TableData], first: int) -> tuple[Kernel, ...]:
    """Return a look-up function for each table; the numbers of tables start at index `first` of the parameters."""
    kernels = []
    for table in tables:
        shape, begin = table.shape, first
        sizes, names = ", ".join(map(str, shape.sizes)), ("x", "y")[: len(shape.sizes)]
        stem, kind = {"monotone": "cubic"}.get(shape.kind, shape.kind), "curve" if len(names) == 1 else "surface"
        code, lines = f"{stem}_{kind}(parameters, {begin}, {sizes}, {', '.join(names)})", []
        if shape.outside == "clamp" and shape.kind != "steps":
            for name, size in zip(names, shape.sizes, strict=True):
                lines.append(Line(f"{name}, in_{name}", f"within(parameters, {begin}, {size}, {name})"))
                begin += size
            code = f"clamped_{kind}({', '.join(f'in_{name}' for name in names)}, *{code})"
        inputs = " and ".join(f"{name} = {quantity}" for name, quantity in zip(names, shape.inputs, strict=True))
        summary = f"The table {shape.name} of {inputs}, with its derivatives up to the third order."
        arguments = ("parameters", *names)
        kernels.append(Kernel(shape.lookup, summary, arguments, (), tuple(lines), (), (code,), 0, 0, FORCED))
        first += shape.count
    return tuple(kernels)


def guess_kernels(tables: Sequence[TableData]) -> tuple[Kernel, ...]:
    """Return a function for each table, used in initial guesses, that looks up the table at many points."""
    kernels = []
    for table in tables:
        shape, names = table.shape, ("x", "y")[: len(table.shape.sizes)]
        points = "zip(x, y)" if len(names) == 2 else "x"
        code = f"np.array([{shape.lookup}(parameters, {', '.join(names)})[number] for {', '.join(names)} in {points}])"
        summary = f"Derivative number `number` of the table {shape.name}, 0 for values, at points of shape (n,)."
        arguments = ("parameters", "number", *names)
        kernels.append(Kernel(f"{shape.lookup}_values", summary, arguments, (), (), (), (code,), 0, 0, CACHED))
    return tuple(kernels)


def table_constants(tables: Sequence[TableData]) -> tuple[Line, ...]:
    """Return the constants with the numbers of all tables and with their total count."""
    if not tables:
        return ()
    written = ""
    for table in tables:
        text, indent = ", ".join(repr(number) for number in table.numbers), " " * 8
        lines = textwrap.wrap(text, 108, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False)
        written += f'    "{table.shape.name}": np.array([\n' + "\n".join(lines) + "\n    ]),\n"
    count = sum(table.shape.count for table in tables)
    return (
        Line("TABLED", str(count), "numbers of tables behind the parameters"),
        Line("TABLES", f"{{\n{written}}}", "breakpoints, then values and slopes there"),
    )


def table_records(tables: Sequence[TableData]) -> dict[str, TableRecord]:
    """Return a record for each table name, with the properties that a file with replacement numbers must have."""
    shapes = [(table.source, table.shape) for table in tables]
    return {s.name: TableRecord(source, s.inputs, s.output, s.kind, s.outside, s.sizes) for source, s in shapes}


def described_tables(tables: Sequence[TableData]) -> list[str]:
    """Return two lines of description for each table, for the docstring of a module."""
    lines = []
    for table in tables:
        lines.append(f"{table.summary}:")
        lines.append(f"    {KINDS[table.shape.kind]}; {OUTSIDE[table.shape.outside]}")
    return lines


@dataclass(frozen=True)
class Input:
    """Input `number` of a table, whose range a solution must not leave; `ends` are parameter indices of the range."""

    table: TableData
    number: int
    ends: tuple[int, int]

    @property
    def name(self) -> str:
        """The name of the input in messages."""
        return f"{self.table.shape.inputs[self.number]} of table {self.table.shape.name}"


def ranged_inputs(tables: Sequence[TableData], first: int, expressions: Sequence[Expr]) -> tuple[Input, ...]:
    """Return the inputs with a range, of `tables` in some expressions; tables are stored from parameter `first` on."""
    inputs, used = [], tables_of(expressions)
    for table in tables:
        index = first
        for number, size in enumerate(table.shape.sizes):
            if table.shape.outside == "error" and table in used:
                inputs.append(Input(table, number, (index, index + size - 1)))
            index += size
        first += table.shape.count
    return tuple(inputs)


def range_constants(inputs: Sequence[Input]) -> tuple[Line, ...]:
    """Return the constants with the number, ranges and names of the inputs that have a range."""
    if not inputs:
        return ()
    ends = ", ".join(f"[{first}, {last}]" for first, last in (i.ends for i in inputs))
    return (
        Line("RANGED", str(len(inputs)), "inputs of tables that have a range"),
        Line("RANGES", f"np.array([{ends}])", "indices of their least and greatest values among the parameters"),
        Line("RANGE_NAMES", repr(tuple(i.name for i in inputs))),
    )


def inputs_kernel(
    name: str,
    where: str,
    arguments: Sequence[str],
    codes: Mapping[Symbol, str],
    inputs: Sequence[Input],
    expressions: Sequence[Expr],
    entry: str = "inputs[{0}, {1}]",
    decorators: tuple[str, ...] = INNER,
) -> Kernel:
    """Return a kernel that fills the least and greatest value of each input in some expressions; it skips others.

    `where` ends its summary. `entry` is code of a value: {0} is the input's number, {1} is 0 (least) or 1 (greatest).
    """
    functions = set[Expr]().union(*(e.atoms(TableBase) for e in expressions))
    outputs = []
    for j, item in enumerate(inputs):
        read = {f.args[item.number] for f in functions if f.table == item.table}
        if values := sorted(read, key=sympy.default_sort_key):
            outputs += [Output(entry.format(j, 0), sympy.Min(*values), f"least {item.name}")]
            outputs += [Output(entry.format(j, 1), sympy.Max(*values), "greatest")]
    summary = f"Least and greatest `inputs` (RANGED, 2) with which tables are read {where}."
    return kernel(name, summary, (*arguments, "inputs"), codes, outputs, decorators=decorators)
