"""Optimal control: cost errors of every scheme, orders by mesh sequences, drivers, and the sections of the page.

Orders. The cost is expected to converge with the order of the scheme, but with order 2 at most where controls are
constant on intervals. Sources: Hager, Runge-Kutta methods in optimal control and the transformed adjoint system, Numer.
Math. 87 (2000), for smooth optima; Dontchev, Hager and Veliov, Second-order Runge-Kutta approximations in control
constrained optimal control, SIAM J. Numer. Anal. 38 (2000), and Dontchev and Hager, The Euler approximation in state
constrained optimal control, Math. Comp. 70 (2001), where bounds become active; Alt, Baier, Gerdts and Lempio, Error
bounds for Euler approximation of linear-quadratic control problems with bang-bang solutions, Numer. Algebra Control
Optim. 2 (2012), for controls that switch.

Limits of costs on ever finer grids. Smooth sequences are extrapolated: Richardson (1911); Romberg's scheme as in
Hairer, Norsett and Wanner (1993), section II.9. Where errors vary irregularly with the grid, the limit is fitted.

Mesh sequences. A mesh sequence starts from a coarse grid and doubles it. Each grid starts from the optimum on a coarser
grid, so that all grids follow one optimum. From the problem's own initial guess, each grid might end in another local
optimum, or fail on the fine grids that long problems need. Where bounds become active or inactive within the motion,
the error varies with the position of these times in their intervals. Grids with other numbers of intervals are then
added.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from codegen.errors import CodegenError
from codegen.evidence.report import building, peers, reference
from codegen.evidence.report import comparison as compare
from codegen.evidence.report.building import SURVEYS, Variant, Workshop, load_control
from codegen.evidence.report.comparison import (
    ABOVE_REFERENCE,
    LARGE,
    SETTLED,
    Measured,
    fitted_order,
    measured_order,
    order_text,
    verdict,
)
from codegen.evidence.report.page import (
    SUPERSCRIPTS,
    Picture,
    Section,
    Table,
    listed,
    number,
    power_of_ten,
    seconds,
    svg,
    times_of_drivers,
)
from codegen.evidence.report.store import Case, Extent, Store, Values, section_of
from codegen.runtime.search import point
from codegen.solving import api
from codegen.solving.arcs import order_of_optima
from codegen.solving.loading import ControlModule, Vector
from codegen.solving.results.control import bound_distances
from codegen.solving.results.result import Result

DRIVERS = ("newton", "slsqp", "trust-constr", "fsolve")
MOST_STEPS = 20_000
"""The first grid is derived from the problem's own number of steps, or from this number if it is smaller."""
LEAST_STEPS, ROUNDING = 5, 1e-12
"""The least number of intervals of a grid, and the error of states and controls below which no finer grid follows."""
MOST_TRIED = 4  # the number of schemes that are tried for the reference
STRANGE = 2.0  # iterations are strange if they exceed this multiple of those of the median scheme on the same grid
OTHER_OPTIMUM = 0.1  # the relative error of the cost on the finest grid above which a remark names possible reasons


