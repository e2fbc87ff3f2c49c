"""Tables with ranges that a solution must not leave: functions that tell with what inputs kernels read them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.expressions.table_functions import TableBase, tables_of
from codegen.lower.kernels import INNER, Kernel, Line, Output, kernel
from codegen.tables.data import TableData


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
