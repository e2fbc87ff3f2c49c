"""The second-order condition: a solution is a minimum, and no saddle point, where the KKT matrix has the right inertia.

At a strict local minimum the Hessian of the Lagrangian is positive definite on the null space of the equations, and
then the KKT matrix has exactly one negative eigenvalue for every equation (Nocedal and Wright, 2006, theorem 16.3). An
unknown at its bound is held there by a multiplier z, which adds z / distance to the diagonal.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.checks.base import Context, Finding, does_not_apply
from codegen.transcribe.program import ControlProgram

_HELD = 1.0
"""From here on z / distance counts as holding an unknown; inside the bounds it is as small as the tolerance."""


def check(context: Context) -> Iterator[Finding]:
    """Count the negative eigenvalues at the solution by a symmetric elimination, which is exact."""
    if not isinstance(context.program, ControlProgram):
        yield does_not_apply("second-order condition", "a simulation minimises nothing")
        return
    module, solution = context.module, context.solution
    subject = f"solution on {solution.t.size - 1} intervals"
    if solution.status != "solved":
        yield Finding("second-order condition", subject, False, f"no solution to judge: {solution.message}")
        return
    grid = module.make_grid((solution.t.size - 1) // max(1, len(context.program.phases)))
    diagonal = held_by_bounds(module, grid, solution.unknowns)
    passed, detail = _judged(module, grid, solution.unknowns, diagonal)
    if module.metadata["inequalities"]:
        detail += f" ({np.count_nonzero(diagonal > _HELD)} unknowns are held by bounds)"
    yield Finding("second-order condition", subject, passed, detail)


def held_by_bounds(module: Any, grid: Any, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
    """The diagonal z / distance of the unknowns that push against a bound; z is the gradient of the Lagrangian."""
    diagonal = np.zeros(unknowns.size)
    if not module.metadata["inequalities"]:
        return diagonal
    gradient = np.where(grid.is_multiplier, 0.0, module.evaluate(grid, unknowns).gradient)
    lower, upper = module.variable_bounds(grid)
    for z, distance in ((gradient, unknowns - lower), (-gradient, upper - unknowns)):
        pushes = np.isfinite(distance) & (z > 0.0)
        diagonal[pushes] += z[pushes] / np.maximum(distance[pushes], np.finfo(float).tiny)
    return diagonal


def _judged(module: Any, grid: Any, unknowns: NDArray[np.float64], diagonal: NDArray[np.float64]) -> tuple[bool, str]:
    equations = module.multiplier_unknowns(grid).size
    excess = module.factor_kkt(grid, unknowns, 1.0, diagonal, module.allocate_system(grid))
    if excess == 0:
        return True, f"a strict local minimum: {equations} negative eigenvalues for {equations} equations"
    if excess is not None and excess > 0:
        return False, f"no minimum: the cost decreases to second order in {excess} or more independent directions"
    return False, "undecided: the KKT matrix is singular, so that the optimum is not isolated"
