"""The result of an optimal-control problem, with residuals that are evaluated outside the driver."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.runtime.record import ControlRecord
from codegen.runtime.search import callbacks
from codegen.runtime.search.bounds import bounds_of, prescribed_beyond
from codegen.runtime.search.grid import plain_grid
from codegen.runtime.search.messages import worst_row
from codegen.runtime.search.scaling import scaled_grid
from codegen.runtime.search.solve import STEEP, corrected_cost
from codegen.runtime.search.table_ranges import tables_beyond
from codegen.solving.loading import ControlModule, Entries, Grid, Vector, time_grid
from codegen.solving.results.estimates import AT_BOUND, Estimates, estimates_of
from codegen.solving.results.result import (
    ControlAttempt,
    Outline,
    Result,
    Run,
    component_names,
    contradicted,
    max_norm,
    origin,
    other_driver,
    outline_of,
)
from codegen.solving.results.segments import put_together, segments_of

LARGE_MULTIPLIERS = 100.0
"""Mean multipliers above it make the optimality conditions' tolerance relative."""
MANY_TERMS = 100
"""From so many terms on the order of a sum counts among its roundings."""


@dataclass(frozen=True)
class Verdict:
    """What is left of a driver's claim once every equation has been evaluated again outside it.

    `residual` and `stationarity` are max-norms; the cost of a solution is corrected by what residuals are worth.
    """

    status: str
    message: str
    cost: float
    residual: float
    stationarity: float


def control_verdict(module: ControlModule, driver: str, run: Run, attempt: ControlAttempt, grid: Grid) -> Verdict:
    """Re-evaluate residual and stationarity of an attempt on a grid, and downgrade a false claim of success.

    Of what a driver knows beside its unknowns only the sizes at the guess, and the bounds in parts of them, are used.
    """
    metadata, unknowns = module.metadata, attempt.unknowns
    scaled = _scaled_grid(module, grid, run) if attempt.scaled is None else attempt.scaled
    conditions = _Conditions(module, grid, scaled, unknowns)
    residual, stationarity = conditions.norms()
    status, message = attempt.status, attempt.message
    if status == "solved" and not _is_accurate(module, scaled, attempt, conditions, (residual, stationarity)):
        found = f"the discrete equations have residual {residual:.1e} and the optimality conditions"
        status, message = contradicted(driver, f"{found} {stationarity:.1e}", other_driver(attempt))
    elif metadata.inequalities and (beyond := prescribed_beyond(scaled, unknowns)):
        status, message = "infeasible", f"infeasible: {beyond}; change the value or the bound"
    elif status == "solved" and (outside := ("" if grid.problem.inputs is None else tables_beyond(grid, unknowns))):
        status = "outside a table"
        message = (
            f"{status}: {outside}; keep it inside by bounds or the guess, or give the table outside='clamp' or 'extend'"
        )
    elif status != "solved" and not attempt.generated and not attempt.is_explained:
        # Optimisers of others number the rows; the module has names for them.
        message += f"; {worst_row(grid, module.evaluate(grid, unknowns))}"
    cost = _cost(module, scaled, conditions.point) if status == "solved" else float(callbacks.cost(grid, unknowns))
    return Verdict(status, message, cost, residual, stationarity)


def control_result(
    module: ControlModule, driver: str, run: Run, attempt: ControlAttempt, seconds: float = math.nan
) -> Result:
    """The result of an attempt, by the verdict on what the driver claims."""
    metadata, unknowns, grid = module.metadata, attempt.unknowns, time_grid(module, run.steps, run.grid)
    verdict = control_verdict(module, driver, run, attempt, grid)
    t, q, p, u, multipliers = module.unpack(grid, unknowns)
    estimates = _estimates(module, grid, unknowns) if verdict.status == "solved" else None
    named = {
        **_free_parameters(module, unknowns),
        **_integral_multipliers(module, unknowns),
        **_inner_conditions(module, grid, unknowns),
    }
    summary = {
        **({"maximum": -verdict.cost} if metadata.maximised else {}),
        "duration": float(t[-1] - t[0]),
        "final_state_miss": _final_state_miss(module, grid, unknowns),
        "largest_control": max_norm(u),
        "stationarity": verdict.stationarity,
        **named,
        **({f"waypoint_{i}": float(t[k]) for i, k in enumerate(grid.inner, 1)} if metadata.waypoints else {}),
        **{f"switch_{i}": float(t[i * run.steps]) for i in range(1, metadata.phases)},
    }
    return Result(
        **origin(metadata, driver, run, attempt, seconds), **asdict(verdict), t=t, q=q, p=p, u=u,
        multipliers=multipliers, log=attempt.log, unknowns=unknowns, names=component_names(metadata),
        stage_abscissae=metadata.stage_abscissae, summary=summary, grid=run.grid, estimates=estimates,
        labels={name: name for name in named},
    )  # fmt: skip


