"""How a search begins at a neighbour's solution: with its multipliers, and duals of bounds that follow from them.

Estimates by least squares are off by what the cost's and equations' curvature makes of it, and cost an iteration or
two. The barrier's weight begins where it ends, so that the path to the solution is not walked again, and unknowns stay
where they are, close to their bounds. Far from the equations, as after a push, other bounds become active and cut step
after step short: then weight and distances are those of a path that begins inside. Source: Yildirim and Wright (2002),
Warm-start strategies in interior-point methods for linear programming, SIAM J. Optim. 12: the larger the change of the
data, the larger the weight of the barrier from which to begin.
"""

import numpy as np
from numba import njit

from codegen.runtime.optimise.barrier import push_inside, relaxation, sum_of_logarithms
from codegen.runtime.kkt.system import factor_kkt
from codegen.runtime.optimise.bounded import FROM_AFAR, Iterate, Search, begin, newton_system
from codegen.runtime.stand_ins.example import INEQUALITIES, TIED
from codegen.runtime.unknowns.point import evaluate
from codegen.runtime.unknowns.tied import with_tied_values

NEAR = 0.1  # residuals above it are far: with 0.3 fish under pressure take half as many iterations again
if INEQUALITIES:
    # With a weight ten times as much an iteration is spent on lowering it.
    PART = 0.1  # of the tolerance is the weight of the barrier
    CLOSE = 1e-8  # unknowns are at least so far inside their bounds: closer than the weight's own distances


def has_multipliers(grid, unknowns):
    """Whether any multiplier is not zero."""
    return np.count_nonzero(unknowns[grid.is_multiplier]) > 0  # any() takes half as long again


def begin_nearby(search, unknowns, tolerance):
    """An iterate at a neighbour's unknowns, multipliers among them; None without any.

    Nor is there one far from the equations, unless there are bounds.
    """
    grid = search.grid
    if not has_multipliers(grid, unknowns):
        return None
    if INEQUALITIES:
        bounds, mu = search.bounds, PART * tolerance
        unknowns = push_inside(*search.box, unknowns, CLOSE)
        if TIED:
            unknowns = with_tied_values(grid, unknowns)
        point, by = evaluate(grid, unknowns), relaxation(mu, search.least)
        if point.residual > NEAR:
            iterate = begin(search, unknowns, FROM_AFAR)
        else:
            distance, duals = np.empty(bounds.side.size), np.empty(bounds.side.size)
            logarithms = fill_bounds(unknowns, point.gradient, *bounds, by, mu, distance, duals)
            iterate = Iterate(point, mu, distance, logarithms, duals)
        return iterate if iterate.point.error < np.inf else None
    else:
        iterate = Iterate(evaluate(grid, unknowns))
        return iterate if iterate.point.residual <= NEAR and iterate.point.error < np.inf else None


def factor_nearby(grid, unknowns, tolerance, search):
    """Factor the linear system of the first step from a neighbour's unknowns, or from others beside them, beforehand.

    `search` is what `search_on` gave for a grid with the same bounds; it has the factors. Return whether there are any
    that such a step can take: the reduced Hessian is positive definite as it is.
    """
    search = Search(grid, *search[1:])
    iterate = begin_nearby(search, unknowns, tolerance)
    if iterate is None:
        return False
    if INEQUALITIES and iterate.mu == FROM_AFAR.weight:
        return False
    _, diagonal = newton_system(search, iterate, iterate.point.gradient, 0.0, 0.0)
    return factor_kkt(grid, iterate.point.unknowns, 1.0, diagonal, search.system) == 0


if INEQUALITIES:

    @njit(cache=True, error_model="numpy")
    def fill_bounds(unknowns, gradient, indices, value, side, magnitude, by, mu, distance, duals):
        """Fill `distance` and `duals` (bounds,); return the sum of the logarithms of distances.

        Bounds are relaxed `by` a part of their magnitudes.
        Where the Lagrangian falls towards a bound, by more than the distance to it, the bound is active, and its dual
        is that slope; the others are on the central path.
        """
        for j in range(indices.size):
            distance[j] = side[j] * (unknowns[indices[j]] - value[j]) + by * magnitude[j]
            slope = side[j] * gradient[indices[j]]
            duals[j] = slope if slope > distance[j] else min(mu / distance[j], 1e3)
        return sum_of_logarithms(distance)
