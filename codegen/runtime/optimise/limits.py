"""Which unknowns lie on their bounds, and which prescribed values beyond them."""

import numpy as np

from codegen.runtime.stand_ins.example import metadata, variable_bounds
from codegen.runtime.unknowns.frame import views

LEAST_SLACK = 1e-7  # slacks below minus this are no rounding
END_NAMES = "start", "end"


def bounds_of(grid):
    """Least and greatest values of all unknowns, in parts of sizes where the grid has them."""
    return grid.bounds or variable_bounds(grid)


def at_limits(grid, unknowns):
    """Boolean mask of the unknowns within a millionth of a bound, which an interior point method never reaches."""
    lower, upper = bounds_of(grid)
    scale = 1e-6 * np.maximum(1.0, np.abs(unknowns))
    return (unknowns - lower <= scale) | (upper - unknowns <= scale)


def prescribed_beyond(grid, unknowns):
    """Which prescribed value or path condition at an end violates what holds farther inside, or nothing.

    Bounds are imposed where something is free to meet them: a motion that begins beyond its bound would leap inside
    within the first interval.
    """
    steps, (nodes, intervals) = grid.steps, views(grid, unknowns)
    if steps == 1:
        return ""
    (low, least), (high, _) = (views(grid, bound) for bound in bounds_of(grid))
    ends, inner = np.s_[:, ::steps], np.s_[:, 1 : steps : max(1, steps - 2)]
    given, margin = nodes[ends], 1e-9 * np.maximum(1.0, np.abs(nodes[ends]))
    beyond = (given < low[inner] - margin) | (given > high[inner] + margin)
    if beyond.any():
        beyond &= np.isinf(low[ends]) & np.isinf(high[ends])
        for body, end, i in np.argwhere(beyond)[:1]:
            limits = f"{low[body, (1, -2)[end], i]:g} to {high[body, (1, -2)[end], i]:g}"
            value = f"{metadata['node'][i]} is prescribed as {given[body, end, i]:g}"
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
