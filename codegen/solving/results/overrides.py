"""What of a module may have other values without a build: parameters, given durations, prescribed ends, by name."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable
from numbers import Real
from typing import Any

from codegen.errors import ArgumentError, clause
from codegen.solving.interfaces import is_connect, is_of_particles, is_simulation
from codegen.solving.results.segments import segments_of

START = "start."
"""What names of prescribed values at the start begin with."""


def as_number(value: Any) -> float:
    """A value as a number; nan where it is none, or larger than any."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def parameter_arguments(module: Any) -> dict[str, str]:
    """The arguments of a module's functions by the names of parameters, which they may not have in Python."""
    # Where particles begin, or sigma of their targets, and what each of them has for itself, come first.
    before = 1 + len(module.metadata.own) if is_of_particles(module) else 0
    return dict(zip(module.metadata.parameters, _keywords(module)[before:], strict=False))


def duration_arguments(module: Any) -> tuple[str, ...]:
    """The arguments for durations that are given; where there are delays, of which it is made, that of a segment."""
    of_parameters = parameter_arguments(module).values()
    return tuple(name for name in _keywords(module) if name.startswith("duration") and name not in of_parameters)


def apart_from_delays(module: Any) -> tuple[str, ...]:
    """The arguments for durations that may have other values: none where delays are parts of them."""
    return () if segments_of(module.metadata) else duration_arguments(module)


def prescribed_ends(module: Any) -> dict[str, tuple[str, str]]:
    """Prescribed values by names such as `end.x`: which end, and the name that the module's functions know.

    Of a simulation these are all values that it starts from; particles have none, since they start from an array.
    """
    if is_simulation(module):
        return {f"{START}{name}": ("start", name) for name in module.metadata.start}
    ends = (("start", module.metadata.start), ("end", module.metadata.end))
    return {f"{end}.{name}": (end, name) for end, names in ends for name in names}


def require_apart_from_arrays(module: Any, names: Iterable[str]) -> None:
    """Refuse, as an ArgumentError, names of what particles start from: an array, which has no value for each name."""
    if not (is_simulation(module) and is_of_particles(module)):
        return
    for name in names:
        if name.startswith(START):
            finding = clause(f"{module.metadata.problem} has no {name}: its particles start from an array")
            raise ArgumentError(finding, "call solve(start=...) of its module, which takes all positions and momenta")


def require_apart_from_delays(module: Any, names: Iterable[str]) -> None:
    """Refuse, as an ArgumentError, names of a duration of which delays are parts: it would change them as well."""
    if segments_of(module.metadata) is None:
        return
    durations = duration_arguments(module)
    for name in names:
        if name in durations:
            finding = f"{module.metadata.problem} has delays, which another {name} would change as well"
            raise ArgumentError(finding, "change it in the problem, and build that")


def _keywords(module: Any) -> list[str]:
    maker = module.make_case if is_connect(module) else module.make_grid
    arguments = inspect.signature(maker).parameters.values()
    return [argument.name for argument in arguments if argument.kind is inspect.Parameter.KEYWORD_ONLY]
