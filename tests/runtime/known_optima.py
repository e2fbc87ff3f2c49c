"""Optimisation problems whose optima are known from elsewhere, with the iterations that another solver needs.

Nonlinear programs: Hock and Schittkowski (1981), Test examples for nonlinear programming codes. Trajectories: optima of
Ipopt 3.11.9, which widens bounds by 1e-8. Iterations are those of Ipopt with its default options and tolerance 1e-10,
from the same guess.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from dense_problem import INFINITY, Motion, program, transcribe
from sympy import cos, exp, log, sin, symbols

from codegen.runtime.search.grid import Grid

x1, x2, x3, x4, x5, x6, x7 = x = symbols("x1:8")
T, u, v = symbols("T u v")
POSITIVE = 0.0, INFINITY


def nlp(guess: tuple[float, ...], cost: Any, equations: Any = (), inequalities: Any = (), bounds: Any = None) -> Grid:
    return program(dict(zip(x, guess, strict=False)), cost, list(equations), list(inequalities), bounds)


# name: (optimum, iterations of Ipopt 3.11.9 with its default options and tolerance 1e-10, problem)
HOCK_SCHITTKOWSKI = {
    "1": (0.0, 26, lambda: nlp((-2, 1), 100 * (x2 - x1**2) ** 2 + (1 - x1) ** 2, bounds={x2: (-1.5, INFINITY)})),
    "5": (-1.913222955, 9, lambda: nlp((0, 0), sin(x1 + x2) + (x1 - x2) ** 2 - 1.5 * x1 + 2.5 * x2 + 1,
                                       bounds={x1: (-1.5, 4), x2: (-3, 3)})),
    "6": (0.0, 5, lambda: nlp((-1.2, 1), (1 - x1) ** 2, [10 * (x2 - x1**2)])),
    "7": (-np.sqrt(3), 27, lambda: nlp((2, 2), log(1 + x1**2) - x2, [(1 + x1**2) ** 2 + x2**2 - 4])),
    "10": (-1.0, 13, lambda: nlp((-10, 10), x1 - x2, [], [3 * x1**2 - 2 * x1 * x2 + x2**2 - 1])),
    "11": (-8.498464223, 9, lambda: nlp((4.9, 0.1), (x1 - 5) ** 2 + x2**2 - 25, [], [x1**2 - x2])),
    "14": (1.393464978, 8, lambda: nlp((2, 2), (x1 - 2) ** 2 + (x2 - 1) ** 2, [x1 - 2 * x2 + 1],
                                       [x1**2 / 4 + x2**2 - 1])),
    "15": (306.5, 17, lambda: nlp((-2, 1), 100 * (x2 - x1**2) ** 2 + (1 - x1) ** 2, [], [1 - x1 * x2, -x1 - x2**2],
                                  {x1: (-INFINITY, 0.5)})),
    "19": (-6961.81381, 15, lambda: nlp((20.1, 5.84), (x1 - 10) ** 3 + (x2 - 20) ** 3, [],
                                        [100 - (x1 - 5) ** 2 - (x2 - 5) ** 2, (x1 - 6) ** 2 + (x2 - 5) ** 2 - 82.81],
                                        {x1: (13, 100), x2: (0, 100)})),
    "24": (-1.0, 13, lambda: nlp((1, 0.5), ((x1 - 3) ** 2 - 9) * x2**3 / (27 * np.sqrt(3)), [],
                                 [x2 - x1 / np.sqrt(3), -x1 - np.sqrt(3) * x2, x1 + np.sqrt(3) * x2 - 6],
                                 {x1: POSITIVE, x2: POSITIVE})),
    "26": (0.0, 31, lambda: nlp((-2.6, 2, 2), (x1 - x2) ** 2 + (x2 - x3) ** 4, [(1 + x2**2) * x1 + x3**4 - 3])),
    "27": (0.04, 54, lambda: nlp((2, 2, 2), 0.01 * (x1 - 1) ** 2 + (x2 - x1**2) ** 2, [x1 + x3**2 + 1])),
    "28": (0.0, 1, lambda: nlp((-4, 1, 1), (x1 + x2) ** 2 + (x2 + x3) ** 2, [x1 + 2 * x2 + 3 * x3 - 1])),
    "35": (1 / 9, 8, lambda: nlp((0.5, 0.5, 0.5), 9 - 8 * x1 - 6 * x2 - 4 * x3 + 2 * x1**2 + 2 * x2**2 + x3**2
                                 + 2 * x1 * x2 + 2 * x1 * x3, [], [x1 + x2 + 2 * x3 - 3],
                                 dict.fromkeys(x[:3], POSITIVE))),
    "36": (-3300.0, 13, lambda: nlp((10, 10, 10), -x1 * x2 * x3, [], [x1 + 2 * x2 + 2 * x3 - 72],
                                    {x1: (0, 20), x2: (0, 11), x3: (0, 42)})),
    "39": (-1.0, 13, lambda: nlp((2, 2, 2, 2), -x1, [x2 - x1**3 - x3**2, x1**2 - x2 - x4**2])),
    "43": (-44.0, 10, lambda: nlp((0, 0, 0, 0), x1**2 + x2**2 + 2 * x3**2 + x4**2 - 5 * x1 - 5 * x2 - 21 * x3 + 7 * x4,
                                  [], [x1**2 + x2**2 + x3**2 + x4**2 + x1 - x2 + x3 - x4 - 8,
                                       x1**2 + 2 * x2**2 + x3**2 + 2 * x4**2 - x1 - x4 - 10,
                                       2 * x1**2 + x2**2 + x3**2 + 2 * x1 - x2 - x4 - 5])),
    "47": (0.0, 22, lambda: nlp((2, np.sqrt(2), -1, 2 - np.sqrt(2), 0.5), (x1 - x2) ** 2 + (x2 - x3) ** 3
                                + (x3 - x4) ** 4 + (x4 - x5) ** 4,
                                [x1 + x2**2 + x3**3 - 3, x2 - x3**2 + x4 - 1, x1 * x5 - 1])),
    "48": (0.0, 1, lambda: nlp((3, 5, -3, 2, -2), (x1 - 1) ** 2 + (x2 - x3) ** 2 + (x4 - x5) ** 2,
                               [x1 + x2 + x3 + x4 + x5 - 5, x3 - 2 * (x4 + x5) + 3])),
    "51": (0.0, 1, lambda: nlp((2.5, 0.5, 2, -1, 0.5), (x1 - x2) ** 2 + (x2 + x3 - 2) ** 2 + (x4 - 1) ** 2
                               + (x5 - 1) ** 2, [x1 + 3 * x2 - 4, x3 + x4 - 2 * x5, x2 - x5])),
    "65": (0.9535288567, 16, lambda: nlp((-5, 5, 0), (x1 - x2) ** 2 + (x1 + x2 - 10) ** 2 / 9 + (x3 - 5) ** 2, [],
                                         [x1**2 + x2**2 + x3**2 - 48],
                                         {x1: (-4.5, 4.5), x2: (-4.5, 4.5), x3: (-5, 5)})),
    "71": (17.0140173, 9, lambda: nlp((1, 5, 5, 1), x1 * x4 * (x1 + x2 + x3) + x3,
                                      [x1**2 + x2**2 + x3**2 + x4**2 - 40], [25 - x1 * x2 * x3 * x4],
                                      dict.fromkeys(x[:4], (1, 5)))),
    "76": (-4.681818181, 8, lambda: nlp((0.5, 0.5, 0.5, 0.5), x1**2 + 0.5 * x2**2 + x3**2 + 0.5 * x4**2 - x1 * x3
                                        + x3 * x4 - x1 - 3 * x2 + x3 - x4, [],
                                        [x1 + 2 * x2 + x3 + x4 - 5, 3 * x1 + x2 + 2 * x3 - x4 - 4, 1.5 - x2 - 4 * x3],
                                        dict.fromkeys(x[:4], POSITIVE))),
    "100": (680.6300573, 12, lambda: nlp((1, 2, 0, 4, 0, 1, 1), (x1 - 10) ** 2 + 5 * (x2 - 12) ** 2 + x3**4
                                         + 3 * (x4 - 11) ** 2 + 10 * x5**6 + 7 * x6**2 + x7**4 - 4 * x6 * x7
                                         - 10 * x6 - 8 * x7, [],
                                         [2 * x1**2 + 3 * x2**4 + x3 + 4 * x4**2 + 5 * x5 - 127,
                                          7 * x1 + 3 * x2 + 10 * x3**2 + x4 - x5 - 282,
                                          23 * x1 + x2**2 + 6 * x6**2 - 8 * x7 - 196,
                                          4 * x1**2 + x2**2 - 3 * x1 * x2 + 2 * x3**2 + 5 * x6 - 11 * x7])),
}  # fmt: skip


def cart_pole(bounds: Any, duration: Any = 2.0, running: Any = u**2, terminal: Any = 0) -> Motion:
    """Swing-up of a pole on a cart; Kelly (2017), An introduction to trajectory optimization, section 6."""
    q, theta, dq, dtheta = states = symbols("q theta dq dtheta")
    shared = 1 + 0.3 * (1 - cos(theta) ** 2)
    push = (0.15 * sin(theta) * dtheta**2 + u + 2.943 * cos(theta) * sin(theta)) / shared
    turn = -(0.15 * cos(theta) * sin(theta) * dtheta**2 + u * cos(theta) + 12.753 * sin(theta)) / (0.5 * shared)
    start, end = dict.fromkeys(states, 0.0), {q: 1.0, theta: np.pi, dq: 0.0, dtheta: 0.0}
    guess = {q: (0, 1), theta: (0, np.pi), T: 2.0}
    limits = {**dict(zip((q, u), bounds, strict=True)), T: (0.5, 5.0)}
    return Motion(
        list(states), [u], [dq, dtheta, push, turn], duration, running, start, end, guess, limits, [], terminal
    )


def pendulum(duration: Any, running: Any, terminal: Any) -> Motion:
    """Swing-up of a pendulum by a torque that is too weak to lift it at once."""
    theta, limits = symbols("theta"), {u: (-5, 5), T: (0.3, 30)}
    guess = {theta: (0, np.pi), T: 3.0}
    start, end = {theta: 0, v: 0}, {theta: np.pi, v: 0}
    return Motion(
        [theta, v], [u], [v, -9.81 * sin(theta) + u], duration, running, start, end, guess, limits, [], terminal
    )


def brachistochrone() -> Motion:
    """Fastest slide from (0, 10) to (10, 5), from a guess without any speed profile."""
    start, end, limits = {x1: 0, x2: 10, v: 0}, {x1: 10, x2: 5}, {u: (0, np.pi), T: (0.1, 10)}
    guess = {x1: (0, 10), x2: (10, 5), v: 1.0, u: 1.0, T: 1.0}
    return Motion([x1, x2, v], [u], [v * sin(u), -v * cos(u), 9.80665 * cos(u)], T, 0, start, end, guess, limits, [], T)


def van_der_pol() -> Motion:
    """Least squares of state and control of the forced oscillator, with bounds on both."""
    rates, limits = [(1 - x2**2) * x1 - x2 + u, x1], {u: (-0.75, 1), x1: (-0.25, INFINITY)}
    return Motion([x1, x2], [u], rates, 10.0, x1**2 + x2**2 + u**2, {x1: 0, x2: 1}, {}, {x2: 1.0}, limits)


def goddard() -> Motion:
    """Greatest height of a rocket with drag; Dolan, More and Munson (2004), COPS, problem 9."""
    h, m = symbols("h m")
    drag = 310 * v**2 * exp(-500 * (h - 1))
    guess = {h: (1, 1.01), v: 0.05, m: (1, 0.6), u: 1.7, T: 0.2}
    limits = {u: (0, 3.5), T: (0.01, 1), v: POSITIVE, h: (1, INFINITY)}
    rates = [v, (u - drag) / m - 1 / h**2, -2 * u]
    return Motion([h, v, m], [u], rates, T, 0, {h: 1, v: 0, m: 1}, {m: 0.6}, guess, limits, [], -h)


# name: (optimum, or None where Ipopt finds none, iterations until it stops, problem)
TRAJECTORIES = {
    "cart-pole": (60.38214231730647, 17, lambda: transcribe(cart_pole([(-2, 2), (-20, 20)]), 25)),
    "cart-pole, tight": (60.457625603027, 21, lambda: transcribe(cart_pole([(-1, 1.2), (-13, 13)]), 25)),
    "cart-pole, least time": (1.1727584248354, 44, lambda: transcribe(cart_pole([(-2, 2), (-20, 20)], T, 0, T), 25)),
    "pendulum": (38.090076157004, 16, lambda: transcribe(pendulum(3.0, u**2, 0), 25)),
    "pendulum, least time": (2.400688605387, 70, lambda: transcribe(pendulum(T, 0, T), 25)),
    "brachistochrone": (1.8019729695487, 29, lambda: transcribe(brachistochrone(), 25)),
    "van der Pol": (3.6841866347328, 13, lambda: transcribe(van_der_pol(), 25)),
    "Goddard": (-1.0128909814847, 22, lambda: transcribe(goddard(), 25)),
}


def double_integrator() -> Motion:
    """Least time from rest to rest over a distance of one with |u| <= 1, which is 2."""
    guess = {x1: (0.0, 1.0), T: 1.0}
    bounds = {u: (-1.0, 1.0), T: (0.1, 10.0)}
    return Motion([x1, v], [u], [v, u], T, 0, {x1: 0, v: 0}, {x1: 1, v: 0}, guess, bounds, [], T)
