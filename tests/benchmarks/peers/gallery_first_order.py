"""First-order systems of the gallery (see `gallery_problem.py`)."""

from math import inf, pi
from typing import Any

from numpy import cos, sin  # which take CasADi's symbols as well: a cost is given no functions

from .gallery_problem import GalleryProblem, Vector, line


def brachistochrone() -> GalleryProblem:
    """From (0, 10) to (10, 5) under 9.80665."""
    return GalleryProblem(
        controls=1,
        dynamics=lambda F, q, u, t, p: [q[2] * F.sin(u[0]), -q[2] * F.cos(u[0]), 9.80665 * F.cos(u[0])],
        terminal_cost=lambda q, v, p: p[0],
        duration=lambda p: p[0],
        free=((2.0, 0.5, 10.0),),
        start=(0.0, 10.0, 0.0),
        end=(10.0, 5.0, None),
        control_bounds={0: (0.0, pi)},
        guess=lambda F, s: ([10 * s, 10 - 5 * s, 10 * s], [(1 + 16 * s) * pi / 18]),
    )


def van_der_pol() -> GalleryProblem:
    """PROPT's van der Pol oscillator."""
    return GalleryProblem(
        controls=1,
        dynamics=lambda F, q, u, t, p: [(1 - q[1] ** 2) * q[0] - q[1] + u[0], q[0]],
        cost=lambda q, v, u, t: q[0] ** 2 + q[1] ** 2 + u[0] ** 2,
        duration=lambda p: 5.0,
        start=(0.0, 1.0),
        end=(None, None),
        control_bounds={0: (-0.3, 1.0)},
        guess=line([0, 1], [0, 1], 0),
    )


def goddard_rocket() -> GalleryProblem:
    """COPS's Goddard rocket."""

    def dynamics(F: Any, q: Vector, u: Vector, t: Any, p: Vector) -> list[Any]:
        r, v, m = q[0], q[1], q[2]
        return [v, (u[0] - 310 * v**2 * F.exp(500 * (1 - r))) / m - 1 / r**2, -2 * u[0]]

    return GalleryProblem(
        controls=1,
        dynamics=dynamics,
        terminal_cost=lambda q, v, p: -q[0],
        duration=lambda p: p[0],
        free=((0.2, 0.0, inf),),
        start=(1.0, 0.0, 1.0),
        end=(None, None, 0.6),
        bounds={0: (1.0, inf), 1: (0.0, inf), 2: (0.6, 1.0)},
        control_bounds={0: (0.0, 3.5)},
        guess=lambda F, s: ([1, s * (1 - s), 1 - 0.4 * s], [1.75]),
    )


def crane() -> GalleryProblem:
    """PSOPT's container crane, in 9 s."""
    return GalleryProblem(
        controls=2,
        dynamics=lambda F, q, u, t, p: [
            *(q[3], q[4], q[5]),
            u[0] + 17.2656 * q[2],
            u[1],
            -(u[0] + 27.0756 * q[2] + 2 * q[4] * q[5]) / q[1],
        ],
        cost=lambda q, v, u, t: (q[2] ** 2 + q[5] ** 2) / 2,
        duration=lambda p: 9.0,
        start=(0.0, 22.0, 0.0, 0.0, -1.0, 0.0),
        end=(10.0, 14.0, 0.0, 2.5, 0.0, 0.0),
        bounds={3: (-2.5, 2.5), 4: (-1.0, 1.0)},
        control_bounds={0: (-2.83374, 2.83374), 1: (-0.80865, 0.71265)},
        guess=line([0, 22, 0, 0, -1, 0], [10, 14, 0, 2.5, 0, 0], 0, 0),
    )


