"""Which unknowns lie on their bounds, and which prescribed values beyond them."""

import numpy as np

from codegen.runtime.example import BODIES, NODE, STRIDE, metadata, variable_bounds
from codegen.runtime.layout import free_unknowns


def bounds_of(grid):
    """Least and greatest values of all unknowns, in parts of sizes where the grid has them."""
    lower, upper = variable_bounds(grid)
    if grid.sizes.size:
        return lower / grid.sizes, upper / grid.sizes
    return lower, upper


def at_limits(grid, unknowns):
    """Boolean mask of the unknowns within a millionth of a bound, which an interior point method never reaches."""
    lower, upper = bounds_of(grid)
    scale = 1e-6 * np.maximum(1.0, np.abs(unknowns))
    return (unknowns - lower <= scale) | (upper - unknowns <= scale)


def prescribed_beyond(grid, unknowns):
    """Which prescribed end value violates the bound that holds at the next inner node, or nothing.

    Bounds are imposed where something is free to meet them: a motion that begins beyond its bound would leap inside
    within the first interval.
    """
    lower, upper = variable_bounds(grid)
    pinned, chain = ~free_unknowns(grid), grid.steps * STRIDE + NODE
    last = chain - NODE
    for first in range(0, BODIES * chain if grid.steps > 1 else 0, chain):
        for end, here, inner in (("start", first, first + STRIDE), ("end", first + last, first + last - STRIDE)):
            for i, name in enumerate(metadata["node"]):
                if not pinned[here + i]:
                    continue
                value, low, high = unknowns[here + i], lower[inner + i], upper[inner + i]
                margin = 1e-9 * max(1.0, abs(value))
                if not low - margin <= value <= high + margin:
                    return f"{name} is prescribed as {value:g} at the {end}, beyond its bounds {low:g} to {high:g}"
    return ""
