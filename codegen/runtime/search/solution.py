"""The solution of an optimal control problem that `solve` of a generated module returns, and the log of a search."""

import math
from time import perf_counter
from typing import NamedTuple

import numpy as np

from codegen.runtime.search.grid import Grid, checked_count, checked_tolerance, with_pinned_values
from codegen.runtime.search.solve import optimise

BETWEEN_LOOKS = 1e-3  # seconds between readings of the clock with a time limit, but at least one iteration


class Solution(NamedTuple):
    """The solution of an optimal control problem with N intervals.

    Arrays of the motion, except `t`, have one row for each of the N + 1 nodes or of the N intervals. They have one
    column for each quantity, with the columns of several bodies side by side.

    Attributes
    ----------
    status, message : str
        The termination status, such as "solved", and a sentence on the end of the search.
    cost : float
        The discrete cost. If the status is "solved", it is corrected to first order for the residuals.
    residual, stationarity : float
        Max-norms of all discrete equations and of the optimality conditions, both evaluated at the solution.
    iterations : int
        The number of iterations of all searches together.
    t : (N + 1,)
        Times of the nodes.
    q, p, u, multipliers : array
        Coordinates, momenta, controls and multipliers.
    unknowns : (n,)
        All unknowns, which `solve` takes as its `guess`.
    log : (iterates, 5 or 6)
        For each iterate cost, residual, stationarity, shift of the Hessian, step length, and with bounds the weight of
        the barrier.
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
        Unknowns of the initial guess; None stands for the problem's own initial guess.
    tolerance : float
        Tolerance of residuals and stationarity: absolute if their terms exceed one, relative to smaller terms.
    max_iterations : int
        Largest number of iterations of all searches together.
    time_limit : float
        Seconds after which the search ends.
    warm : bool
        True for a warm start: the guess is close to the solution.
    scaling : str
        "auto" for automatic scaling factors, or "none" for a search in the problem's own units.
    log : bool
        True to print the iterates.
    watch : callable or None
        Function (number, row) that is called with the number and the log row of every iterate.

    Returns
    -------
    Solution
        If the numerics fail, `status` is not "solved", and `message` states the reason and a remedy.

    Raises
    ------
    ValueError
        If an argument is unusable.
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


class Log:
    """The log of a search, with its time limit in seconds.

    `parts` are arrays of rows of iterates, `watch` is None or a function that is called with the number and the row of
    each iterate.
    """

    def __init__(self, time_limit=math.inf, watch=None):
        if not time_limit > 0.0:
            raise ValueError(f"time_limit is {time_limit!r}, expected a positive number of seconds")
        self.parts, self.watch, self.deadline = [], watch, perf_counter() + time_limit
        self._called, self._iteration = 0.0, math.inf  # time of the last call of the search; seconds of an iteration

    def iterations_per_call(self, _done, most, affordable):
        """Return the largest number of iterations for the next call of the compiled search.

        The number is at most `most`, the room in the log array, and `affordable`. It is one if there is a `watch`
        function. With a time limit, the search returns after about a millisecond. Once the time limit has passed, the
        number is zero: the search then only tests for convergence.
        """
        if self.deadline < math.inf:
            self._called = perf_counter()
            if self._called > self.deadline:
                return 0
            affordable = min(affordable, int(BETWEEN_LOOKS / self._iteration))
        if self.watch is not None:
            return 1
        return max(1, min(most, affordable))

    def extend(self, search, rows):
        """Keep the rows (k, 6) of iterates, which are in the problem's own units."""
        if self.deadline < math.inf:
            self._iteration = max(1e-9, perf_counter() - self._called) / max(1, len(rows))
        self._keep(rows[:, : 6 if search.is_bounded else 5].copy())

    def add(self, point, length):
        """Keep a row for a point of a search that has no shifts of the Hessian."""
        self._keep(np.array([(point.cost, point.residual, point.stationarity, 0.0, length)]))

    def _keep(self, rows):
        first = sum(map(len, self.parts))
        self.parts.append(rows)
        if self.watch is not None:
            for number, row in enumerate(rows.tolist(), first):
                self.watch(number, tuple(row))

    def table(self):
        """Return all rows: (iterates, 5 or 6), or (0, 5) for an empty log."""
        return np.concatenate(self.parts) if self.parts else np.empty((0, 5))

    def is_late(self):
        """Return True if the time limit has passed."""
        return perf_counter() > self.deadline


def print_log(rows):
    """Print the rows (iterates, 5 or 6) of a log as a table."""
    last = "  barrier" if rows.shape[1] > 5 else ""
    print(f"iteration            cost   residual  stationarity     shift     step{last}")
    for i, (cost, residual, stationarity, shift, length, *barrier) in enumerate(rows.tolist()):
        weight = "".join(f" {mu:8.1e}" for mu in barrier)
        print(f"{i:9d} {cost:15.8g} {residual:10.2e} {stationarity:13.2e} {shift:9.1e} {length:8.1e}{weight}")
