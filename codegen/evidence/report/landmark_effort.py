"""The effort of landmark registration: accuracy, routes of solution, the fastest scheme, dimensions.

The particle ansatz as a weak solution of the Euler-Poincare equations, by numbers (thesis, B.2). m = sum_i p_i delta(x
- q_i) solves m_t + v . grad m + (grad v)' m + m div v = 0 if for every test function psi the sum over particles of d/dt
(p_i psi(q_i)) equals what v does to them. psi enters by its values and slopes at the particles only, which are those of
random polynomials that vanish on the circle with their normal derivatives.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.optimize import fsolve

from codegen.evidence.report.settings import Settings, few_landmarks, smooth_pair
from codegen.evidence.report.store import Case, Store, Values
from codegen.problem.points import PointSet
from codegen.solving import api
from codegen.solving.drivers import DRIVERS
from codegen.solving.drivers.shared import quiet_single_thread
from codegen.solving.loading import ConnectModule, Vector

REFERENCES, TABLE, TOLERANCES, WORK = "references", "table 5.2", "tolerances", "work and precision"
EXACT = 1e-13
"""The tolerance of the reference, by dop853; the thesis's was 2.24e-14, by ode113."""
THESIS_TABLE = {"midpoint": (9399.0, 1.729e-3), "lsoda 1e-02": (63.30, 2.803e-6), "explicit-euler": (19.14, 3.751e-3)}
"""Seconds and error in cost of Table 5.2; lsoda stands for Matlab's ode113 at the tolerance that it had there."""
ROWS = ("midpoint", "lsoda 1e-02", "explicit-euler", "dop853 1e-06", "symplectic-euler", "rk4")
SCHEMES = ("explicit-euler", "symplectic-euler", "midpoint", "stormer-verlet", "rk4")


def accuracy_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """References, the rows of Table 5.2, the sweep of tolerances, and error against time of every scheme."""
    del store
    for count in (*settings.counts, 40):
        yield Case(REFERENCES, f"nc {count}", lambda count=count: _reference(settings, count))  # type: ignore[misc]
        if count != 40:
            yield Case(TABLE, f"lsoda 1e-06; nc {count}", lambda c=count: _row(settings, "lsoda 1e-06", c))  # type: ignore[misc]
    for row in ROWS[:3] if settings.quick else ROWS:
        yield Case(TABLE, f"{row}; nc 40", lambda row=row: _row(settings, row, 40))  # type: ignore[misc]
    for code in ("lsoda",) if settings.quick else ("lsoda", "dop853"):
        for tolerance in tolerances(settings.quick):
            name = f"{code} {tolerance:.1e}"
            yield Case(TOLERANCES, name, lambda c=code, t=tolerance: _adaptive(settings, c, t, 40))  # type: ignore[misc]
    if settings.quick:
        return
    for scheme in SCHEMES:
        for steps in (5, 10, 20, 40, 80):
            name = f"{scheme}; N {steps}"
            yield Case(WORK, name, lambda s=scheme, n=steps: _stepped(settings, s, 40, n))  # type: ignore[misc]


def tolerances(quick: bool) -> list[float]:
    """The thesis's 1e-2, 7.5e-3, 5e-3, 2.5e-3, 1e-3 ... 1e-6, then powers of ten down to 1e-12."""
    if quick:
        return [1e-2, 1e-4, 1e-6]
    found = [factor * 10.0**power for power in (-3, -4, -5, -6) for factor in (10.0, 7.5, 5.0, 2.5)]
    return [*found, *(10.0**-power for power in range(6, 13))]


def points_of(settings: Settings, count: int) -> PointSet:
    """The trilobites' forty landmarks, or few random ones."""
    return settings.landmarks if count == 40 else few_landmarks(count)


def _reference(settings: Settings, count: int) -> Values:
    result = api.solve(settings.module("dop853"), points=points_of(settings, count), tolerance=EXACT)
    values = {"cost": result.cost, "residual": result.residual, "status": result.status}
    return {**values, "path": result.q.reshape(result.steps + 1, -1, 2), "drift": result.summary["energy_drift"]}


