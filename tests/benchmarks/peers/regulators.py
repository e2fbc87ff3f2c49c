"""Two horizons of controllers, with costs that are sums of squares, for programs that need the residuals."""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi
from typing import Any

from .gallery_problem import GalleryProblem, Vector
from .shooting_problems import SHOOTING


@dataclass(frozen=True)
class Regulator:
    """A problem from a measured state. Its costs are sums of squares: of residuals(q, u), and of final(q) at the end.

    `kick` are the standard deviations of a disturbance of each state, which acts every `every` samples.
    """

    problem: GalleryProblem
    residuals: Callable[[Vector, Vector], list[Any]]
    final: Callable[[Vector], list[Any]]
    steps: int
    kick: tuple[float, ...]
    every: int


def squared(values: list[Any]) -> Any:
    """The sum of squares."""
    return sum(value**2 for value in values)


def cart_pole() -> Regulator:
    """Balance a pole on a cart; the angle counts from the upright position."""
    hanging = SHOOTING["cart_pole"]().dynamics
    assert hanging

    def away(q: Vector) -> list[Any]:
        return [q[0], 10**0.5 * q[1], 0.1**0.5 * q[2], 0.1**0.5 * q[3]]

    def residuals(q: Vector, u: Vector) -> list[Any]:
        return [*away(q), 0.001**0.5 * u[0]]

    problem = GalleryProblem(
        controls=1,
        dynamics=lambda F, q, u, t, p: hanging(F, [q[0], q[1] + pi, q[2], q[3]], u, t, p),
        cost=lambda q, v, u, t: squared(residuals(q, u)),
        terminal_cost=lambda q, v, p: squared(away(q)),
        duration=lambda p: 2.0,
        start=(0.0, 0.2, 0.0, 0.0),
        end=(None,) * 4,
        bounds={0: (-2.0, 2.0)},
        control_bounds={0: (-20.0, 20.0)},
        guess=lambda F, s: ([0.0, 0.2, 0.0, 0.0], [0.0]),
    )
    return Regulator(problem, residuals, away, 40, (0.3, 0.2, 0.3, 1.0), 40)


def planar_quadrotor() -> Regulator:
    """Hold a planar quadrotor at the origin with rotors that only push."""
    dynamics = SHOOTING["planar_quadrotor"]().dynamics
    hover = 0.4 * 9.81 / 2

    def away(q: Vector) -> list[Any]:
        return [3 * q[0], 3 * q[1], *(0.3 * rate for rate in q[2:])]

    def residuals(q: Vector, u: Vector) -> list[Any]:
        return [*away(q), 0.1 * (u[0] - hover), 0.1 * (u[1] - hover)]

    problem = GalleryProblem(
        controls=2,
        dynamics=dynamics,
        cost=lambda q, v, u, t: squared(residuals(q, u)),
        terminal_cost=lambda q, v, p: squared(away(q)),
        duration=lambda p: 1.5,
        start=(0.5, 0.0, 0.0, 0.0, 0.0, 0.0),
        end=(None,) * 6,
        bounds={2: (-1.0, 1.0)},
        control_bounds={0: (0.0, 6.0), 1: (0.0, 6.0)},
        guess=lambda F, s: ([0.5, 0, 0, 0, 0, 0], [hover, hover]),
    )
    return Regulator(problem, residuals, away, 30, (0.5, 0.5, 0.2, 0.5, 0.5, 1.0), 30)


REGULATORS: dict[str, Callable[[], Regulator]] = {make.__name__: make for make in (cart_pole, planar_quadrotor)}
"""All problems of this file by their names."""
