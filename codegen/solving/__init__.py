"""Solving with any driver: machine code first, then warm starts, several guesses, finer grids."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, cast

from codegen.drivers import DRIVERS, SCALINGS, Driver, find
from codegen.errors import ArgumentError

if TYPE_CHECKING:
    from pathlib import Path

    from codegen.author.points import PointSet
    from codegen.loading import ControlModule, GeneratedModule, Vector
    from codegen.machine_code.processes import Compilers
    from codegen.solutions.result import Result, Watch

LEAST_TIME = 1e-9
"""Seconds in which a search does not begin."""


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
    from codegen.solutions.result import Request
    from codegen.solving.run import run

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

    from codegen.solving.multistart import best_of
    from codegen.solving.refinement import refine, transferred

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
        from codegen.solving.run import compile_here  # only now: importing it takes a fifteenth of a build

        compile_here(path)
    return time.perf_counter() - begin