def control_outline(module: ControlModule, driver: str, run: Run, attempt: ControlAttempt) -> Outline:
    """The verdict on an attempt, and its trajectories; those of segments put together."""
    if segments_of(module.metadata) is not None:
        outline = outline_of(put_together(control_result(module, driver, run, attempt), module.metadata))
        return replace(outline, free=_free_parameters(module, attempt.unknowns))
    grid = time_grid(module, run.steps, run.grid)
    verdict = control_verdict(module, driver, run, attempt, grid)
    names = ("t", "q", "p", "u", "multipliers")
    arrays = dict(zip(names, attempt.trajectories or module.unpack(grid, attempt.unknowns), strict=True))
    free = _free_parameters(module, attempt.unknowns) if module.metadata.free_parameters else {}
    return Outline(verdict.status, verdict.message, verdict.cost, verdict.residual, arrays, attempt.unknowns, free)


def _estimates(module: ControlModule, grid: Grid, unknowns: Vector) -> Estimates | None:
    """What measurements say of free parameters, where there are any."""
    if module.metadata.observations is None:
        return None
    return estimates_of(module, grid, unknowns, held_at_bounds(module, grid, unknowns))


def held_at_bounds(module: ControlModule, grid: Grid, unknowns: Vector) -> NDArray[np.bool_]:
    """Which unknowns are at a bound, (n,); the grid has no sizes."""
    held = np.zeros(unknowns.size, dtype=bool)
    primal = module.primal_unknowns(grid)
    distance = np.minimum(*bound_distances(module, grid, unknowns))
    held[primal] = distance <= AT_BOUND * np.maximum(1.0, np.abs(unknowns[primal]))
    return held


def control_numbers(metadata: ControlRecord, run: Run) -> int:
    """How many numbers the generated solver keeps: it was measured to need 26 for every unknown."""
    intervals = run.steps * int(metadata.phases)
    return 26 * (intervals + 1) * (len(metadata.node) + len(metadata.interval))


def _scaled_grid(module: ControlModule, grid: Grid, run: Run) -> Grid:
    """The grid with the sizes in whose parts the generated solver works from the guess that was asked for."""
    if run.scaling == "none":
        return grid
    guess = module.initial_guess(grid) if run.guess is None else run.guess
    scaled: Grid = scaled_grid(grid, module.with_pinned_values(grid, guess))
    return scaled


def _cost(module: ControlModule, scaled: Grid, point: Any) -> float:
    """The discrete cost of a solution, corrected by what residuals and distances to bounds are worth."""
    own = module.evaluate(scaled, point.unknowns / scaled.sizes) if scaled.sizes.size else point
    return float(corrected_cost(scaled, own))


def _is_accurate(
    module: ControlModule, scaled: Grid, attempt: ControlAttempt, conditions: _Conditions, norms: tuple[float, float]
) -> bool:
    """Whether residual and stationarity, in the solver's scales, are as small as the driver promised, or rounding."""
    residual, stationarity = conditions.norms(scaled.sizes, scaled.weight) if scaled.sizes.size else norms
    if not math.isfinite(residual + stationarity):
        return False
    if max(residual, stationarity) <= 10.0 * attempt.tolerance:
        return True  # whatever rounding and multipliers would forgive beside
    unknowns, weight, grid = attempt.unknowns, scaled.weight, plain_grid(scaled)
    sizes = scaled.sizes if scaled.sizes.size else np.ones(unknowns.size)
    rounding = _rounding_level(module, grid, unknowns, weight * sizes)
    steepest = max_norm((weight * sizes)[module.primal_unknowns(grid)] * callbacks.cost_gradient(grid, unknowns))
    scale = max(1.0, steepest, _mean_multiplier(module, scaled, unknowns, sizes, weight) / LARGE_MULTIPLIERS)
    # Multipliers without limit would forgive any slope. Linear-quadratic problems, which know no sizes, have no limit.
    if not grid.problem.structure.linear_quadratic and stationarity > STEEP * max(1.0, steepest):
        return False
    return residual <= 10.0 * max(attempt.tolerance, rounding) and stationarity <= 10.0 * max(
        attempt.tolerance * scale, rounding
    )


