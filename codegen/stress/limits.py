"""The largest stable step of a scheme, by bisection on the spectral radius of its own step about a state of rest."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from codegen.stress.cases import Case
from codegen.stress.systems import REST, frequency

LEAST, MOST = 0.02, 1e4
"""Steps times frequency between which the limit is looked for."""
POINTS = 1500
"""So many steps are tried between them; the first window of instability of some compositions is 2 % wide."""
GROWTH = 1e-4
"""A spectral radius above one by more than this is growth; explicit Euler's is (h omega)^2/2 above one."""

_known: dict[tuple[str, str], float] = {}


def stable_limit(module: Any, case: Case) -> float:
    """The largest h omega at which no small motion about rest grows: 0 if there is none, infinite if there is no limit.

    Source of the criterion: Hairer, Lubich and Wanner (2006), Geometric numerical integration, VIII.6 and I.5.2.
    """
    key = (module.metadata.inputs, case.setup.label)
    if key not in _known:
        _known[key] = first_growth(lambda x: spectral_radius(module, case.setup.file.stem, x) <= 1.0 + GROWTH)
    return _known[key]


def first_growth(is_stable: Callable[[float], bool]) -> float:
    """The h omega where motions begin to grow, by trial and bisection; beyond it, other stable steps may follow."""
    if not is_stable(LEAST):
        return 0.0
    grid = np.geomspace(LEAST, MOST, POINTS)
    below = LEAST
    for above in grid[1:]:
        if not is_stable(above):
            for _ in range(40):
                middle = math.sqrt(below * above)
                below, above = (middle, above) if is_stable(middle) else (below, middle)
            return below
        below = above
    return math.inf


def spectral_radius(module: Any, problem: str, h_omega: float) -> float:
    """The largest modulus of an eigenvalue of the step's Jacobian at rest, by central differences."""
    values, rest = REST[problem]
    h = h_omega / frequency(problem, values)
    grid = module.make_grid(1, duration=h, **values)
    size = len(rest)
    change = 1e-6
    columns = []
    for i in range(size):
        offset = np.zeros(size)
        offset[i] = change
        forward, backward = (module.step(grid, np.array(rest) + sign * offset) for sign in (1.0, -1.0))
        columns.append((forward - backward) / (2.0 * change))
    matrix = np.array(columns).T
    return float(np.abs(np.linalg.eigvals(matrix)).max()) if np.isfinite(matrix).all() else math.inf
