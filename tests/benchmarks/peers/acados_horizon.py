"""The program of a moving horizon in acados: C code that acados writes and compiles in the current folder.

Dynamics and cost of an interval are one step of rk4, as in `casadi_shooting.py`, given to acados as discrete dynamics
and external costs. The Gauss-Newton Hessian is that of the residuals at the stages of rk4. The package
`comma-deps-acados` has acados as libraries. Its folder `acados` must be in PYTHONPATH, ACADOS_SOURCE_DIR must name
`acados/install`, and LD_LIBRARY_PATH `acados/install/lib`.
"""

from __future__ import annotations

from time import thread_time
from typing import Any

import casadi as ca
import numpy as np
from acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver

from .casadi_shooting import Array, step_function
from .regulators import Regulator

WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


class AcadosHorizon:
    """A solver that starts from its own last solution, shifted; `seconds` is the time of acados without the shift."""

    def __init__(self, name: str, regulator: Regulator, is_single: bool, is_exact: bool, tolerance: float) -> None:
        """Write and compile the solver: one iteration if `is_single`, with the exact Hessian or Gauss and Newton's."""
        problem, steps = regulator.problem, regulator.steps
        n, m, self.steps = problem.dimension, problem.controls, steps
        x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
        end, cost = step_function(problem, steps)(x, u, 0, ca.SX(0, 1))
        h = problem.duration([]) / steps
        final = ca.vertcat(*regulator.final(ca.vertsplit(x)))
        model = AcadosModel()
        model.name, model.x, model.u = name, x, u
        model.disc_dyn_expr = end
        model.cost_expr_ext_cost = cost / h  # acados multiplies by the length of the interval
        model.cost_expr_ext_cost_e = ca.sumsqr(final)
        if not is_exact:
            model.cost_expr_ext_cost_custom_hess = 2 * self._gauss_newton(regulator, x, u, h)
            slopes = ca.jacobian(final, x)
            model.cost_expr_ext_cost_custom_hess_e = 2 * slopes.T @ slopes
        ocp = AcadosOcp()
        ocp.model, ocp.dims.N = model, steps
        ocp.cost.cost_type = ocp.cost.cost_type_e = "EXTERNAL"
        limits = ocp.constraints
        limits.x0 = np.array(problem.start)
        limits.idxbx = limits.idxbx_e = np.array(list(problem.bounds))
        limits.lbx = limits.lbx_e = np.array([low for low, _ in problem.bounds.values()])
        limits.ubx = limits.ubx_e = np.array([high for _, high in problem.bounds.values()])
        limits.idxbu = np.array(list(problem.control_bounds))
        limits.lbu = np.array([low for low, _ in problem.control_bounds.values()])
        limits.ubu = np.array([high for _, high in problem.control_bounds.values()])
        options = ocp.solver_options
        options.tf, options.integrator_type = problem.duration([]), "DISCRETE"
        options.nlp_solver_type = "SQP_RTI" if is_single else "SQP"
        options.hessian_approx = "EXACT" if is_exact else "GAUSS_NEWTON"
        options.regularize_method = "PROJECT" if is_exact else "NO_REGULARIZE"
        options.qp_solver, options.qp_solver_cond_N = "PARTIAL_CONDENSING_HPIPM", max(1, steps // 4)
        options.qp_solver_warm_start, options.qp_solver_iter_max = 1, 100
        options.nlp_solver_max_iter, options.tol = 100, tolerance
        options.ext_fun_compile_flags = "-O3 -march=native"
        self.solver = AcadosOcpSolver(ocp, json_file=f"{name}.json", verbose=False)
        self.values = np.array(problem.guess(np, 0.0)[0], dtype=float), np.array(problem.guess(np, 0.0)[1], dtype=float)
        self.states, self.controls = np.tile(self.values[0], (steps + 1, 1)), np.tile(self.values[1], (steps, 1))
        self.status, self.iterations, self.seconds, self.is_first = "", 0, 0.0, True

    @staticmethod
    def _gauss_newton(regulator: Regulator, x: ca.SX, u: ca.SX, h: float) -> ca.SX:
        """The sum over the stages of rk4 of the products of the residuals' slopes in (u, x)."""
        assert regulator.problem.dynamics
        dynamics, total, slope = regulator.problem.dynamics, 0, ca.SX.zeros(x.shape)
        inputs, both = ca.vertsplit(u), ca.vertcat(u, x)
        for weight, share in zip(WEIGHTS, (0.0, 0.5, 0.5, 1.0), strict=True):
            at = ca.vertsplit(x + h * share * slope)
            slopes = ca.jacobian(ca.vertcat(*regulator.residuals(at, inputs)), both)
            total += weight * slopes.T @ slopes
            slope = ca.vertcat(*dynamics(ca, at, inputs, 0, []))
        return total

    def step(self, state: Array, _t: float) -> Array:
        """The inputs of the first interval."""
        solver, steps = self.solver, self.steps
        if not self.is_first:
            multipliers = [solver.get(k, "pi") for k in range(steps)]
            for k in range(steps + 1):
                solver.set(k, "x", self.states[min(k + 1, steps)])
            for k in range(steps):
                solver.set(k, "u", self.controls[min(k + 1, steps - 1)])
                solver.set(k, "pi", multipliers[min(k + 1, steps - 1)])
        else:
            for k in range(steps + 1):
                solver.set(k, "x", self.values[0])
            for k in range(steps):
                solver.set(k, "u", self.values[1])
        begin = thread_time()
        solver.set(0, "lbx", state)
        solver.set(0, "ubx", state)
        status = solver.solve()
        inputs = solver.get(0, "u")
        self.seconds, self.is_first = thread_time() - begin, False
        self.status = "solved" if status == 0 else f"status {status}"
        self.iterations = int(np.max(solver.get_stats("sqp_iter")))
        self.states = np.array([solver.get(k, "x") for k in range(steps + 1)])
        self.controls = np.array([solver.get(k, "u") for k in range(steps)])
        return np.asarray(inputs)

    def plan(self) -> tuple[Any, Any]:
        """States (N + 1, n) and controls (N, m) of the last solution."""
        return self.states, self.controls
