"""Slacks s >= 0 turn an inequality g <= 0 into an equation g + s = 0."""

import numpy as np

from codegen.runtime.stand_ins.example import NODE, SLACK_MULTIPLIERS, SLACKS
from codegen.runtime.optimise.termination import HOLDS
from codegen.runtime.unknowns.time_grid import views
from codegen.runtime.unknowns.point import evaluate


def with_slacks(grid, unknowns):
    """A copy of `unknowns` (n,) whose slacks satisfy their equations where the inequalities hold; zero where not."""
    unknowns = unknowns.copy()
    _, intervals = views(grid, unknowns)
    intervals[:, :, SLACKS - NODE] = 0.0
    _, residuals = views(grid, evaluate(grid, unknowns).gradient)
    intervals[:, :, SLACKS - NODE] = np.maximum(0.0, -residuals[:, :, SLACK_MULTIPLIERS - NODE])
    return unknowns


def with_violations(grid, point):
    """The point, in whose gradient (unknowns,) the row of an inequality g <= 0 is by how much g exceeds zero.

    To the solver it is g + s, which may be huge where the inequality holds, while s is on its way. Rows stay what they
    are where nothing else is violated. Everything is in the problem's own units.
    """
    gradient = point.gradient.copy()
    (_, rows), (_, unknowns) = views(grid, gradient), views(grid, point.unknowns)
    violations = rows[:, :, SLACK_MULTIPLIERS - NODE] - unknowns[:, :, SLACKS - NODE]
    rows[:, :, SLACK_MULTIPLIERS - NODE] = np.maximum(violations, 0.0)
    holds = np.abs(gradient[grid.is_multiplier]).max() <= HOLDS
    return point if holds else point._replace(gradient=gradient)
