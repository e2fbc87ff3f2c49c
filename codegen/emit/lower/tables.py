"""The tables of a module as strings: look-up functions, numbers, descriptions, and ranges of their inputs.

A table may have a range that a solution must not leave. Kernels then return the least and greatest values of the
inputs with which each such table is read.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.emit.lower.kernels import CACHED, INNER, Kernel, Line, Output, kernel
from codegen.runtime.record import TableRecord
from codegen.symbolic.functions import TableBase, tables_of
from codegen.symbolic.tables import KINDS, OUTSIDE, TableData

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
