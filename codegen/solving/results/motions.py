"""The result of a simulation, with residuals that are evaluated outside the driver where all states are stored.

The result of a connect problem, with residuals that are evaluated outside the driver.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from codegen.errors import PointsError
from codegen.runtime.record import Record
from codegen.solving.loading import ConnectModule, Matrix, SimulateModule, Vector
from codegen.solving.results.result import (
    ConnectAttempt,
    Outline,
    Result,
    Run,
    SimulateAttempt,
    component_names,
    contradicted,
    max_norm,
    origin,
    other_driver,
    outline_of,
)

UNITS = 1e4
"""How many times larger than rounding errors the changes are by which their effect is measured."""


def simulate_result(
    module: SimulateModule, driver: str, run: Run, attempt: SimulateAttempt, seconds: float = math.nan
) -> Result:
    """Re-evaluate the residual of an attempt, and downgrade a false claim of success."""
    metadata = module.metadata
    # What rounding may leave of residuals of ordinary equations; those of a variational step divide by h.
    step = attempt.t[-1] / max(attempt.steps, 1)
    size = max(1.0, max_norm(attempt.q), max_norm(attempt.p)) * max(1.0, 1.0 / step if step > 0.0 else 1.0)
    residual, rounding = attempt.residual, (1e3 * float(np.finfo(float).eps) * size)
    if run.every == 1 and attempt.t.size > 1:
        residual = module.path_residual(module.make_grid(run.steps), np.hstack([attempt.q, attempt.p]))
        if residual > max(attempt.tolerance, rounding):
            rounding = max(rounding, 10.0 * rounding_level(module, run.steps, attempt.q, attempt.p))
    status, message = attempt.status, attempt.message
    if status == "solved" and not residual <= max(attempt.tolerance, rounding):
        finding = f"the scheme's equations have residual {residual:.1e}"
        status, message = contradicted(driver, finding, "try more steps")
    if status == "solved" and not attempt.generated and (first_outside := getattr(module, "first_outside", None)):
        number, range_left = first_outside(module.make_grid(run.steps), np.hstack([attempt.q, attempt.p]))
        if number and run.every == 1:
            status, message = "outside a table", f"outside a table in step {number} of {run.steps}: {range_left}"
    names = component_names(metadata)
    drift, final_change = np.abs(attempt.energy - attempt.energy[0]), attempt.energy[-1] - attempt.energy[0]
    final = dict(zip((*names["q"], *names["p"]), (*attempt.q[-1], *attempt.p[-1]), strict=True))
    is_kept = metadata.conservative
    summary = {
        "duration": float(attempt.t[-1]),
        **{f"final_{name}": float(value) for name, value in final.items()},
        # What drives or damps a motion changes its energy, which is no error of the scheme then.
        ("energy_drift" if is_kept else "energy_change"): float(drift.max() if is_kept else final_change),
        "steps_per_second": attempt.steps / seconds if seconds > 0.0 else float("inf"),
    }
    return Result(
        **origin(metadata, driver, run, attempt, seconds), status=status, message=message, residual=float(residual),
        t=attempt.t, q=attempt.q, p=attempt.p, energy=attempt.energy, names=names, summary=summary,
        labels={f"final_{name}": f"final {name}" for name in final},
    )  # fmt: skip


def simulate_outline(module: SimulateModule, driver: str, run: Run, attempt: SimulateAttempt) -> Outline:
    """The verdict on an attempt, and the motion."""
    return outline_of(simulate_result(module, driver, run, attempt))


def simulate_numbers(metadata: Record, run: Run) -> int:
    """How many numbers are kept: the path, its positions and momenta, times and energies."""
    return (run.steps // run.every + 1) * (4 * len(metadata.coordinates) + 2)


def rounding_level(module: SimulateModule, steps: int, q: Matrix, p: Matrix) -> float:
    """By how much the residual of consecutive states, shapes (M, n), changes with two units in their last place.

    Stiff forces make much of it: a place that is rounded is pulled back by the stiffness. Measured with changes that
    are larger by UNITS, less what the residual was before, so that no wrong state raises the level. Zero if nothing is
    finite.
    """
    path, grid = np.hstack([q, p]), module.make_grid(steps)
    signs = np.where(np.add.outer(np.arange(path.shape[0]), np.arange(path.shape[1])) % 2, 1.0, -1.0)
    moved = path + 2.0 * UNITS * signs * np.spacing(np.abs(path).max(axis=0))
    level = (float(module.path_residual(grid, moved)) - float(module.path_residual(grid, path))) / UNITS
    return max(0.0, level) if np.isfinite(level) else 0.0


def intersecting_paths(start: Vector, target: Vector) -> list[tuple[int, int]]:
    """Numbers, from 1, of points whose segments from start to target, arrays of shape (n, d), cross; none unless d = 2.

    Segments that only touch or overlap are not counted.
    """
    found = list[tuple[int, int]]()
    if start.shape[1] != 2:
        return found
    for i in range(len(start) - 1):
        p, q, r, s = start[i], target[i], start[i + 1 :], target[i + 1 :]
        apart = _side(p, q, r) * _side(p, q, s) < 0.0
        both = apart & (_side(r, s, p) * _side(r, s, q) < 0.0)
        found += [(i + 1, i + 2 + int(j)) for j in np.flatnonzero(both)]
    return found


def _side(a: Vector, b: Vector, c: Vector) -> Vector:
    left: Vector = (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1])
    return left - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])


TOLERANCE = 1e-12


def connect_result(
    module: ConnectModule, driver: str, run: Run, attempt: ConnectAttempt, seconds: float = math.nan
) -> Result:
    """Re-evaluate every step and the arrival, and downgrade a false claim of success."""
    metadata, case, path = module.metadata, case_of(module, run), attempt.path
    energy = np.array([module.hamiltonian(np.ascontiguousarray(z), case.own, case.parameters) for z in path])
    residual, cost, arrival = _measured(module, case, path, energy)
    status, message = attempt.status, attempt.message
    if status == "solved" and not residual <= 10.0 * attempt.tolerance:
        status, message = contradicted(driver, f"the equations have residual {residual:.1e}", other_driver(attempt))
    crossed = intersecting_paths(case.start, case.target)
    if status != "solved" and crossed:
        one, other = crossed[0]
        message += f"; the straight ways of {len(crossed)} pairs of points cross, first those of {one} and {other}"
    summary = {
        "particles": float(case.start.shape[0]),
        "largest_arrival_error": float(arrival.max()),
        "mean_arrival_error": float(arrival.mean()),
        "largest_miss": float(np.abs(path[-1, 0] - case.target).max()),
        "condition_number": condition_number(module, case),
        "crossing_pairs": float(len(crossed)),
        "energy_drift": float(np.abs(energy - energy[0]).max()),
        "domain_margin": min(float(module.domain_margin(np.ascontiguousarray(z))) for z in path),
        "attempts": float(max(1, len(attempt.attempts))),
        "tangents": float(attempt.tangents),
    }
    return Result(
        **origin(metadata, driver, run, attempt, seconds), status=status, message=message, cost=cost, residual=residual,
        t=case.duration / case.steps * np.arange(case.steps + 1), q=path[:, 0].reshape(case.steps + 1, -1),
        p=path[:, 1].reshape(case.steps + 1, -1), energy=energy, names=particle_names(metadata, case.start.shape[0]),
        summary=summary, attempts=attempt.attempts,
    )  # fmt: skip


def connect_outline(module: ConnectModule, driver: str, run: Run, attempt: ConnectAttempt) -> Outline:
    """The verdict on an attempt, and the motion."""
    return outline_of(connect_result(module, driver, run, attempt))


def _measured(module: ConnectModule, case: Any, path: Any, energy: Vector) -> tuple[float, float, Vector]:
    """The residual of all equations, the cost, and by how much each point misses its target; NaN where nothing is."""
    finite = bool(np.isfinite(path).all())
    errors, end = module.path_errors(case, path) if finite else (np.full(1, np.nan), np.full(case.start.size, np.nan))
    arrival: Vector = np.abs(end).reshape(case.start.shape)
    if module.metadata.adaptive:
        # The steps are the integrator's own; what remains to be checked is where it arrives.
        return max_norm(end), float(2.0 * case.duration * energy[:-1].mean()), arrival
    cost = float(module.path_cost(case, path)) if finite else math.nan
    return max(max_norm(errors.ravel()), max_norm(end)), cost, arrival


def particle_names(metadata: Record, count: int) -> dict[str, tuple[str, ...]]:
    """The names of the columns of arrays, coordinates of one particle after the other."""
    groups = {"q": metadata.coordinates, "p": metadata.rates, "u": ()}
    return {key: tuple(f"{name}_{i + 1}" for i in range(count) for name in group) for key, group in groups.items()}


def connect_numbers(metadata: Record, run: Run) -> int:
    """How many numbers are kept: states at all nodes with what Newton's method makes of them, and two matrices."""
    count = 0 if run.points is None else len(run.points.start)
    return 40 * (run.steps + 1) * count * len(metadata.coordinates) + 2 * count**2


def case_of(module: ConnectModule, run: Run) -> Any:
    """The points that a run carries, checked by the module; PointsError tells what is wrong with them."""
    points = run.points
    if points is None:
        raise PointsError("there are no points to connect", "give a file of points")
    tolerance = TOLERANCE if run.tolerance is None or module.metadata.adaptive else run.tolerance
    try:
        return module.make_case(
            points.start, points.target, run.steps, sigma=points.sigma, tolerance=min(tolerance, 1e-6)
        )
    except ValueError as error:
        raise PointsError(str(error), "correct the points, or the arguments") from error


def condition_number(module: ConnectModule, case: Any, most: int = 1500) -> float:
    """The condition number of H_pp at the start in the 2-norm; NaN beyond that many rows."""
    size = case.start.shape[0] * int(module.BLOCKS)
    if size > most:
        return math.nan
    matrix = np.empty((size, size))
    module.momentum_matrix(np.stack([case.start, np.zeros_like(case.start)]), case.own, case.parameters, matrix)
    return float(np.linalg.cond(matrix)) if np.isfinite(matrix).all() else math.nan