def _row(settings: Settings, row: str, count: int) -> Values:
    scheme, _, tolerance = row.partition(" ")
    if tolerance:
        return _adaptive(settings, scheme, float(tolerance), count)
    return _stepped(settings, scheme, count, 10)


def _adaptive(settings: Settings, code: str, tolerance: float, count: int) -> Values:
    points = points_of(settings, count)
    result = api.solve(settings.module(code), points=points, tolerance=tolerance, repeat=1)
    return {
        "cost": result.cost,
        "residual": result.residual,
        "seconds": result.seconds_solve,
        "status": result.status,
        "tolerance": tolerance,
    }


def _stepped(settings: Settings, scheme: str, count: int, steps: int) -> Values:
    result = api.solve(settings.module(scheme), points=points_of(settings, count), steps=steps, repeat=5)
    return {
        "cost": result.cost,
        "residual": result.residual,
        "seconds": result.seconds_solve,
        "status": result.status,
        "iterations": result.iterations,
        "steps": steps,
    }


WEAK_SOLUTION_SECTION = "weak solution"


def weak_solution_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Random test functions on every set of landmarks along their motion."""
    del store
    for count in (*settings.counts, 40):
        yield Case(WEAK_SOLUTION_SECTION, f"nc {count}", lambda c=count: _defects(settings, c))  # type: ignore[misc]


def _defects(settings: Settings, count: int) -> Values:
    module, points = settings.module("explicit-euler"), points_of(settings, count)
    solution = module.solve(points.start, points.target, 10)
    generator, worst, size = np.random.default_rng(5), 0.0, 0.0
    for k in (0, 5, 10):
        for _ in range(5):
            coefficients = generator.normal(size=(4, 4))
            defect, rate = weak_defect(module, solution.q[k], solution.p[k], coefficients)
            worst, size = max(worst, defect), max(size, rate)
    return {"largest defect": worst, "largest rate": size, "test functions": 15}


def weak_defect(module: ConnectModule, q: Vector, p: Vector, coefficients: Vector) -> tuple[float, float]:
    """The largest component of the weak equation's left side, and of its first term alone.

    (v . grad m) psi becomes -p . (psi div v + v . grad psi) by parts; the slopes of v are central differences.
    """
    gradient, none = np.empty((2, *q.shape)), np.zeros((len(q), 0))
    module.hamiltonian_gradient(np.stack([q, p]), none, np.zeros(0), gradient)
    velocity, force = gradient[1], -gradient[0]
    step = 1e-5
    slopes = np.stack(
        [(_field(module, q, p, q + h) - _field(module, q, p, q - h)) / (2 * step) for h in step * np.eye(2)], axis=-1
    )
    psi, psi_slope = _test_function(q, coefficients)
    divergence = np.trace(slopes, axis1=1, axis2=2)
    along = (psi_slope * velocity).sum(axis=1)
    rate = force.T @ psi + p.T @ along
    advected = -p.T @ (psi * divergence + along)
    stretched = np.einsum("i,ilk,il->k", psi, slopes, p)
    compressed = p.T @ (psi * divergence)
    return float(np.abs(rate + advected + stretched + compressed).max()), float(np.abs(rate).max())


def _field(module: ConnectModule, q: Vector, p: Vector, x: Vector) -> Vector:
    """The field v at places x, shape (m, 2): the velocity of particles there without momentum."""
    places, count = np.concatenate([q, x]), len(q)
    matrix = np.empty((len(places),) * 2)
    module.momentum_matrix(np.stack([places, np.zeros_like(places)]), np.zeros((len(places), 0)), np.zeros(0), matrix)
    return matrix[count:, :count] @ p


def _test_function(q: Vector, coefficients: Vector) -> tuple[Vector, Vector]:
    """The function psi = (1 - |x|^2)^2 sum_ab c_ab x^a y^b and its gradient at places of shape (n, 2)."""
    x, y = q.T
    powers = np.arange(4)
    in_x, in_y = x[:, None] ** powers, y[:, None] ** powers
    by_x = powers * x[:, None] ** np.maximum(powers - 1, 0)
    by_y = powers * y[:, None] ** np.maximum(powers - 1, 0)
    sums = [np.einsum("ia,ab,ib->i", a, coefficients, b) for a, b in ((in_x, in_y), (by_x, in_y), (in_x, by_y))]
    well = 1.0 - x**2 - y**2
    gradient = [well**2 * s - 4.0 * well * place * sums[0] for s, place in zip(sums[1:], (x, y), strict=True)]
    return well**2 * sums[0], np.stack(gradient, axis=1)


DIMENSION_SECTION = "dimension"
COUNTS = (5, 10, 20, 50, 100, 200)
KERNELS = (("plate", 2), ("plate", 3), ("gauss", 2), ("gauss", 3))
WIDTH = 0.15
"""The Gaussian's; with wider ones the matrix of the kernel loses all digits for many landmarks."""


