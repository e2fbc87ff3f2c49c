"""Well-known first-order problems with 2 to 12 states, in the form of `gallery_problem.py`.

Their functions take sympy, numpy or CasADi for `F`, so that one statement is both our problem and the peer's.
"""

from collections.abc import Callable
from itertools import pairwise
from math import inf, pi
from typing import Any

from .gallery_problem import GalleryProblem, Vector, line


def squares(*factors: float) -> Callable[..., Any]:
    """The cost that is the sum of all squared controls, each times its factor."""
    return lambda q, v, u, t: sum(f * a**2 for f, a in zip(factors, u, strict=True))


def double_integrator() -> GalleryProblem:
    """Move a mass by one in one second with the least effort, with a limit of its speed."""
    return GalleryProblem(
        controls=1,
        dynamics=lambda F, q, u, t, p: [q[1], u[0]],
        cost=squares(1.0),
        duration=lambda p: 1.0,
        start=(0.0, 0.0),
        end=(1.0, 0.0),
        bounds={1: (-1.3, 1.3)},
        control_bounds={0: (-10.0, 10.0)},
        guess=line([0, 0], [1, 0], 0),
    )


def pendulum() -> GalleryProblem:
    """Swing a pendulum up with a torque that cannot hold it at the side."""
    return GalleryProblem(
        controls=1,
        dynamics=lambda F, q, u, t, p: [q[1], -9.81 * F.sin(q[0]) - 0.1 * q[1] + u[0]],
        cost=squares(1.0),
        duration=lambda p: 4.0,
        start=(0.0, 0.0),
        end=(pi, 0.0),
        control_bounds={0: (-5.0, 5.0)},
        guess=line([0, 0], [pi, 0], 0),
    )


def rayleigh() -> GalleryProblem:
    """Rayleigh's equation of an electric oscillator (Maurer and Augustin 2001), with the end at rest."""
    return GalleryProblem(
        controls=1,
        dynamics=lambda F, q, u, t, p: [q[1], -q[0] + q[1] * (1.4 - 0.14 * q[1] ** 2) + 4 * u[0]],
        cost=lambda q, v, u, t: u[0] ** 2 + q[0] ** 2,
        duration=lambda p: 4.5,
        start=(-5.0, -5.0),
        end=(0.0, 0.0),
        control_bounds={0: (-1.0, 1.0)},
        guess=line([-5, -5], [0, 0], 0),
    )


def fishing() -> GalleryProblem:
    """Lotka-Volterra fishing (Sager 2005), relaxed: the control is bang-bang and singular."""
    return GalleryProblem(
        controls=1,
        dynamics=lambda F, q, u, t, p: [
            q[0] - q[0] * q[1] - 0.4 * q[0] * u[0],
            -q[1] + q[0] * q[1] - 0.2 * q[1] * u[0],
        ],
        cost=lambda q, v, u, t: (q[0] - 1) ** 2 + (q[1] - 1) ** 2,
        duration=lambda p: 12.0,
        start=(0.5, 0.7),
        end=(None, None),
        control_bounds={0: (0.0, 1.0)},
        guess=line([0.5, 0.7], [1, 1], 0.5),
    )


def stirred_tank() -> GalleryProblem:
    """Continuous stirred tank of Hicks and Ray (1971): from one steady state to another, by the cooling."""

    def dynamics(F: Any, q: Vector, u: Vector, t: Any, p: Vector) -> list[Any]:
        reaction = 300 * q[0] * F.exp(-5 / q[1])
        cooling = 1.95e-4 * u[0] * (q[1] - 0.3816)
        return [(1 - q[0]) / 20 - reaction, (0.3947 - q[1]) / 20 + reaction - cooling]

    return GalleryProblem(
        controls=1,
        dynamics=dynamics,
        cost=lambda q, v, u, t: 1e6 * (q[0] - 0.0944) ** 2 + 2e3 * (q[1] - 0.7766) ** 2 + 1e-3 * (u[0] - 340) ** 2,
        duration=lambda p: 10.0,
        start=(0.1367, 0.7293),
        end=(None, None),
        bounds={0: (0.0, 1.0), 1: (0.5, 1.0)},
        control_bounds={0: (0.0, 500.0)},
        guess=line([0.1367, 0.7293], [0.0944, 0.7766], 340),
    )


