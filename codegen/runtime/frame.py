"""What surrounds the solver: the time grid and its checks, views of the unknowns, messages, the iteration log."""

import numpy as np

from codegen.runtime.example import (
    IS_MULTIPLIER,
    NODE,
    STRIDE,
    metadata,
)
from codegen.runtime.point import Grid

REMEDIES = {
    "iteration limit": "raise max_iterations, or start from a better guess",
    "non-finite": "a kernel returned NaN or infinity; change the guess or the parameters",
    "rank-deficient": "the optimality conditions are singular: a control is free of cost, or a boundary condition is"
    " redundant or out of reach; run codegen check",
    "saddle point": "the guess is stationary, but no minimum; start from another guess",
    "unbounded": "the cost has no minimum under the constraints; check the sign of the cost",
    "stalled": "no further progress in floating-point arithmetic; loosen the tolerance or rescale the problem",
    "infeasible": "the equations cannot be satisfied near the guess; change the guess, the duration or the steps",
}


def checked_grid(steps, duration, parameters):
    """A Grid; ValueError when a number is not finite, or when steps or duration are not positive."""
    if isinstance(steps, bool) or int(steps) != steps or steps < 1:
        raise ValueError(f"steps is {steps!r}, expected a positive integer")
    if not 0.0 < duration < np.inf:
        raise ValueError(f"duration is {duration!r}, expected a positive number")
    parameters = np.array(parameters, dtype=float)
    if not np.isfinite(parameters).all():
        raise ValueError(f"parameters and boundary values must be finite, got {parameters}")
    steps = int(steps)
    is_multiplier = np.empty(steps * STRIDE + NODE, dtype=bool)
    is_multiplier[: steps * STRIDE].reshape(steps, STRIDE)[:] = IS_MULTIPLIER
    is_multiplier[steps * STRIDE :] = IS_MULTIPLIER[:NODE]
    return Grid(steps, float(duration) / steps, parameters, is_multiplier)


def replace_values(boundary, where, values):
    """Overwrite prescribed boundary values by name; ValueError tells which names there are."""
    for quantity, value in (values or {}).items():
        key = f"{where} {quantity}"
        if key not in boundary:
            known = ", ".join(name.split()[1] for name in boundary if name.startswith(where)) or "nothing"
            raise ValueError(f"{quantity!r} is not prescribed at the {where}; prescribed: {known}")
        boundary[key] = float(value)


def views(grid, unknowns):
    """Views of a vector of unknowns: nodes (N + 1, NODE) and what lies on intervals (N, STRIDE - NODE)."""
    item = unknowns.itemsize
    nodes = np.ndarray((grid.steps + 1, NODE), float, unknowns, 0, (STRIDE * item, item))
    intervals = unknowns[: grid.steps * STRIDE].reshape(grid.steps, STRIDE)[:, NODE:]
    return nodes, intervals


def describe(grid, point, status):
    """One sentence on how the solution ended, naming the worst equation and its node where it failed."""
    if status == "solved":
        return f"all equations hold to {point.error:.1e}"
    size = np.abs(point.gradient)
    worst = int(np.argmax(np.where(np.isfinite(size), size, np.inf)))
    k, place = divmod(worst, STRIDE)
    names = (*metadata["node"], *metadata["interval"])
    where = f"by {names[place]} at {'node' if place < NODE else 'interval'} {k}"
    return f"{status}: the derivative of the Lagrangian {where} is {point.gradient[worst]:.1e}; {REMEDIES[status]}"


def print_log(rows):
    """Print the iterations: cost, residual, stationarity, shift of the Hessian, step length."""
    print("iteration            cost   residual  stationarity     shift     step")
    for i, (cost, residual, stationarity, shift, length) in enumerate(rows):
        print(f"{i:9d} {cost:15.8g} {residual:10.2e} {stationarity:13.2e} {shift:9.1e} {length:8.1e}")
