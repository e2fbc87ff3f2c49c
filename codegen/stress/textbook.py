"""The equations of a step in their textbook form and extended precision, evaluated on the states that a module returns.

For H = |p|^2/2 + V(q) with f = -V_q. Nothing of the generated code takes part. Source of all forms: Hairer, Lubich and
Wanner (2006), Geometric numerical integration, I.1 and VI.3; variational schemes are taken on their Hamiltonian side,
Marsden and West (2001), section 2.6.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from codegen.solutions.result import Result
from codegen.stress.cases import Case
from codegen.stress.systems import DEFAULTS, FORCES

Array = Any
Field = Callable[[Array], Array]


def explicit_euler(f: Field, h: Any, q: Array, p: Array, q1: Array, p1: Array) -> tuple[Array, Array]:
    """Field at (q0, p0)."""
    return q1 - q - h * p, p1 - p - h * f(q)


def implicit_euler(f: Field, h: Any, q: Array, p: Array, q1: Array, p1: Array) -> tuple[Array, Array]:
    """Field at (q1, p1)."""
    return q1 - q - h * p1, p1 - p - h * f(q1)


def symplectic_euler(f: Field, h: Any, q: Array, p: Array, q1: Array, p1: Array) -> tuple[Array, Array]:
    """Field at (q0, p1)."""
    return q1 - q - h * p1, p1 - p - h * f(q)


def symplectic_euler_adjoint(f: Field, h: Any, q: Array, p: Array, q1: Array, p1: Array) -> tuple[Array, Array]:
    """Field at (q1, p0)."""
    return q1 - q - h * p, p1 - p - h * f(q1)


def midpoint(f: Field, h: Any, q: Array, p: Array, q1: Array, p1: Array) -> tuple[Array, Array]:
    """Field at the mean of both states."""
    return q1 - q - h * (p + p1) / 2, p1 - p - h * f((q + q1) / 2)


def stormer_verlet(f: Field, h: Any, q: Array, p: Array, q1: Array, p1: Array) -> tuple[Array, Array]:
    """Half a kick, a drift, half a kick."""
    half = p + h / 2 * f(q)
    return q1 - q - h * half, p1 - half - h / 2 * f(q1)


TEXTBOOK = {
    "explicit-euler": explicit_euler,
    "implicit-euler": implicit_euler,
    "symplectic-euler": symplectic_euler,
    "symplectic-euler-adjoint": symplectic_euler_adjoint,
    "midpoint": midpoint,
    "stormer-verlet": stormer_verlet,
    "trapezoidal": stormer_verlet,
    "rectangle": symplectic_euler,
}
"""By the name of the scheme, of either method."""

COUNT = 200
"""Steps that are evaluated again, from the start on."""


def textbook_errors(module: Any, case: Case, result: Result) -> float:
    """The largest residual of the textbook's equations over the first steps, in rounding errors of double precision.

    What rounding may do to a step is measured by its terms: states, h p, h f, and h times the change of f when places
    are rounded, as a sum of terms of the size of the largest place and of h p is.
    """
    if result.steps != len(result.t) - 1:
        raise ValueError("the textbook's equations need every step")
    problem = case.setup.file.stem
    values = {name: np.longdouble(v) for name, v in (DEFAULTS[problem] | dict(case.values)).items() if name in
              DEFAULTS[problem]}  # fmt: skip
    h = np.longdouble(module.make_grid(result.steps).h)
    q, p = (np.asarray(a[: COUNT + 1], dtype=np.longdouble) for a in (result.q, result.p))

    def field(places: Array) -> Array:
        return FORCES[problem](values, places)

    worst, eps = 0.0, np.finfo(float).eps
    for k in range(len(q) - 1):
        errors = TEXTBOOK[result.scheme](field, h, q[k], p[k], q[k + 1], p[k + 1])
        sizes = _sizes(field, h, (q[k], q[k + 1]), (p[k], p[k + 1]))
        for error, size in zip(errors, sizes, strict=True):
            worst = max(worst, float(np.abs(error).max() / (eps * size)))
    return worst


def _sizes(field: Field, h: Any, places: tuple[Array, Array], momenta: tuple[Array, Array]) -> tuple[Any, Any]:
    """Magnitudes of the terms of either equation, and of what rounded places do to the force."""
    tiny = np.finfo(float).tiny  # below it, numbers have fewer digits
    place, momentum = (max(np.abs(a).max() for a in (*pair, tiny)) for pair in (places, momenta))
    force = max(np.abs(field(q)).max() for q in places)
    moved = h * momentum
    offset = np.longdouble(1e-8) * (place + moved) * (-1.0) ** np.arange(len(places[0]))  # neighbours move apart
    slope = max(np.abs(field(q + offset) - field(q)).max() * 1e8 for q in places)
    kicked = h * (force + slope)
    return place + moved + h * kicked, momentum + kicked
