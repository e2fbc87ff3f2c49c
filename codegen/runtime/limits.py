"""Which unknowns lie on their bounds, and which prescribed values beyond them."""

import numpy as np

from codegen.runtime.example import metadata, variable_bounds
from codegen.runtime.frame import views

LEAST_SLACK = 1e-7  # slacks below minus this are no rounding


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
    bounds, values = variable_bounds(grid), views(grid, unknowns)
    (low, least), (high, _) = (views(grid, bound) for bound in bounds)
    for where, k, inner in (("start", 0, 1), ("end", -1, -2)) if grid.steps > 1 else ():
        for i, name in enumerate(metadata["node"]):
            value, without = values[0][:, k, i], np.isinf(low[:, k, i]) & np.isinf(high[:, k, i])
            margin = 1e-9 * np.maximum(1.0, np.abs(value))
            beyond = (value < low[:, inner, i] - margin) | (value > high[:, inner, i] + margin)
            for body in np.flatnonzero(without & beyond)[:1]:
                limits = f"{low[body, inner, i]:g} to {high[body, inner, i]:g}"
                return f"{name} is prescribed as {value[body]:g} at the {where}, beyond its bounds {limits}"
        for i, name in enumerate(metadata["interval"]):
            released = least[:, k, i] < least[:, inner, i]  # a slack of what is prescribed
            if (released & (values[1][:, k, i] < least[:, inner, i] - LEAST_SLACK)).any():
                condition = metadata["meanings"].get(name, name).removeprefix("slack of ").partition(" at ")[0]
                return f"what is prescribed at the {where} violates {condition}"
    return ""
