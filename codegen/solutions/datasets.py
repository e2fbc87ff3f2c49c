"""A solution as an xarray.Dataset or a pandas.DataFrame, for what other libraries do with such."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from codegen.errors import ArgumentError, ExtraError

if TYPE_CHECKING:
    from xarray import Dataset

_COLUMNS = {"q": "coordinate", "p": "momentum", "u": "control"}
"""Dimensions of columns, as those of a sweep are called."""
_TEXTS = ("problem", "title", "task", "driver", "scheme", "status", "message")


def _require(library: str, what: str) -> None:
    """Refuse to go on without a library; ExtraError names the extra that brings it."""
    if find_spec(library) is None:
        raise ExtraError(f"{what} needs {library}, which is not installed", "pip install 'variational-codegen[sweep]'")


def as_dataset(result: Any) -> Dataset:
    """See `Result.to_dataset`."""
    _require("xarray", "a data set")
    import xarray

    if result.q.ndim != 2:
        raise ArgumentError(f"{result.problem} is about particles, whose path has no columns", "take its arrays")
    variables: dict[str, tuple[tuple[str, ...], Any]] = {"t": (("node",), result.t)}
    for name in ("q", "p"):
        if result.names[name]:
            variables[name] = ("node", _COLUMNS[name]), getattr(result, name)
    if result.energy is not None:
        variables["energy"] = ("node",), result.energy
    for name, dim in (("u", "control"), ("multipliers", "multiplier")):
        array = getattr(result, name)
        if array is not None and array.shape[1]:
            variables[name] = _by_rows(array, result.t.size, dim)
    numbers = {"cost": result.cost, "residual": result.residual, "stationarity": result.stationarity}
    variables |= {name: ((), value) for name, value in numbers.items() if value is not None}
    coordinates: dict[str, Any] = {}
    for name in (name for name in _COLUMNS if name in variables):
        coordinates[_COLUMNS[name]] = list(result.names[name])
        units = [result.units.get(column, "") for column in result.names[name]]
        if any(units):
            coordinates[f"{_COLUMNS[name]}_unit"] = (_COLUMNS[name], units)
    texts: dict[str, Any] = {name: getattr(result, name) for name in _TEXTS}
    attributes = {**texts, "formulation": result.method, "steps": result.steps, "iterations": result.iterations}
    data = xarray.Dataset(variables, coordinates, attributes | dict(result.summary) | dict(result.parameters))
    for name in ("t", "energy", "cost"):
        if name in data and result.units.get(name):
            data[name].attrs["units"] = result.units[name]
    return data


def _by_rows(array: Any, nodes: int, dim: str) -> tuple[tuple[str, ...], Any]:
    """Dimensions and values of an array whose rows belong to nodes, intervals, or stages of intervals."""
    if len(array) == nodes:
        return ("node", dim), array
    stages = len(array) // (nodes - 1)
    if stages == 1:
        return ("interval", dim), array
    return ("interval", "stage", dim), array.reshape(nodes - 1, stages, array.shape[1])


def as_frame(result: Any) -> Any:
    """See `Result.to_frame`."""
    _require("pandas", "a data frame")
    import pandas

    if result.q.ndim != 2:
        raise ArgumentError(f"{result.problem} is about particles, whose path has no columns", "take its arrays")
    columns = {name: result.q[:, i] for i, name in enumerate(result.names["q"])}
    columns |= {name: result.p[:, i] for i, name in enumerate(result.names["p"])}
    if result.u is not None and result.names["u"]:
        controls = result.controls_at(result.t)
        if not result.stage_abscissae and len(result.u) < result.t.size:
            controls = np.vstack([result.u, result.u[-1:]])  # each from its node on
        columns |= {name: controls[:, i] for i, name in enumerate(result.names["u"])}
    if result.energy is not None:
        columns["energy"] = result.energy
    frame = pandas.DataFrame(columns, index=pandas.Index(result.t, name="t"))
    frame.attrs["units"] = {name: unit for name, unit in result.units.items() if name == "t" or name in columns}
    return frame
