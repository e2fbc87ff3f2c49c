"""Running a driver: machine code first, then the timed runs, then the residuals that no driver can embellish.

Solutions carried from one time grid to another: warm starts, and mesh sequences N, 2N, 4N with an error estimate.
Sources: Betts (2010), Practical methods for optimal control, section 4.7, for mesh refinement; Richardson (1911) for
the extrapolation.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from codegen.errors import NumericsError
from codegen.runtime.record import Sites
from codegen.solving.drivers import Driver
from codegen.solving.drivers.shared import quiet_single_thread
from codegen.solving.interfaces import ControlModule, GeneratedModule, Matrix, Vector, time_grid
from codegen.solving.loading import machine_code_counts
from codegen.solving.machine_code.ahead_of_time import seconds_of_machine_code, unwritable_cache_error
from codegen.solving.results.result import Result, Run
from codegen.solving.tasks import Task, task_of


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


def transferred(
    module: ControlModule, unknowns: Vector, steps: int, source: Vector | None = None, target: Vector | None = None
) -> Vector:
    """A solution's unknowns on a grid of N intervals, N = `steps`: interpolated in time, without overshoot.

    Nodes are interpolated between nodes, intervals between their midpoints, in every phase by itself. Intervals are
    equal, or last the fractions `source` of the solution and `target` of the new grid. Raises NumericsError when the
    vector belongs to another problem.
    """
    old_steps = source_steps(module, unknowns)
    old_grid, new_grid = time_grid(module, old_steps, source), time_grid(module, steps, target)
    result = np.zeros(new_grid.is_multiplier.size)
    old_nodes, old_intervals = module.views(old_grid, unknowns)
    new_nodes, new_intervals = module.views(new_grid, result)
    old_times, new_times = old_grid.nodes / old_steps, new_grid.nodes / steps
    for phase in range(module.metadata.phases):
        first = min(phase, 1)  # the node at a switch belongs to the phase before, since it has the values before a jump
        old, new = (slice(phase * n + first, (phase + 1) * n + 1) for n in (old_steps, steps))
        new_nodes[:, new] = _interpolated(old_times[old], old_nodes[:, old], new_times[new])
        old, new = (slice(phase * n, (phase + 1) * n) for n in (old_steps, steps))
        new_intervals[:, new] = _interpolated(_middles(old_times)[old], old_intervals[:, old], _middles(new_times)[new])
    rest = module.problem.structure.root
    result[result.size - rest :] = unknowns[unknowns.size - rest :]
    return module.with_pinned_values(new_grid, result)


def source_steps(module: ControlModule, unknowns: Vector) -> int:
    """The number of intervals, of each phase, that a vector of unknowns belongs to."""
    metadata = module.metadata
    node, bodies = len(metadata.node), metadata.bodies
    phase = metadata.phases * (node + len(metadata.interval))
    steps: int
    steps, rest = divmod((unknowns.size - module.problem.structure.root) // bodies - node, phase)
    if rest or steps < 1 or bodies * (steps * phase + node) + module.problem.structure.root != unknowns.size:
        raise NumericsError(
            f"the start has {unknowns.size} unknowns, which fit no number of steps", "use a solution of this problem"
        )
    return steps


def _middles(times: Vector) -> Vector:
    return 0.5 * (times[:-1] + times[1:])


def _interpolated(t: Vector, values: Matrix, at: Vector) -> Matrix:
    if t.size == 1:
        return np.repeat(values, at.size, axis=1)
    from scipy.interpolate import PchipInterpolator  # which takes long to import

    with np.errstate(over="ignore"):  # reciprocals of slopes that are next to zero
        return np.asarray(PchipInterpolator(t, values, axis=1)(np.clip(at, t[0], t[-1])), dtype=float)


def refine(
    solve: Callable[[int, Vector | None], Result],
    module: ControlModule,
    steps: int,
    doublings: int,
    warm: Vector | None = None,
) -> Result:
    """Solve on N, 2N, 4N, ... intervals, each from the solution before; the last result, with an error estimate.

    `solve` takes a number of intervals and a start; `warm` is the first one. A grid that fails leaves the next one to
    start from the last solution, or from the problem's own guess where there is none: a grid may be too coarse for a
    solution. How each ended is told in `levels`. The summary gains, where the last two or more were solved, the cost
    extrapolated by the order of optima and its distance from the last one as an error estimate, and the order that
    three grids show.
    """
    known, results = warm, list[Result]()
    for number in [steps * 2**k for k in range(doublings + 1)]:
        results.append(solve(number, None if known is None else transferred(module, known, number)))
        known = results[-1].unknowns if results[-1].solved else known
    costs = [result.cost for result in _solved_to_the_end(results) if result.cost is not None]
    # What the first solve alone knows, such as how many guesses it tried, stays.
    summary = {**results[0].summary, **results[-1].summary, **_estimates(module, costs)}
    return replace(results[-1], summary=summary, attempts=results[0].attempts, levels=tuple(results))


def _solved_to_the_end(results: Sequence[Result]) -> Sequence[Result]:
    """Those behind the last failure."""
    failed = [index for index, result in enumerate(results) if not result.solved]
    return results[failed[-1] + 1 if failed else 0 :]


def order_of_optima(module: ControlModule) -> int:
    """The order at which costs converge: the scheme's own, but 2 at most where there are controls.

    A control that is constant on each interval, or linear between nodes, approximates a smooth one at order 2, and the
    cost at its minimum no better, whatever the scheme of the motion. With controls at stages it has the scheme's order.
    """
    order, metadata = int(module.metadata.order), module.metadata
    return min(order, 2) if metadata.control_names and metadata.controls != Sites.STAGES else order


def _estimates(module: ControlModule, costs: list[float]) -> dict[str, float]:
    """What a sequence of costs on halved steps tells of their limit."""
    order = order_of_optima(module)
    summary: dict[str, float] = {}
    if len(costs) > 1:
        error = (costs[-1] - costs[-2]) / (2**order - 1)
        summary |= {"cost_extrapolated": costs[-1] + error, "cost_error_estimate": abs(error)}
    if len(costs) > 2:
        before, last = costs[-2] - costs[-3], costs[-1] - costs[-2]
        # Differences at rounding level show no order.
        if min(abs(before), abs(last)) > 1e-12 * max(1.0, abs(costs[-1])) and before / last > 0.0:
            summary["observed_order"] = float(np.log2(before / last))
    return summary