def zermelo() -> GalleryProblem:
    """Zermelo's boat: the shortest time across a current that grows with the distance from the shore."""
    return GalleryProblem(
        controls=1,
        dynamics=lambda F, q, u, t, p: [F.cos(u[0]) - 0.5 * q[1], F.sin(u[0])],
        terminal_cost=lambda q, v, p: p[0],
        duration=lambda p: p[0],
        free=((5.0, 0.5, 20.0),),
        start=(3.66, -1.86),
        end=(0.0, 0.0),
        guess=line([3.66, -1.86], [0, 0], 2.5),
    )


def dubins() -> GalleryProblem:
    """Dubins's car (1957) with a turning circle of one, to a place four to its left, in the opposite direction."""
    return GalleryProblem(
        controls=1,
        dynamics=lambda F, q, u, t, p: [F.cos(q[2]), F.sin(q[2]), u[0]],
        terminal_cost=lambda q, v, p: p[0],
        duration=lambda p: p[0],
        free=((6.0, 0.5, 20.0),),
        start=(0.0, 0.0, 0.0),
        end=(1.0, 4.0, pi),
        control_bounds={0: (-1.0, 1.0)},
        guess=line([0, 0, 0], [1, 4, pi], 0.5),
    )


def moon_lander() -> GalleryProblem:
    """Land softly with the least fuel, in a time that is free; the thrust is zero, then full."""
    return GalleryProblem(
        controls=1,
        dynamics=lambda F, q, u, t, p: [q[1], u[0] / q[2] - 1, -u[0] / 2.349],
        terminal_cost=lambda q, v, p: -q[2],
        duration=lambda p: p[0],
        free=((1.5, 0.1, 10.0),),
        start=(1.0, -0.783, 1.0),
        end=(0.0, 0.0, None),
        bounds={0: (0.0, inf), 2: (0.1, 1.0)},
        control_bounds={0: (0.0, 1.227)},
        guess=line([1, -0.783, 1], [0, 0, 0.5], 0.6),
    )


def earth_to_mars() -> GalleryProblem:
    """From the circular orbit of the earth to that of Mars in the least time (Moyer and Pinkham 1964)."""

    def dynamics(F: Any, q: Vector, u: Vector, t: Any, p: Vector) -> list[Any]:
        acceleration = 0.1405 / (1 - 0.07487 * t)
        radial, tangential = acceleration * F.sin(u[0]), acceleration * F.cos(u[0])
        return [q[1], q[2] ** 2 / q[0] - 1 / q[0] ** 2 + radial, -q[1] * q[2] / q[0] + tangential]

    return GalleryProblem(
        controls=1,
        dynamics=dynamics,
        terminal_cost=lambda q, v, p: p[0],
        duration=lambda p: p[0],
        free=((3.5, 1.0, 8.0),),
        start=(1.0, 0.0, 1.0),
        end=(1.525, 0.0, 1.525**-0.5),
        bounds={0: (0.5, 3.0)},
        guess=lambda F, s: ([1 + 0.525 * s, 0, 1 + (1.525**-0.5 - 1) * s], [0.5 + 5 * s]),
    )


def cart_pole() -> GalleryProblem:
    """Swing a pole on a cart up (Kelly 2017), with its equations solved for the accelerations."""

    def dynamics(F: Any, q: Vector, u: Vector, t: Any, p: Vector) -> list[Any]:
        cart, pole, length, g = 1.0, 0.3, 0.5, 9.81
        s, c, spin = F.sin(q[1]), F.cos(q[1]), q[3] ** 2
        mass = cart + pole * (1 - c**2)
        return [
            q[2],
            q[3],
            (length * pole * s * spin + u[0] + pole * g * c * s) / mass,
            -(length * pole * c * s * spin + u[0] * c + (cart + pole) * g * s) / (length * mass),
        ]

    return GalleryProblem(
        controls=1,
        dynamics=dynamics,
        cost=squares(1.0),
        duration=lambda p: 2.0,
        start=(0.0, 0.0, 0.0, 0.0),
        end=(1.0, pi, 0.0, 0.0),
        bounds={0: (-2.0, 2.0)},
        control_bounds={0: (-20.0, 20.0)},
        guess=line([0, 0, 0, 0], [1, pi, 0, 0], 0),
    )


