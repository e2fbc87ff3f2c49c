"""The form in which the gallery's problems are written a second time.

A peer that read `problems/*.py` would repeat its mistakes. The descriptions are free of any symbolic package and of
this project's code: their functions are plain arithmetic, with `F` for the few functions they need, so that numpy
(`F = numpy`) and CasADi (`F = casadi`) values may be put in.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

Vector = Sequence[Any]
Numbers = tuple[float | None, ...]


def nothing(*_: Any) -> list[Any]:
    """No conditions."""
    return []


@dataclass(frozen=True)
class GalleryProblem:
    """An optimal-control problem in the variables q (coordinates or states), their rates v, controls u, time t.

    `p` are static parameters that are optimised along. Exactly one of `lagrangian(F, q, v, t)` and `dynamics(F, q, u,
    t, p)` is given; `force(F, q, v, u, t)` belongs to a Lagrangian. The cost is the integral of `cost(q, v, u, t)` plus
    `terminal_cost(q, v, p)`. `start`, `end`, `start_rate`, `end_rate` are numbers, or None where the end is free.
    Conditions are lists of (expression, lower, upper); `path(q, v, u, t)` is a list of expressions that must not be
    positive, `nodal_path(q)` one for every node but the first, `constraint(q)` one of expressions that vanish.
    `guess(F, s)` gives (q, u) at t = s T. With `bodies` > 1 all of this is about one body, `start` and `guess` depend
    on its number, and `couplings(F, ends)` ties their end coordinates together.
    """

    controls: int
    start: Numbers | Callable[[int], Numbers]
    end: Numbers
    guess: Callable[..., tuple[list[Any], list[Any]]]
    lagrangian: Callable[..., Any] | None = None
    force: Callable[..., list[Any]] = nothing
    dynamics: Callable[..., list[Any]] | None = None
    cost: Callable[..., Any] = lambda q, v, u, t: 0
    terminal_cost: Callable[..., Any] = lambda q, v, p: 0
    duration: Callable[[Vector], Any] = lambda p: 1.0
    start_rate: Numbers = ()
    end_rate: Numbers = ()
    start_conditions: Callable[..., list[tuple[Any, float, float]]] = nothing
    end_conditions: Callable[..., list[tuple[Any, float, float]]] = nothing
    bounds: dict[int, tuple[float, float]] = field(default_factory=dict)
    control_bounds: dict[int, tuple[float, float]] = field(default_factory=dict)
    path: Callable[..., list[Any]] = nothing
    nodal_path: Callable[..., list[Any]] = nothing
    constraint: Callable[..., list[Any]] = nothing
    free: tuple[tuple[float, float, float], ...] = ()  # guess, lower and upper bound of each static parameter
    bodies: int = 1
    couplings: Callable[..., list[Any]] = nothing
    trapezoidal: bool = False  # the quadrature of a Lagrangian; else the midpoint rule

    @property
    def dimension(self) -> int:
        """The number of coordinates or states."""
        return len(self.end)


def line(first: Sequence[float], last: Sequence[float], *controls: float) -> Callable[..., tuple[list[Any], list[Any]]]:
    """The guess that goes straight from one end to the other, with constant controls."""
    return lambda F, s, *body: ([a + (b - a) * s for a, b in zip(first, last, strict=True)], list(controls))
