"""Step after step from an initial state, and what is reported about the states that are stored.

A scheme's `advance(state, t, h, given, work, interval)` fills the end of `interval` with the state after a step, in
arrays of `allocate_work(h, given)`; it returns the iterations, or a negative number that says why there is no step.
`given` is the same for all steps: parameters, then what else the scheme takes.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.optimise.counts import checked_count, checked_times
from codegen.runtime.stand_ins.example_step import PARTS, RANGED, STAGES, STATE
from codegen.runtime.stepping.body_motion import FAILURES, energies, largest_residual, settings_for
from codegen.runtime.stepping.composition import advance_parts, allocate_parts
from codegen.runtime.stepping.step_newton import advance, allocate_work
from codegen.runtime.tabulated.table_left import range_left
from codegen.runtime.tabulated.table_steps import LEFT_TABLE, left_tables


class Grid(NamedTuple):
    """N steps of length h, the values of the parameters, the initial state, and what all steps are `given`."""

    steps: int
    h: float
    parameters: np.ndarray
    start: np.ndarray
    given: tuple[object, ...]


def checked_step_grid(steps, duration, parameters, start, *own):
    """A Grid; ValueError when a number is not finite, a shape does not fit, or steps or duration are not positive."""
    steps, duration = checked_times(steps, duration)
    parameters, start = np.array(parameters, dtype=float), np.array(start, dtype=float)
    settings = settings_for(start, *own)
    for name, values in (("parameters", parameters), ("start", start)):
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite, got {values}")
    return Grid(steps, duration / steps, parameters, start, (parameters, *settings))


@njit(cache=True, error_model="numpy")
def follow(start, steps, h, given, every, path, before):
    """Make the steps and store every `every`-th state, and the last, in the rows of `path`, shape (M, start.size).

    Row i of `before` takes the state one step before that of row i + 1 of `path`; with `every` 1 nothing is written
    there. Stops at the first step that fails, and then stores the last good state. Returns the number of steps made,
    the rows of `path` in use, the iterations and 0, or a negative number that says why the next step failed.
    """
    if STATE:
        state, interval = start.copy(), np.empty(STAGES + STATE)
        now, after, size = state, interval[STAGES:], STATE
    else:
        state, interval = start.copy(), np.empty(start.shape)
        now, after, size = state.reshape(-1), interval.reshape(-1), start.size
    if PARTS:  # noqa: SIM108  decided when a module is made
        work = allocate_parts(h, given)
    else:
        work = allocate_work(h, given)
    if RANGED:
        inputs = np.empty((RANGED, 2))
    rows, iterations, wait = 1, 0, every
    for i in range(size):
        path[0, i] = now[i]
    for k in range(steps):
        if PARTS:
            outcome = advance_parts(state, k * h, given, work, interval)
        else:
            outcome = advance(state, k * h, h, given, work, interval)
            if RANGED and outcome >= 0 and left_tables(state, interval, k * h, h, given[0], inputs) >= 0:
                outcome = LEFT_TABLE
        total = 0.0
        for i in range(size):
            total += abs(after[i])
        if outcome >= 0 and not total < np.inf:
            outcome = -1
        if outcome < 0:
            if wait < every:
                for i in range(size):
                    path[rows, i] = now[i]
                rows += 1
            return k, rows, iterations, outcome
        iterations += outcome
        wait -= 1
        is_stored = wait == 0 or k == steps - 1
        if is_stored and every > 1:
            for i in range(size):
                before[rows - 1, i] = now[i]
        for i in range(size):
            now[i] = after[i]
        if is_stored:
            for i in range(size):
                path[rows, i] = now[i]
            rows += 1
            wait = every
    return steps, rows, iterations, 0


def integrate(grid, every):
    """Follow the motion; return (status, message, steps, t, q, p, energy, residual, iterations).

    Shapes are (M,) for M stored states, and (M, n) for q and p, of n numbers each.
    """
    every, size = min(checked_count("every", every), grid.steps), grid.start.size
    path = np.empty((1 - (-grid.steps // every), size))
    before = path if every == 1 else np.empty((path.shape[0] - 1, size))
    steps, rows, iterations, outcome = follow(grid.start, grid.steps, grid.h, grid.given, every, path, before)
    t, energy = grid.h * np.minimum(every * np.arange(rows), steps), np.empty(rows)
    energies(path, t, grid.given, energy)
    measured = rows if outcome == 0 else 1 + steps // every
    residual = largest_residual(before, path, measured, steps, grid.h, grid.given, every)
    status, message = describe(grid, steps, iterations, outcome)
    if RANGED and outcome == LEFT_TABLE:
        message = message.format(range_left(grid, path[rows - 1], steps * grid.h))
    q, p = path[:rows, : size // 2].copy(), path[:rows, size // 2 :].copy()
    return status, message, steps, t, q, p, energy, residual if steps else np.nan, iterations


def describe(grid, steps, iterations, outcome):
    """Status and one sentence on how the trajectory ended, naming the step that failed and its time."""
    if outcome == 0:
        effort = f" with {iterations / steps:.2f} iterations each" if iterations else ""
        return "solved", f"all {steps} steps were made{effort}"
    status, remedy = FAILURES[outcome]
    where = f"step {steps + 1} of {grid.steps}, from t = {steps * grid.h:g} to {(steps + 1) * grid.h:g}"
    return status, f"{status} in {where}: {remedy}"


def path_residual(grid, path):
    """The residual along an array of consecutive states, shape (M, 2 n); see `largest_residual`."""
    path = np.array(path, dtype=float)
    count = path.shape[0]
    return largest_residual(path, path, count, count, grid.h, grid.given, 1)
