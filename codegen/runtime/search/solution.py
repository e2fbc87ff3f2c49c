"""The solution of an optimal control problem, as `solve` of a generated module returns it."""

import math
from typing import NamedTuple

import numpy as np

from codegen.runtime.search.grid import Grid, checked_count, checked_tolerance, with_pinned_values
from codegen.runtime.search.iteration_log import Log, print_log
from codegen.runtime.search.solve import optimise


class Solution(NamedTuple):
    """A solution; `t` is (N + 1,), other arrays have a row for each of the N + 1 nodes, or of the N intervals.

    Attributes
    ----------
    status, message : str
    cost : float
        If the status is "solved", corrected by what residuals are worth.
    residual, stationarity : float
        Max-norms of all discrete equations and of the optimality conditions, both evaluated at the solution.
    iterations : int
    t, q, p, u, multipliers : array
        Times, coordinates, momenta, controls, and multipliers, a column for each, of several bodies side by side.
    unknowns : (n,)
        The vector that `guess` takes.
    log : (iterates, 5 or 6)
    scaled : Grid
        The grid with the scaling factors with which the search began.
    """

    status: str
    message: str
    cost: float
    residual: float
    stationarity: float
    iterations: int
    t: np.ndarray
    q: np.ndarray
    p: np.ndarray
    u: np.ndarray
    multipliers: np.ndarray
    unknowns: np.ndarray
    log: np.ndarray
    scaled: Grid


def solve_on(
    grid, guess=None, tolerance=1e-10, max_iterations=3000, time_limit=math.inf, warm=False, scaling="auto", log=False,
    watch=None,
):  # fmt: skip
    """Find a local minimum on a grid.

    Parameters
    ----------
    grid : Grid
        Intervals, parameters and the problem.
    guess : (n,) or None
        Unknowns to start from; None for the problem's own guess.
    tolerance : float
        Of residuals and stationarity, absolute where their terms exceed one, relative to these where they are smaller.
    max_iterations : int
        Of all searches together.
    time_limit : float
        Seconds after which the search ends.
    warm : bool
        True if the guess is close to the solution.
    scaling : str
        "auto", or "none" for a solver that works in the problem's own units.
    log : bool
        True to print the iterates.
    watch : callable or None
        Called with the number and the row of the log of every iterate.

    Returns
    -------
    Solution
        Where the numerics fail, `status` is not "solved", and `message` says what happened and what to try.

    Raises
    ------
    ValueError
        When an argument is unusable.
    """
    problem = grid.problem
    unknowns = problem.initial_guess(grid) if guess is None else with_pinned_values(grid, guess)
    tolerance, max_iterations = checked_tolerance(tolerance, 1.0), checked_count("max_iterations", max_iterations)
    iterates = Log(time_limit, watch)
    status, message, point, iterations, scaled = optimise(
        grid, unknowns, tolerance, max_iterations, warm, scaling, iterates
    )
    rows = iterates.table()
    if log:
        print_log(rows)
    return Solution(
        status, message, float(point.cost), float(point.residual), float(point.stationarity), iterations,
        *problem.unpack(grid, point.unknowns), point.unknowns, rows, scaled,
    )  # fmt: skip
