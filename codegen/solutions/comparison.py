"""Whether two solutions are the same, and how far apart they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from codegen.errors import ArgumentError

_TIMED = ("steps_per_second",)
"""Entries of a summary that say how long something took."""


def same(one: Any, other: Any) -> bool:
    """Whether two values are equal to the last bit, arrays and what they stand in included; NaN equals NaN."""
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        is_number = isinstance(one, np.ndarray) and one.dtype.kind in "fc"
        return bool(np.array_equal(one, other, equal_nan=is_number))
    if type(one) is not type(other):
        return False
    if is_dataclass(one) and not isinstance(one, type):
        compared = [part.name for part in fields(one) if part.compare]
        return all(same(getattr(one, name), getattr(other, name)) for name in compared)
    if isinstance(one, Mapping):
        own = [key for key in one if key not in _TIMED]
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in own)
    if isinstance(one, (tuple, list)):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other or (one != one and other != other))


def differences(one: Any, other: Any) -> dict[str, float]:
    """How far another solution is away, as the max-norm for each quantity; see `Result.differences`."""
    for name in ("task", "names"):
        if getattr(one, name) != getattr(other, name):
            finding = f"{one.problem} and {other.problem} have other quantities"
            raise ArgumentError(finding, "compare solutions of one problem")
    if one.q.ndim != 2:
        raise ArgumentError(f"{one.problem} is about particles", "compare its arrays")
    found = {"t": abs(float(one.t[-1] - other.t[-1]))}
    for key in ("q", "p"):
        for column, name in enumerate(one.names[key]):
            beside = np.interp(one.t, other.t, getattr(other, key)[:, column])
            found[name] = float(np.abs(getattr(one, key)[:, column] - beside).max())
    if one.u is not None and other.u is not None:
        times = one.control_times
        apart = np.abs(one.controls_at(times) - other.controls_at(times))
        found |= dict(zip(one.names["u"], apart.max(axis=0).tolist(), strict=True))
    if one.cost is not None and other.cost is not None:
        found["cost"] = abs(one.cost - other.cost)
    return found
