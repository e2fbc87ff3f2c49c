"""Extremals of smooth problems to rounding: Pontryagin's conditions by multiple shooting with scipy's DOP853.

With H = L + p . f the states and costates satisfy x' = f, p' = -dH/dx, and dH/du = 0 gives the controls, in which H is
quadratic. The states are given at the start, and the states or zero costates at the end. The unknowns are states and
costates at the ends of all segments. Newton's method starts from CasADi's and IPOPT's solution by rk4, whose
multipliers are the costates. Nothing here belongs to the project under test.

Between the ends of a segment the extremal is a Chebyshev polynomial through points at which DOP853 is restarted. The
interpolant of DOP853 is less accurate than its steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy
from numpy.polynomial import chebyshev
from scipy.integrate import solve_ivp

from .casadi_shooting import Array, PreparedShooting
from .gallery_problem import GalleryProblem

DEGREE, NEWTON_STEPS = 16, 12
TIGHT: dict[str, Any] = {"method": "DOP853", "rtol": 3e-14}
FINE = 4
"""Intervals of the first guess in a segment."""


@dataclass(frozen=True)
class Extremal:
    """The cost, and the coefficients (segments, DEGREE + 1, n + m) of states and controls as Chebyshev polynomials."""

    cost: float
    duration: float
    coefficients: Array
    dimension: int

    def at(self, times: Array) -> tuple[Array, Array]:
        """States (T, n) and controls (T, m)."""
        segments = len(self.coefficients)
        place = np.asarray(times) / self.duration * segments
        segment = np.clip(place.astype(int), 0, segments - 1)
        s = 2.0 * (place - segment) - 1.0
        basis = chebyshev.chebvander(s, DEGREE)
        values = np.einsum("td,tdc->tc", basis, self.coefficients[segment])
        return values[:, : self.dimension], values[:, self.dimension :]


def extremal(problem: GalleryProblem, segments: int) -> Extremal:
    """The extremal near IPOPT's solution; ArithmeticError if Newton's method does not converge."""
    n, m, length = problem.dimension, problem.controls, float(problem.duration([]))
    field, jacobian, inputs = hamiltonian_field(problem)
    z = first_guess(problem, segments)
    size = np.abs(z).max(axis=0)
    # A component may vanish, but for rounding.
    size = np.maximum(size, 1e-3 * np.repeat([size[:n].max(), size[n:].max()], n))
    h = length / segments

    def moved(start: Array, span: float) -> Array:
        """States, costates and cost after the time `span`."""
        tolerance = 1e-15 * np.append(size, 1.0)
        found = solve_ivp(lambda _, y: field(y[:-1]), (0.0, span), np.append(start, 0.0), atol=tolerance, **TIGHT)
        return np.asarray(found.y[:, -1])

    def propagated(start: Array) -> Array:
        """The derivative of the flow over a segment, to the accuracy that Newton's method needs."""

        def rates(_: float, y: Array) -> Array:
            return np.concatenate(
                [field(y[: 2 * n])[:-1], (jacobian(y[: 2 * n]) @ y[2 * n :].reshape(2 * n, 2 * n)).ravel()]
            )

        begin = np.concatenate([start, np.eye(2 * n).ravel()])
        found = solve_ivp(rates, (0.0, h), begin, method="DOP853", rtol=1e-9, atol=1e-12)
        return np.asarray(found.y[2 * n :, -1]).reshape(2 * n, 2 * n)

    assert not callable(problem.start)
    given = [i if value is not None else n + i for i, value in enumerate(problem.end)]
    wanted = np.array([0.0 if value is None else value for value in problem.end])
    before = np.inf
    for _ in range(NEWTON_STEPS):
        ends = np.array([moved(start, h) for start in z[:-1]])
        residual = np.concatenate(
            [z[0, :n] - np.array(problem.start), (z[1:] - ends[:, :-1]).ravel(), z[-1, given] - wanted]
        )
        matrix = np.zeros((z.size, z.size))
        matrix[:n, :n] = np.eye(n)
        for k in range(segments):
            rows = slice(n + 2 * n * k, n + 2 * n * (k + 1))
            matrix[rows, 2 * n * k : 2 * n * (k + 1)] = -propagated(z[k])
            matrix[rows, 2 * n * (k + 1) : 2 * n * (k + 2)] = np.eye(2 * n)
        matrix[np.arange(z.size - n, z.size), 2 * n * segments + np.array(given)] = 1.0
        step = -np.linalg.solve(matrix, residual).reshape(z.shape)
        z = z + step
        length_of_step = float(np.max(np.abs(step) / size))
        if length_of_step < 1e-11 and length_of_step >= before / 4:  # no further progress: rounding
            break
        before = length_of_step
    else:
        raise ArithmeticError(f"Newton's method has a last step of {length_of_step:.0e}")
    pieces, cost = [], 0.0
    points = np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))[::-1]
    fractions = np.diff((points + 1.0) / 2.0, prepend=0.0, append=1.0)
    for start in z[:-1]:
        values, y = [], start
        for fraction in fractions:
            found = moved(y, fraction * h)
            y, cost = found[:-1], cost + found[-1]
            values.append([*y[:n], *inputs(y)])
        vander = chebyshev.chebvander(points, DEGREE)
        pieces.append(np.linalg.solve(vander, np.array(values[:-1])))
    coefficients = np.array(pieces)
    tail = np.abs(coefficients[:, -2:]).max(axis=(0, 1)) / np.abs(coefficients[:, 0]).max(axis=0)
    if tail.max() > 1e-11:
        raise ArithmeticError(f"polynomials of degree {DEGREE} leave {tail.max():.0e}; give more segments")
    return Extremal(float(cost), length, coefficients.reshape(segments, DEGREE + 1, n + m), n)


