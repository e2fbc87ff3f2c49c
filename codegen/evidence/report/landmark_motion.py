"""The motion of landmarks: jumps between paths, initial paths, the smoothness of warps.

What happens inside the optimiser of the thesis's Figures 5.8 and 5.9: momenta on nodes, and loose tolerances. The
thesis minimises 2 h sum H over places and momenta at the nodes, both averaged on intervals. Only averages of momenta
act: p_k + (-1)^k a has the same averages for every a, costs as much and obeys the same constraints, so that the minimum
is never isolated. Ours has one momentum for each interval. Both are given to scipy's SLSQP, from the thesis's curved
paths and from straight ones, with the thesis's tolerance 1e-6 and with a tight one, and compared with Newton's solution
of the same discrete problem.

How many steps a smooth warp needs: errors and folds of the warp of the whole disc against the number of steps. Points
that carry no momentum follow v(x) = sum_j p_j G(x, q_j). An explicit step x + h v(x) is one to one where h times the
Lipschitz constant of v is below one; cells of a grid whose signed area becomes negative show a fold.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

from codegen.evidence.report.landmark_effort import points_of
from codegen.evidence.report.settings import Settings, few_landmarks, smooth_pair
from codegen.evidence.report.store import Case, Store, Values
from codegen.problem.points import PointSet
from codegen.solving import api
from codegen.solving.drivers.shared import quiet_single_thread
from codegen.solving.loading import ConnectModule, Matrix, Vector

JUMPS_SECTION = "jumps"
LOOSE, TIGHT = 1e-6, 1e-14
VARIANTS = tuple(
    (place, path, tolerance)
    for place in ("nodes", "intervals")
    for path in ("curved", "straight")
    for tolerance in (LOOSE, TIGHT)
)


def jump_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Every variant with ever more steps until a solve takes longer than the limit."""
    if settings.quick:
        return
    for count in settings.counts[:2]:
        yield Case(JUMPS_SECTION, f"null space; nc {count}", lambda count=count: _null_space(settings, count))  # type: ignore[misc]
        for place, path, tolerance in VARIANTS:
            for steps in settings.steps:
                name = case_name(place, path, tolerance, count, steps)

                def measure(
                    n: int = steps, c: int = count, v: tuple[str, str, float] = (place, path, tolerance)
                ) -> Values:
                    return _minimised(settings, c, n, *v)

                yield Case(JUMPS_SECTION, name, measure)
                values = store.get(JUMPS_SECTION, name)
                if values is not None and (values["seconds"] or 0.0) > settings.limit:
                    break


def case_name(place: str, path: str, tolerance: float, count: int, steps: int) -> str:
    """The name of a case."""
    return f"momenta on {place}; {path} paths; tolerance {tolerance:g}; nc {count}; N {steps}"


@dataclass(frozen=True)
class Unknowns:
    """How unknowns x of a minimiser give those of the action, as matrix x; the identity for momenta of intervals."""

    matrix: Matrix

    def cost(self, module: ConnectModule, case: Any, x: Vector) -> tuple[float, Vector]:
        """The action's cost and its gradient by the minimiser's unknowns."""
        y = self.matrix @ x
        return module.action_cost(case, y), module.action_cost_gradient(case, y) @ self.matrix


def unknowns(place: str, size: int, steps: int) -> Unknowns:
    """Inner places, then momenta: on intervals as the action has them, or on nodes, averaged between neighbours."""
    inner = (steps - 1) * size
    if place == "intervals":
        return Unknowns(np.eye(inner + steps * size))
    matrix = np.zeros((inner + steps * size, inner + (steps + 1) * size))
    matrix[:inner, :inner] = np.eye(inner)
    for k in range(steps):
        rows = slice(inner + k * size, inner + (k + 1) * size)
        for node in (k, k + 1):
            matrix[rows, inner + node * size : inner + (node + 1) * size] = 0.5 * np.eye(size)
    return Unknowns(matrix)


def start(module: ConnectModule, case: Any, place: str, path: str) -> Vector:
    """Places on curved or straight paths, momenta by the Legendre transform of each interval; of nodes: its first."""
    states = module.guessed_path(case)
    if path == "straight":
        fractions = np.arange(case.steps + 1)[:, None, None] / case.steps
        states[:, 0] = case.start + fractions * (case.target - case.start)
        moved = (case.target - case.start) / case.duration
        for k in range(case.steps + 1):
            states[k, 1] = module.momenta_of(case, states[k, 0], moved)
    momenta = states[:, 1] if place == "nodes" else states[:-1, 1]
    return np.concatenate([states[1:-1, 0].ravel(), momenta.ravel()])


