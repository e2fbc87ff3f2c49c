"""What an author makes of a file of numbers: a function with exact derivatives."""

from __future__ import annotations

import keyword
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codegen.author.data_files import data_file
from codegen.errors import TableError
from codegen.expressions.checks import checked
from codegen.expressions.table_functions import member
from codegen.tables.data import KINDS, OUTSIDE, TableData
from codegen.tables.files import read_table


class Table:
    """A function of one or two quantities that is given by a file of numbers.

    `thrust = Table("thrust.csv", inputs=("mach", "altitude"), output="thrust")` reads three columns of a file that
    lies beside the problem file, and `thrust(M, h)` is then used like any function of sympy. Of two inputs the file
    has a row for every pair of a grid, in any order. Units are the author's.

    The `kind` is "cubic", a spline with two continuous derivatives; "monotone" (of one input), with one, but without
    overshoot; "linear", which has a kink at every breakpoint, where Newton's method may not converge; or "steps", for
    guesses alone. `outside` its range a table goes on as the polynomials at its edge; in the solution that is an
    error, unless it is "extend", or "clamp", which keeps the value at the edge. `name` is what messages, and the
    argument `tables` of solvers, call it, by default `output`.

    Raises TableError for a file that is no such table, naming the line, and for unusable arguments.
    """

    def __init__(
        self,
        file: Path | str,
        inputs: Sequence[str] | str,
        output: str,
        *,
        kind: str = "cubic",
        outside: str = "error",
        name: str | None = None,
    ) -> None:
        own = (inputs,) if isinstance(inputs, str) else inputs
        name = output if name is None else name
        _require_arguments(file, own, output, kind, outside, name)
        path = data_file(Path(file))
        self.data: TableData = read_table(path, Path(file).as_posix(), name, own, output, kind, outside)

    def __call__(self, *at: Any) -> Any:
        """The value at numbers or expressions, one for each input."""
        shape = self.data.shape
        if len(at) != len(shape.inputs):
            raise TableError(
                f"table {shape.name} is called with {len(at)} arguments",
                f"give {' and '.join(shape.inputs)}, as in {shape.name}({', '.join(shape.inputs)})",
            )
        whats = (f"{name} of table {shape.name}" for name in shape.inputs)
        return member(self.data, (0,) * len(at))(*(checked(a, what) for a, what in zip(at, whats, strict=True)))

    @property
    def range(self) -> tuple[tuple[float, float], ...]:
        """The least and the greatest breakpoint of each input."""
        return tuple((float(axis[0]), float(axis[-1])) for axis in self.data.axes)

    @property
    def values(self) -> np.ndarray:
        """What the file gives at the breakpoints, shape (n,) or (n, m)."""
        return np.array(self.data.heights[..., 0])

    def __repr__(self) -> str:
        return f"Table({self.data.source!r}, {self.data.shape.inputs!r}, {self.data.shape.output!r})"


def _require_arguments(file: Any, inputs: Any, output: Any, kind: Any, outside: Any, name: Any) -> None:
    if not isinstance(file, Path | str):
        raise TableError(f"the file of a table is {file!r}", "give its path")
    if not isinstance(inputs, (tuple, list)) or len(inputs) not in (1, 2):
        raise TableError(f"inputs of table {output!r} are {inputs!r}", 'name one or two columns, as in ("mach",)')
    for what, column in [*(("input", column) for column in inputs), ("output", output)]:
        if not isinstance(column, str) or not column.strip():
            raise TableError(f"the {what} {column!r} of table {output!r} is no name of a column", "give it as text")
    if len({*inputs, output}) <= len(inputs):
        raise TableError(f"table {output!r} has a column twice among {', '.join((*inputs, output))}", "name each once")
    if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name):
        raise TableError(f"a table is called {name!r}", 'give an identifier, as in name="thrust"')
    for what, given, known in (("kind", kind, KINDS), ("outside", outside, OUTSIDE)):
        if given not in known:
            raise TableError(f"{what} of table {name} is {given!r}", f"use one of {', '.join(known)}")
    if len(inputs) == 2 and kind in ("monotone", "steps"):
        raise TableError(f"table {name} of two inputs is {kind}", "use cubic or linear, or a table of one input")
