"""The thesis's section 5.3: errors in cost against an adaptive reference, on few landmarks and on forty."""

from __future__ import annotations

from collections.abc import Iterator

from codegen import solving
from codegen.author.points import PointSet
from codegen.report.settings import Settings, few_landmarks
from codegen.report.store import Case, Store, Values

REFERENCES, TABLE, TOLERANCES, WORK = "references", "table 5.2", "tolerances", "work and precision"
EXACT = 1e-13
"""The tolerance of the reference, by dop853; the thesis's was 2.24e-14, by ode113."""
THESIS_TABLE = {"midpoint": (9399.0, 1.729e-3), "lsoda 1e-02": (63.30, 2.803e-6), "explicit-euler": (19.14, 3.751e-3)}
"""Seconds and error in cost of Table 5.2; lsoda stands for Matlab's ode113 at the tolerance that it had there."""
ROWS = ("midpoint", "lsoda 1e-02", "explicit-euler", "dop853 1e-06", "symplectic-euler", "rk4")
SCHEMES = ("explicit-euler", "symplectic-euler", "midpoint", "stormer-verlet", "rk4")


def cases(settings: Settings, store: Store) -> Iterator[Case]:
    """References, the rows of Table 5.2, the sweep of tolerances, and error against time of every scheme."""
    del store
    for count in (*settings.counts, 40):
        yield Case(REFERENCES, f"nc {count}", lambda count=count: _reference(settings, count))  # type: ignore[misc]
        if count != 40:
            yield Case(TABLE, f"lsoda 1e-06; nc {count}", lambda c=count: _row(settings, "lsoda 1e-06", c))  # type: ignore[misc]
    for row in ROWS[:3] if settings.quick else ROWS:
        yield Case(TABLE, f"{row}; nc 40", lambda row=row: _row(settings, row, 40))  # type: ignore[misc]
    for code in ("lsoda",) if settings.quick else ("lsoda", "dop853"):
        for tolerance in tolerances(settings.quick):
            name = f"{code} {tolerance:.1e}"
            yield Case(TOLERANCES, name, lambda c=code, t=tolerance: _adaptive(settings, c, t, 40))  # type: ignore[misc]
    if settings.quick:
        return
    for scheme in SCHEMES:
        for steps in (5, 10, 20, 40, 80):
            name = f"{scheme}; N {steps}"
            yield Case(WORK, name, lambda s=scheme, n=steps: _stepped(settings, s, 40, n))  # type: ignore[misc]


def tolerances(quick: bool) -> list[float]:
    """The thesis's 1e-2, 7.5e-3, 5e-3, 2.5e-3, 1e-3 ... 1e-6, then powers of ten down to 1e-12."""
    if quick:
        return [1e-2, 1e-4, 1e-6]
    found = [factor * 10.0**power for power in (-3, -4, -5, -6) for factor in (10.0, 7.5, 5.0, 2.5)]
    return [*found, *(10.0**-power for power in range(6, 13))]


def points_of(settings: Settings, count: int) -> PointSet:
    """The trilobites' forty landmarks, or few random ones."""
    return settings.landmarks if count == 40 else few_landmarks(count)


def _reference(settings: Settings, count: int) -> Values:
    result = solving.solve(settings.module("dop853"), points=points_of(settings, count), tolerance=EXACT)
    values = {"cost": result.cost, "residual": result.residual, "status": result.status}
    return {**values, "path": result.q.reshape(result.steps + 1, -1, 2), "drift": result.summary["energy_drift"]}


def _row(settings: Settings, row: str, count: int) -> Values:
    scheme, _, tolerance = row.partition(" ")
    if tolerance:
        return _adaptive(settings, scheme, float(tolerance), count)
    return _stepped(settings, scheme, count, 10)


def _adaptive(settings: Settings, code: str, tolerance: float, count: int) -> Values:
    points = points_of(settings, count)
    result = solving.solve(settings.module(code), points=points, tolerance=tolerance, repeat=1)
    return {
        "cost": result.cost,
        "residual": result.residual,
        "seconds": result.seconds_solve,
        "status": result.status,
        "tolerance": tolerance,
    }


def _stepped(settings: Settings, scheme: str, count: int, steps: int) -> Values:
    result = solving.solve(settings.module(scheme), points=points_of(settings, count), steps=steps, repeat=5)
    return {
        "cost": result.cost,
        "residual": result.residual,
        "seconds": result.seconds_solve,
        "status": result.status,
        "iterations": result.iterations,
        "steps": steps,
    }
