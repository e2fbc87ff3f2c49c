"""Bounds of unknowns, and the slacks s >= 0 that turn an inequality g <= 0 into an equation g + s = 0."""

import numpy as np
from numba import njit

from codegen.runtime.search.grid import free_unknowns, views
from codegen.runtime.search.point import evaluate

LEAST_SLACK = 1e-7  # a slack below -LEAST_SLACK is not a rounding error
UNSURE = 10.0  # possible error of a value that end conditions determine, relative to the residual of the equations
HOLDS = 1e-9  # an equation with a smaller residual counts as satisfied
END_NAMES = "start", "end"


def bounds_of(grid):
    """Return the least and the greatest values (n,) of all unknowns, divided by the grid's scaling factors if any."""
    if grid.bounds:
        return grid.bounds
    if grid.problem.variable_bounds is not None:
        return grid.problem.variable_bounds(grid)
    return np.full(grid.is_multiplier.size, -np.inf), np.full(grid.is_multiplier.size, np.inf)


def units_of(grid):
    """Return the scaling factors (n,) of all unknowns, which are ones if the grid has no scaling factors."""
    return grid.sizes if grid.sizes.size else np.ones(grid.is_multiplier.size)


def at_bounds(grid, unknowns):
    """Return the mask (n,) of the unknowns within a relative distance of a millionth of a bound.

    An interior-point method never reaches the bound itself.
    """
    lower, upper = bounds_of(grid)
    scale = 1e-6 * np.maximum(1.0, np.abs(unknowns))
    return (unknowns - lower <= scale) | (upper - unknowns <= scale)


def contradictory_bounds(grid):
    """Return the index of an unknown whose least value is above its greatest value, or -1 without such an unknown."""
    lower, upper = bounds_of(grid)
    (indices,) = (lower > upper).nonzero()
    return int(indices[0]) if indices.size else -1


def prescribed_beyond(grid, unknowns):
    """Return a text on a prescribed value or path constraint at an end that violates bounds, or "" without a violation.

    A prescribed value has no bounds itself. It is compared with the bounds of the same unknown at the next node, since
    a motion that begins outside these would jump inside in the first interval. Unknowns are in the problem's own units.
    Margins are relative to scaling factors if the grid has them.
    """
    if grid.steps == 1 or grid.problem.variable_bounds is None:
        return ""
    s, metadata = grid.problem.structure, grid.problem.metadata
    units, (lower, upper), sizes = units_of(grid), bounds_of(grid), (s.bodies, s.stride, s.node, grid.steps)
    index, inner = first_beyond(*sizes, unknowns, units, lower, upper, 0.0)
    if index >= 0 and free_unknowns(grid)[index]:
        # Conditions at the end determine this unknown, only as accurately as the conditions are satisfied.
        unsure = UNSURE * evaluate(grid, unknowns / units).residual
        index, inner = first_beyond(*sizes, unknowns, units, lower, upper, unsure)
    if index < 0:
        return ""
    local = index % (grid.steps * s.stride + s.node)
    end, i = END_NAMES[local >= s.stride], local % s.stride
    if i < s.node:
        limits = f"{units[index] * lower[inner]:g} to {units[index] * upper[inner]:g}"
        return f"{metadata.node[i]} is prescribed as {unknowns[index]:g} at the {end}, beyond its bounds {limits}"
    name = metadata.interval[i - s.node]
    condition = metadata.meanings[name].subject if name in metadata.meanings else name
    return f"what is prescribed at the {end} violates {condition}"


@njit(cache=True, error_model="numpy")
def first_beyond(bodies, stride, node, steps, unknowns, units, lower, upper, unsure):
    """Return the index of the first unknown at an end that violates the bounds of its neighbour, and of the neighbour.

    The neighbour is the same unknown at the next node or on the next interval. `unknowns`, `units`, `lower` and `upper`
    are (n,). Prescribed values have no bounds themselves, and have an error of up to `unsure`. Slacks of prescribed
    values have no least value. Both indices are -1 if no unknown violates bounds.
    """
    for body in range(bodies):
        for i in range(stride):
            start = body * (steps * stride + node) + i
            end = start + (steps if i < node else steps - 1) * stride
            for index, inner in ((start, start + stride), (end, end - stride)):
                value, least, greatest = unknowns[index] / units[index], lower[inner], upper[inner]
                margin = max(unsure, 1e-9 * max(1.0, abs(value))) if i < node else LEAST_SLACK
                is_below = lower[index] < least and value < least - margin
                is_above = upper[index] > greatest and value > greatest + margin
                is_given = lower[index] == -np.inf and upper[index] == np.inf
                if (i < node and is_given and (is_below or is_above)) or (i >= node and is_below):
                    return index, inner
    return -1, -1


def determined_slacks(grid):
    """Return the mask (n,) of slacks that equations determine; the bounds of these slacks are below zero."""
    s, slacks = grid.problem.structure, np.zeros(grid.is_multiplier.size)
    _, intervals = views(grid, slacks)
    intervals[:, :, s.slacks - s.node] = 1.0
    lower, _ = bounds_of(grid)
    return (slacks > 0.0) & (lower < 0.0)


def with_slacks(grid, unknowns):
    """Return `unknowns` (n,) with slacks that satisfy their equations, or are zero for violated inequalities."""
    s, unknowns = grid.problem.structure, unknowns.copy()
    _, intervals = views(grid, unknowns)
    intervals[:, :, s.slacks - s.node] = 0.0
    _, residuals = views(grid, evaluate(grid, unknowns).gradient)
    intervals[:, :, s.slacks - s.node] = np.maximum(0.0, -residuals[:, :, s.slack_multipliers - s.node])
    return unknowns


def with_violations(grid, point):
    """Return `point` with the violation of each inequality g <= 0 in place of the residual of its equation g + s = 0.

    During a search g + s may be large although the inequality holds. The point stays unchanged if neither an equation
    nor an inequality is violated. Everything is in the problem's own units.
    """
    s, gradient = grid.problem.structure, point.gradient.copy()
    (_, rows), (_, unknowns) = views(grid, gradient), views(grid, point.unknowns)
    violations = rows[:, :, s.slack_multipliers - s.node] - unknowns[:, :, s.slacks - s.node]
    rows[:, :, s.slack_multipliers - s.node] = np.maximum(violations, 0.0)
    holds = np.abs(gradient[grid.is_multiplier]).max() <= HOLDS
    return point if holds else point._replace(gradient=gradient)
