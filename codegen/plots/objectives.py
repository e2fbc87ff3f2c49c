"""Numbers of each case by which cases are compared, by name: what a data set records, or what follows from its arrays.

A Pareto front is the cases of which no other one is better in one objective and at least as good in the other.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError, clause

if TYPE_CHECKING:
    from xarray import Dataset

Numbers = NDArray[np.float64]
SAME = 1e-6
"""Parts of the range of an objective that make no difference, as values at the same bound."""
_COLUMNS = {"q": "coordinate", "u": "control"}
_OTHERS = {"residual", "seconds", "improvement"}
"""Numbers that say how a case was solved, and nothing of its solution."""


@dataclass(frozen=True)
class Objective:
    """A number of each case by its name, that is to be small, or large where a minus stands before it."""

    name: str
    is_large: bool

    @property
    def sign(self) -> float:
        """What values are multiplied by to be small."""
        return -1.0 if self.is_large else 1.0


def objectives_of(text: str) -> tuple[Objective, Objective]:
    """The two objectives of `--pareto A,B`; ArgumentError for anything else."""
    words = [word.strip() for word in text.split(",")]
    if len(words) != 2 or not all(word.removeprefix("-") for word in words) or words[0] == words[1]:
        raise ArgumentError(clause(f"--pareto {text}: a front has two objectives"), "write --pareto cost,duration")
    one, other = (Objective(word.removeprefix("-"), word.startswith("-")) for word in words)
    return one, other


def require_objectives(objectives: tuple[Objective, ...], data: Dataset) -> None:
    """Refuse names that mean nothing for a data set; ArgumentError lists those that do."""
    known = _known(data)
    for objective in objectives:
        if objective.name not in known:
            close = difflib.get_close_matches(objective.name, known, 3, 0.5)
            nearest = f"did you mean {' or '.join(close)}? " if close else ""
            finding = f"--pareto {objective.name}: the sweep has no such number of each case"
            raise ArgumentError(clause(finding), clause(f"{nearest}it has {', '.join(known)}"))


def values_of(objective: Objective, data: Dataset) -> Numbers:
    """The values of an objective, an array over the cases; NaN for what is not solved, unless they vary."""
    return _known(data)[objective.name]()


def is_dominated(one: Numbers, other: Numbers) -> NDArray[np.bool_]:
    """Which of n points (n,) are no part of the front where both are to be small; NaN is nowhere.

    Another point is better in one objective by more than SAME, and in the other at most by this worse.
    """
    dominated = np.zeros(one.size, bool)
    (there,) = np.nonzero(np.isfinite(one) & np.isfinite(other))
    if not there.size:
        return dominated
    x, y = one[there], other[there]
    x_same, y_same = SAME * np.ptp(x), SAME * np.ptp(y)
    order = np.argsort(x, kind="stable")
    # The least of the other objective among the first points in the order of the one.
    least = np.concatenate([[np.inf], np.minimum.accumulate(y[order])])
    left = least[np.searchsorted(x[order], x - x_same, side="left")]
    not_right = least[np.searchsorted(x[order], x + x_same, side="right")]
    dominated[there] = (left <= y + y_same) | (not_right < y - y_same)
    return dominated


def _known(data: Dataset) -> dict[str, Callable[[], Numbers]]:
    """What gives the values of each objective by its name."""
    dims = data["status"].dims
    found: dict[str, Callable[[], Numbers]] = {}
    for name, variable in data.data_vars.items():
        if variable.dims == dims and variable.dtype.kind == "f" and name not in _OTHERS:
            found[str(name)] = lambda own=variable: np.asarray(own.values, dtype=float)  # type: ignore[misc]
    if "d_cost" in data:
        for i, by in enumerate(data["by"].values):
            found[f"d_cost.{by}"] = lambda i=i: np.asarray(data["d_cost"].isel(by=i).values)  # type: ignore[misc]
    for array, column in _COLUMNS.items():
        if array in data:
            rows = str(data[array].dims[len(dims)])
            for i, name in enumerate(data[column].values):
                own = data[array].isel({column: i})
                found |= {f"{word}.{name}": _reduced(own, rows, word) for word in ("start", "end", "max", "min")}
    if "t" in data:
        found["duration"] = lambda: _last(data["t"]) - np.asarray(data["t"].isel(node=0).values)
    for name, coordinate in data.coords.items():
        if coordinate.dims and coordinate.dims[0] in dims and coordinate.dtype.kind in "fiub":
            found[str(name)] = lambda own=coordinate: _over_cases(own, data)  # type: ignore[misc]
    return found


def _over_cases(coordinate: Any, data: Dataset) -> Numbers:
    return np.array(coordinate.broadcast_like(data["status"]).transpose(*data["status"].dims).values, dtype=float)


def _reduced(array: Any, rows: str, word: str) -> Callable[[], Numbers]:
    """What a trajectory comes to."""
    ways: Mapping[str, Callable[[], Any]] = {
        "start": lambda: _flat(array).isel({rows: 0}).values,
        "end": lambda: _last(_flat(array)),
        "max": lambda: _flat(array).max(rows).values,
        "min": lambda: _flat(array).min(rows).values,
    }
    return lambda: np.asarray(ways[word](), dtype=float)


def _flat(array: Any) -> Any:
    """Controls at stages by their means on intervals."""
    return array.mean("stage") if "stage" in array.dims else array


def _last(array: Any) -> Numbers:
    """The last values that are numbers: arrays of fewer steps end in NaN."""
    values = np.asarray(array.values, dtype=float)
    number = np.maximum(1, np.isfinite(values).sum(axis=-1)) - 1
    return np.asarray(np.take_along_axis(values, number[..., None], axis=-1)[..., 0])
