"""The registry of drivers: ways to solve what a generated module describes.

`newton` is the generated solver itself; the others hand the module's functions to scipy, so that its answers can be
cross-checked. Importing this file imports no driver, and neither numpy nor numba nor scipy.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from codegen.errors import ArgumentError

if TYPE_CHECKING:
    from codegen.drivers.compilation import SecondProcess
    from codegen.drivers.result import Result
    from codegen.load import GeneratedModule


@dataclass(frozen=True)
class Driver:
    """Name, summary, and the tasks that it applies to: its file has one function for each, named after the task."""

    name: str
    file: str
    tasks: tuple[str, ...]
    summary: str

    def function(self, task: str) -> Callable[..., Any]:
        """The function (module, request) -> attempt for a task, imported when it is asked for."""
        return getattr(import_module(f"codegen.drivers.{self.file}"), task)  # type: ignore[no-any-return]


_ROWS = (
    Driver("newton", "newton", ("control", "simulate"), "the generated solver"),
    Driver("slsqp", "slsqp", ("control",), "scipy's sequential least-squares programming, dense"),
    Driver("trust-constr", "trust_constr", ("control",), "scipy's trust-region SQP, sparse with exact Hessians"),
    Driver("ipopt", "ipopt", ("control",), "IPOPT, an interior point method; needs cyipopt (extra: ipopt)"),
    Driver("fsolve", "fsolve", ("control", "simulate"), "MINPACK's hybrid Powell method, dense, on square systems"),
)

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


def solve(
    module: GeneratedModule, driver: str = "newton", *, steps: int | None = None, every: int = 1, repeat: int = 1
) -> Result:
    """Solve with a driver on `steps` intervals (default: the problem's own number) and re-evaluate the residuals.

    The first of `repeat` + 1 runs compiles and is not timed. `every` thins the stored steps of a simulation. Raises
    ArgumentError when the driver does not apply, NumericsError when a number is unusable; numerical failure is a
    status of the result.
    """
    from codegen.drivers.run import run

    return run(module, find(driver, module.metadata["task"]), steps=steps, every=every, repeat=repeat)


def prepare(module: GeneratedModule, helper: SecondProcess) -> float:
    """Have everything that `newton` needs compiled, so that later processes find machine code; return the seconds."""
    from codegen.drivers.run import prepare

    return prepare(module, helper)
