"""Better initial paths: how many iterations the solve for all states takes from several guesses (thesis, chapter 6)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from codegen.author.points import PointSet
from codegen.interfaces import ConnectModule
from codegen.report.measure.accuracy import points_of
from codegen.report.settings import Settings, smooth_pair
from codegen.report.store import Case, Store, Values

SECTION = "initial paths"
KINDS = {
    "straight": "straight lines at constant speed",
    "curved": "the thesis's curved paths, exact for a single landmark",
    "spline": "the flow of the clamped-plate spline: explicit steps from the momenta of the straight way",
    "shot": "the trajectory after two steps of Broyden's or Newton's method of shooting",
    "coarse": "the solution with a fifth of the steps, interpolated",
}
STEPS = 20


def cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Every guess on few landmarks, on the trilobites, and on a hundred random ones."""
    del store
    if settings.quick:
        return
    sets = {f"nc {n}": points_of(settings, n) for n in (*settings.counts, 40)} | {"nc 100, smooth": smooth_pair(100)}
    for name, points in sets.items():
        for kind in KINDS:
            yield Case(SECTION, f"{kind}; {name}", lambda p=points, k=kind: _iterations(settings, p, k))  # type: ignore[misc]


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
    case = module.make_case(points.start, points.target, STEPS)
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
