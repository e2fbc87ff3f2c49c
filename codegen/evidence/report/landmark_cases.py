"""The measurements of landmark registration: accuracy, routes of solution, fastest scheme, dimensions, paths, warps.

The particle ansatz m = sum_i p_i delta(x - q_i) is checked as a weak solution of the Euler-Poincare equations (thesis,
B.2), m_t + v . grad m + (grad v)' m + m div v = 0. For every test function psi, the sum of d/dt (p_i psi(q_i)) over
particles must cancel the terms with v. Only the values and slopes of psi at the particles matter. Test functions are
random polynomials, which vanish on the unit circle with their normal derivatives.

Jumps between paths. In Figures 5.8 and 5.9 of the thesis, time and error of the optimiser jump from one N to the next.
The thesis minimises 2 h sum H over positions and momenta at the nodes, both averaged on intervals. Only averages of
momenta matter: p_k + (-1)^k a has the same averages for every a, the same cost and the same constraints, so that the
minimum is never isolated. The generated module has one momentum for each interval. Both forms are given to scipy's
SLSQP, from the thesis's curved paths and from straight paths, with the thesis's tolerance 1e-6 and with a tight one.
The results are compared with Newton's solution of the same discrete problem.

The smoothness of warps. The errors and folds of a warped grid show how many steps a smooth warp needs. Points without
momentum follow v(x) = sum_j p_j G(x, q_j). An explicit step x + h v(x) is one to one if h times the Lipschitz constant
of v is below one. A cell of the grid with a negative signed area shows a fold.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import fsolve, minimize

from codegen.evidence.report.building import timed
from codegen.evidence.report.store import Case, Settings, Store, Values, few_landmarks, smooth_pair
from codegen.problem.points import PointSet
from codegen.solving import api
from codegen.solving.drivers import DRIVERS
from codegen.solving.drivers.quiet import quiet_single_thread
from codegen.solving.loading import ConnectModule, Matrix, Vector
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
BUDGET = 0.1  # seconds for the samples of a time
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
        "seconds": timed(partial(module.solve_case, case), BUDGET).processor,
        "seconds of a trajectory": timed(partial(module.trajectory, case, solution.p[0]), BUDGET).processor,
        "operations": list(module.metadata.operations["hamiltonian_gradient"]),
    }


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
        values[f"{scheme} seconds"] = timed(partial(module.solve_case, case), BUDGET).processor
        values[f"{scheme} trajectory"] = timed(partial(module.trajectory, case, solution.p[0]), BUDGET).processor
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


# ---- Jumps between paths ----

JUMPS_SECTION = "jumps"
LOOSE, TIGHT = 1e-6, 1e-14


@dataclass(frozen=True)
class Minimisation:
    """A minimisation: momenta on "nodes" or "intervals", "curved" or "straight" initial paths, and the tolerance."""

    momenta: str
    path: str
    tolerance: float

    def case(self, count: int, steps: int) -> str:
        """Return the name of the case."""
        return f"momenta on {self.momenta}; {self.path} paths; tolerance {self.tolerance:g}; nc {count}; N {steps}"


VARIANTS = tuple(
    Minimisation(momenta, path, tolerance)
    for momenta in ("nodes", "intervals")
    for path in ("curved", "straight")
    for tolerance in (LOOSE, TIGHT)
)


def jump_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Yield cases: every variant with ever more steps, until a solve takes longer than the limit."""
    if settings.quick:
        return
    for count in settings.counts[:2]:
        # The numbers of directions of the unknowns that change neither cost nor constraints.
        matrices = {momenta: unknowns(momenta, 2 * count, 10) for momenta in ("nodes", "intervals")}
        free = {name: int(matrix.shape[1] - np.linalg.matrix_rank(matrix)) for name, matrix in matrices.items()}
        yield Case(JUMPS_SECTION, f"null space; nc {count}", partial(dict, free))
        for variant in VARIANTS:
            for steps in settings.steps:
                name = variant.case(count, steps)
                yield Case(JUMPS_SECTION, name, partial(_minimised, settings, count, steps, variant))
                values = store.get(JUMPS_SECTION, name)
                if values is not None and (values["seconds"] or 0.0) > settings.limit:
                    break


