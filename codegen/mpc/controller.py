"""A model predictive controller, which solves a problem over a moving horizon from each measured state.

Source: Rawlings, Mayne and Diehl (2017), Model Predictive Control, chapter 8; for single Newton steps Diehl, Bock and
Schloeder (2005), A real-time iteration scheme for nonlinear optimization in optimal feedback control.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from threading import Lock
from time import perf_counter

import numpy as np

from codegen.errors import ArgumentError, NumericsError
from codegen.mpc import interface
from codegen.mpc.acceptance import BestIterate, Pace, better, holds
from codegen.mpc.interface import Delay, Motion
from codegen.runtime.search.cascade import factor_nearby, minimise
from codegen.runtime.search.messages import describe, reached
from codegen.runtime.search.point import Point, evaluate
from codegen.runtime.search.scaling import scaled_grid
from codegen.runtime.search.solve import optimise, solve_linear_quadratic
from codegen.runtime.search.termination import final_status
from codegen.solving.loading import ControlModule, Grid, Matrix, Vector
from codegen.solving.results.control import control_verdict
from codegen.solving.results.result import ControlAttempt, Run


@dataclass(frozen=True, eq=False, slots=True)
class Feedback:
    """The result of one sampling time of a controller.

    Attributes
    ----------
    t : float
        Time of the measurement in seconds.
    inputs : array (controls,)
        Inputs in the units of the problem, which act from the time t, or t plus the delay, until the next inputs act.
    status : str
        "solved" if all equations hold to the tolerance, evaluated outside the solver. "iteration limit" or "time limit"
        if iterations or time were used up. "non-finite" for example if the measured state has a number that is not
        finite. Otherwise the kind of failure.
    message : str
        A sentence that explains the status.
    cost, residual : float
        Cost of the plan, and max-norm of the residual of its equations.
    iterations : int
        Number of iterations.
    seconds : float
        Time from the call of `step` to the inputs.
    in_time : bool
        True if the inputs were ready before the deadline.
    fell_back : bool
        True if the inputs are those of the initial guess of the search, usually of the shifted last plan.
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
"""Names of the initial guesses of searches, for messages."""
UNFINISHED = ("iteration limit", "time limit")
MOST, MOST_WARM = 3000, 200
"""Largest number of iterations of a first solve; largest number of iterations and restoration steps from a plan.

Most states from which a controller can recover take ten to fifty iterations, rarely 180. Without a limit, a hopeless
state would take thousands of iterations: half a second for a cart-pole, whose pole falls in a tenth of that time.
"""
WARM_UPS, NUDGE = 20, 1e-4
"""Number of timed solves before the first sampling time, and the relative change of their initial state."""


@dataclass(frozen=True, eq=False)
class Ahead:
    """The prepared part of a step: run-time values, the shifted plan (n,), and True if the KKT matrix is factored."""

    given: interface.Arguments
    guess: Vector
    is_factored: bool


