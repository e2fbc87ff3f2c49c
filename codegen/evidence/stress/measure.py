"""The measurement of one case on a loaded module: solve, evaluate the equations again, and compute the error.

A reference is a function (module, case, result) -> error, relative to the natural size of the compared quantity. The
references are closed forms, or adaptive codes of scipy if no closed form exists.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from codegen.discretise.schemes import find
from codegen.discretise.schemes.base import FIRST_ORDER
from codegen.evidence.stress import systems
from codegen.evidence.stress.cases import VIOLATIONS, Case, Measurement, Values
from codegen.evidence.stress.motions import registered
from codegen.evidence.stress.own import largest_stable
from codegen.evidence.stress.problems import defaults, field_of
from codegen.problem.points import PointSet
from codegen.solving import api
from codegen.solving.drivers import task_of
from codegen.solving.loading import GeneratedModule, Grid, Vector
from codegen.solving.results.result import Result

SAME = 1e-6  # the largest relative difference of the costs of one optimum
REPEATS, QUICK = 3, 0.2  # further solves for the time of a user's own problem, if one takes less than QUICK seconds
FINER = 8  # the ratio of numbers of intervals of a reference by the same scheme


def measure(module: ModuleType, case: Case) -> Measurement:
    """Solve a case and return its measurement; the solver's CodegenError is not caught."""
    varied = _with_values(module, case)
    points = None
    if case.points:
        table = np.array(case.points, dtype=float)
        half = table.shape[1] // 2
        points = PointSet(table[:, :half], table[:, half:], np.zeros(len(table)))

    def solve(tried: GeneratedModule, steps: int, every: int = case.every) -> Result:
        known: dict[str, Any] = {"every": every, "doublings": case.doublings}
        options = {name: value for name, value in known.items() if name in task_of(module).options}
        return api.solve(tried, case.driver, points=points, steps=steps, **options)

    begin = time.thread_time()
    result = solve(varied, case.steps)
    seconds = time.thread_time() - begin
    for _ in range(REPEATS if case.truth is not None and seconds < QUICK else 0):  # schemes are compared by their times
        begin = time.thread_time()
        solve(varied, case.steps)
        seconds = min(seconds, time.thread_time() - begin)
    estimate = result.summary.get("cost_error_estimate", math.nan)
    answer = (result.q, result.p, result.u, result.unknowns, result.cost)
    residual, tolerance = VIOLATIONS[result.task](varied, case, result)
    announced = estimate / abs(result.cost) if result.cost else estimate
    error, others, stable = math.nan, 0, math.nan
    failures = int(result.summary.get("attempts", 1)) - int(result.solved)
    if case.guesses:
        plain = api.solve(module, case.driver, steps=case.steps)
        tried = [solve(_with_values(module, case, seed), case.steps) for seed in range(case.guesses)]
        costs = np.array([one.cost for one in tried if one.solved], dtype=float) / abs(plain.cost or 1.0)
        changes = costs - (plain.cost or 0.0) / abs(plain.cost or 1.0)
        failures, others = case.guesses - costs.size, int((np.abs(changes) > SAME).sum())
        lower = min(0.0, float(changes.min(initial=0.0)))
        error, residual = (lower if lower < -SAME else failures / case.guesses), 0.0
    elif case.reference == "refined" and result.solved:
        finer = solve(varied, FINER * case.steps, every=FINER * case.every)
        error = refined(result, finer)
        if result.error is not None and result.error.cost is not None:
            announced = result.error.cost
        elif result.task != "control":  # the change from half as many steps exceeds the error from first order on
            announced = refined(solve(varied, max(1, case.steps // 2)), solve(varied, case.steps, every=2 * case.every))
    elif case.reference and result.solved:
        error = REFERENCES[case.reference](varied, case, result)
    if case.limit:
        stable = systems.stable_limit(module, case) if case.truth is None else largest_stable(module, case.truth)
    return Measurement(
        status=result.status,
        message=result.message,
        finite=all(a is None or bool(np.isfinite(a).all()) for a in answer),
        error=error,
        announced=announced,
        residual=residual,
        tolerance=tolerance,
        textbook=systems.textbook_errors(varied, case, result) if case.textbook and result.solved else math.nan,
        drift=_drift(case, result),
        has_energy=result.energy is not None,
        stable_below=stable,
        failures=failures,
        others=others,
        iterations=result.iterations,
        seconds=seconds,
    )


def _with_values(module: ModuleType, case: Case, seed: int = 1) -> Any:
    """Return a copy of the module with the case's values as default arguments, and with a noisy initial guess."""
    values = _as_keywords(case.values)
    varied = ModuleType(module.__name__)
    vars(varied).update(vars(module))
    for name in ("make_grid", "solve", "nlp", "make_case"):
        original = getattr(module, name, None)
        if original is not None:
            setattr(varied, name, lambda *args, _call=original, **more: _call(*args, **{**values, **more}))
    if case.noise:
        # Reproducible noise on every free primal unknown of the initial guess, relative to its size or to one.
        guessed, solved = varied.initial_guess, varied.solve

        def initial_guess(grid: Grid) -> Vector:
            free, guess = varied.primal_unknowns(grid), np.array(guessed(grid))
            size = np.maximum(1.0, np.abs(guess[free]))
            guess[free] += case.noise * size * np.random.default_rng(seed).standard_normal(free.size)
            return guess

        def solve(steps: int, guess: Vector | None = None, **more: object) -> object:
            start = initial_guess(varied.make_grid(steps)) if guess is None else guess
            return solved(steps=steps, guess=start, **more)

        vars(varied).update({"initial_guess": initial_guess, "solve": solve})
    return varied


def _as_keywords(values: Values) -> dict[str, object]:
    """Return keyword arguments; tuples of names and values become dictionaries, tuples of numbers become arrays."""

    def plain(value: object) -> object:
        if not isinstance(value, tuple):
            return value
        is_table = bool(value) and all(isinstance(v, tuple) and len(v) == 2 and isinstance(v[0], str) for v in value)
        return _as_keywords(value) if is_table else np.array(value, dtype=float)

    return {name: plain(value) for name, value in values}


def _drift(case: Case, result: Result) -> float:
    """Return the largest change of energy relative to its first value or to the masses' weight; NaN without energy."""
    if result.energy is None:
        return math.nan
    energy = np.asarray(result.energy, dtype=float)
    scale = abs(float(energy[0]))
    if case.truth is not None:  # the energy is relative to its parts, and momenta may be constant
        if case.truth.sizes.size == 0:
            return math.nan
        states = np.hstack([result.q, result.p])
        changes = [np.abs(states - states[0])[:, case.truth.conserved] / case.truth.sizes[case.truth.conserved]]
        if case.truth.energy > 0.0:
            changes.append(np.abs(energy - energy[0])[:, None] / case.truth.energy)
        largest = max((float(change.max()) for change in changes if change.size), default=math.nan)
        return largest if np.isfinite(states).all() else math.inf
    values = _parameters(case)
    match case.setup.problem:
        case "pendulum_chain":
            scale = max(scale, float(values["heavy"]), float(values["light"]))
        case "rod_chain":
            scale = max(scale, 21.0)  # unit weights that can fall by 1, 2, ... 6
        case "spring_pendulum":
            scale = max(scale, 1.0)
    if result.task == "simulate" and not np.isfinite(energy).all():
        return math.inf
    return float(np.abs(energy - energy[0]).max() / scale) if scale > 0.0 else math.nan


def _parameters(case: Case) -> dict[str, Any]:
    """Return the parameters of a case: the values of the problem file, or the case's own values."""
    return {**defaults(case.setup.problem), **dict(case.values)}


# ---- References ----


def exact_motion(module: ModuleType, case: Case, result: Result) -> float:
    """Return the largest error against the exact motion of a user's own problem, relative to sizes of components."""
    truth = case.truth
    assert truth is not None
    near = np.abs(np.subtract.outer(result.t, truth.times)).argmin(axis=1)
    is_there = np.abs(truth.times[near] - result.t) <= 1e-9 * truth.times[-1]
    errors = (np.hstack([result.q, result.p]) - truth.states[near]) / truth.sizes
    return float(np.abs(errors[is_there]).max())


def refined(result: Result, finer: Result) -> float:
    """Return the relative error of the cost, or without a cost of the positions, against a result on a finer grid."""
    if not finer.solved:
        return math.nan
    if result.cost is not None and finer.cost is not None:
        return _relative(result.cost, finer.cost)
    return float(np.abs(result.q - finer.q).max() / np.abs(finer.q).max())


def oscillator(module: ModuleType, case: Case, result: Result) -> float:
    """Return the error against q = cos(omega t), p = -omega sin(omega t), times the amplitude."""
    omega = _parameters(case).get("omega", 1.0)
    amplitude = float(result.q[0, 0])
    q, p = np.cos(omega * result.t), -omega * np.sin(omega * result.t)
    errors = np.abs(result.q[:, 0] / amplitude - q), np.abs(result.p[:, 0] / amplitude - p) / omega
    return float(max(error.max() for error in errors))


def stable_step(module: ModuleType, case: Case, result: Result) -> float:
    """Return the relative difference between the largest stable steps by bisection and by the scheme's coefficients."""
    measured, exact = systems.stable_limit(module, case), systems.limit(registered((result.method, result.scheme)))
    if measured == exact:
        return 0.0
    return abs(measured / exact - 1.0) if math.isfinite(exact) and exact else math.inf


def discrete_oscillator(module: ModuleType, case: Case, result: Result) -> float:
    """Return the error against the closed form of the scheme, which follows from its coefficients."""
    h = result.t[-1] / result.steps
    theta, sine = systems.turn(registered((result.method, result.scheme)), h * _parameters(case).get("omega", 1.0))
    k = np.round(result.t / h)
    exact = np.cos(k * theta) + sine * np.sin(k * theta)
    return float(np.abs(result.q[:, 0] / result.q[0, 0] - exact).max())


def kepler(module: ModuleType, case: Case, result: Result) -> float:
    """Return the error of the last position; with unit semi-major axis, Kepler's equation is E - e sin E = pi + t."""
    e = float(result.q[0, 0]) - 1.0
    mean = np.mod(math.pi + result.t, 2.0 * math.pi)
    anomaly = np.where(e > 0.8, math.pi, mean)
    for _ in range(200):
        anomaly = anomaly - (anomaly - e * np.sin(anomaly) - mean) / (1.0 - e * np.cos(anomaly))
    x, y = e - np.cos(anomaly), -math.sqrt((1.0 - e) * (1.0 + e)) * np.sin(anomaly)
    return float(np.abs(result.q - np.stack([x, y], axis=1))[-1].max())


def by_integration(module: ModuleType, case: Case, result: Result) -> float:
    """Return the error against DOP853 at tolerance 1e-12; momenta are relative to the largest momentum."""
    count = result.q.shape[1]
    exact = _integrated(_field(case), np.concatenate([result.q[0], result.p[0]]), result.t)
    of_positions = np.abs(result.q - exact[:, :count]).max()
    of_momenta = np.abs(result.p - exact[:, count:]).max() / max(1.0, np.abs(exact[:, count:]).max())
    return float(max(of_positions, of_momenta))


def rigid_pendulum(module: ModuleType, case: Case, result: Result) -> float:
    """Return the error against the limit of an infinitely stiff spring: a unit rod, horizontal and at rest at first."""
    exact = _integrated(lambda _, z: np.array([z[1], -math.sin(z[0])]), np.array([math.pi / 2.0, 0.0]), result.t)
    positions = np.stack([np.sin(exact[:, 0]), -np.cos(exact[:, 0])], axis=1)
    return float(np.abs(result.q - positions).max())


def chain(module: ModuleType, case: Case, result: Result) -> float:
    """Return the error of the angles of a chain at rest at first, against DOP853 at tolerance 1e-12."""
    count = result.q.shape[1]
    exact = _integrated(_field(case), np.concatenate([result.q[0], np.zeros(count)]), result.t)
    return float(np.abs(result.q - exact[:, :count]).max())


def _field(case: Case) -> Callable[[float, Vector], Vector]:
    rates, values = field_of(case.setup.problem), _parameters(case)
    return lambda _, state: np.asarray(rates(values, state))


def _integrated(field: Callable[[float, Vector], Vector], start: Vector, t: Vector) -> Vector:
    solution = solve_ivp(field, (t[0], t[-1]), start, method="DOP853", t_eval=t, rtol=1e-12, atol=1e-13)
    return solution.y.T if solution.success else np.full((len(t), len(start)), np.nan)


def two_bodies(module: ModuleType, case: Case, result: Result) -> float:
    """Return the error, relative to the distance d, against a circle with omega = sqrt(G (m1 + m2)/d^3)."""
    masses = dict(case.values).get("m", (1.0, 0.001))
    relative = result.q[:, 2:] - result.q[:, :2]
    distance = float(np.linalg.norm(relative[0]))
    angle = math.sqrt(sum(masses) / distance**3) * result.t
    return float(np.abs(relative / distance - np.stack([np.cos(angle), np.sin(angle)], axis=1)).max())


def regulator(module: ModuleType, case: Case, result: Result) -> float:
    """Return the relative error of the cost against the closed form J.

    J = eps^2/2 (l ((x0^2 + x1^2) coth(l T) - 2 x0 x1/sinh(l T)) + a (x1^2 - x0^2)), l^2 = a^2 + 1/eps^2.
    """
    values = _parameters(case)
    a, eps, T, x0, x1 = (values[name] for name in ("a", "eps", "T", "begin", "goal"))
    rate = math.hypot(a, 1.0 / eps)
    z = rate * T
    coth, inverse_sinh = 1.0 / math.tanh(z), 1.0 / math.sinh(z) if z < 700.0 else 0.0
    curved = rate * ((x0 * x0 + x1 * x1) * coth - 2.0 * x0 * x1 * inverse_sinh)
    return _relative(result.cost, eps**2 / 2.0 * (curved + a * (x1 * x1 - x0 * x0)))


def cubic_regulator(module: ModuleType, case: Case, result: Result) -> float:
    """Return the cost error; for long times J = F(1) + F(9/4) + (81/16 - 1)/2, F(y) = (y sqrt(1 + y^2) + asinh y)/2."""
    first, last = ((y * math.hypot(1.0, y) + math.asinh(y)) / 2.0 for y in (1.0, 2.25))
    return _relative(result.cost, first + last + (81.0 / 16.0 - 1.0) / 2.0)


def short_turn(module: ModuleType, case: Case, result: Result) -> float:
    """Return the cost error against 12 (angle)^2/T^3 N^2/(N^2 - 1), the least cost by midpoint without gravity.

    The torque is linear in time on N intervals, where sum of (k + 1/2 - N/2)^2 = N (N^2 - 1)/12.
    """
    values = _parameters(case)
    exact = 12.0 * (values["goal"] - values["begin"]) ** 2 / values["T"] ** 3
    return _relative(result.cost, exact * result.steps**2 / (result.steps**2 - 1.0))


def walled_cart(module: ModuleType, case: Case, result: Result) -> float:
    """Return the cost error against 4/(9 wall)."""
    return _relative(result.cost, 4.0 / (9.0 * dict(case.values)["wall"]))


def other_units(module: ModuleType, case: Case, result: Result) -> float:
    """Return the error of cost, radii and thrusts against the transfer in units of one.

    Thrusts scale with m GM r^-2, costs with m^2 GM^(3/2) r^(-5/2).
    """
    values = _parameters(case)
    m, GM, r0 = values["m"], values["GM"], values["r0"]
    plain = module.solve(result.steps, m=1.0, GM=1.0, r0=1.0, r1=1.2)
    thrust, radius = result.u / (m * GM / r0**2), result.q[:, 0] / r0
    return max(
        _relative(result.cost, plain.cost * m**2 * GM**1.5 * r0**-2.5),
        float(np.abs(radius - plain.q[:, 0]).max()),
        float(np.abs(thrust - plain.u).max() / np.abs(plain.u).max()),
    )


def by_table(module: ModuleType, case: Case, result: Result) -> float:
    """Return the difference from the table's steps, relative to the largest of the motion."""
    values = dict(case.values)
    exact = systems.followed(find(result.scheme, FIRST_ORDER), values["rate"], result.steps, 2.0)
    return float(np.abs(result.q[:, 0] - exact).max() / np.abs(exact).max())


def slow_motion(module: ModuleType, case: Case, result: Result) -> float:
    """Return the largest difference from cos t."""
    return float(np.abs(result.q[:, 0] - np.cos(result.t)).max())


def by_radau(module: ModuleType, case: Case, result: Result) -> float:
    """Return the largest error of a component at the end, relative to its largest value on the motion."""
    t = result.t
    if case.setup.problem == "actuator":
        matrix = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [0.0, 0.0, -1e9, 1e9], [0.0, 0.0, 0.0, 0.0]])
        exact = (expm(t[-1] * matrix) @ np.array([0.0, 0.0, 0.0, 1.0]))[:3]
    else:
        options = {"rtol": 1e-10, "atol": 1e-15}
        exact = solve_ivp(_field(case), (0.0, t[-1]), result.q[0], "Radau", **options).y[:, -1]
    return float((np.abs(result.q[-1] - exact) / np.abs(result.q).max(axis=0)).max())


def single_landmark(module: ModuleType, case: Case, result: Result) -> float:
    """Return the cost error; J = 2 artanh(|y - x|/|1 - conj(x) y|)^2, squared distance for 2 |dq|^2/(1 - |q|^2)^2."""
    x0, y0, x1, y1 = case.points[0]
    start, target = complex(x0, y0), complex(x1, y1)
    exact = 2.0 * math.atanh(abs((target - start) / (1.0 - start.conjugate() * target))) ** 2
    return _relative(result.cost, exact)


def reintegrated(module: ModuleType, case: Case, result: Result) -> float:
    """Return the largest miss of the targets by DOP853 with the computed momenta, on equations written by hand."""
    shape = (len(case.points), 2)
    count = 2 * shape[0]

    def field(_: float, z: Vector) -> Vector:
        by_position, by_momentum = systems.plate_gradient(z[:count].reshape(shape), z[count:].reshape(shape))
        return np.concatenate([by_momentum.ravel(), -by_position.ravel()])

    start = np.concatenate([result.q[0], result.p[0]])
    exact = _integrated(field, start, result.t[[0, -1]])[-1, :count].reshape(shape)
    return float(np.abs(exact - np.array(case.points)[:, 2:]).max())


def at_rest(module: ModuleType, case: Case, result: Result) -> float:
    """Return the larger of the cost and the largest displacement, which both vanish at rest."""
    return max(abs(result.cost or 0.0), float(np.abs(result.q - result.q[0]).max()))


def _relative(value: float | None, exact: float) -> float:
    """Return the relative error, or the absolute error for exact = 0."""
    if value is None or not math.isfinite(value):
        return math.inf
    return abs(value / exact - 1.0) if exact else abs(value)


REFERENCES: dict[str, Callable[[ModuleType, Case, Result], float]] = {
    function.__name__: function
    for function in (
        by_table, slow_motion, by_radau, exact_motion, oscillator, stable_step,
        discrete_oscillator, kepler, by_integration, rigid_pendulum, chain, two_bodies, regulator, cubic_regulator,
        short_turn, walled_cart, other_units, single_landmark, reintegrated, at_rest,
    )
}  # fmt: skip
"""Every reference by name; `Case.reference` is one of these names."""
