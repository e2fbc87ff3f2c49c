"""A solve with other values of parameters than the problem's own, which need no build."""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Mapping
from numbers import Real
from typing import Any

from codegen.errors import ArgumentError, NumericsError, clause
from codegen.interfaces import is_connect
from codegen.solving.other_tables import with_arguments


def with_values(module: Any, values: Mapping[str, float]) -> Any:
    """The module with other values of parameters, of a given duration and of prescribed ends, by `keys_of_values`.

    Raises ArgumentError for a name that is none of them, and NumericsError for a value that is no finite number.
    """
    if not values:
        return module
    known = {} if is_connect(module) else keys_of_values(module)
    given: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            close = difflib.get_close_matches(name, known, 1)
            remedy = f"did you mean {close[0]}?" if close else f"use one of {', '.join(known)}"
            finding = clause(f"{module.metadata['problem']} has no parameter {name}")
            raise ArgumentError(finding, clause(remedy) if known else "leave it out")
        if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
            raise NumericsError(clause(f"parameter {name} is {value!r}"), "give a finite number")
        end, _, quantity = known[name].partition(" ")
        if quantity:
            given.setdefault(end, {})[quantity] = float(value)
        else:
            given[end] = float(value)
    return with_arguments(module, **given)


def keys_of_values(module: Any) -> dict[str, str]:
    """What may be given: arguments of the module's functions by the names of parameters, and durations.

    Prescribed ends are called `start.x` and `end.x`, with the end and the name behind a blank.
    """
    arguments = inspect.signature(module.make_grid).parameters.values()
    keywords = [argument.name for argument in arguments if argument.kind is inspect.Parameter.KEYWORD_ONLY]
    own = dict(zip(module.metadata["parameters"], keywords, strict=False))
    durations = {keyword: keyword for keyword in keywords[len(own) :] if keyword.startswith("duration")}
    ends = {name.replace(" ", ".", 1): name for name in module.metadata.get("boundary", ())}
    return {**own, **{name: key for name, key in (durations | ends).items() if name not in own}}
