"""A solve with other measurements than those of a module, in the same columns; any number of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from codegen.errors import ArgumentError
from codegen.interfaces import GeneratedModule, Matrix
from codegen.solving.other_tables import with_arguments
from codegen.tables.measurements import Layout, given_measurements, read_measurements


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
