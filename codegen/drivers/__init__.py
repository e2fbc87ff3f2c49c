"""The registry of drivers: ways to solve what a generated module describes.

`newton` is the generated solver itself; the others hand the module's functions to scipy, so that its answers can be
cross-checked. Importing this file imports no driver, and neither numpy nor numba nor scipy.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from codegen.errors import ArgumentError


@dataclass(frozen=True)
class Driver:
    """Name, summary, and the tasks that it applies to: its file has one function for each, named after the task."""

    name: str
    file: str
    tasks: tuple[str, ...]
    summary: str
    stops: tuple[tuple[str, str], ...] = ()
    """Where its tolerance, most iterations or time may be chosen: pairs of a task and the argument's name."""

    def function(self, task: str) -> Callable[..., Any]:
        """The function (module, request) -> attempt for a task, imported when it is asked for."""
        return getattr(import_module(f"codegen.drivers.{self.file}"), task)  # type: ignore[no-any-return]


SCALINGS = ("auto", "none")
"""Whether an optimiser works in parts of the sizes that it finds in a problem, or in the problem's own units."""

_OF_CONTROL = (("control", "tolerance"), ("control", "max_iterations"))
_OF_TIME = (("control", "time_limit"),)
_ROWS = (
    Driver(
        "newton", "newton", ("control", "simulate", "connect"), "the generated solver",
        (*_OF_CONTROL, *_OF_TIME, ("simulate", "max_iterations"), ("connect", "tolerance")),
    ),
    Driver(
        "slsqp", "slsqp", ("control", "connect"), "scipy's sequential least-squares programming, dense",
        _OF_CONTROL[1:],
    ),
    Driver(
        "trust-constr", "trust_constr", ("control", "connect"), "scipy's trust-region SQP, sparse with exact Hessians",
        _OF_CONTROL[1:],
    ),
    Driver(
        "ipopt", "ipopt", ("control",), "IPOPT, an interior point method; needs cyipopt (extra: ipopt)",
        _OF_CONTROL + _OF_TIME,
    ),
    Driver("fsolve", "fsolve", ("control", "simulate", "connect"), "MINPACK's hybrid Powell method, dense"),
    Driver("fmin", "fmin", ("connect",), "Nelder and Mead's simplex method, for a few particles"),
)  # fmt: skip

DRIVERS: dict[str, Driver] = {driver.name: driver for driver in _ROWS}
"""Every driver by name; tests run over this table."""


def find(name: str, task: str | None = None) -> Driver:
    """The driver of that name, which must apply to the task; ArgumentError tells which do."""
    if name not in DRIVERS:
        close = difflib.get_close_matches(name, DRIVERS, 1)
        remedy = f"did you mean {close[0]}?" if close else f"use one of {', '.join(DRIVERS)}"
        raise ArgumentError(f"there is no driver {name!r}", remedy)
    driver = DRIVERS[name]
    if task is not None and task not in driver.tasks:
        names = [other.name for other in DRIVERS.values() if task in other.tasks]
        raise ArgumentError(f"driver {name} does not apply to a {task} problem", f"use one of {', '.join(names)}")
    return driver
