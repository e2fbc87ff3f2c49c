"""The same with acados: CasADi expressions, Gauss-Legendre integrators and SQP as generated C, compiled by gcc."""

import casadi
import numpy
from acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver

m, l, g, N = 1, 0.5, 9.81, 100
x, u = casadi.SX.sym("x", 2), casadi.SX.sym("u")
model = AcadosModel()
model.name, model.x, model.u = "swing_up", x, u
model.f_expl_expr = casadi.vertcat(x[1], u / (m * l**2) - g / l * casadi.sin(x[0]))
model.xdot = casadi.SX.sym("xdot", 2)
model.f_impl_expr = model.xdot - model.f_expl_expr
model.cost_expr_ext_cost = u**2

ocp = AcadosOcp()
ocp.model = model
ocp.dims.N = N
ocp.cost.cost_type = "EXTERNAL"
ocp.constraints.x0 = numpy.zeros(2)
ocp.constraints.idxbx_e = numpy.arange(2)
ocp.constraints.lbx_e = ocp.constraints.ubx_e = numpy.array([numpy.pi, 0])
options = ocp.solver_options
options.tf, options.nlp_solver_type, options.nlp_solver_max_iter = 2, "SQP", 200
options.integrator_type, options.sim_method_num_stages = "IRK", 3
options.hessian_approx, options.regularize_method = "EXACT", "PROJECT"
options.qp_solver, options.globalization = "PARTIAL_CONDENSING_HPIPM", "MERIT_BACKTRACKING"
options.tol = 1e-8

solver = AcadosOcpSolver(ocp, json_file="swing_up.json")
for k in range(N + 1):
    solver.set(k, "x", numpy.array([numpy.pi * k / N, 0]))
status, cost = solver.solve(), solver.get_cost()
print(status, cost)