def unknowns(momenta: str, size: int, steps: int) -> Matrix:
    """Return the matrix that maps the unknowns of the minimiser to the unknowns of the action.

    Both are inner positions (`size` entries per node), then momenta. The action has momenta on intervals. If `momenta`
    is "nodes", the minimiser has momenta on nodes, which are averaged between neighbours.
    """
    inner = (steps - 1) * size
    means = np.eye(steps) if momenta == "intervals" else 0.5 * (np.eye(steps, steps + 1) + np.eye(steps, steps + 1, 1))
    return np.asarray(block_diag(np.eye(inner), np.kron(means, np.eye(size))))


def _straight_path(module: ConnectModule, case: Any) -> Vector:
    """Return the positions on straight lines at constant speed and their momenta, shape (N + 1, 2, n, d)."""
    velocity = (case.target - case.start) / case.duration
    places = [case.start + k / case.steps * (case.target - case.start) for k in range(case.steps + 1)]
    return np.array([[q, module.momenta_of(case, q, velocity)] for q in places])


def _minimised(settings: Settings, count: int, steps: int, variant: Minimisation) -> Values:
    module, points = settings.module("midpoint", "action"), few_landmarks(count)
    exact = api.solve(module, points=points, steps=steps).cost
    assert exact is not None
    case = module.make_case(points.start, points.target, steps)
    size, on_nodes = points.start.size, variant.momenta == "nodes"
    matrix = unknowns(variant.momenta, size, steps)
    equations = {
        "type": "eq",
        "fun": lambda x: module.action_constraints(case, matrix @ x),
        "jac": lambda x: module.action_jacobian(case, matrix @ x) @ matrix,
    }

    def cost(x: Vector) -> tuple[float, Vector]:
        y = matrix @ x
        return module.action_cost(case, y), module.action_cost_gradient(case, y) @ matrix

    begin = time.perf_counter()
    states = _straight_path(module, case) if variant.path == "straight" else module.guessed_path(case)
    momenta = states[:, 1] if on_nodes else states[:-1, 1]
    x = np.concatenate([states[1:-1, 0].ravel(), momenta.ravel()])
    with quiet_single_thread():
        optimum = minimize(
            cost, x, jac=True, constraints=[equations], method="SLSQP",
            options={"maxiter": 400, "ftol": variant.tolerance},
        )  # fmt: skip
    seconds = time.perf_counter() - begin
    y = matrix @ optimum.x
    gradient, jacobian = module.action_cost_gradient(case, y), module.action_jacobian(case, y)
    multipliers = np.linalg.lstsq(jacobian.T, -gradient, rcond=None)[0]
    alternating = 0.0  # the size of the part of nodal momenta that alternates in sign from node to node
    if on_nodes:
        nodal = optimum.x[(steps - 1) * size :].reshape(steps + 1, size)
        alternating = float(np.abs((-1.0) ** np.arange(steps + 1) @ nodal).max() / (steps + 1))
    return {
        "seconds": seconds,
        "cost": float(optimum.fun),
        "error": abs(float(optimum.fun) - exact),
        "constraints": float(np.abs(module.action_constraints(case, y)).max()),
        "stationarity": float(np.abs(gradient + jacobian.T @ multipliers).max()),
        "iterations": int(optimum.nit),
        "ended": str(optimum.message),
        "alternating": alternating,
    }


# ---- Initial paths ----

PATHS_SECTION = "initial paths"
KINDS = {
    "straight": "straight lines at constant speed",
    "curved": "the thesis's curved paths, exact for a single landmark",
    "spline": "the flow of the clamped-plate spline: explicit steps from the momenta of the straight way",
    "shot": "the trajectory after two steps of Broyden's or Newton's method of shooting",
    "coarse": "the solution with a fifth of the steps, interpolated",
}
PATHS_STEPS = 20


