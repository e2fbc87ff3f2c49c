"""What surrounds the steps: the time grid and its checks, storage, and what is reported about a trajectory."""

from typing import NamedTuple

import numpy as np

from codegen.runtime.stepping.composition import advance_parts, allocate_parts
from codegen.runtime.optimise.counts import checked_count
from codegen.runtime.stand_ins.example_step import PARTS, STAGES, STATE
from codegen.runtime.stepping.step_newton import advance, allocate_work
from codegen.runtime.optimise.tolerances import checked_tolerance
from codegen.runtime.stepping.trajectory import energies, follow, largest_residual

FAILURES = {
    -1: ("non-finite", "a state is infinite or not a number; use more steps, or check start and parameters"),
    -2: ("singular", "the equations of the step have no unique solution; use more steps, or check the parameters"),
    -3: ("newton failed", "Newton's method did not converge; use more steps, or raise max_iterations"),
}


class Grid(NamedTuple):
    """N steps of length h, the values of the parameters, and the initial state (q, p)."""

    steps: int
    h: float
    parameters: np.ndarray
    start: np.ndarray


def checked_grid(steps, duration, parameters, start):
    """A Grid; ValueError when a number is not finite, or when steps or duration are not positive."""
    steps = checked_count("steps", steps)
    if not 0.0 < duration < np.inf:
        raise ValueError(f"duration is {duration!r}, expected a positive number")
    parameters, start = np.array(parameters, dtype=float), np.array(start, dtype=float)
    if not np.isfinite(parameters).all():
        raise ValueError(f"parameters must be finite, got {parameters}")
    if start.shape != (STATE,):
        raise ValueError(f"start has shape {start.shape}, expected ({STATE},): first positions, then momenta")
    if not np.isfinite(start).all():
        raise ValueError(f"start must be finite, got {start}")
    return Grid(steps, float(duration) / steps, parameters, start)


def replace_values(boundary, values):
    """Overwrite initial values by name; ValueError tells which names there are."""
    for quantity, value in values.items():
        if quantity not in boundary:
            raise ValueError(f"{quantity!r} is not prescribed at the start; prescribed: {', '.join(boundary)}")
        boundary[quantity] = float(value)


def integrate(grid, every, tolerance, max_iterations):
    """Follow the motion; return (status, message, steps, t, q, p, energy, residual, iterations)."""
    every = min(checked_count("every", every), grid.steps)
    tolerance, max_iterations = checked_tolerance(tolerance, 1e-6), checked_count("max_iterations", max_iterations)
    path = np.empty((1 - (-grid.steps // every), STATE))
    before = path if every == 1 else np.empty((path.shape[0] - 1, STATE))
    steps, rows, iterations, outcome = follow(
        grid.start, grid.steps, grid.h, grid.parameters, every, tolerance, max_iterations, path, before
    )
    t = grid.h * np.minimum(every * np.arange(rows), steps)
    energy = np.empty(rows)
    energies(path, t, grid.parameters, energy)
    measured = rows if outcome == 0 else 1 + steps // every
    residual = largest_residual(
        before, path, measured, steps, grid.h, grid.parameters, every, tolerance, max_iterations
    )
    status, message = describe(grid, steps, iterations, outcome)
    q, p = path[:rows, : STATE // 2].copy(), path[:rows, STATE // 2 :].copy()
    return status, message, steps, t, q, p, energy, residual if steps else np.nan, iterations


def describe(grid, steps, iterations, outcome):
    """Status and one sentence on how the trajectory ended, naming the step that failed and its time."""
    if outcome == 0:
        effort = f" with {iterations / steps:.2f} iterations each" if iterations else ""
        return "solved", f"all {steps} steps were made{effort}"
    status, remedy = FAILURES[outcome]
    place = f"step {steps + 1} of {grid.steps}, from t = {steps * grid.h:g} to {(steps + 1) * grid.h:g}"
    return status, f"{status} in {place}: {remedy}"


def step(grid, state, t=0.0, tolerance=1e-13, max_iterations=50):
    """State (q, p) one step of length grid.h after `state`; NaN when the equations cannot be solved."""
    interval = np.empty(STAGES + STATE)
    state = np.array(state, dtype=float)
    if PARTS:
        work = allocate_parts(grid.h, grid.parameters)
        outcome = advance_parts(state, t, grid.parameters, work, interval, tolerance, max_iterations)
    else:
        work = allocate_work(grid.h, grid.parameters)
        outcome = advance(state, t, grid.h, grid.parameters, work, interval, tolerance, max_iterations)
    return interval[STAGES:] if outcome >= 0 else np.full(STATE, np.nan)


def path_residual(grid, path, tolerance=1e-13, max_iterations=50):
    """Max-norm of the scheme's own equations along an array of consecutive states, shape (M, 2 n)."""
    path = np.array(path, dtype=float)
    count = path.shape[0]
    return largest_residual(path, path, count, count, grid.h, grid.parameters, 1, tolerance, max_iterations)
