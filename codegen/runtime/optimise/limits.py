"""Which unknowns lie on their bounds, and which prescribed values beyond them."""

import numpy as np

from codegen.runtime.stand_ins.example import metadata, variable_bounds
from codegen.runtime.unknowns.frame import views

LEAST_SLACK = 1e-7  # slacks below minus this are no rounding
END_NAMES = "start", "end"


def bounds_of(grid):
    """Least and greatest values of all unknowns, in parts of sizes where the grid has them."""
    return grid.bounds or variable_bounds(grid)


def units_of(grid):
    """The sizes of all unknowns, ones where the grid has none."""
    return grid.sizes if grid.sizes.size else np.ones(grid.is_multiplier.size)


def at_limits(grid, unknowns):
    """Boolean mask of the unknowns within a millionth of a bound, which an interior point method never reaches."""
    lower, upper = bounds_of(grid)
    scale = 1e-6 * np.maximum(1.0, np.abs(unknowns))
    return (unknowns - lower <= scale) | (upper - unknowns <= scale)


def prescribed_beyond(grid, unknowns):
    """Which prescribed value or path condition at an end violates what holds farther inside, or nothing.

    Unknowns are in the problem's own units; what is negligible is so in parts of sizes where the grid has them.
    Bounds are imposed where something is free to meet them: a motion that begins beyond its bound would leap inside
    within the first interval.
    """
    steps, units = grid.steps, units_of(grid)
    nodes, intervals = views(grid, unknowns / units)
    if steps == 1:
        return ""
    (low, least), (high, _) = (views(grid, bound) for bound in bounds_of(grid))
    ends, inner = np.s_[:, ::steps], np.s_[:, 1 : steps : max(1, steps - 2)]
    given, margin = nodes[ends], 1e-9 * np.maximum(1.0, np.abs(nodes[ends]))
    beyond = (given < low[inner] - margin) | (given > high[inner] + margin)
    if beyond.any():
        beyond &= np.isinf(low[ends]) & np.isinf(high[ends])
        for body, end, i in np.argwhere(beyond)[:1]:
            unit, k = views(grid, units)[0][body, 0, i], (1, -2)[end]
            limits = f"{unit * low[body, k, i]:g} to {unit * high[body, k, i]:g}"
            value = f"{metadata['node'][i]} is prescribed as {unit * given[body, end, i]:g}"
            return f"{value} at the {END_NAMES[end]}, beyond its bounds {limits}"
    ends, inner = np.s_[:, :: steps - 1], np.s_[:, 1 : steps - 1 : max(1, steps - 3)] if steps > 2 else np.s_[:, ::-1]
    violated = intervals[ends] < least[inner] - LEAST_SLACK
    if violated.any():
        violated &= least[ends] < least[inner]  # a slack of what is prescribed has no bound there
        for _, end, i in np.argwhere(violated)[:1]:
            name = metadata["interval"][i]
            condition = metadata["meanings"].get(name, name).removeprefix("slack of ").partition(" at ")[0]
            return f"what is prescribed at the {END_NAMES[end]} violates {condition}"
    return ""
