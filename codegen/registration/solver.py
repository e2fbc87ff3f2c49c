"""The generated solver of registrations: where its problem is found, and how it is built, compiled and kept.

The problem file is in `problems/` of a checkout, and in `codegen/gallery/` where the package is installed. The
module that is derived from it goes to the build cache ($CODEGEN_CACHE_DIR, or a folder in the user's cache directory),
and its machine code beside it, so that only the first registration on a machine has to wait for either.

The flow: the generated solver that moves landmarks, and its kernels that carry any other point along. A point x without
momentum moves by x' = sum_j G(x, q_j) p_j and disturbs no landmark, so the motion of the landmarks, once solved for,
carries any number of points, forwards and backwards. They make the steps that the landmarks make, and on the way back
the exact inverses of these steps.

Many points are divided among threads. Generated kernels hold no lock while they run; and threads that live for one call
alone are safe in a server with several sessions, and in a process that forks, as a pool that numba keeps would not be.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ModuleError, NumericsError, SchemeError
from codegen.registration.pairs import PointArray
from codegen.runtime.record import ConnectRecord, Task
from codegen.solving.loading import load

_THREADS: ContextVar[int] = ContextVar("threads", default=os.cpu_count() or 1)
THREADED = 400_000
"""Velocities that one landmark gives to one point, from which on a second thread is worth its start."""


class FlowModule(Protocol):
    """What is used of a generated module that carries tracer points; a case is what `make_case` returns."""

    metadata: ConnectRecord

    solve_case: Callable[..., Any]
    make_case: Callable[..., Any]
    momenta_of: Callable[..., NDArray[np.float64]]
    momenta_of_least_action: Callable[[Any], NDArray[np.float64]]
    momentum_matrix: Callable[..., None]
    penalised: Callable[[Any, float, NDArray[np.float64]], float]
    misses_by_far: Callable[[Any, NDArray[np.float64]], bool]
    stages_of: Callable[[Any, Any], NDArray[np.float64]]
    carry: Callable[..., tuple[PointArray, Any]]
    POINTS: int
    BLOCK: int


def require_tracers(module: Any) -> FlowModule:
    """The same module, if it carries tracer points; ModuleError tells if it does not."""
    if module.metadata.task != Task.CONNECT or not module.metadata.passive:
        raise ModuleError("the module carries no points", "build it with --set passive=True")
    return cast(FlowModule, module)


@contextmanager
def threads_at_most(number: int) -> Iterator[None]:
    """Flows that are made here use at most so many threads, as where there is a process for every processor."""
    token = _THREADS.set(number)
    try:
        yield
    finally:
        _THREADS.reset(token)


@dataclass(frozen=True, eq=False)
class Flow:
    """The solved motion of landmarks in the disc, or in the ball, from t = 0 to 1 in equal steps.

    `path`, shape (N + 1, 2, n, d), are the landmarks' places and momenta at the nodes; `points` the states at which the
    scheme evaluates the field. `threads` is the most of them that work at once.
    """

    module: FlowModule
    case: Any
    path: NDArray[np.float64]
    points: NDArray[np.float64]
    threads: int = field(default_factory=_THREADS.get)

    @property
    def steps(self) -> int:
        """The number of steps N."""
        return len(self.path) - 1

    @property
    def velocities(self) -> NDArray[np.float64]:
        """The landmarks' velocities at the start, H_pp p, shape (n, d)."""
        places, momenta = self.path[0]
        matrix = np.empty((len(places), len(places)))
        self.module.momentum_matrix(self.path[0], self.case.own, self.case.parameters, matrix)
        return np.asarray(matrix @ momenta)

    def carry(self, points: PointArray, start: float = 0.0, stop: float = 1.0) -> PointArray:
        """Where points of the disc, shape (n, d), that are there at time `start` are at time `stop`.

        Points on the rim and outside stay where they are. A point becomes NaN when a step, too long for it, has no
        solution there. Raises NumericsError when points or times are unusable.
        """
        return self._carried(points, start, stop, False)[0]

    def carry_with_jacobian(
        self, points: PointArray, start: float = 0.0, stop: float = 1.0
    ) -> tuple[PointArray, NDArray[np.float64]]:
        """The same, and the derivative of each place by where it came from, shape (n, d, d)."""
        return self._carried(points, start, stop, True)

    def _carried(self, points: PointArray, start: float, stop: float, derive: bool) -> tuple[PointArray, Any]:
        points = np.ascontiguousarray(points, dtype=float)
        first, last = start * self.steps, stop * self.steps

        def part(some: PointArray) -> tuple[PointArray, Any]:
            return self.module.carry(self.case, self.points, some, first, last, derive)

        work = len(points) * abs(last - first) * self.module.POINTS * self.points.shape[2]
        try:
            if self.threads < 2 or work < THREADED:
                return part(points)
            part(points[:1])  # compiled, or read from disk, before several threads ask for it
            with ThreadPoolExecutor(self.threads) as pool:
                parts = list(pool.map(part, self._shares(points)))
        except ValueError as error:
            raise NumericsError(str(error), "give points, one a row, and times between 0 and 1") from error
        places = np.concatenate([places for places, _ in parts])
        return places, np.concatenate([jacobians for _, jacobians in parts]) if derive else None

    def _shares(self, points: PointArray) -> list[PointArray]:
        """The points for each thread: whole blocks, so that results do not depend on how many threads there are."""
        blocks = -(-len(points) // self.module.BLOCK)
        ends = [self.module.BLOCK * (blocks * k // self.threads) for k in range(1, self.threads)]
        return np.split(points, ends)


def of_steps(flow: Flow, gradients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bounds of |D Phi - I| of each step from those of the gradients at all stages, shape (N POINTS,)."""
    module: Any = flow.module
    h, found = flow.case.duration / flow.steps, np.zeros(flow.steps)
    for k, stages in enumerate(gradients.reshape(flow.steps, module.POINTS)):
        rates: list[float] = []
        for row, gradient in zip(module.ROWS, stages, strict=True):
            stretched = 1.0 + h * sum(abs(a) * rate for a, rate in zip(row, rates, strict=False))
            rates.append(float(gradient) * stretched)
        found[k] = h * sum(abs(b) * rate for b, rate in zip(module.WEIGHTS, rates, strict=True))
    return found


PROBLEM = "image_registration.py"
DEFAULT_SCHEME = "rk4"


def arguments_of(dimension: int) -> dict[str, str]:
    """The problem's arguments for pictures, in two dimensions, or volumes, in three."""
    return {"passive": "True"} if dimension == 2 else {"passive": "True", "dimension": str(dimension)}


def problem_file() -> Path:
    """The file of the problem whose module registers images; ModuleError when it is missing."""
    here = Path(__file__).parent
    for candidate in (here.parent / "gallery" / PROBLEM, here.parents[1] / "problems" / PROBLEM):
        if candidate.is_file():
            return candidate
    raise ModuleError(f"{PROBLEM} is missing from the installation", "install the package again")


def is_compiled(scheme: str = DEFAULT_SCHEME, dimension: int = 2) -> bool:
    """Whether the module of a scheme and its machine code are on disk, so that nobody has to wait for them."""
    from codegen.solving.cache import stored
    from codegen.solving.compiler import build
    from codegen.solving.machine_code.parts import has_machine_code

    if not stored(problem_file(), arguments_of(dimension), scheme=scheme).is_file():
        return False
    return has_machine_code(load(build(problem_file(), arguments_of(dimension), scheme=scheme).path))


@cache
def registration_module(scheme: str = DEFAULT_SCHEME, dimension: int = 2) -> FlowModule:
    """The generated module of a scheme, derived and compiled when it is needed for the first time on a machine.

    That is announced on stderr. Raises SchemeError for a scheme without fixed steps.
    """
    from codegen.solving.compiler import build
    from codegen.solving.machine_code.compilation import compile_all
    from codegen.solving.machine_code.parts import has_machine_code
    from codegen.solving.machine_code.processes import compilers

    made = build(problem_file(), arguments_of(dimension), scheme=scheme)
    module = require_tracers(load(made.path))
    if module.metadata.adaptive:
        raise SchemeError(f"scheme {scheme} chooses its own steps and carries no points", "use midpoint or rk4")
    if not has_machine_code(module):
        print("codegen: compiling the solver of registrations, once on this machine ...", file=sys.stderr)
        with compilers() as processes:
            processes.compile(made.path)
    compile_all(module)  # reads machine code, or makes what is missing, before anything is timed
    return module