def dimension_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Explicit Euler steps, N = 10, with the Gaussian and the plate's kernel in the plane and in space."""
    del store
    for kernel, dimension in (("plate", 2),) if settings.quick else KERNELS:
        for count in COUNTS[:4] if settings.quick else COUNTS:
            name = f"{kernel} {dimension}-D; nc {count}"
            yield Case(DIMENSION_SECTION, name, lambda k=kernel, d=dimension, n=count: _solved(settings, k, d, n))  # type: ignore[misc]


def arguments(kernel: str, dimension: int) -> dict[str, str]:
    """What --set says for a kernel and a dimension; nothing for the defaults."""
    found = {"kernel": kernel} if kernel != "plate" else {}
    return found | ({"dimension": str(dimension)} if dimension != 2 else {})


def _solved(settings: Settings, kernel: str, dimension: int, count: int) -> Values:
    module: Any = settings.module("explicit-euler", **arguments(kernel, dimension))
    points = smooth_pair(count, dimension)
    case = module.make_case(points.start, points.target, 10, **({"width": WIDTH} if kernel == "gauss" else {}))
    solution = module.solve_case(case)
    momenta = solution.p[0]
    repeats = 3 if count < 100 else 1
    return {
        "status": solution.status,
        "residual": solution.residual,
        "iterations": solution.iterations,
        "seconds": least_time(lambda: module.solve_case(case), repeats),
        "seconds of a trajectory": least_time(lambda: module.trajectory(case, momenta), 20),
        "operations": list(module.metadata.operations["hamiltonian_gradient"]),
    }


