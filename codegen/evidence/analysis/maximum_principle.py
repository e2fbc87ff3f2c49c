"""Pontryagin's necessary conditions of a control problem, derived symbolically.

The state x holds the coordinates and their rates. With the dynamics x' = f(x, u, t), the cost rate C(x, u, t) and the
costate psi, the Hamiltonian is C + psi.f, and an optimum satisfies

    x' = f,    psi' = -dH/dx,    0 = dH/du,    psi_i = 0 at an end that leaves x_i free.

Source: Pontryagin, Boltyanskii, Gamkrelidze and Mishchenko (1962); Bryson and Ho, Applied optimal control, chapter 2.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import mpmath
import numpy as np
import sympy
from numpy.typing import NDArray
from scipy.integrate import solve_bvp, solve_ivp
from scipy.optimize import OptimizeResult
from sympy.solvers.ode.systems import matrix_exp

from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.model.definitions import Boundary, Model
from codegen.discretise.model.legendre import new_symbols, solve_blocks
from codegen.errors import ArgumentError, BoundaryError, DegenerateError, NumericsError
from codegen.evidence.analysis.modified_equations import vector_field
from codegen.symbolic import checks as expressions


@dataclass(frozen=True)
class NecessaryConditions:
    """The boundary value problem of an optimum; tuples are in the order of `states` = (coordinates, rates).

    `dynamics` and `hamiltonian` contain the controls; `optimal_control`, `state_rates`, `costate_rates` and `cost_rate`
    do not. `start` and `end` are expressions that vanish, one for each state.
    """

    model: Model
    states: tuple[sympy.Symbol, ...]
    costates: tuple[sympy.Symbol, ...]
    dynamics: tuple[sympy.Expr, ...]
    hamiltonian: sympy.Expr
    optimal_control: tuple[sympy.Expr, ...]
    state_rates: tuple[sympy.Expr, ...]
    costate_rates: tuple[sympy.Expr, ...]
    cost_rate: sympy.Expr
    start: tuple[sympy.Expr, ...]
    end: tuple[sympy.Expr, ...]


def beyond_maximum_principle(model: Model) -> str:
    """Return a text: the features of a problem that the necessary conditions do not cover; empty if there are none."""
    features = {
        "several phases": bool(model.phases),
        "values of the past": bool(model.joined),
        "a first-order system": model.form == "first-order",
        "bounds": bool(model.bounds),
        **dict.fromkeys((kind.words for kind in CONDITIONS if kind.of_model(model)), True),
        "a terminal cost": model.terminal_cost != 0,
        "free parameters": bool(model.free_parameters),
        "several bodies": model.bodies > 1,
        "no controls": not model.controls,
    }
    return ", ".join(name for name, present in features.items() if present)


def necessary_conditions(model: Model) -> NecessaryConditions:
    """Derive the necessary conditions of a control problem in its own form (Lagrangian or Hamiltonian).

    Raises ArgumentError if the problem has no cost, or a feature that these conditions do not cover. Raises SymbolError
    if a name `psi_<state>` is taken, and DegenerateError if dH/du = 0 does not determine the controls.
    """
    if model.cost is None or model.end is None:
        raise ArgumentError(f"{model.name} is no control problem", "return codegen.Control(...) from problem()")
    beyond = beyond_maximum_principle(model)
    if beyond:
        raise ArgumentError(
            f"{model.name} has {beyond}, for which the maximum principle is not derived",
            "take its reference from a finer grid instead",
        )
    states = (*model.coordinates, *model.rates)
    costates = new_symbols(model, "psi_", states)
    dynamics = dynamics_of(model)
    hamiltonian = model.cost + sum((psi * f for psi, f in zip(costates, dynamics, strict=True)), sympy.S.Zero)
    optimal = _optimal_control(model, hamiltonian)
    substitution = dict(zip(model.controls, optimal, strict=True))
    return NecessaryConditions(
        model=model,
        states=states,
        costates=costates,
        dynamics=dynamics,
        hamiltonian=hamiltonian,
        optimal_control=optimal,
        state_rates=tuple(f.xreplace(substitution) for f in dynamics),
        costate_rates=tuple(-hamiltonian.diff(x).xreplace(substitution) for x in states),
        cost_rate=model.cost.xreplace(substitution),
        start=_end_equations(states, costates, model.start),
        end=_end_equations(states, costates, model.end),
    )


def dynamics_of(model: Model) -> tuple[sympy.Expr, ...]:
    """Return the time derivatives of all states: coordinates, then rates by the forced Euler-Lagrange equations."""
    if model.form == "first-order":
        return tuple(model.dynamics)
    if model.form == "hamiltonian":
        return tuple(vector_field(model))
    function, q, rates = model.function, model.coordinates, model.rates
    momenta = [function.diff(v) for v in rates]
    right = [
        function.diff(x) + f - p.diff(model.time) - sum(p.diff(y) * v for y, v in zip(q, rates, strict=True))
        for x, f, p in zip(q, model.force, momenta, strict=True)
    ]
    return (*rates, *solve_blocks(sympy.hessian(function, rates), right))


def _optimal_control(model: Model, hamiltonian: sympy.Expr) -> tuple[sympy.Expr, ...]:
    """Return the controls that solve dH/du = 0."""
    stationarity = [hamiltonian.diff(u) for u in model.controls]
    curvature = sympy.Matrix(stationarity).jacobian(list(model.controls)).applyfunc(sympy.expand)
    names = " ".join(map(str, model.controls))
    if not curvature.has(*model.controls):
        off = dict.fromkeys(model.controls, sympy.S.Zero)
        try:
            return solve_blocks(curvature, [-slope.xreplace(off) for slope in stationarity])
        except DegenerateError:
            raise DegenerateError(
                f"the cost does not determine {names}", "add a term to it that grows with the square of each control"
            ) from None
    try:
        solutions = sympy.solve(stationarity, list(model.controls), dict=True)
    except NotImplementedError:
        solutions = []
    complete = [solution for solution in solutions if set(solution) == set(model.controls)]
    if len(complete) != 1:
        raise DegenerateError(
            f"stationarity has {len(complete) or 'no'} closed solutions for {names}", "make the cost quadratic in it"
        )
    return tuple(complete[0][u] for u in model.controls)


def _end_equations(
    states: Sequence[sympy.Symbol], costates: Sequence[sympy.Symbol], boundary: Boundary
) -> tuple[sympy.Expr, ...]:
    values = (*boundary.positions, *boundary.rates)
    return tuple(psi if v is None else x - v for x, psi, v in zip(states, costates, values, strict=True))


def parameter_values(model: Model, values: Mapping[str, float] | None) -> dict[sympy.Symbol, float]:
    """Return all parameters by symbol; `values` override defaults by name. Raise ArgumentError for unknown names."""
    symbols = {parameter.name: parameter for parameter in model.parameters}
    for name in values or {}:
        if name not in symbols:
            raise ArgumentError(f"{model.name} has no parameter {name}", f"use one of {', '.join(symbols) or 'none'}")
    return model.default_values | {symbols[name]: float(value) for name, value in (values or {}).items()}


_SIMPLIFY_LIMIT = 600


@dataclass(frozen=True)
class ExactOptimum:
    """The optimum in closed form: the cost in terms of parameters, and states and controls also in terms of time."""

    model: Model
    cost: sympy.Expr
    states: tuple[sympy.Expr, ...]
    controls: tuple[sympy.Expr, ...]

    def cost_at(self, values: Mapping[str, float] | None = None) -> float:
        """Return the cost as a number; `values` override defaults by name. Raises ArgumentError for an unknown name."""
        numbers = parameter_values(self.model, values)
        function = sympy.lambdify(list(numbers), self.cost, modules="mpmath", cse=True)
        with mpmath.workdps(40):
            # Complex conjugate eigenvalues may leave an imaginary part, which is a rounding error.
            return float(mpmath.re(function(*map(mpmath.mpf, numbers.values()))))


def exact_optimum(model: Model) -> ExactOptimum | None:
    """Solve the necessary conditions in closed form if they are linear with constant coefficients; else return None.

    The result is also None if the eigenvalues have no practical formula by radicals. Raises the errors of
    `necessary_conditions`, and BoundaryError if the boundary conditions do not determine the trajectory.

    With z = (x, psi) the Hamiltonian at the optimal controls is K = z.Sz/2 + g.z + c, and z' = J dK/dz. Integration of
    d(psi.x)/dt = psi.dK/dpsi - x.dK/dx and K = C + psi.x' gives the cost without quadrature:
    J = (psi(0).x(0) - psi(T).x(T))/2 + integral of g.z/2 + cT, and g.z is integrated by one more linear equation.
    """
    conditions = necessary_conditions(model)
    z = [*conditions.states, *conditions.costates]
    substitution = dict(zip(model.controls, conditions.optimal_control, strict=True))
    eliminated = conditions.hamiltonian.xreplace(substitution)
    # Nonzero third differences along a line, in 60 digits, show that K is not quadratic in z. The expansion of a long
    # expression would show the same, but takes a minute.
    numbers = model.default_values | {model.time: 0.37}
    evaluate = sympy.lambdify([*z, *numbers], eliminated, modules="mpmath", cse=True)
    with mpmath.workdps(60):
        begin = [mpmath.mpf(3 + 2 * i) / 17 for i in range(len(z))]
        slopes = [mpmath.mpf(5 + 7 * i % 11) / 23 for i in range(len(z))]
        data = [mpmath.mpf(value) for value in numbers.values()]
        values = [evaluate(*(a + k * b for a, b in zip(begin, slopes, strict=True)), *data) for k in range(4)]
        difference = abs(values[3] - 3 * values[2] + 3 * values[1] - values[0])
        if difference > mpmath.mpf(10) ** -40 * max(abs(value) for value in values):
            return None
    reduced = sympy.expand(eliminated)
    at_zero = dict.fromkeys(z, sympy.S.Zero)
    gradient = sympy.Matrix([reduced.diff(symbol) for symbol in z])
    hessian = gradient.jacobian(z).applyfunc(sympy.cancel)
    if hessian.has(*z, model.time) or reduced.has(model.time):
        return None
    slope, half = gradient.xreplace(at_zero), len(conditions.states)
    # Unknowns of the linear flow: z, and, when g is not zero, the constant 1 and the integral of g.z.
    flow = sympy.zeros(2 * half + 2)
    flow[:half, : 2 * half], flow[:half, 2 * half] = hessian[half:, :], slope[half:, :]
    flow[half : 2 * half, : 2 * half], flow[half : 2 * half, 2 * half] = -hessian[:half, :], -slope[:half, :]
    flow[2 * half + 1, : 2 * half] = slope.T
    if slope.is_zero_matrix:
        flow = flow[: 2 * half, : 2 * half]
    # The solution w(t) of w' = flow w that satisfies the end equations, if exp(flow t) has a practical formula.
    eigenvalue = sympy.Dummy("s")
    factors = sympy.factor_list(flow.charpoly().as_expr(eigenvalue), eigenvalue)[1]
    quartic = [(factor, count) for factor, count in factors if sympy.degree(factor, eigenvalue) > 2]
    # One simple quartic without parameters is still practical; sympy stalls for more nested radicals.
    if len(quartic) > 1 or any(
        count > 1 or sympy.degree(factor, eigenvalue) > 4 or factor.free_symbols != {eigenvalue}
        for factor, count in quartic
    ):
        return None
    # Positive symbols help sympy to find real formulas, which are analytic and so hold for other signs as well.
    signed = {p: sympy.Dummy(p.name, positive=True) for p, v in model.default_values.items() if v > 0.0}
    plain = {dummy: p for p, dummy in signed.items()}
    exponential = matrix_exp(flow.xreplace(signed), model.time).xreplace(plain)
    initial = sympy.Matrix([*z, 1, 0][: flow.rows])
    final = exponential.subs(model.time, model.duration) * initial
    at_end = dict(zip(z, final[: 2 * half], strict=True))
    equations = [*conditions.start, *(equation.xreplace(at_end) for equation in conditions.end)]
    matrix = sympy.Matrix(equations).jacobian(z)
    if expressions.null_direction([expressions.values_at(matrix, model.default_values)]) is not None:
        raise BoundaryError("the boundary conditions do not determine the optimum", "fix or free other end values")
    constants = solve_blocks(matrix, [-equation.xreplace(at_zero) for equation in equations])
    solution = exponential * sympy.Matrix([*constants, 1, 0][: flow.rows])
    first, last = (solution.subs(model.time, instant) for instant in (sympy.S.Zero, model.duration))
    boundary_term = [(w[:half, :].T * w[half : 2 * half, :])[0] for w in (first, last)]
    integral = sympy.S.Zero if slope.is_zero_matrix else last[2 * half + 1]
    cost = (boundary_term[0] - boundary_term[1] + integral) / 2 + reduced.xreplace(at_zero) * model.duration
    trajectory = dict(zip(z, solution[: 2 * half], strict=True))
    return ExactOptimum(
        model=model,
        cost=sympy.simplify(cost) if cost.count_ops() < _SIMPLIFY_LIMIT else cost,
        states=tuple(solution[:half]),
        controls=tuple(u.xreplace(trajectory) for u in conditions.optimal_control),
    )


Array = NDArray[np.float64]
Trajectory = tuple[Array, Array, Array]

_FIRST_TOLERANCE = 1e-4
_LEAST_TOLERANCE = 1e-12
_SMALLEST_ADVANCE = 1e-3


@dataclass(frozen=True)
class Reference:
    """An optimum at times `t` (M,), for n coordinates and m controls: states and costates (M, 2n), controls (M, m).

    `residual` is the largest root mean square defect of the differential equations on any mesh interval, in time from
    0 to 1. Each defect is relative to 1 + |derivative| and in units of the largest value of its unknown.
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

    Parameters
    ----------
    model : Model
        A control problem that the maximum principle covers.
    values : Mapping[str, float], optional
        Overrides of default parameters by name.
    tolerance : float
        Relative tolerance of the collocation, from 1e-12 to 1.
    guess : tuple of arrays, optional
        (t, x, psi) of shapes (M,), (M, 2n), (M, 2n). By default coordinates are interpolated linearly between their end
        values, or follow the problem's own guess. Velocities are the slopes of coordinates; if this fails they are
        interpolated, as momenta are. psi is zero. If nothing converges, the end values move continuously from the end
        of the uncontrolled motion to the prescribed values.
    seconds : float
        Limit of processor time.

    Returns
    -------
    Reference
        A stationary trajectory, which may be one of several local optima.

    Raises
    ------
    ArgumentError
        For an unknown parameter or an unusable tolerance.
    NumericsError
        If nothing converges within the time limit.
    """
    if not _LEAST_TOLERANCE <= tolerance < 1.0:
        raise ArgumentError(f"tolerance is {tolerance:g}", f"give one from {_LEAST_TOLERANCE:g} to 1")
    conditions = necessary_conditions(model)
    system = _BoundaryValueProblem(conditions, parameter_values(model, values), seconds)
    guesses = [_interpolated_guess(model, system, slopes) for slopes in (True, False)] if guess is None else [guess]
    for parts in guesses:
        t, x, psi = (np.asarray(part, dtype=float) for part in parts)
        expected = (t.size, system.count)
        if t.ndim != 1 or t.size < 2 or x.shape != expected or psi.shape != expected or not np.all(np.diff(t) > 0.0):
            raise NumericsError(
                f"the guess has shapes {t.shape}, {x.shape}, {psi.shape}",
                f"give increasing t (M,), x and psi {expected}",
            )
        y = np.vstack([x.T, psi.T, np.zeros((1, t.size))])
        solution = system.solve((t - t[0]) / (t[-1] - t[0]), y, system.end_values, _FIRST_TOLERANCE)
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
        controls=system.controls(solution.x * system.duration, solution.y).T,
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
        self.controls = _vectorised(model.time, z, numbers, conditions.optimal_control)
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

    def rates(self, s: Array, y: Array) -> Array:
        return self.duration * self._rates(s * self.duration, y)

    def solve(self, s: Array, y: Array, end_values: Array, tolerance: float) -> OptimizeResult:
        """Run solve_bvp from mesh s and guess y, which also sets the scales of unknowns. Free `end_values` are nan."""
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
    """Return a function of times (M,) and values (at least len(z), M) that returns an array (len(outputs), M)."""
    names = list(numbers)
    function = sympy.lambdify([time, *z, *names], list(outputs), modules="numpy", cse=True)
    constants = [numbers[name] for name in names]

    def evaluate(t: Array, y: Array) -> Array:
        results = function(t, *y[: len(z)], *constants)
        return np.array([np.broadcast_to(result, t.shape) for result in results], dtype=float)

    return evaluate


def _interpolated_guess(model: Model, system: _BoundaryValueProblem, slopes: bool) -> Trajectory:
    """Return the problem's guess, or lines between end values; with `slopes`, velocities are slopes of coordinates."""
    # The value at a free end is the value at the other end.
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
        # Velocities along the path, not interpolated end velocities, lead to the optimum near the path.
        x[:, half:] = np.gradient(x[:, :half], t, axis=0)
    return t, x, np.zeros_like(x)


def _continued(system: _BoundaryValueProblem) -> OptimizeResult | None:
    """Return a solution by adaptive continuation of end values from the uncontrolled motion to the problem, or None."""
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
