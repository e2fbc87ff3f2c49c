"""Common parts of drivers: scaled optimal-control problems, particles, warnings and threads.

The optimal-control problem for scipy has only free unknowns, and its equations have comparable magnitudes. Each
equation is divided by the largest entry of its row of the Jacobian at the initial guess. The cost is divided by its
largest derivative at the guess, if this derivative exceeds one, as in section 3.8 of Waechter and Biegler (2006).
Unknowns are not scaled. With the scaling factors r of an equation and f of the cost, a multiplier nu of the scaled
problem corresponds to the multiplier lambda = r nu / f of the problem.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray
from scipy.optimize import Bounds, OptimizeResult, lsq_linear
from scipy.sparse import csr_array

from codegen.errors import ArgumentError
from codegen.solving.drivers.quiet import quiet_single_thread
from codegen.solving.loading import Case, ConnectModule, ControlModule, Matrix, NonlinearProgram, Vector, time_grid
from codegen.solving.results.motions import case_of
from codegen.solving.results.result import ConnectAttempt, ControlAttempt, Run, max_norm

_SIGN_ROUNDING = 1e-9
"""Magnitude of a multiplier of a bound with the wrong sign, relative to the cost gradient, that is a rounding error."""
_DENSE_LIMIT = 1500
"""Largest number of unknowns and equations for which multipliers are computed by dense least squares."""


def claim(
    name: str, status: str, iterations: int, unknowns: Vector, tolerance: float, remedy: str = "; try driver newton"
) -> ControlAttempt:
    """Return the attempt of an optimiser with a message that states its status.

    `name` is the name of the optimiser. `remedy` is appended to the message of a failure.
    """
    message = f"{name} found a local minimum in {iterations} iterations"
    if status != "solved":
        message = f"{status}: {name} gave up after {iterations} iterations{remedy}"
    return ControlAttempt(status, message, iterations, unknowns, tolerance)


def program_on_grid(module: ControlModule, run: Run) -> NonlinearProgram:
    """Return the nonlinear program on the grid of a run, with the initial guess of the run or else of the problem."""
    guess = module.initial_guess(time_grid(module, run.steps, run.grid)) if run.guess is None else run.guess
    return module.nlp(run.steps, grid=run.grid, guess=guess)


def require_small(program: NonlinearProgram, limit: int, driver: str) -> None:
    """Raise ArgumentError if a nonlinear program has more than `limit` unknowns and equations.

    A driver with dense matrices would take minutes and gigabytes for it.
    """
    size = program.primal.size + program.dual.size
    if size > limit:
        raise ArgumentError(
            f"driver {driver} uses dense matrices, and {program.grid.steps} steps make {size} unknowns and equations",
            f"take fewer steps (at most {limit} unknowns and equations), or use newton or trust-constr",
        )


@dataclass(frozen=True)
class ScaledProblem:
    """The scaled problem: minimise f J(x) subject to r_i c_i(x) = 0, for optimisers that compute no scaling factors."""

    program: NonlinearProgram

    @classmethod
    def on_grid(cls, module: ControlModule, run: Run) -> ScaledProblem:
        """Return the scaled problem on the grid of a run, with the initial guess of the run or else of the problem."""
        return cls(program_on_grid(module, run))

    @cached_property
    def inner_start(self) -> Vector:
        """The initial guess, moved into the interior of the bounds, which some optimisers require."""
        (lower, upper), start = self.program.bounds, self.program.x0
        push = 1e-2 * np.minimum(np.maximum(1.0, np.abs(start)), upper - lower)
        return np.clip(start, lower + push, upper - push)

    @property
    def scipy_bounds(self) -> Bounds | None:
        """The bounds for scipy.optimize, which all iterates satisfy; None if no unknown is bounded."""
        lower, upper = self.program.bounds
        if not (np.isfinite(lower).any() or np.isfinite(upper).any()):
            return None
        return Bounds(lower, upper, keep_feasible=True)

    @cached_property
    def row_scale(self) -> Vector:
        """The scaling factors r of the equations."""
        jacobian = abs(self.program.jacobian(self.program.x0))
        size = jacobian.max(axis=1).toarray().ravel()
        return np.asarray(1.0 / np.where((size > 0.0) & np.isfinite(size), size, 1.0), dtype=float)

    @cached_property
    def cost_scale(self) -> float:
        """The scaling factor f of the cost."""
        size = max_norm(self.program.gradient(self.program.x0))
        return 1.0 / max(1.0, size) if np.isfinite(size) else 1.0

    def unscaled(self, nu: Vector) -> Vector:
        """Return the multipliers of the problem; `nu` are the multipliers of the scaled problem."""
        return self.row_scale * nu / self.cost_scale

    def unknowns(self, x: Vector, nu: Vector) -> Vector:
        """Return the vector of all unknowns from the free primal unknowns `x` and the scaled multipliers `nu`."""
        return self.program.unknowns(x, self.unscaled(nu))

    def cost(self, x: Vector) -> float:
        """Return the scaled cost."""
        return self.cost_scale * self.program.cost(x)

    def cost_gradient(self, x: Vector) -> Vector:
        """Return the gradient of the scaled cost."""
        return self.cost_scale * self.program.gradient(x)

    def constraints(self, x: Vector) -> Vector:
        """Return the residuals of the scaled equations."""
        return self.row_scale * self.program.constraints(x)

    def jacobian(self, x: Vector) -> csr_array:
        """Return the Jacobian of the scaled equations, a sparse matrix."""
        return scipy.sparse.diags_array(self.row_scale) @ self.program.jacobian(x)

    def hessian(self, x: Vector, nu: Vector | None = None, weight: float = 1.0) -> csr_array:
        """Return the sparse Hessian of the scaled Lagrangian, in which the cost is multiplied by `weight`.

        Without the multipliers `nu`, the Hessian of the scaled cost is returned.
        """
        return self.cost_scale * self.program.hessian(x, None if nu is None else self.unscaled(nu), weight)

    def stationarity(self, x: Vector, nu: Vector) -> Vector:
        """Return the gradient of the scaled Lagrangian."""
        return self.cost_scale * self.program.stationarity(x, self.unscaled(nu))

    def multipliers(self, x: Vector) -> Vector:
        """Return the scaled multipliers that minimise the 2-norm of the stationarity.

        Unknowns on their bounds are omitted, because multipliers of the bounds balance their derivatives. If a
        multiplier of a bound then has the wrong sign, all multipliers are computed together by bounded least squares,
        unless the matrix is too large.
        """
        jacobian, gradient = self.jacobian(x), self.cost_gradient(x)
        lower, upper = self.program.bounds
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
        solution = lsq_linear(np.hstack([jacobian.T.toarray(), duals]), -gradient, (least, np.inf), method="bvls")
        return np.asarray(solution.x[: nu.size], dtype=float)

    def unbalanced(self, x: Vector, nu: Vector) -> float:
        """Return the largest violation of the optimality conditions with bounds.

        For each unknown the violation is the derivative of the Lagrangian times the distance to the bound towards which
        the Lagrangian falls, or times 1 if this distance is larger.
        """
        slope, (lower, upper) = self.stationarity(x, nu), self.program.bounds
        return max_norm(slope * np.clip(np.where(slope > 0.0, x - lower, upper - x), 0.0, 1.0))

    def _balanced(self, jacobian: csr_array, gradient: Vector, inside: NDArray[np.bool_]) -> Vector:
        """Return the multipliers that minimise the stationarity of the unknowns in the mask `inside`.

        The least-squares problem is solved by a sparse augmented system.
        """
        jacobian, gradient = jacobian[:, inside], gradient[inside]
        identity = scipy.sparse.identity(gradient.size)
        system = scipy.sparse.bmat([[identity, jacobian.T], [jacobian, None]], format="csc")
        right = np.concatenate([-gradient, np.zeros(jacobian.shape[0])])
        try:
            nu = scipy.sparse.linalg.splu(system).solve(right)[gradient.size :]
        except RuntimeError:  # exactly singular
            nu = np.full(right.size - gradient.size, np.nan)
        if not np.isfinite(nu).all():
            nu = np.linalg.lstsq(jacobian.T.toarray(), -gradient, rcond=None)[0]
        return np.asarray(nu, dtype=float)


DENSE_LIMIT = 3000
"""Largest number of unknowns and equations for a method with dense matrices."""


def minimised(
    module: ConnectModule, run: Run, driver: str, minimise: Callable[[ConnectModule, Case, Vector], OptimizeResult]
) -> ConnectAttempt:
    """Return the motion of particles with the least discrete action, found by an optimiser of scipy.

    `minimise` maps the module, the case and the initial guess to a result of scipy. Raise ArgumentError if the driver
    does not apply to the problem.
    """
    require_method(module, driver, ("action",))
    case = case_of(module, run)
    if case.sigma.any():
        raise ArgumentError(f"driver {driver} meets targets exactly, and there is a sigma", "use newton")
    start = module.action_start(case)
    require_at_most(start.size + case.steps * case.start.size, DENSE_LIMIT, driver)
    with quiet_single_thread():
        solution = minimise(module, case, start)
    return verdict(
        module, driver, case, module.action_path(case, solution.x), int(solution.nit), 1e-6, str(solution.message)
    )


def verdict(
    module: ConnectModule, driver: str, case: Case, path: Matrix, iterations: int, tolerance: float, reason: str
) -> ConnectAttempt:
    """Return the attempt of a driver for particles; its status depends on the residual of the path only.

    `reason` is the message of the driver, which is quoted for a failure.
    """
    error = largest_error(module, case, path)
    if error <= tolerance:
        text = f"{driver} connects the points with residual {error:.1e} after {iterations} iterations"
        return ConnectAttempt("solved", text, iterations, path, tolerance)
    text = " ".join(str(reason).split())
    text = f"stalled: {driver} stopped with residual {error:.1e} ({text}); try driver newton, or more steps"
    return ConnectAttempt("stalled", text, iterations, path, tolerance)


def largest_error(module: ConnectModule, case: Case, path: Matrix) -> float:
    """Return the largest residual of a path, in the equations of all steps and in the arrival at the targets."""
    errors, end = module.path_errors(case, path)
    return max(max_norm(errors.ravel()), max_norm(end))


def finite(values: Vector) -> Vector:
    """Return the values with NaN and infinity replaced by large numbers, which a root finder avoids."""
    return np.nan_to_num(values, nan=1e3, posinf=1e3, neginf=-1e3)


def require_method(module: ConnectModule, driver: str, methods: tuple[str, ...]) -> None:
    """Raise ArgumentError if the method of a module is not one of `methods`, or if its scheme is adaptive."""
    method = module.metadata.method
    if method not in methods:
        raise ArgumentError(f"driver {driver} does not solve method {method}", f"use --method {' or '.join(methods)}")
    if module.metadata.adaptive:
        raise ArgumentError(f"driver {driver} needs steps, and {module.metadata.scheme} chooses its own", "use newton")


def require_at_most(size: int, limit: int, driver: str) -> None:
    """Raise ArgumentError if the number `size` of unknowns and equations exceeds the limit of a driver."""
    if size > limit:
        raise ArgumentError(
            f"driver {driver} would have {size} unknowns and equations", f"take at most {limit}, or use newton"
        )
