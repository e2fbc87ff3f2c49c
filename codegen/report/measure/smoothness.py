"""How many steps a smooth warp needs: errors and folds of the warp of the whole disc against the number of steps.

Points that carry no momentum follow v(x) = sum_j p_j G(x, q_j). An explicit step x + h v(x) is one to one where
h times the Lipschitz constant of v is below one; cells of a grid whose signed area becomes negative show a fold.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from codegen.author.points import PointSet
from codegen.interfaces import ConnectModule, Vector
from codegen.report.settings import Settings
from codegen.report.store import Case, Store, Values

SECTION = "smoothness"
AMPLITUDES = (0.5, 1.0, 2.0)
"""Displacements of the trilobites' landmarks as multiples of the given ones; the last stay inside the disc."""
STEPS = (1, 2, 3, 5, 10, 20, 40, 80)
_FINE, _ROWS = 640, 31


def cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Explicit Euler warps of growing amplitude with ever more steps."""
    del store
    if settings.quick:
        return
    for amplitude in AMPLITUDES:
        yield Case(SECTION, f"amplitude {amplitude:g}; N {_FINE}", lambda a=amplitude: _warp(settings, a, _FINE))  # type: ignore[misc]
        for steps in STEPS:
            name = f"amplitude {amplitude:g}; N {steps}"
            yield Case(SECTION, name, lambda a=amplitude, n=steps: _warp(settings, a, n))  # type: ignore[misc]


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
