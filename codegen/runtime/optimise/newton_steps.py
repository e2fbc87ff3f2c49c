"""Newton's steps: inertia correction, which makes them lead downhill, line search, second-order correction, watchdog.

Source: Waechter and Biegler (2006), On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming, whose equation and algorithm numbers are quoted.
"""

from typing import NamedTuple

import numpy as np

from codegen.runtime.kkt.refinement import ACCURATE, inaccuracy, linear_residual, refine
from codegen.runtime.kkt.system import factor_kkt, solve_kkt
from codegen.runtime.optimise.bounded import (
    corrected_inertia,
    barrier_objective,
    moved,
    newton_system,
    first_delta_w,
    step_along,
    with_duals,
)
from codegen.runtime.stand_ins.example import INEQUALITIES, UNBOUNDED

CORRECTIONS = 4  # second-order corrections that are tried at one iterate
SHORT = 0.25  # part of a step that is left when it counts as much too long
SHORT_IN_TURN = 6  # so many of them make the next ones shorter beforehand
LEAST_DAMPING = 1e-5
UNSOLVED = 0.1  # part of the residual; Newton's steps leave less near a solution
FULL_STEPS = 4  # how many may pass untested before one has to be better than the iterate where they began


class Watchdog(NamedTuple):
    """Where full steps began: the iterate, its Newton step, and how many may still follow."""

    iterate: NamedTuple
    step: NamedTuple
    left: int = FULL_STEPS


class AccuracyMonitor:
    """When to measure what a step leaves of the linear system: where it left more of the equations than it should.

    Curvature may be the reason, so that a step that was measured and found accurate makes it take twice as many
    doubtful ones. After one that was not, the next is measured, and refined, before it is taken.
    """

    def __init__(self):
        self.doubtful, self.enough = 0, 1

    def add(self):
        """Take note of a step that left too much."""
        self.doubtful += 1

    def is_due(self):
        """Whether a step has to be measured: the one that has just left too much, or the next."""
        return self.doubtful >= self.enough

    def record(self, refined):
        """Take note of whether a step that was measured had to be refined."""
        self.doubtful, self.enough = (1, 1) if refined else (0, 2 * self.enough)


def regularised_step(search, iterate, before, damping, careful):
    """A Newton step with the least delta_w on the Hessian, from `damping` on, that makes it a descent step, or None.

    This is algorithm IC; `before` is the correction at the last iterate. With `careful`, what the step leaves of the
    linear system is measured, and solved for again where that is much. None where the system stays singular.
    """
    grid, system, point = search.grid, search.system, iterate.point
    primal, singular, delta_c = np.empty(point.unknowns.size), False, 0.0
    at_once, least = first_delta_w(before)
    delta_w = max(damping, at_once)
    while delta_w < 1e20:
        gradient, diagonal = newton_system(search, iterate, point.gradient, delta_w, delta_c)
        excess = factor_kkt(grid, point.unknowns, 1.0, diagonal, system, gradient)
        if excess == 0:
            solve_kkt(grid, system, gradient, primal, carried=True)
            refined = careful and refine(grid, point.unknowns, diagonal, system, gradient, primal)
            same = delta_w == before.delta_w == 0.0 and not singular
            given = before if same else corrected_inertia(before, delta_w, least, singular)
            step = step_along(search, iterate, gradient, primal, given, refined)
            if abs(step.slope) < np.inf:
                return step
        elif delta_c == 0.0 and (excess is None or excess < 0):
            delta_c, singular = 1e-8, True  # the equations may be dependent
            if INEQUALITIES:
                delta_c *= iterate.mu**0.25
            continue
        if delta_w == 0.0:
            delta_w = least
        else:
            delta_w *= 100.0 if before.last == 0.0 else 8.0
    return None


def is_inaccurate(search, iterate, step):
    """Whether a step leaves so much of its linear system that it has to be refined."""
    grid, point = search.grid, iterate.point
    _, diagonal = newton_system(search, iterate, point.gradient, step.inertia.delta_w, 0.0)
    left = linear_residual(grid, point.unknowns, diagonal, step.gradient, step.primal)
    return inaccuracy(grid, step.gradient, step.primal, left) > ACCURATE


