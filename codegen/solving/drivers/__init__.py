"""The registry of drivers: methods that solve the problem of a generated module.

`newton` is the generated solver. The other drivers call scipy or IPOPT with the functions of the module, for
comparison. To start quickly, this file imports no driver, and neither numpy nor numba nor scipy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from codegen.errors import ArgumentError, nearest


@dataclass(frozen=True)
class Driver:
    """A driver, with the tasks that it can solve.

    `options` maps each task to the options of a request that apply to the driver. The `file` of a driver has a function
    for each task, with the name of the task. `generated` is True for the solver in the generated module.
    """

    name: str
    file: str
    summary: str
    options: Mapping[str, tuple[str, ...]]
    generated: bool = False

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks that the driver can solve."""
        return tuple(self.options)

    def takes(self, task: str, option: str) -> bool:
        """Return True if the driver accepts an option for a task."""
        return option in self.options.get(task, ())

    def function(self, task: str) -> Callable[..., Any]:
        """Import the driver, and return its function (module, run) -> attempt for a task."""
        return getattr(import_module(f"codegen.solving.drivers.{self.file}"), task)  # type: ignore[no-any-return]


_ROWS = (
    Driver(
        "newton", "newton", "the generated solver",
        {
            "control": ("tolerance", "max_iterations", "time_limit", "scaling", "log", "watch"),
            "simulate": ("max_iterations",),
            "connect": ("tolerance",),
        },
        generated=True,
    ),
    Driver(
        "slsqp", "slsqp", "scipy's sequential least-squares programming, dense",
        {"control": ("max_iterations",), "connect": ()},
    ),
    Driver(
        "trust-constr", "trust_constr", "scipy's trust-region SQP, sparse with exact Hessians",
        {"control": ("max_iterations",), "connect": ()},
    ),
    Driver(
        "ipopt", "ipopt", "IPOPT, an interior point method; needs cyipopt (extra: ipopt)",
        {"control": ("tolerance", "max_iterations", "time_limit")},
    ),
    Driver("fsolve", "fsolve", "MINPACK's hybrid Powell method, dense", {"control": (), "simulate": (), "connect": ()}),
    Driver("fmin", "fmin", "Nelder and Mead's simplex method, for a few particles", {"connect": ()}),
)  # fmt: skip

DRIVERS: dict[str, Driver] = {driver.name: driver for driver in _ROWS}
"""All drivers by name; tests run over this table."""


def find(name: str, task: str | None = None) -> Driver:
    """Return the driver with a name; raise ArgumentError if the driver does not exist or does not apply to the task."""
    if not isinstance(name, str) or name not in DRIVERS:
        raise ArgumentError(f"there is no driver {name!r}", nearest(name, DRIVERS, f"use one of {', '.join(DRIVERS)}"))
    driver = DRIVERS[name]
    if task is not None and task not in driver.tasks:
        names = [other.name for other in DRIVERS.values() if task in other.tasks]
        raise ArgumentError(f"driver {name} does not apply to a {task} problem", f"use one of {', '.join(names)}")
    return driver
