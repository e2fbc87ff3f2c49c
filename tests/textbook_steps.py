"""One step of every scheme by the equations of textbooks, in high precision and with numerical derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mpmath
import numpy as np
from simulation_systems import System


def partial(function: Callable[..., Any], index: int, *arguments: Any) -> list[Any]:
    """Numerical gradient by one of the vector arguments, in high precision."""
    gradient = []
    for i in range(len(arguments[index])):

        def along(s: Any, i: int = i) -> Any:
            moved = [list(a) if isinstance(a, (list, tuple)) else a for a in arguments]
            moved[index][i] = s
            return function(*moved)

        gradient.append(mpmath.diff(along, arguments[index][i]))
    return gradient


def field(system: System, q: Sequence[Any], p: Sequence[Any], t: Any) -> tuple[list[Any], list[Any]]:
    """Forced Hamiltonian vector field."""
    velocity = partial(system.hamiltonian, 1, q, p, t)
    slope = [-g for g in partial(system.hamiltonian, 0, q, p, t)]
    if system.force:
        slope = [s + f for s, f in zip(slope, system.force(q, velocity, t), strict=True)]
    return velocity, slope


def mean(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
    return [(x + y) / 2 for x, y in zip(a, b, strict=True)]


def one_step_defect(point: str) -> Callable[..., list[Any]]:
    """z1 - z0 - h X at the named point: which q, which p, which time."""

    def defect(system: System, q0: Any, p0: Any, q1: Any, p1: Any, t: Any, h: Any) -> list[Any]:
        q, p, instant = {
            "left": (q0, p0, t),
            "right": (q1, p1, t + h),
            "old q, new p": (q0, p1, t),
            "new q, old p": (q1, p0, t + h),
            "middle": (mean(q0, q1), mean(p0, p1), t + h / 2),
        }[point]
        velocity, slope = field(system, q, p, instant)
        return [
            *(b - a - h * v for a, b, v in zip(q0, q1, velocity, strict=True)),
            *(b - a - h * s for a, b, s in zip(p0, p1, slope, strict=True)),
        ]

    return defect


def stormer_verlet_defect(system: System, q0: Any, p0: Any, q1: Any, p1: Any, t: Any, h: Any) -> list[Any]:
    """Hairer, Lubich and Wanner (VI.3.4); the inner momentum follows from the last equation, explicit in it or not."""
    n = len(q0)

    def inner(*middle: Any) -> list[Any]:
        _, slope = field(system, q0, list(middle), t)
        return [m - a - h / 2 * s for m, a, s in zip(middle, p0, slope, strict=True)]

    solution = mpmath.findroot(inner, list(p0)) if n > 1 else [mpmath.findroot(lambda m: inner(m)[0], p0[0])]
    middle = list(solution)
    before, after = field(system, q0, middle, t)[0], field(system, q1, middle, t + h)
    return [
        *(b - a - h / 2 * (u + v) for a, b, u, v in zip(q0, q1, before, after[0], strict=True)),
        *(b - m - h / 2 * s for m, b, s in zip(middle, p1, after[1], strict=True)),
    ]


def variational_defect(rule: Sequence[tuple[Any, Any]]) -> Callable[..., list[Any]]:
    """p0 + D1 Ld + f- and p1 - D2 Ld - f+ for the quadrature rule [(weight, abscissa), ...]."""

    def defect(system: System, q0: Any, p0: Any, q1: Any, p1: Any, t: Any, h: Any) -> list[Any]:
        def at(function: Callable[..., Any], c: Any, a: Any, b: Any) -> Any:
            position = [(1 - c) * x + c * y for x, y in zip(a, b, strict=True)]
            return function(position, [(y - x) / h for x, y in zip(a, b, strict=True)], t + c * h)

        def discrete_lagrangian(a: Any, b: Any) -> Any:
            return h * sum(w * at(system.lagrangian, c, a, b) for w, c in rule)

        minus, plus = [0] * len(q0), [0] * len(q0)
        for w, c in rule if system.force else ():
            force = at(system.force, c, q0, q1)
            minus = [m + h * w * (1 - c) * f for m, f in zip(minus, force, strict=True)]
            plus = [m + h * w * c * f for m, f in zip(plus, force, strict=True)]
        left, right = partial(discrete_lagrangian, 0, q0, q1), partial(discrete_lagrangian, 1, q0, q1)
        return [
            *(p + d + f for p, d, f in zip(p0, left, minus, strict=True)),
            *(p - d - f for p, d, f in zip(p1, right, plus, strict=True)),
        ]

    return defect


def position_verlet_defect(system: System, q0: Any, p0: Any, q1: Any, p1: Any, t: Any, h: Any) -> list[Any]:
    """The other variant of Hairer, Lubich and Wanner (VI.3.4), with the inner position."""
    n = len(q0)

    def inner(*middle: Any) -> list[Any]:
        velocity, _ = field(system, list(middle), p0, t + h / 2)
        return [m - a - h / 2 * v for m, a, v in zip(middle, q0, velocity, strict=True)]

    solution = mpmath.findroot(inner, list(q0)) if n > 1 else [mpmath.findroot(lambda m: inner(m)[0], q0[0])]
    middle = list(solution)
    before, after = field(system, middle, p0, t + h / 2)[1], field(system, middle, p1, t + h / 2)
    return [
        *(b - m - h / 2 * v for m, b, v in zip(middle, q1, after[0], strict=True)),
        *(b - a - h / 2 * (u + v) for a, b, u, v in zip(p0, p1, before, after[1], strict=True)),
    ]


HALF = mpmath.mpf(1) / 2
TEXTBOOK = {
    ("hamiltonian", "explicit-euler"): one_step_defect("left"),
    ("hamiltonian", "implicit-euler"): one_step_defect("right"),
    ("hamiltonian", "symplectic-euler"): one_step_defect("old q, new p"),
    ("hamiltonian", "symplectic-euler-adjoint"): one_step_defect("new q, old p"),
    ("hamiltonian", "midpoint"): one_step_defect("middle"),
    ("hamiltonian", "stormer-verlet"): stormer_verlet_defect,
    ("hamiltonian", "position-verlet"): position_verlet_defect,
    ("variational", "rectangle"): variational_defect([(1, 0)]),
    ("variational", "midpoint"): variational_defect([(1, HALF)]),
    ("variational", "trapezoidal"): variational_defect([(HALF, 0), (HALF, 1)]),
}


def textbook_step(system: System, method: str, scheme: str, instant: float, length: float) -> np.ndarray:
    """Solve the textbook's equations for one step from the system's state."""
    n = system.dimension
    state = [mpmath.mpf(x) for x in system.state]
    t, h = mpmath.mpf(instant), mpmath.mpf(length)
    defect = TEXTBOOK[method, scheme]
    velocity, slope = field(system, state[:n], state[n:], t)
    guess = [x + h * rate for x, rate in zip(state, (*velocity, *slope), strict=True)]

    def equations(*z: Any) -> list[Any]:
        return defect(system, state[:n], state[n:], list(z[:n]), list(z[n:]), t, h)

    return np.array([float(x) for x in mpmath.findroot(equations, guess, tol=1e-30)])
