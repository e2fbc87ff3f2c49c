"""The discretised problem as a nonlinear program for external optimisers.

Minimise f(x) such that c(x) = 0 and lower <= x <= upper. The unknowns x are the free primal unknowns, without
multipliers and without prescribed boundary values.
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
    """Unknowns as a motion; `t` is (N + 1,), other arrays have a row for each of the N + 1 nodes, or N intervals.

    Attributes
    ----------
    t, q, p, u, multipliers : array
        Times, coordinates, momenta, controls, and multipliers, a column for each, of several bodies side by side.
    unknowns : array
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

    A path condition g(x) <= 0 is an equation g(x) + s = 0 with a slack s >= 0 among the unknowns. Sparse matrices have
    the same pattern at all points; entries outside the pattern are zero everywhere.

    Attributes
    ----------
    grid : Grid
        The time grid, with the parameters and the prescribed boundary values.
    guess : array
        All unknowns of the initial guess; prescribed values are taken from here.
    """

    grid: Grid
    guess: np.ndarray

    @cached_property
    def primal(self):
        """The indices (n,) of x among all unknowns."""
        return primal_unknowns(self.grid)

    @cached_property
    def dual(self):
        """The indices (m,) among all unknowns of the multipliers of c."""
        return multiplier_unknowns(self.grid)

    @cached_property
    def x0(self):
        """The initial guess (n,)."""
        return self.guess[self.primal]

    @cached_property
    def bounds(self):
        """Lower and upper bounds, a pair of (n,), infinite for unknowns without; `scipy.optimize.Bounds(*bounds)`."""
        return tuple(bound[self.primal] for bound in bounds_of(self.grid))

    @cached_property
    def constraint_bounds(self):
        """Lower and upper bounds of c(x), a pair of (m,): zeros, as all constraints are equations."""
        return np.zeros(self.dual.size), np.zeros(self.dual.size)

    @cached_property
    def names(self):
        """The names of x, with node or interval and time at the guess, as in `r at node 3 (t = 1.2)`."""
        return tuple(unknown_name(self.grid, self.guess, index) for index in self.primal)

    def cost(self, x):
        """Return the discrete cost f(x)."""
        return float(point.cost(self.grid, self.unknowns(x)))

    def gradient(self, x):
        """Return the gradient (n,) of the cost."""
        return point.cost_gradient(self.grid, self.unknowns(x))

    def constraints(self, x):
        """Return the residuals c(x), (m,)."""
        return point.constraints(self.grid, self.unknowns(x))

    def stationarity(self, x, multipliers):
        """Return the gradient (n,) of the Lagrangian f + multipliers . c."""
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
            Multipliers (m,), None for zeros.
        weight : float
            0 for the Hessian of the constraints alone, as `scipy.optimize.NonlinearConstraint` takes it.
        """
        rows, columns, values = point.hessian(self.grid, self.unknowns(x, multipliers))
        if weight != 1.0:  # the Lagrangian is linear in weight and multipliers
            values = values + (weight - 1.0) * point.hessian(self.grid, self.unknowns(x))[2]
        return self._sparse((rows, columns, values), self.primal.size)

    def unknowns(self, x, multipliers=None):
        """Return all unknowns, with prescribed values, of x (n,) and the multipliers (m,) of c, zeros if None."""
        unknowns = self.guess.copy()
        unknowns[self.primal] = x
        unknowns[self.dual] = 0.0 if multipliers is None else multipliers
        if self.grid.problem.structure.root:  # unknowns of the end nodes equal linking variables
            unknowns = with_pinned_values(self.grid, unknowns)
        return unknowns

    def evaluate(self, x, multipliers=None):
        """Return cost, gradient of the Lagrangian by all unknowns, and norms, as a Point."""
        return evaluate(self.grid, self.unknowns(x, multipliers))

    def unpack(self, x, multipliers=None):
        """Return the Trajectory of x (n,) and the multipliers (m,) of c, zeros if None."""
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
    """Return the NonlinearProgram on a grid; `guess` holds all unknowns, None for the problem's own guess."""
    guess = grid.problem.initial_guess(grid) if guess is None else with_pinned_values(grid, guess)
    return NonlinearProgram(grid, guess)
