"""Loops over alike rows of a kernel: the equations of a long chain have one loop for all inner links.

A row is a sequence of outputs that belong together, such as an equation and its derivatives. Alike rows differ only in
the indices of arrays. An index is linear in the number i of the repetition, or comes from a table with one row for each
repetition. Common subexpressions are found in one row at a time.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import sympy
from sympy import Expr, Symbol

from codegen.emit.lower.kernels import Kernel, Line, Loop, Output, kernel
from codegen.emit.lower.printer import scalar_code, stabilised, with_decimal_roots
from codegen.symbolic.checks import longer_than
from codegen.symbolic.functions import TableBase
from codegen.symbolic.graph import Assignment
from codegen.symbolic.terms import MANY, Family, are_many, families

_LONG = 100
"""Number of operations from which the value of an assignment is not substituted into the rows."""
_GROWTH = 4
"""Factor by which the rows may grow if assignments are substituted into them."""
Column = tuple[int, ...]
"""The index of an array in each repetition of a loop."""


def looped(
    name: str,
    summary: str,
    arguments: Sequence[str],
    codes: Mapping[Symbol, str],
    outputs: Sequence[Output],
    assignments: Sequence[Assignment] = (),
    decorators: tuple[str, ...] = (),
    straight_line: Sequence[Assignment] = (),
    row_of: Sequence[int] = (),
) -> Kernel:
    """Return the result of `kernel`, with loops over alike rows if there are many.

    `row_of` has the number of the row of each output; by default each output is a row. The `assignments` are
    substituted into the rows of loops. The `straight_line` is evaluated before all rows.
    """
    rows: list[list[Output]] = [[] for _ in range(max(row_of, default=-1) + 1)] if row_of else [[o] for o in outputs]
    for output, row in zip(outputs, row_of, strict=False):
        rows[row].append(output)
    written, kept = _substituted(rows, assignments) if len(rows) >= MANY else (None, [])
    found = families([[o.value for o in row] for row in written or ()], lambda s: _split(codes.get(s, s.name))[0])
    if written is None or not are_many(found):
        return kernel(name, summary, arguments, codes, outputs, None, assignments, decorators, straight_line)
    # Rows that read tables stay outside of loops.
    long = [f for f in found if f.is_large and not any(value.has(TableBase) for value in f.template)]
    inside = {member.row for family in long for member in family.members}
    others = [output for i, row in enumerate(written) if i not in inside for output in row]
    plain = kernel(name, summary, arguments, codes, others, None, kept, decorators, straight_line)
    writer = _Writer(name, codes, {*arguments, *(line.target for line in (*plain.inputs, *plain.body))})
    loops = [writer.loop(family, [written[member.row] for member in family.members]) for family in long]
    read = writer.fixed | {line.target for line in plain.inputs}
    return replace(
        plain,
        inputs=tuple(Line(s.name, code) for s, code in codes.items() if s.name in read and code != s.name),
        loops=tuple(loops),
        tables=tuple(writer.tables),
        operations_before=plain.operations_before + writer.before,
        operations_after=plain.operations_after + writer.after,
    )


def _substituted(
    rows: Sequence[Sequence[Output]], assignments: Sequence[Assignment]
) -> tuple[list[list[Output]] | None, list[Assignment]]:
    """Return rows without short assignments, or None if the rows become much longer, and the long assignments."""
    values, kept = dict[Expr, Expr](), list[Assignment]()
    if not assignments:
        return [list(row) for row in rows], kept
    for symbol, value in assignments:
        written = value.xreplace(values)
        if longer_than(_LONG, [written]):
            kept.append((symbol, written))
        else:
            values[symbol] = written
    replaced = [[replace(output, value=output.value.xreplace(values)) for output in row] for row in rows]
    before = sum(int(value.count_ops()) for _, value in assignments)
    before += sum(int(output.value.count_ops()) for row in rows for output in row)
    after = sum(int(output.value.count_ops()) for row in replaced for output in row)
    return replaced if after <= _GROWTH * before else None, kept


def _split(code: str) -> tuple[str, int]:
    """Return the array and the index in the code of an entry; the code and -1 for other code."""
    match = re.fullmatch(r"(\w+)\[(\d+)\]", code)
    return (match[1], int(match[2])) if match else (code, -1)


class _Writer:
    """A writer of the loops of one kernel.

    `tables` are the constants that the loops read. `fixed` are the names of symbols that are the same in all rows.
    """

    def __init__(self, kernel: str, codes: Mapping[Symbol, str], taken: set[str]) -> None:
        self.kernel, self.codes = kernel, codes
        self.taken = taken | {symbol.name for symbol in codes} | {"i"}
        self.tables: list[Line] = []
        self.fixed: set[str] = set()
        self.before = self.after = 0

    def loop(self, family: Family, rows: Sequence[Sequence[Output]]) -> Loop:
        """Return the loop over the members of a family, whose outputs are `rows`."""
        count = len(family.members)
        table = _Table(f"{self.kernel.upper()}_{len(self.tables) + 1}", count)
        names, inputs = dict[Symbol, Symbol](), list[Line]()
        for slot, symbols in zip(family.slots, zip(*(m.symbols for m in family.members), strict=True), strict=True):
            if len(set(symbols)) == 1:
                names[slot] = symbols[0]
                self.fixed.add(symbols[0].name)
                continue
            arrays, indices = zip(*(_split(self.codes[symbol]) for symbol in symbols), strict=True)
            inputs.append(Line(slot.name, f"{arrays[0]}[{table.code(indices)}]"))
        values = [with_decimal_roots(stabilised(value.xreplace(names))) for value in family.template]
        taken = self.taken | {slot.name for slot in family.slots}
        fresh = (Symbol(f"x{i}", real=True) for i in range(10**9) if f"x{i}" not in taken)
        common, reduced = sympy.cse(values, symbols=fresh, order="canonical")
        outputs = list[Line]()
        for number, value in enumerate(reduced):
            targets = [_split(row[number].target) for row in rows]
            first = rows[0][number]
            target = f"{targets[0][0]}[{table.code([index for _, index in targets])}]"
            comment = f"for i = 0: {first.comment}" if first.comment else ""
            outputs.append(Line(target, scalar_code(value), comment, first.operator))
        if table.columns:
            self.tables.append(table.line)
        self.before += count * sum(int(value.count_ops()) for value in values)
        self.after += count * sum(int(value.count_ops()) for value in (*(value for _, value in common), *reduced))
        body = [Line(symbol.name, scalar_code(value)) for symbol, value in common]
        return Loop(count, (*inputs, *body, *outputs))


class _Table:
    """The indices of a loop that are not linear in the number of the repetition; equal columns are kept once."""

    def __init__(self, name: str, count: int) -> None:
        self.name, self.count = name, count
        self.columns: list[Column] = []

    def code(self, indices: Sequence[int]) -> str:
        """Return the code of an index that has the given values in the repetitions."""
        first, step = indices[0], indices[1] - indices[0]
        if all(index == first + step * i for i, index in enumerate(indices)):
            variable = {0: "", 1: "i"}.get(step, f"{step}*i")
        else:
            column = tuple(index - first for index in indices)
            if column not in self.columns:
                self.columns.append(column)
            variable = f"{self.name}[i, {self.columns.index(column)}]"
        if not variable:
            return str(first)
        return f"{variable} + {first}" if first else variable

    @property
    def line(self) -> Line:
        """The constant of the module that holds the table."""
        rows = (f"[{', '.join(map(str, row))}]" for row in zip(*self.columns, strict=True))
        return Line(self.name, f"np.array([{', '.join(rows)}])", "indices of a loop: rows are its repetitions")
