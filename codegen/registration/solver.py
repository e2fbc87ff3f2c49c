"""The generated solver of registrations: its problem file, its compilation, and the flow of its solution.

The problem file is in `problems/` of a checkout, and in `codegen/gallery/` of an installation from a wheel. The
generated module is stored in the build cache ($CODEGEN_CACHE_DIR, or a folder in the cache directory of the user)
together with its machine code. So only the first registration on a machine derives and compiles the module.

The flow: the generated solver moves landmarks, and its kernels carry any other point. A point x without momentum moves
by x' = sum_j G(x, q_j) p_j and has no effect on landmarks. So the solved motion of the landmarks carries any number of
points, forwards and backwards. Forwards, points take the same steps as landmarks; backwards, the exact inverse steps.

Many points are divided among threads, because generated kernels hold no lock. Threads that live for one call are safe
in a server with several sessions and in a process that forks. The thread pool of numba is not safe there.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ModuleError, NumericsError, SchemeError
from codegen.registration.pairs import PointArray
from codegen.solving.loading import Case, ConnectModule, GeneratedModule, is_connect, load

_THREADS: ContextVar[int] = ContextVar("threads", default=os.cpu_count() or 1)
THREADED = 400_000  # number of evaluations of the Green's function above which several threads are used


class FlowCase(Case, Protocol):
    """The data of a problem, a named tuple from `make_case` of the module; start and target have shape (m, d)."""

    _replace: Callable[..., FlowCase]


class FlowModule(ConnectModule, Protocol):
    """A generated module that carries tracer points; modules of implicit schemes lack the last three members."""

    __file__: str
    make_case: Callable[..., FlowCase]
    momenta_of: Callable[..., NDArray[np.float64]]
    momenta_of_least_action: Callable[[FlowCase], NDArray[np.float64]]
    penalised: Callable[[FlowCase, float, NDArray[np.float64]], float]
    stages_of: Callable[[FlowCase, NDArray[np.float64]], NDArray[np.float64]]
    carry: Callable[..., tuple[PointArray, NDArray[np.float64]]]
    BLOCK: int
    ROWS: Sequence[Sequence[float]]
    WEIGHTS: Sequence[float]
    tracer_gradient: Callable[..., None]


def require_tracers(module: GeneratedModule) -> FlowModule:
    """Return the module if it carries tracer points; raise ModuleError otherwise."""
    if not is_connect(module) or not module.metadata.passive:
        raise ModuleError("the module carries no points", "build it with --set passive=True")
    return cast(FlowModule, module)


@contextmanager
def threads_at_most(number: int) -> Iterator[None]:
    """Limit the threads of each flow that is created in this context, for instance if every core has a process."""
    token = _THREADS.set(number)
    try:
        yield
    finally:
        _THREADS.reset(token)


@dataclass(frozen=True, eq=False)
class Flow:
    """The solved motion of landmarks in the disc, or in the ball, from t = 0 to 1 in N equal steps.

    `path`, shape (N + 1, 2, n, d), has the positions and momenta of the landmarks at the nodes. `points`, shape
    (N POINTS, 2, n, d), has positions and momenta at all stages of the scheme. `threads` is the largest number used.
    """

    module: FlowModule
    case: FlowCase
    path: NDArray[np.float64]
    points: NDArray[np.float64]
    threads: int = field(default_factory=_THREADS.get)

    @property
    def steps(self) -> int:
        """The number of steps N."""
        return len(self.path) - 1

    @property
    def velocities(self) -> NDArray[np.float64]:
        """The initial velocities of the landmarks, H_pp p, shape (n, d)."""
        places, momenta = self.path[0]
        matrix = np.empty((len(places), len(places)))
        self.module.momentum_matrix(self.path[0], self.case.own, self.case.parameters, matrix)
        return np.asarray(matrix @ momenta)

    def carry(self, points: PointArray, start: float = 0.0, stop: float = 1.0) -> PointArray:
        """Return the final positions of `carry_with_jacobian`, without derivatives."""
        return self.carry_with_jacobian(points, start, stop, derive=False)[0]

    def carry_with_jacobian(
        self, points: PointArray, start: float = 0.0, stop: float = 1.0, derive: bool = True
    ) -> tuple[PointArray, NDArray[np.float64]]:
        """Carry points of the disc, shape (n, d), from time `start` to time `stop`.

        Return the final positions and, unless `derive` is False, their derivatives with respect to the initial
        positions, shape (n, d, d). Points on the rim and outside do not move. A point becomes NaN if the equations of a
        long step have no solution there. Raise NumericsError for unusable points or times.
        """
        points = np.ascontiguousarray(points, dtype=float)
        first, last = start * self.steps, stop * self.steps

        def part(some: PointArray) -> tuple[PointArray, NDArray[np.float64]]:
            return self.module.carry(self.case, self.points, some, first, last, derive)

        work = len(points) * abs(last - first) * self.module.POINTS * self.points.shape[2]
        try:
            if self.threads < 2 or work < THREADED:
                return part(points)
            part(points[:1])  # compiles the kernel, or reads it from disk, before several threads use it
            # Each thread gets whole blocks, so that results do not depend on the number of threads.
            blocks = -(-len(points) // self.module.BLOCK)
            ends = [self.module.BLOCK * (blocks * k // self.threads) for k in range(1, self.threads)]
            with ThreadPoolExecutor(self.threads) as pool:
                parts = list(pool.map(part, np.split(points, ends)))
        except ValueError as error:
            raise NumericsError(str(error), "give points, one a row, and times between 0 and 1") from error
        places = np.concatenate([places for places, _ in parts])
        return places, np.concatenate([jacobians for _, jacobians in parts]) if derive else parts[0][1]


def of_steps(flow: Flow, gradients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bound |D Phi - I| for each step Phi, shape (N,), by bounds of velocity gradients at stages, shape (N POINTS,)."""
    module = flow.module
    h, bounds = flow.case.duration / flow.steps, np.zeros(flow.steps)
    for k, stages in enumerate(gradients.reshape(flow.steps, module.POINTS)):
        rates: list[float] = []
        for row, gradient in zip(module.ROWS, stages, strict=True):
            stretched = 1.0 + h * sum(abs(a) * rate for a, rate in zip(row, rates, strict=False))
            rates.append(float(gradient) * stretched)
        bounds[k] = h * sum(abs(b) * rate for b, rate in zip(module.WEIGHTS, rates, strict=True))
    return bounds


