"""Iterates of the interior point method: how they begin, are measured, and follow each other by Newton's steps.

Source: Waechter and Biegler (2006), On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming, whose equation and algorithm numbers are quoted.
"""

from typing import NamedTuple

import numpy as np

from codegen.runtime.optimise.barrier import (
    add_barrier,
    measure_optimality,
    measure_step,
    move,
    move_duals,
    push_inside,
    relaxation,
)
from codegen.runtime.stand_ins.example import TIED
from codegen.runtime.unknowns.point import Point, evaluate
from codegen.runtime.optimise.rounding import is_solved
from codegen.runtime.kkt.refinement import refine
from codegen.runtime.kkt.system import factor_kkt, solve_kkt
from codegen.runtime.unknowns.tied import with_tied_values

CORRECTIONS = 4  # second-order corrections that are tried at one iterate
SHORT = 0.25  # part of a step that is left when it counts as much too long
SHORT_IN_TURN = 6  # so many of them make the next ones shorter beforehand
LEAST_DAMPING = 1e-5
UNSOLVED = 0.1  # part of the residual; Newton's steps leave less near a solution
FULL_STEPS = 4  # how many may pass untested before one has to be better than the iterate where they began


class Search(NamedTuple):
    """What stays the same during a solve: grid, bounds, storage of the linear system, places of multipliers.

    `box` holds the least and the greatest values of all unknowns, infinite where there is no bound.
    """

    grid: NamedTuple
    bounds: NamedTuple
    system: tuple[NamedTuple, int]
    equations: np.ndarray
    box: tuple[np.ndarray, np.ndarray]


class Iterate(NamedTuple):
    """A point, the distances of its unknowns to their bounds with the sum of their logarithms, and bound duals."""

    point: NamedTuple
    distance: np.ndarray
    logarithms: float
    duals: np.ndarray


class Step(NamedTuple):
    """A Newton step: its barrier gradient, slope, longest primal and dual lengths, and the Hessian's shift.

    `refined` says that the linear system was not solved accurately at once.
    """

    primal: np.ndarray
    dual: np.ndarray
    gradient: np.ndarray
    slope: float
    longest: float
    dual_length: float
    shift: float
    refined: bool


class Watch(NamedTuple):
    """Where full steps began: the iterate, its Newton step, and how many may still follow."""

    iterate: NamedTuple
    step: NamedTuple
    left: int = FULL_STEPS


class Doubts:
    """When to measure what steps leave of the linear system: where whole ones leave as much of the equations as before.

    Curvature may be the reason, so that steps that were measured and found accurate make it take twice as many doubts.
    Once one was not, all are measured.
    """

    def __init__(self):
        self.doubts, self.enough = 0, 1

    def are_enough(self):
        """Whether the next step has to be measured."""
        return self.doubts >= self.enough

    def note(self, step, leaves_much):
        """Take note of how a step was solved for, and of whether it has left much of the equations."""
        if self.are_enough():
            self.doubts, self.enough = (1, 1) if step.refined else (0, 2 * self.enough)
        self.doubts += leaves_much


def begin(search, unknowns, attempt, central=False):
    """An iterate at primal unknowns that are pushed inside their bounds, with duals of one, or on the central path."""
    bounds, mu = search.bounds, attempt.weight
    unknowns = push_inside(*search.box, unknowns, attempt.push)
    if TIED:
        unknowns = with_tied_values(search.grid, unknowns)  # nodes move with the shared unknowns that they equal
    distance = bounds.side * (unknowns[bounds.place] - bounds.value) + relaxation(mu) * bounds.magnitude
    return with_multipliers(search, unknowns, distance, np.minimum(mu / distance, 1e3) if central else None)


def with_multipliers(search, unknowns, distance, duals=None):
    """An iterate at primal unknowns and their distances, with multipliers by least squares, and duals, or ones."""
    duals = np.ones(distance.size) if duals is None else duals
    unknowns = guess_multipliers(search, unknowns, duals)
    return Iterate(evaluate(search.grid, unknowns), distance, np.log(distance).sum(), duals)


def guess_multipliers(search, unknowns, duals):
    """Unknowns whose multipliers solve stationarity by least squares (36), or vanish where that is huge or singular."""
    grid, bounds, system, *_ = search
    unknowns = np.where(grid.is_multiplier, 0.0, unknowns)
    gradient = np.where(grid.is_multiplier, 0.0, evaluate(grid, unknowns).gradient)
    np.subtract.at(gradient, bounds.place, bounds.side * duals)
    if factor_kkt(grid, unknowns, 0.0, np.where(grid.is_multiplier, -1e-12, 1.0), system, gradient) is None:
        return unknowns
    step = np.empty_like(unknowns)
    solve_kkt(grid, system, gradient, step, carried=True)
    multipliers = np.where(grid.is_multiplier, step, 0.0)
    return unknowns + multipliers if np.abs(multipliers).max(initial=0.0) <= 1e3 else unknowns


