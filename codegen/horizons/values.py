"""Run-time values of a controller: numbers, and functions of the present time, among the arguments of a solve."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from codegen.errors import ArgumentError, clause
from codegen.horizons.interface import Interface, number

Moving: TypeAlias = float | Callable[[float], float]
"""A run-time value: a number, or a function of the present time."""


class Values:
    """The values that a controller, or `what` is called so, was given: parameters and prescribed ends, as `end.x`.

    Raises ArgumentError for a name that there is not or a value that is neither a number nor a function, NumericsError
    for a number that is not finite.
    """

    def __init__(
        self,
        interface: Interface,
        values: Mapping[str, Moving],
        of_solves: Mapping[str, Any],
        what: str = "the problem",
    ) -> None:
        if not isinstance(values, Mapping):
            finding = clause(f"run-time values of {what} are {values!r}")
            raise ArgumentError(finding, 'give names and values, such as {"place": 1.0}')
        self._interface, self._of_solves, self._what = interface, dict(of_solves), what
        interface.require_known(values, what)
        self._constants = {n: number(v, f"parameter {n}") for n, v in values.items() if not callable(v)}
        self._moving = {n: v for n, v in values.items() if callable(v)}

    def given(self, t: float, own: Mapping[str, float] | None = None) -> dict[str, Any]:
        """The arguments of the module's functions at a time, with values that hold at this time alone."""
        given = dict(self._of_solves)
        for name, value in self._constants.items():
            self._interface.place(given, name, value)
        for name, function in self._moving.items():
            self._interface.place(given, name, number(function(t), f"parameter {name} at t = {t:g}"))
        if own:
            self._interface.require_known(own, self._what)
            for name, value in own.items():
                self._interface.place(given, name, number(value, f"parameter {name}"))
        return given