def _mean_multiplier(module: ControlModule, scaled: Grid, unknowns: Vector, sizes: Vector, weight: float) -> float:
    """The mean modulus of all multipliers and of the duals of bounds, the slopes that are held by them.

    Where it is large, optimality conditions are sums of large terms, and the tolerance is relative to it, as it is for
    the generated solver and IPOPT. Source: Waechter and Biegler (2006), equation (6).
    """
    grid = plain_grid(scaled)
    primal, multipliers = module.primal_unknowns(grid), module.multiplier_unknowns(grid)
    below, above = bound_distances(module, scaled, unknowns)
    slopes = weight * sizes[primal] * np.abs(callbacks.stationarity(grid, unknowns))
    bounded = np.isfinite(below) | np.isfinite(above)
    total = np.abs(unknowns[multipliers] / sizes[multipliers]).sum() + slopes[bounded].sum()
    return float(total / max(1, multipliers.size + bounded.sum()))


class _Conditions:
    """What is left of all conditions at some unknowns, evaluated once, in the problem's own units.

    Bounds are those of the grid `scaled`, in whose units slacks may yield; the other one has no sizes.
    """

    def __init__(self, module: ControlModule, grid: Grid, scaled: Grid, unknowns: Vector) -> None:
        self.point = module.evaluate(grid, unknowns)
        self._module, self._grid = module, grid
        self._misses = _misses(module, grid, unknowns)
        self._distances = bound_distances(module, scaled, unknowns) if module.metadata.inequalities else None

    def norms(self, sizes: Vector | None = None, weight: float = 1.0) -> tuple[float, float]:
        """Max-norms of all equations and bounds, and of the stationarity, in parts of the unknowns' sizes, if given."""
        if sizes is None and self._distances is None:  # the most frequent case, and one of many in a sweep
            # What is pinned has no entry in the gradient, so that the norms of all of it are those of what is free.
            return max(self.point.residual, max_norm(self._misses)), self.point.stationarity
        gradient = self.point.gradient
        own = np.ones(gradient.size) if sizes is None else sizes
        rows, columns = self._module.multiplier_unknowns(self._grid), self._module.primal_unknowns(self._grid)
        primal, slopes = own[columns], gradient[columns]
        wrong = [weight * own[rows] * gradient[rows]]
        if self._misses.size:
            wrong.append(self._misses / own)
        if self._distances is not None:
            wrong.append(np.maximum(0.0, -np.minimum(*self._distances)) / primal)
            slopes = _unbalanced(slopes, self._distances, primal)
        return max(max_norm(values) for values in wrong), max_norm(weight * primal * slopes)


def bound_distances(module: ControlModule, grid: Grid, unknowns: Vector) -> tuple[Vector, Vector]:
    """Distances of the free primal unknowns from their lower and upper bounds, infinite where there are none."""
    primal = module.primal_unknowns(grid)
    if not module.metadata.inequalities:
        none = np.full(primal.size, np.inf)
        return none, none
    lower, upper = bounds_of(grid)
    units = grid.sizes if grid.sizes.size else np.ones(unknowns.size)
    return (unknowns - units * lower)[primal], (units * upper - unknowns)[primal]


def _unbalanced(slopes: Vector, distances: tuple[Vector, Vector], sizes: Vector) -> Vector:
    """The gradient of the Lagrangian by free primal unknowns, as far as no bound holds against it.

    A bound may hold against a slope that leads out of it, in proportion to its closeness: what remains is the slope
    times the distance in parts of the unknown's size, as in complementarity.
    """
    below, above = (np.clip(distance / sizes, 0.0, 1.0) for distance in distances)
    return np.asarray(np.where(slopes > 0.0, slopes * below, slopes * above), dtype=float)


