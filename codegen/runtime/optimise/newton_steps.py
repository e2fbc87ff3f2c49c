"""Newton's steps: inertia correction, which makes them lead downhill, and how accurately they are solved for.

Numbers are those of Waechter and Biegler (2006), as in `newton.py`.
"""

import numpy as np

from codegen.runtime.kkt.refinement import ACCURATE, linear_residual, refine
from codegen.runtime.kkt.system import factor_kkt, solve_kkt
from codegen.runtime.optimise.bounded import (
    InertiaCorrection,
    corrected_inertia,
    first_delta_w,
    newton_system,
    step_along,
)
from codegen.runtime.stand_ins.example import INEQUALITIES, UNBOUNDED

LARGE_SHIFT = 1e8  # of the Hessian: where it does not do, rounding has given an eigenvalue of zero its sign
UNSOLVED = 0.1  # part of the residual; Newton's steps leave less near a solution
if UNBOUNDED:
    FAR = 10.0  # times the largest unknown
SOLVED = 1e-12  # residuals below it are rounding, which no step reduces


class AccuracyMonitor:
    """When to measure what a step leaves of the linear system: where it left more of the equations than it should.

    Curvature may be the reason, and is for a step or two of most searches, so that the second doubtful one is the first
    that is measured, and one that was found accurate makes it take four times as many. After one that was not, the next
    is measured, and refined, before it is taken.
    """

    def __init__(self):
        self.doubtful, self.enough = 0, 2

    def add(self):
        """Take note of a step that left too much."""
        self.doubtful += 1

    def is_due(self):
        """Whether a step has to be measured: the one that has just left too much, or the next."""
        return self.doubtful >= self.enough

    def record(self, refined):
        """Take note of whether a step that was measured had to be refined."""
        self.doubtful, self.enough = (1, 1) if refined else (0, 4 * self.enough)


def regularised_step(search, iterate, before, damping, careful):
    """A Newton step with the least delta_w on the Hessian, from `damping` on, that makes it a descent step, or None.

    This is algorithm IC; `before` is the correction at the last iterate. Equations that are dependent, as those of a
    vehicle at rest often are, may have an eigenvalue of zero to which rounding gave a sign, so that the count of
    negative ones means nothing: a step, or a shift, without end tells of it. With `careful`, what the step leaves of
    the linear system is measured, and solved for again where that is much. None where the system stays singular.
    """
    grid, system, point = search.grid, search.system, iterate.point
    primal, delta_c = np.empty(point.unknowns.size), 0.0
    at_once, least = first_delta_w(before)
    delta_w = max(damping, at_once)
    while delta_w < 1e20:
        gradient, diagonal = newton_system(search, iterate, point.gradient, delta_w, delta_c)
        excess = factor_kkt(grid, point.unknowns, 1.0, diagonal, system, gradient, primal)
        if excess == 0:
            same = delta_w == before.delta_w == 0.0 and delta_c == 0.0
            given = before if same else corrected_inertia(before, delta_w, least, delta_c > 0.0)
            step = step_along(search, iterate, gradient, primal, given)
            if delta_c == 0.0 and step.is_of_rounding:
                delta_c = dual_regularisation(iterate)
                continue
            if UNBOUNDED and delta_c > 0.0 and before.last == 0.0 < delta_w < 1.0 and is_far(grid, point, primal):
                delta_w *= 100.0
                continue
            if careful:  # corrections that are not worth their name change the step as well
                refined = refine(grid, point.unknowns, diagonal, system, gradient, primal)
                step = step_along(search, iterate, gradient, primal, given)._replace(refined=refined)
            if abs(step.slope) < np.inf:
                return step
        elif delta_c == 0.0 and (excess is None or excess < 0 or delta_w > LARGE_SHIFT):
            delta_c = dual_regularisation(iterate)
            if delta_w > LARGE_SHIFT:
                delta_w = max(damping, at_once)
            continue
        if delta_w == 0.0:
            delta_w = least
        else:
            delta_w *= 100.0 if before.last == 0.0 else 8.0
    return None


def step_with_factors(search, iterate):
    """The Newton step with the factors that there are, of a matrix beside the iterate that was not shifted."""
    gradient, _ = newton_system(search, iterate, iterate.point.gradient, 0.0, 0.0)
    primal = np.empty(gradient.size)
    solve_kkt(search.grid, search.system, gradient, primal)
    return step_along(search, iterate, gradient, primal, InertiaCorrection())


if UNBOUNDED:

    def is_far(grid, point, primal):
        """Whether a step goes far beyond anything that an iterate knows of.

        Where equations do not depend on anything there, to first order, the first shift alone says how far.
        """
        is_primal = ~grid.is_multiplier
        return np.abs(primal[is_primal]).max() > FAR * max(1.0, np.abs(point.unknowns[is_primal]).max())


def dual_regularisation(iterate):
    """delta_c, for equations that may be dependent."""
    if INEQUALITIES:
        return 1e-8 * iterate.mu**0.25
    else:
        return 1e-8


def is_inaccurate(search, iterate, step):
    """Whether a step leaves so much of its linear system that it has to be refined."""
    grid, point = search.grid, iterate.point
    _, diagonal = newton_system(search, iterate, point.gradient, step.inertia.delta_w, 0.0)
    _, inaccuracy = linear_residual(grid, point.unknowns, diagonal, step.gradient, step.primal)
    return inaccuracy > ACCURATE


def barely_reduces_residual(point, step, length, trial):
    """Whether a step of some length has left more than its part of the equations: they are curved, or it is inaccurate.

    Were they linear, 1 - `length` of each would be left.
    """
    if UNBOUNDED and step.inertia.delta_w > 0.0:
        return False  # it is far from a solution, where curvature is the reason
    return trial.residual > max(SOLVED, (1.0 - length + UNSOLVED) * point.residual)
