"""What of a module may have other values without a build: parameters, given durations, prescribed ends, by name."""

from __future__ import annotations

import inspect
import math
from numbers import Real
from typing import Any

from codegen.interfaces import is_of_particles
from codegen.solutions.segments import segments_of


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
    # Where particles begin, and what each of them has for itself, comes first.
    before = 1 + len(module.metadata["own"]) if is_of_particles(module) else 0
    return dict(zip(module.metadata["parameters"], _keywords(module)[before:], strict=False))


def duration_arguments(module: Any) -> tuple[str, ...]:
    """The arguments for durations that are given; none where delays are parts of it."""
    if segments_of(module.metadata) is not None:
        return ()
    of_parameters = parameter_arguments(module).values()
    return tuple(name for name in _keywords(module) if name.startswith("duration") and name not in of_parameters)


def prescribed_ends(module: Any) -> dict[str, tuple[str, str]]:
    """Prescribed values by names such as `end.x`: which end, and the name that the module's functions know."""
    segments, found = segments_of(module.metadata), {}
    for entry in module.metadata.get("boundary", ()):
        end, name = entry.split(" ", 1)
        own = name if segments is None else segments.split(name)[0]
        found[f"{end}.{own}"] = end, name
    return found


def _keywords(module: Any) -> list[str]:
    arguments = inspect.signature(module.make_grid).parameters.values()
    return [argument.name for argument in arguments if argument.kind is inspect.Parameter.KEYWORD_ONLY]
