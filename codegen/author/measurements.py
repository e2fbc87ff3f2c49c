"""What an author says of measurements: a file, which of its columns holds what, how exact and how trusted they are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import sympy

from codegen.author.data_files import data_file
from codegen.errors import TableError
from codegen.tables.measurements import LOSSES, Layout, MeasurementData, read_measurements


class Measurements:
    """Values that were measured at some times, and that a motion is to fit: `Measurements("oil.csv", values={a: "z"})`.

    The file lies beside the problem file; it has a column of times, `time`, and for every entry of `values`, which maps
    a state, a coordinate or an expression of them to the name of its column, the values that were measured. Times have
    nothing to do with nodes. Cells may be empty where nothing was measured.

    To the cost is added the sum over all values of e^2, e being the motion, as its scheme continues it inside an
    interval, less the value, in parts of its standard deviation. `sigma` maps entries of `values` to that, a positive
    number in the units of the value or the name of a column, or is one for all. Without it errors count as they are,
    and the standard deviation that all have in common is estimated from what is left of them. The `loss` is "squares",
    "huber" (2 |e| - 1 beyond |e| = 1) or "soft-l1" (2 (sqrt(1 + e^2) - 1)), which outliers pull less.

    Raises TableError for a file that holds no such values, naming the line, and for unusable arguments.
    """

    def __init__(
        self,
        file: Path | str,
        *,
        values: Mapping[Any, str],
        time: str = "t",
        sigma: Mapping[Any, float | str] | float | str | None = None,
        loss: str = "squares",
    ) -> None:
        if not isinstance(file, Path | str) or not str(file).isprintable():
            raise TableError(f"the file of measurements is {file!r}", "give its path")
        what = f"measurements {Path(file).as_posix()}"
        columns = _checked_values(what, values)
        _require_name(f"time of {what}", time)
        sigmas = _checked_sigmas(what, sigma, columns)
        if not isinstance(loss, str) or loss not in LOSSES:
            raise TableError(f"loss of {what} is {loss!r}", f"use one of {', '.join(LOSSES)}")
        if loss != "squares" and None in sigmas:
            raise TableError(
                f"{what} have the loss {loss!r} and no sigma", "give sigma, beyond which errors count less"
            )
        self.values: dict[Any, str] = columns
        self.loss = loss
        layout = Layout(time, tuple(columns.values()), sigmas)
        names = [layout.time, *layout.columns]
        if len(set(names)) < len(names):
            raise TableError(f"{what} have a column twice among {', '.join(names)}", "name each once")
        self.data: MeasurementData = read_measurements(data_file(Path(file)), Path(file).as_posix(), layout)

    def __repr__(self) -> str:
        return f"Measurements({self.data.source!r}, values={self.values!r})"


def _checked_values(what: str, values: Any) -> dict[Any, str]:
    if not isinstance(values, Mapping) or not values:
        raise TableError(f"values of {what} are {values!r}", 'map what was measured to columns, as in values={x: "z"}')
    for key, column in values.items():
        if not isinstance(key, sympy.Expr):
            raise TableError(f"values of {what} have the key {key!r}", "use states, or expressions of them")
        _require_name(f"the column of {key} in {what}", column)
    return dict(values)


def _require_name(what: str, name: Any) -> None:
    if not isinstance(name, str) or not name.strip():
        raise TableError(f"{what} is {name!r}", "give the name of a column, as text")


def _checked_sigmas(what: str, sigma: Any, values: Mapping[Any, str]) -> tuple[float | str | None, ...]:
    """Of each column its standard deviation; either all of them have one, or none."""
    if sigma is None:
        return (None,) * len(values)
    given = sigma if isinstance(sigma, Mapping) else dict.fromkeys(values, sigma)
    for key in given:
        if key not in values:
            raise TableError(
                f"sigma of {what} has the key {key}", f"use those of values, {', '.join(map(str, values))}"
            )
    found: list[float | str | None] = []
    for key in values:
        if key not in given:
            raise TableError(f"sigma of {what} lacks {key}", "give every value one, or leave sigma out")
        own = given[key]
        if isinstance(own, str):
            _require_name(f"sigma of {key} in {what}", own)
            found.append(own)
            continue
        number = float(own) if isinstance(own, (int, float, sympy.Number)) and not isinstance(own, bool) else math.nan
        if not 0.0 < number < math.inf:
            raise TableError(f"sigma of {key} in {what} is {own!r}", "give a positive number, or the name of a column")
        found.append(number)
    return tuple(found)
