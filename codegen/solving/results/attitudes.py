"""Attitudes of a result as matrices, angular velocities in the frames of the bodies, and vectors.

The columns of an attitude are a unit quaternion q = (w, x, y, z). A simulation has the energy H(q, p) as a function of
momenta, and the momentum p = 2 q pi of the quaternion contains the angular momentum pi in the frame of the body. So the
angular velocity is dH/dpi. The energy is quadratic in the momenta, so that a central difference has no error but
rounding. An optimum has no such function. Its angular velocity during a step follows from the increment of the
attitude, and its value at a node is the mean of both steps, which has order 2 like the schemes for rotations.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError
from codegen.runtime.record import Task

Array = NDArray[np.float64]
_PARTS = "wxyz"


def columns_of(result: Any) -> dict[str, list[int]]:
    """Return the numbers of the four columns of `q` of each attitude by name.

    With several bodies, the name of an attitude ends with the number of its body.
    """
    found, names = dict[str, list[int]](), result.names["q"] if result.attitudes else ()
    for attitude in result.attitudes:
        for ending in (own.removeprefix(f"{attitude}_w") for own in names if own.startswith(f"{attitude}_w")):
            parts = [f"{attitude}_{part}{ending}" for part in _PARTS]
            if set(parts) <= {*names}:
                found[attitude + ending] = [names.index(part) for part in parts]
    return found


def angular_velocity_names(result: Any) -> dict[str, str]:
    """Return the attitude of each angular velocity by name: `omega`, or `omega_<attitude>` with several attitudes."""
    attitudes = [*columns_of(result)] if result.attitudes and result.names["p"] else []
    return {"omega": attitudes[0]} if len(attitudes) == 1 else {f"omega_{name}": name for name in attitudes}


def matrices(result: Any, name: str) -> Array:
    """Return the attitude `name` at the nodes (M + 1, 3, 3): rotations from the frame of the body to that of space."""
    q = result.q[:, columns_of(result)[name]]
    w, v = q[:, 0], q[:, 1:]
    cross = np.zeros((len(q), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = v
    cross[:, [1, 2, 0], [2, 0, 1]] = -v
    squares = (q**2).sum(axis=1)[:, None, None]
    real = (w**2 - (v**2).sum(axis=1))[:, None, None] * np.eye(3)
    return np.asarray((real + 2.0 * v[:, :, None] * v[:, None, :] + 2.0 * w[:, None, None] * cross) / squares)


def angular_velocity(result: Any, name: str) -> Array:
    """Return the angular velocity of the attitude `name` at the nodes (M + 1, 3), in the frame of the body."""
    columns = columns_of(result)[name]
    return _of_energy(result, columns) if result.task == Task.SIMULATE else _of_increments(result, columns)


def vector(result: Any, name: str) -> Array | None:
    """Return the vector (M + 1, 3) whose components are called `name` and _x, _y and _z; None if there are none."""
    parts = [f"{name}_{part}" for part in _PARTS[1:]]
    for key, names in result.names.items():
        if {*parts} <= {*names}:
            return np.asarray(getattr(result, key)[:, [names.index(part) for part in parts]])
    return None


def _of_energy(result: Any, columns: list[int]) -> Array:
    from codegen.runtime.stepping.steps import energies  # imports numba

    if result.background is None:
        raise ArgumentError(f"{result.problem}: this solution does not know its module", "solve by codegen.solve")
    module: Any = result.background.loaded(result.parameters)
    parameters = module.make_grid(result.steps).parameters
    path, times = np.hstack([result.q, result.p]), np.ascontiguousarray(result.t)
    q, momenta = result.q[:, columns], [result.q.shape[1] + column for column in columns]
    size = max(1e-3, float(np.abs(result.p[:, columns]).max()))
    omega = np.empty((len(path), 3))
    for axis in range(3):
        unit = np.zeros(4)
        unit[1 + axis] = 1.0
        found = []
        for sign in (1.0, -1.0):
            moved = path.copy()
            moved[:, momenta] += 2.0 * sign * size * _product(q, unit[None])
            values = np.empty(len(path))
            energies(module.problem.energy.address, moved, times, parameters, values)
            found.append(values)
        omega[:, axis] = (found[0] - found[1]) / (2.0 * size)
    return omega


def _of_increments(result: Any, columns: list[int]) -> Array:
    q, h = result.q[:, columns], np.diff(result.t)[:, None]
    increment = _product(q[:-1] * [1.0, -1.0, -1.0, -1.0], q[1:])
    # A step of the midpoint rule turns by tau(h omega), and the quaternion of tau is (1, h omega/4)^2, normalised.
    steps = 4.0 * increment[:, 1:] / (np.linalg.norm(increment, axis=1)[:, None] + increment[:, :1]) / h
    if len(steps) == 1:
        return np.repeat(steps, 2, axis=0)
    ends = steps[[0, -1]] + (steps[[0, -1]] - steps[[1, -2]]) * h[[0, -1]] / (h[[0, -1]] + h[[1, -2]])
    middle = (steps[:-1] * h[1:] + steps[1:] * h[:-1]) / (h[:-1] + h[1:])
    return np.vstack([ends[:1], middle, ends[1:]])


def _product(a: Array, b: Array) -> Array:
    """Return the products of the quaternions in the rows of two arrays."""
    w, v, c, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    return np.hstack([w * c - (v * u).sum(axis=1, keepdims=True), w * u + c * v + np.cross(v, u)])
