"""How far Newton's steps are followed: filter line search, second-order correction, watchdog.

Numbers are those of Waechter and Biegler (2006), as in `newton.py`.
"""

import numpy as np

from codegen.runtime.kkt.system import solve_kkt
from codegen.runtime.optimise.bounded import (
    InertiaCorrection,
    barrier_error,
    barrier_objective,
    moved,
    step_along,
)
from codegen.runtime.optimise.filter import Filter
from codegen.runtime.optimise.newton_steps import (
    AccuracyMonitor,
    barely_reduces_residual,
    is_inaccurate,
    regularised_step,
    step_with_factors,
)
from codegen.runtime.optimise.stagnation import is_at_rounding_level
from codegen.runtime.stand_ins.example import INEQUALITIES

CORRECTIONS = 4  # second-order corrections that are tried at one iterate
SHORT = 0.25  # part of a step that is left when it counts as much too long
SHORT_IN_TURN = 6  # so many of them make the next ones shorter beforehand
SHORTENED = 10  # steps in turn that the filter shortens before full ones are tried
LEAST_DAMPING = 1e-5
TINY, CLOSER = 1e-13, 0.9  # part of an unknown, or of one, that is none; part of the error that may be left
IN_VAIN = 20  # full steps in turn that leave the equations as they were: linearised, these contradict each other
FULL_STEPS = 4  # how many may pass untested before one has to be better than the iterate where they began


class Globalisation:
    """What decides how far Newton's steps are followed: the filter, and what earlier steps of a descent were like.

    `watchdog` holds where full steps began: the iterate, its Newton step, and how many may still follow.
    """

    def __init__(self, attempt, violation):
        first = max(1.0, violation)
        self.shortest, self.small_violation = attempt.shortest, 1e-4 * first
        self.filtered = Filter(attempt.funnel * first)
        self.inertia, self.length, self.damping = InertiaCorrection(), 0.0, 0.0
        self.shortened, self.watchdog, self.monitor = 0, None, AccuracyMonitor()
        self.in_vain, self.is_factored = 0, attempt.is_factored

    def is_contradicted(self, point):
        """Whether full steps in turn have left the equations as they were, far from holding."""
        return self.in_vain >= IN_VAIN and point.residual > self.small_violation

    if INEQUALITIES:

        def forget(self):
            """Forget what belongs to another barrier problem."""
            self.filtered.empty()
            self.shortened, self.watchdog = 0, None

    def next_iterate(self, search, iterate):
        """(step, next iterate) of Newton's method; None for a step where the system stays singular.

        The next iterate is None where no part of the step is acceptable.
        """
        if self.is_factored:
            self.is_factored = False
            step = step_with_factors(search, iterate)
            trial = self.line_search(search, iterate, step)
            if trial is not None:
                return step, trial
        careful, before = self.monitor.is_due(), self.inertia
        step = regularised_step(search, iterate, before, self.damping, careful)
        if step is None:
            return None, None
        self.inertia = step.inertia
        if careful:
            self.monitor.record(step.refined)
        if self.shortened == SHORTENED:
            self.watchdog = iterate, step, FULL_STEPS
        if self.watchdog is not None:
            self.shortened = 0
            return step, self.watchdog_step(search, iterate, step)
        trial = self.line_search(search, iterate, step)
        if trial is not None and not careful and barely_reduces_residual(iterate.point, step, self.length, trial.point):
            self.monitor.add()
            if self.monitor.is_due():
                if is_inaccurate(search, iterate, step):
                    step = regularised_step(search, iterate, before, self.damping, True) or step
                    self.inertia = step.inertia
                    trial = self.line_search(search, iterate, step)
                self.monitor.record(step.refined)
        self.shortened = self.shortened + 1 if trial is None or self.length < step.longest else 0
        as_before = self.shortened == 0 and trial.point.violation >= 0.999 * iterate.point.violation
        self.in_vain = self.in_vain + 1 if as_before else 0
        if self.shortened or self.damping > 0.0:
            self.damping = damped(self.damping, step, self.length, self.shortened) if trial is not None else 0.0
        return step, trial

    def line_search(self, search, iterate, step):
        """The next iterate after a step that is shortened until the filter accepts it, or None."""
        length = step.longest
        while length > self.shortest:
            self.length = length
            trial = moved(search, iterate, step, length)
            if self.is_better(trial, iterate, step, length):
                return trial
            if length == step.longest and converges_unseen(search, iterate, step, trial):
                return trial
            if length == step.longest and trial.point.violation >= iterate.point.violation:
                better = self.second_order_correction(search, iterate, step, trial.point)
                if better is not None:
                    return better
            length *= 0.5
        self.length = length
        return None

    def watchdog_step(self, search, iterate, step):
        """The next iterate after a full step that is taken untested, in the hope that one soon is better.

        The watchdog technique: where the equations' curvature makes the filter shorten step after step, full ones may
        be better after all. If none is, all goes on from where they began. Source: section 3.2.
        """
        began, first, left = self.watchdog
        trial, self.length = moved(search, iterate, step, step.longest), step.longest
        better = self.is_better(trial, began, first, first.longest)
        if not better and (left == 1 or not trial.point.error < np.inf):
            self.length, self.watchdog = 0.0, None
            if INEQUALITIES:
                began = began._replace(measured=None)  # it was, before its bounds were relaxed less
            return began
        self.watchdog = None if better else (began, first, left - 1)
        return trial

    def is_better(self, trial, iterate, step, length):
        """Whether a trial may follow an iterate, from which a step of some length was to lead to it."""
        return trial.point.error < np.inf and self.filtered.accept(
            iterate.point.violation,
            barrier_objective(iterate),
            trial.point.violation,
            barrier_objective(trial),
            step.slope,
            length,
            self.small_violation,
        )

    def second_order_correction(self, search, iterate, step, refused):
        """The iterate after second-order corrections (27) of a full step that the equations' curvature spoils, or None.

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
            better = step_along(search, iterate, right, correction, step.inertia)
            length = better.longest
            trial = moved(search, iterate, better, length)
            if self.is_better(trial, iterate, step, step.longest):
                return trial
            if not trial.point.violation < 0.99 * refused.violation:
                return None
            refused = trial.point
        return None


def converges_unseen(search, iterate, step, trial):
    """Whether a step moves primal unknowns, or leaves of the equations, rounding alone, and is closer to an optimum.

    With bounds the optimality conditions are also those of the barrier problem, in which duals may be all that is left
    to move, or unknowns by as little as a cost does that vanishes at its optimum, as that of exact data. Cost and
    violation, which the filter compares, tell nothing of it. IPOPT takes tiny steps unseen: section 3.9.
    """
    is_closer = trial.point.error < CLOSER * iterate.point.error
    if INEQUALITIES:
        is_closer = is_closer or barrier_error(trial) < CLOSER * barrier_error(iterate)
    if not is_closer:
        return False
    rests = np.abs(step.primal) <= TINY * np.maximum(1.0, np.abs(iterate.point.unknowns))
    return bool((rests | search.grid.is_multiplier).all()) or is_at_rounding_level(search.grid, trial.point)


def damped(damping, step, length, shortened):
    """The least shift of the Hessian for the next step: more where steps in turn had to be shortened much, else less.

    A Hessian that is barely positive definite sends steps far beyond where it means something.
    """
    if length <= SHORT * step.longest and shortened >= SHORT_IN_TURN:
        return 4.0 * max(step.inertia.delta_w, damping, LEAST_DAMPING)
    if length < step.longest:
        return damping
    return damping / 2.0 if damping > LEAST_DAMPING else 0.0
