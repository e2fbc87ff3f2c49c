"""Groups, chains and closed loops of the gallery: couplings and holonomic constraints (see `gallery_problem.py`)."""

from math import acos, cos, pi, sin, sqrt
from typing import Any

from .gallery_problem import GalleryProblem, Numbers, Vector, line, nothing


def hovercraft(craft: int) -> GalleryProblem:
    """The gallery's hovercraft with a minimal set of end conditions."""
    radius = 0.5 / sin(pi / craft)

    def couplings(F: Any, ends: list[Vector]) -> list[Any]:
        sides = [(a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 - 1 for a, b in zip(ends, [*ends[1:], ends[0]], strict=True)]
        centre = [sum(e[0] for e in ends) - 2 * craft, sum(e[1] for e in ends) - 2 * craft, ends[0][1] - 2]
        return sides + centre + [(e[0] - 2) ** 2 + (e[1] - 2) ** 2 - radius**2 for e in ends[: craft - 3]]

    def guess(F: Any, s: Any, body: int) -> tuple[list[Any], list[Any]]:
        x, angle = 1 + 2 * body / (craft - 1), pi + 2 * pi * body / craft
        return [x + s * (2 + radius * cos(angle) - x), s * (2 + radius * sin(angle)), s * pi / 2], [1, 1]

    return GalleryProblem(
        controls=2,
        lagrangian=lambda F, q, v, t: (v[0] ** 2 + v[1] ** 2) / 2 + 0.05 * v[2] ** 2,
        force=lambda F, q, v, u, t: [
            F.cos(q[2]) * u[0] - F.sin(q[2]) * u[1],
            F.sin(q[2]) * u[0] + F.cos(q[2]) * u[1],
            -0.2 * u[1],
        ],
        cost=lambda q, v, u, t: u[0] ** 2 + u[1] ** 2,
        start=lambda body: (1 + 2 * body / (craft - 1), 0.0, 0.0),
        start_rate=(0.0, 0.0, 0.0),
        end=(None, None, pi / 2),
        end_rate=(0.0, 0.0, 0.0),
        bodies=craft,
        couplings=couplings,
        guess=guess,
    )


def n_link_pendulum(links: int) -> GalleryProblem:
    """A chain of unit mass and length with a motor at every joint, to 45 degrees."""

    def lagrangian(F: Any, q: Vector, v: Vector, t: Any) -> Any:
        x_rates = [F.cos(a) * b for a, b in zip(q, v, strict=True)]
        y_rates = [F.sin(a) * b for a, b in zip(q, v, strict=True)]
        total = 0
        for i in range(links):
            total += (sum(x_rates[: i + 1]) ** 2 + sum(y_rates[: i + 1]) ** 2) / (2 * links**3)
            total += 9.81 * (links - i) * F.cos(q[i]) / links**2
        return total

    return GalleryProblem(
        controls=links,
        lagrangian=lagrangian,
        force=lambda F, q, v, u, t: [u[i] - (u[i + 1] if i + 1 < links else 0) for i in range(links)],
        cost=lambda q, v, u, t: sum(torque**2 for torque in u),
        start=(0.0,) * links,
        start_rate=(0.0,) * links,
        end=(pi / 4,) * links,
        end_rate=(0.0,) * links,
        guess=line([0] * links, [pi / 4] * links, *[0] * links),
    )


def spherical_pendulum(form: str) -> GalleryProblem:
    """A quarter turn of the spherical pendulum, `cartesian` or in `angles`."""
    r, g = 1 / sqrt(2), 9.81
    common: dict[str, Any] = {"controls": 2, "cost": lambda q, v, u, t: u[0] ** 2 + u[1] ** 2}
    if form == "angles":
        return GalleryProblem(
            **common,
            lagrangian=lambda F, q, v, t: (v[0] ** 2 + F.sin(q[0]) ** 2 * v[1] ** 2) / 2 + g * F.cos(q[0]),
            force=lambda F, q, v, u, t: [
                F.cos(q[0]) * (F.cos(q[1]) * u[0] + F.sin(q[1]) * u[1]),
                F.sin(q[0]) * (F.cos(q[1]) * u[1] - F.sin(q[1]) * u[0]),
            ],
            start=(pi / 4, 0.0),
            start_rate=(0.0, 0.0),
            end=(pi / 4, pi / 2),
            end_rate=(0.0, 0.0),
            guess=line([pi / 4, 0], [pi / 4, pi / 2], 0, 0),
        )
    return GalleryProblem(
        **common,
        lagrangian=lambda F, q, v, t: (v[0] ** 2 + v[1] ** 2 + v[2] ** 2) / 2 - g * q[2],
        force=lambda F, q, v, u, t: [u[0], u[1], 0],
        constraint=lambda F, q: [q[0] ** 2 + q[1] ** 2 + q[2] ** 2 - 1],
        start=(r, 0.0, -r),
        start_rate=(0.0, 0.0, 0.0),
        end=(0.0, r, -r),
        end_rate=(0.0, 0.0, 0.0),
        guess=lambda F, s: ([r * F.cos(pi * s / 2), r * F.sin(pi * s / 2), -r], [0, 0]),
    )


def four_bar() -> GalleryProblem:
    """Half a turn of a crank of length 1; ground, coupler and rocker have length 2."""
    start = (0.0, acos(1 / 4), pi - acos(1 / 4))
    end = (pi, acos(3 / 4), pi - acos(3 / 4))
    return GalleryProblem(
        controls=1,
        lagrangian=lambda F, q, v, t: (
            v[0] ** 2 / 6
            + (v[0] ** 2 + 2 * F.cos(q[0] - q[1]) * v[0] * v[1] + v[1] ** 2) / 2
            + v[1] ** 2 / 6
            + 2 / 3 * v[2] ** 2
        ),
        force=lambda F, q, v, u, t: [u[0], 0, 0],
        cost=lambda q, v, u, t: u[0] ** 2,
        constraint=lambda F, q: [
            F.cos(q[0]) + 2 * F.cos(q[1]) - 2 * F.cos(q[2]) - 2,
            F.sin(q[0]) + 2 * F.sin(q[1]) - 2 * F.sin(q[2]),
        ],
        start=start,
        start_rate=(0.0, 0.0, 0.0),
        end=end,
        end_rate=(0.0, 0.0, 0.0),
        guess=line(start, end, 0),
    )


def cart_pendulum(form: str) -> GalleryProblem:
    """bioptim's two tests, `plain` and `holonomic`, by the trapezoidal rule."""
    extra = form == "holonomic"

    def lagrangian(F: Any, q: Vector, v: Vector, t: Any) -> Any:
        sine, cosine, rate = F.sin(q[-1]), F.cos(q[-1]), v[-1]
        height, climb = (q[1], v[1]) if extra else (0, 0)
        across = v[0] + rate * (0.9542 * cosine - 0.0688 * sine)
        up = climb + rate * (0.9542 * sine + 0.0688 * cosine)
        energy = 9.81 * (height + 0.0688 * sine - 0.9542 * cosine)
        return (across**2 + up**2 + 0.0391 * rate**2) / 2 - energy

    def slow(F: Any, q: Vector, v: Vector) -> list[tuple[Any, float, float]]:
        return [(v[0], -0.01, 0.01), (v[-1], -0.01, 0.01)] if extra else []

    n = 3 if extra else 2
    rate: Numbers = (None, 0.0, None) if extra else (0.0, 0.0)
    return GalleryProblem(
        controls=1,
        lagrangian=lagrangian,
        force=lambda F, q, v, u, t: [u[0]] + [0] * (n - 1),
        cost=lambda q, v, u, t: u[0] ** 2,
        constraint=(lambda F, q: [q[1]]) if extra else nothing,
        start=(0.0,) * n,
        start_rate=rate,
        start_conditions=slow,
        end=(0.0,) * (n - 1) + (3.14,),
        end_rate=rate,
        end_conditions=slow,
        bounds={0: (-1.0, 5.0), n - 1: (-2 * pi, 2 * pi)},
        control_bounds={0: (-100.0, 100.0)},
        guess=line([0] * n, [0] * (n - 1) + [3.14], 0),
        trapezoidal=True,
    )


def convoy() -> GalleryProblem:
    """A trolley on a rail and a drone within radio range of each other."""
    m, M, g = 1.0, 2.0, 1.0
    return GalleryProblem(
        controls=3,
        lagrangian=lambda F, q, v, t: M / 2 * v[0] ** 2 + m / 2 * (v[1] ** 2 + v[2] ** 2) - m * g * q[2],
        force=lambda F, q, v, u, t: [u[0], u[1], u[2]],
        cost=lambda q, v, u, t: u[0] ** 2 + u[1] ** 2 + u[2] ** 2,
        start=(0.0, 0.0, 0.5),
        start_rate=(0.0, -4.0, 4.0),
        end=(2.0, 2.0, 0.5),
        end_rate=(0.0, 0.0, 0.0),
        nodal_path=lambda q: [(q[1] - q[0]) ** 2 + q[2] ** 2 - 1],
        guess=line([0, 0, 0.5], [2, 2, 0.5], 0, 0, 0),
    )