def path_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Yield cases: every initial guess for small sets of landmarks, the trilobites, and a hundred random landmarks."""
    if settings.quick:
        return
    sets = {f"nc {n}": settings.points(n) for n in (*settings.counts, 40)} | {"nc 100, smooth": smooth_pair(100)}
    for name, points in sets.items():
        for kind in KINDS:
            yield Case(PATHS_SECTION, f"{kind}; {name}", partial(_iterations, settings, points, kind))


def _guess(module: ConnectModule, case: Any, kind: str) -> Vector:
    """Return the states of the initial guess `kind` (see KINDS), shape (N + 1, 2, n, d)."""
    if kind == "straight":
        return _straight_path(module, case)
    if kind == "curved":
        return np.asarray(module.guessed_path(case))
    if kind == "spline":
        return np.asarray(module.trajectory(case, module.first_momenta(case))[1])
    if kind == "shot":
        solution = module.solve_case(case._replace(tolerance=1e-6, max_iterations=2), module.first_momenta(case))
        return np.stack([solution.q, solution.p], axis=1)
    coarse = case._replace(steps=case.steps // 5)
    solution = module.solve_case(coarse)
    nodes = np.arange(case.steps + 1) / case.steps * coarse.steps
    below = np.minimum(nodes.astype(int), coarse.steps - 1)
    part = (nodes - below)[:, None, None, None]
    states = np.stack([solution.q, solution.p], axis=1)
    return np.asarray((1.0 - part) * states[below] + part * states[below + 1])


def _iterations(settings: Settings, points: PointSet, kind: str) -> Values:
    module = settings.module("explicit-euler")
    case = module.make_case(points.start, points.target, PATHS_STEPS)
    exact = module.solve_case(case).q
    _guess(module, case, kind)  # compiles
    begin = time.perf_counter()
    path = _guess(module, case, kind)
    seconds = time.perf_counter() - begin
    distance = float(np.abs(path[:, 0] - exact).max()) if np.isfinite(path).all() else np.nan
    log, states = np.zeros((case.max_iterations + 1, 3)), np.zeros((case.steps * module.POINTS, *path.shape[1:]))
    path = np.ascontiguousarray(path)
    outcome, iterations, residual = module.all_states(case, module.preconditioner(case), path, states, log)
    return {
        "solved": outcome > 0, "iterations": iterations, "residual": residual, "seconds of the guess": seconds,
        "distance of places": distance, "first residual": float(log[0, 0]),
    }  # fmt: skip


# ---- The smoothness of warps ----

SMOOTHNESS_SECTION = "smoothness"
AMPLITUDES = (0.5, 1.0, 2.0)
"""Factors of the displacements of the trilobites' landmarks, which stay inside the disc with the last factor."""
SMOOTHNESS_STEPS = (1, 2, 3, 5, 10, 20, 40, 80)
_FINE, _ROWS = 640, 31


def smoothness_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Yield cases: warps by explicit Euler with increasing displacements and ever more steps."""
    if settings.quick:
        return
    for amplitude in AMPLITUDES:
        for steps in (_FINE, *SMOOTHNESS_STEPS):
            name = f"amplitude {amplitude:g}; N {steps}"
            yield Case(SMOOTHNESS_SECTION, name, partial(_warp, settings, amplitude, steps))


def grid() -> Vector:
    """Return the points of a grid on a square inside the unit circle, shape (rows, rows, 2)."""
    line = np.linspace(-0.7, 0.7, _ROWS)
    return np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)


def _warp(settings: Settings, amplitude: float, steps: int) -> Values:
    module, points = settings.module("explicit-euler"), settings.landmarks
    target = points.start + amplitude * (points.target - points.start)
    solution = module.solve(points.start, target, steps)
    if solution.status != "solved":
        return {"status": solution.status, "steps": steps}
    # The images of the grid under the steps, and the largest difference quotient of h v on the grid.
    x = grid().reshape(-1, 2)
    steepest, spacing = 0.0, np.linalg.norm(grid()[0, 1] - grid()[0, 0])
    for q, p in zip(solution.q[:-1], solution.p[:-1], strict=True):
        step = _field(module, q, p, x) / (len(solution.q) - 1)
        field = step.reshape(_ROWS, _ROWS, 2)
        slopes = [np.linalg.norm(np.diff(field, axis=a), axis=-1).max() / spacing for a in (0, 1)]
        steepest, x = max(steepest, *slopes), x + step
    warped = x.reshape(_ROWS, _ROWS, 2)
    area = cell_areas(warped) / cell_areas(grid())
    return {
        "status": solution.status, "steps": steps, "least area": float(area.min()), "greatest area": float(area.max()),
        "steepest": float(steepest), "cost": solution.cost, "places": warped.round(9),
    }  # fmt: skip


def cell_areas(positions: Vector) -> Vector:
    """Return the signed areas of the cells of a grid from their diagonals; `positions` has shape (rows, rows, 2)."""
    first, second = positions[1:, 1:] - positions[:-1, :-1], positions[:-1, 1:] - positions[1:, :-1]
    return 0.5 * (first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])
