"""What is measured of an optimal-control problem: cost errors of every scheme, and drivers beside each other.

Orders at which costs of optima converge, with what is expected of them and what is to be said beside them. Expected is
the scheme's order, but 2 at most where controls are constant on intervals. Sources: Hager, Runge-Kutta methods in
optimal control and the transformed adjoint system, Numer. Math. 87 (2000), for smooth optima; Dontchev, Hager and
Veliov, Second-order Runge-Kutta approximations in control constrained optimal control, SIAM J. Numer. Anal. 38 (2000),
and Dontchev and Hager, The Euler approximation in state constrained optimal control, Math. Comp. 70 (2001), where
bounds become active; Alt, Baier, Gerdts and Lempio, Error bounds for Euler approximation of linear-quadratic control
problems with bang-bang solutions, Numer. Algebra Control Optim. 2 (2012), for controls that switch.

Where costs on ever finer grids tend to: extrapolation of smooth sequences, a fit where errors vary with the grid.
Source of the extrapolation: Richardson (1911); Romberg's scheme as in Hairer, Norsett and Wanner (1993), section II.9.

Costs of optima on ever finer grids, each found from the optimum on a coarser grid, so that all follow one optimum. From
a problem's own guess every grid may end in another local optimum, and long problems need finer grids than a guess leads
to. A mesh sequence starts from a coarse grid and doubles it; where bounds become active or inactive within the motion,
grids of other numbers of intervals are added, since the error then varies with the place of these times in their
intervals.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from codegen.errors import CodegenError
from codegen.evidence.report.building import SURVEYS, Variant, Workshop
from codegen.evidence.report.orders import LARGE, Order, fitted_order, measured_order, verdict
from codegen.evidence.report.page import SUPERSCRIPTS, listed
from codegen.evidence.report.settings import Extent
from codegen.evidence.report.store import Case, Store, Values
from codegen.runtime.search import point
from codegen.solving import api, drivers
from codegen.solving.arcs import order_of_optima
from codegen.solving.loading import ControlModule, GeneratedModule, Vector, is_control
from codegen.solving.results.control import bound_distances
from codegen.solving.results.result import Result

FAR = 0.2
"""Costs that differ by more than this part belong to optima that have nothing in common."""


@dataclass(frozen=True)
class Limit:
    """An extrapolated value, by how much it may be wrong, and how."""

    value: float
    error: float
    how: str


def limit_of(costs: Sequence[float], order: int) -> Limit:
    """The limit of costs on N, 2N, 4N, ... intervals, for errors h^p + h^(p+1) + ..., or h^p + h^(p+2) + ...

    Symmetric schemes have the second form. Each eliminated power gives a column; the column is taken whose last two
    entries agree best, and their distance is the error.
    """
    found = [_column(costs, [order + step * k for k in range(len(costs) - 1)]) for step in (1, 2)]
    error, value, powers = min(found)
    eliminated = listed([_power(p) for p in powers])
    how = f"extrapolated such that {eliminated} cancel" if powers else "not extrapolated"
    return Limit(value, max(error, 1e-15 * abs(value)), how)


def _power(exponent: int) -> str:
    return "h" if exponent == 1 else "h" + str(exponent).translate(SUPERSCRIPTS)


def _column(costs: Sequence[float], powers: Sequence[int]) -> tuple[float, float, tuple[int, ...]]:
    column = list(costs)
    best: tuple[float, float, tuple[int, ...]] = (math.inf, costs[-1], ())
    for k, power in enumerate(powers):
        column = [b + (b - a) / (2.0**power - 1.0) for a, b in pairwise(column)]
        if len(column) < 2:
            break
        best = min(best, (abs(column[-1] - column[-2]), column[-1], tuple(powers[: k + 1])))
    return best


def fitted_limit(steps: Sequence[int], costs: Sequence[float], order: int) -> Limit:
    """J in J + c N^-p by least squares over the finest quarter of a range of N; its error is two standard errors.

    Coarse grids count only down to the first whose cost is far from the finest one, that of another optimum. Residuals
    are taken to be of the size of the error itself, so that a row counts in proportion to N^p.
    """
    rows = [(n, cost) for n, cost in zip(steps, costs, strict=True) if 4 * n >= max(steps)]
    far = [i for i, (_, cost) in enumerate(rows) if abs(cost - rows[-1][1]) > FAR * abs(rows[-1][1])]
    rows = rows[max(far, default=-1) + 1 :]
    if len(rows) < 3:
        return Limit(rows[-1][1], math.inf, "")
    n, values = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    weight = (n / n.max()) ** order
    matrix = np.column_stack([weight, weight * (n / n.max()) ** -order])
    (value, slope), *_ = np.linalg.lstsq(matrix, weight * values, rcond=None)
    left = weight * values - matrix @ [value, slope]
    variance = float(left @ left) / max(1, len(rows) - 2) * np.linalg.inv(matrix.T @ matrix)[0, 0]
    return Limit(float(value), max(2.0 * math.sqrt(variance), 1e-15 * abs(value)),
                 f"fitted to {len(rows)} grids by J + c {_power(order)}")  # fmt: skip


MOST_INTERVALS = 1_500_000
FINEST_SMOOTH, FINEST_SWITCHING, FINE = 1024, 128, 2000
"""How much finer than the first grid the last is at most where the optimum is smooth, and is where bounds become
active; there it has so many intervals at least."""
COLD = 16
"""The first grid may be so much finer than asked for, where coarser ones have no optimum."""
PARTS = 6
"""Grids per doubling where bounds become active."""
ENOUGH, ACCURATE = 0.005, 1e-10
"""Local orders that differ by no more are good enough, and so are limits with this relative error."""
NO_MORE = 1e-11
"""Relative differences of costs below which rounding is near."""


@dataclass
class _Sequence:
    """Optima by growing number of intervals, and the seconds of processor time that are left."""

    module: ControlModule
    seconds: float
    failure: str = ""
    """What became of the last solve that failed."""
    steps: list[int] = field(default_factory=list)
    results: list[Result] = field(default_factory=list)

    @property
    def costs(self) -> list[float]:
        return [float(result.cost or 0.0) for result in self.results]

    def solve(self, steps: int, warm: Vector | None) -> Result | None:
        """From an optimum on a coarser grid, at once or by way of one in between, else from the problem's own guess.

        None where nothing leads to an optimum.
        """
        begin = time.process_time()
        try:
            result = api.solve(self.module, steps=steps, warm=warm)
            if not result.solved and warm is not None:
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


def sequence(module: ControlModule, first: int, seconds: float) -> Values:
    """Numbers of intervals and costs of a mesh sequence, unknowns whose bounds become active or inactive.

    No grid is begun after so many seconds of processor time, of which a busy machine does not take more.
    """
    found = _Sequence(module, seconds)
    steps, changes = first, list[str]()
    while steps <= MOST_INTERVALS and found.seconds > 0.0:
        result = found.solve(steps, found.results[-1].unknowns if found.results else None)
        if result is None and (found.results or steps >= COLD * first):
            break
        if result is not None:
            found.steps.append(steps)
            found.results.append(result)
            changes = switching(module, result)
            if _is_finished(found, first, changes):
                break
        steps *= 2
    between = _between(found) if changes and len(found.steps) > 2 else []
    return {
        "order": module.metadata.order, "expected order": order_of_optima(module), "steps": found.steps,
        "costs": found.costs, "switching": changes, "more steps": [n for n, _ in between],
        "more costs": [cost for _, cost in between], "failure": found.failure, "seconds": seconds - found.seconds,
    }  # fmt: skip


def switching(module: ControlModule, result: Result) -> list[str]:
    """The unknowns of which a bound becomes active or inactive between two neighbouring nodes or intervals.

    A bound is active where its multiplier, the slope of the Lagrangian, exceeds the distance from it. Inequalities
    of the path have unknowns of their own, which are bounded.
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
    for first in range(0, phases * result.steps, result.steps):  # between phases lies a node, wherever it is
        inner = nodes[:, first + 1 : first + result.steps], intervals[:, first : first + result.steps]
        changes |= np.concatenate([np.diff(values, axis=1).any(axis=(0, 1)) for values in inner])
    return [name for name, changed in zip(names, changes, strict=True) if changed]


