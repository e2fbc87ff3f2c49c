"""A solve with other values of parameters than the problem's own, which need no build."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

from codegen.errors import ArgumentError, NumericsError, clause
from codegen.interfaces import few_steps, is_connect
from codegen.solutions.given_values import (
    apart_from_delays,
    parameter_arguments,
    prescribed_ends,
    require_apart_from_arrays,
    require_apart_from_delays,
)
from codegen.solving.other_tables import with_arguments


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
