"""Whether nothing but rounding is left, so that no step makes progress."""

from codegen.runtime.optimise.convergence_test import UNIT_ROUNDOFF, sizes_of_terms


def is_at_rounding_level(grid, point):
    """Whether residual and stationarity are no larger than a thousand rounding errors."""
    sizes = sizes_of_terms(grid, point.unknowns)
    return point.residual <= 1e3 * UNIT_ROUNDOFF * sizes[0] and point.stationarity <= 1e3 * UNIT_ROUNDOFF * sizes[1]
