"""Velocities with given momenta, where a module says what momenta belong to velocities and not the reverse."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from codegen.interfaces import Vector

NEWTON_STEPS, CLOSE = 20, 1e-12
"""One step is enough where kinetic energy is quadratic in velocities."""


def velocities_of(momenta: Callable[[Vector], Vector], wanted: Vector, guess: Vector) -> Vector:
    """The velocities (coordinates,) with the momenta `wanted`, by Newton's method from a guess.

    Its matrix is that of differences over one, exact for a kinetic energy that is quadratic in velocities.
    """
    v = guess
    for _ in range(NEWTON_STEPS):
        found = momenta(v)
        missing = wanted - found
        if not np.abs(missing).max() > CLOSE * max(1.0, np.abs(wanted).max()):
            break
        v = v + np.linalg.solve(np.column_stack([momenta(v + unit) - found for unit in np.eye(v.size)]), missing)
    return v