def barely_reduces_residual(point, step, length, trial):
    """Whether a step of some length has left more than its part of the equations: they are curved, or it is inaccurate.

    Were they linear, 1 - `length` of each would be left.
    """
    if UNBOUNDED and step.inertia.delta_w > 0.0:
        return False  # it is far from a solution, where curvature is the reason
    return trial.residual > (1.0 - length + UNSOLVED) * point.residual


def damped(damping, step, length, shortened):
    """The least shift of the Hessian for the next step: more where steps in turn had to be shortened much, else less.

    A Hessian that is barely positive definite sends steps far beyond where it means something.
    """
    if length <= SHORT * step.longest and shortened >= SHORT_IN_TURN:
        return 4.0 * max(step.inertia.delta_w, damping, LEAST_DAMPING)
    if length < step.longest:
        return damping
    return damping / 2.0 if damping > LEAST_DAMPING else 0.0


def line_search(search, iterate, step, shortest, small_violation, filtered):
    """Shorten the step until the filter accepts it; return the next iterate, or None, and the length."""
    length = step.longest
    while length > shortest:
        trial = moved(search, iterate, step.primal, length)
        if is_better(trial, iterate, step, length, small_violation, filtered):
            if INEQUALITIES:
                trial = with_duals(trial, step)
            return trial, length
        if length == step.longest and trial.point.violation >= iterate.point.violation:
            better = second_order_correction(search, iterate, step, trial.point, small_violation, filtered)
            if better is not None:
                return better, length
        length *= 0.5
    return None, length


def watchdog_step(search, iterate, step, watchdog, small_violation, filtered):
    """(next iterate, length, watchdog) after a full step that is taken untested, in the hope that one soon is better.

    The watchdog technique: where the equations' curvature makes the filter shorten step after step, full ones may be
    better after all. If none is, all goes on from where they began. Source: Waechter and Biegler (2006), section 3.2.
    """
    trial = moved(search, iterate, step.primal, step.longest)
    better = is_better(trial, watchdog.iterate, watchdog.step, watchdog.step.longest, small_violation, filtered)
    if not better and (watchdog.left == 1 or not trial.point.error < np.inf):
        return watchdog.iterate, 0.0, None
    if INEQUALITIES:
        trial = with_duals(trial, step)
    return trial, step.longest, None if better else watchdog._replace(left=watchdog.left - 1)


def is_better(trial, iterate, step, length, small_violation, filtered):
    """Whether a trial may follow an iterate, from which a step of some length was to lead to it."""
    new, old = trial.point, iterate.point
    return new.error < np.inf and filtered.accept(
        old.violation,
        barrier_objective(iterate),
        new.violation,
        barrier_objective(trial),
        step.slope,
        length,
        small_violation,
    )


def second_order_correction(search, iterate, step, refused, small_violation, filtered):
    """The iterate after second-order corrections (27) of the full step, or None: the equations' curvature may be wrong.

    `refused` is the point to which the full step led. Duals follow the corrected step: those of the step that was
    refused belong to other distances.
    """
    grid, right, length = search.grid, step.gradient.copy(), step.longest
    residual = iterate.point.gradient[grid.is_multiplier]
    for _ in range(CORRECTIONS):
        residual = length * residual + refused.gradient[grid.is_multiplier]
        right[grid.is_multiplier] = residual
        correction = np.empty_like(step.primal)
        solve_kkt(grid, search.system, right, correction)
        better = step_along(search, iterate, right, correction, step.inertia, False)
        length = better.longest
        trial = moved(search, iterate, correction, length)
        if is_better(trial, iterate, step, step.longest, small_violation, filtered):
            if INEQUALITIES:
                trial = with_duals(trial, better)
            return trial
        if not trial.point.violation < 0.99 * refused.violation:
            return None
        refused = trial.point
    return None
