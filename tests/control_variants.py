"""Control problems that between them have every feature of a generated module, and a point to try them at."""

from __future__ import annotations

from typing import Any

import numpy as np

from codegen.runtime.search import point
from codegen.runtime.search.grid import free_unknowns
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, is_factored, solve_kkt

DOUBLE_PENDULUM = '''"""Double pendulum whose boundary conditions leave coupled velocities free."""
from sympy import cos, pi
from codegen import Control, controls, coordinates, parameters
def problem() -> Control:
    (a, b), (da, db) = coordinates("a b")
    u, w = controls("u w")
    m, l, g = parameters(m=1, l=1, g=9.81)
    return Control(
        lagrangian=m*l**2/2*(2*da**2 + db**2 + 2*da*db*cos(a - b)) + m*g*l*(2*cos(a) + cos(b)),
        force={a: u, b: w}, cost=u**2 + w**2, duration=2,
        start={a: 0, b: 0, da: 0}, end={a: pi/2, b: pi/2, db: 0}, steps=20)
'''

DRIVEN = '''"""A driven oscillator: time in the Lagrangian, the force, the cost and the guess; free end velocity."""
from sympy import cos, exp
from codegen import Control, control, coordinate, parameters, time
def problem() -> Control:
    q, dq = coordinate("q")
    u = control("u")
    k, R = parameters(k=2, R=0.5)
    t = time()
    return Control(
        lagrangian=exp(t/3)*(dq**2/2 - k*q**2/2), force={q: u*(1 + t/5) - dq/10}, cost=R*u**2*exp(-t/2) + q**2*cos(t),
        duration=2, start={q: 1, dq: 0}, end={q: 0}, guess={q: 1 - t/2, u: t}, steps=20)
'''

ANTIPHASE = '''"""Two damped oscillators, kept in antiphase with the least effort; the period is free."""
from sympy import Eq, cos, pi
from codegen import Control, body_number, control, coordinate, free_parameter, parameters, time
def problem() -> Control:
    q, v = coordinate("q")
    u = control("u")
    t, body = time(), body_number()
    damping, distance = parameters(damping=0.1, distance=2)
    T = free_parameter("T", guess=6)
    return Control(
        lagrangian=v**2 / 2 - q**2 / 2, force={q: u - damping * v}, cost=u**2 + 1, duration=T, periodic=[q, v],
        end_conditions=[Eq(q.of(0) - q.of(1), distance)], bodies=2,
        guess={q: (1 - 2 * body) * cos(pi * t / 3)}, steps=20)
'''

PUSHED = '''"""A damped pendulum, pushed at a slant, in a forced periodic motion with little effort."""
from sympy import cos, pi, sin
from codegen import Control, control, coordinate, time
def problem() -> Control:
    q, v = coordinate("q")
    u, t = control("u"), time()
    return Control(
        lagrangian=v**2/2 + cos(q), force={q: u*cos(q) - v/5 + sin(t)}, cost=u**2 + (q - sin(t))**2, duration=2*pi,
        periodic=[q, v], guess={q: sin(t)}, steps=20)
'''

