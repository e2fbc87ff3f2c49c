"""What a solve is worth within a sampling time: its equations evaluated again, and which of two plans is applied."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.loading import Grid, Vector
from codegen.solutions.control import control_verdict
from codegen.solutions.result import ControlAttempt, Run

ALLOWED = 10.0
"""Times the tolerance that residual and slopes of a solution may be, as in `control_verdict`."""


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """A plan, `unknowns` (n,), with what is evaluated there outside the solver: gradient, cost, and residual."""

    unknowns: Vector
    gradient: Vector
    cost: float
    residual: float


def candidate(module: Any, grid: Grid, unknowns: Vector) -> Candidate:
    """A plan with its equations evaluated."""
    point = module.evaluate(grid, unknowns)
    return Candidate(unknowns, point.gradient, float(point.cost), float(point.residual))


def is_solution(module: Any, grid: Grid, found: Candidate, run: Run, iterations: int, tolerance: float) -> bool:
    """Whether all equations hold at what a solver calls solved.

    Most often residual and slopes are within the tolerance as they stand. Else sizes, rounding and large multipliers
    decide, as they do for every driver, which takes ten times as long.
    """
    if found.residual <= ALLOWED * tolerance and _steepest(module, grid, found) <= ALLOWED * tolerance:
        return True
    claim = ControlAttempt("solved", "", iterations, found.unknowns, tolerance)
    return control_verdict(module, "newton", run, claim, grid).status == "solved"


def _steepest(module: Any, grid: Grid, found: Candidate) -> float:
    """The largest slope of the Lagrangian times the distance to the bound that it leads to, one where that is far."""
    slopes = np.where(grid.is_multiplier, 0.0, found.gradient)
    if module.metadata["inequalities"]:
        lower, upper = module.bounds_of(grid)
        distances = np.where(slopes > 0.0, found.unknowns - lower, upper - found.unknowns)
        slopes *= np.minimum(np.maximum(distances, 0.0), 1.0)
    return float(np.abs(slopes).max())


def better(one: Candidate, other: Candidate, feasible: float) -> Candidate:
    """The first of two plans unless the other is better.

    That is one whose equations hold to `feasible` where those of the first do not; of two that do, the cheaper one; of
    two that do not, the one with the smaller residual.
    """
    violations = max(one.residual, feasible), max(other.residual, feasible)
    if not violations[0] < np.inf or violations[1] < violations[0]:
        return other
    return other if violations[1] == violations[0] and other.cost < one.cost else one