def least_time(run: Callable[[], Any], repeats: int) -> float:
    """The least processor time of several warm runs, in seconds; other work on the machine lengthens it little."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return min(times)


MIDPOINT_SECTION = "midpoint effort"


def midpoint_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """The nested solve on few landmarks, ours on these and on forty."""
    del store
    if settings.quick:
        return
    for count in (*settings.counts, 40):
        yield Case(MIDPOINT_SECTION, f"generated; nc {count}", lambda c=count: _generated(settings, c))  # type: ignore[misc]
    for count in settings.counts:
        yield Case(MIDPOINT_SECTION, f"nested fsolve; nc {count}", lambda c=count: _nested(settings, c))  # type: ignore[misc]


def _generated(settings: Settings, count: int) -> Values:
    found: dict[str, Any] = {}
    points = points_of(settings, count)
    for scheme in ("midpoint", "explicit-euler"):
        module = settings.module(scheme)
        case = module.make_case(points.start, points.target, 10)
        solution = module.solve_case(case)
        found[f"{scheme} seconds"] = least_time(lambda m=module, c=case: m.solve_case(c), 5)  # type: ignore[misc]
        found[f"{scheme} trajectory"] = least_time(lambda m=module, c=case, p=solution.p[0]: m.trajectory(c, p), 20)  # type: ignore[misc]
        found[f"{scheme} cost"], found[f"{scheme} status"] = solution.cost, solution.status
    return found


def _nested(settings: Settings, count: int) -> Values:
    """As the thesis did it: fsolve for the initial momenta, and inside it fsolve for every implicit step."""
    module, points = settings.module("midpoint"), points_of(settings, count)
    case = module.make_case(points.start, points.target, 10)
    first = module.first_momenta(case).ravel()
    begin = time.process_time()
    with quiet_single_thread():
        found = fsolve(lambda p: _arrival(module, case, points, p), first, xtol=1e-8)
    seconds = time.process_time() - begin
    return {"seconds": seconds, "residual": float(np.abs(module.residual(case, found)).max())}


def _arrival(module: ConnectModule, case: Any, points: PointSet, momenta: Any) -> Any:
    """Where midpoint steps arrive whose equations fsolve solves, with Jacobians by differences."""
    state, gradient = np.stack([points.start, momenta.reshape(points.start.shape)]), np.empty((2, *points.start.shape))
    h = case.duration / case.steps

    def equations(after: Any, before: Any) -> Any:
        middle = 0.5 * (before + after.reshape(before.shape))
        module.hamiltonian_gradient(middle, case.own, case.parameters, gradient)
        return (after.reshape(before.shape) - before - h * np.stack([gradient[1], -gradient[0]])).ravel()

    for _ in range(case.steps):
        state = fsolve(equations, state.ravel(), args=(state,), xtol=1e-8).reshape(state.shape)
    return (state[0] - points.target).ravel()


FASTEST_SECTION = "fastest"
TARGETS = (1e-3, 1e-6, 1e-9)
STEPPED = ("explicit-euler", "symplectic-euler", "midpoint", "stormer-verlet", "rk4", "yoshida-4-of-midpoint",
           "butcher-6")  # fmt: skip
ADAPTIVE = ("lsoda", "dop853")
_MOST_STEPS, _ASYMPTOTIC = 3000, 40
"""Steps beyond which no scheme is tried, and from which on its order is taken to predict how many it needs."""
_REPEAT = 5


def fastest_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """For every scheme and target, the fewest steps or the loosest tolerance that meets it."""
    del store
    if settings.quick:
        return

    @cache
    def reference() -> float:
        found = api.solve(settings.module("dop853"), points=settings.landmarks, tolerance=EXACT)
        assert found.cost is not None
        return found.cost

    searches: dict[str, Callable[[Settings, str, float, float], Values]] = {
        **dict.fromkeys(STEPPED, _fewest_steps),
        **dict.fromkeys(ADAPTIVE, _loosest_tolerance),
    }
    for scheme, search in searches.items():
        for target in TARGETS:
            name = f"{scheme}; {target:g}"
            yield Case(FASTEST_SECTION, name, lambda f=search, s=scheme, t=target: f(settings, s, t, reference()))  # type: ignore[misc]


def _fewest_steps(settings: Settings, scheme: str, target: float, exact: float) -> Values:
    """Steps by the power of N with which the scheme's order lets the error fall; not reached where N would be huge."""
    module = settings.module(scheme)
    order, steps, error = module.metadata.order, 1, math.inf
    while steps <= _MOST_STEPS:
        result = _fastest_solved(settings, scheme, {"steps": steps})
        error = abs(result.cost - exact) if result.solved else math.inf
        if error <= target:
            result = _fastest_solved(settings, scheme, {"steps": steps, "repeat": _REPEAT})
            return {"reached": True, "steps": steps, "error": error, "seconds": result.seconds_solve}
        growth = (error / target) ** (1.0 / order) if math.isfinite(error) else 2.0
        if steps >= _ASYMPTOTIC and growth * steps > _MOST_STEPS:
            break
        caution = 0.995 if steps >= _ASYMPTOTIC else 0.97  # the order holds better the more steps there are
        steps = max(steps + 1, math.floor(steps * min(caution * growth, 4.0)))
    return {"reached": False, "steps": _MOST_STEPS, "error": error, "seconds": math.inf}


