"""The reference of an optimum, and CasADi with IPOPT on the problem of a report, if CasADi is installed.

For the reference the scheme of the highest order that applies is solved on grids that are doubled, each from the
optimum on the grid before. Between nodes and stages, splines interpolate. The difference of the last two grids is the
estimate of the error. It exceeds the error of the last grid as long as the sequence converges.

CasADi uses multiple shooting by rk4.

With a control u_k that is constant on each interval, and the Runge-Kutta method rk4 for states and cost,

    minimise    sum_k (cost of step k) + terminal cost
    subject to  x_{k+1} - F(x_k, u_k, t_k, h) = 0,  prescribed states at both ends,  bounds on states and controls

The right-hand sides are those of the author's problem, printed by sympy for CasADi. States are coordinates with
velocities or momenta. A worker process runs the file, so that neither sympy nor CasADi disturbs other measurements.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import import_module
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from codegen.errors import CodegenError
from codegen.evidence.report.store import Values
from codegen.evidence.report.timing import timed
from codegen.solving import api
from codegen.solving.drivers.shared import quiet_single_thread
from codegen.solving.loading import ControlModule, Matrix, Vector
from codegen.solving.results.result import Result

NAME = "CasADi + IPOPT, rk4"
OPTIONS = {
    "print_time": False, "expand": True, "error_on_fail": False, "ipopt.print_level": 0, "ipopt.sb": "yes",
    "ipopt.tol": 1e-10, "ipopt.max_iter": 1000,
}  # fmt: skip
_ABSENT = ("path", "integrals", "inner_conditions", "start_conditions", "end_conditions", "holonomic", "rolling",
           "periodic", "joined", "delays", "free_parameters", "phases", "measurements")  # fmt: skip
"""Features of a model that the program has not."""


@dataclass(frozen=True)
class Guess:
    """The initial guess on a grid: coordinates and momenta (N + 1, n) at nodes, and controls (N, m) on intervals."""

    q: Matrix
    p: Matrix
    u: Matrix


def measured(problem: Path, guesses: Sequence[Guess], reference: Values, limit: float, budget: float) -> Values:
    """Return the solves on the grids of the guesses, in rows with times and errors; or the reason for none.

    No grid follows a solve of more than `limit` seconds. A solve is repeated for at most `budget` seconds.
    """
    from codegen.discretise.model.from_problem import load_problem

    trajectory, rows = read_trajectory(reference), list[Values]()
    try:
        program = _Program(load_problem(problem, {}))
    except (CodegenError, NotImplementedError, NameError, TypeError, AttributeError) as error:
        return {"rows": rows, "message": str(error)}
    for guess in guesses:
        run = program.on_grid(guess)
        with quiet_single_thread():
            solution, status, iterations = run()
        row: Values = {"steps": len(guess.u), "status": status, "iterations": iterations}
        if status == "Solve_Succeeded":
            found = program.trajectory(np.asarray(solution["x"]).ravel(), len(guess.u))
            with quiet_single_thread():
                time = timed(run, budget)
            row = {**row, "cost": float(solution["f"]), **trajectory.errors(found), "seconds": time.processor,
                   "wall seconds": time.wall, "status": "solved"}  # fmt: skip
            if time.processor > limit:
                rows.append(row)
                break
        rows.append(row)
    return {"rows": rows}


class _Program:
    """The dynamics and the cost of a problem as functions of CasADi."""

    def __init__(self, model: Any) -> None:
        """Print the right-hand sides; raise NotImplementedError with the feature that the program has not."""
        import sympy

        features = [name for name in _ABSENT if getattr(model, name)] + (["bodies"] if model.bodies > 1 else [])
        if features:
            raise NotImplementedError(f"no program for problems with {', '.join(features).replace('_', ' ')}")
        self.ca, self.model = import_module("casadi"), model
        if hasattr(self.ca.GlobalOptions, "setNumpyMode"):
            self.ca.GlobalOptions.setNumpyMode(-1)  # functions of numpy accept symbols of CasADi without a warning
        self.values = model.default_values
        self.states = (*model.coordinates, *model.rates)
        self.duration = float(model.duration.xreplace(self.values))
        arguments = (*self.states, *model.controls, model.time)

        def printed(expressions: Sequence[Any], module: Any) -> Callable[..., Any]:
            numeric = [expression.xreplace(self.values) for expression in expressions]
            return sympy.lambdify(arguments, numeric, modules=module, cse=True)  # type: ignore[no-any-return]

        self.rates = printed([*_rates(model), model.cost], self.ca)
        self.terminal_cost = printed([model.terminal_cost], self.ca)
        momenta = model.rates if model.form == "hamiltonian" else [model.function.diff(v) for v in model.rates]
        self.momenta = printed(momenta, "numpy")

    def on_grid(self, guess: Guess) -> Callable[[], tuple[Any, str, int]]:
        """Return the function that solves from a guess; it returns the solution, the status and the iterations."""
        ca, model, n, m, steps = self.ca, self.model, len(self.states), len(self.model.controls), len(guess.u)
        h = self.duration / steps
        x, u, t = ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX.sym("t")

        def rate(state: Any, time: Any) -> Any:
            return ca.vertcat(*self.rates(*ca.vertsplit(state[:n]), *ca.vertsplit(u), time))

        state = ca.vertcat(x, 0)
        first = rate(state, t)
        second = rate(state + h / 2 * first, t + h / 2)
        third = rate(state + h / 2 * second, t + h / 2)
        end = state + h / 6 * (first + 2 * second + 2 * third + rate(state + h * third, t + h))
        step = ca.Function("step", [x, u, t], [end[:n], end[n]], {"cse": True})
        w = ca.MX.sym("w", (n + m) * steps + n)
        table, last = ca.reshape(w[: (n + m) * steps], n + m, steps), w[(n + m) * steps :]
        following, costs = step.map(steps)(table[:n, :], table[n:, :], ca.DM(h * np.arange(steps)).T)
        gaps = ca.vec(ca.horzcat(table[:n, 1:], last) - following)
        final = self.terminal_cost(*ca.vertsplit(last), *[0] * m, self.duration)[0]
        rates = guess.p
        if model.form == "lagrangian":
            rates = np.gradient(guess.q, h, axis=0)
        nodes = np.hstack([guess.q, rates])
        low, high = np.full((steps + 1, n + m), -inf), np.full((steps + 1, n + m), inf)
        symbols = (*self.states, *model.controls)
        for bound in model.bounds:
            for side, limit in ((low, bound.lower), (high, bound.upper)):
                if limit is not None:
                    side[:, symbols.index(bound.symbol)] = float(limit.xreplace(self.values))
        for node, boundary in ((0, model.start), (-1, model.end)):
            for i, value in enumerate((*boundary.positions, *boundary.rates)):
                if value is not None:
                    nodes[node, i] = low[node, i] = high[node, i] = float(value.xreplace(self.values))
        begin = np.append(np.hstack([nodes[:-1], guess.u]).ravel(), nodes[-1])
        lower, upper = (side.ravel()[: begin.size] for side in (low, high))
        nlp = {"x": w, "f": ca.sum2(costs) + final, "g": gaps}
        solver = ca.nlpsol("solver", "ipopt", nlp, OPTIONS)
        solve = partial(solver, x0=begin, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)

        def run() -> tuple[Any, str, int]:
            solution = solve()
            statistics = solver.stats()
            return solution, str(statistics["return_status"]), int(statistics["iter_count"])

        return run

    def trajectory(self, unknowns: Vector, steps: int) -> Trajectory:
        """Return states (q, p) at the nodes and controls at the midpoints of a solution."""
        n, m, half = len(self.states), len(self.model.controls), len(self.model.coordinates)
        table = unknowns[: (n + m) * steps].reshape(steps, n + m)
        states, controls = np.vstack([table[:, :n], unknowns[(n + m) * steps :]]), table[:, n:]
        times = np.linspace(0.0, self.duration, steps + 1)
        momenta = self.momenta(*states.T, *np.zeros((m, 1)), times)
        columns = [states[:, :half], *(np.broadcast_to(p, times.shape)[:, None] for p in momenta)]
        fractions = np.linspace(0.0, 1.0, steps + 1)
        return Trajectory(self.duration, fractions, np.hstack(columns), fractions[:-1] + 0.5 / steps, controls)


def _rates(model: Any) -> Sequence[Any]:
    """Return the time derivatives of all states."""
    import sympy

    from codegen.discretise.model.legendre import solve_blocks
    from codegen.evidence.analysis.modified_equations import vector_field

    if model.form == "first-order":
        return tuple(model.dynamics)
    if model.form == "hamiltonian":
        return tuple(vector_field(model))
    q, rates = model.coordinates, model.rates
    momenta = [model.function.diff(v) for v in rates]
    right = [
        model.function.diff(x) + f - p.diff(model.time) - sum(p.diff(y) * v for y, v in zip(q, rates, strict=True))
        for x, f, p in zip(q, model.force, momenta, strict=True)
    ]
    return (*rates, *solve_blocks(sympy.hessian(model.function, rates), right))


# The reference

DEGREE = 5
COARSEST, MOST_INTERVALS, ENOUGH = 20, 5120, 1e-12
"""The least and the largest number of intervals of a reference, and the estimated error below which it is accurate."""
TOLERANCE = 1e-12
_STORED = ("duration", "nodes", "states", "times", "controls")
SAMPLES = 1001  # the number of equidistant times at which two references are compared


@dataclass(frozen=True)
class Trajectory:
    """States (N + 1, n) at `nodes`, and controls (T, m) at `times`; both times are fractions of the duration."""

    duration: float
    nodes: Vector
    states: Matrix
    times: Vector
    controls: Matrix

    @cached_property
    def splines(self) -> tuple[BSpline, BSpline]:
        """Return states and controls as functions of the fraction of the duration."""
        states, controls = (
            make_interp_spline(x, values, min(DEGREE, x.size - 1))
            for x, values in ((self.nodes, self.states), (self.times, self.controls))
        )
        return states, controls

    def errors(self, other: Trajectory) -> dict[str, float | None]:
        """Return the errors of `other`: of states, the largest, and of controls, the root mean square.

        Errors are relative to the largest value of each component. The error of the duration counts as one of states.
        """
        states, controls = (spline(x) for spline, x in zip(self.splines, (other.nodes, other.times), strict=True))
        of_states = np.abs(other.states - states) / _sizes(self.states)
        of_duration = abs(other.duration / self.duration - 1.0)
        values: dict[str, float | None] = {"states": max(float(of_states.max()), of_duration), "controls": None}
        if self.controls.shape[1]:
            of_controls = (other.controls - controls) / _sizes(self.controls)
            values["controls"] = float(np.sqrt((of_controls**2).mean(axis=0)).max())
        return values

    def resampled(self) -> Trajectory:
        """Return the values at equidistant times."""
        x = np.linspace(0.0, 1.0, SAMPLES)
        states, controls = (spline(x) for spline in self.splines)
        return Trajectory(self.duration, x, states, x, controls)


def _sizes(values: Matrix) -> Vector:
    """Return the largest modulus of each column; of all columns for one that vanishes."""
    sizes = np.abs(values).max(axis=0, initial=0.0)
    largest = sizes.max(initial=0.0) or 1.0
    return np.where(sizes > 1e-9 * largest, sizes, largest)


def trajectory_of(result: Result) -> Trajectory:
    """Return states (q, p) and controls of a result of one phase."""
    assert result.u is not None
    begin, duration = result.t[0], result.t[-1] - result.t[0]
    times = np.unique(result.control_times)
    return Trajectory(
        float(duration), (result.t - begin) / duration, np.hstack([result.q, result.p]), (times - begin) / duration,
        result.controls_at(times),
    )  # fmt: skip


def read_trajectory(values: Values) -> Trajectory:
    """Return a stored trajectory."""
    nodes, states, times, controls = (np.array(values[name]) for name in ("nodes", "states", "times", "controls"))
    return Trajectory(values["duration"], nodes, states, times, controls.reshape(len(times), -1))


def refined(modules: Sequence[tuple[str, ControlModule]], first: int, budget: float) -> Values:
    """Return the reference by the first of the `modules`, with their labels, that has optima on two grids.

    No grid starts after `budget` seconds of processor time since the first grid of a module.
    """
    for label, module in modules:
        steps, earlier, begin = max(first, COARSEST), None, 0.0
        best: Values = {}
        while steps <= MOST_INTERVALS and (earlier is None or time.process_time() - begin < budget):
            result = _solved(module, steps, earlier)
            if result is None:
                break
            begin = begin or time.process_time()  # the first solve may read machine code
            if earlier is not None:
                errors = trajectory_of(result).errors(trajectory_of(earlier).resampled())
                assert result.cost is not None
                assert earlier.cost is not None
                errors["cost"] = abs(result.cost - earlier.cost) / (abs(result.cost) or 1.0)
                largest = max(error for error in errors.values() if error is not None)
                if best and largest >= best["largest"]:
                    break  # rounding, or a limit that the controls of this scheme do not approach
                trajectory = trajectory_of(result)
                best = {
                    **{name: getattr(trajectory, name) for name in _STORED},
                    "cost": result.cost, "errors": errors, "largest": largest, "label": label, "steps": steps,
                }  # fmt: skip
                if largest < ENOUGH:
                    break
            earlier, steps = result, 2 * steps
        if best:
            return best
    return {"label": None}


def _solved(module: ControlModule, steps: int, warm: Result | None) -> Result | None:
    """Return an optimum with the tolerance of references, or with the default tolerance; None if both searches fail."""
    for tolerance in (TOLERANCE, None):
        try:
            result = api.solve(module, steps=steps, warm=warm and warm.unknowns, tolerance=tolerance)
        except CodegenError:  # such as too little memory
            return None
        if result.solved:
            return result
    return None
