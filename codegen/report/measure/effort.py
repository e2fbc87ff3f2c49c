"""Can midpoint stepping be efficient: the thesis's nested root finders beside tangents of implicit steps."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.optimize import fsolve

from codegen.author.points import PointSet
from codegen.drivers.quiet import quiet_single_thread
from codegen.interfaces import ConnectModule
from codegen.report.measure.accuracy import points_of
from codegen.report.measure.dimension import least_time
from codegen.report.settings import Settings
from codegen.report.store import Case, Store, Values

SECTION = "midpoint effort"


def cases(settings: Settings, store: Store) -> Iterator[Case]:
    """The nested solve on few landmarks, ours on these and on forty."""
    del store
    if settings.quick:
        return
    for count in (*settings.counts, 40):
        yield Case(SECTION, f"generated; nc {count}", lambda c=count: _generated(settings, c))  # type: ignore[misc]
    for count in settings.counts:
        yield Case(SECTION, f"nested fsolve; nc {count}", lambda c=count: _nested(settings, c))  # type: ignore[misc]


def _generated(settings: Settings, count: int) -> Values:
    found: dict[str, Any] = {}
    points = points_of(settings, count)
    for scheme in ("midpoint", "explicit-euler"):
        module = settings.module(scheme)
        case = module.make_case(points.start, points.target, 10)
        solution = module.solve_case(case)
        found[f"{scheme} seconds"] = least_time(lambda m=module, c=case: m.solve_case(c), 5)  # type: ignore[misc]
        found[f"{scheme} trajectory"] = least_time(lambda m=module, c=case, p=solution.p[0]: m.trajectory(c, p), 20)  # type: ignore[misc]
        found[f"{scheme} cost"], found[f"{scheme} status"] = solution.cost, solution.status
    return found


def _nested(settings: Settings, count: int) -> Values:
    """As the thesis did it: fsolve for the initial momenta, and inside it fsolve for every implicit step."""
    module, points = settings.module("midpoint"), points_of(settings, count)
    case = module.make_case(points.start, points.target, 10)
    first = module.first_momenta(case).ravel()
    begin = time.process_time()
    with quiet_single_thread():
        found = fsolve(lambda p: _arrival(module, case, points, p), first, xtol=1e-8)
    seconds = time.process_time() - begin
    return {"seconds": seconds, "residual": float(np.abs(module.residual(case, found)).max())}


def _arrival(module: ConnectModule, case: Any, points: PointSet, momenta: Any) -> Any:
    """Where midpoint steps arrive whose equations fsolve solves, with Jacobians by differences."""
    state, gradient = np.stack([points.start, momenta.reshape(points.start.shape)]), np.empty((2, *points.start.shape))
    h = case.duration / case.steps

    def equations(after: Any, before: Any) -> Any:
        middle = 0.5 * (before + after.reshape(before.shape))
        module.hamiltonian_gradient(middle, case.own, case.parameters, gradient)
        return (after.reshape(before.shape) - before - h * np.stack([gradient[1], -gradient[0]])).ravel()

    for _ in range(case.steps):
        state = fsolve(equations, state.ravel(), args=(state,), xtol=1e-8).reshape(state.shape)
    return (state[0] - points.target).ravel()
