"""Tables, initial guesses and measurements that are read from files of numbers.

A table is a function in a problem, with exact derivatives.
"""

from __future__ import annotations

import keyword
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import sympy
from sympy import Expr

from codegen.errors import TableError, nearest
from codegen.problem.points import data_file
from codegen.problem.symbols import ControlInput, Coordinate, Quantity, State
from codegen.symbolic.checks import checked
from codegen.symbolic.functions import table_function
from codegen.symbolic.tables import (
    KINDS,
    LOSSES,
    OUTSIDE,
    Layout,
    MeasurementData,
    TableData,
    read_columns,
    read_measurements,
    read_table,
)


class Table:
    """A function of one or two quantities that interpolates the numbers in a file.

    `thrust = Table("thrust.csv", inputs=("mach", "altitude"), output="thrust")` reads three columns of a file. Then
    `thrust(M, h)` is used like a function of sympy. Numbers in the file have the units of the problem.

    Parameters
    ----------
    file : path
        Path of the file, relative to the folder of the problem file. For two inputs the file has a row for every pair
        of values on a rectangular grid, in any order.
    inputs : str or sequence of str
        Names of one or two columns.
    output : str
        Name of the column of values.
    kind : {"cubic", "monotone", "linear", "steps"}
        Interpolation: "cubic" is a spline with two continuous derivatives. "monotone" is a spline with one continuous
        derivative and without overshoot, for one input. "linear" is piecewise linear; Newton's method may fail at its
        kinks. "steps" is piecewise constant, for guesses only.
    outside : {"error", "extend", "clamp"}
        Values outside the range of the table: "extend" continues the polynomials at the edge, and "clamp" keeps the
        value at the edge. "error" also continues the polynomials, but a solution that uses them has the status "outside
        a table".
    name : str
        Name in messages and in the option `tables` of solves, by default `output`.

    Raises
    ------
    TableError
        For an unusable file, with the line, and for unusable arguments.
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
        columns = (inputs,) if isinstance(inputs, str) else inputs
        name = output if name is None else name
        _require_arguments(file, columns, output, kind, outside, name)
        if kind == "steps":
            outside = "clamp"  # a table of steps always keeps the value at its edge
        path = data_file(Path(file))
        self.data: TableData = read_table(path, Path(file).as_posix(), name, columns, output, kind, outside)

    def __call__(self, *at: Expr | float) -> Expr:
        """Return the value of the table for numbers or expressions, one for each input."""
        shape = self.data.shape
        if len(at) != len(shape.inputs):
            raise TableError(
                f"table {shape.name} is called with {len(at)} arguments",
                f"give {' and '.join(shape.inputs)}, as in {shape.name}({', '.join(shape.inputs)})",
            )
        values = [checked(a, f"{name} of table {shape.name}") for a, name in zip(at, shape.inputs, strict=True)]
        return table_function(self.data, (0,) * len(at))(*values)

    @property
    def range(self) -> tuple[tuple[float, float], ...]:
        """Least and greatest breakpoint of each input."""
        return tuple((float(axis[0]), float(axis[-1])) for axis in self.data.axes)

    @property
    def values(self) -> np.ndarray:
        """Values at the breakpoints, with the shape (n,) for one input or (n, m) for two inputs."""
        return np.array(self.data.heights[..., 0])

    def __repr__(self) -> str:
        return f"Table({self.data.source!r}, {self.data.shape.inputs!r}, {self.data.shape.output!r})"


class Trajectory:
    """A motion that is read from a file as an initial guess: `guess=Trajectory("start.csv")`.

    Before the first row and after the last row the values are constant.

    Parameters
    ----------
    file : path
        A file with a column of times, and columns with the names of coordinates, states and controls.
    time : str
        Name of the column of times.
    columns : sequence of str
        Names of the columns to use, by default all.
    kind : {"linear", "cubic", "monotone", "steps"}
        Interpolation between rows; "steps" holds each value until the next row.

    Raises
    ------
    TableError
        As for Table.
    """

    def __init__(
        self, file: Path | str, *, time: str = "t", columns: Sequence[str] | None = None, kind: str = "linear"
    ) -> None:
        _require_arguments(file, (time,), f"a column beside {time}", kind, "clamp", "trajectory")
        path = data_file(Path(file))
        if columns is not None and (isinstance(columns, str) or not all(isinstance(name, str) for name in columns)):
            raise TableError(f"columns of {file} are {columns!r}", 'name them, as in columns=["x", "v"]')
        table = read_columns(path, () if columns is None else [time, *columns])
        if time not in table.values:
            raise TableError(f"{path}: there is no column {time!r}", 'name the column of times, as in time="t"')
        names = [name for name in table.values if name != time]
        if not names:
            raise TableError(f"{path} has no column beside {time!r}", "add columns called like states and controls")
        self.file = Path(file).as_posix()
        self.tables: dict[str, TableData] = {
            name: read_table(path, self.file, f"guess_{number}", (time,), name, kind, "clamp")
            for number, name in enumerate(names, start=1)
        }


def guess_entries(guess: object, quantities: Iterable[Quantity], time: Expr) -> object:
    """Return the argument `guess` of a problem with tables and trajectories replaced by expressions of time.

    Raise TableError if a column of a trajectory has the name of no quantity, and for a table of two inputs.
    """
    if isinstance(guess, Trajectory):
        named = {quantity.name: quantity for quantity in quantities if isinstance(quantity, _GUESSED)}
        for column in guess.tables:
            if column not in named:
                remedy = nearest(column, named, f"call it like one of {', '.join(named)},")
                finding = f"{guess.file}: no quantity that may be guessed is called {column}"
                raise TableError(finding, f"{remedy} or choose columns=[...]")
        return {named[column]: table_function(table, (0,))(time) for column, table in guess.tables.items()}
    if not isinstance(guess, Mapping):
        return guess
    return {key: value(time) if isinstance(value, Table) else value for key, value in guess.items()}


_GUESSED = (Coordinate, State, ControlInput)
"""The kinds of quantities for which a trajectory may have a column."""


def _require_arguments(
    file: object, inputs: Sequence[str], output: str, kind: object, outside: object, name: object
) -> None:
    if not isinstance(file, Path | str) or not str(file).isprintable():
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
    for what, choice, known in (("kind", kind, KINDS), ("outside", outside, OUTSIDE)):
        if choice not in known:
            raise TableError(f"{what} of table {name} is {choice!r}", f"use one of {', '.join(known)}")
    if len(inputs) == 2 and kind in ("monotone", "steps"):
        raise TableError(f"table {name} of two inputs is {kind}", "use cubic or linear, or a table of one input")


class Measurements:
    """Measured values to which a motion is fitted, as in `Measurements("oil.csv", values={a: "z"})`.

    The sum of e^2 over all measured values is added to the cost. The error e is the value of the motion minus the
    measured value, divided by the standard deviation. The times of measurements need not be nodes; the scheme
    interpolates the motion inside an interval.

    Parameters
    ----------
    file : path
        Path of the file, relative to the folder of the problem file. Its cells may be empty.
    values : dict
        Measured quantities, which are states, coordinates or expressions of them, with the names of their columns.
    time : str
        Name of the column of times.
    sigma : float, str or dict
        Standard deviations: positive numbers in the units of the values, or names of columns. A dict has an entry for
        each measured quantity; otherwise all quantities have the same standard deviation. Without `sigma` errors are
        not scaled, and a common standard deviation is estimated from the residuals.
    loss : {"squares", "huber", "soft-l1"}
        Loss function of the error: "squares" is e^2. "huber" is e^2 up to |e| = 1, and 2 |e| - 1 beyond. "soft-l1" is
        2 (sqrt(1 + e^2) - 1). The last two reduce the effect of outliers.

    Raises
    ------
    TableError
        For a file without these values, with the line, and for unusable arguments.
    """

    def __init__(
        self,
        file: Path | str,
        *,
        values: Mapping[Expr, str],
        time: str = "t",
        sigma: Mapping[Expr, float | str] | float | str | None = None,
        loss: str = "squares",
    ) -> None:
        if not isinstance(file, Path | str) or not str(file).isprintable():
            raise TableError(f"the file of measurements is {file!r}", "give its path")
        what = f"measurements {Path(file).as_posix()}"
        if not isinstance(values, Mapping) or not values:
            remedy = 'map what was measured to columns, as in values={x: "z"}'
            raise TableError(f"values of {what} are {values!r}", remedy)
        for key, column in values.items():
            if not isinstance(key, sympy.Expr):
                raise TableError(f"values of {what} have the key {key!r}", "use states, or expressions of them")
            _require_name(f"the column of {key} in {what}", column)
        _require_name(f"time of {what}", time)
        sigmas: list[float | str | None] = [None] * len(values)
        if sigma is not None:
            deviations = sigma if isinstance(sigma, Mapping) else dict.fromkeys(values, sigma)
            for key in deviations:
                if key not in values:
                    remedy = f"use those of values, {', '.join(map(str, values))}"
                    raise TableError(f"sigma of {what} has the key {key}", remedy)
            for index, key in enumerate(values):
                if key not in deviations:
                    raise TableError(f"sigma of {what} lacks {key}", "give every value one, or leave sigma out")
                sigmas[index] = _checked_sigma(f"sigma of {key} in {what}", deviations[key])
        if not isinstance(loss, str) or loss not in LOSSES:
            raise TableError(f"loss of {what} is {loss!r}", f"use one of {', '.join(LOSSES)}")
        if loss != "squares" and None in sigmas:
            raise TableError(
                f"{what} have the loss {loss!r} and no sigma", "give sigma, beyond which errors count less"
            )
        self.values: dict[Expr, str] = dict(values)
        self.loss = loss
        layout = Layout(time, tuple(self.values.values()), tuple(sigmas))
        names = [layout.time, *layout.columns]
        if len(set(names)) < len(names):
            raise TableError(f"{what} have a column twice among {', '.join(names)}", "name each once")
        self.data: MeasurementData = read_measurements(data_file(Path(file)), Path(file).as_posix(), layout)

    def __repr__(self) -> str:
        return f"Measurements({self.data.source!r}, values={self.values!r})"


def _require_name(what: str, name: object) -> None:
    if not isinstance(name, str) or not name.strip():
        raise TableError(f"{what} is {name!r}", "give the name of a column, as text")


def _checked_sigma(what: str, value: Expr | float | str) -> float | str:
    if isinstance(value, str):
        _require_name(what, value)
        return value
    is_number = isinstance(value, (int, float, sympy.Number)) and not isinstance(value, bool)
    number = float(value) if is_number else math.nan
    if not 0.0 < number < math.inf:
        raise TableError(f"{what} is {value!r}", "give a positive number, or the name of a column")
    return number
