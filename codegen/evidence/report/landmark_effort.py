"""The effort of landmark registration: accuracy, routes of solution, the fastest scheme, space dimensions.

The particle ansatz m = sum_i p_i delta(x - q_i) is checked as a weak solution of the Euler-Poincare equations (thesis,
B.2), m_t + v . grad m + (grad v)' m + m div v = 0. For every test function psi, the sum of d/dt (p_i psi(q_i)) over
particles must cancel the terms with v. Only the values and slopes of psi at the particles matter. Test functions are
random polynomials, which vanish on the unit circle with their normal derivatives.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.optimize import fsolve

from codegen.evidence.report.store import Case, Settings, Store, Values, few_landmarks, smooth_pair
from codegen.solving import api
from codegen.solving.drivers import DRIVERS
from codegen.solving.drivers.shared import quiet_single_thread
from codegen.solving.loading import ConnectModule, Vector
from codegen.solving.results.result import Result

# ---- Accuracy ----

REFERENCES, TABLE, TOLERANCES, WORK = "references", "table 5.2", "tolerances", "work and precision"
EXACT = 1e-13
"""The tolerance of the reference by dop853. The thesis uses 2.24e-14 in ode113."""
THESIS_TABLE = {"midpoint": (9399.0, 1.729e-3), "lsoda 1e-02": (63.30, 2.803e-6), "explicit-euler": (19.14, 3.751e-3)}
"""Seconds and error in cost of Table 5.2; lsoda stands for Matlab's ode113 with the tolerance of the thesis."""
ROWS = ("midpoint", "lsoda 1e-02", "explicit-euler", "dop853 1e-06", "symplectic-euler", "rk4")
SCHEMES = ("explicit-euler", "symplectic-euler", "midpoint", "stormer-verlet", "rk4")


def accuracy_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Yield cases: references, the rows of Table 5.2, a sweep of tolerances, and error against time of each scheme."""
    for count in (*settings.counts, 40):
        yield Case(REFERENCES, f"nc {count}", partial(_reference, settings, count))
        if count != 40:
            yield Case(TABLE, f"lsoda 1e-06; nc {count}", partial(_adaptive, settings, "lsoda", 1e-6, count))
    for row in ROWS[:3] if settings.quick else ROWS:
        scheme, _, text = row.partition(" ")
        adaptive, stepped = partial(_adaptive, settings, scheme), partial(_stepped, settings, scheme, 10)
        yield Case(TABLE, f"{row}; nc 40", partial(adaptive, float(text), 40) if text else stepped)
    # The thesis's 1e-2, 7.5e-3, 5e-3, 2.5e-3, 1e-3 ... 1e-6, then powers of ten down to 1e-12.
    tolerances = [factor * 10.0**power for power in (-3, -4, -5, -6) for factor in (10.0, 7.5, 5.0, 2.5)]
    tolerances += [10.0**-power for power in range(6, 13)]
    for code in ("lsoda",) if settings.quick else ("lsoda", "dop853"):
        for tolerance in (1e-2, 1e-4, 1e-6) if settings.quick else tolerances:
            yield Case(TOLERANCES, f"{code} {tolerance:.1e}", partial(_adaptive, settings, code, tolerance, 40))
    if settings.quick:
        return
    for scheme in SCHEMES:
        for steps in (5, 10, 20, 40, 80):
            yield Case(WORK, f"{scheme}; N {steps}", partial(_stepped, settings, scheme, steps))


def _reference(settings: Settings, count: int) -> Values:
    result = api.solve(settings.module("dop853"), points=settings.points(count), tolerance=EXACT)
    values = {"cost": result.cost, "residual": result.residual, "status": result.status}
    return {**values, "path": result.q.reshape(result.steps + 1, -1, 2), "drift": result.summary["energy_drift"]}


def _adaptive(settings: Settings, code: str, tolerance: float, count: int) -> Values:
    result = api.solve(settings.module(code), points=settings.points(count), tolerance=tolerance, repeat=1)
    return {
        "cost": result.cost, "residual": result.residual, "seconds": result.seconds_solve, "status": result.status,
        "tolerance": tolerance,
    }  # fmt: skip


def _stepped(settings: Settings, scheme: str, steps: int) -> Values:
    result = api.solve(settings.module(scheme), points=settings.landmarks, steps=steps, repeat=5)
    return {
        "cost": result.cost, "residual": result.residual, "seconds": result.seconds_solve, "status": result.status,
        "iterations": result.iterations, "steps": steps,
    }  # fmt: skip


# ---- The particle ansatz as a weak solution ----

WEAK_SOLUTION_SECTION = "weak solution"


def weak_solution_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Yield a case for every set of landmarks: the check of the weak equation along the motion."""
    for count in (*settings.counts, 40):
        yield Case(WEAK_SOLUTION_SECTION, f"nc {count}", partial(_defects, settings, count))