def primal_part(grid, unknowns):
    """Unknowns without their multipliers, which are zero."""
    return np.where(grid.is_multiplier, 0.0, unknowns)


def measured_iterate(search, iterate):
    """The iterate with the duals of bounds taking part in its stationarity, and what measure_optimality says."""
    point, bounds, is_multiplier = iterate.point, search.bounds, search.grid.is_multiplier
    measured = measure_optimality(
        point.gradient, point.unknowns, is_multiplier, bounds.place, bounds.side, iterate.distance, iterate.duals
    )
    error = max(point.residual, measured[0]) if point.error < np.inf else np.inf
    # Building the tuples anew takes a third of the time of replacing fields.
    point = Point(point.unknowns, point.gradient, point.cost, point.residual, point.violation, measured[0], error)
    return Iterate(point, iterate.distance, iterate.logarithms, iterate.duals), measured


def is_acceptable(grid, point, measured, tolerance):
    """Whether a point is optimal to the tolerance, with complementarities one by one and scaled multipliers (5)."""
    _, _, _, highest, mean, mean_dual, _ = measured
    scaled = point.stationarity / (max(100.0, mean) / 100.0)
    if highest / (max(100.0, mean_dual) / 100.0) > tolerance:
        return False
    return is_solved(grid, point._replace(stationarity=scaled, error=max(point.residual, scaled)), tolerance)


def barrier_error(point, measured, mu):
    """Error of the optimality conditions of the barrier problem, scaled where multipliers are large (5)."""
    stationarity, _, lowest, highest, mean, mean_dual, _ = measured
    off_centre = max(highest - mu, mu - lowest)
    scale, dual_scale = max(100.0, mean) / 100.0, max(100.0, mean_dual) / 100.0
    return max(stationarity / scale, point.residual, off_centre / dual_scale)


def tightened(search, iterate, before, mu):
    """The iterate with its bounds relaxed as it belongs to a lower weight; what is then outside moves inside."""
    bounds, by = search.bounds, relaxation(before) - relaxation(mu)
    if by == 0.0:
        return iterate
    least = 0.1 * relaxation(mu) * bounds.magnitude
    distance = iterate.distance - by * bounds.magnitude
    outside = distance < least
    if not outside.any():
        return iterate._replace(distance=distance, logarithms=np.log(distance).sum())
    unknowns = iterate.point.unknowns.copy()
    unknowns[bounds.place[outside]] += bounds.side[outside] * (least - distance)[outside]
    distance[outside] = least[outside]
    if TIED:
        unknowns = with_tied_values(search.grid, unknowns)
    return iterate._replace(point=evaluate(search.grid, unknowns), distance=distance, logarithms=np.log(distance).sum())


def regularised_step(search, iterate, mu, last_shift, damping, careful):
    """Newton step of the barrier problem, the Hessian shifted until its inertia is right (algorithm IC), or None.

    With `careful`, what the step leaves of the linear system is measured, and solved for again where that is much.
    """
    grid, bounds, system, *_ = search
    point, size = iterate.point, iterate.point.unknowns.size
    diagonal, gradient, primal = np.empty(size), np.empty(size), np.empty(size)
    dual = np.empty(bounds.place.size)
    barrier = grid.is_multiplier, bounds.place, bounds.side, iterate.distance, iterate.duals, mu
    shift, dual_shift = damping, 0.0
    while shift < 1e20:
        add_barrier(point.gradient, *barrier, shift, dual_shift, gradient, diagonal)
        excess = factor_kkt(grid, point.unknowns, 1.0, diagonal, system, gradient)
        if excess == 0:
            solve_kkt(grid, system, gradient, primal, carried=True)
            refined = careful and refine(grid, point.unknowns, diagonal, system, gradient, primal)
            measured = measure_step(point.unknowns, gradient, primal, *barrier, max(0.99, 1.0 - mu), dual)
            if abs(measured[0]) < np.inf:
                return Step(primal, dual, gradient, *measured, shift, refined)
        elif dual_shift == 0.0 and (excess is None or excess < 0):
            dual_shift = 1e-8 * mu**0.25  # the equations may be dependent
            continue
        if shift == 0.0:
            shift = 1e-4 if last_shift == 0.0 else max(1e-20, last_shift / 3.0)
        else:
            shift *= 100.0 if last_shift == 0.0 else 8.0
    return None


