"""Problems of one mass and of several points, of which tests change an argument at a time."""

from __future__ import annotations

from typing import Any

import sympy

from codegen import Control, control, controls, coordinate, coordinates
from codegen.discretise.model.definitions import Condition


def plain(names: str) -> Any:
    """The symbols that a model has for declared names."""
    symbols = sympy.symbols(names, real=True)
    return symbols


def oscillator(**changes: Any) -> Control:
    """A driven oscillator whose arguments may be given as functions of q, dq and u."""
    q, dq = coordinate("q")
    u = control("u")
    given = {name: value(q, dq, u) if callable(value) else value for name, value in changes.items()}
    arguments = {
        "lagrangian": dq**2 / 2 - q**2 / 2,
        "force": {q: u},
        "cost": u**2,
        "duration": 1,
        "start": {q: 0, dq: 0},
        **given,
    }
    return Control(**arguments)


def runners(bodies: int = 2, **changes: Any) -> Control:
    """Several points in the plane whose arguments may be given as functions of (x, y) and (dx, dy)."""
    (x, y), (dx, dy) = coordinates("x y")
    f, g = controls("f g")
    given = {name: value((x, y), (dx, dy)) if callable(value) else value for name, value in changes.items()}
    arguments = {
        "lagrangian": (dx**2 + dy**2) / 2,
        "force": {x: f, y: g},
        "cost": f**2 + g**2,
        "duration": 1,
        "start": {x: 0, y: 0, dx: 0, dy: 0},
        "bodies": bodies,
        **given,
    }
    return Control(**arguments)


def names(conditions: tuple[Condition, ...]) -> list[str]:
    return [condition.name for condition in conditions]