def _defects(settings: Settings, count: int) -> Values:
    module, points = settings.module("explicit-euler"), settings.points(count)
    solution = module.solve(points.start, points.target, 10)
    generator, worst, size = np.random.default_rng(5), 0.0, 0.0
    for k in (0, 5, 10):
        for _ in range(5):
            coefficients = generator.normal(size=(4, 4))
            defect, rate = _weak_defect(module, solution.q[k], solution.p[k], coefficients)
            worst, size = max(worst, defect), max(size, rate)
    return {"largest defect": worst, "largest rate": size, "test functions": 15}


def _weak_defect(module: ConnectModule, q: Vector, p: Vector, coefficients: Vector) -> tuple[float, float]:
    """Return the largest component of the weak equation's left side, and of its first term; `coefficients` define psi.

    By parts, (v . grad m) psi becomes -p . (psi div v + v . grad psi). The slopes of v are central differences.
    """
    gradient, none = np.empty((2, *q.shape)), np.zeros((len(q), 0))
    module.hamiltonian_gradient(np.stack([q, p]), none, np.zeros(0), gradient)
    velocity, force = gradient[1], -gradient[0]
    step = 1e-5
    slopes = np.stack(
        [(_field(module, q, p, q + h) - _field(module, q, p, q - h)) / (2 * step) for h in step * np.eye(2)], axis=-1
    )
    # The function psi = (1 - |x|^2)^2 sum_ab c_ab x^a y^b and its gradient at positions of shape (n, 2).
    x, y = q.T
    powers = np.arange(4)
    in_x, in_y = x[:, None] ** powers, y[:, None] ** powers
    by_x = powers * x[:, None] ** np.maximum(powers - 1, 0)
    by_y = powers * y[:, None] ** np.maximum(powers - 1, 0)
    sums = [np.einsum("ia,ab,ib->i", a, coefficients, b) for a, b in ((in_x, in_y), (by_x, in_y), (in_x, by_y))]
    well = 1.0 - x**2 - y**2
    slopes_of_psi = [well**2 * s - 4.0 * well * axis * sums[0] for s, axis in zip(sums[1:], (x, y), strict=True)]
    psi, psi_slope = well**2 * sums[0], np.stack(slopes_of_psi, axis=1)
    divergence = np.trace(slopes, axis1=1, axis2=2)
    along = (psi_slope * velocity).sum(axis=1)
    rate = force.T @ psi + p.T @ along
    advected = -p.T @ (psi * divergence + along)
    stretched = np.einsum("i,ilk,il->k", psi, slopes, p)
    compressed = p.T @ (psi * divergence)
    return float(np.abs(rate + advected + stretched + compressed).max()), float(np.abs(rate).max())


def _field(module: ConnectModule, q: Vector, p: Vector, x: Vector) -> Vector:
    """Return the field v at positions x, shape (m, 2): the velocity of particles at x without momentum."""
    positions, count = np.concatenate([q, x]), len(q)
    none, matrix = np.zeros((len(positions), 0)), np.empty((len(positions),) * 2)
    module.momentum_matrix(np.stack([positions, np.zeros_like(positions)]), none, np.zeros(0), matrix)
    return matrix[count:, :count] @ p


# ---- Growth with the number of landmarks and the dimension of space ----

DIMENSION_SECTION = "dimension"
COUNTS = (5, 10, 20, 50, 100, 200)
KERNELS = (("plate", 2), ("plate", 3), ("gauss", 2), ("gauss", 3))
WIDTH = 0.15
"""The width of the Gaussian, the parameter `width_` of the module. With a wider Gaussian the kernel matrix of many
landmarks is numerically singular."""


def dimension_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Yield cases by explicit Euler, N = 10, with the Gaussian and the plate's kernel in the plane and in space."""
    for kernel, dimension in (("plate", 2),) if settings.quick else KERNELS:
        for count in COUNTS[:4] if settings.quick else COUNTS:
            name = f"{kernel} {dimension}-D; nc {count}"
            yield Case(DIMENSION_SECTION, name, partial(_grown, settings, kernel, dimension, count))


