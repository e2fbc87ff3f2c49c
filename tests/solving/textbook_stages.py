"""One step of Runge-Kutta methods from tables that are computed anew, and of compositions step by step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mpmath
import numpy as np
import sympy
from simulation_systems import System
from textbook_steps import field, textbook_step

from codegen.discretise import schemes

Table = list[list[Any]]
_ITERATIONS = 40


def collocation(abscissae: list[Any]) -> tuple[list[Any], Table]:
    """Weights and table of collocation at some abscissae: integrals of Lagrange's basis polynomials."""

    def basis(j: int) -> Any:
        return lambda x: mpmath.fprod((x - c) / (abscissae[j] - c) for i, c in enumerate(abscissae) if i != j)

    count = range(len(abscissae))
    return [mpmath.quad(basis(j), [0, 1]) for j in count], [
        [mpmath.quad(basis(j), [0, c]) for j in count] for c in abscissae
    ]


def gauss(stages: int) -> tuple[list[Any], Table, Table]:
    """Collocation at the roots of the shifted Legendre polynomial."""
    roots = mpmath.polyroots(mpmath.taylor(lambda x: mpmath.legendre(stages, 2 * x - 1), 0, stages)[::-1])
    weights, table = collocation(sorted(mpmath.re(root) for root in roots))
    return weights, table, table


def radau() -> tuple[list[Any], Table, Table]:
    """Collocation at the roots of d^2/dx^2 (x^2 (x - 1)^3), of which the last is 1 (Hairer and Wanner 1996, IV.5)."""
    weights, table = collocation(sorted(mpmath.re(root) for root in mpmath.polyroots([10, -18, 9, -1])))
    return weights, table, table


def lobatto() -> tuple[list[Any], Table, Table]:
    """IIIA is collocation at 0, 1/2 and 1; the symplectic partner has c_ij = b_j (1 - a_ji / b_i)."""
    b, a = collocation([mpmath.mpf(0), mpmath.mpf(1) / 2, mpmath.mpf(1)])
    return b, a, [[b[j] * (1 - a[j][i] / b[i]) for j in range(3)] for i in range(3)]


def simpson() -> tuple[list[Any], Table, Table]:
    """IIIA for coordinates and momenta."""
    b, a = collocation([mpmath.mpf(0), mpmath.mpf(1) / 2, mpmath.mpf(1)])
    return b, a, a


def classical() -> tuple[list[Any], Table, Table]:
    """Kutta's method."""
    half, sixth = mpmath.mpf(1) / 2, mpmath.mpf(1) / 6
    table = [[0, 0, 0, 0], [half, 0, 0, 0], [0, half, 0, 0], [0, 0, 1, 0]]
    return [sixth, 2 * sixth, 2 * sixth, sixth], table, table


TABLES = {
    ("hamiltonian", "gauss-4"): lambda: gauss(2),
    ("variational", "gauss-4"): lambda: gauss(2),
    ("hamiltonian", "gauss-6"): lambda: gauss(3),
    ("variational", "gauss-6"): lambda: gauss(3),
    ("hamiltonian", "gauss-8"): lambda: gauss(4),
    ("hamiltonian", "radau-5"): radau,
    ("hamiltonian", "hermite-simpson"): simpson,
    ("hamiltonian", "lobatto-4"): lobatto,
    ("variational", "lobatto-4"): lobatto,
    ("hamiltonian", "rk4"): classical,
}
"""Galerkin integrators with forces of time alone are the same maps (Marsden and West 2001, section 2.6.6)."""


def higher_order_step(system: System, method: str, scheme: str, instant: float, length: float) -> np.ndarray:
    """The state one step after the system's own."""
    with mpmath.workdps(25):
        if (method, scheme) in TABLES:
            state = _stages_solved(system, *TABLES[method, scheme](), instant, length)
        else:
            found = schemes.find(scheme, method)
            state = _composed(system, found, instant, length)
        return np.array([float(x) for x in state])


def _stages_solved(system: System, b: list[Any], a: Table, c: Table, instant: float, length: float) -> list[Any]:
    """Iterate on the slopes of the stages, which contracts for short steps."""
    n, t, h = system.dimension, mpmath.mpf(instant), mpmath.mpf(length)
    q0, p0 = ([mpmath.mpf(x) for x in part] for part in (system.state[:n], system.state[n:]))
    stages = range(len(b))
    slopes = [field(system, q0, p0, t)] * len(b)

    def moved(x0: list[Any], row: list[Any], which: int) -> list[Any]:
        return [x + h * sum(w * slopes[j][which][i] for j, w in enumerate(row)) for i, x in enumerate(x0)]

    for _ in range(_ITERATIONS):
        slopes = [field(system, moved(q0, a[i], 0), moved(p0, c[i], 1), t + sum(a[i]) * h) for i in stages]
    return [*moved(q0, b, 0), *moved(p0, b, 1)]


def _composed(system: System, scheme: Any, instant: float, length: float) -> list[Any]:
    """Position Verlet by two halves of any length: the inner position, a kick by both lengths, the rest of the way.

    For Hamiltonians that are separable.
    """
    assert scheme.base.name == "position-verlet"
    n, t = system.dimension, mpmath.mpf(instant)
    q, p = ([mpmath.mpf(x) for x in part] for part in (system.state[:n], system.state[n:]))
    for row in scheme.parts:
        first, second = (mpmath.mpf(length) * mpmath.mpf(str(sympy.N(f, 25))) for f in row)
        q = [x + first * v for x, v in zip(q, field(system, q, p, t)[0], strict=True)]
        t += first
        p = [x + (first + second) * f for x, f in zip(p, field(system, q, p, t)[1], strict=True)]
        q = [x + second * v for x, v in zip(q, field(system, q, p, t)[0], strict=True)]
        t += second
    return [*q, *p]


def composed_of_midpoint(system: System, fractions: list[Any], instant: float, length: float) -> np.ndarray:
    """Steps of the midpoint rule one after the other."""
    state = system
    for fraction in fractions:
        part = length * float(fraction)
        state = replace(state, state=tuple(textbook_step(state, "hamiltonian", "midpoint", instant, part)))
        instant += part
    return np.array(state.state)
