"""A linear-quadratic problem needs no scaling: one Newton step is the same in all units."""

from codegen.runtime.optimise.messages import describe
from codegen.runtime.optimise.newton_linear import minimise
from codegen.runtime.unknowns.point import lagrangian
from codegen.runtime.optimise.termination import final_status


def optimise(grid, unknowns, tolerance, max_iterations, warm, scaling, log):
    """Minimise; return (status, message, point, iterations, grid). `scaling` has no effect."""
    status, point, iterations = minimise(grid, unknowns, tolerance, max_iterations, warm, log)
    status = final_status(grid, unknowns, point, status)
    status, message = describe(grid, unknowns, point, status)
    if status == "solved":
        point = point._replace(cost=corrected_cost(grid, point))
    return status, message, point, iterations, grid


def corrected_cost(grid, point):
    """The cost less what the residuals are worth."""
    return float(lagrangian(grid, point))


def scaled_grid(grid, unknowns):
    """The grid as it is."""
    return grid
