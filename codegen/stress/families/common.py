"""What all families share: setups of the package's own problems, promised errors, energies that oscillate."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, TypeAlias

from codegen import schemes
from codegen.schemes import Scheme, particles
from codegen.stress.cases import Setup
from codegen.stress.linear import swing
from codegen.stress.systems import LIMITS

PROBLEMS = Path(__file__).parents[1] / "problems"

SchemeOf: TypeAlias = tuple[str | None, str]
"""A method, None for particles, and a scheme."""

HIGHER_ORDER: tuple[SchemeOf, ...] = tuple(
    (method, name)
    for method in ("hamiltonian", "variational")
    for name, scheme in schemes.METHODS[method].items()
    if scheme.order > 2 and name in LIMITS
)
"""Schemes of higher order for mechanical systems; what is tried with them is a family of its own."""

EVERY_SCHEME: tuple[SchemeOf, ...] = (
    ("hamiltonian", "explicit-euler"),
    ("hamiltonian", "implicit-euler"),
    ("hamiltonian", "symplectic-euler"),
    ("hamiltonian", "symplectic-euler-adjoint"),
    ("hamiltonian", "midpoint"),
    ("hamiltonian", "stormer-verlet"),
    ("variational", "rectangle"),
    ("variational", "midpoint"),
    ("variational", "trapezoidal"),
)
"""What is tried on the oscillator, where it is cheap and everything is known; a new scheme takes one line here."""

STIFF_SCHEMES = EVERY_SCHEME[:3] + EVERY_SCHEME[4:6]
"""Those tried on the larger problems: one of each kind, since each costs seconds of compilation."""


def setup(problem: str, scheme: SchemeOf | None = None, **arguments: Any) -> Setup:
    """A problem of this package by method and scheme (default: the problem's own)."""
    method, name = scheme or (None, None)
    return Setup(PROBLEMS / f"{problem}.py", name, method, tuple(arguments.items()))


def registered(scheme: SchemeOf) -> Scheme:
    """What the registry says of a scheme."""
    method, name = scheme
    return schemes.find(name, method) if method else particles.find(name, "connect")


def promised(scheme: SchemeOf, h_omega: float, phase: float) -> float:
    """The error that a scheme of order p promises after a phase omega t, where h omega < 1/2; NaN where it is useless.

    Over the phase omega t the Eulers change amplitudes by exp(+-h omega omega t/2) or shift them by h omega/2, and the
    schemes of order 2 shift phases by (h omega)^2/12 omega t at most (Hairer, Lubich and Wanner 2006, IX.1): twice and
    three times these are allowed, for the nonlinear terms. Of schemes of higher order the constants are below 0.03 on
    the oscillator (`codegen.stress.linear`), and less than one is allowed.
    """
    order = registered(scheme).order
    error = h_omega**order * (1.0 + phase) / (4.0 if order == 2 else 1.0)
    return error if h_omega < 0.5 and error < 0.5 else math.nan


def oscillation(scheme: SchemeOf, h_omega: float) -> float:
    """By how much of itself a symplectic scheme lets the energy of an oscillator swing below its stable limit.

    Symplectic Euler keeps p^2 + w^2 q^2 - h w^2 q p, Störmer-Verlet p^2 + w^2 q^2 (1 - (h w)^2/4), and the midpoint
    rule the energy itself, as Gauss' methods do; what other schemes of higher order keep follows from their tables.
    """
    if scheme in HIGHER_ORDER and registered(scheme).symplectic:
        return 1e-6 + (1.1 * swing(scheme[1], h_omega) if h_omega < LIMITS[scheme[1]] else 0.1)
    half = h_omega / 2.0
    if scheme[1] == "midpoint":
        return 1e-6
    if half >= 1.0 or not registered(scheme).symplectic:
        return 0.1
    return 1.1 * (half**2 / (1.0 - half**2) if registered(scheme).order == 2 else 2.0 * half / (1.0 - half))