class Controller:
    """A model predictive controller: from each measured state, it solves a problem and returns the next inputs.

    The initial guess of a solve is the last plan, shifted by a sampling time, with the measured state. The first Newton
    step is then the tangential predictor. If a search ends early, the inputs of the best feasible iterate are applied.
    This is the cheapest iterate with a residual up to the square root of the tolerance. Without a feasible iterate the
    last iterate is applied, or the shifted plan if its residual is smaller. If a solve fails, the shifted plan is
    applied. The first solve starts from the problem's initial guess. With a deadline it starts from the solution for
    the problem's own initial state, which the constructor computes.

    Parameters
    ----------
    problem : Path, str or module
        An optimisation whose `start` has all measured quantities, as for `codegen.solve`.
    steps : int, optional
        Number of intervals of the horizon.
    horizon : float, optional
        Length of the horizon in seconds, by default the problem's duration. If the duration is a parameter that other
        formulas use, set this parameter in `parameters` instead.
    sample : float, optional
        Sampling time in seconds, by default the length of one interval.
    arguments, scheme, method
        Options of the build, as for `codegen.build`.
    parameters : dict of str to float or function, optional
        Run-time values by name: numbers, or functions of the time at which a plan starts, for moving references and
        known disturbances. `end.x` is a prescribed value at the end.
    tolerance : float
        Tolerance of a solve.
    newton_steps : int, optional
        Number of Newton steps of a solve (real-time iteration). A single step ends at the first bound that it meets, so
        three steps are better with bounds. By default a solve has at most 200 iterations and restoration steps.
    deadline : float, optional
        Largest time in seconds from the call of `step` to the inputs. An iteration begins only if it will end in time,
        according to the times of earlier steps.
    scaling : {"auto", "none"}
        With "auto" the controller decides once, at the solution for the problem's own initial state, whether the solver
        scales variables. With scaling the last iterate takes the place of the best feasible iterate.
    delay : int
        Number of sampling times between a measurement and the action of its inputs, for example for their computation.
        The model predicts the state over this time under the last `delay` inputs (delay compensation). The plan starts
        from the predicted state at the end of this time.

    Attributes
    ----------
    states, inputs : tuple of str
        Names of measured states and of inputs, in the order of arrays.
    last : Feedback or None
        Result of the last step; earlier results are not stored.

    Raises
    ------
    ArgumentError
        For a problem without controls or a measured start, or with phases, delays, inner times or a free duration; for
        a `delay` of a problem whose motion does not follow from its start and inputs; for invalid options.
    NumericsError
        For unusable numbers.
    CodegenError
        As `codegen.build`, for a problem that cannot be read or derived.

    Notes
    -----
    A controller may be called from any thread; a call waits until the call before has ended.
    """

    def __init__(
        self,
        problem: object,
        *,
        steps: int | None = None,
        horizon: float | None = None,
        sample: float | None = None,
        arguments: Mapping[str, object] | None = None,
        scheme: str | None = None,
        method: str | None = None,
        parameters: Mapping[str, interface.Moving] | None = None,
        tolerance: float = 1e-8,
        newton_steps: int | None = None,
        deadline: float | None = None,
        scaling: str = "auto",
        delay: int = 0,
    ) -> None:
        self.options = interface.Options(steps, horizon, sample, tolerance, newton_steps, deadline, scaling, delay)
        self.module: ControlModule = interface.control_module(problem, arguments or {}, scheme, method)
        self._interface = interface.interface_of(self.module)
        self.states, self.inputs = self._interface.states, self._interface.inputs
        self._attitudes = attitudes_of(tuple(self.module.metadata.attitudes), self.states)
        self.steps = int(self.module.metadata.steps) if steps is None else steps
        of_solves = {} if horizon is None else {"duration": horizon}
        self._values = interface.Values(self._interface, parameters or {}, of_solves)
        self._grids = interface.Grids(self.module, self._interface, self.steps)
        grid = self._grids.at(self._values.given(0.0))
        self.horizon = grid.steps * grid.h
        self.sample = grid.h if sample is None else sample
        # The sampling time in intervals, rounded if it is nearly a whole number.
        intervals = self.sample * self.steps / self.horizon
        if intervals > self.steps * (1.0 + interface.WHOLE):
            finding = f"the sampling time {self.sample:g} is longer than the horizon {self.horizon:g}"
            raise NumericsError(finding, "give a shorter sample, or a longer horizon")
        intervals = float(round(intervals)) if abs(intervals - round(intervals)) <= interface.WHOLE else intervals
        self._usual_start = self._interface.start_of(grid)
        self._shift = interface.shift_by(self.module, grid, intervals)
        self.delay = delay
        self._delay: Delay | None = None
        if delay:
            motion = Motion(self.module, self._interface, self.sample, intervals)
            self._delay = Delay(self._interface, self._values, motion, delay, self.sample)
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

    def step(self, state: object, t: float = 0.0, parameters: Mapping[str, float] | None = None) -> Vector:
        """Return the inputs for a measured state at the time t.

        A numerical failure raises no exception: the shifted plan gives the inputs, and `last.status` has the
        failure. The same holds for a measured state with a number that is not finite; its status is "non-finite".

        Parameters
        ----------
        state : array (states,) or dict of str to float
            The measured state in the units of the problem. In a dict, the attitude and the angular velocity of a
            rotation may be the matrix `R` and the vector `omega`, as in results. The sign of a quaternion is ignored.
        t : float
            Time of the measurement in seconds. The inputs act from this time on, or later by the delay. With a delay,
            `step` must be called at every sampling time.
        parameters : dict of str to float, optional
            Run-time values that replace the `parameters` of the controller in this step.

        Returns
        -------
        array (controls,)
            The inputs in the units of the problem.

        Raises
        ------
        NumericsError
            For a state of another shape, a time that is not finite, and unusable run-time values.
        ArgumentError
            For an unknown name.
        """
        deadline, clock = self.options.deadline, self._clock
        begin = clock()
        measured = interface.vector(self._attitudes.by_state(state), self.states, "the state", is_finite=False)
        t = interface.number(t, "the time")
        pairs = zip(self.states, measured.tolist(), strict=True)
        invalid = ", ".join(f"{name} is {value}" for name, value in pairs if not math.isfinite(value))
        with self._lock:
            failure: tuple[str, str] | None = None  # status and message of a step without a search
            if not invalid and self._attitudes.indices:
                measured = self._attitudes.aligned(measured, self._usual_start if self._state is None else self._state)
            start: Vector | None = measured
            if invalid:
                remedy = "give finite numbers, for example an estimate"
                failure = "non-finite", f"non-finite: in the measured state {invalid}; {remedy}"
            elif self._delay is not None:
                start = self._delay.state_after(measured, t, parameters)
                if start is None:
                    message = "newton failed: the motion under the inputs on their way cannot be followed"
                    failure = "newton failed", message
            given = self._values.given(self._start_of_plan(t), parameters)
            if not invalid:
                self._state = measured if start is None else start
            if self._ahead is not None and self._ahead.given != given:
                self._ahead = None
            grid = self._grids.at(given, self._state)
            if self._plan is not None:
                what, guess = BEFORE, self._shift(self._plan) if self._ahead is None else self._ahead.guess
            elif self._of_start is not None and (deadline is not None or invalid):
                # Without a plan there is no time before a deadline for a search from the problem's guess.
                what, guess = OF_START, self._of_start.copy()
            else:
                what, guess = OWN_GUESS, self.module.initial_guess(grid)
            if what is not OWN_GUESS and not invalid:
                guess = self._pinned(grid, guess)
            limit = math.inf if deadline is None else self._pace.limit(deadline - (clock() - begin))
            most = None if self._plan is None else self.options.newton_steps
            allowed = math.inf if self._plan is None else max(MOST_WARM, most or 0)
            log = BestIterate(limit, self._feasible, clock, allowed, self._pace.rest.seconds)
            best, fell_back, status, message, iterations = self._accepted(grid, guess, what, log, most, failure)
            if self._plan is not None or not invalid:
                self._plan = best.unknowns
            end = clock()
            seconds = end - begin
            if deadline is not None:
                self._pace.learn(log.beginning, log.rest(end), log.was_late)
            self.last = last = Feedback(
                t, best.unknowns[self._of_inputs], status, message, best.cost, best.residual, iterations, seconds,
                deadline is None or seconds <= deadline, fell_back,
            )  # fmt: skip
            self._ahead = None
            if self._delay is not None:
                self._delay.append(last.inputs)
        return last.inputs.copy()

    def prepare(self, t: float, parameters: Mapping[str, float] | None = None) -> None:
        """Compute, before the time t, the part of the step at time t that needs no measurement.

        This is the preparation phase of a real-time iteration: the shifted plan, run-time values, the grid, and the
        factorisation for the first Newton step. The Newton step then uses the KKT matrix at the predicted state and the
        residuals at the measured state. The first step, and a step at another time or with other `parameters`, ignore
        the preparation.

        Parameters
        ----------
        t : float
            Time of the next measurement in seconds.
        parameters : dict of str to float, optional
            Run-time values as in `step`.

        Raises
        ------
        NumericsError, ArgumentError
            As `step`, for unusable run-time values.
        """
        t = interface.number(t, "the time")
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
        """Return the problem's own initial state.

        Returns
        -------
        array (states,)
            The state in the units of the problem.
        """
        return self._interface.start_of(self._grids.separate(self._values.given(0.0)))

    def reset(self, inputs: object = None) -> None:
        """Delete the plan, before a measured state that does not follow from the last state.

        Parameters
        ----------
        inputs : array (controls,) or dict of str to float, optional
            With a delay, the inputs that act before the first inputs of the controller, zero by default.

        Raises
        ------
        ArgumentError
            If `inputs` are given to a controller without a delay.
        NumericsError
            For unusable inputs.
        """
        if inputs is not None and self._delay is None:
            finding = "inputs on their way to a controller without a delay"
            raise ArgumentError(finding, "leave them out, or give Controller(..., delay=1)")
        with self._lock:
            if self._delay is not None:
                self._delay.reset(inputs)
            self._plan, self.last, self._ahead = None, None, None

    def plan(self) -> tuple[Vector, Matrix, Matrix]:
        """Return the plan of the last step.

        Returns
        -------
        times : array (N + 1,)
            Times of the nodes in seconds.
        q : array (N + 1, coordinates)
            Coordinates or states at the nodes.
        u : array (N, controls)
            Inputs of the intervals.

        Raises
        ------
        ArgumentError
            Before the first step.
        """
        with self._lock:
            last, plan = self.last, self._plan
        if last is None or plan is None:
            raise ArgumentError("there is no plan yet", "call step first")
        begin = self._start_of_plan(last.t)
        times, q, _, u, _ = self.module.unpack(self._grids.separate(self._values.given(begin)), plan)
        return begin + times, q, u

    def _start_of_plan(self, t: float) -> float:
        """Return the time at which a plan made at the time t starts."""
        return t + self.delay * self.sample

    def _accepted(
        self, grid: Grid, guess: Vector, what: str, log: BestIterate, most: int | None,
        failure: tuple[str, str] | None = None,
    ) -> tuple[Point, bool, str, str, int]:  # fmt: skip
        """Search for a plan from a guess; return (plan to apply, True if it is the guess, status, message, iterations).

        `what` names the guess. The plan is evaluated outside the solver. With a `failure` the search is omitted.
        """
        status, message, iterations = "time limit", "time limit: there was no time for an iteration", 0
        point: Point | None = None
        if failure is not None:
            status, message = failure
        elif log.limit > 0.0:
            status, message, point, iterations = self._solve(grid, guess, what is not OWN_GUESS, log, most)
            if log.is_exhausted and status != "solved":
                status = "iteration limit"
                message = f"{status} after {iterations} iterations and {log.count - iterations} of restorations"
        if status == "solved":
            assert point is not None, "a solved search has a point"
            best, tolerance = evaluate(grid, point.unknowns), self.options.tolerance
            if holds(self.module, grid, best, tolerance):
                return best, False, status, message, iterations
            # The convergence test for results of all drivers allows for scaling factors, rounding errors and large
            # multipliers. It takes ten times as long as `holds`.
            run = Run(self.steps, guess=guess, scaling=self._scaling)
            claim = ControlAttempt("solved", "", iterations, best.unknowns, tolerance)
            if control_verdict(self.module, "newton", run, claim, grid).status == "solved":
                return best, False, status, message, iterations
            status = "inaccurate"
            message = f"{status}: the solver reported success, but the equations have residual {best.residual:.1e}"
        iterate: Point | None = None  # None if the guess is better
        if status in UNFINISHED and iterations and point is not None:
            iterate = point if log.best is None else better(point, log.best, self._feasible)
            if not iterate.residual <= self._feasible:
                iterate = iterate if better(iterate, evaluate(grid, guess), self._feasible) is iterate else None
        best = evaluate(grid, guess if iterate is None else iterate.unknowns)
        if iterate is not None:
            what = "best feasible iterate" if best.residual <= self._feasible else "last iterate"
        message = f"{message}; applied is the {what}, whose equations hold to {best.residual:.1e}"
        return best, iterate is None, status, message, iterations

    def _pinned(self, grid: Grid, unknowns: Vector) -> Vector:
        """Set the prescribed values, such as the measured state, in a plan (n,), and return the plan."""
        self.module.problem.pin_values(grid, unknowns, self.module.views(grid, unknowns)[0])
        return unknowns

    def _solve(
        self, grid: Grid, guess: Vector, is_warm: bool, log: BestIterate, most: int | None
    ) -> tuple[str, str, Point, int]:
        """Return (status, message, point, iterations) of a search, without the checks of the module's `solve`.

        Without scaling and tables the search is called directly. The search also accepts a measured state beyond a
        bound, which `solve` would refuse: bounds hold from the first node that the inputs can influence.
        """
        options = self.options.tolerance, MOST if most is None else most, is_warm
        if not self._is_plain:
            status, message, point, iterations, _ = optimise(grid, guess, *options, self._scaling, log)
            return status, message, point, iterations
        search = self._grids.search
        if self._is_linear:
            system = None if search is None else search.system
            status, point, iterations = solve_linear_quadratic(grid, guess, self.options.tolerance, log, system)
        else:
            is_factored = self._ahead is not None and self._ahead.is_factored
            status, point, iterations = minimise(grid, guess, *options, log, search=search, is_factored=is_factored)
        if status == "solved":
            return status, f"all {reached(point)}", point, iterations
        if status in UNFINISHED or log.is_exhausted:  # no time for a detailed message
            return status, f"{status} after {iterations} iterations", point, iterations
        status = final_status(grid, guess, point, status)
        return status, describe(grid, guess, point, status)[1], point, iterations

    def _warm_up(self, grid: Grid) -> Pace:
        """Solve the problem for its own initial state: compile it, decide on scaling, and time the parts of a step."""
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
            self._accepted(grid, self._pinned(grid, point.unknowns.copy()), OF_START, log, 2)
            total = self._clock() - begin
            before, rest = log.beginning, log.rest(begin + total)
            measured.append((total if before is None else before, rest or total))
        return Pace(measured)


