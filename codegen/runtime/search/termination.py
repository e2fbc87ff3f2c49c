"""The termination status of a search, and the convergence test for points that Python evaluates.

The convergence test compares residuals with the largest terms of the equations. `final_status` corrects the status of a
search by tests that are too expensive during the search.
"""

import numpy as np

from codegen.runtime.search import optimality, workspace
from codegen.runtime.search.bounds import HOLDS, at_bounds
from codegen.runtime.search.grid import least_duration, multiplier_unknowns, primal_unknowns
from codegen.runtime.search.iterates import arguments_of
from codegen.runtime.search.linear_system import allocate_system, factor_kkt
from codegen.runtime.search.optimality import UNIT_ROUNDOFF, WORTH_MEASURING, is_small
from codegen.runtime.search.point import evaluate, hessian, jacobian

GROWTH = 1e3  # an unknown diverges if it exceeds this multiple of max(1, |guess|)
FALL = 0.5  # and if the cost has fallen by more than this part of the first cost
HELD = 1e-6  # and if the residual is at most this part of the largest unknown
HUGE = 1e6  # larger multipliers belong to dependent equations
VIOLATED = 1e-6  # larger residuals are not rounding errors


def final_status(grid, guess, point, status):
    """Return the termination status of a search, or a more precise status.

    `guess` and `point` have the scaling factors of the grid. A problem is unbounded if unknowns grow while the cost
    falls, or if a duration is not positive. If a search cannot continue at a point where the equations hold, the
    equations are dependent, not infeasible. If the equations do not hold and outnumber the unknowns, the problem is
    infeasible.
    """
    s = grid.problem.structure
    if status in ("unbounded", "saddle point") or (status == "solved" and not s.root):
        return status
    if not point.error < np.inf:
        return "non-finite"
    unknowns = unscaled_unknowns(grid, point.unknowns)
    if status == "rank-deficient":
        derivatives = hessian(grid, unknowns)[2], jacobian(grid, unknowns)[2]
        if not all(np.isfinite(values).all() for values in derivatives):
            return "non-finite"
    if s.shared and not least_duration(grid, unknowns) > 0.0:
        return "unbounded"
    if diverging_unknowns(grid, guess, point, status == "solved").any():
        return "unbounded"
    if status in ("infeasible", "stalled") and point.residual <= HOLDS:
        largest_multiplier = np.abs(point.unknowns[grid.is_multiplier]).max(initial=0.0)
        return "rank-deficient" if largest_multiplier > HUGE else "stalled"
    if status == "stalled" and point.residual > VIOLATED:
        is_overdetermined = multiplier_unknowns(grid).size > primal_unknowns(grid).size
        return "infeasible" if is_overdetermined else status
    return status


def unscaled_unknowns(grid, unknowns):
    """Return unknowns in the problem's own units."""
    return unknowns * grid.sizes if grid.sizes.size else unknowns


def diverging_unknowns(grid, guess, point, is_stationary):
    """Return the mask (n,) of the unknowns that are large and continue to grow.

    With `is_stationary`, only linking variables are tested, such as a free duration. The cost may fall for ever as a
    linking variable grows. Newton's step then does not tend to zero relative to that variable.
    """
    unknowns, diverges = point.unknowns, np.zeros(guess.size, bool)
    tested = slice(guess.size - grid.problem.structure.root if is_stationary else 0, None)
    if not np.abs(unknowns[tested]).max(initial=0.0) > GROWTH:
        return diverges
    is_large = np.abs(unknowns[tested]) > GROWTH * np.maximum(1.0, np.abs(guess[tested]))
    diverges[tested] = ~grid.is_multiplier[tested] & is_large
    if not diverges.any():
        return diverges
    diverges &= ~at_bounds(grid, unknowns)
    if is_stationary:
        return diverges & (np.abs(newton_step(grid, point)) > 0.01 * np.abs(unknowns))
    falls = point.gradient * unknowns < -0.1 * abs(point.cost)
    first_cost, largest = evaluate(grid, guess).cost, np.abs(unknowns[~grid.is_multiplier]).max()
    has_fallen = first_cost - point.cost > FALL * abs(first_cost) and point.residual <= HELD * largest
    return diverges & falls & has_fallen


def newton_step(grid, point):
    """Return Newton's step (n,) with unknowns at their bounds held fixed.

    The step is infinite if the KKT matrix does not have the inertia of a minimum.
    """
    system, step, shift = allocate_system(grid), np.empty_like(point.unknowns), np.zeros(point.unknowns.size)
    shift[at_bounds(grid, point.unknowns) & ~grid.is_multiplier] = 1e12
    if factor_kkt(grid, point.unknowns, 1.0, shift, system, point.gradient, step) != 0:
        return np.full(step.size, np.inf)
    return step


def sizes_of_terms(grid, unknowns, system=None):
    """Return the largest sum of absolute terms in an equation, and in a stationarity condition, both scaled.

    `system` is storage for the linear system; without it, new storage is allocated.
    """
    problem, data, storage = arguments_of(grid, system or allocate_system(grid))
    vectors, is_costless = np.empty((workspace.VECTORS, unknowns.size)), int(grid.problem.structure.costless)
    return optimality.terms(problem, data, storage, unknowns, is_costless, vectors)


def is_solved(grid, point, tolerance, roundings=1.0, system=None):
    """Return True if residual and stationarity are within the tolerance, or at the rounding level of their terms.

    The tolerance is absolute if the terms of the equations exceed one, and relative to smaller terms. A problem in
    small units is therefore not called solved too early. `roundings` is the largest number of rounding errors.
    """
    if not grid.problem.structure.linear_quadratic and point.error > max(tolerance, WORTH_MEASURING):
        return False
    equations, stationarity = sizes_of_terms(grid, point.unknowns, system)
    return is_small(point.residual, equations, tolerance, roundings) and is_small(
        point.stationarity, stationarity, tolerance, roundings
    )


def is_at_rounding_level(grid, point, system=None):
    """Return True if residual and stationarity are at most a thousand rounding errors of their terms."""
    sizes = sizes_of_terms(grid, point.unknowns, system)
    return point.residual <= 1e3 * UNIT_ROUNDOFF * sizes[0] and point.stationarity <= 1e3 * UNIT_ROUNDOFF * sizes[1]