def _minimised(settings: Settings, count: int, steps: int, place: str, path: str, tolerance: float) -> Values:
    module, points = settings.module("midpoint", "action"), few_landmarks(count)
    exact = api.solve(module, points=points, steps=steps).cost
    assert exact is not None
    case = module.make_case(points.start, points.target, steps)
    chosen = unknowns(place, points.start.size, steps)
    equations = {
        "type": "eq",
        "fun": lambda x: module.action_constraints(case, chosen.matrix @ x),
        "jac": lambda x: module.action_jacobian(case, chosen.matrix @ x) @ chosen.matrix,
    }
    begin, x = time.perf_counter(), start(module, case, place, path)
    with quiet_single_thread():
        found = minimize(
            lambda x: chosen.cost(module, case, x),
            x,
            jac=True,
            constraints=[equations],
            method="SLSQP",
            options={"maxiter": 400, "ftol": tolerance},
        )
    seconds = time.perf_counter() - begin
    y = chosen.matrix @ found.x
    gradient, jacobian = module.action_cost_gradient(case, y), module.action_jacobian(case, y)
    multipliers = np.linalg.lstsq(jacobian.T, -gradient, rcond=None)[0]
    return {
        "seconds": seconds,
        "cost": float(found.fun),
        "error": abs(float(found.fun) - exact),
        "constraints": float(np.abs(module.action_constraints(case, y)).max()),
        "stationarity": float(np.abs(gradient + jacobian.T @ multipliers).max()),
        "iterations": int(found.nit),
        "ended": str(found.message),
        "alternating": _alternating(found.x, points.start.size, steps) if place == "nodes" else 0.0,
    }


def _alternating(x: Vector, size: int, steps: int) -> float:
    """The size of the part of nodal momenta that alternates in sign from node to node."""
    momenta = x[(steps - 1) * size :].reshape(steps + 1, size)
    signs = (-1.0) ** np.arange(steps + 1)
    return float(np.abs(signs @ momenta).max() / (steps + 1))


def _null_space(settings: Settings, count: int) -> Values:
    """How many directions of the unknowns change neither cost nor constraints, by the rank of what maps them."""
    found: dict[str, Any] = {}
    for place in ("nodes", "intervals"):
        matrix = unknowns(place, 2 * count, 10).matrix
        found[place] = int(matrix.shape[1] - np.linalg.matrix_rank(matrix))
    del settings
    return found


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
    """Every guess on few landmarks, on the trilobites, and on a hundred random ones."""
    del store
    if settings.quick:
        return
    sets = {f"nc {n}": points_of(settings, n) for n in (*settings.counts, 40)} | {"nc 100, smooth": smooth_pair(100)}
    for name, points in sets.items():
        for kind in KINDS:
            yield Case(PATHS_SECTION, f"{kind}; {name}", lambda p=points, k=kind: _iterations(settings, p, k))  # type: ignore[misc]


