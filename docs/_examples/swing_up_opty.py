"""The same with opty: equations of motion in sympy, controls at nodes, IPOPT."""

import numpy
import sympy
from opty import Problem, create_objective_function

N, h = 101, 2 / 100
m, l, g, t = sympy.symbols("m l g t")
theta, omega, torque = (sympy.Function(name)(t) for name in ("theta", "omega", "torque"))
equations = sympy.Matrix([theta.diff(t) - omega, m * l**2 * omega.diff(t) + m * g * l * sympy.sin(theta) - torque])
objective, gradient = create_objective_function(
    sympy.Integral(torque**2, t), (theta, omega), (torque,), (), N, h, integration_method="midpoint", time_symbol=t
)
ends = (theta.func(0), theta.func(2) - sympy.pi, omega.func(0), omega.func(2))
problem = Problem(
    objective, gradient, equations, (theta, omega), N, h, known_parameter_map={m: 1, l: 0.5, g: 9.81},
    instance_constraints=ends, integration_method="midpoint", time_symbol=t,
)  # fmt: skip
problem.add_option("print_level", 0)
guess = numpy.concatenate([numpy.linspace(0, numpy.pi, N), numpy.zeros(2 * N)])
solution, found = problem.solve(guess)
cost = objective(solution)
print(cost)
