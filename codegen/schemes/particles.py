"""Schemes for many particles: one-step compositions, an explicit Runge-Kutta method, adaptive references."""

from __future__ import annotations

import difflib
from dataclasses import dataclass

from sympy import Rational

from codegen.errors import SchemeError
from codegen.schemes.base import OneStep, Scheme
from codegen.schemes.one_step import ONE_STEPS


@dataclass(frozen=True)
class ExplicitRungeKutta(Scheme):
    """k_i = F(z0 + h sum_{j<i} a_ij k_j), z1 = z0 + h sum_i b_i k_i; `rows` holds the a_ij, `weights` the b_i."""

    rows: tuple[tuple[Rational, ...], ...]
    weights: tuple[Rational, ...]


@dataclass(frozen=True)
class Adaptive(Scheme):
    """A code of scipy that chooses its steps by a tolerance; `code` is its name there."""

    code: str


_HALF, _ZERO, _ONE = Rational(1, 2), Rational(0), Rational(1)

RK4 = ExplicitRungeKutta(
    name="rk4",
    order=4,
    symmetric=False,
    symplectic=False,
    source="Kutta (1901); Hairer, Norsett and Wanner (1993), Solving ordinary differential equations I, table II.1.2",
    summary="the classical Runge-Kutta method",
    rows=((), (_HALF,), (_ZERO, _HALF), (_ZERO, _ZERO, _ONE)),
    weights=(Rational(1, 6), Rational(1, 3), Rational(1, 3), Rational(1, 6)),
)

_ADAPTIVE = (
    Adaptive(
        name="dop853",
        order=8,
        symmetric=False,
        symplectic=False,
        source="Hairer, Norsett and Wanner (1993), II.5 (scipy.integrate.DOP853)",
        summary="explicit Runge-Kutta method of order 8 with step-size control",
        code="DOP853",
    ),
    Adaptive(
        name="lsoda",
        order=12,
        symmetric=False,
        symplectic=False,
        source="Petzold (1983), SIAM Journal on Scientific and Statistical Computing 4 (scipy.integrate.LSODA)",
        summary="multistep methods of Adams and backward differentiation formulas, order and step by error control",
        code="LSODA",
    ),
)

PARTICLE_SCHEMES: dict[str, Scheme] = {scheme.name: scheme for scheme in (*ONE_STEPS, RK4, *_ADAPTIVE)}
"""Every scheme for pairwise systems by name; tests run over this table."""


def find(name: str, task: str) -> OneStep | ExplicitRungeKutta | Adaptive:
    """The scheme of that name; SchemeError tells which there are for the task."""
    offered = [n for n, s in PARTICLE_SCHEMES.items() if task == "connect" or not isinstance(s, Adaptive)]
    if name not in offered:
        close = difflib.get_close_matches(name, offered, 1)
        hint = f"did you mean {close[0]}?" if close else f"use one of {', '.join(offered)}"
        raise SchemeError(f"there is no scheme {name!r} for particles and task {task}", hint)
    found = PARTICLE_SCHEMES[name]
    assert isinstance(found, (OneStep, ExplicitRungeKutta, Adaptive))
    return found