def _is_finished(found: _Sequence, first: int, changes: list[str]) -> bool:
    """Whether finer grids would tell nothing more."""
    steps = found.steps[-1]
    if changes:
        return steps >= max(FINEST_SWITCHING * first, FINE)
    return steps >= FINEST_SMOOTH * first or _has_settled(found)


def _has_settled(found: _Sequence) -> bool:
    """Whether local orders of differences agree and, from order 2 on, the limit is known well; or rounding is near."""
    costs, order = found.costs, order_of_optima(found.module)
    scale = max(abs(costs[-1]), 1e-300)
    differences: list[float | None] = [abs(b - a) / scale for a, b in pairwise(costs)]
    if len(costs) > 3 and all(d is not None and d < NO_MORE for d in differences[-2:]):
        return True
    settled = measured_order(found.steps[:-1], differences)
    if settled is None or settled.spread > ENOUGH or settled.finest < found.steps[-2]:
        return False
    return order < 2 or limit_of(costs, order).error < ACCURATE * scale


def _between(found: _Sequence) -> list[tuple[int, float]]:
    """Further grids, whose numbers of intervals are between those of the sequence, without a common factor."""
    added: list[tuple[int, float]] = []
    for (coarse, result), fine in zip(zip(found.steps, found.results, strict=True), found.steps[1:], strict=False):
        for part in range(1, PARTS):
            steps = round(coarse * 2.0 ** (part / PARTS))
            if coarse < steps < fine and (more := found.solve(steps, result.unknowns)) is not None:
                added.append((steps, float(more.cost or 0.0)))
    return added