def _misses(module: ControlModule, grid: Grid, unknowns: Vector) -> Vector:
    """By how much the unknowns that a boundary condition fixes differ from their values, (n,); zero for others.

    Empty where none does.
    """
    pinned = module.with_pinned_values(grid, unknowns)
    if (pinned == unknowns).all():  # as for the generated solver, which pins what is given
        return np.empty(0)
    misses = unknowns - pinned
    misses[module.primal_unknowns(grid)] = 0.0
    misses[module.multiplier_unknowns(grid)] = 0.0
    return misses


def _rounding_level(module: ControlModule, grid: Grid, unknowns: Vector, weights: Vector) -> float:
    """Error of a weighted residual when every unknown is off by half a unit in the last place: eps max_i |K| |x|.

    What is summed over all intervals, such as an integral condition or the slope by a free duration, errs by the square
    root of the number of its terms beside. Source: Higham (2002), Accuracy and stability of numerical algorithms,
    sections 4.2 and 7.2.
    """
    columns, rows = module.primal_unknowns(grid), module.multiplier_unknowns(grid)
    primal, dual = np.abs(unknowns[columns]), np.abs(unknowns[rows])

    def row_sums(entries: Entries, x: Vector, size: int, transposed: bool = False) -> Vector:
        rows, columns, values = entries
        rows, columns = (columns, rows) if transposed else (rows, columns)
        terms = np.bincount(rows, minlength=size)
        sums = np.bincount(rows, np.abs(values) * x[columns], minlength=size)
        return np.asarray(np.where(terms >= max(grid.steps, MANY_TERMS), np.sqrt(terms), 1.0) * sums, dtype=float)

    jacobian, hessian = callbacks.jacobian(grid, unknowns), callbacks.hessian(grid, unknowns)
    equations = row_sums(jacobian, primal, dual.size)
    optimality = row_sums(hessian, primal, primal.size) + row_sums(jacobian, dual, primal.size, transposed=True)
    return float(np.finfo(float).eps) * max(
        max_norm(weights[rows] * equations), max_norm(weights[columns] * optimality)
    )


def _final_state_miss(module: ControlModule, grid: Grid, unknowns: Vector) -> float:
    """Largest error of the conditions at the end: prescribed values, and equations of the last nodes."""
    metadata = module.metadata
    bodies, node = metadata.bodies, len(metadata.node)
    chain = grid.steps * (node + len(metadata.interval)) + node
    indices = np.arange(unknowns.size)
    at_end = (indices >= bodies * chain) | (indices % chain >= chain - node)
    equations = at_end[module.multiplier_unknowns(grid)]
    return max(max_norm(_misses(module, grid, unknowns)), max_norm(callbacks.constraints(grid, unknowns)[equations]))


def _integral_multipliers(module: ControlModule, unknowns: Vector) -> dict[str, float]:
    """The multipliers of conditions on integrals: the rates at which the cost falls as their values grow."""
    first = unknowns.size - module.problem.structure.root
    integrals = module.metadata.integrals
    return {f"multiplier of {name}": float(unknowns[first + index]) for name, index in integrals}


def _inner_conditions(module: ControlModule, grid: Grid, unknowns: Vector) -> dict[str, float]:
    """The multipliers of conditions at inner times, body by body."""
    if not module.metadata.inner_conditions:
        return {}
    nodes, _ = module.views(grid, unknowns)
    found = {}
    for name, number, index in module.metadata.inner_conditions:
        for body, of_nodes in enumerate(nodes):
            of_body = f" of body {body}" if len(nodes) > 1 else ""
            found[f"multiplier of {name}{of_body}"] = float(of_nodes[grid.inner[int(number)], int(index)])
    return found


def _free_parameters(module: ControlModule, unknowns: Vector) -> dict[str, float]:
    """Values of the static parameters that were optimised; they stand before the multipliers of couplings."""
    names = module.metadata.free_parameters
    last = unknowns.size - module.problem.structure.couplings
    return dict(zip(names, map(float, unknowns[last - len(names) : last]), strict=True))
