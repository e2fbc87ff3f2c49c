"""What happens inside the optimiser of the thesis's Figures 5.8 and 5.9: momenta on nodes, and loose tolerances.

The thesis minimises 2 h sum H over places and momenta at the nodes, both averaged on intervals. Only averages of
momenta act: p_k + (-1)^k a has the same averages for every a, costs as much and obeys the same constraints, so that the
minimum is never isolated. Ours has one momentum for each interval. Both are given to scipy's SLSQP, from the thesis's
curved paths and from straight ones, with the thesis's tolerance 1e-6 and with a tight one, and compared with Newton's
solution of the same discrete problem.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

from codegen import solving
from codegen.drivers.quiet import quiet_single_thread
from codegen.interfaces import ConnectModule, Matrix, Vector
from codegen.report.settings import Settings, few_landmarks
from codegen.report.store import Case, Store, Values

SECTION = "jumps"
LOOSE, TIGHT = 1e-6, 1e-14
VARIANTS = tuple(
    (place, path, tolerance)
    for place in ("nodes", "intervals")
    for path in ("curved", "straight")
    for tolerance in (LOOSE, TIGHT)
)


def cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Every variant with ever more steps until a solve takes longer than the limit."""
    if settings.quick:
        return
    for count in settings.counts[:2]:
        yield Case(SECTION, f"null space; nc {count}", lambda count=count: _null_space(settings, count))  # type: ignore[misc]
        for place, path, tolerance in VARIANTS:
            for steps in settings.steps:
                name = case_name(place, path, tolerance, count, steps)

                def measure(
                    n: int = steps, c: int = count, v: tuple[str, str, float] = (place, path, tolerance)
                ) -> Values:
                    return _minimised(settings, c, n, *v)

                yield Case(SECTION, name, measure)
                values = store.get(SECTION, name)
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
    exact = solving.solve(module, points=points, steps=steps).cost
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
