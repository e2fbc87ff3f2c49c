"""The continuation of problems with contact forces: the relaxation of products of forces and gaps is reduced.

The parameter epsilon of the grid is the final relaxation. The first search has the relaxation FIRST times epsilon, and
each further search begins with the solution of the search before it. The first reductions are small, because contacts
form and part; below SETTLED times epsilon they rarely do. If a search fails, the relaxation is reduced by smaller
factors. Source: Scholtes (2001), Convergence properties of a regularization scheme for mathematical programs
with complementarity constraints, SIAM Journal on Optimization 11.
"""

import math

import numpy as np

FIRST, SETTLED = 1e9, 2e4  # relaxations, relative to the final relaxation
SLOWLY, QUICKLY = math.sqrt(10.0), 100.0  # factors by which larger and smaller relaxations are reduced
LEAST_FACTOR = 1.2  # least factor of a reduction after failures
LOOSE = 1e-6  # tolerance of all searches but the last


def relaxation_column(grid):
    """Return the index of the relaxation among the parameters of a grid."""
    metadata = grid.problem.metadata
    return list(metadata.parameters).index(metadata.relaxation)


def with_relaxation(grid, value):
    """Return a grid with another relaxation."""
    parameters = grid.parameters.copy()
    parameters[:, relaxation_column(grid)] = value
    return grid._replace(parameters=parameters, bounds=())


def relaxed(search, grid, unknowns, tolerance, max_iterations, warm, scaling, log):
    """Minimise with smaller and smaller relaxations by `search`; return as `search`, which is `optimise_varied`.

    A warm start begins with the final relaxation. If that fails, all searches follow.
    """
    final, total = float(grid.parameters[0, relaxation_column(grid)]), 0
    if warm:
        outcome = search(grid, unknowns, tolerance, max_iterations, True, scaling, log)
        total = outcome[3]
        if outcome[0] == "solved" or total >= max_iterations:
            return outcome
    reached, value, factor, begin = math.inf, FIRST * final, SLOWLY, unknowns
    while True:
        is_last = value <= final * (1.0 + 1e-9)
        relaxed_grid = grid if is_last else with_relaxation(grid, value)
        status, message, point, iterations, scaled = search(
            relaxed_grid, begin, tolerance if is_last else max(tolerance, LOOSE), max_iterations - total,
            reached < math.inf, scaling, log,
        )  # fmt: skip
        total += iterations
        if status == "solved" and is_last:
            return status, message, point, total, scaled
        if status == "solved":
            reached, begin = value, np.array(point.unknowns)
            factor = SLOWLY if reached > SETTLED * final else QUICKLY
        else:
            factor = math.sqrt(factor)
            if reached == math.inf or factor < LEAST_FACTOR or status == "time limit" or total >= max_iterations:
                until = "not even the first" if reached == math.inf else f"only the relaxation {reached:.1e}"
                message = f"{message}; of the contact laws, {until} was reached, and {final:.1e} was asked"
                return status, message, point, total, scaled
        value = max(final, reached / factor)
