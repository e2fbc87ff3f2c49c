"""Measured attitudes of controllers: their names, their lengths, and the sign of their quaternions.

q and -q are the same attitude, and an estimator may return either. A plan from the other one would turn the body by a
further whole turn. So the sign of a measured quaternion is that of the state before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codegen.errors import NumericsError

Vector = NDArray[np.float64]
_PARTS = "wxyz"
_NEARLY = 0.1
"""Largest deviation of the length of a measured quaternion from one, or of a matrix from orthogonality."""


@dataclass(frozen=True)
class Attitudes:
    """The attitudes among measured states: for each name, the indices of its quaternion and of the rates, if any."""

    states: tuple[str, ...]
    indices: Mapping[str, tuple[list[int], list[int]]]

    def by_state(self, values: object) -> object:
        """Return a measurement with the keys `R` and `omega` replaced by those of the states.

        The values of these keys are a rotation matrix (3, 3), and the angular velocity (3,) in the frame of the body.
        """
        if not isinstance(values, Mapping) or not self.indices:
            return values
        measured = dict(values)
        for name, (quaternion, rates) in self.indices.items():
            if name not in measured:
                continue
            q = _of_matrix(measured.pop(name), name)
            measured |= dict(zip((self.states[i] for i in quaternion), q, strict=True))
            spin = "omega" if len(self.indices) == 1 else f"omega_{name}"
            if rates and spin in measured:
                w = np.array(measured.pop(spin), dtype=float)
                if w.shape != (3,):
                    raise NumericsError(f"{spin} has shape {w.shape}, expected (3,)", "give the angular velocity")
                dq = np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))]) / 2
                measured |= dict(zip((self.states[i] for i in rates), dq, strict=True))
        return measured

    def aligned(self, state: Vector, before: Vector) -> Vector:
        """Return a state whose quaternions have length one, rates across it, and the sign of the state `before`.

        Raises NumericsError for a quaternion whose length is far from one.
        """
        state = state.copy()
        for name, (quaternion, rates) in self.indices.items():
            length = float(np.linalg.norm(state[quaternion]))
            if abs(length - 1.0) > _NEARLY:
                raise NumericsError(f"the quaternion of {name} has the length {length:.6g}", "give length one")
            sign = -1.0 if state[quaternion] @ before[quaternion] < 0.0 else 1.0
            state[quaternion] *= sign / length
            if rates:
                q = state[quaternion]
                state[rates] *= sign / length
                state[rates] -= (q @ state[rates]) * q
        return state


def attitudes_of(names: tuple[str, ...], states: tuple[str, ...]) -> Attitudes:
    """Return the attitudes with the given names whose quaternions are among the states of a controller."""
    indices = dict[str, tuple[list[int], list[int]]]()
    for name in names:
        parts = [f"{name}_{part}" for part in _PARTS]
        if {*parts} <= {*states}:
            rates = [f"d{part}" for part in parts]
            has_rates = {*rates} <= {*states}
            indices[name] = [*map(states.index, parts)], [*map(states.index, rates)] if has_rates else []
    return Attitudes(states, indices)


def _of_matrix(value: object, name: str) -> Vector:
    """Return the quaternion of the rotation that is nearest to a matrix (Bar-Itzhack 2000)."""
    remedy = "give a rotation matrix (3, 3)"
    try:
        R = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise NumericsError(f"{name} is no matrix", remedy) from None
    if R.shape != (3, 3):
        raise NumericsError(f"{name} has shape {R.shape}, expected (3, 3)", remedy)
    if not np.all(np.isfinite(R)):
        return np.full(4, np.nan)
    if np.abs(R.T @ R - np.eye(3)).max() > _NEARLY or np.linalg.det(R) < 0.0:
        raise NumericsError(f"{name} is no rotation", remedy)
    K = np.empty((4, 4))
    K[0, 0] = np.trace(R)
    K[0, 1:] = K[1:, 0] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    K[1:, 1:] = R + R.T - np.trace(R) * np.eye(3)
    return np.asarray(np.linalg.eigh(K)[1][:, -1])
