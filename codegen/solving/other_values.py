"""A solve with other values of parameters than the problem's own, which need no build."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from codegen.errors import ArgumentError, NumericsError, TableError, clause
from codegen.interfaces import GeneratedModule, Matrix, Vector, few_steps, is_connect
from codegen.runtime.record import TableRecord
from codegen.solutions.given_values import (
    apart_from_delays,
    parameter_arguments,
    prescribed_ends,
    require_apart_from_arrays,
    require_apart_from_delays,
)
from codegen.tables.files import read_table
from codegen.tables.measurements import Layout, given_measurements, read_measurements


def with_tables(module: GeneratedModule, files: Mapping[str, Path | str] | None) -> Any:
    """The module with the tables of some files in place of its own, by their names, or itself where there are none.

    Raises ArgumentError for a name that is no table's, and TableError for a file that is no such table.
    """
    if not files:
        return module
    known = module.metadata.tables
    numbers = {name: _numbers(name, Path(file), known) for name, file in files.items()}
    return with_arguments(module, tables=numbers)


def with_arguments(module: Any, **given: Any) -> Any:
    """The module with arguments given to whatever makes its grids, or its cases."""
    other = ModuleType(getattr(module, "__name__", "generated"))
    other.__dict__.update(vars(module))
    makers = ("make_case", "solve") if is_connect(module) else ("make_grid", "nlp", "solve")
    other.__dict__.update({name: partial(getattr(module, name), **given) for name in makers if hasattr(module, name)})
    return other


def _numbers(name: str, file: Path, known: Mapping[str, TableRecord]) -> Vector:
    if name not in known:
        remedy = f"name one of {', '.join(known)}" if known else "leave it out"
        raise ArgumentError(f"--table {name}={file}: the problem has no table {name}", remedy)
    own = known[name]
    columns = (own.inputs, own.output, own.kind, own.outside)
    table = read_table(file, file.as_posix(), name, *columns)
    if table.shape.sizes != own.sizes:
        found, wanted = (" and ".join(map(str, sizes)) for sizes in (table.shape.sizes, own.sizes))
        raise TableError(
            f"{file}: table {name} has {found} breakpoints, and the module is built for {wanted}",
            "give as many, or change the problem's own file",
        )
    return np.array(table.numbers)


def with_values(module: Any, values: Mapping[str, float]) -> Any:
    """The module with other values of parameters, of given durations, and of prescribed ends (`start.x`), by name.

    Raises ArgumentError for a name that is none of them, and NumericsError for values that no grid can have.
    """
    if not values:
        return module
    known = {} if is_connect(module) else _known(module)
    require_apart_from_delays(module, values)
    require_apart_from_arrays(module, values)
    given: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            raise ArgumentError(clause(f"{module.metadata.problem} has no parameter {name}"), _remedy(name, known))
        end, quantity = known[name]
        if quantity:
            given.setdefault(end, {})[quantity] = float(value)
        else:
            given[end] = float(value)
    other = with_arguments(module, **given)
    try:
        other.make_grid(few_steps(module, 1))
    except ValueError as error:
        raise NumericsError(f"{module.metadata.problem}: {error}", "give other values") from error
    return other


def _known(module: Any) -> dict[str, tuple[str, str]]:
    """Arguments by the names of what they are for, beside the quantity where they map names to values.

    A parameter comes before a duration or an end of the same name.
    """
    durations = {name: (name, "") for name in apart_from_delays(module)}
    own = {name: (argument, "") for name, argument in parameter_arguments(module).items()}
    return {**own, **{name: key for name, key in (durations | prescribed_ends(module)).items() if name not in own}}


def _remedy(name: str, known: Mapping[str, Any]) -> str:
    if not known:
        return "leave it out"
    close = difflib.get_close_matches(name, known, 1)
    return clause(f"did you mean {close[0]}?" if close else f"use one of {', '.join(known)}")


def with_observations(module: GeneratedModule, given: Any) -> Any:
    """The module with other measurements in place of its own, or itself where none are given.

    `given` is a file, or a mapping of columns to arrays of shape (n,), and of several bodies a list of these. Raises
    ArgumentError where nothing was measured or their number is another, and TableError for what are no measurements.
    """
    if given is None:
        return module
    observations = module.metadata.observations
    if observations is None:
        raise ArgumentError("--observations: the problem has no measurements", "leave it out")
    listed, bodies = list(given) if isinstance(given, (list, tuple)) else [given], module.metadata.bodies
    if len(listed) != bodies:
        finding = f"--observations gives {len(listed)} sets of measurements, and there are {bodies} bodies"
        raise ArgumentError(finding, "give one for each")
    layout = Layout(observations.time, observations.columns, observations.sigmas)
    return with_arguments(module, observations=tuple(_rows(one, layout) for one in listed))


def _rows(given: Any, layout: Layout) -> Matrix:
    if isinstance(given, Path | str):
        return read_measurements(Path(given), Path(given).as_posix(), layout).array
    if isinstance(given, Mapping):
        return given_measurements(given, layout).array
    raise ArgumentError(f"observations are {given!r}", "give a file, or a mapping of columns to arrays")
