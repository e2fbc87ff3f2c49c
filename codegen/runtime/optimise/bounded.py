"""Iterates where unknowns have bounds: how they begin, are measured, and follow each other by steps of the barrier.

Source: Waechter and Biegler (2006), On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming, whose equation and algorithm numbers are quoted.
"""

from typing import NamedTuple

import numpy as np

from codegen.runtime.kkt.unbordered import allocate_system
from codegen.runtime.kkt.system import factor_kkt, is_factored
from codegen.runtime.optimise.barrier import (
    LEAST_RELAXED,
    MOST_RELAXING,
    RELAXED,
    add_barrier,
    approach,
    finite_bounds,
    take_step,
    measure_optimality,
    push_inside,
    relaxation,
    slopes_without_multipliers,
)
from codegen.runtime.optimise.active_bounds import bounds_of
from codegen.runtime.optimise.convergence_test import is_solved
from codegen.runtime.stand_ins.example import TIED
from codegen.runtime.unknowns.layout import multiplier_unknowns
from codegen.runtime.unknowns.point import Point, evaluate, lagrangian
from codegen.runtime.unknowns.tied import with_tied_values


class Attempt(NamedTuple):
    """How a search begins: first weight of the barrier, how far inside their bounds unknowns are, and how nearby.

    `nearby` is the part of the guess's violation that may be left before the search begins. Steps below the shortest
    make way for restoration; the violation may grow by the factor `funnel`. The guess is bent by a part of its size.
    `is_factored` says that the linear system is factored, at a point beside it.
    """

    weight: float
    push: float
    nearby: float
    shortest: float
    funnel: float
    bulge: float = 0.0
    is_factored: bool = False


FROM_GUESS = Attempt(0.1, 1e-2, 1.0, 1e-12, 1e4)
# Of a neighbour whose multipliers are of no use. Duals begin on the central path.
FROM_NEIGHBOUR = Attempt(1e-5, 1e-4, 1.0, 1e-12, 1e4)
# Of one whose equations do not hold: close to their bounds, unknowns would be stopped by them step after step.
FROM_AFAR = Attempt(0.1, 0.1, 1.0, 1e-12, 1e4)
CASCADE = (
    Attempt(0.1, 1e-2, 0.1, 1e-3, 2.0),
    Attempt(10.0, 1e-2, 1.0, 1e-3, 2.0),
    Attempt(0.1, 1e-2, 1.0, 1e-12, 1e4, 0.1),  # where equations depend on each other at the guess alone
)


class Search(NamedTuple):
    """What stays the same during a solve: grid, bounds, storage of the linear system, indices of multipliers.

    `box` holds the least and the greatest values of all unknowns, infinite where there is no bound. Bounds are relaxed
    by `least` at least, in parts of their magnitudes.
    """

    grid: NamedTuple
    bounds: NamedTuple
    system: tuple[NamedTuple, int]
    equations: np.ndarray
    box: tuple[np.ndarray, np.ndarray]
    least: float = LEAST_RELAXED


class Measured(NamedTuple):
    """What is measured of an iterate with the duals of its bounds, as `measure_optimality` says."""

    stationarity: float
    gap: float
    lowest: float
    highest: float
    mean: float
    mean_dual: float
    largest: float


class Iterate(NamedTuple):
    """A point, the barrier's weight mu, and what belongs to the bounds.

    These are the distances of unknowns to them (bounds,), the sum of their logarithms, the duals (bounds,), and what is
    `measured` with them, if it is known.
    """

    point: NamedTuple
    mu: float
    distance: np.ndarray
    logarithms: float
    duals: np.ndarray
    measured: Measured | None = None


class InertiaCorrection(NamedTuple):
    """delta_w, the Hessian's shift at an iterate, and the last one that was not zero."""

    delta_w: float = 0.0
    last: float = 0.0


class Step(NamedTuple):
    """A Newton step: its barrier gradient, slope, longest primal and dual lengths, and the Hessian's shift.

    `is_of_rounding` says that the linear system is singular but for rounding, which made the step; `refined` says that
    it was not solved accurately at once. `end` is the iterate after its longest lengths, which a line search tries
    first: it is measured in the same call as the step.
    """

    primal: np.ndarray
    dual: np.ndarray
    gradient: np.ndarray
    slope: float
    is_of_rounding: bool
    longest: float
    dual_length: float
    inertia: NamedTuple
    end: Iterate | None = None
    refined: bool = False


def search_on(grid):
    """What stays the same during a solve on a grid."""
    box = bounds_of(grid)
    return Search(grid, finite_bounds(*box), allocate_system(grid), multiplier_unknowns(grid), box)


