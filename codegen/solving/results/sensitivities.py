"""Sensitivities of a solution: its derivatives by parameters, boundary values and a given duration, by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from codegen.errors import ArgumentError
from codegen.runtime.record import Task, phrase
from codegen.solving.loading import Grid, Vector, few_steps, time_grid
from codegen.solving.results.result import Derivatives, Result, Sensitivities
from codegen.solving.results.segments import put_together, segments_of

SHARP = 1e-12
"""The tolerance to which solutions are found again that have no sensitivities."""
UNSOLVED = "the problem was not solved"


def require_sensitive(module: Any) -> None:
    """Refuse a module without what sensitivities need; ArgumentError says how it is made."""
    task, problem = module.metadata.task, module.metadata.problem
    if task == Task.CONTROL and module.metadata.sensitivities is None:
        finding = f"the module of {problem} has no sensitivities"
        raise ArgumentError(finding, "build it with --sensitivities, or give the problem file")


@dataclass(frozen=True)
class Rates:
    """What a module finds at the unknowns (n,) of a solution, on a grid; its `sensitivities` have no arrays yet."""

    module: Any
    grid: Grid
    unknowns: Vector
    found: Any
    sensitivities: Sensitivities

    @property
    def free(self) -> dict[str, Vector]:
        """Derivatives (m,) of free parameters by all quantities."""
        names, couplings = self.module.metadata.free_parameters, self.module.problem.structure.couplings
        last = self.found.unknowns.shape[1] - couplings
        columns = self.found.unknowns[:, last - len(names) : last].T
        return dict(zip(names, columns, strict=True))

    def derivatives(self, result: Result) -> list[Derivatives]:
        """Those of a result, not yet put together of segments, by each quantity."""
        there = replace(result, unknowns=self.unknowns)
        return [_derivatives(there, self, i) for i, _ in enumerate(self.sensitivities.names)]


def rates_at(
    module: Any, steps: int, unknowns: Vector, given: Sequence[str] = (), fractions: Vector | None = None
) -> Rates:
    """The sensitivities of a solution on so many intervals, which may last `fractions` of the duration.

    Quantities that are `given` by name follow no others.
    """
    names, grid = tuple(module.metadata.sensitivities), time_grid(module, steps, fractions)
    found = module.sensitivities(grid, unknowns, given)
    if found.failure:
        unknowns = _sharpened(module, steps, unknowns, fractions)
        found = module.sensitivities(grid, unknowns, given)
    doubtful = tuple(_place(module, grid, int(index)) for index in found.doubtful)
    costs, left = (np.full(len(names), np.nan), np.nan) if found.failure else (found.cost, found.inaccuracy)
    return Rates(module, grid, unknowns, found, Sensitivities(names, costs, found.failure, doubtful, left, {}))


def with_sensitivities(result: Result, module: Any, given: tuple[str, ...] = ()) -> Result:
    """The result of a module, not yet put together of segments, with its sensitivities.

    Quantities that are `given` by name follow no others.
    """
    if not result.solved or result.unknowns is None:
        names = tuple(module.metadata.sensitivities)
        missing = Sensitivities(names, np.full(len(names), np.nan), UNSOLVED, (), np.nan, {})
        return replace(result, sensitivity=missing)
    rates = rates_at(module, result.steps, result.unknowns, given, result.grid)
    found = rates.sensitivities
    if found.reason:
        return replace(result, sensitivity=found)
    by_name = dict(zip(found.names, rates.derivatives(result), strict=True))
    whole = Sensitivities(found.names, found.costs, "", found.doubtful, found.inaccuracy, by_name)
    return replace(result, sensitivity=whole)


def quantity_values(module: Any, result: Result) -> dict[str, Vector]:
    """The values (bodies,) of what there are derivatives by, in a solution with the module's own numbers."""
    names, parameters = module.metadata.sensitivities, module.make_grid(few_steps(module, 4)).parameters
    found = dict(zip(names[: module.OWN_QUANTITIES], parameters.T))
    return found | ({"duration": np.array([result.t[-1] - result.t[0]])} if "duration" in names else {})


def _sharpened(module: Any, steps: int, unknowns: Vector, fractions: Vector | None) -> Vector:
    """The unknowns of the solution to a lower tolerance, where that is reached.

    Where curvatures are small, multipliers that are known to the tolerance may leave no minimum.
    """
    given = {} if fractions is None else {"grid": fractions}
    found = module.solve(steps, guess=unknowns, warm=True, tolerance=SHARP, **given)
    return np.asarray(found.unknowns if found.status == "solved" else unknowns)


def _derivatives(result: Result, rates: Rates, i: int) -> Derivatives:
    """Those by quantity i, put together where the problem was cut into segments."""
    module, found = rates.module, rates.found
    unpacked = module.unpacked_rates(rates.grid, result.unknowns, found, i)
    arrays = dict(zip(("t", "q", "p", "u", "multipliers"), unpacked))
    durations = found.durations[i]
    if segments := segments_of(module.metadata):
        bare = replace(result, **arrays, levels=(), accuracy=None, grid=None, message="")
        whole = put_together(bare, module.metadata)
        arrays = {name: getattr(whole, name) for name in arrays}
        durations = segments.number * durations
    free = {name: float(values[i]) for name, values in rates.free.items()}
    return Derivatives(cost=float(found.cost[i]), durations=durations, free=free, unknowns=found.unknowns[i], **arrays)


def _place(module: Any, grid: Grid, index: int) -> str:
    """What an unknown is, and where."""
    metadata = module.metadata
    node, bodies = len(metadata.node), metadata.bodies
    stride = node + len(metadata.interval)
    chain = grid.steps * stride + node
    if index >= bodies * chain:
        return str(metadata.shared[index - bodies * chain])
    body, local = divmod(index, chain)
    k, j = divmod(local, stride)
    name = metadata.node[j] if j < node else metadata.interval[j - node]
    what = phrase(metadata.meanings[name], role=not metadata.is_slack(name)) if name in metadata.meanings else name
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
