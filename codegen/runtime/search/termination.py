"""The termination status, corrected by what can be seen only afterwards.

How large the terms of the equations are: what a residual has to be compared with.
"""

import numpy as np

from codegen.runtime.search import descent
from codegen.runtime.search.bounds import HOLDS, at_bounds
from codegen.runtime.search.descent import UNIT_ROUNDOFF, VANISHED, WORTH_MEASURING
from codegen.runtime.search.grid import least_duration, multiplier_unknowns, primal_unknowns
from codegen.runtime.search.iterates import arguments_of
from codegen.runtime.search.linear_system import allocate_system, factor_kkt
from codegen.runtime.search.point import evaluate, hessian, jacobian

GROWTH = 1e3  # an unknown diverges if it exceeds this multiple of max(1, |guess|)
FALL = 0.5  # least fall of the cost, relative to the first one, if an unknown diverges
HELD = 1e-6  # largest residual, relative to the largest unknown, if an unknown diverges
HUGE = 1e6  # larger multipliers belong to dependent equations
VIOLATED = 1e-6  # larger residuals are not rounding errors


def final_status(grid, guess, point, status):
    """Return the status of a solver, or a more precise one.

    Where unknowns grow and the cost falls, or a duration is not positive, the problem is unbounded. Where the equations
    hold, a solver that cannot go on has not found them infeasible, but dependent on each other. Where they do not hold
    and are more than the unknowns, no better guess would help it.
    """
    if status in ("unbounded", "saddle point") or (status == "solved" and not grid.problem.structure.root):
        return status
    if not point.error < np.inf or (
        status == "rank-deficient" and not is_finite_matrix(grid, unscaled_unknowns(grid, point.unknowns))
    ):
        return "non-finite"
    if grid.problem.structure.shared and not least_duration(grid, unscaled_unknowns(grid, point.unknowns)) > 0.0:
        return "unbounded"
    if diverging_unknowns(grid, guess, point, status == "solved").any():
        return "unbounded"
    if status in ("infeasible", "stalled") and point.residual <= HOLDS:
        return "rank-deficient" if largest_multiplier(grid, point) > HUGE else "stalled"
    if status == "stalled" and point.residual > VIOLATED and is_overdetermined(grid):
        return "infeasible"
    return status


def unscaled_unknowns(grid, unknowns):
    """Return unknowns in the problem's own units."""
    return unknowns * grid.sizes if grid.sizes.size else unknowns


def is_finite_matrix(grid, unknowns):
    """Return True if all second derivatives are finite."""
    return all(np.isfinite(entries(grid, unknowns)[2]).all() for entries in (hessian, jacobian))


def is_overdetermined(grid):
    """Return True if there are more equations than unknowns; they may still agree with each other."""
    return multiplier_unknowns(grid).size > primal_unknowns(grid).size


def largest_multiplier(grid, point):
    """Return the largest modulus of a multiplier."""
    return np.abs(point.unknowns[grid.is_multiplier]).max(initial=0.0)


def diverging_unknowns(grid, guess, point, is_stationary):
    """Return a mask of the unknowns that diverge: they are large, and go on growing.

    At a stationary point only those are looked at that no node owns, such as a free duration: the cost may fall for
    ever as it grows, ever more slowly, and then Newton's step does not tend to zero relative to the unknown.
    """
    unknowns, grown = point.unknowns, np.zeros(guess.size, bool)
    seen = slice(guess.size - grid.problem.structure.root if is_stationary else 0, None)
    if not np.abs(unknowns[seen]).max(initial=0.0) > GROWTH:
        return grown
    large = np.abs(unknowns[seen]) > GROWTH * np.maximum(1.0, np.abs(guess[seen]))
    grown[seen] = ~grid.is_multiplier[seen] & large
    if not grown.any():
        return grown
    grown &= ~at_bounds(grid, unknowns)
    if is_stationary:
        return grown & (np.abs(newton_step(grid, point)) > 0.01 * np.abs(unknowns))
    falls = point.gradient * unknowns < -0.1 * abs(point.cost)
    first = evaluate(grid, guess).cost
    largest = np.abs(unknowns[~grid.is_multiplier]).max()
    has_fallen = first - point.cost > FALL * abs(first) and point.residual <= HELD * largest
    return grown & falls & has_fallen


def newton_step(grid, point):
    """Return Newton's step with unknowns at their bounds held fixed; infinite if the inertia is wrong."""
    system, step, shift = allocate_system(grid), np.empty_like(point.unknowns), np.zeros(point.unknowns.size)
    shift[at_bounds(grid, point.unknowns) & ~grid.is_multiplier] = 1e12
    if factor_kkt(grid, point.unknowns, 1.0, shift, system, point.gradient, step) != 0:
        return np.full(step.size, np.inf)
    return step


def sizes_of_terms(grid, unknowns, system=None):
    """Return the largest sums of absolute terms in an equation, and in a stationarity condition, as `terms`, scaled."""
    problem, data, storage = arguments_of(grid, system or allocate_system(grid))
    vectors, is_costless = np.empty((descent.VECTORS, unknowns.size)), int(grid.problem.structure.costless)
    return descent.terms(problem, data, storage, unknowns, is_costless, vectors)


def is_solved(grid, point, tolerance, roundings=1.0, system=None):
    """Return True if residual and stationarity are within the tolerance, or some rounding errors of their terms.

    The tolerance is absolute where the terms of the equations exceed one and relative to them where they are smaller,
    so that a problem in small units is not called solved too early.
    """
    if not grid.problem.structure.linear_quadratic and point.error > max(tolerance, WORTH_MEASURING):
        return False
    equations, stationarity = sizes_of_terms(grid, point.unknowns, system)
    return is_small(point.residual, equations, tolerance, roundings) and is_small(
        point.stationarity, stationarity, tolerance, roundings
    )


def is_small(value, size, tolerance, roundings):
    """Return True if a sum of terms of a given size is zero, to the tolerance or but for rounding."""
    return value <= max(tolerance * min(1.0, size), roundings * UNIT_ROUNDOFF * size, VANISHED)


def is_at_rounding_level(grid, point, system=None):
    """Return True if residual and stationarity are no larger than a thousand rounding errors."""
    sizes = sizes_of_terms(grid, point.unknowns, system)
    return point.residual <= 1e3 * UNIT_ROUNDOFF * sizes[0] and point.stationarity <= 1e3 * UNIT_ROUNDOFF * sizes[1]
