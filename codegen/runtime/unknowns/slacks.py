"""Slacks s >= 0 turn an inequality g <= 0 into an equation g + s = 0."""

import numpy as np

from codegen.runtime.stand_ins.example import NODE, SLACK_MULTIPLIERS, SLACKS
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