def _loosest_tolerance(settings: Settings, scheme: str, target: float, exact: float) -> Values:
    """Four tolerances a decade."""
    for quarter in range(4, 53):
        given = {"tolerance": 10.0 ** (-quarter / 4)}
        result = _fastest_solved(settings, scheme, given)
        error = abs(result.cost - exact) if result.solved else math.inf
        if error <= target:
            result = _fastest_solved(settings, scheme, {**given, "repeat": _REPEAT})
            return {"reached": True, "steps": result.steps, "error": error, "seconds": result.seconds_solve, **given}
    return {"reached": False, "steps": 0, "error": math.inf, "seconds": math.inf}


def _fastest_solved(settings: Settings, scheme: str, given: dict[str, Any]) -> Any:
    return api.solve(settings.module(scheme), points=settings.landmarks, **given)


ROUTES_SECTION = "sweeps"
DRAWN = 20
"""The number of steps whose paths are drawn."""


@dataclass(frozen=True)
class Route:
    """A way to the solution: what the thesis calls it (or what ours is called), the method and the driver."""

    label: str
    method: str
    driver: str
    schemes: tuple[str, ...]


_EULERS = ("explicit-euler", "symplectic-euler", "implicit-euler", "midpoint")
ROUTES = (
    Route("stepping, newton", "stepping", "newton", _EULERS),
    Route("stepping, fsolve", "stepping", "fsolve", _EULERS),
    Route("full, newton", "full", "newton", _EULERS),
    Route("action, newton", "action", "newton", ("explicit-euler", "symplectic-euler", "midpoint")),
    Route("stepping, fmin", "stepping", "fmin", ("explicit-euler", "midpoint")),
    Route("full, fsolve", "full", "fsolve", ("explicit-euler", "midpoint")),
    Route("action, trust-constr", "action", "trust-constr", ("explicit-euler", "midpoint")),
    Route("action, slsqp", "action", "slsqp", ("explicit-euler", "midpoint")),
)


def route_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Every route on every set of landmarks, with ever more steps until a solve takes longer than the limit."""
    for scheme in ("explicit-euler", "midpoint") if settings.quick else _EULERS:
        for route in ROUTES:
            if scheme not in route.schemes or (settings.quick and route.driver not in ("newton", "fsolve")):
                continue
            if settings.quick and (route.method != "stepping"):
                continue
            for count in settings.counts:
                yield from _growing(settings, store, scheme, route, count)


def _growing(settings: Settings, store: Store, scheme: str, route: Route, count: int) -> Iterator[Case]:
    for steps in settings.steps:
        name = case_name(scheme, route.label, count, steps)

        def measure(steps: int = steps) -> Values:
            return _sweeps_solved(settings, scheme, route, count, steps)

        yield Case(ROUTES_SECTION, name, measure)
        values = store.get(ROUTES_SECTION, name)
        if values is not None and (values["seconds"] or 0.0) > settings.limit:
            return


def case_name(scheme: str, route: str, count: int, steps: int) -> str:
    """The name of a case."""
    return f"{scheme}; {route}; nc {count}; N {steps}"


def _sweeps_solved(settings: Settings, scheme: str, route: Route, count: int, steps: int) -> Values:
    module = settings.module(scheme, None if route.method == "stepping" else route.method)
    repeat = 5 if DRIVERS[route.driver].generated or (route.method, route.driver) == ("stepping", "fsolve") else 1
    result = api.solve(module, route.driver, points=few_landmarks(count), steps=steps, repeat=repeat)
    found: dict[str, object] = {
        "status": result.status,
        "cost": result.cost,
        "residual": result.residual,
        "seconds": result.seconds_solve,
        "iterations": result.iterations,
    }
    if steps == DRAWN:
        found["path"] = result.q.reshape(steps + 1, count, 2)
    return found