def two_link_arm() -> GalleryProblem:
    """Turn a horizontal arm of two equal links with two torques, its mass matrix inverted."""

    def dynamics(F: Any, q: Vector, u: Vector, t: Any, p: Vector) -> list[Any]:
        first, second, coupling = 5 / 3, 1 / 3, F.cos(q[1]) / 2
        a, b, d = first + 2 * coupling, second + coupling, second
        bend = F.sin(q[1]) / 2
        left = u[0] + bend * (2 * q[2] + q[3]) * q[3]
        right = u[1] - bend * q[2] ** 2
        determinant = a * d - b**2
        return [q[2], q[3], (d * left - b * right) / determinant, (a * right - b * left) / determinant]

    return GalleryProblem(
        controls=2,
        dynamics=dynamics,
        cost=squares(1.0, 1.0),
        duration=lambda p: 2.0,
        start=(0.0, 0.5, 0.0, 0.0),
        end=(1.5, 1.0, 0.0, 0.0),
        bounds={2: (-1.0, 1.0)},
        control_bounds={0: (-5.0, 5.0), 1: (-5.0, 5.0)},
        guess=line([0, 0.5, 0, 0], [1.5, 1, 0, 0], 0, 0),
    )


def bicycle() -> GalleryProblem:
    """Change the lane with the kinematic model of a car, by acceleration and rate of the steering angle."""
    return GalleryProblem(
        controls=2,
        dynamics=lambda F, q, u, t, p: [
            q[3] * F.cos(q[2]),
            q[3] * F.sin(q[2]),
            q[3] * F.tan(q[4]) / 2.7,
            u[0],
            u[1],
        ],
        cost=squares(1.0, 10.0),
        duration=lambda p: 3.0,
        start=(0.0, 0.0, 0.0, 10.0, 0.0),
        end=(30.0, 3.5, 0.0, 10.0, 0.0),
        bounds={3: (0.0, 15.0), 4: (-0.05, 0.05)},
        control_bounds={0: (-3.0, 3.0), 1: (-0.5, 0.5)},
        guess=line([0, 0, 0, 10, 0], [30, 3.5, 0, 10, 0], 0, 0),
    )


def planar_quadrotor() -> GalleryProblem:
    """Fly a planar quadrotor by one metre in one second."""
    return GalleryProblem(
        controls=2,
        dynamics=lambda F, q, u, t, p: [
            *(q[3], q[4], q[5]),
            -(u[0] + u[1]) * F.sin(q[2]) / 0.4,
            (u[0] + u[1]) * F.cos(q[2]) / 0.4 - 9.81,
            (u[1] - u[0]) / 0.12,
        ],
        cost=squares(1.0, 1.0),
        duration=lambda p: 1.0,
        start=(1.0, *[0.0] * 5),
        end=(0.0,) * 6,
        control_bounds={0: (-9.81, 9.81), 1: (-9.81, 9.81)},
        guess=line([1, 0, 0, 0, 0, 0], [0] * 6, 1.962, 1.962),
    )


def reorientation() -> GalleryProblem:
    """Turn a rigid body, whose attitude is given by modified Rodrigues parameters, from rest to rest."""

    def dynamics(F: Any, q: Vector, u: Vector, t: Any, p: Vector) -> list[Any]:
        (a, b, c), (x, y, z) = q[:3], q[3:]
        inner, rest = a * x + b * y + c * z, 1 - a**2 - b**2 - c**2
        inertia = (1.0, 1.5, 2.0)
        turn = (b * z - c * y, c * x - a * z, a * y - b * x)
        attitude = [(rest * w + 2 * n + 2 * s * inner) / 4 for w, n, s in zip((x, y, z), turn, (a, b, c), strict=True)]
        gyration = (
            (inertia[1] - inertia[2]) * y * z,
            (inertia[2] - inertia[0]) * z * x,
            (inertia[0] - inertia[1]) * x * y,
        )
        return [*attitude, *((m + g) / i for m, g, i in zip(u, gyration, inertia, strict=True))]

    return GalleryProblem(
        controls=3,
        dynamics=dynamics,
        cost=squares(1.0, 1.0, 1.0),
        duration=lambda p: 5.0,
        start=(0.0,) * 6,
        end=(0.3, 0.5, -0.4, 0.0, 0.0, 0.0),
        control_bounds=dict.fromkeys(range(3), (-0.6, 0.6)),
        guess=line([0] * 6, [0.3, 0.5, -0.4, 0, 0, 0], 0, 0, 0),
    )


