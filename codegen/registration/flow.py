"""The flow: the generated solver that moves landmarks, and its kernels that carry any other point along.

A point x without momentum moves by x' = sum_j G(x, q_j) p_j and disturbs no landmark, so the motion of the landmarks,
once solved for, carries any number of points, forwards and backwards. A step of the scheme evaluates the field at
known states of the landmarks; the generated inverse of that step takes the points back.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError
from codegen.registration.pairs import PointArray

Array: TypeAlias = NDArray[np.float64]

SHARE = 2048
"""Least number of points for which a thread of its own pays."""


class CarryingModule(Protocol):
    """A generated module that connects landmarks and carries passive points; its `solve` is in `ConnectModule`."""

    metadata: Any
    make_case: Callable[..., Any]
    solve_case: Callable[..., Any]
    carry: Callable[..., tuple[PointArray, Array | None]]
    carry_points: Callable[..., None]
    stages_of: Callable[[Any, Array], Array]


@dataclass(frozen=True, eq=False)
class Flow:
    """The solved motion of landmarks in the disc, from t = 0 to 1 in equal steps.

    `path`, shape (N + 1, 2, n, 2), are the landmarks' places and momenta at the nodes; `stages` the states at which the
    scheme evaluates the field.
    """

    module: CarryingModule
    case: Any
    path: Array
    stages: Array

    @property
    def steps(self) -> int:
        """The number of steps N."""
        return len(self.path) - 1

    @property
    def momenta(self) -> Array:
        """The landmarks' initial momenta, shape (n, 2)."""
        return self.path[0, 1]

    def carry(self, points: PointArray, time: float = 1.0, backwards: bool = False) -> PointArray:
        """Where points of the disc, shape (n, 2), that start at time 0 are at `time`; or backwards, from `time` to 0.

        Points outside the disc stay where they are; NaN where an implicit step has no solution.
        """
        return self._carried(points, time, backwards, False)[0]

    def carry_with_jacobian(
        self, points: PointArray, time: float = 1.0, backwards: bool = False
    ) -> tuple[PointArray, Array]:
        """The same, and the derivative of each place by where it came from, shape (n, 2, 2)."""
        return self._carried(points, time, backwards, True)

    def _carried(self, points: PointArray, time: float, backwards: bool, derive: bool) -> tuple[PointArray, Array]:
        carried = np.array(points, dtype=np.float64, order="C")
        jacobians = np.empty((len(carried) if derive else 0, 2, 2))
        parts = self._parts(time)

        def work(rows: slice) -> None:
            own = jacobians[rows]
            for number, (first, last, h) in enumerate(reversed(parts) if backwards else parts):
                ends = (last, first) if backwards else (first, last)
                part = np.empty_like(own)
                self._carry_part(carried[rows], ends, h, part)
                own[:] = part if number == 0 else part @ own
            if not parts:
                own[:] = np.eye(2)

        _in_threads(work, len(carried))
        return carried, jacobians

    def _carry_part(self, points: PointArray, ends: tuple[int, int], h: float, jacobians: Array) -> None:
        case = self.case
        before = points.copy()
        self.module.carry_points(before, h, *ends, self.stages, case.own, case.parameters, points, jacobians)

    def _parts(self, time: float) -> list[tuple[int, int, float]]:
        """Whole steps up to a time, and the part of a step that is left: (first node, last node, length of a step)."""
        if not 0.0 <= time <= 1.0:
            raise LandmarkError(f"the time is {time!r}", "give a number from 0 to 1")
        h = self.case.duration / self.steps
        whole = min(self.steps, int(np.floor(time * self.steps + 1e-12)))
        left = time * self.steps - whole
        parts = [(0, whole, h)] if whole > 0 else []
        return parts + ([(whole, whole + 1, left * h)] if left > 1e-12 else [])


@cache
def workers() -> int:
    """The processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers(), thread_name_prefix="codegen-flow")


def _in_threads(work: Callable[[slice], None], count: int) -> None:
    """Share rows between threads, which run at the same time because generated kernels release Python's lock."""
    pieces = max(1, min(4 * workers(), count // SHARE))
    if workers() == 1 or pieces == 1:
        work(slice(0, count))
        return
    cuts = np.linspace(0, count, pieces + 1).astype(int)
    for _ in _pool().map(work, [slice(a, b) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]):
        pass