VARIANTS: list[tuple[str, str | None, dict[str, str]]] = [
    ("linear_pendulum", None, {}),
    ("orbital_transfer", None, {}),
    ("orbital_transfer", None, {"scheme": "trapezoidal"}),
    ("orbital_transfer", None, {"method": "hamiltonian", "scheme": "stormer-verlet"}),
    ("orbital_transfer", None, {"controls": "nodal"}),
    ("double", DOUBLE_PENDULUM, {}),
    ("double", DOUBLE_PENDULUM, {"method": "hamiltonian"}),
    ("driven", DRIVEN, {}),
    ("hovercraft", None, {}),
    ("antiphase", ANTIPHASE, {}),
    ("antiphase", ANTIPHASE, {"method": "hamiltonian"}),
    ("pushed", PUSHED, {}),
    ("spherical_pendulum", None, {}),
    ("van_der_pol", None, {"scheme": "trapezoidal"}),
    ("goddard_rocket", None, {}),
    ("low_thrust", None, {}),
    ("van_der_pol", None, {"scheme": "rk4"}),
    ("van_der_pol", None, {"scheme": "hermite-simpson"}),
    ("van_der_pol", None, {"scheme": "rk4", "controls": "linear"}),
    ("low_thrust", None, {"scheme": "gauss-4"}),
    ("low_thrust", None, {"method": "hamiltonian", "scheme": "rk4"}),
    ("driven", DRIVEN, {"scheme": "gauss-4"}),
    ("antiphase", ANTIPHASE, {"method": "hamiltonian", "scheme": "gauss-4"}),
    ("orbital_transfer", None, {"method": "hamiltonian", "scheme": "yoshida-4"}),
    ("two_stage_rocket", None, {"scheme": "rk4"}),
]
"""Name, text (or None for a file of the gallery) and choices."""


def trial_point(module: Any, grid: Any, seed: int, scale: float) -> np.ndarray:
    """Unknowns at a random distance from the guess; those that are given, or equal shared ones, keep to that."""
    free = free_unknowns(grid)
    noise = np.random.default_rng(seed).normal(scale=scale, size=free.size)
    return module.with_pinned_values(grid, module.initial_guess(grid) + np.where(free, noise, 0.0))


def dense_kkt(module: Any, grid: Any, unknowns: np.ndarray) -> np.ndarray:
    """The KKT matrix from the callbacks; rows and columns of what is given are zero."""
    matrix = np.zeros((unknowns.size, unknowns.size))
    primal, multipliers = module.primal_unknowns(grid), module.multiplier_unknowns(grid)
    rows, columns, values = point.hessian(grid, unknowns)
    np.add.at(matrix, (primal[rows], primal[columns]), values)
    rows, columns, values = point.jacobian(grid, unknowns)
    np.add.at(matrix, (multipliers[rows], primal[columns]), values)
    np.add.at(matrix, (primal[columns], multipliers[rows]), values)
    return matrix


def assert_steps_are_dense(module: Any, grid: Any, diagonal: np.ndarray, unknowns: np.ndarray) -> Any:
    """Compare the steps with and without the right-hand side in the elimination; return the storage of the factors."""
    free = np.flatnonzero(free_unknowns(grid))
    right = np.where(free_unknowns(grid), np.random.default_rng(3).normal(size=unknowns.size), 0.0)
    system, carried, again = allocate_system(grid), np.zeros(unknowns.size), np.zeros(unknowns.size)
    assert is_factored(factor_kkt(grid, unknowns, 1.0, diagonal, system, right, carried))
    solve_kkt(grid, system, right, again)
    matrix = (dense_kkt(module, grid, unknowns) + np.diag(diagonal))[np.ix_(free, free)]
    expected = np.linalg.solve(matrix, -right[free])
    for step in (carried, again):
        np.testing.assert_allclose(step[free], expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())
    return system


def shifts(module: Any, grid: Any, shift: float, delta_c: float) -> np.ndarray:
    """A diagonal to be added to the KKT matrix, for free unknowns only."""
    diagonal = np.where(grid.is_multiplier, -delta_c, shift)
    return np.where(free_unknowns(grid), diagonal, 0.0)


def eliminated_blocks_are_positive(module: Any, grid: Any, matrix: np.ndarray) -> bool:
    """Whether what the module eliminates inside each interval has a positive definite block of the KKT matrix."""
    chain = grid.steps * module.problem.structure.stride + module.problem.structure.node
    first = module.problem.structure.stride - module.problem.structure.condensed
    indices = [
        body * chain + k * module.problem.structure.stride + first + np.arange(module.problem.structure.condensed)
        for body in range(module.BODIES)
        for k in range(grid.steps)
    ]
    return all(np.linalg.eigvalsh(matrix[np.ix_(p, p)]).min(initial=np.inf) > 0.0 for p in indices)
