"""The options of `codegen solve`: what is refused, or read, before anything is derived, and what a module must fit."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.errors import ArgumentError

if TYPE_CHECKING:
    from codegen.author.points import PointSet
    from codegen.loading import GeneratedModule, Vector
    from codegen.solutions.result import Result


def require_sensible(driver: str, log: bool, save: Path | None, out: Path | None) -> None:
    """Refuse, before anything is derived, what could only fail after everything is solved."""
    from codegen import drivers
    from codegen.solutions import output

    drivers.find(driver)
    if log and driver != "newton":
        raise ArgumentError(f"driver {driver} keeps no log of its iterates", "use --log with --driver newton")
    if save is not None:
        output.require_writable(save, output.ARCHIVES, "--save")
    if out is not None:
        output.require_folder(out, "--out", may_be_made=True)


def points_of(problem: Path, set_: list[str]) -> Callable[[Mapping[str, Any]], PointSet | None]:
    """What reads the points of a problem about particles, once its module says how many coordinates they have."""
    from codegen.author.problem_file import parse_arguments, split_points

    given = split_points(problem, parse_arguments(set_, problem))[1]

    def read(metadata: Mapping[str, Any]) -> PointSet | None:
        if metadata["task"] != "connect":
            return None
        from codegen.author.points import read_points

        file = Path(given) if given is not None else problem.parent / metadata["points"]
        return read_points(file, len(metadata["coordinates"]))

    return read


def start_of(warm: Path | None) -> Callable[[GeneratedModule], Vector | None]:
    """What gives the unknowns of a saved result, already read, once there is a module that they must fit."""
    if warm is None:
        return lambda module: None
    from codegen.solving import warm_start

    saved = warm_start.read_start(warm)
    return lambda module: warm_start.fitting(saved, module)


def with_options(result: Result) -> Result:
    """A result whose messages name options of the command where they named arguments of a function."""
    levels = tuple(replace(level, message=_with_options(level.message)) for level in result.levels)
    return replace(result, message=_with_options(result.message), levels=levels)


def _with_options(message: str) -> str:
    option = r"\braise (max_iterations|time_limit)\b"
    return re.sub(option, lambda found: f"raise --{found[1].replace('_', '-')}", message)


def require_fitting(task: str, driver: str, every: int, log: bool) -> None:
    """Refuse options that mean nothing for the task."""
    from codegen import drivers

    drivers.find(driver, task)
    if every > 1 and task != "simulate":
        raise ArgumentError(f"--every {every} thins simulations, and this is a {task} problem", "leave it out")
    if log and task != "control":
        raise ArgumentError(f"--log shows iterates of an optimisation, and this is a {task} problem", "leave it out")
