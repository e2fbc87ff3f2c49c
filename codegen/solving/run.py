"""Running a driver: machine code first, then the timed runs, then the residuals that no driver can embellish."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from codegen.drivers import Driver
from codegen.errors import NumericsError
from codegen.interfaces import GeneratedModule
from codegen.loading import machine_code_counts
from codegen.machine_code.ahead_of_time import unwritable_cache_error
from codegen.solutions.result import Result, Run
from codegen.tasks import task_of


def run_and_verify(module: GeneratedModule, driver: Driver, run: Run, repeat: int) -> Result:
    """Run a driver `repeat` times with warm machine code, and assess the last solution; see `codegen.solve`."""
    task = task_of(module)
    require_memory(task.numbers(module.metadata, run), run.steps)
    function = driver.function(task.name)
    begin, compiled_before = time.perf_counter(), machine_code_counts(module)[0]
    try:
        if not driver.generated:  # the others call what this one does not
            task.touch(module, run.steps)
        attempt, seconds, warm_up = _timed(module, lambda: function(module, run), repeat)
    except ValueError as error:
        # Generated modules know nothing of codegen's errors.
        raise NumericsError(str(error), "correct the problem's numbers or the options") from error
    except OSError as error:
        raise unwritable_cache_error(module, error) from error
    result: Result = task.result(module, driver.name, run, attempt, seconds)
    compiled = machine_code_counts(module)[0] > compiled_before
    return replace(result, seconds_first=warm_up - begin, compiled=compiled)


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