def heat() -> GalleryProblem:
    """Heat a rod of ten points from its left end, so that its right end has the wanted temperature."""

    def dynamics(F: Any, q: Vector, u: Vector, t: Any, p: Vector) -> list[Any]:
        around = [u[0], *q, q[-1]]
        return [20 * (around[i] - 2 * around[i + 1] + around[i + 2]) for i in range(10)]

    return GalleryProblem(
        controls=1,
        dynamics=dynamics,
        cost=lambda q, v, u, t: sum((x - 0.5) ** 2 for x in q) / 10 + 1e-3 * u[0] ** 2,
        terminal_cost=lambda q, v, p: 10 * (q[9] - 0.5) ** 2,
        duration=lambda p: 0.5,
        start=(0.0,) * 10,
        end=(None,) * 10,
        bounds={0: (-inf, 0.8)},
        control_bounds={0: (-1.0, 1.0)},
        guess=line([0] * 10, [0.5] * 10, 0.5),
    )


def oscillators() -> GalleryProblem:
    """Bring a chain of six masses with cubic springs to rest, by forces on its two ends."""

    def dynamics(F: Any, q: Vector, u: Vector, t: Any, p: Vector) -> list[Any]:
        places = [0, *q[:6], 0]
        stretch = [b - a for a, b in pairwise(places)]
        tension = [s + s**3 for s in stretch]
        pushes = [u[0], 0, 0, 0, 0, u[1]]
        return [*q[6:], *(tension[i + 1] - tension[i] + pushes[i] for i in range(6))]

    return GalleryProblem(
        controls=2,
        dynamics=dynamics,
        cost=squares(1.0, 1.0),
        duration=lambda p: 12.0,
        start=(0.5, -0.5, 0.5, -0.5, 0.5, -0.5, *[0.0] * 6),
        end=(0.0,) * 12,
        control_bounds={0: (-1.0, 1.0), 1: (-1.0, 1.0)},
        guess=line([0.5, -0.5, 0.5, -0.5, 0.5, -0.5, *[0] * 6], [0] * 12, 0, 0),
    )


def spatial_quadrotor() -> GalleryProblem:
    """Fly a quadrotor with 12 states, Euler angles and body rates, by its thrust and three torques."""

    def dynamics(F: Any, q: Vector, u: Vector, t: Any, p: Vector) -> list[Any]:
        (sr, cr), (sp, cp), (sy, cy) = ((F.sin(a), F.cos(a)) for a in q[6:9])
        a, b, c = q[9:]
        ix, iy, iz = 0.01, 0.01, 0.02
        turn = b * sr + c * cr
        return [
            *q[3:6],
            u[0] * (cy * sp * cr + sy * sr),
            u[0] * (sy * sp * cr - cy * sr),
            u[0] * cp * cr - 9.81,
            a + sp / cp * turn,
            b * cr - c * sr,
            turn / cp,
            (u[1] + (iy - iz) * b * c) / ix,
            (u[2] + (iz - ix) * c * a) / iy,
            (u[3] + (ix - iy) * a * b) / iz,
        ]

    last = (2.0, 1.0, 1.0, *[0.0] * 9)
    return GalleryProblem(
        controls=4,
        dynamics=dynamics,
        cost=lambda q, v, u, t: (u[0] - 9.81) ** 2 + 100 * (u[1] ** 2 + u[2] ** 2 + u[3] ** 2),
        duration=lambda p: 1.5,
        start=(0.0,) * 12,
        end=last,
        bounds={6: (-1.2, 1.2), 7: (-1.2, 1.2)},
        control_bounds={0: (0.0, 20.0), **dict.fromkeys((1, 2, 3), (-0.3, 0.3))},
        guess=line([0] * 12, last, 9.81, 0, 0, 0),
    )


SHOOTING = {
    problem.__name__: problem
    for problem in (
        *(double_integrator, pendulum, rayleigh, fishing, stirred_tank, zermelo, dubins, moon_lander, earth_to_mars),
        *(cart_pole, two_link_arm, bicycle, planar_quadrotor, reorientation, heat, oscillators, spatial_quadrotor),
    )
}
"""All problems of this file by their names."""
