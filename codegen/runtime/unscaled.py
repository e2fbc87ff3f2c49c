"""A linear-quadratic problem needs no scaling: one Newton step is the same in all units."""

from codegen.runtime.messages import describe
from codegen.runtime.newton_linear import minimise


def optimise(grid, unknowns, tolerance, max_iterations, warm, scaling, log):
    """Minimise; return (status, message, point, iterations). `scaling` has no effect."""
    status, point, iterations = minimise(grid, unknowns, tolerance, max_iterations, warm, log)
    return *describe(grid, unknowns, point, status), point, iterations
