"""The mechanics of the stress problems once more, in numpy and by hand: what generated code is compared with.

Forces are written for arrays of any floating type, so that they serve scipy in double and the textbook's equations in
extended precision.

The equations of a step in their textbook form and extended precision, evaluated on the states that a module returns.

For H = |p|^2/2 + V(q) with f = -V_q. Nothing of the generated code takes part. Source of all forms: Hairer, Lubich and
Wanner (2006), Geometric numerical integration, I.1 and VI.3; variational schemes are taken on their Hamiltonian side,
Marsden and West (2001), section 2.6.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from codegen.solutions.result import Result
from codegen.stress.cases import Case

Array = Any
Force = Callable[[Mapping[str, Any], Array], Array]


def oscillator_force(values: Mapping[str, Any], q: Array) -> Array:
    """-omega^2 q."""
    return -(values["omega"] ** 2) * q


def spring_force(values: Mapping[str, Any], q: Array) -> Array:
    """Of a spring of natural length one, and gravity downwards."""
    length = np.sqrt(q[0] * q[0] + q[1] * q[1])
    pull = -values["k"] * (length - 1) / length
    return np.stack([pull * q[0], pull * q[1] - 1])


def fput_force(values: Mapping[str, Any], q: Array) -> Array:
    """Stiff springs inside three pairs, quartic ones between them and to the walls."""
    force = np.zeros_like(q)
    for i in (0, 2, 4):
        pull = values["omega"] ** 2 / 2 * (q[i + 1] - q[i])
        force[i], force[i + 1] = force[i] + pull, force[i + 1] - pull
    for i in (-1, 1, 3, 5):
        left = q[i] if i >= 0 else q[0] * 0
        right = q[i + 1] if i + 1 < len(q) else q[0] * 0
        pull = 4 * (right - left) ** 3
        if i >= 0:
            force[i] = force[i] + pull
        if i + 1 < len(q):
            force[i + 1] = force[i + 1] - pull
    return force


def rod_force(values: Mapping[str, Any], q: Array) -> Array:
    """Elastic rods from the origin to each mass in turn, and gravity downwards; q holds x1, y1, x2, ..."""
    places = np.concatenate([np.zeros_like(q[:2])[None], q.reshape(-1, 2)])
    along = places[1:] - places[:-1]
    length = np.sqrt((along**2).sum(axis=1))[:, None]
    pull = values["k"] * (length - 1) * along / length
    force = -pull
    force[:-1] += pull[1:]
    force[:, 1] -= 1
    return force.reshape(q.shape)


def kepler_force(values: Mapping[str, Any], q: Array) -> Array:
    """-mu q/|q|^3."""
    distance = np.sqrt(q[0] * q[0] + q[1] * q[1])
    return -values["mu"] * q / distance**3


FORCES: dict[str, Force] = {
    "oscillator": oscillator_force,
    "spring_pendulum": spring_force,
    "fput": fput_force,
    "rod_chain": rod_force,
    "kepler": kepler_force,
}
"""Forces of problems with unit masses, H = |p|^2/2 + V(q)."""

DEFAULTS: dict[str, dict[str, float]] = {
    "oscillator": {"omega": 1.0},
    "spring_pendulum": {"k": 1e4},
    "fput": {"omega": 50.0},
    "rod_chain": {"k": 1e4},
    "kepler": {"mu": 1.0},
    "pendulum_chain": {"heavy": 1.0, "light": 1.0, "g": 1.0},
}
"""Parameters as the problem files have them."""

_STIFF = 1e4
REST: dict[str, tuple[dict[str, float], tuple[float, ...]]] = {
    "oscillator": ({"omega": 1.0}, (0.0, 0.0)),
    "spring_pendulum": ({"k": _STIFF}, (0.0, -1.0 - 1.0 / _STIFF, 0.0, 0.0)),
    "fput": ({"omega": 50.0}, (0.0,) * 12),
}
"""Parameters and states (q, p) of rest, about which the stability of a scheme is measured."""


def frequency(problem: str, values: Mapping[str, Any]) -> float:
    """The largest frequency of small motions about rest."""
    return math.sqrt(values["k"]) if problem == "spring_pendulum" else float(values["omega"])


def chain_acceleration(values: Mapping[str, Any], angles: Array, rates: Array) -> Array:
    """Angular accelerations of a chain of pendulums of unit length: M(angles) q'' = -C(angles) q'^2 - gravity."""
    count = len(angles)
    masses = np.ones(count)
    masses[0], masses[-1] = values["heavy"], values["light"]
    below = np.cumsum(masses[::-1])[::-1]
    carried = below[np.maximum.outer(np.arange(count), np.arange(count))]
    difference = np.subtract.outer(angles, angles)
    right = -(carried * np.sin(difference)) @ rates**2 - below * values["g"] * np.sin(angles)
    return np.linalg.solve(carried * np.cos(difference), right)


def plate_gradient(q: Array, p: Array) -> tuple[Array, Array]:
    """H_q and H_p of H = 1/2 sum_ij p_i . p_j G(q_i, q_j) with the Green's function of the clamped plate, by hand.

    With a = 1 - |x|^2, b = 1 - |y|^2, s = |x - y|^2, w = a b/s: dG = b/2 w/(1 + w) da + (w/(1 + w) - log(1 + w))/2 ds.
    """
    margin = 1.0 - (q**2).sum(axis=1)
    by_place, by_momentum = np.zeros_like(q), np.zeros_like(q)
    for i in range(len(q)):
        by_momentum[i] += p[i] * margin[i] ** 2 / 2.0
        by_place[i] += -(p[i] @ p[i]) * margin[i] * q[i]
        for j in range(len(q)):
            if j == i:
                continue
            difference = q[i] - q[j]
            s = difference @ difference
            w = margin[i] * margin[j] / s
            green = margin[i] * margin[j] / 2.0 - s / 2.0 * np.log1p(w)
            by_momentum[i] += p[j] * green
            slope = margin[j] / 2.0 * w / (1.0 + w) * (-2.0 * q[i])
            slope = slope + (w / (1.0 + w) - np.log1p(w)) * difference
            by_place[i] += (p[i] @ p[j]) * slope
    return by_place, by_momentum


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
