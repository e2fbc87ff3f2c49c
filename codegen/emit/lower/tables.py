"""The tables of a module as strings: look-up functions, numbers, and what is said of them.

Tables with ranges that a solution must not leave: functions that tell with what inputs kernels read them.
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
"""Decorator of functions that become part of their callers, where derivatives that nobody reads are left out."""


def table_kernels(tables: Sequence[TableData], first: int) -> tuple[Kernel, ...]:
    """A function for every table, whose numbers stand among the parameters from the index `first` on."""
    kernels = []
    for table in tables:
        kernels.append(_kernel(table, first))
        first += table.shape.count
    return tuple(kernels)


def _kernel(table: TableData, first: int) -> Kernel:
    shape = table.shape
    sizes, names = ", ".join(map(str, shape.sizes)), ("x", "y")[: len(shape.sizes)]
    stem, kind = {"monotone": "cubic"}.get(shape.kind, shape.kind), "curve" if len(names) == 1 else "surface"
    code, lines = f"{stem}_{kind}(parameters, {first}, {sizes}, {', '.join(names)})", []
    if shape.outside == "clamp" and shape.kind != "steps":
        for name, size in zip(names, shape.sizes, strict=True):
            lines.append(Line(f"{name}, in_{name}", f"within(parameters, {first}, {size}, {name})"))
            first += size
        code = f"clamped_{kind}({', '.join(f'in_{name}' for name in names)}, *{code})"
    inputs = " and ".join(f"{name} = {given}" for name, given in zip(names, shape.inputs, strict=True))
    summary = f"The table {shape.name} of {inputs}, with its derivatives up to the third order."
    return Kernel(shape.lookup, summary, ("parameters", *names), (), tuple(lines), (), (code,), 0, 0, FORCED)


def guess_kernels(tables: Sequence[TableData]) -> tuple[Kernel, ...]:
    """A function for every table that guesses read, which looks it up at many points."""
    kernels = []
    for table in tables:
        shape, names = table.shape, ("x", "y")[: len(table.shape.sizes)]
        at = "zip(x, y)" if len(names) == 2 else "x"
        code = f"np.array([{shape.lookup}(parameters, {', '.join(names)})[number] for {', '.join(names)} in {at}])"
        summary = f"Derivative number `number` of the table {shape.name}, 0 for values, at points of shape (n,)."
        arguments = ("parameters", "number", *names)
        kernels.append(Kernel(f"{shape.lookup}_values", summary, arguments, (), (), (), (code,), 0, 0, CACHED))
    return tuple(kernels)


def table_constants(tables: Sequence[TableData]) -> tuple[Line, ...]:
    """The numbers of all tables, and how many there are."""
    if not tables:
        return ()
    written = "".join(f'    "{table.shape.name}": {_array(table)},\n' for table in tables)
    count = sum(table.shape.count for table in tables)
    return (
        Line("TABLED", str(count), "numbers of tables behind the parameters"),
        Line("TABLES", f"{{\n{written}}}", "breakpoints, then values and slopes there"),
    )


def _array(table: TableData) -> str:
    text = ", ".join(repr(number) for number in table.numbers)
    lines = textwrap.wrap(text, 108, initial_indent=" " * 8, subsequent_indent=" " * 8, break_on_hyphens=False)
    return "np.array([\n" + "\n".join(lines) + "\n    ])"


def table_records(tables: Sequence[TableData]) -> dict[str, TableRecord]:
    """What a reader of another file has to know of each table."""
    found = {}
    for table in tables:
        s = table.shape
        found[s.name] = TableRecord(table.source, s.inputs, s.output, s.kind, s.outside, s.sizes)
    return found


def table_arguments(tables: Sequence[TableData]) -> tuple[str, ...]:
    """The argument that takes other numbers, where there are tables."""
    return ("tables",) if tables else ()


def described_tables(tables: Sequence[TableData]) -> list[str]:
    """Every table in a line or two, for the docstring of a module."""
    lines = []
    for table in tables:
        lines.append(f"{table.summary}:")
        lines.append(f"    {KINDS[table.shape.kind]}; {OUTSIDE[table.shape.outside]}")
    return lines


@dataclass(frozen=True)
class Input:
    """An input of a table whose range a solution must not leave: its number, and the indices of its ends."""

    table: TableData
    number: int
    ends: tuple[int, int]

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.table.shape.inputs[self.number]} of table {self.table.shape.name}"

    def values(self, expressions: Sequence[Expr]) -> list[Expr]:
        """With what expressions read the table."""
        functions = set[Expr]().union(*(e.atoms(TableBase) for e in expressions))
        found = {f.args[self.number] for f in functions if f.table == self.table}
        return sorted(found, key=sympy.default_sort_key)


def ranged_inputs(tables: Sequence[TableData], first: int, read: Sequence[Expr]) -> tuple[Input, ...]:
    """The inputs of tables that have a range and that some expressions read.

    Numbers of tables stand among parameters from an index on.
    """
    found, used = [], tables_of(read)
    for table in tables:
        index = first
        for number, size in enumerate(table.shape.sizes):
            if table.shape.outside == "error" and table in used:
                found.append(Input(table, number, (index, index + size - 1)))
            index += size
        first += table.shape.count
    return tuple(found)


def range_constants(inputs: Sequence[Input]) -> tuple[Line, ...]:
    """Names and ranges of the inputs."""
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
    indices: Mapping[Symbol, str],
    inputs: Sequence[Input],
    expressions: Sequence[Expr],
    entry: str = "inputs[{0}, {1}]",
    decorators: tuple[str, ...] = INNER,
) -> Kernel:
    """What tells the least and the greatest value of every input in some expressions; others are left alone.

    `entry` is the code of a value, where the numbers of the input and of one of the two values stand.
    """
    outputs = []
    for j, given in enumerate(inputs):
        if values := given.values(expressions):
            outputs += [Output(entry.format(j, 0), sympy.Min(*values), f"least {given.name}")]
            outputs += [Output(entry.format(j, 1), sympy.Max(*values), "greatest")]
    summary = f"Least and greatest `inputs` (RANGED, 2) with which tables are read {where}."
    return kernel(name, summary, (*arguments, "inputs"), indices, outputs, decorators=decorators)
