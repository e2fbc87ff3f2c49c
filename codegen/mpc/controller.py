"""A controller with a moving horizon: at every sampling time it solves a problem from the measured state on.

Source: Rawlings, Mayne and Diehl (2017), Model Predictive Control, chapter 8; for single Newton steps Diehl, Bock and
Schloeder (2005), A real-time iteration scheme for nonlinear optimization in optimal feedback control.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from threading import Lock
from time import perf_counter
from typing import Any

import numpy as np

from codegen.errors import ArgumentError
from codegen.mpc.acceptance import BestIterate, Candidate, Pace, better, candidate, holds, is_solution
from codegen.mpc.interface import Grids, Interface, Moving, Options, Values, interface_of, module_of, number, shift_by
from codegen.mpc.motion import delay_of
from codegen.runtime.search import linear
from codegen.runtime.search.cascade import factor_nearby, minimise
from codegen.runtime.search.messages import describe, reached
from codegen.runtime.search.scaling import scaled_grid
from codegen.runtime.search.solve import optimise
from codegen.runtime.search.termination import final_status
from codegen.solving.interfaces import Grid, Matrix, Vector
from codegen.solving.results.result import Run


@dataclass(frozen=True, eq=False, slots=True)
class Feedback:
    """What became of one sampling time.

    `inputs` (controls,) are to be applied until those of the next one, in the problem's units, from the time `t` of the
    measurement on or, with a delay, so much later. `status` is "solved" where all equations hold to the tolerance,
    evaluated again outside the solver; "iteration limit" or "time limit" where iterations or time ran out first; else
    it says how the solve failed. `message` says so in a sentence. `fell_back` tells that the inputs are those where the
    search began, as a rule the plan before, shifted.
    `residual` is the max-norm of the plan's equations, `cost` what the plan costs. `seconds` is the time from the
    call to the inputs; `in_time`: it is within the deadline.
    """

    t: float
    inputs: Vector
    status: str
    message: str
    cost: float
    residual: float
    iterations: int
    seconds: float
    in_time: bool
    fell_back: bool


BEFORE, OF_START, OWN_GUESS = "plan before, shifted", "plan from the problem's own start", "problem's own guess"
"""Where searches begin."""
UNFINISHED = ("iteration limit", "time limit")
MOST, MOST_WARM = 3000, 200
"""Iterations at most, as for every solve; and with those of restorations, which are not counted otherwise, from a plan.

