"""What all families share: setups of the package's own problems, promised errors, energies that oscillate."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, TypeAlias

from codegen.discretise import particles, schemes
from codegen.discretise.schemes.base import Scheme
from codegen.evidence.stress.cases import Setup
from codegen.evidence.stress.systems import limit, swing

PROBLEMS = Path(__file__).parents[1] / "problems"

SchemeOf: TypeAlias = tuple[str | None, str]
"""A method, None for particles, and a scheme."""

MECHANICAL: tuple[SchemeOf, ...] = tuple(
    (method, name) for method in ("hamiltonian", "variational") for name in schemes.METHODS[method]
)
"""What is tried on the oscillator, where it is cheap and everything is known: all schemes for mechanical systems."""

EULER, IMPLICIT_EULER, SYMPLECTIC_EULER, MIDPOINT, VERLET = (
    ("hamiltonian", name)
    for name in ("explicit-euler", "implicit-euler", "symplectic-euler", "midpoint", "stormer-verlet")
)
STIFF_SCHEMES: tuple[SchemeOf, ...] = (EULER, IMPLICIT_EULER, SYMPLECTIC_EULER, MIDPOINT, VERLET)
"""Those tried on the larger problems: one of each kind, since each costs seconds of compilation."""


def setup(problem: str, scheme: SchemeOf | None = None, **arguments: Any) -> Setup:
    """A problem of this package by method and scheme (default: the problem's own)."""
    method, name = scheme or (None, None)
    return Setup(PROBLEMS / f"{problem}.py", name, method, tuple(arguments.items()))


def registered(scheme: SchemeOf) -> Scheme:
    """What the registry says of a scheme."""
    method, name = scheme
    return schemes.find(name, method) if method else particles.particle_scheme(name, "connect")


def of_order(low: int, high: float = math.inf) -> tuple[SchemeOf, ...]:
    """The schemes for mechanical systems with an order between two, both included."""
    return tuple(scheme for scheme in MECHANICAL if low <= registered(scheme).order <= high)


def promised(scheme: SchemeOf, h_omega: float, phase: float) -> float:
    """The error that a scheme of order p promises after a phase omega t, where h omega < 1/2; NaN where it is useless.

    Over the phase omega t the Eulers change amplitudes by exp(+-h omega omega t/2) or shift them by h omega/2, and the
    schemes of order 2 shift phases by (h omega)^2/12 omega t at most (Hairer, Lubich and Wanner 2006, IX.1): twice and
    three times these are allowed, for the nonlinear terms. Of schemes of higher order the constants are below 0.03 on
    the oscillator (`codegen.evidence.stress.systems`), and less than one is allowed.
    """
    order = registered(scheme).order
    error = h_omega**order * (1.0 + phase) / (4.0 if order == 2 else 1.0)
    return error if h_omega < 0.5 and error < 0.5 else math.nan


def oscillation(scheme: SchemeOf, h_omega: float) -> float:
    """By how much of itself a symplectic scheme lets the energy of an oscillator swing below its stable limit."""
    found = registered(scheme)
    return 1e-6 + 1.1 * swing(found, h_omega) if found.symplectic and h_omega < limit(found) else 0.1
