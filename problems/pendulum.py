"""Let a simple pendulum swing.

Unit mass, length and gravity: H = p^2/2 - cos q, or L = dq^2/2 + cos q. Source: Hairer, Lubich and Wanner (2006),
Geometric numerical integration, section I.1. All quantities are nondimensional.
"""

from typing import Literal

from sympy import Expr, cos, sin

from codegen import Simulate, canonical_pair, coordinate
from codegen.drawing import Item, Mass, Rod, Trail


def drawing(q: Expr) -> list[Item]:
    """The pendulum as a bob on a rod."""
    bob = sin(q), -cos(q)
    return [Trail(bob), Rod((0, 0), bob), Mass(bob, 0.08)]


def problem(form: Literal["hamiltonian", "lagrangian"] = "hamiltonian") -> Simulate:
    if form == "hamiltonian":
        q, p = canonical_pair("q", "p")
        return Simulate(hamiltonian=p**2 / 2 - cos(q), duration=60, start={q: 0, p: 1.4}, steps=200, drawing=drawing(q))
    q, dq = coordinate("q")
    return Simulate(lagrangian=dq**2 / 2 + cos(q), duration=60, start={q: 0, dq: 1.4}, steps=200, drawing=drawing(q))