def hamiltonian_field(problem: GalleryProblem) -> tuple[Any, Any, Any]:
    """Functions of (x, p): the rates of x, p and cost; the derivative of the rates of x and p; the controls."""
    assert problem.dynamics
    n, m = problem.dimension, problem.controls
    x, p, u = (sympy.symbols(f"{name}:{count}", seq=True) for name, count in (("x", n), ("p", n), ("u", m)))
    rates = problem.dynamics(sympy, x, u, sympy.S.Zero, [])
    cost = sympy.sympify(problem.cost(x, None, u, sympy.S.Zero))
    hamiltonian = cost + sum(a * b for a, b in zip(p, rates, strict=True))
    quadratic = sympy.hessian(hamiltonian, u)
    assert not quadratic.free_symbols & set(u)
    linear = sympy.Matrix([hamiltonian.diff(a).subs(dict.fromkeys(u, 0)) for a in u])
    inputs = list(-quadratic.inv() * linear)
    chosen = dict(zip(u, inputs, strict=True))
    flow = sympy.Matrix([*rates, *(-hamiltonian.diff(a) for a in x)]).subs(chosen)
    z = (*x, *p)
    as_function = {"modules": "numpy", "cse": True}
    functions = [
        sympy.lambdify(z, list(part), **as_function) for part in ([*flow, cost.subs(chosen)], flow.jacobian(z), inputs)
    ]
    return (
        lambda y: np.array(functions[0](*y), dtype=float),
        lambda y: np.array(functions[1](*y), dtype=float).reshape(2 * n, 2 * n),
        lambda y: functions[2](*y),
    )


def first_guess(problem: GalleryProblem, segments: int) -> Array:
    """States and costates (segments + 1, 2 n) at the ends of segments, from IPOPT's solution and its multipliers."""
    n, m, steps = problem.dimension, problem.controls, FINE * segments
    prepared = PreparedShooting(problem, steps, "ipopt", 1e-9, 1000)
    prepared.run()
    status = prepared.report()["status"]
    if status != "solved":
        raise ArithmeticError(f"IPOPT {status}")
    unknowns = np.asarray(prepared.solution["x"]).ravel()
    states = np.vstack([unknowns[: (n + m) * steps].reshape(steps, n + m)[:, :n], unknowns[(n + m) * steps :]])
    # The constraint is x_{k+1} - F(x_k, u_k) = 0, whose multiplier is minus the costate at the node k + 1.
    costates = -np.asarray(prepared.solution["lam_g"]).ravel().reshape(steps, n)
    return np.hstack([states, np.vstack([costates[:1], costates])])[::FINE]
