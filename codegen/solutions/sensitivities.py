"""Sensitivities of a solution: its derivatives by parameters, boundary values and a given duration, by name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from codegen.errors import ArgumentError
from codegen.loading import Grid, Vector, time_grid
from codegen.solutions.derivatives import Derivatives, Sensitivities
from codegen.solutions.result import Result
from codegen.solutions.segments import put_together, segments_of

SHARP = 1e-12
"""The tolerance to which solutions are found again that have no sensitivities."""


def require_sensitive(module: Any) -> None:
    """Refuse a module without what sensitivities need; ArgumentError says how it is made."""
    task, problem = module.metadata["task"], module.metadata["problem"]
    if task == "control" and "sensitivities" not in module.metadata:
        finding = f"the module of {problem} has no sensitivities"
        raise ArgumentError(finding, "build it with --sensitivities, or give the problem file")


def with_sensitivities(result: Result, module: Any, given: tuple[str, ...] = ()) -> Result:
    """The result of a module, not yet put together of segments, with its sensitivities.

    Quantities that are `given` by name follow no others.
    """
    names = tuple(module.metadata["sensitivities"])
    none = np.full(len(names), np.nan)
    if not result.solved or result.unknowns is None:
        missing = Sensitivities(names, none, "the problem was not solved", (), np.nan, {})
        return replace(result, sensitivity=missing)
    grid, unknowns = time_grid(module, result.steps, result.grid), result.unknowns
    found = module.sensitivities(grid, unknowns, given)
    if found.failure:
        unknowns = _sharpened(module, result)
        found = module.sensitivities(grid, unknowns, given)
    doubtful = tuple(_place(module, grid, int(index)) for index in found.doubtful)
    if found.failure:
        return replace(result, sensitivity=Sensitivities(names, none, found.failure, doubtful, np.nan, {}))
    there = replace(result, unknowns=unknowns)
    by_name = {name: _derivatives(there, module, grid, found, i) for i, name in enumerate(names)}
    return replace(result, sensitivity=Sensitivities(names, found.cost, "", doubtful, found.inaccuracy, by_name))


def _sharpened(module: Any, result: Result) -> Vector:
    """The unknowns of the solution to a lower tolerance, where that is reached.

    Where curvatures are small, multipliers that are known to the tolerance may leave no minimum.
    """
    given = {} if result.grid is None else {"grid": result.grid}
    found = module.solve(result.steps, guess=result.unknowns, warm=True, tolerance=SHARP, **given)
    return np.asarray(found.unknowns if found.status == "solved" else result.unknowns)


def _derivatives(result: Result, module: Any, grid: Grid, found: Any, i: int) -> Derivatives:
    """Those by quantity i, put together where the problem was cut into segments."""
    arrays = dict(zip(("t", "q", "p", "u", "multipliers"), module.unpacked_rates(grid, result.unknowns, found, i)))
    durations = found.durations[i]
    if segments := segments_of(module.metadata):
        bare = replace(result, **arrays, levels=(), accuracy=None, grid=None, message="")
        whole = put_together(bare, module.metadata)
        arrays = {name: getattr(whole, name) for name in arrays}
        durations = segments.number * durations
    free, last = module.metadata["free_parameters"], found.unknowns.shape[1] - module.COUPLINGS
    values = map(float, found.unknowns[i, last - len(free) : last])
    return Derivatives(
        cost=float(found.cost[i]), durations=durations, free=dict(zip(free, values, strict=True)),
        unknowns=found.unknowns[i], **arrays,
    )  # fmt: skip


def _place(module: Any, grid: Grid, index: int) -> str:
    """What an unknown is, and where."""
    metadata = module.metadata
    node, bodies = len(metadata["node"]), metadata["bodies"]
    stride = node + len(metadata["interval"])
    chain = grid.steps * stride + node
    if index >= bodies * chain:
        return str(metadata["shared"][index - bodies * chain])
    body, local = divmod(index, chain)
    k, j = divmod(local, stride)
    name = metadata["node"][j] if j < node else metadata["interval"][j - node]
    what = metadata["meanings"].get(name, name).removeprefix("slack of ")
    of_body = f" of body {body}" if bodies > 1 else ""
    return f"{what}{of_body} {'at node' if j < node else 'on interval'} {k}"


def as_record(found: Sensitivities, result: Result) -> dict[str, Any]:
    """The part of the JSON object about sensitivities: those of numbers, and of the state at the end."""
    return {
        "reason": found.reason,
        "doubtful": list(found.doubtful),
        "inaccuracy": _finite(found.inaccuracy),
        "by": {name: None if found.reason else _numbers(found[name], result) for name in found},
    }


def _numbers(found: Derivatives, result: Result) -> dict[str, Any]:
    return {
        "cost": _finite(found.cost),
        "durations": [_finite(value) for value in found.durations],
        "free_parameters": {name: _finite(value) for name, value in found.free.items()},
        "end": {name: _finite(value) for name, value in zip(result.names["q"], found.q[-1], strict=True)},
    }


def _finite(number: Any) -> float | None:
    return float(number) if np.isfinite(number) else None


def as_arrays(found: Sensitivities) -> dict[str, Any]:
    """The arrays of an archive: `d_...` has a row for each of `d_names`."""
    if found.reason:
        return {}
    arrays = {"d_names": np.array(found.names), "d_cost": found.costs}
    for name in ("durations", "t", "q", "p", "u", "multipliers", "unknowns"):
        arrays[f"d_{name}"] = np.stack([getattr(found[quantity], name) for quantity in found])
    return arrays