def all_grids(values: Values) -> tuple[list[int], list[float]]:
    """Numbers of intervals of all grids, growing, and their costs."""
    pairs: Sequence[Any] = sorted(
        [*zip(values["steps"], values["costs"], strict=True),
         *zip(values["more steps"], values["more costs"], strict=True)]
    )  # fmt: skip
    return [n for n, _ in pairs], [cost for _, cost in pairs]


DRIVERS = ("newton", "slsqp", "trust-constr", "fsolve")
MOST_STEPS = 20_000
"""No ladder starts with more."""
QUICKLY = 0.01
"""Seconds of a solve that is timed more often."""


def errors_of(problem: Path) -> str:
    """The section of the store that holds costs of all schemes."""
    return f"{problem.stem}: optima"


def orders_of(problem: Path) -> str:
    """The section of the store that holds the mesh sequences of all schemes."""
    return f"{problem.stem}: mesh sequences"


def references_of(problem: Path) -> str:
    """The section of the store that holds the reference cost."""
    return f"{problem.stem}: reference"


def drivers_of(problem: Path) -> str:
    """The section of the store that compares drivers."""
    return f"{problem.stem}: drivers"


def case_name(variant: Variant, steps: int) -> str:
    """The name of a case."""
    return f"{variant.label}; N {steps}"


