"""The discretised problem as a nonlinear program for external optimisers.

Minimise f(x) such that c(x) = 0 and lower <= x <= upper. The unknowns x are the free primal unknowns: they do not
include multipliers and prescribed boundary values.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from codegen.runtime.search import point
from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.grid import Grid, multiplier_unknowns, primal_unknowns, with_pinned_values
from codegen.runtime.search.messages import unknown_name
from codegen.runtime.search.point import evaluate


class Trajectory(NamedTuple):
    """The motion that a vector of unknowns describes, with N intervals.

    Arrays other than `t` have one row for each of the N + 1 nodes, or for each of the N intervals. They have one column
    for each quantity, with the columns of several bodies side by side.

    Attributes
    ----------
    t : (N + 1,)
        Times of the nodes.
    q, p, u, multipliers : array
        Coordinates, momenta, controls and multipliers.
    unknowns : (n,)
        All unknowns, which `solve` takes as its `guess`.
    """

    t: np.ndarray
    q: np.ndarray
    p: np.ndarray
    u: np.ndarray
    multipliers: np.ndarray
    unknowns: np.ndarray


@dataclass(frozen=True, eq=False)
class NonlinearProgram:
    """Minimise f(x) such that c(x) = 0 and lower <= x <= upper, with exact derivatives.

    A path constraint g(x) <= 0 is an equation g(x) + s = 0 with a slack s >= 0 among the unknowns. Sparse matrices have
    the same pattern at all points. Entries outside the pattern are zero everywhere.

    Attributes
    ----------
    grid : Grid
        The time grid, with the parameters and the prescribed boundary values.
    guess : array
        All unknowns of the initial guess, including the prescribed values.
    """

    grid: Grid
    guess: np.ndarray

    @cached_property
    def primal(self):
        """The indices (n,) of x among all unknowns."""
        return primal_unknowns(self.grid)

    @cached_property
    def dual(self):
        """The indices (m,) of the multipliers of c among all unknowns."""
        return multiplier_unknowns(self.grid)

    @cached_property
    def x0(self):
        """The initial guess (n,)."""
        return self.guess[self.primal]

    @cached_property
    def bounds(self):
        """Lower and upper bounds of x, a pair of (n,), infinite where x has no bound.

        Use them as `scipy.optimize.Bounds(*bounds)`.
        """
        return tuple(bound[self.primal] for bound in bounds_of(self.grid))

    @cached_property
    def constraint_bounds(self):
        """Lower and upper bounds of c(x), a pair of (m,): zeros, since all constraints are equations."""
        return np.zeros(self.dual.size), np.zeros(self.dual.size)

    @cached_property
    def names(self):
        """The names of the unknowns x, with node or interval and time, as in `r at node 3 (t = 1.2)`.

        The times belong to the initial guess.
        """
        return tuple(unknown_name(self.grid, self.guess, index) for index in self.primal)

    def cost(self, x):
        """Return the discrete cost f(x)."""
        return float(point.cost(self.grid, self.unknowns(x)))

    def gradient(self, x):
        """Return the gradient (n,) of the cost with respect to x."""
        return point.cost_gradient(self.grid, self.unknowns(x))

    def constraints(self, x):
        """Return the residuals c(x), (m,)."""
        return point.constraints(self.grid, self.unknowns(x))

    def stationarity(self, x, multipliers):
        """Return the gradient (n,) of the Lagrangian f + multipliers . c with respect to x."""
        return point.stationarity(self.grid, self.unknowns(x, multipliers))

    def jacobian(self, x):
        """Return the Jacobian (m, n) of c as a `scipy.sparse.csr_array`."""
        return self._sparse(point.jacobian(self.grid, self.unknowns(x)), self.dual.size)

    def hessian(self, x, multipliers=None, weight=1.0):
        """Return the Hessian of weight f + multipliers . c, both triangles, as a `scipy.sparse.csr_array` (n, n).

        Parameters
        ----------
        x : array
            Unknowns (n,).
        multipliers : array or None
            Multipliers (m,), or None for zeros.
        weight : float
            Factor of f; 0 gives the Hessian of the constraints alone, as for `scipy.optimize.NonlinearConstraint`.
        """
        rows, columns, values = point.hessian(self.grid, self.unknowns(x, multipliers))
        if weight != 1.0:  # the Lagrangian is linear in weight and multipliers
            values = values + (weight - 1.0) * point.hessian(self.grid, self.unknowns(x))[2]
        return self._sparse((rows, columns, values), self.primal.size)

    def unknowns(self, x, multipliers=None):
        """Return all unknowns for x (n,) and the multipliers (m,) of c, including prescribed values.

        Multipliers are zero if they are None.
        """
        unknowns = self.guess.copy()
        unknowns[self.primal] = x
        unknowns[self.dual] = 0.0 if multipliers is None else multipliers
        if self.grid.problem.structure.root:  # unknowns of the end nodes equal linking variables
            unknowns = with_pinned_values(self.grid, unknowns)
        return unknowns

    def evaluate(self, x, multipliers=None):
        """Return cost, gradient of the Lagrangian with respect to all unknowns, and norms, as a Point."""
        return evaluate(self.grid, self.unknowns(x, multipliers))

    def unpack(self, x, multipliers=None):
        """Return the Trajectory for x (n,) and the multipliers (m,) of c, which are zero if they are None."""
        unknowns = self.unknowns(x, multipliers)
        return Trajectory(*self.grid.problem.unpack(self.grid, unknowns), unknowns)

    def _sparse(self, entries, height):
        try:
            from scipy.sparse import csr_array
        except ImportError:
            raise ImportError("sparse matrices of a nonlinear program need scipy: pip install scipy") from None
        rows, columns, values = entries
        matrix = csr_array((values, (rows, columns)), shape=(height, self.primal.size))
        matrix.sort_indices()
        return matrix


def nonlinear_program(grid, guess=None):
    """Return the NonlinearProgram on a grid.

    `guess` holds all unknowns; None stands for the problem's own initial guess.
    """
    guess = grid.problem.initial_guess(grid) if guess is None else with_pinned_values(grid, guess)
    return NonlinearProgram(grid, guess)
