"""What an author writes: a Lagrangian or a Hamiltonian, forces, a cost, boundary conditions, and what to do with them.

A problem file returns one of the classes below. They hold the author's expressions as written; `model.py` checks them
and brings them into the one form that the rest of the pipeline reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar

Expression = Any
"""A sympy expression or a number."""


@dataclass(frozen=True)
class Problem:
    """A mechanical system: either a Lagrangian L(q, dq, t) or a Hamiltonian H(q, p, t), and forces.

    `force` maps a coordinate to the generalised force on it (the covector component of f in the
    Lagrange-d'Alembert principle). `duration` is the length of the time interval [0, T]; `steps` is the default
    number N of intervals. `start` maps coordinates and velocities (or momenta) to their values at t = 0.
    """

    task: ClassVar[str] = ""

    _: KW_ONLY
    lagrangian: Expression = None
    hamiltonian: Expression = None
    force: Mapping[Any, Expression] = field(default_factory=dict)
    duration: Expression
    start: Mapping[Any, Expression]
    steps: int = 100


@dataclass(frozen=True)
class Simulate(Problem):
    """Follow the motion from a complete initial state (all coordinates, and all velocities or all momenta)."""

    task: ClassVar[str] = "simulate"


@dataclass(frozen=True)
class Control(Problem):
    """Move the system from `start` to `end` such that the integral of `cost` over [0, T] is least.

    What `start` or `end` leaves out is free. `guess` maps coordinates and controls to expressions of the parameters
    and of time, from which the solver starts; without it coordinates are interpolated linearly between their end
    values and controls are zero.
    """

    task: ClassVar[str] = "control"

    _: KW_ONLY
    cost: Expression
    end: Mapping[Any, Expression]
    guess: Mapping[Any, Expression] = field(default_factory=dict)
