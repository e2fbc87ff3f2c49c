"""Mechanical systems of the gallery in minimal coordinates (see `gallery_problem.py`)."""

from math import inf, pi
from typing import Any

from .gallery_problem import GalleryProblem, Vector, line
from .problems import PROBLEMS


def double_integrator() -> GalleryProblem:
    """Least time for a distance of 1 with a force of at most 1: T = 2."""
    return GalleryProblem(
        controls=1,
        lagrangian=lambda F, q, v, t: v[0] ** 2 / 2,
        force=lambda F, q, v, u, t: [u[0]],
        terminal_cost=lambda q, v, p: p[0],
        duration=lambda p: p[0],
        free=((1.0, 0.0, inf),),
        start=(0.0,),
        start_rate=(0.0,),
        end=(1.0,),
        end_rate=(0.0,),
        control_bounds={0: (-1.0, 1.0)},
        guess=line([0], [1], 0),
    )


def double_integrator_effort() -> GalleryProblem:
    """Least effort for a distance of 1 in one unit of time: J = 12."""
    return GalleryProblem(
        controls=1,
        lagrangian=lambda F, q, v, t: v[0] ** 2 / 2,
        force=lambda F, q, v, u, t: [u[0]],
        cost=lambda q, v, u, t: u[0] ** 2,
        start=(0.0,),
        start_rate=(0.0,),
        end=(1.0,),
        end_rate=(0.0,),
        guess=line([0], [1], 0),
    )


def bryson_denham() -> GalleryProblem:
    """The double integrator before a wall at 1/9: J = 4."""
    return GalleryProblem(
        controls=1,
        lagrangian=lambda F, q, v, t: v[0] ** 2 / 2,
        force=lambda F, q, v, u, t: [u[0]],
        cost=lambda q, v, u, t: u[0] ** 2 / 2,
        start=(0.0,),
        start_rate=(1.0,),
        end=(0.0,),
        end_rate=(-1.0,),
        bounds={0: (-inf, 1 / 9)},
        guess=line([0], [0], 0),
    )


def cart_pole() -> GalleryProblem:
    """Kelly's cart-pole swing-up."""
    m1, m2, rod, g = 1.0, 0.3, 0.5, 9.81
    return GalleryProblem(
        controls=1,
        lagrangian=lambda F, q, v, t: (
            (m1 + m2) / 2 * v[0] ** 2
            + m2 * rod * F.cos(q[1]) * v[0] * v[1]
            + m2 * rod**2 / 2 * v[1] ** 2
            + m2 * g * rod * F.cos(q[1])
        ),
        force=lambda F, q, v, u, t: [u[0], 0],
        cost=lambda q, v, u, t: u[0] ** 2,
        duration=lambda p: 2.0,
        start=(0.0, 0.0),
        start_rate=(0.0, 0.0),
        end=(1.0, pi),
        end_rate=(0.0, 0.0),
        bounds={0: (-2.0, 2.0)},
        control_bounds={0: (-20.0, 20.0)},
        guess=line([0, 0], [1, pi], 0),
    )


def cart_pole_balance() -> GalleryProblem:
    """The cart-pole near its upright position, as a controller has it."""
    m1, m2, rod, g = 1.0, 0.3, 0.5, 9.81

    def away(q: Vector, v: Vector) -> Any:
        return q[0] ** 2 + 10 * q[1] ** 2 + 0.1 * v[0] ** 2 + 0.1 * v[1] ** 2

    return GalleryProblem(
        controls=1,
        lagrangian=lambda F, q, v, t: (
            (m1 + m2) / 2 * v[0] ** 2
            + m2 * rod * F.cos(q[1]) * v[0] * v[1]
            + m2 * rod**2 / 2 * v[1] ** 2
            - m2 * g * rod * F.cos(q[1])
        ),
        force=lambda F, q, v, u, t: [u[0], 0],
        cost=lambda q, v, u, t: away(q, v) + 0.001 * u[0] ** 2,
        terminal_cost=lambda q, v, p: away(q, v),
        duration=lambda p: 2.0,
        start=(0.0, 0.2),
        start_rate=(0.0, 0.0),
        end=(None, None),
        end_rate=(None, None),
        bounds={0: (-2.0, 2.0)},
        control_bounds={0: (-20.0, 20.0)},
        guess=line([0, 0.2], [0, 0.2], 0),
    )


def pendulum_swing_up() -> GalleryProblem:
    """opty's pendulum with at most 2 N m, in 10 s."""
    return GalleryProblem(
        controls=1,
        lagrangian=lambda F, q, v, t: v[0] ** 2 / 2 + 9.81 * F.cos(q[0]),
        force=lambda F, q, v, u, t: [u[0]],
        cost=lambda q, v, u, t: u[0] ** 2,
        duration=lambda p: 10.0,
        start=(0.0,),
        start_rate=(0.0,),
        end=(pi,),
        end_rate=(0.0,),
        control_bounds={0: (-2.0, 2.0)},
        guess=lambda F, s: ([pi * s**2 * F.sin(4.5 * pi * s)], [0]),
    )


