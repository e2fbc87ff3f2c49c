"""MINPACK's hybrid Powell method with exact Jacobians, for implicit steps, and for the KKT conditions as equations.

Source: Powell (1970), A hybrid method for nonlinear equations; More, Garbow and Hillstrom (1980), User guide for
MINPACK-1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeGuard

import numpy as np
from scipy.optimize import fsolve

from codegen.errors import ArgumentError
from codegen.runtime.record import Method
from codegen.solving.drivers.quiet import quiet_single_thread
from codegen.solving.drivers.shared import (
    DENSE_LIMIT,
    finite,
    program_on_grid,
    require_at_most,
    require_method,
    require_small,
    verdict,
)
from codegen.solving.loading import (
    ConnectModule,
    ControlModule,
    ImplicitModule,
    Matrix,
    SimulateModule,
    Vector,
    is_implicit,
    is_of_particles,
)
from codegen.solving.results.motions import case_of
from codegen.solving.results.result import ConnectAttempt, ControlAttempt, Run, SimulateAttempt, max_norm

TOLERANCE = 1e-8
LIMIT = 3000


def control(module: ControlModule, run: Run) -> ControlAttempt:
    """Solve residual = 0 and stationarity = 0 for primal unknowns and multipliers together, and return the attempt.

    The stationary point need not be a minimum. Equations are not scaled; the method itself scales the unknowns. In a
    test with four problems and 10 to 30 steps, 55 of 60 searches succeeded, and fewer than half with scaled equations.
    """
    if module.metadata.inequalities:
        raise ArgumentError(
            "driver fsolve solves equations, and the problem has inequalities",
            "use newton, slsqp, trust-constr or ipopt",
        )
    program = program_on_grid(module, run)
    require_small(program, LIMIT, "fsolve")
    count, equation_count = program.primal.size, program.dual.size

    def equations(y: Vector) -> Vector:
        x, nu = y[:count], y[count:]
        return np.concatenate([program.stationarity(x, nu), program.constraints(x)])

    def kkt_matrix(y: Vector) -> Matrix:
        jacobian = program.jacobian(y[:count]).toarray()
        hessian = program.hessian(y[:count], y[count:]).toarray()
        return np.block([[hessian, jacobian.T], [jacobian, np.zeros((equation_count, equation_count))]])

    start = np.concatenate([program.x0, np.zeros(equation_count)])
    with quiet_single_thread():
        y, details, code, reason = fsolve(equations, start, fprime=kkt_matrix, full_output=True, xtol=1e-13)
    evaluations = int(details["nfev"])
    status, message = _verdict(y, details, code, reason)
    if status == "solved":
        message = f"fsolve found a stationary point with {evaluations} evaluations"
    return ControlAttempt(status, message, evaluations, program.unknowns(y[:count], y[count:]), TOLERANCE)


def simulate(module: SimulateModule, run: Run) -> SimulateAttempt:
    """Solve the equations of all time steps, each from the prediction of the scheme, and return the attempt.

    The number of iterations is the number of evaluations of the residual. Raise ArgumentError for an explicit scheme,
    and for particles.
    """
    if getattr(module.metadata, "events", ()) or getattr(module.metadata, "gaps", ()):
        raise ArgumentError("driver fsolve finds no events", "use newton")
    if not _is_stepwise(module):
        raise ArgumentError(
            f"driver fsolve has nothing to solve: {module.metadata.scheme} is explicit for this problem",
            "use newton, or a scheme that is implicit for it",
        )
    grid, residual, jacobian = module.make_grid(run.steps), module.residual, module.jacobian
    states, evaluations = [grid.start], 0
    status, message = "solved", ""
    with quiet_single_thread():
        for k in range(grid.steps):
            state, t = states[-1], k * grid.h
            y, details, code, reason = fsolve(
                lambda y, state=state, t=t: residual(grid, y, state, t),
                module.predict(grid, state, t),
                fprime=lambda y, state=state, t=t: jacobian(grid, y, state, t),
                full_output=True,
                xtol=1e-13,
            )
            evaluations += int(details["nfev"])
            status, message = _verdict(y, details, code, reason)
            if status != "solved":
                message = f"in step {k + 1} of {grid.steps}, from t = {k * grid.h:g}, {message}"
                break
            states.append(np.asarray(module.complete(grid, y, state, t)))
    path, steps = np.array(states), len(states) - 1
    stored = np.unique([*range(0, steps + 1, run.every), steps])
    times, dimension, energy = grid.h * stored, len(module.metadata.coordinates), None
    if function := getattr(module, "energy", None):
        energy = np.array([function(row, t, grid.parameters) for row, t in zip(path[stored], times, strict=True)])
    return SimulateAttempt(
        status=status,
        message=message or f"all {steps} steps were made with {evaluations / steps:.2f} evaluations each",
        iterations=evaluations,
        t=times,
        q=path[stored, :dimension],
        p=path[stored, dimension:],
        energy=energy,
        steps=steps,
        residual=module.path_residual(grid, path) if steps else float("nan"),
        tolerance=TOLERANCE,
    )


def connect(module: ConnectModule, run: Run) -> ConnectAttempt:
    """Connect particles by solving the equations for the initial momenta or for all nodes, and return the attempt.

    The Jacobian of the equations is generated.
    """
    require_method(module, "fsolve", ("stepping", "full"))
    case = case_of(module, run)
    shooting = module.metadata.method == Method.STEPPING
    size = case.start.size if shooting else 2 * case.start.size * case.steps
    require_at_most(size, DENSE_LIMIT, "fsolve")
    equations = module.residual if shooting else module.all_equations
    derivative = module.jacobian if shooting else module.all_equations_jacobian
    start = module.first_momenta(case).ravel() if shooting else module.first_unknowns(case)
    with quiet_single_thread():
        y, details, _, reason = fsolve(
            lambda y: finite(equations(case, y)),
            start,
            fprime=lambda y: finite(derivative(case, y)),
            full_output=True,
            xtol=1e-13,
        )
    path = module.trajectory(case, y)[1] if shooting else module.path_of(case, y)
    return verdict(module, "fsolve", case, path, int(details["nfev"]), 1e-8, reason)


def _is_stepwise(module: SimulateModule) -> TypeGuard[ImplicitModule]:
    """Return True if a module solves one system of equations in each time step, and False if it solves none.

    Raise ArgumentError if a step consists of several systems, and for particles.
    """
    if is_of_particles(module):
        raise ArgumentError(
            "driver fsolve does not solve the steps of particles, whose module has its own Newton method", "use newton"
        )
    if module.metadata.parts:
        raise ArgumentError(
            f"driver fsolve solves one system in each step, and {module.metadata.scheme} makes "
            f"{module.metadata.parts} steps of another scheme",
            "use newton",
        )
    return is_implicit(module)


def _verdict(y: Vector, details: Mapping[str, Vector], code: int, reason: str) -> tuple[str, str]:
    """Return the termination status of fsolve and a message, which is empty for the status "solved".

    Slow progress (codes 3 to 5) is accepted if the residual has the size of rounding errors.
    """
    residual = max_norm(details["fvec"])
    if not np.isfinite(y).all() or not np.isfinite(residual):
        return "non-finite", "non-finite: an expression is infinite or no number; check the start and the parameters"
    if code == 1 or (code in (3, 4, 5) and residual <= 1e-11 * max(1.0, max_norm(y))):
        return "solved", ""
    if code == 2:
        return "iteration limit", "iteration limit: fsolve ran out of evaluations; try driver newton, or more steps"
    return "stalled", f"stalled: fsolve says, {' '.join(reason.split())} Try driver newton, or more steps"
