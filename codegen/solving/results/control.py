"""The result of an optimal-control problem, with residuals that are evaluated outside the driver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from codegen.runtime.record import ControlRecord, Kind
from codegen.runtime.search import point as derivatives
from codegen.runtime.search.bounds import bounds_of, determined_slacks, prescribed_beyond
from codegen.runtime.search.grid import plain_grid
from codegen.runtime.search.messages import OUTSIDE_TABLE, REMEDIES, tables_beyond, worst_row
from codegen.runtime.search.scaling import scaled_grid
from codegen.runtime.search.solve import STEEP, corrected_cost
from codegen.runtime.search.stacks import Optimum
from codegen.runtime.search.termination import newton_step
from codegen.solving.loading import ControlModule, Entries, Grid, Matrix, Vector, time_grid
from codegen.solving.results.estimates import AT_BOUND, estimates_of
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
"""Mean modulus of the multipliers above which the tolerance of the optimality conditions is scaled with this mean."""
SMALL_BESIDE_COST, STILL_FALLS = 1e-7, 1e-5
"""Relative to the scaled cost: tolerances that are not small, and decreases by one more Newton step that matter."""
LARGE_PRODUCT = 1e4
"""Largest product of a contact force and a gap, relative to the default relaxation, without a warning.

The default is 1e-8 of an estimate of the energy, so that larger products change the motion visibly.
"""
MANY_TERMS = 100
"""Least number of terms of a sum for which the accumulation of rounding errors is taken into account."""


@dataclass(frozen=True)
class Verdict:
    """The termination status of an attempt after all equations were evaluated again, independently of the driver.

    `residual` is the max-norm of all equations and bounds, and `stationarity` of the optimality conditions. The `cost`
    of a solution is corrected for the residuals.
    """

    status: str
    message: str
    cost: float
    residual: float
    stationarity: float


def control_verdict(module: ControlModule, driver: str, run: Run, attempt: ControlAttempt, grid: Grid) -> Verdict:
    """Return the termination status of an attempt, from residuals that are evaluated independently of the driver.

    A driver's claim of success is replaced by a failure if the residuals are too large. `grid` has no scaling factors.
    From the driver only the unknowns, the scaling factors at the initial guess and the scaled bounds are used.
    """
    metadata, unknowns, scaled = module.metadata, attempt.unknowns, attempt.scaled
    if scaled is None and run.scaling == "none":
        scaled = grid
    elif scaled is None:
        guess = module.initial_guess(grid) if run.guess is None else run.guess
        scaled = scaled_grid(grid, module.with_pinned_values(grid, guess))
    assert scaled is not None
    conditions = _Conditions(module, grid, scaled, unknowns)
    residual, stationarity = conditions.norms()
    status, message = attempt.status, attempt.message
    if status == "solved" and not _is_accurate(module, scaled, attempt, conditions, (residual, stationarity)):
        finding = (
            f"the discrete equations have residual {residual:.1e} and the optimality conditions {stationarity:.1e}"
        )
        status, message = contradicted(driver, finding, other_driver(attempt))
    elif metadata.inequalities and (beyond := prescribed_beyond(scaled, unknowns)):
        status, message = "infeasible", f"infeasible: {beyond}; change the value or the bound"
    elif status == "solved" and (outside := ("" if grid.problem.inputs is None else tables_beyond(grid, unknowns))):
        status = OUTSIDE_TABLE
        message = f"{status}: {outside}; {REMEDIES[status]}"
    elif status != "solved" and not attempt.generated and not attempt.is_explained:
        # Messages of other optimisers number the equations; the module knows the name of the worst one.
        message += f"; {worst_row(grid, module.evaluate(grid, unknowns))}"
    if status == "solved":
        point = conditions.point
        if scaled.sizes.size:
            point = module.evaluate(scaled, point.unknowns / scaled.sizes)
        cost = float(corrected_cost(scaled, point))
    else:
        cost = float(derivatives.cost(grid, unknowns))
    return Verdict(status, message, cost, residual, stationarity)


def control_result(
    module: ControlModule, driver: str, run: Run, attempt: ControlAttempt, seconds: float = math.nan
) -> Result:
    """Return the result of an attempt, with the status of `control_verdict`.

    `seconds` is the time of the fastest run of the driver.
    """
    metadata, unknowns, grid = module.metadata, attempt.unknowns, time_grid(module, run.steps, run.grid)
    verdict = control_verdict(module, driver, run, attempt, grid)
    t, q, p, u, multipliers = module.unpack(grid, unknowns)
    estimates = None
    if verdict.status == "solved" and metadata.observations is not None:
        estimates = estimates_of(module, grid, unknowns, held_at_bounds(module, grid, unknowns))
    bodies, node = metadata.bodies, len(metadata.node)
    # The residuals of the last nodes and of the linking variables belong to the end of the motion.
    chain = grid.steps * (node + len(metadata.interval)) + node
    indices = np.arange(unknowns.size)
    at_end = (indices >= bodies * chain) | (indices % chain >= chain - node)
    equations = derivatives.constraints(grid, unknowns)[at_end[module.multiplier_unknowns(grid)]]
    # The multiplier of an integral constraint is minus the derivative of the cost with respect to its prescribed value.
    root = unknowns.size - module.problem.structure.root
    named = free_parameters(module, unknowns)
    named |= {f"multiplier of {name}": float(unknowns[root + index]) for name, index in metadata.integrals}
    if metadata.inner_conditions:
        nodes, _ = module.views(grid, unknowns)
        for name, number, index in metadata.inner_conditions:
            for body, values in enumerate(nodes):
                of_body = f" of body {body}" if len(nodes) > 1 else ""
                named[f"multiplier of {name}{of_body}"] = float(values[grid.inner[int(number)], int(index)])
    contact = contact_of(module, grid, unknowns) if metadata.relaxation else None
    is_control = [name not in metadata.contact_forces for name in metadata.control_names]
    controls = u[:, np.tile(is_control, bodies)] if u.size else u
    summary = {
        **({"maximum": -verdict.cost} if metadata.maximised else {}),
        "duration": float(t[-1] - t[0]),
        "final_state_miss": max(max_norm(_misses(module, grid, unknowns)), max_norm(equations)),
        **({"largest_control": max_norm(controls)} if controls.size else {}),
        **({} if contact is None else {"complementarity": contact.complementarity}),
        "stationarity": verdict.stationarity,
        **named,
        **({f"waypoint_{i}": float(t[k]) for i, k in enumerate(grid.inner, 1)} if metadata.waypoints else {}),
        **{f"switch_{i}": float(t[i * run.steps]) for i in range(1, metadata.phases)},
    }
    return Result(
        **origin(metadata, driver, run, attempt, seconds), **asdict(verdict), t=t, q=q, p=p, u=u,
        multipliers=multipliers, log=attempt.log, unknowns=unknowns, names=component_names(metadata),
        stage_abscissae=metadata.stage_abscissae, summary=summary, grid=run.grid, estimates=estimates,
        labels={name: name for name in named}, gaps={} if contact is None else contact.gaps,
        notes=() if contact is None else contact.notes,
    )  # fmt: skip


@dataclass(frozen=True)
class Contact:
    """The gaps (N,) at the ends of all intervals by name, and the largest product of a contact law.

    `relative` is this product in relation to the default relaxation.
    """

    gaps: dict[str, Vector]
    complementarity: float
    relative: float

    @property
    def notes(self) -> tuple[str, ...]:
        """A warning if the contact laws hold only approximately."""
        if self.relative <= LARGE_PRODUCT:
            return ()
        finding = f"products of contact forces and gaps reach {self.complementarity:.1e}"
        return (f"{finding}, {self.relative:.1e} times the default relaxation: give a smaller one",)


def contact_of(module: ControlModule, grid: Grid, unknowns: Vector) -> Contact:
    """Return the gaps and the violation of the contact laws at `unknowns` (n,), whose equations hold."""
    metadata = module.metadata
    _, intervals = module.views(grid, unknowns)
    values = {name: intervals[0, :, i] for i, name in enumerate(metadata.interval)}
    relaxation = float(grid.parameters[0, list(metadata.parameters).index(metadata.relaxation)])
    gaps, products = dict[str, Vector](), [0.0]
    for name, meaning in metadata.meanings.items():
        if meaning.kind is Kind.GAP_SLACK:
            gaps[meaning.of] = values[name].copy()
        elif meaning.kind is Kind.COMPLEMENTARITY_SLACK:
            products.append(float((relaxation - values[name]).max()))
    return Contact(gaps, max(products), max(products) / float(metadata.parameters[metadata.relaxation]))


def control_outline(module: ControlModule, driver: str, run: Run, attempt: ControlAttempt) -> Outline:
    """Return the status and the trajectories of an attempt, which a sweep stores.

    For a problem with delays the trajectories of all segments are assembled to one motion.
    """
    if segments_of(module.metadata) is not None:
        outline = outline_of(put_together(control_result(module, driver, run, attempt), module.metadata))
        return replace(outline, free=free_parameters(module, attempt.unknowns))
    grid = time_grid(module, run.steps, run.grid)
    verdict = control_verdict(module, driver, run, attempt, grid)
    return _outline(module, grid, verdict, attempt.unknowns, attempt.trajectories)


def outline_of_optimum(module: ControlModule, grid: Grid, optimum: Optimum) -> Outline:
    """Return the Outline of an optimum of a batch, which has evaluated the equations again outside its search."""
    return _outline(module, grid, optimum, optimum.unknowns)


def _outline(
    module: ControlModule, grid: Grid, verdict: Verdict | Optimum, unknowns: Vector, trajectories: Sequence[Matrix] = ()
) -> Outline:
    names = ("t", "q", "p", "u", "multipliers")
    arrays = dict(zip(names, trajectories or module.unpack(grid, unknowns), strict=True))
    free = free_parameters(module, unknowns) if module.metadata.free_parameters else {}
    return Outline(verdict.status, verdict.message, verdict.cost, verdict.residual, arrays, unknowns, free)


def control_numbers(metadata: ControlRecord, run: Run) -> int:
    """Return the number of floating-point numbers that the generated solver stores: 26 per unknown, as measured."""
    intervals = run.steps * int(metadata.phases)
    return 26 * (intervals + 1) * (len(metadata.node) + len(metadata.interval))


def held_at_bounds(module: ControlModule, grid: Grid, unknowns: Vector) -> NDArray[np.bool_]:
    """Return a mask (n,) that is True for each unknown at an active bound; `grid` must have no scaling factors."""
    held = np.zeros(unknowns.size, dtype=bool)
    primal = module.primal_unknowns(grid)
    distance = np.minimum(*bound_distances(module, grid, unknowns))
    held[primal] = distance <= AT_BOUND * np.maximum(1.0, np.abs(unknowns[primal]))
    return held


def bound_distances(module: ControlModule, grid: Grid, unknowns: Vector) -> tuple[Vector, Vector]:
    """Return the distances of the free primal unknowns from their lower bounds, and from their upper bounds.

    Both arrays have the shape (p,). Entries are negative if a bound is violated, and infinite without a bound.
    """
    primal = module.primal_unknowns(grid)
    if not module.metadata.inequalities:
        none = np.full(primal.size, np.inf)
        return none, none
    lower, upper = bounds_of(grid)
    scales = grid.sizes if grid.sizes.size else np.ones(unknowns.size)
    return (unknowns - scales * lower)[primal], (scales * upper - unknowns)[primal]


def free_parameters(module: ControlModule, unknowns: Vector) -> dict[str, float]:
    """Return the values of free parameters by name; their unknowns precede the multipliers of coupling conditions."""
    names = module.metadata.free_parameters
    last = unknowns.size - module.problem.structure.couplings
    return dict(zip(names, map(float, unknowns[last - len(names) : last]), strict=True))


class _Conditions:
    """The violations of all equations, bounds and optimality conditions at `unknowns` (n,), in the problem's units.

    The bounds are read from the grid `scaled`, which has scaling factors; `grid` has none.
    """

    def __init__(self, module: ControlModule, grid: Grid, scaled: Grid, unknowns: Vector) -> None:
        self.point = module.evaluate(grid, unknowns)
        self._module, self._grid = module, grid
        self._misses = _misses(module, grid, unknowns)
        self._distances = bound_distances(module, scaled, unknowns) if module.metadata.inequalities else None
        self._is_determined = determined_slacks(scaled)[module.primal_unknowns(grid)] if self._distances else None

    def norms(self, scales: Vector | None = None, weight: float = 1.0) -> tuple[float, float]:
        """Return the max-norm of all equations and bounds, and the max-norm of the stationarity.

        `scales` (n,) are the scaling factors of the unknowns, and `weight` the scaling factor of the cost. Without
        them the norms are in the units of the problem.
        """
        if scales is None and self._distances is None:  # the most frequent case, for example in a sweep
            # Pinned unknowns have no entry in the gradient, and do not contribute to the norms of the point.
            return max(self.point.residual, max_norm(self._misses)), self.point.stationarity
        gradient = self.point.gradient
        scales = np.ones(gradient.size) if scales is None else scales
        rows, columns = self._module.multiplier_unknowns(self._grid), self._module.primal_unknowns(self._grid)
        primal, slopes = scales[columns], gradient[columns]
        violations = [weight * scales[rows] * gradient[rows]]
        if self._misses.size:
            violations.append(self._misses / scales)
        if self._distances is not None:
            violations.append(np.maximum(0.0, -np.minimum(*self._distances)) / primal)
            # Complementarity: a slope of the Lagrangian is permitted at an active bound if the cost falls beyond the
            # bound. The error is the slope times the distance to the bound in scaled units, which is at most 1. The
            # multiplier of a determined slack is arbitrary, because its equation depends on others.
            below, above = (np.clip(distance / primal, 0.0, 1.0) for distance in self._distances)
            slopes = np.where(slopes > 0.0, slopes * below, slopes * above)
            slopes[self._is_determined] = 0.0
        return max(max_norm(values) for values in violations), max_norm(weight * primal * slopes)


def _misses(module: ControlModule, grid: Grid, unknowns: Vector) -> Vector:
    """Return the deviations (n,) of prescribed unknowns from their boundary values; empty if all are zero."""
    pinned = module.with_pinned_values(grid, unknowns)
    if (pinned == unknowns).all():  # always true for the generated solver, which inserts prescribed values
        return np.empty(0)
    misses = unknowns - pinned
    misses[module.primal_unknowns(grid)] = 0.0
    misses[module.multiplier_unknowns(grid)] = 0.0
    return misses


def _is_accurate(
    module: ControlModule, scaled: Grid, attempt: ControlAttempt, conditions: _Conditions, norms: tuple[float, float]
) -> bool:
    """Return True if scaled residual and stationarity are below the tolerance of the attempt or the rounding errors.

    `norms` are the residual and the stationarity in the units of the problem. Both may exceed the limit by a factor of
    10. Optimality conditions are sums of large terms if the mean modulus of the multipliers is large. This mean
    includes the multipliers of bounds, and the tolerance is relative to it. Source: Waechter and Biegler (2006),
    equation (6).
    """
    residual, stationarity = conditions.norms(scaled.sizes, scaled.weight) if scaled.sizes.size else norms
    if not math.isfinite(residual + stationarity):
        return False
    if _still_falls(module, scaled, attempt):
        return False
    if max(residual, stationarity) <= 10.0 * attempt.tolerance:
        return True
    unknowns, weight, grid = attempt.unknowns, scaled.weight, plain_grid(scaled)
    scales = scaled.sizes if scaled.sizes.size else np.ones(unknowns.size)
    rounding = _rounding_level(module, grid, unknowns, weight * scales)
    primal, dual = module.primal_unknowns(grid), module.multiplier_unknowns(grid)
    steepest = max_norm((weight * scales)[primal] * derivatives.cost_gradient(grid, unknowns))
    below, above = bound_distances(module, scaled, unknowns)
    slopes = weight * scales[primal] * np.abs(derivatives.stationarity(grid, unknowns))
    bounded = np.isfinite(below) | np.isfinite(above)
    total = np.abs(unknowns[dual] / scales[dual]).sum() + slopes[bounded].sum()
    mean_multiplier = float(total / max(1, dual.size + bounded.sum()))
    scale = max(1.0, steepest, mean_multiplier / LARGE_MULTIPLIERS)
    # The tolerance grows with the multipliers, so a limit that is independent of them bounds the stationarity as well.
    # Linear-quadratic problems have no scaling factors, and do not need this limit.
    if not grid.problem.structure.linear_quadratic and stationarity > STEEP * max(1.0, steepest):
        return False
    limit = 10.0 * max(attempt.tolerance * scale, rounding)
    return residual <= 10.0 * max(attempt.tolerance, rounding) and stationarity <= limit


def _still_falls(module: ControlModule, scaled: Grid, attempt: ControlAttempt) -> bool:
    """Return True if bounds matter, and a Newton step that ends at bounds would lower the cost noticeably.

    If the tolerance is not small relative to the scaled cost, unknowns may meet it far from the optimum, for example
    along a flat arc of the cost. Along a Newton step dx the cost falls by -g.dx/2.
    """
    scales = scaled.sizes if scaled.sizes.size else np.ones(attempt.unknowns.size)
    if not module.metadata.inequalities:
        return False
    point = module.evaluate(scaled, attempt.unknowns / scales)
    if attempt.tolerance <= SMALL_BESIDE_COST * abs(point.cost):
        return False
    primal = module.primal_unknowns(scaled)
    below, above = (distance / scales[primal] for distance in bound_distances(module, scaled, attempt.unknowns))
    step = newton_step(scaled, point)[primal]
    if not np.isfinite(step).all():  # the KKT matrix does not have the inertia of a minimum
        return False
    step = np.clip(step, -np.maximum(below, 0.0), np.maximum(above, 0.0))
    decrease = -float(point.gradient[primal] @ step) / 2.0
    return decrease > max(STILL_FALLS * abs(float(point.cost)), attempt.tolerance)


def _rounding_level(module: ControlModule, grid: Grid, unknowns: Vector, weights: Vector) -> float:
    """Return the largest rounding error of the weighted residuals: eps max_i w_i (|K| |x|)_i with the KKT matrix K.

    `weights` (n,) are the factors w_i. Every unknown x_j is assumed to have the relative error eps. Sums over all
    intervals have an additional factor, the square root of the number of terms. Examples are an integral constraint and
    the derivative with respect to a free duration. Source: Higham (2002), Accuracy and stability of numerical
    algorithms, sections 4.2 and 7.2.
    """
    columns, rows = module.primal_unknowns(grid), module.multiplier_unknowns(grid)
    primal, dual = np.abs(unknowns[columns]), np.abs(unknowns[rows])

    def row_sums(entries: Entries, x: Vector, size: int, transposed: bool = False) -> Vector:
        rows, columns, values = entries
        rows, columns = (columns, rows) if transposed else (rows, columns)
        terms = np.bincount(rows, minlength=size)
        sums = np.bincount(rows, np.abs(values) * x[columns], minlength=size)
        return np.asarray(np.where(terms >= max(grid.steps, MANY_TERMS), np.sqrt(terms), 1.0) * sums, dtype=float)

    jacobian, hessian = derivatives.jacobian(grid, unknowns), derivatives.hessian(grid, unknowns)
    equations = row_sums(jacobian, primal, dual.size)
    optimality = row_sums(hessian, primal, primal.size) + row_sums(jacobian, dual, primal.size, transposed=True)
    return float(np.finfo(float).eps) * max(
        max_norm(weights[rows] * equations), max_norm(weights[columns] * optimality)
    )
