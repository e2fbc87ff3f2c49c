"""Six problems with smooth optima, as first-order systems, and five of them as mechanical systems as well.

No bound is active, the cost is quadratic in the controls and the dynamics are affine in them, so that `pontryagin.py`
finds each extremal to rounding. The states of a mechanical system are its coordinates, then their rates.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi
from typing import Any

from .gallery_mechanical import cart_pole, from_first_gallery, quadrotor
from .gallery_problem import GalleryProblem, Vector, line
from .shooting_problems import SHOOTING, squares

Dynamics = Callable[[Any, Vector, Vector, Any, Vector], list[Any]]


@dataclass(frozen=True)
class SmoothProblem:
    """The problem in first-order form, and in the form with a Lagrangian if it is mechanical."""

    first_order: GalleryProblem
    mechanical: GalleryProblem | None = None


def unbounded(problem: GalleryProblem) -> GalleryProblem:
    """The problem without its bounds, which are not active at the optimum."""
    return replace(problem, bounds={}, control_bounds={})


def both_forms(mechanical: GalleryProblem, dynamics: Dynamics) -> SmoothProblem:
    """A mechanical problem, and the same with its equations solved for the accelerations.

    Both guesses are a straight line; the rates are its slope.
    """
    states = [[*q, *v] for q, v in ((mechanical.start, mechanical.start_rate), (mechanical.end, mechanical.end_rate))]
    _, inputs = mechanical.guess(None, 0.0)
    length = mechanical.duration([])
    slope = [(b - a) / length for a, b in zip(mechanical.start, mechanical.end, strict=True)]
    first_order = GalleryProblem(
        controls=mechanical.controls,
        dynamics=dynamics,
        cost=mechanical.cost,
        duration=mechanical.duration,
        start=tuple(states[0]),
        end=tuple(states[1]),
        guess=line([*mechanical.start, *slope], [*mechanical.end, *slope], *inputs),
    )
    return SmoothProblem(first_order, unbounded(mechanical))


def van_der_pol() -> SmoothProblem:
    """Damp a van der Pol oscillator with an unbounded input; the end is free."""
    return SmoothProblem(
        GalleryProblem(
            controls=1,
            dynamics=lambda F, q, u, t, p: [(1 - q[1] ** 2) * q[0] - q[1] + u[0], q[0]],
            cost=lambda q, v, u, t: q[0] ** 2 + q[1] ** 2 + u[0] ** 2,
            duration=lambda p: 5.0,
            start=(0.0, 1.0),
            end=(None, None),
            guess=line([0, 1], [0, 0], 0),
        )
    )


def linear_pendulum() -> SmoothProblem:
    """A linear-quadratic problem, whose optimum is known in closed form."""
    return both_forms(from_first_gallery("linear_pendulum"), lambda F, q, u, t, p: [q[1], u[0] - q[0]])


def orbital_transfer() -> SmoothProblem:
    """Raise a satellite to another circular orbit in one revolution."""

    def dynamics(F: Any, q: Vector, u: Vector, t: Any, p: Vector) -> list[Any]:
        return [q[2], q[3], q[0] * q[3] ** 2 - 0.40038 / q[0] ** 2, u[0] / (100 * q[0]) - 2 * q[2] * q[3] / q[0]]

    return both_forms(from_first_gallery("orbital_transfer_1"), dynamics)


def cart_pole_swing_up() -> SmoothProblem:
    """Swing the pole of a cart up (Kelly 2017)."""
    dynamics = SHOOTING["cart_pole"]().dynamics
    assert dynamics
    return both_forms(cart_pole(), dynamics)


def planar_quadrotor() -> SmoothProblem:
    """Fly a planar quadrotor by one metre in one second."""
    dynamics = SHOOTING["planar_quadrotor"]().dynamics
    assert dynamics
    return both_forms(quadrotor(), dynamics)


def two_link_arm() -> SmoothProblem:
    """Turn a horizontal arm of two equal links from rest to rest with the least effort."""

    def lagrangian(F: Any, q: Vector, v: Vector, t: Any) -> Any:
        bend = F.cos(q[1])
        return (5 / 3 + bend) / 2 * v[0] ** 2 + (1 / 3 + bend / 2) * v[0] * v[1] + v[1] ** 2 / 6

    mechanical = GalleryProblem(
        controls=2,
        lagrangian=lagrangian,
        force=lambda F, q, v, u, t: [u[0], u[1]],
        cost=squares(1.0, 1.0),
        duration=lambda p: 2.0,
        start=(0.0, 0.5),
        start_rate=(0.0, 0.0),
        end=(pi / 2, 1.0),
        end_rate=(0.0, 0.0),
        guess=line([0, 0.5], [pi / 2, 1.0], 0, 0),
    )
    dynamics = SHOOTING["two_link_arm"]().dynamics
    assert dynamics
    return both_forms(mechanical, dynamics)


SMOOTH: dict[str, Callable[[], SmoothProblem]] = {
    problem.__name__: problem
    for problem in (
        *(van_der_pol, linear_pendulum, orbital_transfer),
        *(cart_pole_swing_up, planar_quadrotor, two_link_arm),
    )
}
"""All problems of this file by their names."""
