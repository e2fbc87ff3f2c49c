"""Running a driver: machine code first, then the timed runs, then the residuals that no driver can embellish."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from codegen.drivers import Driver
from codegen.drivers.quiet import quiet_single_thread
from codegen.errors import NumericsError
from codegen.interfaces import GeneratedModule
from codegen.loading import machine_code_counts
from codegen.machine_code.ahead_of_time import unwritable_cache_error
from codegen.machine_code.seconds import seconds_of_machine_code
from codegen.solutions.result import Result, Run
from codegen.tasks import Task, task_of


def run_and_verify(module: GeneratedModule, driver: Driver, run: Run, repeat: int) -> Result:
    """Run a driver `repeat` times, and assess the last solution; see `codegen.solve`.

    The time is the least of the runs. The time in which numba compiles or reads functions during a run is left
    out: a driver may call functions for the first time.
    """
    task = task_of(module)
    require_memory(task.numbers(module.metadata, run), run.steps)
    function = driver.function(task.name)
    compiled_before = machine_code_counts(module)[0]
    begin = time.perf_counter()
    try:
        _get_ready(module, driver, task, run.steps)
        code_seconds = time.perf_counter() - begin
        attempt, seconds, late = _timed(lambda: function(module, run), repeat)
    except ValueError as error:
        # Generated modules know nothing of codegen's errors.
        raise NumericsError(str(error), "correct the problem's numbers or the options") from error
    except OSError as error:
        raise unwritable_cache_error(module, error) from error
    result: Result = task.result(module, driver.name, run, attempt, seconds)
    compiled = machine_code_counts(module)[0] > compiled_before
    return replace(result, seconds_code=code_seconds + late, compiled=compiled)


def _get_ready(module: GeneratedModule, driver: Driver, task: Task, steps: int) -> None:
    """Load the functions of a driver in this process before a run is timed, by calls of a smaller problem."""
    if not driver.generated:  # the others call what this one does not
        with quiet_single_thread():
            task.touch(module, steps)
        return
    if machine_code_counts(module) == (0, 0):
        with quiet_single_thread():
            task.small(module)


def require_memory(numbers: int, steps: int) -> None:
    """Refuse what would not fit into memory, before the operating system kills the process without a word."""
    if not hasattr(os, "sysconf"):
        return
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if 8 * numbers > memory:
        raise NumericsError(
            f"{steps} steps need about {8e-9 * numbers:.0f} GB of memory, and there are {1e-9 * memory:.0f}",
            "take fewer steps, or store only every so many-th of a simulation",
        )


def _timed(solve: Callable[[], Any], repeat: int) -> tuple[Any, float, float]:
    """The last attempt, the least time of the runs, and the seconds of machine code in all of them."""
    best, code_seconds = math.inf, 0.0
    for _ in range(repeat):
        with seconds_of_machine_code() as spent:
            begin = time.perf_counter()
            attempt = solve()
            seconds = time.perf_counter() - begin
        code_seconds += spent.seconds
        best = min(best, max(seconds - spent.seconds, 0.0))
    return attempt, best, code_seconds