def untimed(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Yield cases: the reference motion, and the mesh sequence of every scheme."""
    modules = {v: workshop.control(v) for v in workshop.built(variants)}
    if not modules:
        return
    first = _first_steps(modules)
    if next(iter(modules.values())).metadata.phases == 1:
        candidates = [(v.label, workshop.path(v)) for v in _trusted(modules)[:MOST_TRIED]]
        refined = partial(_refined, candidates, first, extent.reference_seconds)
        yield Case(section_of(problem, "reference"), "motion", refined)
    for variant in modules:
        sequenced = partial(_sequenced, workshop.path(variant), first, extent.sequence_seconds)
        yield Case(section_of(problem, "mesh sequences"), variant.label, sequenced)


def _refined(candidates: Sequence[tuple[str, Path]], first: int, seconds: float) -> Values:
    return reference.refined(((label, load_control(path)) for label, path in candidates), first, seconds)


def _sequenced(path: Path, first: int, seconds: float) -> Values:
    return sequence(load_control(path), first, seconds)


def _first_steps(modules: Mapping[Variant, ControlModule]) -> int:
    """Return the number of intervals with which mesh sequences and drivers begin: a quarter of the problem's own."""
    return max(LEAST_STEPS, min(MOST_STEPS, next(iter(modules.values())).metadata.steps) // 4)


def _trusted(modules: Mapping[Variant, ControlModule]) -> list[Variant]:
    """Return the variants by decreasing order of the optimum; the problem's own scheme is the first of its order."""
    default = next(iter(modules))
    return sorted(modules, key=lambda v: (-order_of_optima(modules[v]), v != default))


def cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Yield cases: every scheme on ever finer grids, the reference of the cost, drivers, times, iterations."""
    store, modules = workshop.store, {v: workshop.control(v) for v in workshop.built(variants)}
    if not modules:
        return
    optima, references = section_of(problem, "optima"), section_of(problem, "reference")
    default, first, trusted = next(iter(modules)), _first_steps(modules), _trusted(modules)
    motion = store.get(references, "motion") or {}
    trajectory = reference.read_trajectory(motion) if motion.get("label") else None
    runs: dict[str, Callable[[], object]] = {}
    for variant, module in modules.items():
        for steps in (max(LEAST_STEPS, first // 2) * 2**k for k in range(extent.control_doublings + 1)):
            name = variant.run(steps)
            yield Case(optima, name, partial(solved, module, steps, trajectory=trajectory))
            values = store.get(optima, name) or {}
            if values["status"] == "solved":
                runs[name] = building.solver(module, steps)
            worst = max((values[key] for key in ("states", "controls") if values.get(key) is not None), default=1.0)
            if (values["seconds of first solve"] or 0.0) > extent.limit or worst < ROUNDING:
                break
    exact = (store.get(SURVEYS, problem.stem) or {}).get("exact cost")
    yield Case(references, "cost", partial(_reference, store, problem, trusted, exact))
    module = modules[default]
    if module.initial_guess(module.make_grid(first)).size <= extent.driver_unknowns:
        for driver in DRIVERS:
            yield Case(section_of(problem, "drivers"), driver, partial(solved, module, first, driver))
            if (store.get(section_of(problem, "drivers"), driver) or {})["status"] != "refused":
                runs[f"driver {driver}"] = building.solver(module, first, driver)
    yield from building.cases(problem, runs, store, extent.time_budget)
    if extent.peers and trajectory is not None:
        grids = [row["steps"] for row in default.rows(store, optima)]
        for peer in peers.installed():
            solves = partial(_peer, peer, problem, module, grids, motion, extent)
            yield Case(section_of(problem, "peers"), peer.name, solves)
    for variant, steps in _strange(store, problem, list(modules)):
        yield Case(section_of(problem, "iterations"), variant.run(steps), partial(_searched, modules[variant], steps))


def _peer(
    peer: peers.Peer, problem: Path, module: ControlModule, grids: Sequence[int], motion: Values, extent: Extent
) -> Values:
    """Return the solves of a peer from the initial guesses of the module."""
    guesses = []
    for steps in grids:
        grid = module.make_grid(steps)
        _, q, p, u, _ = module.unpack(grid, module.initial_guess(grid))
        guesses.append(peers.Guess(q, p, u))
    return peers.measured(peer, problem, guesses, motion, extent.limit, extent.time_budget)


def solved(
    module: ControlModule,
    steps: int,
    driver: str = "newton",
    budget: float = 0.0,
    trajectory: reference.Trajectory | None = None,
) -> Values:
    """Return status, cost and residuals of a solve from the problem's own initial guess.

    With a `budget` in seconds its time is measured, and with a `trajectory`, the reference, the errors of the states
    and of the controls.
    """
    try:
        result = api.solve(module, driver, steps=steps)
    except CodegenError as error:  # such as too little memory, or a driver that does not apply
        keys = ("cost", "seconds of first solve", "iterations", "residual", "stationarity", "order", "expected order")
        return {**dict.fromkeys(keys), "status": "refused", "message": str(error), "steps": steps}
    values = {
        "status": result.status, "steps": steps, "cost": result.cost, "seconds of first solve": result.seconds_solve,
        "iterations": result.iterations, "residual": result.residual, "stationarity": result.stationarity,
        "order": module.metadata.order, "expected order": order_of_optima(module),
        "load seconds": result.seconds_code,
    }  # fmt: skip
    if trajectory is not None and result.solved:
        values |= trajectory.errors(reference.trajectory_of(result))
    if budget:
        measured = building.timed(building.solver(module, steps, driver), budget)
        values |= {"seconds": measured.processor, "wall seconds": measured.wall, "spread": measured.spread}
    return values


def _strange(store: Store, problem: Path, variants: Sequence[Variant]) -> list[tuple[Variant, int]]:
    """Return the schemes with more than STRANGE times the iterations of the median scheme, and the worst grid."""
    counts: dict[int, dict[Variant, int]] = {}
    for variant in variants:
        for row in variant.rows(store, section_of(problem, "optima")):
            if row["status"] == "solved":
                counts.setdefault(row["steps"], {})[variant] = row["iterations"]
    worst: dict[Variant, tuple[float, int]] = {}
    for steps, by_variant in counts.items():
        median = max(1.0, float(np.median(list(by_variant.values()))))
        for variant, count in by_variant.items():
            if count > STRANGE * median:
                worst[variant] = max(worst.get(variant, (0.0, 0)), (count / median, steps))
    return [(variant, steps) for variant, (_, steps) in worst.items()]


def _searched(module: ControlModule, steps: int) -> Values:
    """Return the number of iterations of a solve, of steps that are halved at least, and of shifted Hessians."""
    result = api.solve(module, steps=steps, log=True)
    assert result.log is not None
    shifts, lengths = result.log[1:, 3], result.log[1:, 4]
    return {
        "iterations": result.iterations, "shortened": int((lengths <= 0.5).sum()), "shifted": int((shifts > 0.0).sum()),
        "first residual": float(result.log[0, 1]),
    }  # fmt: skip


def _reference(store: Store, problem: Path, trusted: Sequence[Variant], exact: float | None) -> Values:
    """Return the reference cost: `exact`, else the most accurate of the refined motion and the mesh sequences' limits.

    The limit is that of the first mesh sequence of `trusted` that has a limit.
    """
    if exact is not None:
        return {"cost": exact, "error": 1e-15 * abs(exact), "how": "closed form of the maximum principle"}
    found = list[Values]()
    motion = store.get(section_of(problem, "reference"), "motion") or {}
    if motion.get("label"):
        error = motion["errors"]["cost"] * (abs(motion["cost"]) or 1.0) + 1e-15 * abs(motion["cost"])
        how = f"{motion['label']} on {motion['steps']} intervals"
        found.append({"cost": motion["cost"], "error": error, "how": how, "scheme": motion["label"]})
    for variant in trusted:
        values = store.get(section_of(problem, "mesh sequences"), variant.label)
        if values is not None and (limit := _limit(values)) is not None:
            how = f"{variant.label} on {values['steps'][0]} to {values['steps'][-1]} intervals, {limit.how}"
            found.append({"cost": limit.value, "error": limit.error, "how": how, "scheme": variant.label})
            break
    if found:
        return min(found, key=lambda values: float(values["error"]))
    return {"cost": None, "error": None, "how": "no scheme has optima on three successive grids"}


# ---- Limits of costs ----

FAR = 0.2  # costs with a larger relative difference belong to unrelated optima


@dataclass(frozen=True)
class Limit:
    """The extrapolated limit of a sequence of costs, its estimated error, and the method as text."""

    value: float
    error: float
    how: str


def limit_of(costs: Sequence[float], order: int) -> Limit:
    """Return the limit of costs on N, 2N, 4N, ... intervals, for errors h^p + h^(p+1) + ..., or h^p + h^(p+2) + ...

    p is the `order`. Symmetric schemes have the second form. Each elimination of a power gives a column. The result is
    from the column whose last two entries agree best; the difference of these entries is the error.
    """
    error, value, eliminated = math.inf, costs[-1], tuple[int, ...]()
    for step in (1, 2):
        column, powers = list(costs), tuple(order + step * k for k in range(len(costs) - 1))
        for k, power in enumerate(powers):
            column = [b + (b - a) / (2.0**power - 1.0) for a, b in pairwise(column)]
            if len(column) > 1:
                entry = abs(column[-1] - column[-2]), column[-1], powers[: k + 1]
                error, value, eliminated = min((error, value, eliminated), entry)
    names = listed([_power(p) for p in eliminated])
    how = f"extrapolated such that {names} cancel" if eliminated else "not extrapolated"
    return Limit(value, max(error, 1e-15 * abs(value)), how)


def _power(exponent: int) -> str:
    return "h" if exponent == 1 else "h" + str(exponent).translate(SUPERSCRIPTS)


def fitted_limit(steps: Sequence[int], costs: Sequence[float], order: int) -> Limit:
    """Return J in J + c N^-p, p = `order`, by least squares over the grids with at least a quarter of the largest N.

    Grids up to the last one whose cost is far from the finest cost are left out, since they belong to another optimum.
    Residuals are assumed to be proportional to N^-p, so the weight of a row is N^p. The error is two standard errors.
    """
    rows = [(n, cost) for n, cost in zip(steps, costs, strict=True) if 4 * n >= max(steps)]
    far = [i for i, (_, cost) in enumerate(rows) if abs(cost - rows[-1][1]) > FAR * abs(rows[-1][1])]
    rows = rows[max(far, default=-1) + 1 :]
    if len(rows) < 3:
        return Limit(rows[-1][1], math.inf, "")
    n, values = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    decay = (n / n.max()) ** -order
    (_, value), covariance = np.polyfit(decay, values, 1, w=1.0 / decay, cov=True)
    return Limit(float(value), max(2.0 * math.sqrt(covariance[1, 1]), 1e-15 * abs(value)),
                 f"fitted to {len(rows)} grids by J + c {_power(order)}")  # fmt: skip


def _limit(values: Values) -> Limit | None:
    """Return the limit of the costs of a mesh sequence, or None for fewer than three grids."""
    if len(values["steps"]) < 3:
        return None
    if values["switching"]:
        return fitted_limit(*all_grids(values), values["expected order"])
    return limit_of(values["costs"], values["expected order"])


# ---- Mesh sequences ----

MOST_INTERVALS = 1_500_000
FINEST_SMOOTH, FINEST_SWITCHING, FINE = 1024, 128, 2000
"""The largest ratio of the last grid to the first, for smooth optima and for optima whose bounds become active. In the
second case the last grid has at least FINE intervals."""
COLD = 16  # if coarse grids have no optimum, the first grid may be finer than requested by up to this factor
PARTS = 6  # the number of grids per doubling for optima whose bounds become active or inactive
ENOUGH, ACCURATE = 0.005, 1e-10
"""The largest difference of settled local orders, and the relative error below which a limit is accurate."""
NO_MORE = 1e-11  # rounding errors are near if the relative differences of costs are below this value


@dataclass
class _Sequence:
    """A mesh sequence: optima by increasing number of intervals, and the remaining seconds of processor time."""

    module: ControlModule
    seconds: float
    failure: str = ""
    """The message of the last solve that failed."""
    steps: list[int] = field(default_factory=list)
    results: list[Result] = field(default_factory=list)

    @property
    def costs(self) -> list[float]:
        return [float(result.cost or 0.0) for result in self.results]

    def solve(self, steps: int, warm: Vector | None) -> Result | None:
        """Return an optimum from a coarser one (`warm`), else from the problem's guess; None if all solves fail."""
        begin = time.process_time()
        try:
            result = api.solve(self.module, steps=steps, warm=warm)
            if not result.solved and warm is not None:  # try a grid in between
                between = api.solve(self.module, steps=3 * steps // 4, warm=warm)
                if between.solved:
                    result = api.solve(self.module, steps=steps, warm=between.unknowns)
            if not result.solved and warm is not None:
                result = api.solve(self.module, steps=steps)
        except CodegenError as error:  # such as too little memory
            self.failure = str(error)
            return None
        finally:
            self.seconds -= time.process_time() - begin
        if result.solved:
            return result
        self.failure = f"N = {steps}: {result.message}"
        return None

    def has_settled(self) -> bool:
        """Return True if local orders of differences agree and the limit is accurate, or if rounding is near."""
        costs, order = self.costs, order_of_optima(self.module)
        scale = max(abs(costs[-1]), 1e-300)
        differences = [abs(b - a) / scale for a, b in pairwise(costs)]
        if len(costs) > 3 and all(difference < NO_MORE for difference in differences[-2:]):
            return True
        settled = measured_order(self.steps[:-1], differences)
        if settled is None or settled.spread > ENOUGH or settled.finest < self.steps[-2]:
            return False
        return order < 2 or limit_of(costs, order).error < ACCURATE * scale


def sequence(module: ControlModule, first: int, seconds: float) -> Values:
    """Return the grids and costs of a mesh sequence, and the unknowns whose bounds become active or inactive.

    `first` is the number of intervals of the first grid. No grid starts after `seconds` of processor time, which does
    not depend on the load of the machine.
    """
    grids = _Sequence(module, seconds)
    steps, changes = first, list[str]()
    while steps <= MOST_INTERVALS and grids.seconds > 0.0:
        result = grids.solve(steps, grids.results[-1].unknowns if grids.results else None)
        if result is None and (grids.results or steps >= COLD * first):
            break
        if result is not None:
            grids.steps.append(steps)
            grids.results.append(result)
            changes = switching(module, result)
            if changes and steps >= max(FINEST_SWITCHING * first, FINE):
                break
            if not changes and (steps >= FINEST_SMOOTH * first or grids.has_settled()):
                break
        steps *= 2
    between: list[tuple[int, float]] = []  # grids between two grids of the sequence
    if changes and len(grids.steps) > 2:
        for (coarse, fine), result in zip(pairwise(grids.steps), grids.results, strict=False):
            for part in range(1, PARTS):
                n = round(coarse * 2.0 ** (part / PARTS))
                if coarse < n < fine and (optimum := grids.solve(n, result.unknowns)) is not None:
                    between.append((n, float(optimum.cost or 0.0)))
    return {
        "order": module.metadata.order, "expected order": order_of_optima(module), "steps": grids.steps,
        "costs": grids.costs, "switching": changes, "more steps": [n for n, _ in between],
        "more costs": [cost for _, cost in between], "failure": grids.failure, "seconds": seconds - grids.seconds,
    }  # fmt: skip


def switching(module: ControlModule, result: Result) -> list[str]:
    """Return the names of unknowns with a bound that becomes active or inactive between adjacent nodes or intervals.

    A bound is active if its multiplier, the derivative of the Lagrangian, exceeds the distance from the bound.
    Inequality path constraints have slack unknowns, which are bounded.
    """
    if not module.metadata.inequalities:
        return []
    grid, unknowns = module.make_grid(result.steps), result.unknowns
    assert unknowns is not None
    below, above = bound_distances(module, grid, unknowns)
    active = np.zeros(unknowns.size)
    active[module.primal_unknowns(grid)] = np.abs(point.stationarity(grid, unknowns)) > np.minimum(below, above)
    nodes, intervals = module.views(grid, active)
    names, phases = [*module.metadata.node, *module.metadata.interval], module.metadata.phases
    changes = np.zeros(len(names), dtype=bool)
    for first in range(0, phases * result.steps, result.steps):  # without the nodes between phases
        inner = nodes[:, first + 1 : first + result.steps], intervals[:, first : first + result.steps]
        changes |= np.concatenate([np.diff(values, axis=1).any(axis=(0, 1)) for values in inner])
    return [name for name, changed in zip(names, changes, strict=True) if changed]


def all_grids(values: Values) -> tuple[list[int], list[float]]:
    """Return the numbers of intervals of all grids in increasing order, and their costs."""
    pairs = sorted(
        [*zip(values["steps"], values["costs"], strict=True),
         *zip(values["more steps"], values["more costs"], strict=True)]
    )  # fmt: skip
    return [n for n, _ in pairs], [cost for _, cost in pairs]


ELSEWHERE = 1e-3
"""Limits that differ by more than this fraction plus ten times their errors belong to different local optima."""
EXACT = 1e-9  # no order is measured if no relative error exceeds this value
OCTAVES = 16  # the largest ratio of numbers of intervals in a fit


def measured(store: Store, problem: Path, variant: Variant) -> Measured:
    """Return the solves of a scheme, the relative errors of their costs, and the order of the mesh sequence.

    Errors are None if a solve failed or if there is no reference. The expected order is the order of the scheme, but at
    most 2 where controls are constant on intervals.
    """
    rows = building.timed_rows(store, problem, variant, "optima")
    reference = store.get(section_of(problem, "reference"), "cost") or {}
    expected = next((int(order) for v in rows if (order := v.get("expected order")) is not None), variant.order)
    solves = Measured(rows, [_error(v, reference.get("cost")) for v in rows], None, expected, "")
    values = store.get(section_of(problem, "mesh sequences"), variant.label)
    limit = None if values is None else _limit(values)
    if values is None or limit is None:
        failure = "" if values is None else values["failure"]
        return replace(solves, verdict="no optimum on three successive grids", remark=failure)
    switching, target, floor, remark = tuple(values["switching"]), limit.value, limit.error, ""
    if reference.get("cost") is not None:
        cost, error = float(reference["cost"]), float(reference["error"])
        if abs(limit.value - cost) <= ELSEWHERE * (abs(cost) or 1.0) + 10.0 * (limit.error + error):
            target, floor = cost, error
        else:
            remark = f"another local optimum, whose cost tends to {limit.value:.6g}"
    scale = abs(target) or 1.0
    steps, costs = all_grids(values)
    errors = [abs(cost - target) / scale for cost in costs]
    solves = replace(solves, switching=switching, finest=steps[-1], finest_error=errors[-1], remark=remark)
    if max(errors) < EXACT:
        return replace(solves, verdict="exact on every grid")
    if switching:
        # If the reference is fitted to the finest quarter of these grids, only coarser grids can show an order. Grids
        # up to the last one with an unrelated optimum are left out.
        is_reference = variant.label == reference.get("scheme") or bool(remark)
        top = steps[-1] // 4 if is_reference else steps[-1]
        coarse = [(n, error) for n, error in zip(steps, errors, strict=True) if top <= OCTAVES * n and n <= top]
        kept = coarse[max((i + 1 for i, (_, error) in enumerate(coarse) if error > LARGE), default=0) :]
        order = fitted_order([n for n, _ in kept], [error for _, error in kept], floor / scale)
    else:
        order = measured_order(steps, errors, floor / scale)
    if order is None and values["failure"]:
        remark = "; ".join(text for text in (remark, f"ended at {values['failure']}") if text)
    return replace(solves, order=order, verdict=verdict(order, expected), remark=remark)


# ---- Sections of the page ----

_ORDERS = (
    "Orders are measured in mesh sequences: each grid starts from the optimum on a coarser one, so that all follow one "
    "optimum, until the orders between successive grids agree within "
    f"{SETTLED:g} over three grids, at {ABOVE_REFERENCE:g} times the reference's error or above. A control that is "
    "constant on each interval approximates a smooth one at order 2, and the cost at its minimum no better, whatever "
    "the scheme of the motion (Hager 2000; Dontchev, Hager and Veliov 2000): the lesser of 2 and the scheme's order is "
    "expected. Superconvergent are schemes whose first error cancels in the cost, as where they differ from one of "
    "higher order by an impulse at the ends."
)
_ERRORS = (
    "Errors are relative to the largest value of each component: of states and momenta the largest at the nodes, of "
    "controls the root mean square at stages, at nodes, or at midpoints of intervals with a constant control."
)
LARGE_RESIDUAL = 10.0  # the residual of the initial guess above which it is named as a reason for many iterations
_SWITCHING = (
    "This optimum is not smooth: bounds of {names} become active or inactive within the motion. The interval in which "
    "that happens holds one mean value of the control, which moves the state by a multiple of h² that depends on the "
    "place in the interval. The same orders are expected of the size of the error (Euler's methods: Dontchev and Hager "
    "2001 for bounds of states, Alt, Baier, Gerdts and Lempio 2012 for controls that switch), but without a steady "
    "factor. So they are fitted to six grids per doubling; ± is twice the standard error of the slope."
)


def _error(values: Values, exact: float | None) -> float | None:
    """Return |J - J*|/|J*|, or |J| for J* = 0; None for a failed solve or an unknown J* (`exact`)."""
    if exact is None or values["status"] != "solved" or values["cost"] is None:
        return None
    return float(abs(values["cost"] - exact) / (abs(exact) or 1.0))


def elsewhere(rows: Sequence[Values]) -> set[int]:
    """Return the grids whose states are far from the reference, although a coarser grid is close to it."""
    errors = [(row["steps"], row["states"]) for row in rows if row.get("states") is not None]
    return {n for n, error in errors if error > FAR and any(k < n and e < CLOSE for k, e in errors)}


def ladder_of(label: str, order: int, rows: Sequence[Values], of_cost: Sequence[float | None]) -> compare.Ladder:
    """Return the errors of states, controls and cost by numbers of steps; `ALL` is the largest of the three.

    Grids whose search ended in another local optimum have no errors.
    """
    far = elsewhere(rows)
    errors = {
        "states": [row.get("states") for row in rows],
        "controls": [row.get("controls") for row in rows],
        "cost": of_cost,
    }
    for key, values in errors.items():
        errors[key] = [None if row["steps"] in far else e for row, e in zip(rows, values, strict=True)]
    together = [
        None if None in row[::2] else max(error for error in row if error is not None)
        for row in zip(*errors.values(), strict=True)
    ]
    return compare.Ladder(
        label, order, [row["steps"] for row in rows], [row.get("seconds") for row in rows], {**errors, ALL: together},
        label in [peer.name for peer in peers.PEERS],
    )  # fmt: skip


ALL = "states, controls and cost"
CLOSE = 0.01
"""The error of states below which a grid has found the optimum of the reference; above FAR it has found another."""


def sections(store: Store, problem: Path, variants: Sequence[Variant], title: str) -> list[Section]:
    """Return the sections on the choice of a scheme, on orders, and on drivers."""
    cost = store.get(section_of(problem, "reference"), "cost") or {}
    motion = store.get(section_of(problem, "reference"), "motion") or {}
    exact = cost.get("cost")
    schemes = {v: m for v in variants if (m := measured(store, problem, v)).rows}
    relative = 0.0 if exact is None else cost["error"] / (abs(exact) or 1.0)
    if exact is None:
        texts = [f"There is no reference cost: {cost.get('how', 'no scheme was built')}."]
    else:
        accuracy = f", accurate to {number(relative, 2)}" if relative > 1e-14 else ""
        texts = [f"Reference of the cost: {exact:.12g}, {cost['how']}{accuracy}."]
    uncertain = motion.get("errors") or {}
    if uncertain:
        parts = [f"{number(uncertain[key], 2)} for {key}" for key in ("states", "controls") if uncertain.get(key)]
        texts.append(
            f"Reference of states and controls: {motion['label']} on {motion['steps']} intervals, with splines of "
            f"degree {reference.DEGREE}; the grid before differs by {listed(parts)}. {_ERRORS}"
        )
    ladders = [ladder_of(v.label, v.order, m.rows, m.errors) for v, m in schemes.items()]
    for peer in peers.PEERS:
        if rows := (store.get(section_of(problem, "peers"), peer.name) or {}).get("rows"):
            of_cost = [_error({"cost": None, **row}, exact) for row in rows]
            ladders.append(ladder_of(peer.name, peer.order, rows, of_cost))
    quantities = {key: uncertain[key] for key in ("states", "controls") if uncertain.get(key) is not None}
    quantities |= {} if exact is None else {"cost": relative}
    tables, pictures = [], []
    if quantities and ladders:
        wanted = {ALL: max(quantities.values()), **quantities} if len(quantities) > 1 else quantities
        sentences, table = compare.choice(ladders, wanted)
        texts, tables = [*sentences[:1], *texts], [table]
        pictures = compare.figures(ladders, quantities, next(iter(wanted)))
    choice = Section(title, tuple(texts), tuple(tables), tuple(pictures[:1]))
    deciding = ALL if len(quantities) > 1 else "cost"
    by_speed = sorted(ladders, key=lambda ladder: compare.speed(ladder, deciding))
    times = tuple((ladder.label, *compare.reach_columns(ladder, list(quantities))) for ladder in by_speed)
    head = tuple(f"{name} to {power_of_ten(target)}" for name in quantities for target in compare.TARGETS)
    caption = "Processor time of one solve to an error, fastest first."
    tables = [Table(caption, ("scheme", *head), times)] if quantities else []
    strange = _strange_table(store, problem)
    tables += [] if strange is None else [strange]
    everything = Section(f"{problem.stem}: all schemes", (building.RULE,), tuple(tables), tuple(pictures[1:]))
    texts, pictures = [_ORDERS], []
    names = dict.fromkeys(name for scheme in schemes.values() for name in scheme.switching)
    if names:
        texts.append(_SWITCHING.format(names=listed(list(names))))
    orders, runs = [], []
    for variant, scheme in schemes.items():
        kind = f"bounds of {', '.join(scheme.switching)}" if scheme.switching else "smooth"
        steps = [row["steps"] for row in scheme.rows]  # the orders of states and controls are those of the figures
        of_motion = [
            measured_order(steps, [row.get(key) for row in scheme.rows], uncertain.get(key) or 0.0)
            for key in ("states", "controls")
        ]
        orders.append((
            variant.label, str(variant.order), str(scheme.expected), order_text(scheme.order, scheme.verdict),
            *("" if order is None else number(order.value) for order in of_motion),
            scheme.order.range if scheme.order else "–", str(scheme.finest or "–"),
            number(scheme.finest_error, 2), kind, scheme.remark,
        ))  # fmt: skip
        last, error = scheme.rows[-1], scheme.errors[-1]
        remarks = [f"{v['steps']}: {v['status']}" for v in scheme.rows if v["status"] != "solved"]
        remarks += [f"{n}: another local optimum" for n in sorted(elsewhere(scheme.rows))]
        if error is not None and error > OTHER_OPTIMUM:
            remarks.append("far from the reference: too few intervals, or another local optimum")
        runs.append((
            variant.label, f"{last['steps']}", "–" if last["cost"] is None else f"{last['cost']:.9g}",
            number(error, 2), seconds(last["seconds"]), seconds(last["wall seconds"]), str(last["iterations"]),
            number(last["residual"], 2), number(last["stationarity"], 2), "; ".join(remarks),
        ))  # fmt: skip
    head = ("scheme", "scheme's order", "expected of the cost", "measured", "of states", "of controls", "at N",
            "finest N", "relative error there",
            "optimum", "remarks")  # fmt: skip
    tables = [Table("The order of the cost's error, by mesh sequences.", head, tuple(orders)).without_empty_columns()]
    head = ("scheme", "N", "cost", "relative error", "solve time", "wall clock", "iterations", "residual",
            "stationarity", "remarks")  # fmt: skip
    caption = "The finest solve of every scheme from the problem's own guess, on the grids that the figures show."
    tables.append(Table(caption, head, tuple(runs)).without_empty_columns())
    by_driver, by_name = dict(store.rows(section_of(problem, "drivers"))), building.times(store, problem)
    for name, values in by_driver.items():
        of_driver = by_name.get(f"driver {name}")
        by_driver[name] = {**values, "seconds": of_driver and of_driver.processor}
    if by_driver:
        newton = (by_driver.get("newton") or {}).get("seconds") or math.nan
        rows, refused = [], list[str]()
        for name, values in by_driver.items():
            if values["seconds"] is None:
                rows.append((name, values["status"], *["–"] * 6))
                refused.append(f"{values['message'][0].upper()}{values['message'][1:]}.")
                continue
            rows.append((
                name, values["status"], seconds(values["seconds"]), number(values["seconds"] / newton),
                str(values["iterations"]), number(values["residual"], 2), number(values["stationarity"], 2),
                number(_error(values, exact), 2),
            ))  # fmt: skip
        columns = ("driver", "status", "solve time", "× newton", "iterations", "residual", "stationarity",
                   "relative error of cost")  # fmt: skip
        steps = next(iter(by_driver.values()))["steps"]
        caption = f"Drivers on {steps} intervals of the default scheme, each from the problem's own guess."
        tables.append(Table(" ".join([caption, *refused]), columns, tuple(rows)))
        bars = [(name, v["seconds"], v["status"] == "solved") for name, v in by_driver.items() if v["seconds"]]
        pictures.append(Picture(f"Drivers on {steps} intervals.", svg(times_of_drivers, bars)))
    name = problem.stem
    return [choice, everything, Section(f"{name}: orders and drivers", tuple(texts), tuple(tables), tuple(pictures))]


def _strange_table(store: Store, problem: Path) -> Table | None:
    """Return the table of solves with strange numbers of iterations, or None if there are none."""
    rows = []
    for name, values in store.rows(section_of(problem, "iterations")):
        reasons = []
        if values["shortened"]:
            reasons.append(f"the line search shortens {values['shortened']} steps to half or less")
        if values["shifted"]:
            reasons.append(f"the Hessian is shifted in {values['shifted']}, since it has negative curvature")
        if values["first residual"] > LARGE_RESIDUAL:
            reasons.append(
                f"the equations at the initial guess have the residual {number(values['first residual'], 2)}"
            )
        rows.append((name, str(values["iterations"]), "; ".join(reasons) or "the log of the search shows no reason"))
    caption = f"Solves with more than {STRANGE:g} times the iterations of the median scheme on the same grid."
    head = ("scheme", "iterations", "what the log of the search shows")
    return Table(caption, head, tuple(rows), "words") if rows else None
