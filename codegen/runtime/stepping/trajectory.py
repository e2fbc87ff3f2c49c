"""Step after step from an initial state, and what is measured along the stored path.

`interval` holds what belongs to one step: inner stages (STAGES of them), then the state at the right node.
"""

import numpy as np
from numba import njit

from codegen.runtime.stepping.composition import advance_parts, allocate_parts, parts_residual
from codegen.runtime.stand_ins.example_step import PARTS, STAGES, STATE, energy, step_equations
from codegen.runtime.stepping.step_newton import advance, allocate_work


@njit(cache=True, error_model="numpy")
def follow(start, steps, h, parameters, every, tolerance, max_iterations, path, before):
    """Make the steps and store every `every`-th state, and the last, in the rows of `path`.

    Row i of `before` takes the state one step before that of row i + 1 of `path`; with `every` 1 nothing is written
    there. Stops at the first step that fails, and then stores the last good state. Returns the number of steps made,
    the rows of `path` in use, the iterations and 0, or a negative number that says why the next step failed.
    """
    state, interval = start.copy(), np.empty(STAGES + STATE)
    if PARTS:  # noqa: SIM108  decided when a module is made
        work = allocate_parts(h, parameters)
    else:
        work = allocate_work(h, parameters)
    rows, iterations, wait = 1, 0, every
    for i in range(STATE):
        path[0, i] = state[i]
    for k in range(steps):
        if PARTS:
            outcome = advance_parts(state, k * h, parameters, work, interval, tolerance, max_iterations)
        else:
            outcome = advance(state, k * h, h, parameters, work, interval, tolerance, max_iterations)
        total = 0.0
        for i in range(STATE):
            total += abs(interval[STAGES + i])
        if outcome >= 0 and not total < np.inf:
            outcome = -1
        if outcome < 0:
            if wait < every:
                for i in range(STATE):
                    path[rows, i] = state[i]
                rows += 1
            return k, rows, iterations, outcome
        iterations += outcome
        wait -= 1
        is_stored = wait == 0 or k == steps - 1
        if is_stored and every > 1:
            for i in range(STATE):
                before[rows - 1, i] = state[i]
        for i in range(STATE):
            state[i] = interval[STAGES + i]
        if is_stored:
            for i in range(STATE):
                path[rows, i] = state[i]
            rows += 1
            wait = every
    return steps, rows, iterations, 0


@njit(cache=True, error_model="numpy")
def largest_residual(before, path, rows, steps, h, parameters, every, tolerance, max_iterations):
    """Max-norm of the scheme's own equations over the steps that led from `before` to rows 1, 2, ... of `path`.

    Inner stages, which are not stored, are computed again from the state before the step.
    """
    interval, residual = np.empty(STAGES + STATE), np.empty(STAGES + STATE)
    if PARTS:  # noqa: SIM108  decided when a module is made
        work = allocate_parts(h, parameters)
    else:
        work = allocate_work(h, parameters)
    largest = 0.0
    for row in range(1, rows):
        t = (min(row * every, steps) - 1) * h
        if PARTS:
            size = parts_residual(
                before[row - 1], path[row], t, parameters, work, interval, residual, tolerance, max_iterations
            )
            largest = max(largest, size)
        else:
            if STAGES > 0:
                advance(before[row - 1], t, h, parameters, work, interval, tolerance, max_iterations)
            for i in range(STATE):
                interval[STAGES + i] = path[row, i]
            step_equations(before[row - 1], interval, t, h, parameters, residual)
            for i in range(STAGES + STATE):
                if not abs(residual[i]) < np.inf:
                    return np.inf
                largest = max(largest, abs(residual[i]))
    return largest


@njit(cache=True, error_model="numpy")
def energies(path, times, parameters, values):
    """Fill `values` with the Hamiltonian along the path."""
    for row in range(values.size):
        values[row] = energy(path[row], times[row], parameters)