def ladder(own_steps: int, doublings: int) -> list[int]:
    """A quarter of the problem's own number of steps, at least 5, doubled so often."""
    first = max(5, min(MOST_STEPS, own_steps) // 4)
    return [first * 2**k for k in range(doublings + 1)]


def cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Every scheme on ever finer grids, mesh sequences, the reference, then the drivers on the coarsest grid."""
    store, built = workshop.store, workshop.built(variants)
    for variant in built:
        own = _module(workshop, variant).metadata.steps
        for steps in ladder(own, extent.control_doublings):
            name = case_name(variant, steps)
            yield Case(
                errors_of(problem),
                name,
                lambda v=variant, n=steps: solved(_module(workshop, v), n, extent.repeat),  # type: ignore[misc]
            )
            values = store.get(errors_of(problem), name)
            if values is not None and (values["seconds"] or 0.0) > extent.limit:
                break
        yield Case(orders_of(problem), variant.label, lambda v=variant: _sequence(workshop, v, extent))  # type: ignore[misc]
    if not built:
        return
    # Optima of all schemes of order 2 and more converge alike, so that the problem's own scheme is asked first.
    trusted = sorted(built, key=lambda v: (-min(v.order, 2), v != built[0]))
    exact = (store.get(SURVEYS, problem.stem) or {}).get("exact cost")
    yield Case(references_of(problem), "cost", lambda: _reference(store, problem, trusted, exact))
    module = _module(workshop, built[0])
    steps = ladder(module.metadata.steps, 0)[0]
    if module.initial_guess(module.make_grid(steps)).size > extent.driver_unknowns:
        return
    for driver in DRIVERS:
        yield Case(
            drivers_of(problem),
            driver,
            lambda d=driver: _by_driver(module, d, steps, extent.repeat),  # type: ignore[misc]
        )


def _sequence(workshop: Workshop, variant: Variant, extent: Extent) -> Values:
    module = _module(workshop, variant)
    return sequence(module, ladder(module.metadata.steps, 0)[0], extent.sequence_seconds)


def _module(workshop: Workshop, variant: Variant) -> ControlModule:
    module = workshop.module(variant)
    assert is_control(module)
    return module


_KEYS = ("cost", "seconds", "iterations", "residual", "stationarity", "order", "expected order", "load seconds")


def solved(module: ControlModule, steps: int, repeat: int, driver: str = "newton", **options: Any) -> Values:
    """Status, cost, times and residuals of a solution from the problem's own guess."""
    try:
        result = well_timed(module, driver, repeat, steps=steps, **options)
    except CodegenError as error:  # such as too little memory
        return {**dict.fromkeys(_KEYS), "status": "refused", "message": str(error), "steps": steps}
    return {
        "status": result.status, "steps": steps, "cost": result.cost, "seconds": result.seconds_solve,
        "iterations": result.iterations, "residual": result.residual, "stationarity": result.stationarity,
        "order": module.metadata.order, "expected order": order_of_optima(module),
        "load seconds": result.seconds_code,
    }  # fmt: skip


def well_timed(module: GeneratedModule, driver: str, repeat: int, **options: Any) -> Result:
    """A result whose time is the least of `repeat` solves, of ten times as many where these take milliseconds."""
    result = api.solve(module, driver, repeat=1, **options)
    if repeat > 1 and result.seconds_solve < 1.0:
        return api.solve(module, driver, repeat=10 * repeat if result.seconds_solve < QUICKLY else repeat, **options)
    return result


def _reference(store: Store, problem: Path, trusted: Sequence[Variant], exact: float | None) -> Values:
    """The closed form, else the limit of the mesh sequence of the first scheme that has one."""
    if exact is not None:
        return {"cost": exact, "error": 1e-15 * abs(exact), "how": "closed form of the maximum principle"}
    for variant in trusted:
        values = store.get(orders_of(problem), variant.label)
        if values is not None and (found := limit(values)) is not None:
            how = f"{variant.label} on {values['steps'][0]} to {values['steps'][-1]} intervals, {found.how}"
            return {"cost": found.value, "error": found.error, "how": how, "scheme": variant.label}
    return {"cost": None, "error": None, "how": "no scheme has optima on three successive grids"}


def limit(values: Values) -> Limit | None:
    """Where the costs of a mesh sequence tend to; None for fewer than three grids."""
    if len(values["steps"]) < 3:
        return None
    if values["switching"]:
        return fitted_limit(*all_grids(values), values["expected order"])
    return limit_of(values["costs"], values["expected order"])


def _by_driver(module: ControlModule, driver: str, steps: int, repeat: int) -> Values:
    """A solution by one of scipy's methods; what does not apply is recorded with its reason."""
    return solved(module, steps, repeat if drivers.DRIVERS[driver].generated else 1, driver)


ELSEWHERE = 1e-3
"""Limits that differ by more than this part, and by ten times their errors, belong to different local optima."""
EXACT = 1e-9
"""Where no relative error is larger, there is nothing to converge."""
OCTAVES = 16
"""A fit is over so large a range of the number of intervals."""


@dataclass(frozen=True)
class Convergence:
    """A measured order with its verdict, unknowns whose bounds become active within the motion, finest N, remarks."""

    order: Order | None
    said: str
    switching: tuple[str, ...] = ()
    finest: int | None = None
    error: float | None = None
    remark: str = ""


def convergence_of(store: Store, problem: Path, variant: Variant, expected: int) -> Convergence:
    """What the mesh sequence of a scheme shows."""
    values = store.get(orders_of(problem), variant.label)
    own = None if values is None else limit(values)
    if values is None or own is None:
        failure = "" if values is None else values["failure"]
        return Convergence(None, "no optimum on three successive grids", remark=failure)
    reference = store.get(references_of(problem), "cost") or {}
    switching, target, floor, remark = tuple(values["switching"]), own.value, own.error, ""
    if reference.get("cost") is not None:
        cost, known_to = float(reference["cost"]), float(reference["error"])
        if abs(own.value - cost) <= ELSEWHERE * (abs(cost) or 1.0) + 10.0 * (own.error + known_to):
            target, floor = cost, known_to
        else:
            remark = f"another local optimum, whose cost tends to {own.value:.6g}"
    scale = abs(target) or 1.0
    steps, costs = all_grids(values)
    errors = [abs(cost - target) / scale for cost in costs]
    last: dict[str, Any] = {"switching": switching, "finest": steps[-1], "error": errors[-1], "remark": remark}
    if max(errors) < EXACT:
        return Convergence(None, "exact on every grid", **last)
    if switching:
        order = _fitted(steps, errors, floor / scale, variant.label == reference.get("scheme") or bool(remark))
    else:
        order = measured_order(steps, errors, floor / scale)
    if order is None and values["failure"]:
        last["remark"] = "; ".join(text for text in (remark, f"ended at {values['failure']}") if text)
    return Convergence(order, verdict(order, expected), **last)


def _fitted(steps: Sequence[int], errors: Sequence[float], floor: float, is_reference: bool) -> Order | None:
    """The order over the finest range that the reference allows, which is fitted to the finest quarter itself.

    Coarse grids count only down to the first that has an optimum of another kind.
    """
    top = steps[-1] // 4 if is_reference else steps[-1]
    rows = [(n, error) for n, error in zip(steps, errors, strict=True) if top <= OCTAVES * n and n <= top]
    kept = rows[max((i + 1 for i, (_, error) in enumerate(rows) if error > LARGE), default=0) :]
    return fitted_order([n for n, _ in kept], [error for _, error in kept], floor)
