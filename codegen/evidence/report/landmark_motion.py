"""The motion of landmarks: jumps between paths, initial paths, the smoothness of warps.

Jumps. In Figures 5.8 and 5.9 of the thesis, time and error of the optimiser jump from one N to the next. The thesis
minimises 2 h sum H over positions and momenta at the nodes, both averaged on intervals. Only averages of momenta
matter: p_k + (-1)^k a has the same averages for every a, the same cost and the same constraints, so that the minimum is
never isolated. The generated module has one momentum for each interval. Both forms are given to scipy's SLSQP, from the
thesis's curved paths and from straight paths, with the thesis's tolerance 1e-6 and with a tight one. The results are
compared with Newton's solution of the same discrete problem.

Smoothness. The errors and folds of a warped grid show how many steps a smooth warp needs. Points without momentum
follow v(x) = sum_j p_j G(x, q_j). An explicit step x + h v(x) is one to one if h times the Lipschitz constant of v is
below one. A cell of the grid with a negative signed area shows a fold.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import minimize

from codegen.evidence.report.store import Case, Settings, Store, Values, few_landmarks, smooth_pair
from codegen.problem.points import PointSet
from codegen.solving import api
from codegen.solving.drivers.shared import quiet_single_thread
from codegen.solving.loading import ConnectModule, Matrix, Vector

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
        yield Case(JUMPS_SECTION, f"null space; nc {count}", partial(_null_space, count))
        for variant in VARIANTS:
            for steps in settings.steps:
                name = variant.case(count, steps)
                yield Case(JUMPS_SECTION, name, partial(_minimised, settings, count, steps, variant))
                values = store.get(JUMPS_SECTION, name)
                if values is not None and (values["seconds"] or 0.0) > settings.limit:
                    break


def _null_space(count: int) -> Values:
    """Return the numbers of directions of the unknowns that change neither cost nor constraints, by a matrix rank."""
    matrices = {momenta: unknowns(momenta, 2 * count, 10) for momenta in ("nodes", "intervals")}
    return {name: int(matrix.shape[1] - np.linalg.matrix_rank(matrix)) for name, matrix in matrices.items()}


def unknowns(momenta: str, size: int, steps: int) -> Matrix:
    """Return the matrix that maps the unknowns of the minimiser to the unknowns of the action.

    Both are inner positions (`size` entries per node), then momenta. The action has momenta on intervals. If `momenta`
    is "nodes", the minimiser has momenta on nodes, which are averaged between neighbours.
    """
    inner = (steps - 1) * size
    if momenta == "intervals":
        return np.eye(inner + steps * size)
    matrix = np.zeros((inner + steps * size, inner + (steps + 1) * size))
    matrix[:inner, :inner] = np.eye(inner)
    for k in range(steps):
        rows = slice(inner + k * size, inner + (k + 1) * size)
        for node in (k, k + 1):
            matrix[rows, inner + node * size : inner + (node + 1) * size] = 0.5 * np.eye(size)
    return matrix


def _straight_path(module: ConnectModule, case: Any) -> Vector:
    """Return the positions on straight lines at constant speed and their momenta, shape (N + 1, 2, n, d)."""
    states = np.zeros((case.steps + 1, 2, *case.start.shape))
    velocity = (case.target - case.start) / case.duration
    for k in range(case.steps + 1):
        states[k, 0] = case.start + k / case.steps * (case.target - case.start)
        states[k, 1] = module.momenta_of(case, states[k, 0], velocity)
    return states


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
    count = solution.q.shape[1]
    matrix, none = np.empty((count + len(x),) * 2), np.zeros((count + len(x), 0))
    steepest, spacing = 0.0, np.linalg.norm(grid()[0, 1] - grid()[0, 0])
    for q, p in zip(solution.q[:-1], solution.p[:-1], strict=True):
        positions = np.concatenate([q, x])
        module.momentum_matrix(np.stack([positions, np.zeros_like(positions)]), none, np.zeros(0), matrix)
        step = (matrix[count:, :count] @ p) / (len(solution.q) - 1)
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
