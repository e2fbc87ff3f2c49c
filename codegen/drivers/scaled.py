"""The optimal-control problem as scipy wants it: free unknowns only, equations of comparable size.

Each equation is divided by the largest entry of its row of the Jacobian at the initial guess, and the cost by its
largest derivative there if that exceeds one, as in section 3.8 of Waechter and Biegler (2006). Unknowns are not
scaled. With the multipliers nu of the scaled problem, lambda = r nu / f belongs to the original one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray
from scipy.optimize import Bounds, lsq_linear

from codegen.errors import ArgumentError
from codegen.interfaces import ControlModule, Entries, Grid, Indices, Vector, time_grid
from codegen.solutions.result import ControlAttempt, Run, max_norm

_SIGN_ROUNDING = 1e-9
_DENSE_LIMIT = 1500


def claim(
    name: str, status: str, iterations: int, unknowns: Vector, tolerance: float, remedy: str = "; try driver newton"
) -> ControlAttempt:
    """What an optimiser says that it has found, or with what status it gave up."""
    message = f"{name} found a local minimum in {iterations} iterations"
    if status != "solved":
        message = f"{status}: {name} gave up after {iterations} iterations{remedy}"
    return ControlAttempt(status, message, iterations, unknowns, tolerance)


@dataclass(frozen=True)
class ScaledProblem:
    """Minimise f J(x) such that r_i c_i(x) = 0; `base` holds the values of pinned unknowns.

    The factors are one for an optimiser that scales by itself.
    """

    module: ControlModule
    grid: Grid
    base: Vector
    primal: Indices
    dual: Indices
    is_scaled: bool = True

    @classmethod
    def on_grid(cls, module: ControlModule, run: Run, is_scaled: bool = True) -> ScaledProblem:
        """The problem on N intervals, from the guess that is asked for, else the problem's own."""
        grid = time_grid(module, run.steps, run.grid)
        base = module.initial_guess(grid) if run.guess is None else module.with_pinned_values(grid, run.guess)
        return cls(module, grid, base, module.primal_unknowns(grid), module.multiplier_unknowns(grid), is_scaled)

    @property
    def start(self) -> Vector:
        """Free primal unknowns of the initial guess."""
        return self.base[self.primal]

    @property
    def inner_start(self) -> Vector:
        """The same, moved off and inside the bounds, which some optimisers insist on."""
        lower, upper = self.bounds
        push = 1e-2 * np.minimum(np.maximum(1.0, np.abs(self.start)), upper - lower)
        return np.clip(self.start, lower + push, upper - push)

    @cached_property
    def bounds(self) -> tuple[Vector, Vector]:
        """Lower and upper bounds of the free primal unknowns."""
        if not self.module.metadata["inequalities"]:
            return np.full(self.primal.size, -np.inf), np.full(self.primal.size, np.inf)
        lower, upper = self.module.variable_bounds(self.grid)
        return lower[self.primal], upper[self.primal]

    @property
    def scipy_bounds(self) -> Bounds | None:
        """The bounds as scipy.optimize wants them; iterates stay within them."""
        if not self.module.metadata["inequalities"]:
            return None
        return Bounds(*self.bounds, keep_feasible=True)

    @cached_property
    def row_scale(self) -> Vector:
        """The factors r of the equations."""
        if not self.is_scaled:
            return np.ones(self.dual.size)
        rows, _, values = self.module.jacobian(self.grid, self.base)
        size = np.zeros(self.dual.size)
        np.maximum.at(size, rows, np.abs(values))
        return 1.0 / np.where((size > 0.0) & np.isfinite(size), size, 1.0)

    @cached_property
    def cost_scale(self) -> float:
        """The factor f of the cost."""
        if not self.is_scaled:
            return 1.0
        size = max_norm(self.module.cost_gradient(self.grid, self.base))
        return 1.0 / max(1.0, size) if np.isfinite(size) else 1.0

    def unknowns(self, x: Vector, nu: Vector | None = None) -> Vector:
        """All unknowns, for free primal unknowns x and scaled multipliers nu (default zero)."""
        unknowns = self.base.copy()
        unknowns[self.primal] = x
        unknowns[self.dual] = 0.0 if nu is None else self.row_scale * nu / self.cost_scale
        # Unknowns at the ends may equal shared ones, which have just been changed.
        return self.module.with_pinned_values(self.grid, unknowns) if self.module.problem.structure.root else unknowns

    def cost(self, x: Vector) -> float:
        """The scaled cost."""
        return self.cost_scale * self.module.cost(self.grid, self.unknowns(x))

    def cost_gradient(self, x: Vector) -> Vector:
        """Its gradient."""
        return self.cost_scale * self.module.cost_gradient(self.grid, self.unknowns(x))

    def constraints(self, x: Vector) -> Vector:
        """The scaled equations."""
        return self.row_scale * self.module.constraints(self.grid, self.unknowns(x))

    def jacobian(self, x: Vector) -> Any:
        """Their Jacobian, a sparse matrix."""
        rows, columns, values = self.module.jacobian(self.grid, self.unknowns(x))
        return self._sparse((rows, columns, values * self.row_scale[rows]), self.dual.size)

    def hessian(self, x: Vector, nu: Vector | None = None) -> Any:
        """Hessian of the scaled Lagrangian, a sparse matrix; without nu that of the cost."""
        rows, columns, values = self.module.hessian(self.grid, self.unknowns(x, nu))
        return self._sparse((rows, columns, self.cost_scale * values), self.primal.size)

    def stationarity(self, x: Vector, nu: Vector) -> Vector:
        """Gradient of the scaled Lagrangian."""
        return self.cost_scale * self.module.stationarity(self.grid, self.unknowns(x, nu))

    def multipliers(self, x: Vector) -> Vector:
        """Scaled multipliers that minimise the 2-norm of the stationarity.

        Unknowns on their bounds are left out, because duals of the bounds balance them. Where a dual then has the wrong
        sign, multipliers and duals are found together by bounded least squares, unless the matrix is too large.
        """
        jacobian, gradient = self.jacobian(x), self.cost_gradient(x)
        lower, upper = self.bounds
        scale = 1e-6 * np.maximum(1.0, np.abs(x))
        held = np.where(x - lower <= scale, 1.0, 0.0) - np.where(upper - x <= scale, 1.0, 0.0)
        nu = self._balanced(jacobian, gradient, held == 0.0)
        slope, rounding = gradient + jacobian.T @ nu, _SIGN_ROUNDING * max(1.0, max_norm(gradient))
        if not (held * slope < -rounding).any() or x.size + nu.size > _DENSE_LIMIT:
            return nu
        indices = np.flatnonzero(held)
        duals = np.zeros((x.size, indices.size))
        duals[indices, np.arange(indices.size)] = -held[indices]
        least = np.concatenate([np.full(nu.size, -np.inf), np.zeros(indices.size)])
        found = lsq_linear(np.hstack([jacobian.T.toarray(), duals]), -gradient, (least, np.inf), method="bvls")
        return np.asarray(found.x[: nu.size], dtype=float)

    def unbalanced(self, x: Vector, nu: Vector) -> float:
        """The largest slope times the distance to the bound that it leads to, one where that is farther away."""
        slope, (lower, upper) = self.stationarity(x, nu), self.bounds
        return max_norm(slope * np.clip(np.where(slope > 0.0, x - lower, upper - x), 0.0, 1.0))

    def _balanced(self, jacobian: Any, gradient: Vector, inside: NDArray[np.bool_]) -> Vector:
        """The multipliers with which the stationarity of some unknowns is least, by a sparse augmented system."""
        jacobian, gradient = jacobian[:, inside], gradient[inside]
        identity = scipy.sparse.identity(gradient.size)
        system = scipy.sparse.bmat([[identity, jacobian.T], [jacobian, None]], format="csc")
        right = np.concatenate([-gradient, np.zeros(self.dual.size)])
        try:
            nu = scipy.sparse.linalg.splu(system).solve(right)[gradient.size :]
        except RuntimeError:  # exactly singular
            nu = np.full(self.dual.size, np.nan)
        if not np.isfinite(nu).all():
            nu = np.linalg.lstsq(jacobian.T.toarray(), -gradient, rcond=None)[0]
        return np.asarray(nu, dtype=float)

    def require_at_most(self, limit: int, driver: str) -> None:
        """Refuse problems that would take a dense solver minutes and gigabytes."""
        size = self.primal.size + self.dual.size
        if size > limit:
            raise ArgumentError(
                f"driver {driver} uses dense matrices, and {self.grid.steps} steps make {size} unknowns and equations",
                f"take fewer steps (at most {limit} unknowns and equations), or use newton or trust-constr",
            )

    def _sparse(self, entries: Entries, height: int) -> Any:
        rows, columns, values = entries
        return scipy.sparse.csr_array((values, (rows, columns)), shape=(height, self.primal.size))