def leaves_much(point, step, length, trial):
    """Whether a whole step has left as much of the equations as there was: their curvature, or an inaccurate step."""
    return length == 1.0 and step.longest == 1.0 and trial.residual > UNSOLVED * point.residual


def damped(damping, step, length, shortened):
    """The least shift of the Hessian for the next step: more where steps in turn had to be shortened much, else less.

    A Hessian that is barely positive definite sends steps far beyond where it means something.
    """
    if length <= SHORT * step.longest and shortened >= SHORT_IN_TURN:
        return 4.0 * max(step.shift, damping, LEAST_DAMPING)
    if length < step.longest:
        return damping
    return damping / 2.0 if damping > LEAST_DAMPING else 0.0


def line_search(search, iterate, step, mu, shortest, small_violation, filtered):
    """Shorten the step until the filter accepts it; return the next iterate, or None, and the length."""
    length = step.longest
    while length > shortest:
        trial = moved(search, iterate, step.primal, length)
        if is_better(trial, iterate, step, length, mu, small_violation, filtered):
            return with_duals(trial, iterate, step, mu), length
        if length == step.longest and trial[0].violation >= iterate.point.violation:
            better = corrected(search, iterate, step, mu, trial, small_violation, filtered)
            if better is not None:
                return better, length
        length *= 0.5
    return None, length


def watched(search, iterate, step, mu, watch, small_violation, filtered):
    """(next iterate, length, watch) after a full step that is taken untested, in the hope that one soon is better.

    The watchdog technique: where the equations' curvature makes the filter shorten step after step, full ones may be
    better after all. If none is, all goes on from where they began. Source: Waechter and Biegler (2006), section 3.2.
    """
    trial = moved(search, iterate, step.primal, step.longest)
    if is_better(trial, watch.iterate, watch.step, watch.step.longest, mu, small_violation, filtered):
        return with_duals(trial, iterate, step, mu), step.longest, None
    if watch.left == 1 or not trial[0].error < np.inf:
        return watch.iterate, 0.0, None
    return with_duals(trial, iterate, step, mu), step.longest, watch._replace(left=watch.left - 1)


def is_better(trial, iterate, step, length, mu, small_violation, filtered):
    """Whether a trial may follow an iterate, from which a step of some length was to lead to it."""
    point, _, logarithms = trial
    violation, cost = iterate.point.violation, iterate.point.cost - mu * iterate.logarithms
    trial_cost = point.cost - mu * logarithms
    return point.error < np.inf and filtered.accept(
        violation, cost, point.violation, trial_cost, step.slope, length, small_violation
    )


def with_duals(trial, iterate, step, mu):
    """The iterate at a trial point, with duals after the step's dual part."""
    duals = np.empty(iterate.duals.size)
    move_duals(iterate.duals, step.dual, step.dual_length, trial[1], mu, duals)
    return Iterate(*trial, duals)


def moved(search, iterate, step, length):
    """Point, distances and sum of their logarithms after a step of some length."""
    unknowns, bounds = iterate.point.unknowns, search.bounds
    trial, distance = np.empty(unknowns.size), np.empty(bounds.place.size)
    logarithms = move(unknowns, step, length, bounds.place, bounds.side, iterate.distance, trial, distance)
    return evaluate(search.grid, trial), distance, logarithms


def corrected(search, iterate, step, mu, trial, small_violation, filtered):
    """The iterate after second-order corrections (27) of the full step, or None: the equations' curvature may be wrong.

    Duals follow the corrected step: those of the step that was refused belong to other distances.
    """
    grid, bounds, system, *_ = search
    right, correction, dual = step.gradient.copy(), np.empty_like(step.primal), np.empty_like(step.dual)
    barrier = grid.is_multiplier, bounds.place, bounds.side, iterate.distance, iterate.duals, mu
    residual, length, last = iterate.point.gradient[grid.is_multiplier], step.longest, trial[0].violation
    for _ in range(CORRECTIONS):
        residual = length * residual + trial[0].gradient[grid.is_multiplier]
        right[grid.is_multiplier] = residual
        solve_kkt(grid, system, right, correction)
        if not np.isfinite(correction).all():
            return None
        tau = max(0.99, 1.0 - mu)
        _, length, dual_length = measure_step(iterate.point.unknowns, right, correction, *barrier, tau, dual)
        trial = moved(search, iterate, correction, length)
        if is_better(trial, iterate, step, step.longest, mu, small_violation, filtered):
            return with_duals(trial, iterate, step._replace(dual=dual, dual_length=dual_length), mu)
        if not trial[0].violation < 0.99 * last:
            return None
        last = trial[0].violation
    return None