def guess(module: ConnectModule, case: Any, kind: str) -> Any:
    """States, shape (N + 1, 2, n, d), of a kind of guess; their places end at the targets where the kind knows them."""
    if kind == "curved":
        return module.guessed_path(case)
    if kind == "spline":
        return module.trajectory(case, module.first_momenta(case))[1]
    if kind == "shot":
        solution = module.solve_case(case._replace(tolerance=1e-6, max_iterations=2), module.first_momenta(case))
        return np.stack([solution.q, solution.p], axis=1)
    if kind == "coarse":
        few = case._replace(steps=case.steps // 5)
        solution = module.solve_case(few)
        nodes = np.arange(case.steps + 1) / case.steps * few.steps
        below = np.minimum(nodes.astype(int), few.steps - 1)
        part = (nodes - below)[:, None, None, None]
        states = np.stack([solution.q, solution.p], axis=1)
        return (1.0 - part) * states[below] + part * states[below + 1]
    states = np.zeros((case.steps + 1, 2, *case.start.shape))
    for k in range(case.steps + 1):
        states[k, 0] = case.start + k / case.steps * (case.target - case.start)
        velocity = (case.target - case.start) / case.duration
        states[k, 1] = module.momenta_of(case, states[k, 0], velocity)
    return states


def _iterations(settings: Settings, points: PointSet, kind: str) -> Values:
    module = settings.module("explicit-euler")
    case = module.make_case(points.start, points.target, PATHS_STEPS)
    solution = module.solve_case(case)
    exact = np.stack([solution.q, solution.p], axis=1)
    guess(module, case, kind)  # compiles what it needs
    begin = time.perf_counter()
    path = guess(module, case, kind)
    made = time.perf_counter() - begin
    distance = float(np.abs(path - exact)[:, 0].max()) if np.isfinite(path).all() else np.nan
    log, states = np.zeros((case.max_iterations + 1, 3)), np.zeros((case.steps * module.POINTS, *path.shape[1:]))
    path = np.ascontiguousarray(path)
    outcome, iterations, residual = module.all_states(case, module.preconditioner(case), path, states, log)
    return {
        "solved": outcome > 0,
        "iterations": iterations,
        "residual": residual,
        "seconds of the guess": made,
        "distance of places": distance,
        "first residual": float(log[0, 0]),
    }


SMOOTHNESS_SECTION = "smoothness"
AMPLITUDES = (0.5, 1.0, 2.0)
"""Displacements of the trilobites' landmarks as multiples of the given ones; the last stay inside the disc."""
SMOOTHNESS_STEPS = (1, 2, 3, 5, 10, 20, 40, 80)
_FINE, _ROWS = 640, 31


def smoothness_cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Explicit Euler warps of growing amplitude with ever more steps."""
    del store
    if settings.quick:
        return
    for amplitude in AMPLITUDES:
        for steps in (_FINE, *SMOOTHNESS_STEPS):
            name = f"amplitude {amplitude:g}; N {steps}"
            yield Case(SMOOTHNESS_SECTION, name, lambda a=amplitude, n=steps: _warp(settings, a, n))  # type: ignore[misc]


def stretched(points: PointSet, amplitude: float) -> PointSet:
    """The same landmarks with displacements multiplied."""
    return PointSet(points.start, points.start + amplitude * (points.target - points.start), points.sigma)


def grid() -> Vector:
    """Points of the square that the unit circle surrounds, shape (rows, rows, 2)."""
    line = np.linspace(-0.7, 0.7, _ROWS)
    return np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)


def _warp(settings: Settings, amplitude: float, steps: int) -> Values:
    module, points = settings.module("explicit-euler"), stretched(settings.landmarks, amplitude)
    solution = module.solve(points.start, points.target, steps)
    if solution.status != "solved":
        return {"status": solution.status, "steps": steps}
    warped, steepest = flow(module, solution, grid().reshape(-1, 2))
    warped = warped.reshape(_ROWS, _ROWS, 2)
    area = cell_areas(warped) / cell_areas(grid())
    return {
        "status": solution.status,
        "steps": steps,
        "least area": float(area.min()),
        "greatest area": float(area.max()),
        "steepest": steepest,
        "cost": solution.cost,
        "places": warped.round(9),
    }


def flow(module: ConnectModule, solution: Any, x: Vector) -> tuple[Vector, float]:
    """Where the steps of a solution carry points, and the greatest difference quotient of h v between neighbours."""
    count, steps = solution.q.shape[1], len(solution.q) - 1
    matrix, none = np.empty((count + len(x),) * 2), np.zeros((count + len(x), 0))
    steepest, spacing = 0.0, np.linalg.norm(grid()[0, 1] - grid()[0, 0])
    for q, p in zip(solution.q[:-1], solution.p[:-1], strict=True):
        places = np.concatenate([q, x])
        module.momentum_matrix(np.stack([places, np.zeros_like(places)]), none, np.zeros(0), matrix)
        step = (matrix[count:, :count] @ p) / steps
        field = step.reshape(_ROWS, _ROWS, 2)
        slopes = [np.linalg.norm(np.diff(field, axis=a), axis=-1).max() / spacing for a in (0, 1)]
        steepest, x = max(steepest, *slopes), x + step
    return x, float(steepest)


def cell_areas(places: Vector) -> Vector:
    """Signed areas of the cells of a grid, by their diagonals."""
    first, second = places[1:, 1:] - places[:-1, :-1], places[:-1, 1:] - places[1:, :-1]
    return 0.5 * (first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])
