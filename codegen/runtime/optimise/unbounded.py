"""Iterates where no unknown has a bound: points, and how they begin and follow each other by Newton's steps.

Equation numbers are those of Waechter and Biegler (2006), On the implementation of an interior-point filter line-search
algorithm for large-scale nonlinear programming.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from codegen.runtime.kkt.unbordered import allocate_system
from codegen.runtime.kkt.system import factor_kkt, is_factored
from codegen.runtime.optimise.descent import slope_of
from codegen.runtime.unknowns.layout import layout, multiplier_unknowns
from codegen.runtime.unknowns.point import evaluate, lagrangian


class Attempt(NamedTuple):
    """How a search begins: with what part of the guess's violation, and bent by a part of the guess's size.

    Steps below the shortest make way for restoration; the violation may grow by the factor `funnel`. `is_factored` says
    that the linear system is factored, at a point beside it.
    """

    nearby: float
    shortest: float
    funnel: float
    bulge: float = 0.0
    is_factored: bool = False


FROM_GUESS, NEARBY = Attempt(1.0, 1e-12, 1e4), Attempt(1e-2, 1e-12, 1e4)
FROM_NEIGHBOUR = FROM_GUESS  # Newton's method needs no telling
CASCADE = (
    Attempt(0.1, 1e-3, 2.0),
    Attempt(1.0, 1e-12, 1e4, 0.1),  # where equations depend on each other at the guess alone
)


SMALL_DELTA_W = 1e-2  # below it, the Hessian is first tried as it is


class Search(NamedTuple):
    """What stays the same during a solve: grid, storage of the linear system, indices of multipliers."""

    grid: NamedTuple
    system: tuple[NamedTuple, int]
    equations: np.ndarray


class Iterate(NamedTuple):
    """A point of the search."""

    point: NamedTuple


class InertiaCorrection(NamedTuple):
    """delta_w, the Hessian's shift at an iterate, its last value above zero, and how often in turn it was lowered.

    `singular` once the matrix has been singular or had too few negative eigenvalues, as dependent equations make it.
    """

    delta_w: float = 0.0
    last: float = 0.0
    lowered: int = 0
    singular: bool = False


class Step(NamedTuple):
    """A Newton step: the gradient that it was solved for, slope, greatest length, and the Hessian's shift.

    `is_of_rounding` says that the linear system is singular but for rounding, which made the step; `refined` says that
    it was not solved accurately at once.
    """

    primal: np.ndarray
    gradient: np.ndarray
    slope: float
    is_of_rounding: bool
    longest: float
    inertia: NamedTuple
    refined: bool = False


def search_on(grid):
    """What stays the same during a solve on a grid."""
    return Search(grid, allocate_system(grid), multiplier_unknowns(grid))


def begin(search, unknowns, attempt):
    """An iterate at primal unknowns."""
    return Iterate(evaluate(search.grid, unknowns))


def with_least_squares_multipliers(search, iterate):
    """An iterate whose multipliers solve stationarity by least squares (36), zero where that is huge or singular.

    All multipliers of `iterate` are zero.
    """
    grid, point, system, step = search.grid, iterate.point, search.system, np.empty_like(iterate.point.unknowns)
    if point.stationarity == 0.0:
        return iterate
    gradient = np.where(grid.is_multiplier, 0.0, point.gradient)
    diagonal = regularisation(grid, 1.0, 1e-12)
    if not is_factored(factor_kkt(grid, point.unknowns, 0.0, diagonal, system, gradient, step)):
        return iterate
    multipliers = np.where(grid.is_multiplier, step, 0.0)
    return Iterate(evaluate(grid, point.unknowns + multipliers)) if np.abs(multipliers).max() <= 1e3 else iterate


def barrier_curvature(search, iterate):
    """What a barrier adds to the Hessian's diagonal: nothing."""
    return 0.0


def newton_system(search, iterate, gradient, delta_w, delta_c):
    """Right-hand side and diagonal (unknowns,) of Newton's equations, given the gradient of the Lagrangian."""
    return gradient, regularisation(search.grid, delta_w, delta_c)


def regularisation(grid, delta_w, delta_c):
    """Diagonal with delta_w on the Hessian by primal unknowns, and -delta_c on the multipliers' block."""
    if delta_w == delta_c == 0.0:
        return np.zeros(grid.is_multiplier.size)
    if delta_c == 0.0:
        return delta_w * primal_ones(grid.steps)
    return np.where(grid.is_multiplier, -delta_c, delta_w)


@lru_cache(maxsize=4)
def primal_ones(steps):
    """Ones for primal unknowns and zeros for multipliers, kept for the next solve."""
    return np.where(layout(steps).is_multiplier, 0.0, 1.0)


def first_delta_w(before):
    """The shift that is tried first, and the least one after none; `before` is that of the iterate before.

    Two changes to algorithm IC save factorisations. Where the iterate before needed a shift for its curvatures, a lower
    one is tried at once, and none only when that has become small; and the more often in turn a lower shift was enough,
    the lower the next one is.
    """
    least = max(1e-20, before.last / 3.0 ** min(1 + before.lowered, 40)) if before.last > 0.0 else 1e-4
    at_once = before.delta_w > 0.0 and least > SMALL_DELTA_W and not before.singular
    return least if at_once else 0.0, least


def corrected_inertia(before, delta_w, least, singular):
    """The shift that was enough; `least` was the least to try, `singular` says whether the matrix was without it."""
    singular = singular or before.singular
    lowered = before.lowered + 1 if delta_w == least and not singular else 0
    return InertiaCorrection(delta_w, delta_w or before.last, lowered, singular)


def step_along(search, iterate, gradient, primal, inertia):
    """The step with a primal part, the gradient that it was solved for and a shift, and with its slope."""
    slope = slope_of(iterate.point.unknowns, gradient, primal, search.grid.is_multiplier)
    return Step(primal, gradient, *slope, 1.0, inertia)


def barrier_objective(iterate):
    """What a line search lowers: the cost."""
    return iterate.point.cost


def predicted_cost(search, iterate):
    """The cost of the optimum nearby, to first order: residuals are worth their multipliers."""
    return lagrangian(search.grid, iterate.point)


def moved(search, iterate, step, length):
    """The iterate after a part of a step."""
    primal = step.primal
    return Iterate(evaluate(search.grid, iterate.point.unknowns + (primal if length == 1.0 else length * primal)))
