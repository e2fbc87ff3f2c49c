"""Running a driver: machine code first, then the timed runs, then the residuals that no driver can embellish."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from codegen.drivers import Driver
from codegen.errors import FileError, NumericsError
from codegen.files import refused
from codegen.loading import (
    GeneratedModule,
    code_folders,
    is_connect,
    is_control,
    is_simulation,
    load,
    machine_code_counts,
)
from codegen.machine_code.compilation import solve_small
from codegen.solutions.connect import connect_result
from codegen.solutions.control import control_result
from codegen.solutions.result import Request, Result
from codegen.solutions.simulate import simulate_result


def run(module: GeneratedModule, driver: Driver, request: Request, repeat: int) -> Result:
    """Solve `repeat` times with warm machine code, and assess the last solution; see `codegen.solving.solve`."""
    for name, number in (("steps", request.steps), ("every", request.every), ("repeat", repeat)):
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise NumericsError(f"{name} is {number!r}", "give a positive integer")
    _require_memory(module, request)
    function = driver.function(module.metadata["task"])
    begin, compiled_before = time.perf_counter(), machine_code_counts(module)[0]
    try:
        _touch(module, request, driver.name)
        attempt, seconds, warm_up = _timed(module, lambda: function(module, request), repeat)
    except ValueError as error:
        # Generated modules know nothing of codegen's errors.
        raise NumericsError(str(error), "correct the problem's numbers or the options") from error
    except OSError as error:
        raise unkept(module, error) from error
    result: Result
    if is_connect(module):
        result = connect_result(module, driver.name, request, attempt)
    elif is_control(module):
        result = control_result(module, driver.name, request, attempt)
    elif is_simulation(module):
        result = simulate_result(module, driver.name, request, attempt, seconds)
    compiled = machine_code_counts(module)[0] > compiled_before
    return replace(result, seconds_solve=seconds, seconds_first=warm_up - begin, compiled=compiled)


def _require_memory(module: GeneratedModule, request: Request) -> None:
    """Refuse what would not fit into memory, before the operating system kills the process without a word.

    A simulation keeps the path, its positions and momenta, times and energies; the generated solver of a control
    problem was measured to need 26 numbers for every unknown.
    """
    metadata = module.metadata
    if metadata["task"] == "simulate":
        numbers = (request.steps // request.every + 1) * (4 * len(metadata["coordinates"]) + 2)
    elif metadata["task"] == "connect":
        count = 0 if request.points is None else len(request.points.start)
        numbers = 40 * (request.steps + 1) * count * len(metadata["coordinates"]) + 2 * count**2
    else:
        intervals = request.steps * metadata.get("phases", 1)
        numbers = 26 * (intervals + 1) * (len(metadata["node"]) + len(metadata["interval"]))
    if not hasattr(os, "sysconf"):
        return
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if 8 * numbers > memory:
        raise NumericsError(
            f"{request.steps} steps need about {8e-9 * numbers:.0f} GB of memory, and there are {1e-9 * memory:.0f}",
            "take fewer steps, or store only every so many-th of a simulation",
        )


def compile_here(path: Path) -> None:
    """Have all that `newton` needs of a module compiled in this process."""
    module = load(path)
    try:
        if is_connect(module):
            solve_small(module)
        else:
            module.solve()  # which tells what is wrong, or compiles what is missing
    except OSError as error:
        raise unkept(module, error) from error


def unkept(module: GeneratedModule, error: OSError) -> FileError:
    """The error that says where machine code of a module cannot be written, and what to do about it."""
    folder = ", ".join(sorted(code_folders(module))) or "the folder of machine code"
    return refused(error, folder, "make room there, or let NUMBA_CACHE_DIR name a folder that may be written to")


def _touch(module: GeneratedModule, request: Request, driver: str) -> None:
    """Have the functions compiled, or their machine code read, that a driver of scipy may call."""
    if driver == "newton":
        return
    if is_control(module):
        grid = module.make_grid(request.steps)
        unknowns = module.initial_guess(grid)
        for evaluate in (module.cost, module.cost_gradient, module.constraints, module.jacobian, module.hessian):
            evaluate(grid, unknowns)
    elif is_simulation(module):
        module.solve(steps=1)


def _timed(module: GeneratedModule, solve: Callable[[], Any], repeat: int) -> tuple[Any, float, float]:
    """The last attempt, the least time of the runs with warm machine code, and when the first of them began."""
    best, first_warm = math.inf, math.nan
    runs = 0
    while runs < repeat:
        counts, begin = machine_code_counts(module), time.perf_counter()
        attempt = solve()
        seconds = time.perf_counter() - begin
        if machine_code_counts(module) == counts:
            first_warm = begin if runs == 0 else first_warm
            best = min(best, seconds)
            runs += 1
    return attempt, best, first_warm
