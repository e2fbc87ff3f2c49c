"""The registry of drivers: ways to solve what a generated module describes.

`newton` is the generated solver itself; the others hand the module's functions to scipy, so that its answers can be
cross-checked. Importing this file imports no driver, and neither numpy nor numba nor scipy.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

from codegen.errors import ArgumentError

if TYPE_CHECKING:
    from pathlib import Path

    from codegen.drivers.compilation import Compilers
    from codegen.drivers.result import Result
    from codegen.load import ControlModule, GeneratedModule, Vector
    from codegen.points import PointSet


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
    Driver("newton", "newton", ("control", "simulate", "connect"), "the generated solver"),
    Driver("slsqp", "slsqp", ("control", "connect"), "scipy's sequential least-squares programming, dense"),
    Driver(
        "trust-constr", "trust_constr", ("control", "connect"), "scipy's trust-region SQP, sparse with exact Hessians"
    ),
    Driver("ipopt", "ipopt", ("control",), "IPOPT, an interior point method; needs cyipopt (extra: ipopt)"),
    Driver("fsolve", "fsolve", ("control", "simulate", "connect"), "MINPACK's hybrid Powell method, dense"),
    Driver("fmin", "fmin", ("connect",), "Nelder and Mead's simplex method, for a few particles"),
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
    module: GeneratedModule,
    driver: str = "newton",
    *,
    steps: int | None = None,
    every: int = 1,
    repeat: int = 1,
    warm: Vector | None = None,
    doublings: int = 0,
    guesses: int = 1,
    points: PointSet | None = None,
    tolerance: float | None = None,
) -> Result:
    """Solve with a driver on `steps` intervals (default: the problem's own number) and re-evaluate the residuals.

    The first of `repeat` + 1 runs compiles and is not timed. `every` thins the stored steps of a simulation. An
    optimisation may start from the `unknowns` of an earlier result on any number of intervals (`warm`), and may be
    repeated on twice, four times, ... as many (`doublings`), each time from the solution before. With several
    `guesses` it starts from the problem's own and from variations of it, and the best solution counts. A connect
    problem needs `points`; its `tolerance` is that of the equations, or of an adaptive integrator's steps. Raises
    ArgumentError when the driver does not apply, NumericsError when a number is unusable; numerical failure is a
    status of the result.
    """
    from codegen.drivers.result import Request
    from codegen.drivers.run import run

    found, task = find(driver, module.metadata["task"]), module.metadata["task"]
    steps = module.metadata["steps"] if steps is None else steps
    if task != "control" and (warm is not None or doublings or guesses > 1):
        raise ArgumentError("warm starts, guesses and refinement are for optimisation", f"leave them out to {task}")
    if warm is not None and guesses > 1:
        raise ArgumentError("several guesses beside a warm start", "leave one of them out")
    if task == "simulate":
        return run(module, found, Request(steps, every), repeat)

    if task == "connect":
        return run(module, found, Request(steps, every, None, points, tolerance), repeat)

    from codegen.drivers.multistart import best_of
    from codegen.drivers.refinement import refine, transferred

    control = cast("ControlModule", module)

    def solve_on(number: int, start: Vector | None) -> Result:
        if start is None and guesses > 1:
            return best_of(lambda guess: solve_from(number, guess, False), control, number, guesses)
        return solve_from(number, start, True)

    def solve_from(number: int, start: Vector | None, near: bool) -> Result:
        return run(module, found, Request(number, every, start, near=near), repeat)

    if doublings:
        return refine(solve_on, control, steps, doublings, warm)
    return solve_on(steps, None if warm is None else transferred(control, warm, steps))


def prepare(path: Path, compilers: Compilers) -> float:
    """Have all that `newton` needs of a module compiled, so that processes find machine code; return the seconds."""
    from codegen.drivers.run import prepare

    return prepare(path, compilers)
