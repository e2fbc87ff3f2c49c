"""The same with CasADi's Opti and IPOPT: the discretisation is written out by its user."""

import casadi
import numpy

m, l, g, N = 1, 0.5, 9.81, 100
h = 2 / N
opti = casadi.Opti()
theta, p, torque = opti.variable(N + 1), opti.variable(N + 1), opti.variable(N)
for k in range(N):
    middle = (theta[k] + theta[k + 1]) / 2
    opti.subject_to(theta[k + 1] - theta[k] == h * (p[k] + p[k + 1]) / 2 / (m * l**2))
    opti.subject_to(p[k + 1] - p[k] == h * (torque[k] - m * g * l * casadi.sin(middle)))
opti.subject_to([theta[0] == 0, p[0] == 0, theta[N] == numpy.pi, p[N] == 0])
opti.minimize(h * casadi.sumsqr(torque))
opti.set_initial(theta, numpy.linspace(0, numpy.pi, N + 1))
opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
cost = opti.solve().value(opti.f)
print(cost)
