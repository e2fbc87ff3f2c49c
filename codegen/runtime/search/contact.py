"""The continuation of problems with contact forces: the relaxation of their products falls with the barrier's weight.

Products of contact forces and gaps are at most epsilon, the parameter `relaxation`. The grid has its final value. A
search begins with a large relaxation and reduces it whenever the weight mu of the barrier falls, so that one path of
optima leads to the solution. Source: Raghunathan and Biegler (2005), An interior point method for mathematical programs
with complementarity constraints (MPCCs), SIAM Journal on Optimization 15.
"""

import math
from typing import NamedTuple

import numpy as np

FIRST = 1e8  # relaxation at the weight AT, relative to the final relaxation
AT = 0.1
LEAST = 1e-9  # largest weight with the final relaxation, unless the tolerance is larger


class Relaxation(NamedTuple):
    """The relaxation of a search: its values (nodes,) among the parameters of the grid, and its `final` value."""

    values: np.ndarray
    final: float

    def at(self, mu, tolerance):
        """Return the relaxation for the weight `mu` of the barrier."""
        least = max(LEAST, tolerance)
        power = math.log(FIRST) / math.log(AT / least)
        return self.final * max(1.0, (mu / least) ** power)

    def follow(self, mu, tolerance):
        """Set the relaxation for the weight `mu`."""
        self.values[:] = self.at(mu, tolerance)


def relaxation_of(grid):
    """Return (grid, Relaxation) for a grid with contact forces, otherwise (grid, None).

    The grid returned has its own parameters, so that the relaxation of the argument stays final.
    """
    metadata = grid.problem.metadata
    if not metadata.relaxation:
        return grid, None
    column = list(metadata.parameters).index(metadata.relaxation)
    grid = grid._replace(parameters=grid.parameters.copy())
    values = grid.parameters[:, column]
    return grid, Relaxation(values, float(values[0]))