def begin(search, unknowns, attempt):
    """An iterate at primal unknowns that are pushed inside their bounds, with duals of one, or on the central path."""
    bounds, mu = search.bounds, attempt.weight
    unknowns = push_inside(*search.box, unknowns, attempt.push)
    if TIED:
        unknowns = with_tied_values(search.grid, unknowns)  # nodes move with the shared unknowns that they equal
    distance = bounds.side * (unknowns[bounds.indices] - bounds.value) + relaxation(mu, search.least) * bounds.magnitude
    duals = central_duals(mu, distance) if attempt in (FROM_NEIGHBOUR, FROM_AFAR) else np.ones(distance.size)
    return Iterate(evaluate(search.grid, unknowns), mu, distance, np.log(distance).sum(), duals)


def central_duals(mu, distance):
    """Duals (bounds,) on the central path, or large ones where a bound is closer."""
    return np.minimum(mu / distance, 1e3)


def with_least_squares_multipliers(search, iterate):
    """An iterate whose multipliers solve stationarity by least squares (36), zero where that is huge or singular.

    All multipliers of `iterate` are zero.
    """
    grid, bounds, system, *_ = search
    point, step = iterate.point, np.empty_like(iterate.point.unknowns)
    gradient, diagonal, places = np.empty(step.size), np.empty(step.size), (bounds.indices, bounds.side)
    slopes_without_multipliers(point.gradient, grid.is_multiplier, *places, iterate.duals, gradient, diagonal)
    if not is_factored(factor_kkt(grid, point.unknowns, 0.0, diagonal, system, gradient, step)):
        return iterate
    multipliers = np.where(grid.is_multiplier, step, 0.0)
    if not np.abs(multipliers).max(initial=0.0) <= 1e3:
        return iterate
    return iterate._replace(point=evaluate(grid, point.unknowns + multipliers), measured=None)


def measured_iterate(search, iterate):
    """The iterate with the duals of bounds taking part in its stationarity, and with what is measured."""
    if iterate.measured is not None:
        return iterate
    point, bounds, is_multiplier = iterate.point, search.bounds, search.grid.is_multiplier
    barrier = bounds.indices, bounds.side, iterate.distance, iterate.duals
    measured = measure_optimality(point.gradient, point.unknowns, is_multiplier, *barrier)
    # Building the tuples anew takes a third of the time of replacing fields.
    unknowns, gradient, *evaluated = point
    point = with_duals(unknowns, gradient, evaluated, measured)
    return Iterate(point, iterate.mu, iterate.distance, iterate.logarithms, iterate.duals, Measured(*measured))


def with_duals(unknowns, gradient, evaluated, measured):
    """The point with what was evaluated there, in the stationarity of which duals of bounds take part."""
    cost, residual, violation, _, error = evaluated
    error = max(residual, measured[0]) if error < np.inf else np.inf
    return Point(unknowns, gradient, cost, residual, violation, measured[0], error)


def is_optimal(search, iterate, tolerance, acceptable_will_do):
    """Whether a measured iterate obeys all optimality conditions."""
    closed = iterate.measured.highest <= tolerance and is_solved(search.grid, iterate.point, tolerance)
    return closed or (acceptable_will_do and is_acceptable(search.grid, iterate, tolerance))


def is_acceptable(grid, iterate, tolerance):
    """Whether an iterate is optimal to the tolerance, with complementarities one by one and scaled multipliers (5)."""
    point, measured = iterate.point, iterate.measured
    scaled = measured.stationarity / (max(100.0, measured.mean) / 100.0)
    if measured.highest / (max(100.0, measured.mean_dual) / 100.0) > tolerance:
        return False
    return is_solved(grid, point._replace(stationarity=scaled, error=max(point.residual, scaled)), tolerance)


def is_closed(search, iterate, tolerance):
    """Whether the gap is at most one tolerance for every bound, which is as good as rounding allows."""
    return iterate.measured.gap <= tolerance * search.bounds.indices.size


def decreased_mu(iterate, least):
    """The weight for the next step: lower where the barrier problem is solved well enough (7), in the error (5).

    The power is 1.5 to the end, as in (7): a leap to the last weight costs up to twice the iterations where bounds are
    hardly active, as on singular arcs.
    """
    mu, residual = iterate.mu, iterate.point.residual
    if residual > 10.0 * mu:
        return mu
    stationarity, _, lowest, highest, mean, mean_dual, _ = iterate.measured
    error, dual_scale = max(stationarity / max(1.0, mean / 100.0), residual), max(1.0, mean_dual / 100.0)
    while mu > least and error <= 10.0 * mu and max(highest - mu, mu - lowest) / dual_scale <= 10.0 * mu:
        mu = max(least, min(0.2 * mu, mu**1.5))
    return mu


def falling_relaxation(search, iterate, mu):
    """By how much bounds are relaxed less once the iterate's weight is lowered to mu."""
    if mu >= MOST_RELAXING:
        return 0.0
    return relaxation(iterate.mu, search.least) - relaxation(mu, search.least)