# ---- Attitudes ----
# q and -q are the same attitude, and an estimator may return either. A plan from the other one would turn the body by a
# further whole turn. So the sign of a measured quaternion is that of the state before.

_PARTS = "wxyz"
_NEARLY = 0.1  # largest deviation of the length of a measured quaternion from one, or of a matrix from orthogonality


@dataclass(frozen=True)
class Attitudes:
    """The attitudes among measured states: for each name, the indices of its quaternion and of the rates, if any."""

    states: tuple[str, ...]
    indices: Mapping[str, tuple[list[int], list[int]]]

    def by_state(self, values: object) -> object:
        """Return a measurement with the keys `R`, `omega` and `n` replaced by those of the states.

        The values of these keys are a rotation matrix (3, 3), the angular velocity (3,) in the frame of the body, and a
        vector (3,) with the components n_x, n_y and n_z, such as a unit vector or its velocity.
        """
        if not isinstance(values, Mapping):
            return values
        measured = dict(values)
        for name in [name for name in measured if name not in self.states]:
            parts = [f"{name}_{part}" for part in _PARTS[1:]]
            if name not in self.indices and {*parts} <= {*self.states}:
                measured |= dict(zip(parts, _vector(measured.pop(name), name), strict=True))
        for name, (quaternion, rates) in self.indices.items():
            if name not in measured:
                continue
            q = _of_matrix(measured.pop(name), name)
            measured |= dict(zip((self.states[i] for i in quaternion), q, strict=True))
            spin = "omega" if len(self.indices) == 1 else f"omega_{name}"
            if rates and spin in measured:
                w = _vector(measured.pop(spin), spin)
                dq = np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))]) / 2
                measured |= dict(zip((self.states[i] for i in rates), dq, strict=True))
        return measured

    def aligned(self, state: Vector, before: Vector) -> Vector:
        """Return a state whose quaternions have length one, rates across it, and the sign of the state `before`.

        Raises NumericsError for a quaternion whose length is far from one.
        """
        state = state.copy()
        for name, (quaternion, rates) in self.indices.items():
            length = float(np.linalg.norm(state[quaternion]))
            if abs(length - 1.0) > _NEARLY:
                raise NumericsError(f"the quaternion of {name} has the length {length:.6g}", "give length one")
            sign = -1.0 if state[quaternion] @ before[quaternion] < 0.0 else 1.0
            state[quaternion] *= sign / length
            if rates:
                q = state[quaternion]
                state[rates] *= sign / length
                state[rates] -= (q @ state[rates]) * q
        return state


