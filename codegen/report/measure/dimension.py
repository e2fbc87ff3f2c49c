"""How cost grows with the dimension of space and the number of landmarks (thesis, chapter 6)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from codegen.report.settings import Settings, smooth_pair
from codegen.report.store import Case, Store, Values

SECTION = "dimension"
COUNTS = (5, 10, 20, 50, 100, 200)
KERNELS = (("plate", 2), ("plate", 3), ("gauss", 2), ("gauss", 3))
WIDTH = 0.15
"""The Gaussian's; with wider ones the matrix of the kernel loses all digits for many landmarks."""


def cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Explicit Euler steps, N = 10, with the Gaussian and the plate's kernel in the plane and in space."""
    del store
    for kernel, dimension in (("plate", 2),) if settings.quick else KERNELS:
        for count in COUNTS[:4] if settings.quick else COUNTS:
            name = f"{kernel} {dimension}-D; nc {count}"
            yield Case(SECTION, name, lambda k=kernel, d=dimension, n=count: _solved(settings, k, d, n))  # type: ignore[misc]


def arguments(kernel: str, dimension: int) -> dict[str, str]:
    """What --set says for a kernel and a dimension; nothing for the defaults."""
    found = {"kernel": kernel} if kernel != "plate" else {}
    return found | ({"dimension": str(dimension)} if dimension != 2 else {})


def _solved(settings: Settings, kernel: str, dimension: int, count: int) -> Values:
    module: Any = settings.module("explicit-euler", **arguments(kernel, dimension))
    points = smooth_pair(count, dimension)
    case = module.make_case(points.start, points.target, 10, **({"width": WIDTH} if kernel == "gauss" else {}))
    solution = module.solve_case(case)
    momenta = solution.p[0]
    repeats = 3 if count < 100 else 1
    return {
        "status": solution.status,
        "residual": solution.residual,
        "iterations": solution.iterations,
        "seconds": least_time(lambda: module.solve_case(case), repeats),
        "seconds of a trajectory": least_time(lambda: module.trajectory(case, momenta), 20),
        "operations": list(module.metadata.operations["hamiltonian_gradient"]),
    }


def least_time(run: Callable[[], Any], repeats: int) -> float:
    """The least processor time of several warm runs, in seconds; other work on the machine lengthens it little."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return min(times)