def hypersensitive(duration: float) -> GalleryProblem:
    """dymos's linear hypersensitive problem."""
    return GalleryProblem(
        controls=1,
        dynamics=lambda F, q, u, t, p: [u[0] - q[0]],
        cost=lambda q, v, u, t: (q[0] ** 2 + u[0] ** 2) / 2,
        duration=lambda p: duration,
        start=(1.5,),
        end=(1.0,),
        guess=line([1.5], [1], 0),
    )


def betts_10_7(duration: float) -> GalleryProblem:
    """Betts's example 10.7."""
    return GalleryProblem(
        controls=1,
        dynamics=lambda F, q, u, t, p: [u[0] - q[0] ** 3],
        cost=lambda q, v, u, t: q[0] ** 2 + u[0] ** 2,
        duration=lambda p: duration,
        start=(1.0,),
        end=(1.5,),
        guess=line([0], [0], 0),
    )


def robot_arm() -> GalleryProblem:
    """COPS's robot arm."""

    def dynamics(F: Any, q: Vector, u: Vector, t: Any, p: Vector) -> list[Any]:
        inertia = ((5 - q[0]) ** 3 + q[0] ** 3) / 3
        return [q[3], q[4], q[5], u[0] / 5, u[1] / (inertia * F.sin(q[2]) ** 2), u[2] / inertia]

    first, last = (4.5, 0.0, pi / 4, 0.0, 0.0, 0.0), (4.5, 2 * pi / 3, pi / 4, 0.0, 0.0, 0.0)
    return GalleryProblem(
        controls=3,
        dynamics=dynamics,
        terminal_cost=lambda q, v, p: p[0],
        duration=lambda p: p[0],
        free=((10.0, 1.0, inf),),
        start=first,
        end=last,
        control_bounds=dict.fromkeys(range(3), (-1.0, 1.0)),
        guess=line(first, last, 0, 0, 0),
    )


def quadrotor_path() -> GalleryProblem:
    """A quadrotor with thrust and rates for inputs on a figure of eight, as a controller has it."""
    g, period = 9.81, 8.0

    def path(t: Any) -> tuple[list[Any], list[Any]]:
        w = 2 * pi / period
        place = [3 * sin(w * t), 1.5 * sin(2 * w * t), 1.5 + 0.3 * sin(w * t)]
        return place, [3 * w * cos(w * t), 3 * w * cos(2 * w * t), 0.3 * w * cos(w * t)]

    def track(q: Vector, t: Any) -> Any:
        place, velocity = path(t)
        away = sum((q[i] - place[i]) ** 2 + 0.1 * (q[3 + i] - velocity[i]) ** 2 for i in range(3))
        return away + 0.1 * q[8] ** 2

    def dynamics(F: Any, q: Vector, u: Vector, t: Any, p: Vector) -> list[Any]:
        (sr, cr), (sp, cp), (sy, cy) = ((F.sin(a), F.cos(a)) for a in (q[6], q[7], q[8]))
        turn = u[2] * sr + u[3] * cr
        return [
            *(q[3], q[4], q[5]),
            u[0] * (cy * sp * cr + sy * sr),
            u[0] * (sy * sp * cr - cy * sr),
            u[0] * cp * cr - g,
            u[1] + sp / cp * turn,
            u[2] * cr - u[3] * sr,
            turn / cp,
        ]

    return GalleryProblem(
        controls=4,
        dynamics=dynamics,
        cost=lambda q, v, u, t: track(q, t) + 0.001 * (u[0] - g) ** 2 + 0.01 * (u[1] ** 2 + u[2] ** 2 + u[3] ** 2),
        terminal_cost=lambda q, v, p: track(q, p[0] if p else 1.5),
        duration=lambda p: 1.5,
        start=(0.0, 0.0, 1.5, *[0.0] * 6),
        end=(None,) * 9,
        control_bounds={0: (2.0, 20.0), 1: (-3.0, 3.0), 2: (-3.0, 3.0), 3: (-3.0, 3.0)},
        guess=lambda F, s: ([*path(1.5 * s)[0], *[0] * 6], [g, 0, 0, 0]),
    )
