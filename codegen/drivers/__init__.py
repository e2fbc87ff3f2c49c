"""The registry of drivers: ways to solve what a generated module describes.

`newton` is the generated solver itself; the others hand the module's functions to scipy, so that its answers can be
cross-checked. Importing this file imports no driver, and neither numpy nor numba nor scipy.
"""

from __future__ import annotations

import difflib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

from codegen.errors import ArgumentError

if TYPE_CHECKING:
    from pathlib import Path

    from codegen.drivers.processes import Compilers
    from codegen.drivers.result import Result, Watch
    from codegen.loading import ControlModule, GeneratedModule, Vector
    from codegen.points import PointSet


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

LEAST_TIME = 1e-9
"""Seconds in which a search does not begin."""

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


def _require_stops(
    driver: Driver, task: str, tolerance: float | None, max_iterations: int | None, time_limit: float | None
) -> None:
    """Refuse a tolerance, a number of iterations or a time that is unusable, or that the driver does not take."""
    if tolerance is not None and not 0.0 < tolerance < 1.0:
        raise ArgumentError(f"--tolerance {tolerance:g}", "give a number between 0 and 1")
    if time_limit is not None and not time_limit > 0.0:
        raise ArgumentError(f"--time-limit {time_limit:g}", "give a positive number of seconds")
    for name, value in (("tolerance", tolerance), ("max_iterations", max_iterations), ("time_limit", time_limit)):
        if value is None or (task, name) in driver.stops:
            continue
        option, takers = f"--{name.replace('_', '-')}", [d.name for d in DRIVERS.values() if (task, name) in d.stops]
        if not takers:
            raise ArgumentError(f"{option} does not apply to a {task} problem", "leave it out")
        finding = f"driver {driver.name} takes no {option} for a {task} problem"
        raise ArgumentError(finding, f"leave it out, or use {', '.join(takers)}")


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
    max_iterations: int | None = None,
    scaling: str = "auto",
    time_limit: float | None = None,
    watch: Watch | None = None,
) -> Result:
    """Solve with a driver on `steps` intervals (default: the problem's own number) and re-evaluate the residuals.

    The first of `repeat` + 1 runs compiles and is not timed. `every` thins the stored steps of a simulation. An
    optimisation may start from the `unknowns` of an earlier result on any number of intervals (`warm`), and may be
    repeated on twice, four times, ... as many (`doublings`), each time from the solution before. With several
    `guesses` it starts from the problem's own and from variations of it, and the best solution counts. A connect
    problem needs `points`. `tolerance` is that of the equations, or of an adaptive integrator's steps, and
    `max_iterations` the most that an optimiser makes; None stands for the driver's own. `time_limit` is in seconds, for
    all guesses and grids together, and for each of `repeat` runs by itself; `watch` is called at every iterate of
    `newton` with its number and its row of the log. `scaling="none"` has an optimiser work in the problem's own units.
    Raises ArgumentError when the driver or one of its options does not apply, NumericsError when a number is unusable;
    numerical failure is a status of the result.
    """
    from codegen.drivers.result import Request
    from codegen.drivers.run import run

    found, task = find(driver, module.metadata["task"]), module.metadata["task"]
    steps = module.metadata["steps"] if steps is None else steps
    _require_stops(found, task, tolerance, max_iterations, time_limit)
    if task != "control" and (warm is not None or doublings or guesses > 1):
        raise ArgumentError("warm starts, guesses and refinement are for optimisation", f"leave them out to {task}")
    if scaling not in SCALINGS:
        raise ArgumentError(f"--scaling {scaling}", f"use one of {', '.join(SCALINGS)}")
    if scaling != "auto" and task != "control":
        raise ArgumentError("--scaling is for optimisation", f"leave it out to {task}")
    if scaling != "auto" and found.name != "newton":
        raise ArgumentError(f"driver {found.name} takes no --scaling", "leave it out, or use newton")
    if warm is not None and guesses > 1:
        raise ArgumentError("several guesses beside a warm start", "leave one of them out")
    if task == "simulate":
        return run(module, found, Request(steps, every, max_iterations=max_iterations), repeat)

    if task == "connect":
        return run(module, found, Request(steps, every, None, points, tolerance), repeat)

    from codegen.drivers.multistart import best_of
    from codegen.drivers.refinement import refine, transferred

    control = cast("ControlModule", module)

    def solve_on(number: int, start: Vector | None) -> Result:
        if start is None and guesses > 1:
            return best_of(lambda guess: solve_from(number, guess, False), control, number, guesses)
        return solve_from(number, start, True)

    left = math.inf if time_limit is None else time_limit

    def solve_from(number: int, start: Vector | None, near: bool) -> Result:
        nonlocal left
        stops = tolerance, near, max_iterations, max(left, LEAST_TIME), watch
        request = Request(number, every, start, None, *stops, scaling)
        result = run(module, found, request, repeat)
        left -= result.seconds_solve
        return result

    if doublings:
        return refine(solve_on, control, steps, doublings, warm)
    return solve_on(steps, None if warm is None else transferred(control, warm, steps))


def prepare(path: Path, compilers: Compilers) -> float:
    """Have all that `newton` needs of a module compiled, so that processes find machine code; return the seconds."""
    begin = time.perf_counter()
    if not compilers.compile(path):
        from codegen.drivers.run import compile_here  # only now: importing it takes a fifteenth of a build

        compile_here(path)
    return time.perf_counter() - begin
