"""The result of a simulation, with residuals that are evaluated outside the driver where all states are stored."""

from __future__ import annotations

import math

import numpy as np

from codegen.runtime.record import Record
from codegen.solving.interfaces import Matrix, SimulateModule
from codegen.solving.results.result import (
    Outline,
    Result,
    Run,
    SimulateAttempt,
    component_names,
    contradicted,
    max_norm,
    origin,
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


def stored_numbers(metadata: Record, run: Run) -> int:
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
