"""Optima by closed forms and by the maximum principle, integrated by scipy: what accuracy on request is measured with.

Every function returns the least cost to ten digits or so. The structure of arcs is put in, and their ends follow from
equations, so that nothing here is discretised as a problem file is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq, fsolve

TIGHT: dict[str, Any] = {"method": "DOP853", "rtol": 2.3e-14, "atol": 1e-15}


def hypersensitive(duration: float = 1e4) -> float:
    """The closed form of the problem's file, with x(0) = 3/2 and x(T) = 1."""
    z, a, b = math.sqrt(2.0) * duration, 1.5, 1.0
    beside = 0.0 if z > 700.0 else 2.0 * a * b / math.sinh(z)
    return (math.sqrt(2.0) * ((a**2 + b**2) / math.tanh(min(z, 700.0)) - beside) + b**2 - a**2) / 2.0


def linear_tangent_steering() -> float:
    """The least time with tan u = (1 - 2 t/T) tan u_0: two equations for u_0 and T. Bryson and Ho (1975), 2.4."""

    def misses(z: np.ndarray) -> list[float]:
        angle, time = z
        s = math.tan(angle)
        return [100.0 * time / s * math.asinh(s) - 45.0, _height(angle, time) - 5.0]

    return float(fsolve(misses, [0.9, 0.55], xtol=1e-15)[1])


def _height(angle: float, time: float) -> float:
    """The height after steering with a tangent that runs from tan(angle) to its negative."""
    s = math.tan(angle)
    nodes, weights = np.polynomial.legendre.leggauss(80)
    t = 0.5 * (nodes + 1.0)
    tangent = s * (1.0 - 2.0 * t)
    vertical = 100.0 * tangent / np.sqrt(1.0 + tangent**2)
    return float(time**2 * 0.5 * weights @ (vertical * (1.0 - t)))


def moon_lander() -> float:
    """Free fall, then full thrust F: two equations for the lengths of both, by the rocket equation."""
    thrust, c = 1.227, 2.349

    def misses(z: np.ndarray) -> list[float]:
        fall, burn = z
        v, h = -0.783 - fall, 1.0 - 0.783 * fall - fall**2 / 2.0
        m = 1.0 - thrust * burn / c
        speed = v - burn - c * math.log(m)
        # The double integral of F/m over the burn.
        gained = c * (burn + (m / (thrust / c)) * math.log(m))
        return [speed, h + v * burn - burn**2 / 2.0 + gained]

    return thrust * float(fsolve(misses, [0.239, 1.1575], xtol=1e-15)[1])


def hanging_chain() -> float:
    """The catenary y = a cosh((x - b)/a) + d of length 4 from height 1 to height 3 over a distance of 1."""
    # The length is sqrt(2^2 + (2 a sinh(1/(2 a)))^2).
    a = brentq(lambda a: 2.0 * a * math.sinh(0.5 / a) - math.sqrt(12.0), 0.05, 1.0, xtol=1e-16)
    middle = math.atanh(2.0 / 4.0)  # at half the distance, in parts of a
    left, right = middle - 0.5 / a, middle + 0.5 / a
    d = 1.0 - a * math.cosh(left)

    def primitive(s: float) -> float:
        return a * a * (s / 2.0 + math.sinh(2.0 * s) / 4.0) + d * a * math.sinh(s)

    return primitive(right) - primitive(left)


def catalyst_mixing() -> float:
    """u is 1, then constant on the singular arc, where the motion keeps its direction, then 0."""

    def matrix(u: float) -> np.ndarray:
        return np.array([[-u, 10.0 * u], [u, -10.0 * u - (1.0 - u)]])

    def yield_of(first: float, second: float, u: float) -> float:
        x = np.array([1.0, 0.0])
        for value, time in ((1.0, first), (u, second - first), (0.0, 1.0 - second)):
            x = expm(matrix(value) * time) @ x
        return float(x.sum() - 1.0)

    return _least(lambda z: yield_of(*z), np.array([0.1363, 0.7252, 0.2271]))


