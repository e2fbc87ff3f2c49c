"""The control problems of the comparison, free of any symbolic package and of this project's code.

The Lagrangian, the force and the cost are plain arithmetic, so that sympy, CasADi and numpy values may be put in.
They are written out here a second time, on purpose: a peer that read `problems/*.py` would repeat its mistakes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi, sqrt
from typing import Any

Vector = Sequence[Any]


@dataclass(frozen=True)
class ControlProblem:
    """Least cost with one control u, between two configurations with given velocities.

    `lagrangian(q, v)` and `cost(q, v, u)` give scalars, `force(q, v, u)` gives one component per coordinate.
    All quantities are nondimensional.
    """

    lagrangian: Callable[[Vector, Vector], Any]
    force: Callable[[Vector, Vector, Any], list[Any]]
    cost: Callable[[Vector, Vector, Any], Any]
    duration: float
    start: tuple[float, ...]
    end: tuple[float, ...]
    start_velocity: tuple[float, ...]
    end_velocity: tuple[float, ...]

    @property
    def dimension(self) -> int:
        """The number of coordinates."""
        return len(self.start)


def orbital_transfer(revolutions: float) -> ControlProblem:
    """Raise a satellite from radius 5 to radius 6 within the given number of revolutions."""
    mass, gravity, inner, outer = 100.0, 0.40038, 5.0, 6.0
    return ControlProblem(
        lagrangian=lambda q, v: mass / 2 * (v[0] ** 2 + q[0] ** 2 * v[1] ** 2) + gravity * mass / q[0],
        force=lambda q, v, u: [0, q[0] * u],
        cost=lambda q, v, u: u**2,
        duration=pi * revolutions * (sqrt(inner**3 / gravity) + sqrt(outer**3 / gravity)),
        start=(inner, 0.0),
        end=(outer, 2 * pi * revolutions),
        start_velocity=(0.0, sqrt(gravity / inner**3)),
        end_velocity=(0.0, sqrt(gravity / outer**3)),
    )


def linear_pendulum() -> ControlProblem:
    """Swing a linearised pendulum from rest at 3 pi/5 to rest at 2 pi/5."""
    return ControlProblem(
        lagrangian=lambda q, v: v[0] ** 2 / 2 - q[0] ** 2 / 2,
        force=lambda q, v, u: [u],
        cost=lambda q, v, u: u**2,
        duration=pi / 2,
        start=(3 * pi / 5,),
        end=(2 * pi / 5,),
        start_velocity=(0.0,),
        end_velocity=(0.0,),
    )


PROBLEMS: dict[str, ControlProblem] = {
    "linear_pendulum": linear_pendulum(),
    "orbital_transfer_1": orbital_transfer(1),
    "orbital_transfer_2": orbital_transfer(2),
}
