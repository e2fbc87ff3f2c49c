"""The space shuttle with limited heating by CasADi and IPOPT: collocation at Radau points of degree five.

    python tests/benchmarks/peers/casadi_shuttle.py [K ...]

prints the greatest latitude, in degrees, and the flight time for each number K of elements. Sources as in the problem's
file, problems/published/space_shuttle_reentry.py.
"""

from __future__ import annotations

import math
import sys
from typing import Any

import casadi as ca
import numpy as np

DEGREE = 5


def collocation() -> tuple[np.ndarray, np.ndarray]:
    """The points of an element with its left end, and derivatives of the Lagrange polynomials there."""
    points = np.append(0.0, ca.collocation_points(DEGREE, "radau"))
    derivatives = np.zeros((DEGREE + 1, DEGREE + 1))
    for j in range(DEGREE + 1):
        basis = np.poly1d([1.0])
        for r in range(DEGREE + 1):
            if r != j:
                basis *= np.poly1d([1.0, -points[r]]) / (points[j] - points[r])
        derivatives[j] = np.polyder(basis)(points)
    return points, derivatives


def motion(x: Any, u: Any) -> tuple[Any, Any]:
    """Rates of the six states and the heating rate."""
    altitude, _, latitude, speed, gamma, psi = (x[i] for i in range(6))
    alpha, bank = u[0], u[1]
    v, r, mass = 1e4 * speed, 20902900.0 + 1e5 * altitude, 203000.0 / 32.174
    gravity, density = 0.14076539e17 / r**2, 0.002378 * ca.exp(-1e5 * altitude / 23800.0)
    a = 180.0 / math.pi * alpha
    pressure = density * v**2 / 2.0 * 2690.0
    drag = pressure * (0.07854 - 0.0061592 * a + 6.21408e-4 * a**2)
    lift = pressure * (-0.20704 + 0.029244 * a)
    rates = ca.vertcat(
        v * ca.sin(gamma) / 1e5,
        v * ca.cos(gamma) * ca.sin(psi) / (r * ca.cos(latitude)),
        v * ca.cos(gamma) * ca.cos(psi) / r,
        (-drag / mass - gravity * ca.sin(gamma)) / 1e4,
        lift * ca.cos(bank) / (mass * v) + ca.cos(gamma) * (v / r - gravity / v),
        lift * ca.sin(bank) / (mass * v * ca.cos(gamma))
        + v * ca.cos(gamma) * ca.sin(psi) * ca.sin(latitude) / (r * ca.cos(latitude)),
    )
    shape = 1.0672181 - 0.019213774 * a + 2.1286289e-4 * a**2 - 1.0117249e-6 * a**3
    return rates, 17700.0 * ca.sqrt(density) * (0.0001 * v) ** 3.07 * shape


def greatest_latitude(elements: int, limit: float = 70.0) -> tuple[float, float]:
    """The latitude in degrees and the flight time in seconds."""
    _, derivatives = collocation()
    x, u = ca.MX.sym("x", 6), ca.MX.sym("u", 2)
    field = ca.Function("field", [x, u], list(motion(x, u)))
    opti = ca.Opti()
    time = opti.variable()
    states, controls = opti.variable(6, elements * DEGREE + 1), opti.variable(2, elements * DEGREE)
    for k in range(elements):
        own = states[:, k * DEGREE : (k + 1) * DEGREE + 1]
        for j in range(1, DEGREE + 1):
            rate, heat = field(own[:, j], controls[:, k * DEGREE + j - 1])
            opti.subject_to(ca.mtimes(own, ca.DM(derivatives[:, j])) * elements == time / 1000.0 * 1000.0 * rate)
            opti.subject_to(heat / limit <= 1.0)
    first, last = np.array([2.6, 0, 0, 2.56, math.radians(-1), math.pi / 2]), (0.8, 0.25, math.radians(-5))
    opti.subject_to(states[:, 0] == first)
    for i, value in zip((0, 3, 4), last, strict=True):
        opti.subject_to(states[i, -1] == value)
    opti.subject_to(opti.bounded(-math.pi / 2, controls[0, :], math.pi / 2))
    opti.subject_to(opti.bounded(math.radians(-89), controls[1, :], math.radians(1)))
    opti.subject_to(opti.bounded(1000.0, time, 4000.0))
    opti.minimize(-states[2, -1])
    s = np.linspace(0.0, 1.0, elements * DEGREE + 1)
    ends = np.array([0.8, 1.3, 0.6, 0.25, math.radians(-5), 0.2])
    opti.set_initial(states, first[:, None] + (ends - first)[:, None] * s)
    opti.set_initial(controls[0, :], math.radians(17))
    opti.set_initial(controls[1, :], math.radians(-60))
    opti.set_initial(time, 2000.0)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "tol": 1e-10, "max_iter": 2000})
    found = opti.solve()
    return math.degrees(float(found.value(states[2, -1]))), float(found.value(time))


if __name__ == "__main__":
    for count in map(int, sys.argv[1:] or ("40", "80", "160")):
        print(count, *greatest_latitude(count), flush=True)