def with_relaxed_bounds(search):
    """The search with bounds that stay as relaxed as they are at first.

    Where equations force unknowns onto their bounds, and all multipliers are huge, the relaxation is what gives the
    feasible set an inside; IPOPT keeps it as well.
    """
    return search._replace(least=RELAXED)


def with_barrier_parameter(search, iterate, mu, by):
    """The iterate with a lower weight and bounds relaxed less `by` a part; what is then outside moves inside."""
    point, _, distance, logarithms, duals, measured = iterate
    if by == 0.0:
        return Iterate(point, mu, distance, logarithms, duals, measured)
    bounds = search.bounds
    unknowns, distance, places = point.unknowns.copy(), np.empty(iterate.distance.size), (bounds.indices, bounds.side)
    least = 0.1 * relaxation(mu, search.least)
    logarithms, moves = approach(unknowns, *places, bounds.magnitude, by, least, iterate.distance, distance)
    if moves:
        if TIED:
            unknowns = with_tied_values(search.grid, unknowns)
        return measured_iterate(search, Iterate(evaluate(search.grid, unknowns), mu, distance, logarithms, duals))
    return Iterate(point, mu, distance, logarithms, duals, measured)


def barrier_curvature(search, iterate):
    """What the barrier adds to the Hessian's diagonal (unknowns,)."""
    curvature = np.zeros(iterate.point.unknowns.size)
    np.add.at(curvature, search.bounds.indices, iterate.duals / iterate.distance)
    return curvature


def newton_system(search, iterate, gradient, delta_w, delta_c):
    """Right-hand side and diagonal (unknowns,) of Newton's equations (13), given the gradient of the Lagrangian."""
    indices, _, side, _ = search.bounds
    _, mu, distance, _, duals, _ = iterate
    right, diagonal = np.empty(gradient.size), np.empty(gradient.size)
    is_multiplier = search.grid.is_multiplier
    add_barrier(gradient, is_multiplier, indices, side, distance, duals, mu, delta_w, delta_c, right, diagonal)
    return right, diagonal


def first_delta_w(before):
    """The shift that is tried first, and the least one after none; `before` is that of the iterate before."""
    return 0.0, max(1e-20, before.last / 3.0) if before.last > 0.0 else 1e-4


def corrected_inertia(before, delta_w, least, singular):
    """The shift that was enough."""
    return InertiaCorrection(delta_w, delta_w or before.last)


def step_along(search, iterate, gradient, primal, inertia):
    """The step with a primal part, a barrier gradient and a shift: its dual part, slope, longest lengths and end."""
    dual = np.empty(iterate.duals.size)
    measured, end = stepped(search, iterate, gradient, primal, dual)
    return Step(primal, dual, gradient, *measured, inertia, end)


def barrier_objective(iterate):
    """The barrier function, which a line search lowers (3)."""
    return iterate.point.cost - iterate.mu * iterate.logarithms


def barrier_error(iterate):
    """The error of a measured iterate in the optimality conditions of its barrier problem, (5) without its scales."""
    lowest, highest = iterate.measured.lowest, iterate.measured.highest
    return max(iterate.point.error, highest - iterate.mu, iterate.mu - lowest)


def predicted_cost(search, iterate):
    """The cost of the optimum nearby, to first order: residuals, and distances to bounds, are worth their multipliers.

    Bounds count as they are, not relaxed.
    """
    bounds = search.bounds
    distance = bounds.side * (iterate.point.unknowns[bounds.indices] - bounds.value)
    return lagrangian(search.grid, iterate.point) - iterate.duals @ distance


def moved(search, iterate, step, length):
    """The iterate after a length of a step's primal part and the longest of its dual part, measured there."""
    if length == step.longest and step.end is not None:
        return step.end
    return stepped(search, iterate, step.gradient, step.primal, step.dual, False, length, step.dual_length)[1]


def stepped(search, iterate, right, primal, dual, is_new=True, length=0.0, dual_length=0.0):
    """What `measure_step` says of a step that `is_new`, and the iterate after the longest of it, or after a length."""
    # Taking tuples apart takes a quarter of the time of looking each field up by its name.
    steps, h, nodes, _, parameters, is_multiplier, sizes, _, weight, *_ = search.grid
    point, mu, distance, _, duals, _ = iterate
    indices, _, side, _ = search.bounds
    trial, gradient = np.empty(primal.size), np.empty(primal.size)
    apart, pushes = np.empty(side.size), np.empty(side.size)
    of_step, logarithms, evaluated, measured = take_step(
        is_new, point.unknowns, right, primal, length, indices, side, distance, duals, dual, dual_length, mu, sizes,
        weight, steps, h, nodes, parameters, is_multiplier, trial, apart, pushes, gradient,
    )  # fmt: skip
    return of_step, Iterate(Point(trial, gradient, *evaluated), mu, apart, logarithms, pushes, Measured(*measured))