def acrobot() -> GalleryProblem:
    """OptimTraj's acrobot, in absolute angles."""
    g, rod = 9.81, 0.5
    return GalleryProblem(
        controls=1,
        lagrangian=lambda F, q, v, t: (
            rod**2 * (v[0] ** 2 + v[1] ** 2 / 2 + F.cos(q[0] - q[1]) * v[0] * v[1])
            + g * rod * (2 * F.cos(q[0]) + F.cos(q[1]))
        ),
        force=lambda F, q, v, u, t: [-u[0], u[0]],
        cost=lambda q, v, u, t: u[0] ** 2,
        duration=lambda p: 2.0,
        start=(0.0, 0.0),
        start_rate=(0.0, 0.0),
        end=(pi, pi),
        end_rate=(0.0, 0.0),
        control_bounds={0: (-20.0, 20.0)},
        guess=lambda F, s: ([pi * s**2, pi * s - 2 * F.sin(2 * pi * s)], [0]),
    )


def quadrotor() -> GalleryProblem:
    """A planar quadrotor of two rotors, 1 m sideways in 1 s."""
    m, d, g = 0.2, 0.3, 9.81
    limit = 5 * m * g
    return GalleryProblem(
        controls=2,
        lagrangian=lambda F, q, v, t: m * (v[0] ** 2 + v[1] ** 2) + m * d**2 * v[2] ** 2 - 2 * m * g * q[1],
        force=lambda F, q, v, u, t: [
            -(u[0] + u[1]) * F.sin(q[2]),
            (u[0] + u[1]) * F.cos(q[2]),
            d * (u[1] - u[0]),
        ],
        cost=lambda q, v, u, t: u[0] ** 2 + u[1] ** 2,
        start=(1.0, 0.0, 0.0),
        start_rate=(0.0, 0.0, 0.0),
        end=(0.0, 0.0, 0.0),
        end_rate=(0.0, 0.0, 0.0),
        control_bounds={0: (-limit, limit), 1: (-limit, limit)},
        guess=line([1, 0, 0], [0, 0, 0], m * g, m * g),
    )


def two_link_arm() -> GalleryProblem:
    """Luus's arm, in absolute angles."""
    return GalleryProblem(
        controls=2,
        lagrangian=lambda F, q, v, t: 7 / 6 * v[0] ** 2 + 2 / 3 * v[1] ** 2 + 1.5 * F.cos(q[1] - q[0]) * v[0] * v[1],
        force=lambda F, q, v, u, t: [u[0] - u[1], u[1]],
        terminal_cost=lambda q, v, p: p[0],
        duration=lambda p: p[0],
        free=((3.0, 1.0, 10.0),),
        start=(0.0, 0.5),
        start_rate=(0.0, 0.0),
        end=(0.522, 1.022),
        end_rate=(0.0, 0.0),
        control_bounds={0: (-1.0, 1.0), 1: (-1.0, 1.0)},
        guess=line([0, 0.5], [0.522, 1.022], 0, 0),
    )


def low_thrust() -> GalleryProblem:
    """Bryson and Ho's largest orbit in 193 days."""

    def force(F: Any, q: Vector, v: Vector, u: Vector, t: Any) -> list[Any]:
        acceleration = 0.1405 / (1 - 0.0749 * t)
        return [acceleration * u[0], acceleration * u[1] * q[0]]

    return GalleryProblem(
        controls=2,
        lagrangian=lambda F, q, v, t: (v[0] ** 2 + q[0] ** 2 * v[1] ** 2) / 2 + 1 / q[0],
        force=force,
        terminal_cost=lambda q, v, p: -q[0],
        duration=lambda p: 3.32,
        start=(1.0, 0.0),
        start_rate=(0.0, 1.0),
        end=(None, None),
        end_rate=(0.0, None),
        end_conditions=lambda F, q, v: [(q[0] ** 3 * v[1] ** 2, 1.0, 1.0)],
        path=lambda q, v, u, t: [u[0] ** 2 + u[1] ** 2 - 1],
        guess=lambda F, s: (
            [1 + s**2 * (3 - 2 * s) / 2, 3.32 * (s - s**2 / 4)],
            [F.sin(2 * pi * s), F.cos(2 * pi * s)],
        ),
    )


def from_first_gallery(name: str) -> GalleryProblem:
    """One of the problems of `peers/problems.py`."""
    old = PROBLEMS[name]
    return GalleryProblem(
        controls=1,
        lagrangian=lambda F, q, v, t: old.lagrangian(q, v),
        force=lambda F, q, v, u, t: old.force(q, v, u[0]),
        cost=lambda q, v, u, t: old.cost(q, v, u[0]),
        duration=lambda p: old.duration,
        start=old.start,
        start_rate=old.start_velocity,
        end=old.end,
        end_rate=old.end_velocity,
        guess=line(old.start, old.end, 0),
    )
