"""Nonlinear programs in numpy, solved by SLSQP with complex steps: a yardstick that shares nothing with codegen.

A test writes out a discrete problem of several phases by hand, each phase with nodes and controls of its own, in
functions of one flat vector that also take complex numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import minimize

Function = Callable[[np.ndarray], np.ndarray]


class Variables:
    """Named parts of a flat vector: `shapes` maps names to shapes."""

    def __init__(self, **shapes: tuple[int, ...]) -> None:
        self.shapes, self.size = shapes, sum(int(np.prod(shape)) for shape in shapes.values())

    def parts(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """The parts by their names."""
        out, first = {}, 0
        for name, shape in self.shapes.items():
            out[name] = z[first : first + int(np.prod(shape))].reshape(shape)
            first += int(np.prod(shape))
        return out

    def flat(self, **values: object) -> np.ndarray:
        """A vector with the given values, numbers or arrays, and zeros where none is given."""
        full = [np.broadcast_to(values.get(name, 0.0), shape) for name, shape in self.shapes.items()]
        return np.concatenate([np.ravel(part) for part in full]).astype(float)


def complex_jacobian(function: Function, z: np.ndarray) -> np.ndarray:
    """Derivatives without rounding errors; source: Squire and Trapp (1998)."""
    columns = [function(z + 1e-30j * unit).imag / 1e-30 for unit in np.eye(z.size)]
    return np.stack([np.atleast_1d(column) for column in columns], axis=-1)


def midpoint_steps(x: np.ndarray, u: np.ndarray, h: object, start: object, rate: Callable[..., Sequence]) -> np.ndarray:
    """Residuals of the midpoint rule for x' = rate(x, u, t) on one phase; columns are states."""
    middle = (x[:-1] + x[1:]) / 2
    t = start + h * (np.arange(len(x) - 1) + 0.5)
    return (x[1:] - x[:-1] - h * np.stack(np.broadcast_arrays(*rate(middle.T, u.T, t)), axis=-1)).ravel()


def least(cost: Function, equations: Function, inequalities: Function, start: np.ndarray) -> tuple[float, np.ndarray]:
    """The least cost with equations = 0 and inequalities <= 0, and where; AssertionError unless SLSQP succeeds."""
    constraints = [
        {"type": "eq", "fun": lambda z: equations(z).real, "jac": lambda z: complex_jacobian(equations, z)},
        {"type": "ineq", "fun": lambda z: -inequalities(z).real, "jac": lambda z: -complex_jacobian(inequalities, z)},
    ]
    result = minimize(
        lambda z: float(np.real(cost(z))),
        start,
        jac=lambda z: complex_jacobian(cost, z)[0],
        method="SLSQP",
        constraints=constraints,
        options={"maxiter": 500, "ftol": 1e-14},
    )
    assert result.success, result.message
    return float(result.fun), result.x
