"""Tables and measurements in files, and tables as piecewise polynomials, without sympy.

A file has a line of column names, then rows of numbers. Comments follow `#`. A table of two inputs has a row for
every pair of the grid, in any order. Measurements have a column of times and columns of values, with empty cells for
missing values; times need not be nodes, and may occur twice.

A table consists of breakpoints and of the numbers of a piecewise polynomial at each of them. Its derivatives are
evaluated in any arithmetic: floating-point and complex arrays, numbers with many digits. Real parts decide branches, so
that complex steps and differences with many digits see one polynomial. Source: de Boor (2001), A practical guide to
splines, chapter 4, for Hermite's form.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import TableError

KINDS = {
    "cubic": "a cubic spline with two continuous derivatives",
    "monotone": "cubics with one continuous derivative that are monotone where the data are",
    "linear": "straight lines, whose slope jumps at every breakpoint",
    "steps": "the value of the breakpoint before, with a slope of zero",
}
"""Kinds of interpolation between breakpoints, and the properties of each kind."""
OUTSIDE = {
    "error": "a solution that reads it outside its range is no solution",
    "clamp": "outside it has the value at the edge, and the slope zero",
    "extend": "outside the outermost polynomials go on",
}
"""Rules for inputs before the first or after the last breakpoint, and their effect."""


@dataclass(frozen=True)
class Shape:
    """The properties of a table on which a generated module depends: all except its numbers.

    `inputs` are the names of one or two inputs. `sizes` are the numbers of breakpoints of each input.
    """

    name: str
    inputs: tuple[str, ...]
    output: str
    kind: str
    outside: str
    sizes: tuple[int, ...]

    @property
    def lookup(self) -> str:
        """The name of the generated function that evaluates the table."""
        return f"table_{self.name}"

    @property
    def width(self) -> int:
        """The number of entries at a breakpoint: the value, and for cubics also the slopes."""
        return 1 if self.kind in ("linear", "steps") else 2 ** len(self.sizes)

    @property
    def count(self) -> int:
        """The length of `TableData.numbers`."""
        return sum(self.sizes) + int(np.prod(self.sizes)) * self.width


@dataclass(frozen=True)
class TableData:
    """A table: its shape, the name of its file, and its numbers, shape (count,).

    First come the breakpoints of each input, then the entries at every breakpoint; the second input runs fastest. The
    entry is the value f. Cubics also have slopes: f' for one input, and f_1, f_2, f_12 (partial derivatives) for two.
    Every kind of cubic spline is evaluated in Hermite's form from these numbers.
    """

    shape: Shape
    source: str
    numbers: tuple[float, ...]

    @property
    def summary(self) -> str:
        """A description of the table on one line."""
        shape = self.shape
        ranges = " and ".join(
            f"{name} ({axis.size} from {axis[0]:g} to {axis[-1]:g})"
            for name, axis in zip(shape.inputs, self.axes, strict=True)
        )
        return f"{shape.name} = {shape.output} of {ranges}, {shape.kind}, from {self.source}"

    @property
    def axes(self) -> list[NDArray[np.float64]]:
        """The breakpoints of each input."""
        ends = np.cumsum(self.shape.sizes)
        return np.split(np.array(self.numbers[: ends[-1]]), ends[:-1])

    @property
    def heights(self) -> NDArray[np.float64]:
        """The entries at all breakpoints, shape (*sizes, width)."""
        return np.array(self.numbers[sum(self.shape.sizes) :]).reshape(*self.shape.sizes, self.shape.width)


def fitted(shape: Shape, source: str, axes: Sequence[NDArray[np.float64]], values: NDArray[np.float64]) -> TableData:
    """Return the table that has `values`, shape `shape.sizes`, at the breakpoints `axes` of its inputs.

    Cubic splines have the end conditions "not a knot"; splines of two inputs are products of splines of one input.
    Sources: de Boor (2001), A practical guide to splines, chapters 4 and 17; Fritsch and Butland (1984), A method for
    constructing local monotone piecewise cubic interpolants, SIAM J. Sci. Stat. Comput. 5.
    """
    heights = [values]
    if shape.width > 1:
        heights = [values, *(_slopes(shape.kind, axis, values, index) for index, axis in enumerate(axes))]
        if len(axes) == 2:
            heights.append(_slopes(shape.kind, axes[1], heights[1], 1))
    stacked = np.stack(heights, axis=-1)
    numbers = np.concatenate([*axes, stacked.ravel()])
    return TableData(shape, source, tuple(map(float, numbers)))


def _slopes(kind: str, axis: NDArray[np.float64], values: NDArray[np.float64], index: int) -> NDArray[np.float64]:
    """Return the slopes at the breakpoints `axis` of splines along dimension `index` of the values."""
    from scipy.interpolate import CubicSpline, PchipInterpolator

    spline = (CubicSpline if kind == "cubic" else PchipInterpolator)(axis, values, axis=index)
    return np.asarray(spline(axis, nu=1), dtype=float)


MOST = 20_000
"""Largest number of rows of a file; longer measurements must be smoothed or thinned out before a fit."""
_LEAST = {"cubic": 4, "monotone": 2, "linear": 2, "steps": 1}


@dataclass(frozen=True)
class Columns:
    """The columns of a file by name, each of shape (rows,), and the line number of each row."""

    path: Path
    values: dict[str, NDArray[np.float64]]
    lines: tuple[int, ...]

    def refused(self, row: int, finding: str, remedy: str) -> TableError:
        """Return the error about a row, with the line number of the row."""
        return TableError(f"{self.path}:{self.lines[row]}: {finding}", remedy)


def read_columns(path: Path, names: Sequence[str] = (), optional: Collection[str] = ()) -> Columns:
    """Return the columns `names` of a file, or all columns; NaN replaces empty cells of `optional` columns.

    Raises TableError with file and line if the file is missing or not text, lacks a column, or has ragged rows. The
    same error is raised if a cell of a returned column is not a finite number.
    """
    if not path.is_file():
        finding = "is a directory" if path.is_dir() else "no such file"
        raise TableError(f"{path}: {finding}", "give the path of a file of numbers")
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = csv.reader(line.partition("#")[0] for line in file)
            fields = ((number, [field.strip() for field in row]) for number, row in enumerate(lines, 1))
            rows = [(number, row) for number, row in fields if any(row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise TableError(f"{path} cannot be read ({error})", "give a table of numbers as text") from error
    if not rows:
        raise TableError(f"{path} is empty", "name the columns in the first line, and give rows of numbers")
    (first, header), body = rows[0], rows[1:]
    listed = ", ".join(header)[:100]
    for name in header:
        if header.count(name) > 1:
            raise TableError(f"{path}:{first}: two columns are called {name!r}", "give each another name")
    for name in names:
        if name not in header:
            if len(header) == 1 and (separator := next((sign for sign in ";\t|" if sign in header[0]), "")):
                finding = f"{path}:{first}: {separator!r} separates the columns"
                raise TableError(finding, "separate columns by commas, and write decimals with points")
            raise TableError(f"{path}:{first}: there is no column {name!r}", f"name one of {listed}, or add it")
    chosen = {name: header.index(name) for name in names or header}
    if len(body) > MOST:
        raise TableError(f"{path} has {len(body)} rows", f"give at most {MOST}, by means over neighbours for example")
    empty = {chosen[name] for name in optional}
    table = np.full((len(body), len(chosen)), math.nan)
    for i, (line, row) in enumerate(body):
        if len(row) != len(header):
            finding = f"{path}:{line}: {len(row)} values for {len(header)} columns"
            raise TableError(finding, f"give {','.join(header)[:100]} in every row")
        for j, index in enumerate(chosen.values()):
            if index in empty and not row[index]:
                continue
            with suppress(ValueError):
                table[i, j] = math.nan if "_" in row[index] else float(row[index])
            if not math.isfinite(table[i, j]):
                raise TableError(f"{path}:{line}: {header[index]} is {row[index][:30]!r}", "give finite numbers")
    return Columns(path, {name: table[:, i] for i, name in enumerate(chosen)}, tuple(line for line, _ in body))


def read_table(
    path: Path, source: str, name: str, inputs: Sequence[str], output: str, kind: str, outside: str
) -> TableData:
    """Return the table fitted to a file; `source` names the file in reports, TableError the unusable line."""
    columns = read_columns(path, [*inputs, output])
    if len(inputs) == 1:
        axis = columns.values[inputs[0]]
        axes, values = [axis], columns.values[output]
        for row in range(1, axis.size):
            if not axis[row] > axis[row - 1]:
                what = "twice" if axis[row] == axis[row - 1] else f"after {axis[row - 1]:g}"
                raise columns.refused(row, f"{inputs[0]} is {axis[row]:g} {what}", "sort the rows, each value once")
    else:
        axes, values = _grid(columns, inputs, output)
    least = _LEAST[kind]
    for column, axis in zip(inputs, axes, strict=True):
        if axis.size < least:
            finding = f"{path} has {axis.size} value{'s' * (axis.size != 1)} of {column}"
            raise TableError(finding, f"a {kind} table needs {least} or more; give more, or another kind")
    shape = Shape(name, tuple(inputs), output, kind, outside, tuple(axis.size for axis in axes))
    return fitted(shape, source, axes, values)


def _grid(
    columns: Columns, inputs: Sequence[str], output: str
) -> tuple[list[NDArray[np.float64]], NDArray[np.float64]]:
    """Return the breakpoints of two inputs and the output at all pairs; TableError for a missing or repeated pair."""
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
        # Report the line of the first row with the same value of the first input.
        line = columns.lines[int(rows[i][rows[i] >= 0].min())]
        raise TableError(
            f"{columns.path}:{line}: there is no row with {what}",
            f"give all {rows.size} pairs of the grid of {axes[0].size} values of {inputs[0]} and {axes[1].size} of "
            f"{inputs[1]}",
        )
    return axes, columns.values[output][rows]


Number: TypeAlias = Any
"""A number or an array, in any arithmetic: floating-point, complex, or of mpmath."""
Indices: TypeAlias = NDArray[np.intp]
DEGREE = 3
ORDERS: dict[int, tuple[tuple[int, ...], ...]] = {
    1: ((0,), (1,), (2,), (3,)),
    2: ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)),
}
"""The partial derivatives that generated table functions return, by the number of inputs."""
_HERMITE = ((1, 0, -3, 2), (0, 1, -2, 1), (0, 0, 3, -2), (0, 0, -1, 1))
"""Hermite's cubics as coefficients of 1, s, s^2, s^3: for the value and slope at s = 0, then at s = 1."""
_BASES: dict[str, tuple[tuple[int, ...], ...]] = {"linear": ((1, -1), (0, 1))}