def attitudes_of(names: tuple[str, ...], states: tuple[str, ...]) -> Attitudes:
    """Return the attitudes with the given names whose quaternions are among the states of a controller."""
    indices = dict[str, tuple[list[int], list[int]]]()
    for name in names:
        parts = [f"{name}_{part}" for part in _PARTS]
        if {*parts} <= {*states}:
            rates = [f"d{part}" for part in parts]
            has_rates = {*rates} <= {*states}
            indices[name] = [*map(states.index, parts)], [*map(states.index, rates)] if has_rates else []
    return Attitudes(states, indices)


def _vector(value: object, name: str) -> Vector:
    w = np.array(value, dtype=float)
    if w.shape != (3,):
        raise NumericsError(f"{name} has shape {w.shape}, expected (3,)", "give three numbers")
    return w


def _of_matrix(value: object, name: str) -> Vector:
    """Return the quaternion of the rotation that is nearest to a matrix (Bar-Itzhack 2000)."""
    remedy = "give a rotation matrix (3, 3)"
    try:
        R = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise NumericsError(f"{name} is no matrix", remedy) from None
    if R.shape != (3, 3):
        raise NumericsError(f"{name} has shape {R.shape}, expected (3, 3)", remedy)
    if not np.all(np.isfinite(R)):
        return np.full(4, np.nan)
    if np.abs(R.T @ R - np.eye(3)).max() > _NEARLY or np.linalg.det(R) < 0.0:
        raise NumericsError(f"{name} is no rotation", remedy)
    K = np.empty((4, 4))
    K[0, 0] = np.trace(R)
    K[0, 1:] = K[1:, 0] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    K[1:, 1:] = R + R.T - np.trace(R) * np.eye(3)
    return np.asarray(np.linalg.eigh(K)[1][:, -1])