def _grown(settings: Settings, kernel: str, dimension: int, count: int) -> Values:
    arguments = {"kernel": kernel} if kernel != "plate" else {}
    arguments |= {"dimension": str(dimension)} if dimension != 2 else {}
    module = settings.module("explicit-euler", **arguments)
    points = smooth_pair(count, dimension)
    case = module.make_case(points.start, points.target, 10, **({"width_": WIDTH} if kernel == "gauss" else {}))
    solution = module.solve_case(case)
    return {
        "status": solution.status,
        "residual": solution.residual,
        "iterations": solution.iterations,
        "seconds": _least_time(partial(module.solve_case, case), 3 if count < 100 else 1),
        "seconds of a trajectory": _least_time(partial(module.trajectory, case, solution.p[0]), 20),
        "operations": list(module.metadata.operations["hamiltonian_gradient"]),
    }


def _least_time(run: Callable[[], object], repeats: int) -> float:
    """Return the least processor time of warm runs, in seconds; other work on the machine has little effect on it."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return min(times)


# ---- The effort of the midpoint rule ----

MIDPOINT_SECTION = "midpoint effort"


def midpoint_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Yield cases: the generated solve for all sets of landmarks, and the nested solve for small sets."""
    if settings.quick:
        return
    for count in (*settings.counts, 40):
        yield Case(MIDPOINT_SECTION, f"generated; nc {count}", partial(_generated, settings, count))
    for count in settings.counts:
        yield Case(MIDPOINT_SECTION, f"nested fsolve; nc {count}", partial(_nested, settings, count))


def _generated(settings: Settings, count: int) -> Values:
    values: dict[str, object] = {}
    points = settings.points(count)
    for scheme in ("midpoint", "explicit-euler"):
        module = settings.module(scheme)
        case = module.make_case(points.start, points.target, 10)
        solution = module.solve_case(case)
        values[f"{scheme} seconds"] = _least_time(partial(module.solve_case, case), 5)
        values[f"{scheme} trajectory"] = _least_time(partial(module.trajectory, case, solution.p[0]), 20)
        values[f"{scheme} cost"], values[f"{scheme} status"] = solution.cost, solution.status
    return values


def _nested(settings: Settings, count: int) -> Values:
    """Measure the thesis's method: fsolve for the initial momenta, and inside it fsolve for every implicit step."""
    module, points = settings.module("midpoint"), settings.points(count)
    case = module.make_case(points.start, points.target, 10)
    h, gradient = case.duration / case.steps, np.empty((2, *points.start.shape))

    def equations(after: Vector, before: Vector) -> Vector:
        """Return the residual of the midpoint rule, whose Jacobian fsolve approximates by differences."""
        middle = 0.5 * (before + after.reshape(before.shape))
        module.hamiltonian_gradient(middle, case.own, case.parameters, gradient)
        change = h * np.stack([gradient[1], -gradient[0]])
        return np.ravel(after.reshape(before.shape) - before - change)

    def miss(momenta: Vector) -> Vector:
        """Return the final positions minus the targets."""
        state = np.stack([points.start, momenta.reshape(points.start.shape)])
        for _ in range(case.steps):
            state = fsolve(equations, state.ravel(), args=(state,), xtol=1e-8).reshape(state.shape)
        return np.ravel(state[0] - points.target)

    first = module.first_momenta(case).ravel()
    begin = time.process_time()
    with quiet_single_thread():
        momenta = fsolve(miss, first, xtol=1e-8)
    seconds = time.process_time() - begin
    return {"seconds": seconds, "residual": float(np.abs(module.residual(case, momenta)).max())}


# ---- The fastest scheme ----

FASTEST_SECTION = "fastest"
TARGETS = (1e-3, 1e-6, 1e-9)
STEPPED = ("explicit-euler", "symplectic-euler", "midpoint", "stormer-verlet", "rk4", "yoshida-4-of-midpoint",
           "butcher-6")  # fmt: skip
ADAPTIVE = ("lsoda", "dop853")
_MOST_STEPS, _ASYMPTOTIC = 3000, 40
"""The largest number of steps, and the number from which on the order predicts the steps for a target."""
_REPEAT = 5


