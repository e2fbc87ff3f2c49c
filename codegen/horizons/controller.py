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
from codegen.horizons.grids import Grids
from codegen.horizons.interface import Interface, interface_of, module_of, number
from codegen.horizons.judgement import BestIterate, Candidate, FirstIterate, better, candidate, holds, is_solution
from codegen.horizons.options import Options
from codegen.horizons.shift import shift_by
from codegen.horizons.values import Moving, Values
from codegen.interfaces import Grid, Matrix, Vector
from codegen.solutions.result import Run

UNFINISHED = ("iteration limit", "time limit")
MOST = 3000
"""Iterations at most, as for every solve."""
WARM_UPS = 10
"""Solves of one iteration before the first sampling time, which are timed."""
RESERVE = 1.4
"""Time before a deadline in which no iteration begins, in parts of that from an iterate to the next one's verdict.

Where time runs out, two more plans are evaluated.
"""


@dataclass(frozen=True, eq=False, slots=True)
class Feedback:
    """What became of one sampling time.

    `inputs` (controls,) are to be applied until the next one, in the problem's units. `status` is "solved" where all
    equations hold to the tolerance, evaluated again outside the solver; "iteration limit" or "time limit" where Newton
    steps or time ran out first; else it says how the solve failed. `message` says so in a sentence. `fell_back` tells
    that the inputs are those of the plan before, shifted. `residual` is the max-norm of the plan's equations, `cost`
    what the plan costs. `seconds` is the time from the call to the inputs; `in_time`: it is within the deadline.
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


class Controller:
    """Solves a problem again and again, from the measured state on, and gives the inputs for the next sampling time.

    `problem` is as for `codegen.solve`: an optimisation with all that is measured in `start`.
    `arguments`, `scheme` and `method` are those of a build. The horizon lasts `horizon`, by default the problem's
    duration (whose parameter, if it stands in other formulas as well, is given instead), and has `steps` intervals;
    `sample` is the sampling time, by default one interval. `parameters` are run-time values by name: numbers, or
    functions of the present time, for references that move and disturbances that are known; `end.x` is a prescribed
    value at the end.

    A solve begins from the last plan, shifted by a sampling time, in which the state is the measured one: its first
    Newton step is the tangential predictor. It ends at the `tolerance`, or after `newton_steps` of them (real-time
    iteration; a single one ends at the first bound that it meets, so that with bounds three are better), or before the
    `deadline`, in seconds from the call. Then the best feasible iterate is applied, the cheapest whose equations hold
    to the root of the tolerance; where there is none the last iterate, or the plan before where its residual is
    smaller. A solve that fails falls back on the plan before. `scaling` is "auto", which decides once, at a first
    solution, whether the solver works in parts of sizes (then the best feasible iterate is the last one), or "none".

    `states` and `inputs` are names in the order of arrays. `last` is the Feedback of the last step. Nothing is kept of
    earlier ones. A controller may be called from any thread; calls take turns.

    Raises ArgumentError for a problem without controls or a measured start, with phases, delays, inner times or a free
    duration, and for options that mean nothing; NumericsError for numbers that are unusable; what `codegen.build` does
    for a problem that cannot be read or derived.
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
    ) -> None:
        self.options = Options(steps, horizon, sample, tolerance, newton_steps, deadline, scaling)
        self.module: Any = module_of(problem, arguments or {}, scheme, method)
        self._interface: Interface = interface_of(self.module)
        self.states, self.inputs = self._interface.states, self._interface.inputs
        self.steps = int(self.module.metadata["steps"]) if steps is None else steps
        of_solves = {} if horizon is None else {"duration": horizon}
        self._values = Values(self._interface, parameters or {}, of_solves)
        self._grids = Grids(self.module, self._interface, self.steps)
        grid = self._grids.at(self._values.given(0.0))
        self.horizon = grid.steps * grid.h
        self.sample = grid.h if sample is None else sample
        self._shift = shift_by(self.module, grid, self.options.intervals_of(self.sample, self.horizon, self.steps))
        numbers = np.arange(grid.is_multiplier.size, dtype=float)
        self._of_inputs = self.module.unpack(grid, numbers)[3][0].astype(np.intp)
        self.last: Feedback | None = None
        self._plan: Vector | None = None
        self._feasible = math.sqrt(tolerance)
        self._lock, self._scaling, self._is_plain = Lock(), scaling, False
        self._beginning = self._reserve = 0.0
        self._warm_up(grid)

    def step(self, state: Any, t: float = 0.0, parameters: Mapping[str, float] | None = None) -> Vector:
        """The inputs (controls,) to apply from the time t on, for the measured state, (states,) or a mapping by names.

        `parameters` are run-time values by name that hold at this time alone, beside those that the controller was
        given. Numerical failure is no exception: then the inputs are those of the plan before, shifted, and
        `last.status` says so. Raises NumericsError for a state that is not finite or of another shape and for run-time
        values that are unusable, ArgumentError for a name that there is not.
        """
        begin = perf_counter()
        start = self._interface.state_vector(state)
        t = number(t, "the time")
        with self._lock:
            grid = self._grids.at(self._values.given(t, parameters), start)
            self.last = last = self._feedback(begin, t, grid)
        return last.inputs.copy()

    def first_state(self) -> Vector:
        """The state (states,) that the problem itself starts from."""
        return self._interface.start_of(self._grids.separate(self._values.given(0.0)))

    def reset(self) -> None:
        """Forget the plan, where the next state has nothing to do with the last one: begin from the problem's guess."""
        with self._lock:
            self._plan, self.last = None, None

    def plan(self) -> tuple[Vector, Matrix, Matrix]:
        """What the last step plans: times (N + 1,), coordinates or states at them, and the inputs of N intervals.

        Raises ArgumentError before the first step.
        """
        with self._lock:
            last, plan = self.last, self._plan
        if last is None or plan is None:
            raise ArgumentError("there is no plan yet", "call step first")
        times, q, _, u, _ = self.module.unpack(self._grids.separate(self._values.given(last.t)), plan)
        return last.t + times, q, u

    def _feedback(self, begin: float, t: float, grid: Grid) -> Feedback:
        """Solve, judge what was found, and keep as the plan what is applied."""
        module, deadline = self.module, self.options.deadline
        is_first = self._plan is None
        guess = module.initial_guess(grid) if self._plan is None else self._shifted(grid, self._plan)
        limit = math.inf if deadline is None else deadline - self._reserve - (perf_counter() - begin)
        found, status, iterations = None, "time limit", 0
        message = f"{status}: there was no time for an iteration"
        log = BestIterate(limit, self._feasible)
        if limit > self._beginning:
            most = None if is_first else self.options.newton_steps
            status, message, unknowns, iterations = self._solve(grid, guess, not is_first, log, most)
            best = found = candidate(module, grid, unknowns)
            if status == "solved" and not self._is_solved(grid, guess, found, iterations):
                status = "inaccurate"
                message = f"{status}: the solver reported success, but the equations have residual {found.residual:.1e}"
        if status != "solved":
            before = candidate(module, grid, guess)
            best = before
            if found is not None and status in UNFINISHED:
                if log.unknowns is not None:
                    found = better(found, candidate(module, grid, log.unknowns), self._feasible)
                best = better(found, before, self._feasible)
            plan = "problem's own guess" if is_first else "plan before, shifted"
            iterate = "best feasible iterate" if best.residual <= self._feasible else "last iterate"
            origin = plan if best is before else iterate
            message = f"{message}; applied is the {origin}, whose equations hold to {best.residual:.1e}"
        self._plan = best.unknowns
        seconds = perf_counter() - begin
        return Feedback(
            t, best.unknowns[self._of_inputs], status, message, best.cost, best.residual, iterations, seconds,
            deadline is None or seconds <= deadline, best is not found,
        )  # fmt: skip

    def _is_solved(self, grid: Grid, guess: Vector, found: Candidate, iterations: int) -> bool:
        """Whether all equations hold at what the solver has found and calls solved."""
        module, tolerance = self.module, self.options.tolerance
        if holds(module, grid, found, tolerance):
            return True
        run = Run(self.steps, guess=guess, scaling=self._scaling)
        return is_solution(module, grid, found, run, iterations, tolerance)

    def _shifted(self, grid: Grid, plan: Vector) -> Vector:
        """A plan of one sampling time before, with the state that was measured."""
        unknowns = self._shift(plan)
        self.module.pin_values(grid, unknowns, self.module.views(grid, unknowns)[0])
        return unknowns

    def _solve(
        self, grid: Grid, guess: Vector, is_warm: bool, log: BestIterate, most: int | None
    ) -> tuple[str, str, Vector, int]:
        """(status, message, unknowns, iterations), as the module's `solve`, which makes more of its solution.

        Where sizes are ordinary, and no table has a range, that is the search alone. Then a measured state may be
        beyond a bound, too, which `solve` would refuse: bounds hold from the first node on that can still be chosen.
        """
        module = self.module
        how = self.options.tolerance, MOST if most is None else most, is_warm
        with module.packed_operations():
            if not self._is_plain:
                status, message, point, iterations, _ = module.optimise(grid, guess, *how, self._scaling, log)
                log.unknowns = None  # which is in parts of sizes
                return status, message, point.unknowns, iterations
            known = {} if self._grids.search is None else {"search": self._grids.search}
            status, point, iterations = module.minimise(grid, guess, *how, log, **known)
            if status == "solved":
                return status, f"all {module.reached(point)}", point.unknowns, iterations
            if status in UNFINISHED:  # what is worst is not looked for: there is no time
                return status, f"{status} after {iterations} iterations", point.unknowns, iterations
            status = module.final_status(grid, guess, point, status)
            return status, module.describe(grid, guess, point, status)[1], point.unknowns, iterations

    def _warm_up(self, grid: Grid) -> None:
        """Solve the problem as it stands: that compiles, decides on sizes, and tells how long an iteration takes."""
        guess = self.module.initial_guess(grid)
        status, _, unknowns, _ = self._solve(grid, guess, False, BestIterate(math.inf, 0.0), None)
        if self._scaling == "auto" and status == "solved":
            is_ordinary = not self.module.scaled_grid(grid, unknowns).sizes.size
            self._scaling = "none" if is_ordinary else "auto"
        self._is_plain = self._scaling == "none" and not hasattr(self.module, "tables_beyond")
        beginnings, rests = [], []
        for _ in range(WARM_UPS):
            guess, log = self._shifted(grid, unknowns), FirstIterate()
            again = self._solve(grid, guess, True, log, 1)[2]
            candidate(self.module, grid, again)
            beginnings.append(log.first - log.begin)
            rests.append(perf_counter() - log.first)
        self._beginning, self._reserve = min(beginnings), RESERVE * min(rests)
