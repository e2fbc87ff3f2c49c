"""Files of measurements: a column of times, columns of values with empty cells where nothing was measured, rows sorted.

Reading needs neither sympy nor a module. Times have nothing to do with nodes, and may come twice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import TableError
from codegen.symbolic.tables import Columns, read_columns

LOSSES = {
    "squares": "the sum of squares",
    "huber": "the sum of Huber's losses, e^2 up to |e| = 1 and 2 |e| - 1 beyond",
    "soft-l1": "the sum of soft absolute values, 2 (sqrt(1 + e^2) - 1)",
}
"""What is minimised of the errors e, each in parts of its standard deviation; scipy's least_squares has the same."""


@dataclass(frozen=True)
class Layout:
    """What a module is built for: the column of times, that of each value, and its standard deviation.

    A standard deviation is a number, a column, or None where it is unknown, so that errors count as they are.
    """

    time: str
    columns: tuple[str, ...]
    sigmas: tuple[float | str | None, ...]

    @property
    def width(self) -> int:
        """How many numbers belong to a time: itself, the values, their standard deviations."""
        return 1 + 2 * len(self.columns)


@dataclass(frozen=True)
class MeasurementData:
    """One file of measurements: rows (time, values, standard deviations) by time, NaN where nothing was measured.

    `lines` says where each row stands in the file.
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
        """What was measured, on one line."""
        values = self.array[:, 1 : 1 + len(self.layout.columns)]
        times, count = self.array[:, 0], int(np.isfinite(values).sum())
        return f"{count} values of {', '.join(self.layout.columns)} at {times.size} times from {self.source}"


def read_measurements(path: Path, source: str, layout: Layout) -> MeasurementData:
    """Read a file; TableError names the line, and the column, of what is unusable."""
    deviations = [sigma for sigma in layout.sigmas if isinstance(sigma, str)]
    names = list(dict.fromkeys([layout.time, *layout.columns, *deviations]))
    columns = read_columns(path, names, optional={*layout.columns, *deviations})
    return _checked(columns, source, layout)


def given_measurements(given: Mapping[str, Any], layout: Layout) -> MeasurementData:
    """The same from columns by name, each of shape (n,), with NaN where nothing was measured."""
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
    return _checked(Columns(Path(source), values, tuple(range(values[layout.time].size))), source, layout)


def _checked(columns: Columns, source: str, layout: Layout) -> MeasurementData:
    """Values and standard deviations, by time; TableError for a deviation that is none, and where all is empty."""
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
    """Refuse times outside a motion; TableError names the line of the first of them."""
    rounding = 1e-9 * duration
    for line, time in zip(data.lines, data.array[:, 0], strict=True):
        if not -rounding <= time <= duration + rounding:
            raise TableError(
                f"{data.source}:{line}: {data.layout.time} is {time:g}, and the motion lasts from 0 to {duration:g}",
                "take the row out, or change the duration",
            )
