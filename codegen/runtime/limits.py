"""Which unknowns lie on their bounds."""

import numpy as np

from codegen.runtime.example import variable_bounds


def at_limits(grid, unknowns):
    """Boolean mask of the unknowns within a millionth of a bound, which an interior point method never reaches."""
    lower, upper = variable_bounds(grid)
    scale = 1e-6 * np.maximum(1.0, np.abs(unknowns))
    return (unknowns - lower <= scale) | (upper - unknowns <= scale)