def _least(function: Callable[[np.ndarray], float], guess: np.ndarray) -> float:
    """The least value near a guess: Newton steps with differences, since values at a minimum forgive errors there."""
    z, h = guess.copy(), 1e-4
    for _ in range(8):
        n = z.size
        unit = h * np.eye(n)
        slope = np.array([(function(z + e) - function(z - e)) / (2.0 * h) for e in unit])
        curvature = np.array(
            [
                [
                    (function(z + a + b) - function(z + a - b) - function(z - a + b) + function(z - a - b))
                    / (4.0 * h * h)
                    for b in unit
                ]
                for a in unit
            ]
        )
        z = z - np.linalg.solve(curvature, slope)
    return function(z)


def van_der_pol() -> float:
    """Shooting from the first costates, with u = -lambda_1/2 between its bounds."""

    def rates(_t: float, z: np.ndarray) -> list[float]:
        x, y, p, q, _ = z
        u = min(max(-p / 2.0, -0.3), 1.0)
        return [(1.0 - y * y) * x - y + u, x, -2.0 * x - p * (1.0 - y * y) - q, -2.0 * y + p * (2.0 * x * y + 1.0),
                x * x + y * y + u * u]  # fmt: skip

    def kink(level: float) -> Callable[[float, np.ndarray], float]:
        return lambda _t, z: -z[2] / 2.0 - level

    def end(costates: np.ndarray) -> np.ndarray:
        t, z = 0.0, np.array([0.0, 1.0, *costates, 0.0])
        for _ in range(12):  # from kink to kink, which an integrator must not step over
            found = solve_ivp(rates, (t, 5.0), z, events=[_stopping(kink(-0.3)), _stopping(kink(1.0))], **TIGHT)
            t, z = float(found.t[-1]), found.y[:, -1]
            if found.status == 0:
                return z
            step = solve_ivp(rates, (t, min(5.0, t + 1e-9)), z, **TIGHT)
            t, z = float(step.t[-1]), step.y[:, -1]
        raise ArithmeticError("too many kinks")

    start = fsolve(lambda p: end(p)[2:4], [0.8, 3.0], xtol=1e-13)
    return float(end(np.asarray(start))[4])


def _stopping(event: Any) -> Any:
    event.terminal = True
    return event


def goddard_rocket() -> float:
    """Full thrust until (1 + v/c) D = m g, then such that it stays so, until the fuel is burnt, then none.

    The singular arc is that of Bryson and Ho (1975), section 8.4, for a drag D in proportion to v^2. Minus the height.
    """
    g0, h_c, d_c, c, greatest, last = 1.0, 500.0, 310.0, 0.5, 3.5, 0.6

    def drag(r: float, v: float) -> float:
        return d_c * v * v * math.exp(-h_c * (r - 1.0))

    def rates(thrust: float, z: np.ndarray) -> list[float]:
        r, v, m = z
        return [v, (thrust - drag(r, v)) / m - g0 / r**2, -thrust / c]

    def surface(z: np.ndarray) -> float:
        r, v, m = z
        return (1.0 + v / c) * drag(r, v) - m * g0 / r**2

    def singular(z: np.ndarray) -> float:
        """The thrust, in which the rate of the surface is linear, that keeps it at zero."""
        r, v, m = z
        d = drag(r, v)
        by = np.array(
            [-h_c * (1.0 + v / c) * d + 2.0 * m * g0 / r**3, (2.0 / v * (1.0 + v / c) + 1.0 / c) * d, -g0 / r**2]
        )
        off, on = by @ rates(0.0, z), by @ rates(1.0, z)
        return float(-off / (on - off))

    def arc(thrust: Callable[[np.ndarray], float], z: np.ndarray, until: Callable[[np.ndarray], float]) -> np.ndarray:
        event = _stopping(lambda _t, z: until(z))
        found = solve_ivp(lambda _t, z: rates(thrust(z), z), (0.0, 1.0), z, events=event, **TIGHT)
        return np.asarray(found.y_events[0][0])

    z = arc(lambda _: greatest, np.array([1.0, 0.0, 1.0]), surface)
    z = arc(singular, z, lambda z: z[2] - last)
    return -float(arc(lambda _: 0.0, z, lambda z: z[1])[0])
