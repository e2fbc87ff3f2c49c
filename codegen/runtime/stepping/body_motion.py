"""The motion of a body: what its steps are given, and what is measured along the stored states."""

import numpy as np
from numba import njit

from codegen.runtime.optimise.counts import checked_count
from codegen.runtime.optimise.tolerances import checked_tolerance
from codegen.runtime.stand_ins.example_step import PARTS, RANGED, STAGES, STATE, energy, step_equations
from codegen.runtime.stepping.composition import advance_parts, allocate_parts, parts_residual
from codegen.runtime.stepping.step_newton import advance, allocate_work
from codegen.runtime.tabulated.table_steps import LEFT_TABLE

FAILURES = {
    -1: ("non-finite", "a state is infinite or not a number; use more steps, or check start and parameters"),
    -2: ("singular", "the equations of the step have no unique solution; use more steps, or check the parameters"),
    -3: ("newton failed", "Newton's method did not converge; use more steps, or raise max_iterations"),
}


if RANGED:
    FAILURES[LEFT_TABLE] = (
        "outside a table",
        "{}; keep the motion inside, take a wider table, or give it outside='clamp' or 'extend'",
    )


def settings_for(start):
    """What steps are given beside parameters: tolerance and iterations; ValueError when the start does not fit."""
    if start.shape != (STATE,):
        raise ValueError(f"start has shape {start.shape}, expected ({STATE},): first positions, then momenta")
    return 1e-13, 50


def with_settings(grid, tolerance, max_iterations):
    """The grid with other settings; ValueError when they are unusable."""
    tolerance, max_iterations = checked_tolerance(tolerance, 1e-6), checked_count("max_iterations", max_iterations)
    return grid._replace(given=(grid.parameters, tolerance, max_iterations))


def replace_values(boundary, values):
    """Overwrite initial values by name; ValueError tells which names there are."""
    for quantity, value in values.items():
        if quantity not in boundary:
            raise ValueError(f"{quantity!r} is not prescribed at the start; prescribed: {', '.join(boundary)}")
        boundary[quantity] = float(value)


def step(grid, state, t=0.0):
    """State (q, p), shape (STATE,), a step of length grid.h after `state`; NaN when its equations cannot be solved."""
    state, interval = np.array(state, dtype=float), np.empty(STAGES + STATE)
    if PARTS:
        outcome = advance_parts(state, t, grid.given, allocate_parts(grid.h, grid.given), interval)
    else:
        outcome = advance(state, t, grid.h, grid.given, allocate_work(grid.h, grid.given), interval)
    return interval[STAGES:] if outcome >= 0 else np.full(STATE, np.nan)


@njit(cache=True, error_model="numpy")
def largest_residual(before, path, rows, steps, h, given, every):
    """Max-norm of the scheme's own equations over the steps that led from `before` to rows 1, 2, ... of `path`.

    Rows have shape (STATE,). Inner stages, which are not stored, are computed again from the state before the step.
    """
    interval, residual = np.empty(STAGES + STATE), np.empty(STAGES + STATE)
    if PARTS:  # noqa: SIM108  decided when a module is made
        work = allocate_parts(h, given)
    else:
        work = allocate_work(h, given)
    largest = 0.0
    for row in range(1, rows):
        t = (min(row * every, steps) - 1) * h
        if PARTS:
            size = parts_residual(before[row - 1], path[row], t, given, work, interval, residual)
            largest = max(largest, size)
        else:
            if STAGES > 0:
                advance(before[row - 1], t, h, given, work, interval)
            for i in range(STATE):
                interval[STAGES + i] = path[row, i]
            step_equations(before[row - 1], interval, t, h, given[0], residual)
            for i in range(STAGES + STATE):
                if not abs(residual[i]) < np.inf:
                    return np.inf
                largest = max(largest, abs(residual[i]))
    return largest


@njit(cache=True, error_model="numpy")
def energies(path, times, given, values):
    """Fill `values`, shape (M,), with the Hamiltonian along the path, shape (M or more, STATE), at `times`."""
    for row in range(values.size):
        values[row] = energy(path[row], times[row], given[0])
