"""Small problems for controllers, run by the interpreter: a double integrator in several forms."""

from __future__ import annotations

from functools import cache

import numpy as np
from interpreted import of_problem

from codegen import Control, control, coordinate, parameters, states

HORIZON, STEPS = 2.0, 8


@cache
def regulator(is_bounded: bool = False):
    """A unit mass that is led to rest at `place`; terminal weights are parameters, and so is a constant force."""
    x, v = states("x v")
    u = control("u")
    T, place, wind, limit, xx, xv, vv = parameters(T=HORIZON, place=0, wind=0, limit=1.0, xx=1, xv=0, vv=1)
    bounds = {u: (-limit, limit)} if is_bounded else {}
    return of_problem(
        Control(
            dynamics={x: v, v: u + wind},
            cost=(x - place) ** 2 + v**2 / 2 + u**2 / 4,
            terminal_cost=xx * (x - place) ** 2 + 2 * xv * (x - place) * v + vv * v**2,
            duration=T,
            start={x: 1, v: 0},
            bounds=bounds,
            steps=STEPS,
        )
    )


@cache
def in_micrometres():
    """A mass with a cubic drag and a limited force, in units in which its numbers are a million times as large."""
    x, v = states("x v")
    u = control("u")
    unit = 1e6
    return of_problem(
        Control(
            dynamics={x: v, v: u - v**3 / unit**2},
            cost=(x**2 + v**2 / 2 + u**2 / 4) / unit**2,
            duration=HORIZON,
            start={x: unit, v: 0},
            bounds={u: (-unit, unit)},
            steps=STEPS,
        )
    )


@cache
def walled():
    """A unit mass that has to stay on one side of a wall."""
    x, v = states("x v")
    u = control("u")
    problem = {"dynamics": {x: v, v: u}, "cost": (x - 0.9) ** 2 + u**2, "bounds": {x: (None, 1)}}
    return of_problem(Control(**problem, duration=HORIZON, start={x: 0, v: 0}, steps=STEPS))


@cache
def carried():
    """The same mass with a Lagrangian, a free end and a cubic spring."""
    x, dx = coordinate("x")
    u = control("u")
    (T,) = parameters(T=HORIZON)
    return of_problem(
        Control(
            lagrangian=dx**2 / 2 - x**4 / 4,
            force={x: u},
            cost=x**2 + dx**2 / 2 + u**2 / 4,
            terminal_cost=x**2 + dx**2,
            duration=T,
            start={x: 1, dx: 0},
            steps=STEPS,
        )
    )


def exactly(state, inputs, t, seconds):
    """The motion of a unit mass under a constant force."""
    x, v = state
    (u,) = inputs
    return np.array([x + v * seconds + u * seconds**2 / 2, v + u * seconds])
