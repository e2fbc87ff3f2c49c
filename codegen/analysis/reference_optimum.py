"""High-accuracy optima of nonlinear control problems: scipy's collocation on the maximum principle."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from scipy.integrate import solve_bvp, solve_ivp

from codegen.analysis.maximum_principle import NecessaryConditions, necessary_conditions, parameter_values
from codegen.errors import ArgumentError, NumericsError
from codegen.expressions import checks as expressions
from codegen.model import Model

Array = NDArray[np.float64]
Trajectory = tuple[Array, Array, Array]

_FIRST_TOLERANCE = 1e-4
_LEAST_TOLERANCE = 1e-12
_SMALLEST_ADVANCE = 1e-3


@dataclass(frozen=True)
class Reference:
    """An optimum on the mesh `t` (M,): states and costates (M, 2n), controls (M, m), cost, and the residual.

    The residual is the largest, over the mesh intervals, of the root mean square defect of the differential equations
    in normalised time, each relative to 1 + |derivative| and in units of the largest value of its unknown.
    """

    cost: float
    t: Array
    states: Array
    costates: Array
    controls: Array
    residual: float


def reference_optimum(
    model: Model,
    values: Mapping[str, float] | None = None,
    tolerance: float = 1e-10,
    guess: Trajectory | None = None,
    seconds: float = math.inf,
) -> Reference:
    """Solve the necessary conditions by adaptive collocation of order 4 with exact Jacobians (scipy's solve_bvp).

    `values` override default parameters by name. `guess` is (t, x, psi) of shapes (M,), (M, 2n), (M, 2n); without it
    coordinates are interpolated linearly between their end values (or follow the problem's own guess), velocities are
    their slopes (where that fails: interpolated as well, as momenta are), and psi is zero. If need be, the end values
    are then moved continuously from those of the uncontrolled motion. What is found is stationary; it may be one of
    several local optima. Raises ArgumentError for an unknown parameter or an unusable tolerance, and NumericsError
    when nothing converges, or not in that many `seconds` of processor time.
    """
    if not _LEAST_TOLERANCE <= tolerance < 1.0:
        raise ArgumentError(f"tolerance is {tolerance:g}", f"give one from {_LEAST_TOLERANCE:g} to 1")
    conditions = necessary_conditions(model)
    system = _BoundaryValueProblem(conditions, parameter_values(model, values), seconds)
    guesses = [_interpolated_guess(model, system, slopes) for slopes in (True, False)] if guess is None else [guess]
    for t, x, psi in guesses:
        solution = system.solve(*_checked_guess(system, t, x, psi), system.end_values, _FIRST_TOLERANCE)
        if solution.success:
            break
    else:
        solution = _continued(system)
    if solution is not None and solution.success:
        solution = system.solve(solution.x, solution.y, system.end_values, tolerance)
    if solution is None or not solution.success:
        why = "continuation in the end values stalled" if solution is None else solution.message.rstrip(".")
        raise NumericsError(
            f"no optimum of {model.name} found to {tolerance:g} ({why})",
            "pass guess=(t, x, psi) from a nearby problem or a discrete solution, or a larger tolerance",
        )
    count = len(conditions.states)
    return Reference(
        cost=float(solution.y[-1, -1]),
        t=solution.x * system.duration,
        states=solution.y[:count].T,
        costates=solution.y[count:-1].T,
        controls=system.controls(solution.x, solution.y).T,
        residual=float(np.max(solution.rms_residuals)),
    )


class _BoundaryValueProblem:
    """The necessary conditions as numpy functions of s = t/T in [0, 1] and y = (x, psi, cost so far)."""

    def __init__(self, conditions: NecessaryConditions, numbers: Mapping[sympy.Symbol, float], seconds: float) -> None:
        model = conditions.model
        self.seconds, self.deadline = seconds, time.process_time() + seconds
        z = [*conditions.states, *conditions.costates]
        rates = [*conditions.state_rates, *conditions.costate_rates, conditions.cost_rate]
        jacobian = sympy.Matrix(rates).jacobian(z)
        self.numbers, self.count, self.time = numbers, len(conditions.states), model.time
        self.duration = self.number(model.duration)
        self._rates = _vectorised(model.time, z, numbers, rates)
        self._jacobian = _vectorised(model.time, z, numbers, list(jacobian))
        self._controls = _vectorised(model.time, z, numbers, conditions.optimal_control)
        assert model.end is not None
        self.start_values, self.end_values = (
            np.array([np.nan if v is None else self.number(v) for v in (*side.positions, *side.rates)])
            for side in (model.start, model.end)
        )

    def number(self, expression: sympy.Expr) -> float:
        value = expressions.number_at(expression, self.numbers)
        if value is None:
            raise NumericsError(f"{expression} is no finite number at these parameters", "correct them")
        return value

    def controls(self, s: Array, y: Array) -> Array:
        return self._controls(s * self.duration, y)

    def rates(self, s: Array, y: Array) -> Array:
        return self.duration * self._rates(s * self.duration, y)

    def solve(self, s: Array, y: Array, end_values: Array, tolerance: float) -> Any:
        """Run solve_bvp from the mesh s and the values y, with each unknown measured by its largest value."""
        size = np.abs(y).max(axis=1)
        size[size == 0.0] = 1.0
        scale = size[:, None]
        free_start, free_end = np.isnan(self.start_values), np.isnan(end_values)
        rows, unknowns = np.arange(self.count), 2 * self.count + 1
        first, last = np.zeros((unknowns, unknowns)), np.zeros((unknowns, unknowns))
        first[rows, np.where(free_start, rows + self.count, rows)] = 1.0
        last[rows + self.count, np.where(free_end, rows + self.count, rows)] = 1.0
        first[-1, -1] = 1.0
        known = [np.where(free_start, 0.0, self.start_values), np.where(free_end, 0.0, end_values), np.zeros(1)]
        row_size = (first + last) @ size
        right = np.concatenate(known) / row_size

        def jacobian(s: Array, w: Array) -> Array:
            if time.process_time() > self.deadline:
                raise NumericsError(
                    f"collocation with {self.count} states and as many costates takes more than {self.seconds:g} s",
                    "compare with a smaller system of the kind",
                )
            partial = self._jacobian(s * self.duration, w * scale).reshape(unknowns, unknowns - 1, s.size)
            scaled = self.duration * partial * size[None, :-1, None] / size[:, None, None]
            return np.concatenate([scaled, np.zeros((unknowns, 1, s.size))], axis=1)

        ends = (first * size / row_size[:, None], last * size / row_size[:, None])
        with np.errstate(all="ignore"):
            solution = solve_bvp(
                lambda s, w: self.rates(s, w * scale) / scale,
                lambda a, b: ends[0] @ a + ends[1] @ b - right,
                s,
                y / scale,
                fun_jac=jacobian,
                bc_jac=lambda a, b: ends,
                tol=tolerance,
                bc_tol=min(tolerance, 1e-9),
                max_nodes=100_000 if tolerance < _FIRST_TOLERANCE else 3000,
            )
        solution.y = solution.y * scale
        solution.success = bool(solution.success and np.all(np.isfinite(solution.y)))
        return solution


def _vectorised(
    time: sympy.Symbol, z: Sequence[sympy.Symbol], numbers: Mapping[sympy.Symbol, float], outputs: Sequence[sympy.Expr]
) -> Callable[[Array, Array], Array]:
    """A function of times (M,) and values (at least len(z), M) that returns the outputs as (len(outputs), M)."""
    names = list(numbers)
    function = sympy.lambdify([time, *z, *names], list(outputs), modules="numpy", cse=True)
    constants = [numbers[name] for name in names]

    def evaluate(t: Array, y: Array) -> Array:
        results = function(t, *y[: len(z)], *constants)
        return np.array([np.broadcast_to(result, t.shape) for result in results], dtype=float)

    return evaluate


def _interpolated_guess(model: Model, system: _BoundaryValueProblem, slopes: bool) -> Trajectory:
    """The problem's guess, or straight lines between the end values; a free end takes the other end's value."""
    s = np.linspace(0.0, 1.0, 101)
    first = np.where(np.isnan(system.start_values), system.end_values, system.start_values)
    last = np.where(np.isnan(system.end_values), first, system.end_values)
    x = np.nan_to_num(np.outer(1.0 - s, first) + np.outer(s, last))
    t, half = s * system.duration, system.count // 2
    for symbol, expression in model.guess:
        if symbol in model.coordinates:
            column = _vectorised(model.time, [], system.numbers, [expression])(t, x.T)
            x[:, model.coordinates.index(symbol)] = column[0]
    if slopes and model.form == "lagrangian":
        # Velocities that belong to the path, rather than to the ends, lead to the optimum near the path.
        x[:, half:] = np.gradient(x[:, :half], t, axis=0)
    return t, x, np.zeros_like(x)


def _checked_guess(system: _BoundaryValueProblem, t: Array, x: Array, psi: Array) -> tuple[Array, Array]:
    t, x, psi = (np.asarray(part, dtype=float) for part in (t, x, psi))
    wanted = (t.size, system.count)
    if t.ndim != 1 or t.size < 2 or x.shape != wanted or psi.shape != wanted or not np.all(np.diff(t) > 0.0):
        raise NumericsError(
            f"the guess has shapes {t.shape}, {x.shape}, {psi.shape}", f"give increasing t (M,), x and psi {wanted}"
        )
    return (t - t[0]) / (t[-1] - t[0]), np.vstack([x.T, psi.T, np.zeros((1, t.size))])


def _continued(system: _BoundaryValueProblem) -> Any:
    """Move the end values from those of the uncontrolled motion to the wanted ones, in steps that adapt."""
    count = system.count
    y0 = np.concatenate([np.nan_to_num(system.start_values), np.zeros(count + 1)])
    s = np.linspace(0.0, 1.0, 101)
    with np.errstate(all="ignore"):
        motion = solve_ivp(
            lambda s, y: np.append(system.rates(np.array([s]), y[:, None])[:count, 0], np.zeros(count + 1)),
            (0.0, 1.0),
            y0,
            t_eval=s,
            rtol=1e-8,
            atol=1e-10,
        )
    if not motion.success or not np.all(np.isfinite(motion.y)):
        return None
    y, origin, done, advance = motion.y, motion.y[:count, -1], 0.0, 0.25
    while done < 1.0:
        share = min(1.0, done + advance)
        ends = origin + share * (system.end_values - origin)
        solution = system.solve(s, y, ends, _FIRST_TOLERANCE)
        if solution.success:
            s, y, done, advance = solution.x, solution.y, share, 2.0 * advance
        elif advance < _SMALLEST_ADVANCE:
            return None
        else:
            advance *= 0.4
    return solution
