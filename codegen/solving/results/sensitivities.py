"""Sensitivities of a solution: its derivatives with respect to parameters, boundary values and a given duration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError
from codegen.runtime.record import Task, phrase
from codegen.solving.loading import ControlModule, GeneratedModule, Grid, Vector, few_steps, time_grid
from codegen.solving.results.estimates import as_finite
from codegen.solving.results.result import Derivatives, Result, Sensitivities
from codegen.solving.results.segments import put_together, segments_of

if TYPE_CHECKING:
    from codegen.runtime.search.sensitivities import Sensitivities as UnknownRates

SHARP = 1e-12
"""The tolerance of the solve that is repeated if the derivatives do not exist at a solution."""
UNSOLVED = "the problem was not solved"
"""The reason for missing sensitivities of a failed solve."""


def require_sensitive(module: GeneratedModule) -> None:
    """Raise ArgumentError if a module for optimal control was built without code for sensitivities."""
    task, problem = module.metadata.task, module.metadata.problem
    if task == Task.CONTROL and module.metadata.sensitivities is None:
        finding = f"the module of {problem} has no sensitivities"
        raise ArgumentError(finding, "build it with --sensitivities, or give the problem file")


@dataclass(frozen=True)
class Rates:
    """The derivatives that a module computed at the unknowns (n,) of a solution.

    `found` is the return value of `sensitivities` of the module, with derivatives of the vector of unknowns.
    `sensitivities` has the names and derivatives of the cost, but no derivatives of trajectories yet.
    """

    module: ControlModule
    grid: Grid
    unknowns: Vector
    found: UnknownRates
    sensitivities: Sensitivities

    @property
    def free(self) -> dict[str, Vector]:
        """Derivatives (m,) of each free parameter, by its name, with respect to all m quantities."""
        names, couplings = self.module.metadata.free_parameters, self.module.problem.structure.couplings
        last = self.found.unknowns.shape[1] - couplings
        columns = self.found.unknowns[:, last - len(names) : last].T
        return dict(zip(names, columns, strict=True))

    def derivatives(self, result: Result) -> list[Derivatives]:
        """Return the derivatives of a result with respect to each quantity.

        For a problem with delays the derivatives of all segments are assembled to derivatives of the whole motion.
        """
        module, found, segments = self.module, self.found, segments_of(self.module.metadata)
        each = []
        for i, _ in enumerate(self.sensitivities.names):
            unpacked = module.unpacked_rates(self.grid, self.unknowns, found, i)
            arrays: dict[str, Any] = dict(zip(("t", "q", "p", "u", "multipliers"), unpacked))
            durations = found.durations[i]
            if segments:
                bare = replace(result, **arrays, levels=(), accuracy=None, grid=None, message="")
                whole = put_together(bare, module.metadata)
                arrays = {name: getattr(whole, name) for name in arrays}
                durations = segments.number * durations
            free = {name: float(values[i]) for name, values in self.free.items()}
            cost, unknowns = float(found.cost[i]), found.unknowns[i]
            each.append(Derivatives(cost=cost, durations=durations, free=free, unknowns=unknowns, **arrays))
        return each


def rates_at(
    module: ControlModule, steps: int, unknowns: Vector, given: Sequence[str] = (), fractions: Vector | None = None
) -> Rates:
    """Return the derivatives of a solution `unknowns` (n,) on a grid of `steps` intervals.

    `fractions` are the lengths of the intervals relative to the duration; None means equal intervals. `given` names
    boundary values or durations that parameters do not change, even if the problem defines them by formulas. If the
    derivatives do not exist, the problem is solved again with the tolerance `SHARP`. Errors of the multipliers may hide
    a minimum whose curvatures are small.
    """
    names, grid = module.metadata.sensitivities or (), time_grid(module, steps, fractions)
    found = module.sensitivities(grid, unknowns, given)
    if found.failure:
        options = {} if fractions is None else {"grid": fractions}
        sharp = module.solve(steps, guess=unknowns, warm=True, tolerance=SHARP, **options)
        unknowns = np.asarray(sharp.unknowns if sharp.status == "solved" else unknowns)
        found = module.sensitivities(grid, unknowns, given)
    doubtful = tuple(_unknown_name(module, grid, int(index)) for index in found.doubtful)
    costs, residual = (np.full(len(names), np.nan), np.nan) if found.failure else (found.cost, found.inaccuracy)
    return Rates(module, grid, unknowns, found, Sensitivities(names, costs, found.failure, doubtful, residual, {}))


def with_sensitivities(result: Result, module: ControlModule, given: tuple[str, ...] = ()) -> Result:
    """Return the result with its sensitivities; for a problem with delays its segments must not be assembled yet.

    `given` names boundary values or durations that parameters do not change; see `rates_at`.
    """
    if not result.solved or result.unknowns is None:
        names = module.metadata.sensitivities or ()
        missing = Sensitivities(names, np.full(len(names), np.nan), UNSOLVED, (), np.nan, {})
        return replace(result, sensitivity=missing)
    rates = rates_at(module, result.steps, result.unknowns, given, result.grid)
    sensitivities = rates.sensitivities
    if not sensitivities.reason:
        by_name = dict(zip(sensitivities.names, rates.derivatives(result), strict=True))
        sensitivities = replace(sensitivities, _by_name=by_name)
    return replace(result, sensitivity=sensitivities)


def quantity_values(module: ControlModule, result: Result) -> dict[str, Vector]:
    """Return the values (bodies,) of the quantities with respect to which sensitivities are taken, by name.

    Parameters and boundary values have their default values. The duration is read from the result.
    """
    names, parameters = module.metadata.sensitivities or (), module.make_grid(few_steps(module, 4)).parameters
    values = dict(zip(names[: module.OWN_QUANTITIES], parameters.T))
    return values | ({"duration": np.array([result.t[-1] - result.t[0]])} if "duration" in names else {})


def _unknown_name(module: ControlModule, grid: Grid, index: int) -> str:
    """Return the description of the unknown with an index, for example "state x at node 3"."""
    metadata = module.metadata
    node, bodies = len(metadata.node), metadata.bodies
    stride = node + len(metadata.interval)
    chain = grid.steps * stride + node
    if index >= bodies * chain:
        return str(metadata.shared[index - bodies * chain])
    body, local = divmod(index, chain)
    k, j = divmod(local, stride)
    name = metadata.node[j] if j < node else metadata.interval[j - node]
    text = phrase(metadata.meanings[name], role=not metadata.is_slack(name)) if name in metadata.meanings else name
    of_body = f" of body {body}" if bodies > 1 else ""
    return f"{text}{of_body} {'at node' if j < node else 'on interval'} {k}"


def as_record(sensitivities: Sensitivities, result: Result) -> dict[str, object]:
    """Return the sensitivities as an object for JSON.

    For each quantity the object has the derivatives of the cost, durations, free parameters and the state at the end.
    """
    by: dict[str, object] = dict.fromkeys(sensitivities)
    if not sensitivities.reason:
        for name, derivatives in sensitivities.items():
            end = zip(result.names["q"], derivatives.q[-1], strict=True)
            by[name] = {
                "cost": as_finite(derivatives.cost),
                "durations": [as_finite(value) for value in derivatives.durations],
                "free_parameters": {name: as_finite(value) for name, value in derivatives.free.items()},
                "end": {name: as_finite(value) for name, value in end},
            }
    return {
        "reason": sensitivities.reason,
        "doubtful": list(sensitivities.doubtful),
        "inaccuracy": as_finite(sensitivities.inaccuracy),
        "by": by,
    }


def as_arrays(sensitivities: Sensitivities) -> dict[str, NDArray[np.generic]]:
    """Return the arrays that an .npz archive stores, by name.

    Each array `d_...` has a row for each quantity in `d_names`, with respect to which derivatives were taken.
    """
    if sensitivities.reason:
        return {}
    arrays = {"d_names": np.array(sensitivities.names), "d_cost": sensitivities.costs}
    for name in ("durations", "t", "q", "p", "u", "multipliers", "unknowns"):
        arrays[f"d_{name}"] = np.stack([getattr(sensitivities[quantity], name) for quantity in sensitivities])
    return arrays