Most states from which a controller brings a system back take ten to fifty, seldom 180. Where there is no way back all
that a solve can try would take thousands: half a second of a cart-pole, whose pole falls in a tenth of it.
"""
WARM_UPS, NUDGE = 20, 1e-4
"""Solves before the first sampling time, which are timed, and how far from its state, in parts of that or of one."""


@dataclass(frozen=True, eq=False)
class Ahead:
    """What was prepared for a sampling time: its run-time values, the shifted plan (n,), whether factors are there."""

    given: dict[str, Any]
    guess: Vector
    is_factored: bool


class Controller:
    """Solves a problem again and again, from the measured state on, and gives the inputs for the next sampling time.

    `problem` is as for `codegen.solve`: an optimisation with all that is measured in `start`.
    `arguments`, `scheme` and `method` are those of a build. The horizon lasts `horizon`, by default the problem's
    duration (whose parameter, if it stands in other formulas as well, is given instead), and has `steps` intervals;
    `sample` is the sampling time in seconds, by default one interval. `parameters` are run-time values by name:
    numbers, or functions of the time at which a plan starts, for references that move and disturbances that are known;
    `end.x` is a prescribed value at the end.

    Where inputs begin to act `delay` sampling times after the measurement, as where they are computed meanwhile, the
    state is predicted by the model over that time, under the inputs that act until then, which are the last `delay`
    ones that `step` returned (delay compensation). The plan starts from there and then, and so do its inputs.

    A solve begins from the last plan, shifted by a sampling time, in which the state is the measured one: its first
    Newton step is the tangential predictor. It ends at the `tolerance`, or after `newton_steps` of them (real-time
    iteration; a single one ends at the first bound that it meets, so that with bounds three come closer), by default
    after 200 with those of restorations, or before the `deadline`, in seconds from the call: no iteration begins that
    steps before tell would end too late. Then the best feasible iterate is applied, the cheapest whose equations hold
    to the root of the tolerance; where there is none the last iterate, or the plan before where its residual is
    smaller. A solve that fails falls back on the plan before. Before the first plan a search begins from the problem's
    guess, and where there is a deadline from the solution for the problem's own start, which is found when a controller
    is made. `scaling` is "auto", which decides once, at that solution, whether the solver works in parts of sizes (then
    the best feasible iterate is the last one), or "none".

    `states` and `inputs` are names in the order of arrays. `last` is the Feedback of the last step. Nothing is kept of
    earlier ones. A controller may be called from any thread; calls take turns.

    Raises ArgumentError for a problem without controls or a measured start, with phases, delays, inner times or a free
    duration, for one with a `delay` whose motion does not follow from its start and inputs, and for options that mean
    nothing; NumericsError for numbers that are unusable; what `codegen.build` does for a problem that cannot be read or
    derived.
    """

    def __init__(
        self,
        problem: Any,
        *,
        steps: int | None = None,
        horizon: float | None = None,
        sample: float | None = None,
        arguments: Mapping[str, Any] | None = None,
        scheme: str | None = None,
        method: str | None = None,
        parameters: Mapping[str, Moving] | None = None,
        tolerance: float = 1e-8,
        newton_steps: int | None = None,
        deadline: float | None = None,
        scaling: str = "auto",
        delay: int = 0,
    ) -> None:
        self.options = Options(steps, horizon, sample, tolerance, newton_steps, deadline, scaling, delay)
        self.module: Any = module_of(problem, arguments or {}, scheme, method)
        self._interface: Interface = interface_of(self.module)
        self.states, self.inputs = self._interface.states, self._interface.inputs
        self.steps = int(self.module.metadata.steps) if steps is None else steps
        of_solves = {} if horizon is None else {"duration": horizon}
        self._values = Values(self._interface, parameters or {}, of_solves)
        self._grids = Grids(self.module, self._interface, self.steps)
        grid = self._grids.at(self._values.given(0.0))
        self.horizon = grid.steps * grid.h
        self.sample = grid.h if sample is None else sample
        intervals = self.options.intervals_of(self.sample, self.horizon, self.steps)
        self._shift = shift_by(self.module, grid, intervals)
        self.delay = delay
        self._delay = delay_of(self.module, self._interface, self._values, delay, self.sample, intervals)
        numbers = np.arange(grid.is_multiplier.size, dtype=float)
        self._of_inputs = self.module.unpack(grid, numbers)[3][0].astype(np.intp)
        self.last: Feedback | None = None
        self._plan: Vector | None = None
        self._of_start: Vector | None = None
        self._ahead: Ahead | None = None
        self._state: Vector | None = None
        self._feasible = math.sqrt(tolerance)
        self._lock, self._scaling, self._is_plain = Lock(), scaling, False
        self._is_linear = grid.problem.structure.linear_quadratic
        self._pace = self._warm_up(grid)

    _clock = staticmethod(perf_counter)

    def step(self, state: Any, t: float = 0.0, parameters: Mapping[str, float] | None = None) -> Vector:
        """The inputs (controls,) to apply from the time t on, for the measured state, (states,) or a mapping by names.

        With a delay they are to be applied so much later, and every sampling time needs its step. `parameters` are
        run-time values by name that hold in this step alone, beside those that the controller was given. Numerical
        failure is no exception: then the inputs are those of the plan before, shifted, and `last.status` says so.
        Raises NumericsError for a state that is not finite or of another shape and for run-time values that are
        unusable, ArgumentError for a name that there is not.
        """
        begin = self._clock()
        measured = self._interface.state_vector(state)
        t = number(t, "the time")
        with self._lock:
            start = measured if self._delay is None else self._delay.state_after(measured, t, parameters)
            given = self._values.given(self._start_of_plan(t), parameters)
            self._state = measured if start is None else start
            if self._ahead is not None and self._ahead.given != given:
                self._ahead = None
            grid = self._grids.at(given, self._state)
            self.last = last = self._feedback(begin, t, grid, start is not None)
            self._ahead = None
            if self._delay is not None:
                self._delay.append(last.inputs)
        return last.inputs.copy()

    def prepare(self, t: float, parameters: Mapping[str, float] | None = None) -> None:
        """Do beforehand what the step at the time t can do without a measurement, while the inputs before it act.

        That is the shifted plan, run-time values and grid, and the factorisation of the first Newton step, which is
        then one with the matrix of the predicted state and the residuals of the measured one: the preparation phase of
        a real-time iteration. The step at another time, or with other `parameters`, begins as if nothing was prepared,
        and so does the first one. Raises what `step` does for unusable run-time values.
        """
        t = number(t, "the time")
        with self._lock:
            self._ahead = None
            if self._plan is None:
                return
            given, guess = self._values.given(self._start_of_plan(t), parameters), self._shift(self._plan)
            grid, search = self._grids.at(given, self._state), self._grids.search
            is_factored = False
            if self._is_plain and search is not None and not self._is_linear:
                is_factored = factor_nearby(grid, guess, self.options.tolerance, search)
            self._ahead = Ahead(given, guess, is_factored)

    def first_state(self) -> Vector:
        """The state (states,) that the problem itself starts from."""
        return self._interface.start_of(self._grids.separate(self._values.given(0.0)))

    def reset(self, inputs: Any = None) -> None:
        """Forget the plan, where the next state has nothing to do with the last one: begin as at first.

        With a delay, `inputs` (controls,), an array or a mapping by names, act until the first ones of the controller
        do; they are zero unless given. Raises ArgumentError for inputs without a delay, NumericsError for unusable
        ones.
        """
        if inputs is not None and self._delay is None:
            finding = "inputs on their way to a controller without a delay"
            raise ArgumentError(finding, "leave them out, or give Controller(..., delay=1)")
        with self._lock:
            if self._delay is not None:
                self._delay.reset(inputs)
            self._plan, self.last, self._ahead = None, None, None

    def plan(self) -> tuple[Vector, Matrix, Matrix]:
        """What the last step plans: times (N + 1,), coordinates or states at them, and the inputs of N intervals.

        Raises ArgumentError before the first step.
        """
        with self._lock:
            last, plan = self.last, self._plan
        if last is None or plan is None:
            raise ArgumentError("there is no plan yet", "call step first")
        begin = self._start_of_plan(last.t)
        times, q, _, u, _ = self.module.unpack(self._grids.separate(self._values.given(begin)), plan)
        return begin + times, q, u

    def _start_of_plan(self, t: float) -> float:
        """When a plan starts that is made at the time t, and its inputs begin to act."""
        return t + self.delay * self.sample

    def _feedback(self, begin: float, t: float, grid: Grid, is_known: bool) -> Feedback:
        """Solve, judge what was found, and keep as the plan what is applied; `is_known`: the state is, in the grid."""
        deadline, clock = self.options.deadline, self._clock
        guess, what = self._guess(grid)
        limit = math.inf if deadline is None else self._pace.limit(deadline - (clock() - begin))
        most = None if self._plan is None else self.options.newton_steps
        allowed = math.inf if self._plan is None else max(MOST_WARM, most or 0)
        log = BestIterate(limit, self._feasible, clock, allowed, self._pace.rest.seconds)
        best, fell_back, status, message, iterations = self._judged(grid, guess, what, log, most, is_known)
        self._plan = best.unknowns
        end = clock()
        seconds = end - begin
        if deadline is not None:
            self._pace.learn(log.beginning, log.rest(end), log.was_late)
        return Feedback(
            t, best.unknowns[self._of_inputs], status, message, best.cost, best.residual, iterations, seconds,
            deadline is None or seconds <= deadline, fell_back,
        )  # fmt: skip

    def _guess(self, grid: Grid) -> tuple[Vector, str]:
        """Where a search begins, and what that is.

        Without a plan there is no time before a deadline for a search from the problem's guess.
        """
        if self._plan is not None:
            guess = self._shift(self._plan) if self._ahead is None else self._ahead.guess
            return self._pinned(grid, guess), BEFORE
        if self._of_start is not None and self.options.deadline is not None:
            return self._pinned(grid, self._of_start.copy()), OF_START
        return self.module.initial_guess(grid), OWN_GUESS

    def _judged(
        self, grid: Grid, guess: Vector, what: str, log: BestIterate, most: int | None, is_known: bool = True
    ) -> tuple[Candidate, bool, str, str, int]:
        """(what is applied, whether that is the guess, status, message, iterations) of a search from a guess.

        What is applied is evaluated anew, also where the search is believed which of its iterates is the best.
        """
        status, iterations = "time limit", 0
        point: Any = None
        message = f"{status}: there was no time for an iteration"
        if not is_known:
            status = "newton failed"
            message = f"{status}: the motion under the inputs on their way cannot be followed"
        elif log.limit > 0.0:
            status, message, point, iterations = self._solve(grid, guess, what is not OWN_GUESS, log, most)
            if log.is_exhausted and status != "solved":
                status = "iteration limit"
                message = f"{status} after {iterations} iterations and {log.count - iterations} of restorations"
        if status == "solved":
            best = candidate(grid, point.unknowns)
            if self._is_solved(grid, guess, best, iterations):
                return best, False, status, message, iterations
            status = "inaccurate"
            message = f"{status}: the solver reported success, but the equations have residual {best.residual:.1e}"
        chosen = self._chosen(grid, guess, point, log) if status in UNFINISHED and iterations else None
        best = candidate(grid, guess if chosen is None else chosen.unknowns)
        iterate = "best feasible iterate" if best.residual <= self._feasible else "last iterate"
        origin = what if chosen is None else iterate
        message = f"{message}; applied is the {origin}, whose equations hold to {best.residual:.1e}"
        return best, chosen is None, status, message, iterations

    def _chosen(self, grid: Grid, guess: Vector, point: Any, log: BestIterate) -> Any:
        """The point to apply of a search that came to no end, or None where the guess is better."""
        if point is None:
            return None
        best = point if log.best is None else better(point, log.best, self._feasible)
        if best.residual <= self._feasible:
            return best
        before = candidate(grid, guess)
        return best if better(best, before, self._feasible) is best else None

    def _is_solved(self, grid: Grid, guess: Vector, found: Candidate, iterations: int) -> bool:
        """Whether all equations hold at what the solver has found and calls solved."""
        module, tolerance = self.module, self.options.tolerance
        if holds(module, grid, found, tolerance):
            return True
        run = Run(self.steps, guess=guess, scaling=self._scaling)
        return is_solution(module, grid, found, run, iterations, tolerance)

    def _pinned(self, grid: Grid, unknowns: Vector) -> Vector:
        """A plan in which the state is the one that was measured."""
        self.module.pin_values(grid, unknowns, self.module.views(grid, unknowns)[0])
        return unknowns

    def _solve(
        self, grid: Grid, guess: Vector, is_warm: bool, log: BestIterate, most: int | None
    ) -> tuple[str, str, Any, int]:
        """(status, message, point, iterations), as the module's `solve`, which makes more of its solution.

        Where sizes are ordinary, and no table has a range, that is the search alone. Then a measured state may be
        beyond a bound, too, which `solve` would refuse: bounds hold from the first node on that can still be chosen.
        """
        how = self.options.tolerance, MOST if most is None else most, is_warm
        if not self._is_plain:
            status, message, point, iterations, _ = optimise(grid, guess, *how, self._scaling, log)
            return status, message, point, iterations
        search = self._grids.search
        if self._is_linear:
            status, point, iterations = linear.minimise(grid, guess, self.options.tolerance, log, search.system)
        else:
            is_factored = self._ahead is not None and self._ahead.is_factored
            status, point, iterations = minimise(grid, guess, *how, log, search=search, is_factored=is_factored)
        if status == "solved":
            return status, f"all {reached(point)}", point, iterations
        if status in UNFINISHED or log.is_exhausted:  # what is worst is not looked for: there is no time
            return status, f"{status} after {iterations} iterations", point, iterations
        status = final_status(grid, guess, point, status)
        return status, describe(grid, guess, point, status)[1], point, iterations

    def _warm_up(self, grid: Grid) -> Pace:
        """Solve the problem as it stands: that compiles, decides on sizes, and tells how long parts of a step take."""
        module, given = self.module, self._values.given(0.0)
        if self._delay is not None:
            self._delay.state_after(self._interface.start_of(grid), 0.0, None)
        log = BestIterate(math.inf, 0.0)
        status, _, point, _ = self._solve(grid, module.initial_guess(grid), False, log, None)
        if self._scaling == "auto" and status == "solved":
            is_ordinary = not scaled_grid(grid, point.unknowns).sizes.size
            self._scaling = "none" if is_ordinary else "auto"
        self._is_plain = self._scaling == "none" and module.problem.inputs is None
        self._of_start = point.unknowns if status == "solved" else None
        start, measured = self._interface.start_of(grid), []
        for k in range(WARM_UPS):
            nudge = NUDGE * (-1.0) ** k * np.maximum(1.0, np.abs(start))
            grid, begin = self._grids.at(given, start + nudge), self._clock()
            log = BestIterate(math.inf, self._feasible, self._clock)
            self._judged(grid, self._pinned(grid, point.unknowns.copy()), OF_START, log, 2)
            whole = self._clock() - begin
            before, rest = log.beginning, log.rest(begin + whole)
            measured.append((whole if before is None else before, rest or whole))
        return Pace(measured)