def fastest_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Yield a case for every scheme and target error: the fewest steps or the loosest tolerance that meet it."""
    if settings.quick:
        return

    @cache
    def reference() -> float:
        cost = api.solve(settings.module("dop853"), points=settings.landmarks, tolerance=EXACT).cost
        assert cost is not None
        return cost

    def solve(scheme: str, **options: Any) -> tuple[Result, float]:
        """Return a result on the forty landmarks and the error of its cost."""
        result = api.solve(settings.module(scheme), points=settings.landmarks, **options)
        return result, abs(result.cost - reference()) if result.solved and result.cost is not None else math.inf

    def fewest_steps(scheme: str, target: float) -> Values:
        """Search for the fewest steps that meet the target error; errors are assumed to fall like N^-order."""
        order, steps, error = settings.module(scheme).metadata.order, 1, math.inf
        while steps <= _MOST_STEPS:
            _, error = solve(scheme, steps=steps)
            if error <= target:
                result, _ = solve(scheme, steps=steps, repeat=_REPEAT)
                return {"reached": True, "steps": steps, "error": error, "seconds": result.seconds_solve}
            growth = (error / target) ** (1.0 / order) if math.isfinite(error) else 2.0
            if steps >= _ASYMPTOTIC and growth * steps > _MOST_STEPS:
                break
            caution = 0.995 if steps >= _ASYMPTOTIC else 0.97  # predictions are better for more steps
            steps = max(steps + 1, math.floor(steps * min(caution * growth, 4.0)))
        return {"reached": False, "steps": _MOST_STEPS, "error": error, "seconds": math.inf}

    def loosest_tolerance(scheme: str, target: float) -> Values:
        """Search for the loosest tolerance that meets the target error, with four tolerances per decade."""
        for quarter in range(4, 53):
            tolerance = 10.0 ** (-quarter / 4)
            _, error = solve(scheme, tolerance=tolerance)
            if error <= target:
                result, _ = solve(scheme, tolerance=tolerance, repeat=_REPEAT)
                return {"reached": True, "steps": result.steps, "error": error, "seconds": result.seconds_solve,
                        "tolerance": tolerance}  # fmt: skip
        return {"reached": False, "steps": 0, "error": math.inf, "seconds": math.inf}

    for schemes, search in ((STEPPED, fewest_steps), (ADAPTIVE, loosest_tolerance)):
        for scheme in schemes:
            for target in TARGETS:
                yield Case(FASTEST_SECTION, f"{scheme}; {target:g}", partial(search, scheme, target))


# ---- Routes of solution ----

ROUTES_SECTION = "sweeps"
DRAWN = 20  # the number of steps of the paths that figures show


@dataclass(frozen=True)
class Route:
    """A way to solve: a method with a driver, and the schemes that are solved in this way."""

    method: str
    driver: str
    schemes: tuple[str, ...]

    @property
    def label(self) -> str:
        """Return the name of the route on the page."""
        return f"{self.method}, {self.driver}"


_EULERS = ("explicit-euler", "symplectic-euler", "implicit-euler", "midpoint")
ROUTES = (
    Route("stepping", "newton", _EULERS),
    Route("stepping", "fsolve", _EULERS),
    Route("full", "newton", _EULERS),
    Route("action", "newton", ("explicit-euler", "symplectic-euler", "midpoint")),
    Route("stepping", "fmin", ("explicit-euler", "midpoint")),
    Route("full", "fsolve", ("explicit-euler", "midpoint")),
    Route("action", "trust-constr", ("explicit-euler", "midpoint")),
    Route("action", "slsqp", ("explicit-euler", "midpoint")),
)


def routes_of(scheme: str) -> list[Route]:
    """Return the routes that solve a scheme."""
    return [route for route in ROUTES if scheme in route.schemes]


def route_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Yield cases: every route on every set of landmarks, with ever more steps until a solve exceeds the limit."""
    for scheme in ("explicit-euler", "midpoint") if settings.quick else _EULERS:
        for route in routes_of(scheme):
            if settings.quick and (route.method != "stepping" or route.driver not in ("newton", "fsolve")):
                continue
            for count in settings.counts:
                for steps in settings.steps:
                    name = case_name(scheme, route.label, count, steps)
                    yield Case(ROUTES_SECTION, name, partial(_solved, settings, scheme, route, count, steps))
                    values = store.get(ROUTES_SECTION, name)
                    if values is not None and (values["seconds"] or 0.0) > settings.limit:
                        break


def case_name(scheme: str, route: str, count: int, steps: int) -> str:
    """Return the name of a case of a route."""
    return f"{scheme}; {route}; nc {count}; N {steps}"


def _solved(settings: Settings, scheme: str, route: Route, count: int, steps: int) -> Values:
    module = settings.module(scheme, None if route.method == "stepping" else route.method)
    repeat = 5 if DRIVERS[route.driver].generated or (route.method, route.driver) == ("stepping", "fsolve") else 1
    result = api.solve(module, route.driver, points=few_landmarks(count), steps=steps, repeat=repeat)
    values: dict[str, object] = {
        "status": result.status, "cost": result.cost, "residual": result.residual, "seconds": result.seconds_solve,
        "iterations": result.iterations,
    }  # fmt: skip
    if steps == DRAWN:
        values["path"] = result.q.reshape(steps + 1, count, 2)
    return values