PROBLEM = "image_registration.py"
DEFAULT_SCHEME = "rk4"


def arguments_of(dimension: int) -> dict[str, str]:
    """Return the arguments of the problem file for pictures (`dimension` 2) or volumes (3)."""
    return {"passive": "True"} if dimension == 2 else {"passive": "True", "dimension": str(dimension)}


def problem_file() -> Path:
    """Return the path of the problem file; raise ModuleError if the file is missing."""
    folder = Path(__file__).parent
    for candidate in (folder.parent / "gallery" / PROBLEM, folder.parents[1] / "problems" / PROBLEM):
        if candidate.is_file():
            return candidate
    raise ModuleError(f"{PROBLEM} is missing from the installation", "install the package again")


def is_compiled(scheme: str = DEFAULT_SCHEME, dimension: int = 2) -> bool:
    """Return True if the generated module of a scheme and its machine code are on disk."""
    from codegen.solving.compiler import build, stored
    from codegen.solving.machine_code.compilation import has_machine_code

    if not stored(problem_file(), arguments_of(dimension), scheme=scheme).is_file():
        return False
    return has_machine_code(load(build(problem_file(), arguments_of(dimension), scheme=scheme).path))


@cache
def registration_module(scheme: str = DEFAULT_SCHEME, dimension: int = 2) -> FlowModule:
    """Return the generated module of a scheme; the first call on a machine derives and compiles the module.

    Announce the compilation on stderr. Raise SchemeError for a scheme without fixed steps.
    """
    from codegen.solving.compiler import build
    from codegen.solving.machine_code.compilation import compile_all, has_machine_code
    from codegen.solving.machine_code.processes import compilers

    made = build(problem_file(), arguments_of(dimension), scheme=scheme)
    module = require_tracers(load(made.path))
    if module.metadata.adaptive:
        raise SchemeError(f"scheme {scheme} chooses its own steps and carries no points", "use midpoint or rk4")
    if not has_machine_code(module):
        print("codegen: compiling the solver of registrations, once on this machine ...", file=sys.stderr)
        with compilers() as processes:
            processes.compile(made.path)
    compile_all(module)  # reads machine code, or compiles missing kernels, before anything is timed
    return module
