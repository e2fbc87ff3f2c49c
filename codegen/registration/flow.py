"""The flow: the generated solver that moves landmarks, and its kernels that carry any other point along.

A point x without momentum moves by x' = sum_j G(x, q_j) p_j and disturbs no landmark, so the motion of the landmarks,
once solved for, carries any number of points, forwards and backwards. A step of the scheme evaluates the field at
known states of the landmarks; the same step with the opposite sign takes the points back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from codegen.errors import ModuleError
from codegen.load import ConnectModule, load
from codegen.registration.pairs import PointArray

PROBLEM = "image_registration.py"


def problem_file() -> Path:
    """The problem whose module registers images: beside this file where it is installed, or in a checkout."""
    folder = Path(__file__).parent
    for candidate in (folder / "problem" / PROBLEM, folder.parents[1] / "problems" / PROBLEM):
        if candidate.is_file():
            return candidate
    raise ModuleError(f"{PROBLEM} is missing from the installation", "install the package again")


@cache
def registration_module(scheme: str = "midpoint") -> ConnectModule:
    """The generated module of a scheme, derived when it is needed for the first time."""
    from codegen.compiler import build

    return cast(ConnectModule, load(build(problem_file(), scheme=scheme).path))


@dataclass(frozen=True, eq=False)
class Flow:
    """The solved motion of landmarks in the disc, from t = 0 to 1 in equal steps.

    `path`, shape (N + 1, 2, n, 2), are the landmarks' places and momenta at the nodes; `points` the states at which the
    scheme evaluates the field.
    """

    module: Any
    case: Any
    path: NDArray[np.float64]
    points: NDArray[np.float64]

    @property
    def steps(self) -> int:
        """The number of steps N."""
        return len(self.path) - 1

    def carry(self, points: PointArray, start: float = 0.0, stop: float = 1.0) -> PointArray:
        """Where points of the disc, shape (n, 2), that are there at time `start` are at time `stop`."""
        ends: PointArray = self._carried(points, start, stop, False)[0]
        return ends

    def carry_with_jacobian(
        self, points: PointArray, start: float = 0.0, stop: float = 1.0
    ) -> tuple[PointArray, NDArray[np.float64]]:
        """The same, and the derivative of each place by where it came from, shape (n, 2, 2)."""
        return self._carried(points, start, stop, True)

    def _carried(
        self, points: PointArray, start: float, stop: float, derive: bool
    ) -> tuple[PointArray, NDArray[np.float64]]:
        ends = np.array(points)
        jacobians = np.tile(np.eye(2), (len(ends) if derive else 0, 1, 1))
        fractions = _fractions(self.steps, start, stop)
        order = range(self.steps) if stop >= start else range(self.steps - 1, -1, -1)
        substeps = np.array([(f, a) for f, a, _ in self.module.SUBSTEPS])
        for k in order:
            if fractions[k] == 0.0:
                continue
            stages = self.points[k * len(substeps) : (k + 1) * len(substeps)]
            places, momenta = np.ascontiguousarray(stages[:, 0]), np.ascontiguousarray(stages[:, 1])
            _carry(places, momenta, substeps, fractions[k] / self.steps, ends, jacobians)
        return ends, jacobians


def _fractions(steps: int, start: float, stop: float) -> NDArray[np.float64]:
    """What share of each step lies between two times, negative on the way back."""
    low, high = min(start, stop), max(start, stop)
    nodes = np.arange(steps + 1)
    share = np.minimum(high * steps, nodes[1:]) - np.maximum(low * steps, nodes[:-1])
    return np.asarray(np.clip(share, 0.0, 1.0) * (1.0 if stop >= start else -1.0))


@njit(cache=True, parallel=True)
def _carry(places, momenta, substeps, h, ends, jacobians):  # type: ignore[no-untyped-def]
    for row in prange(ends.shape[0]):
        for number in range(len(substeps)):
            s = number if h > 0.0 else len(substeps) - 1 - number
            step, a = h * substeps[s, 0], substeps[s, 1] if h > 0.0 else 1.0 - substeps[s, 1]
            x0, y0 = ends[row, 0], ends[row, 1]
            dx, dy = 0.0, 0.0
            xx = xy = yx = yy = 0.0
            for _ in range(100):
                x, y = x0 + a * dx, y0 + a * dy
                u = v = xx = xy = yx = yy = 0.0
                alpha = 1.0 - x * x - y * y
                if alpha > 0.0:
                    for j in range(places.shape[1]):
                        ex, ey = x - places[s, j, 0], y - places[s, j, 1]
                        beta = 1.0 - places[s, j, 0] ** 2 - places[s, j, 1] ** 2
                        d = ex * ex + ey * ey + 1e-300
                        log = math.log1p(alpha * beta / d)
                        green = 0.5 * (alpha * beta - d * log)
                        u += green * momenta[s, j, 0]
                        v += green * momenta[s, j, 1]
                        by_d = 0.5 * (alpha * beta / (d + alpha * beta) - log)
                        by_alpha = 0.5 * beta * alpha * beta / (d + alpha * beta)
                        gx, gy = 2.0 * by_d * ex - 2.0 * by_alpha * x, 2.0 * by_d * ey - 2.0 * by_alpha * y
                        xx += gx * momenta[s, j, 0]
                        xy += gy * momenta[s, j, 0]
                        yx += gx * momenta[s, j, 1]
                        yy += gy * momenta[s, j, 1]
                change = max(abs(step * u - dx), abs(step * v - dy))
                dx, dy = step * u, step * v
                if a == 0.0 or change <= 1e-15:
                    break
            ends[row, 0], ends[row, 1] = x0 + dx, y0 + dy
            if jacobians.shape[0] > 0:
                derivative = np.array([[xx, xy], [yx, yy]])
                right = np.eye(2) + (1.0 - a) * step * derivative
                left = np.eye(2) - a * step * derivative
                jacobians[row] = np.linalg.solve(left, right @ jacobians[row])