def derivative(
    table: TableData, order: Sequence[int], at: Sequence[Number], real: Callable[[Number], Number]
) -> Number:
    """Return a derivative at the inputs `at`, `order[i]` times with respect to input i; `real` returns real parts."""
    kind, heights = table.shape.kind, table.heights
    if kind == "steps":
        before = np.searchsorted(table.axes[0], np.asarray(real(at[0]), dtype=float), side="right") - 1
        return at[0] * 0 + (0.0 if order[0] else heights[np.clip(before, 0, table.shape.sizes[0] - 1), 0])
    parts = [_part(axis, table, o, x, real) for axis, o, x in zip(table.axes, order, at, strict=True)]
    if len(parts) == 1:
        cell, weights = parts[0]
        width = 2 if kind in ("cubic", "monotone") else 1
        terms = [_plain(heights[cell + i // width, i % width]) * weight for i, weight in enumerate(weights)]
        return sum(terms[1:], terms[0])
    (row, down), (column, across) = parts
    width = 2 if kind == "cubic" else 1
    terms = []
    for i, one in enumerate(down):
        for j, other in enumerate(across):
            # The last index of heights is 0 to 3 for f, f_1, f_2, f_12.
            height = heights[row + i // width, column + j // width, i % width + 2 * (j % width)]
            terms.append(_plain(height) * one * other)
    return sum(terms[1:], terms[0])


def _part(
    axis: NDArray[np.float64], table: TableData, order: int, x: Number, real: Callable[[Number], Number]
) -> tuple[Indices, list[Number]]:
    """Return the index of the interval with `x`, and the derivatives of the weights of the entries at its ends."""
    flat, at, factor = np.asarray(real(x), dtype=float), x, None
    if table.shape.outside == "clamp":
        inside = (flat >= axis[0]) & (flat <= axis[-1])
        edge = np.where(flat < axis[0], axis[0], axis[-1])
        at = np.where(inside, x, edge) if flat.ndim else (x if inside else x * 0 + float(edge))
        factor = (np.where(inside, 1.0, 0.0) if flat.ndim else int(inside)) if order else None
    cell = np.clip(np.searchsorted(axis, flat, side="right") - 1, 0, axis.size - 2)
    left, length = _plain(axis[cell]), _plain(np.diff(axis)[cell])
    s = (at - left) / length
    weights = [_differentiated(polynomial, order, s) for polynomial in _BASES.get(table.shape.kind, _HERMITE)]
    for number in (1, 3) if len(weights) == len(_HERMITE) else ():
        weights[number] = weights[number] * length
    for _ in range(order):
        weights = [weight / length for weight in weights]
    return cell, weights if factor is None else [weight * factor for weight in weights]


def _plain(height: Number) -> Number:
    return float(height) if np.ndim(height) == 0 else height


def _differentiated(polynomial: Sequence[int], order: int, s: Number) -> Number:
    """Return a derivative at s of the polynomial with coefficients of 1, s, s^2, ..."""
    coefficients = list(polynomial)
    for _ in range(order):
        coefficients = [k * c for k, c in enumerate(coefficients)][1:] or [0]
    total = s * 0 + coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = total * s + coefficient
    return total


LOSSES = {
    "squares": "the sum of squares",
    "huber": "the sum of Huber's losses, e^2 up to |e| = 1 and 2 |e| - 1 beyond",
    "soft-l1": "the sum of soft absolute values, 2 (sqrt(1 + e^2) - 1)",
}
"""Loss functions of errors e, divided by their standard deviations, as in scipy's least_squares."""


@dataclass(frozen=True)
class Layout:
    """The names of the columns that a module reads: times, measured values, and their standard deviations.

    A standard deviation is a number, a column, or None if unknown; then errors are not scaled.
    """

    time: str
    columns: tuple[str, ...]
    sigmas: tuple[float | str | None, ...]

    @property
    def width(self) -> int:
        """The number of entries in a row: the time, the values, their standard deviations."""
        return 1 + 2 * len(self.columns)


@dataclass(frozen=True)
class MeasurementData:
    """One file of measurements: rows (time, values, standard deviations) sorted by time, NaN for missing values.

    `lines` are the line numbers of the rows in the file.
    """

    layout: Layout
    source: str
    rows: tuple[tuple[float, ...], ...]
    lines: tuple[int, ...]

    @property
    def array(self) -> NDArray[np.float64]:
        """The rows, shape (n, width)."""
        return np.array(self.rows).reshape(-1, self.layout.width)

    @property
    def summary(self) -> str:
        """A description of the measurements on one line."""
        values = self.array[:, 1 : 1 + len(self.layout.columns)]
        times, count = self.array[:, 0], int(np.isfinite(values).sum())
        return f"{count} values of {', '.join(self.layout.columns)} at {times.size} times from {self.source}"


def read_measurements(path: Path, source: str, layout: Layout) -> MeasurementData:
    """Return the measurements in a file; TableError names the unusable line and column."""
    deviations = [sigma for sigma in layout.sigmas if isinstance(sigma, str)]
    names = list(dict.fromkeys([layout.time, *layout.columns, *deviations]))
    columns = read_columns(path, names, optional={*layout.columns, *deviations})
    return _checked_measurements(columns, source, layout)


def given_measurements(given: Mapping[str, object], layout: Layout) -> MeasurementData:
    """Return the measurements in `given`: columns by name, each of shape (n,), with NaN for missing values."""
    source = "the columns given"
    deviations = [sigma for sigma in layout.sigmas if isinstance(sigma, str)]
    values: dict[str, NDArray[np.float64]] = {}
    for name in dict.fromkeys([layout.time, *layout.columns, *deviations]):
        if name not in given:
            raise TableError(
                f"{source} lack {name!r}", f"give {', '.join([layout.time, *layout.columns, *deviations])}"
            )
        try:
            values[name] = np.array(given[name], dtype=float)
        except (TypeError, ValueError) as error:
            raise TableError(f"column {name!r} of {source} holds what is no number", "give numbers") from error
        if values[name].ndim != 1 or values[name].shape != values[layout.time].shape:
            raise TableError(
                f"column {name!r} of {source} has shape {values[name].shape}", "give as many as there are times"
            )
    finite = {name: np.isfinite(column) | (np.isnan(column) & (name != layout.time)) for name, column in values.items()}
    for name, usable in finite.items():
        if not usable.all():
            row = int(np.flatnonzero(~usable)[0])
            raise TableError(f"{name}[{row}] of {source} is {values[name][row]}", "give finite numbers")
    return _checked_measurements(Columns(Path(source), values, tuple(range(values[layout.time].size))), source, layout)


def _checked_measurements(columns: Columns, source: str, layout: Layout) -> MeasurementData:
    """Return measurements sorted by time; TableError for an invalid standard deviation or an empty column."""
    times = columns.values[layout.time]
    values = [columns.values[name] for name in layout.columns]
    sigmas = []
    for name, value, sigma in zip(layout.columns, values, layout.sigmas, strict=True):
        if not isinstance(sigma, str):
            sigmas.append(np.full(times.size, 1.0 if sigma is None else sigma))
            continue
        sigmas.append(columns.values[sigma])
        for row in np.flatnonzero(np.isfinite(value) & ~(sigmas[-1] > 0.0)):
            found = "empty" if math.isnan(sigmas[-1][row]) else f"{sigmas[-1][row]:g}"
            raise columns.refused(
                int(row), f"{sigma}, the standard deviation of {name}, is {found}", "let it be positive"
            )
        sigmas[-1] = np.where(np.isfinite(value), sigmas[-1], 1.0)
    for name, value in zip(layout.columns, values, strict=True):
        if not np.isfinite(value).any():
            raise TableError(f"{columns.path}: column {name} holds no value", "give some, or leave the column out")
    rows = np.stack([times, *values, *sigmas], axis=1)
    order = np.argsort(times, kind="stable")
    lines = tuple(columns.lines[row] for row in order)
    return MeasurementData(layout, source, tuple(tuple(map(float, row)) for row in rows[order]), lines)


def require_within(data: MeasurementData, duration: float) -> None:
    """Raise TableError with the line of the first time outside 0 to `duration`, apart from rounding errors."""
    rounding = 1e-9 * duration
    for line, time in zip(data.lines, data.array[:, 0], strict=True):
        if not -rounding <= time <= duration + rounding:
            raise TableError(
                f"{data.source}:{line}: {data.layout.time} is {time:g}, and the motion lasts from 0 to {duration:g}",
                "take the row out, or change the duration",
            )
