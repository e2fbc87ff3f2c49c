"""The tables of a module as strings: look-up functions, numbers, and what is said of them."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from codegen.lower.kernels import CACHED, Kernel, Line
from codegen.runtime.record import TableRecord
from codegen.tables.data import KINDS, OUTSIDE, TableData

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
