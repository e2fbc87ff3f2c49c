"""Files of tables: a line of column names, then rows of numbers, and nothing else but comments after `#`.

A table of two inputs has a row for every pair of the grid, in any order. Reading needs neither sympy nor a module.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from codegen.errors import TableError
from codegen.tables.data import Shape, TableData, fitted

MOST = 20_000
"""Rows: what is measured more often is to be smoothed, or thinned out, before it is fitted."""
_LEAST = {"cubic": 4, "monotone": 2, "linear": 2, "steps": 1}


@dataclass(frozen=True)
class Columns:
    """The columns of a file by name, each of shape (rows,), and the line of every row."""

    path: Path
    values: dict[str, NDArray[np.float64]]
    lines: tuple[int, ...]

    def refused(self, row: int, finding: str, remedy: str) -> TableError:
        """What is said of a row."""
        return TableError(f"{self.path}:{self.lines[row]}: {finding}", remedy)


def read_columns(path: Path, names: Sequence[str] = (), optional: Collection[str] = ()) -> Columns:
    """Read some columns of a file, or all of them; NaN stands for empty cells of `optional` ones.

    Raises TableError, naming the file and the line, when the file is missing or no text, lacks a column, has ragged
    rows, or holds what is no finite number in a column that is read.
    """
    if not path.is_file():
        raise TableError(f"{path}: {'is a directory' if path.is_dir() else 'no such file'}", "give a table as text")
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(_rows(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise TableError(f"{path} cannot be read ({error})", "give a table of numbers as text") from error
    if not rows:
        raise TableError(f"{path} is empty", "name the columns in the first line, and give rows of numbers")
    (first, header), body = rows[0], rows[1:]
    chosen = _indices(path, first, header, names)
    if len(body) > MOST:
        raise TableError(f"{path} has {len(body)} rows", f"give at most {MOST}, by means over neighbours for example")
    empty = {chosen[name] for name in optional}
    values = [
        [_number(path, line, row, header, index, index in empty) for index in chosen.values()] for line, row in body
    ]
    table = np.array(values).reshape(len(body), len(chosen))
    return Columns(path, {name: table[:, i] for i, name in enumerate(chosen)}, tuple(line for line, _ in body))


def _rows(lines: Iterator[str]) -> Iterator[tuple[int, list[str]]]:
    """The fields of every line that holds any, with its number."""
    without = (line.partition("#")[0] for line in lines)
    for number, row in enumerate(csv.reader(without), 1):
        fields = [field.strip() for field in row]
        if any(fields):
            yield number, fields


def _indices(path: Path, line: int, header: Sequence[str], names: Sequence[str]) -> dict[str, int]:
    listed = ", ".join(header)[:100]
    for name in header:
        if header.count(name) > 1:
            raise TableError(f"{path}:{line}: two columns are called {name!r}", "give each another name")
    for name in names:
        if name not in header:
            raise TableError(f"{path}:{line}: there is no column {name!r}", f"name one of {listed}, or add it")
    return {name: header.index(name) for name in names or header}


def _number(path: Path, line: int, row: Sequence[str], header: Sequence[str], index: int, optional: bool) -> float:
    if len(row) != len(header):
        raise TableError(
            f"{path}:{line}: {len(row)} values for {len(header)} columns", f"give {','.join(header)[:100]} in every row"
        )
    if optional and not row[index]:
        return math.nan
    try:
        number = math.nan if "_" in row[index] else float(row[index])
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise TableError(f"{path}:{line}: {header[index]} is {row[index][:30]!r}", "give finite numbers")
    return number


def read_table(
    path: Path, source: str, name: str, inputs: Sequence[str], output: str, kind: str, outside: str
) -> TableData:
    """Read a file and fit the spline of a table; TableError names the line of what is unusable."""
    columns = read_columns(path, [*inputs, output])
    if len(inputs) == 1:
        axes, values = [columns.values[inputs[0]]], columns.values[output]
        _require_ascending(columns, inputs[0])
    else:
        axes, values = _grid(columns, inputs, output)
    least = _LEAST[kind]
    for column, axis in zip(inputs, axes, strict=True):
        if axis.size < least:
            finding = f"{path} has {axis.size} value{'s' * (axis.size != 1)} of {column}"
            raise TableError(finding, f"a {kind} table needs {least} or more; give more, or another kind")
    shape = Shape(name, tuple(inputs), output, kind, outside, tuple(axis.size for axis in axes))
    return fitted(shape, source, axes, values)


def _require_ascending(columns: Columns, name: str) -> None:
    axis = columns.values[name]
    for row in range(1, axis.size):
        if not axis[row] > axis[row - 1]:
            what = "twice" if axis[row] == axis[row - 1] else f"after {axis[row - 1]:g}"
            raise columns.refused(row, f"{name} is {axis[row]:g} {what}", "sort the rows, each value once")


def _grid(
    columns: Columns, inputs: Sequence[str], output: str
) -> tuple[list[NDArray[np.float64]], NDArray[np.float64]]:
    """The breakpoints of two inputs and the values at all pairs; TableError for a pair that is missing or twice."""
    found = [np.unique(columns.values[name], return_inverse=True) for name in inputs]
    axes = [axis for axis, _ in found]
    pairs = np.stack([index.ravel() for _, index in found], axis=1)
    rows = np.full([axis.size for axis in axes], -1)
    for row, (i, j) in enumerate(pairs):
        if rows[i, j] >= 0:
            what = " and ".join(f"{name} {axis[k]:g}" for name, axis, k in zip(inputs, axes, (i, j), strict=True))
            first = columns.lines[rows[i, j]]
            raise columns.refused(row, f"{what} stand in line {first} already", "give each pair once")
        rows[i, j] = row
    if (rows < 0).any():
        i, j = np.argwhere(rows < 0)[0]
        what = " and ".join(f"{name} {axis[k]:g}" for name, axis, k in zip(inputs, axes, (i, j), strict=True))
        # The line is that of the first row with the same value of the first input.
        line = columns.lines[int(rows[i][rows[i] >= 0].min())]
        raise TableError(
            f"{columns.path}:{line}: there is no row with {what}",
            f"give all {rows.size} pairs of the grid of {axes[0].size} values of {inputs[0]} and {axes[1].size} of "
            f"{inputs[1]}",
        )
    return axes, columns.values[output][rows]
