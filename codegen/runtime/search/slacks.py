"""Slacks s >= 0 turn an inequality g <= 0 into an equation g + s = 0."""

import numpy as np

from codegen.runtime.search.grid import views
from codegen.runtime.search.point import evaluate
from codegen.runtime.search.termination import HOLDS


def with_slacks(grid, unknowns):
    """Return `unknowns` (n,) with slacks that satisfy their equations; zero if an inequality does not hold."""
    s, unknowns = grid.problem.structure, unknowns.copy()
    _, intervals = views(grid, unknowns)
    intervals[:, :, s.slacks - s.node] = 0.0
    _, residuals = views(grid, evaluate(grid, unknowns).gradient)
    intervals[:, :, s.slacks - s.node] = np.maximum(0.0, -residuals[:, :, s.slack_multipliers - s.node])
    return unknowns


def with_violations(grid, point):
    """Return the point, in whose gradient (unknowns,) the row of an inequality g <= 0 is by how much g exceeds zero.

    To the solver it is g + s, which may be huge where the inequality holds, while s is on its way. Rows stay what they
    are where nothing else is violated. Everything is in the problem's own units.
    """
    s, gradient = grid.problem.structure, point.gradient.copy()
    (_, rows), (_, unknowns) = views(grid, gradient), views(grid, point.unknowns)
    violations = rows[:, :, s.slack_multipliers - s.node] - unknowns[:, :, s.slacks - s.node]
    rows[:, :, s.slack_multipliers - s.node] = np.maximum(violations, 0.0)
    holds = np.abs(gradient[grid.is_multiplier]).max() <= HOLDS
    return point if holds else point._replace(gradient=gradient)
