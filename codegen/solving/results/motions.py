"""The results of simulations and of connect problems, with residuals that are evaluated outside the driver."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from codegen.errors import PointsError
from codegen.runtime.record import EventAction, Record, SimulationRecord
from codegen.solving.loading import Case, ConnectModule, Matrix, SimulateModule, Vector
from codegen.solving.results.result import (
    ConnectAttempt,
    MotionEvents,
    Outline,
    Result,
    Run,
    SimulateAttempt,
    component_names,
    contradicted,
    max_norm,
    origin,
    other_driver,
    outline_of,
)

UNITS = 1e4
"""Ratio of the perturbations, which measure the effect of rounding errors, to the rounding errors."""
PENETRATION = 1e-9
"""Largest penetration of a gap, relative to the state and the inverse of the time step."""
ROUNDING = 1e3 * float(np.finfo(float).eps)
"""Residual from rounding errors, relative to the state and the inverse of the time step."""
Numbers: TypeAlias = NDArray[np.intp]
FIRST_TIMES = 10
"""Number of times of each event that a sweep stores."""
_OF_GAPS = (EventAction.IMPACT, EventAction.REST, EventAction.OPENING)
TOLERANCE = 1e-12
"""Default tolerance of the arrival of particles."""


def simulate_result(
    module: SimulateModule, driver: str, run: Run, attempt: SimulateAttempt, seconds: float = math.nan
) -> Result:
    """Return the result of an attempt; if all states are stored, the residual is evaluated independently of the driver.

    `seconds` is the time of the fastest run. Residuals below the level of rounding errors are accepted. Variational
    schemes divide rounding errors by the time step h.
    """
    states, residual = np.hstack([attempt.q, attempt.p]), attempt.residual
    rounding = float(rounding_of(states, attempt.t[-1] / max(attempt.steps, 1)))
    scale = rounding / ROUNDING
    if attempt.events is None and run.every == 1 and attempt.t.size > 1:
        residual = module.path_residual(module.make_grid(run.steps), states)
        if residual > max(attempt.tolerance, rounding):
            rounding = max(rounding, 10.0 * rounding_level(module, run.steps, attempt.q, attempt.p))
    status, message = attempt.status, attempt.message
    if status == "solved" and not residual <= max(attempt.tolerance, rounding):
        finding = f"the scheme's equations have residual {residual:.1e}"
        status, message = contradicted(driver, finding, "try more steps")
    if status == "solved" and not attempt.generated and (first_outside := getattr(module, "first_outside", None)):
        number, table = first_outside(module.make_grid(run.steps), states)
        if number and run.every == 1:
            status, message = "outside a table", f"outside a table in step {number} of {run.steps}: {table}"
    names = component_names(module.metadata)
    final = dict(zip((*names["q"], *names["p"]), (*attempt.q[-1], *attempt.p[-1]), strict=True))
    summary = {"duration": float(attempt.t[-1]), **{f"final_{name}": float(value) for name, value in final.items()}}
    if attempt.energy is not None:
        # The energy of a driven or damped motion changes, and this change is no error of the scheme.
        with np.errstate(invalid="ignore"):  # the first energy may be infinite
            change = attempt.energy - attempt.energy[0]
        if module.metadata.conservative:
            summary["energy_drift"] = float(np.abs(change).max())
        else:
            summary["energy_change"] = float(change[-1])
    if isinstance(module.metadata, SimulationRecord) and module.metadata.constraints:
        from codegen.runtime.stepping.motion import constraint_errors  # imports numba

        errors = constraint_errors(module.make_grid(run.steps), states, attempt.t)
        count = len(module.metadata.constraints) - len(module.metadata.rolling)
        if count:
            summary["constraint_error"], summary["constraint_rate"] = map(float, errors[:, :count].max(axis=1))
        if module.metadata.rolling:
            summary["rolling_error"] = float(errors[1, count:].max())
    events = None
    if attempt.events is not None and isinstance(module.metadata, SimulationRecord):
        found, labels, actions = attempt.events, (*module.metadata.events, *module.metadata.gaps), tuple(EventAction)
        events = MotionEvents(
            tuple(labels[int(i)] for i in found.number), tuple(actions[int(i)] for i in found.action), found.t,
            found.before, found.after,
        )  # fmt: skip
        summary["events"] = float(len(events))
        if module.metadata.gaps:
            from codegen.runtime.stepping.motion import gap_values  # imports numba

            summary["least_gap"] = gap_values(module.make_grid(run.steps), states, attempt.t)
            if status == "solved" and not summary["least_gap"] > -PENETRATION * scale:
                finding = f"a gap is {summary['least_gap']:.1e}"
                status, message = contradicted(driver, finding, "try more steps")
    summary["steps_per_second"] = attempt.steps / seconds if seconds > 0.0 else float("inf")
    return Result(
        **origin(module.metadata, driver, run, attempt, seconds), status=status, message=message,
        residual=float(residual), t=attempt.t, q=attempt.q, p=attempt.p, energy=attempt.energy, names=names,
        summary=summary, labels={f"final_{name}": f"final {name}" for name in final}, events=events,
    )  # fmt: skip


def event_labels(metadata: Record) -> tuple[str, ...]:
    """Return the names of events, and the name of each gap with `impact`, `rest` and `opening`.

    These are the columns of a sweep. The tuple is empty for a module without events.
    """
    if not isinstance(metadata, SimulationRecord):
        return ()
    return (*metadata.events, *(f"{gap} {action}" for gap in metadata.gaps for action in _OF_GAPS))


def label_numbers(metadata: SimulationRecord, number: NDArray[np.float64], action: NDArray[np.float64]) -> Numbers:
    """Return the indices (M,) in `event_labels` of events, from their numbers and actions (M,), see `EventArrays`."""
    first, events = tuple(EventAction).index(_OF_GAPS[0]), len(metadata.events)
    of_gaps = events + len(_OF_GAPS) * (number - events) + action - first
    return np.asarray(np.where(number < events, number, of_gaps))


def event_tables(
    shape: tuple[int, int], case: Numbers, label: Numbers, t: Vector
) -> tuple[Matrix, NDArray[np.float64]]:  # fmt: skip
    """Return the numbers of events (n, labels), and the first times (n, FIRST_TIMES, labels) of each, and NaN.

    `shape` is (n, labels). The events of n motions, at the times t (M,), are sorted by `case` (M,) and by time.
    """
    key = np.ravel_multi_index((case, label), shape)
    counts, order = np.bincount(key, minlength=math.prod(shape)), np.argsort(key, kind="stable")
    occurrence = np.arange(key.size) - np.repeat(np.cumsum(counts) - counts, counts)
    first = order[occurrence < FIRST_TIMES]
    times = np.full((shape[0], FIRST_TIMES, shape[1]), np.nan)
    times[case[first], occurrence[occurrence < FIRST_TIMES], label[first]] = t[first]
    return counts.reshape(shape).astype(float), times


def simulate_outline(module: SimulateModule, driver: str, run: Run, attempt: SimulateAttempt) -> Outline:
    """Return the status and the arrays of an attempt, which a sweep stores."""
    outline, events = outline_of(simulate_result(module, driver, run, attempt)), attempt.events
    if events is not None and isinstance(module.metadata, SimulationRecord):
        label = label_numbers(module.metadata, events.number, events.action)
        shape = 1, len(event_labels(module.metadata))
        counts, times = event_tables(shape, np.zeros(label.size, np.intp), label, events.t)
        outline.arrays.update(event_counts=counts[0], event_times=times[0])
    return outline


def simulate_numbers(metadata: Record, run: Run) -> int:
    """Return the number of stored floating-point numbers: states, positions, momenta, times and energies."""
    return (1 - (-run.steps // run.every)) * (4 * len(metadata.coordinates) + 2)


def rounding_of(path: NDArray[np.float64], step: ArrayLike) -> NDArray[np.float64]:
    """Return a residual (..,) of paths (.., M, states) with steps (..,) that rounding errors alone can cause.

    A smaller residual needs no `rounding_level`, which takes two evaluations.
    """
    largest = np.maximum(1.0, np.nanmax(np.abs(path), axis=(-2, -1), initial=0.0))
    with np.errstate(divide="ignore"):
        inverse = np.where(np.asarray(step) > 0.0, 1.0 / np.asarray(step), 1.0)
    level: NDArray[np.float64] = ROUNDING * largest * np.maximum(1.0, inverse)
    return level


def rounding_level(module: SimulateModule, steps: int, q: Matrix, p: Matrix) -> float:
    """Return the residual that rounding errors cause: its increase if all states have errors of two units roundoff.

    `q` and `p` (M, n) are the states of all nodes of a grid of `steps` steps. Stiff forces amplify rounding errors. The
    states are perturbed by UNITS times the rounding errors, and the increase is divided by UNITS. The residual without
    perturbations is subtracted, so that a wrong state does not raise the level. The level is zero if it is not finite.
    """
    path, grid = np.hstack([q, p]), module.make_grid(steps)
    # Signs that alternate from node to node would cancel at midpoints, and equal signs would cancel in differences.
    signs = np.random.default_rng(0).choice((-1.0, 1.0), path.shape)
    moved = path + 2.0 * UNITS * signs * np.spacing(np.abs(path).max(axis=0))
    level = (float(module.path_residual(grid, moved)) - float(module.path_residual(grid, path))) / UNITS
    return max(0.0, level) if np.isfinite(level) else 0.0


def connect_result(
    module: ConnectModule, driver: str, run: Run, attempt: ConnectAttempt, seconds: float = math.nan
) -> Result:
    """Return the result of an attempt, with residuals that are evaluated independently of the driver.

    The equations of all steps and the arrival at the targets are evaluated. `seconds` is the time of the fastest run.
    """
    metadata, case, path = module.metadata, case_of(module, run), attempt.path
    energy = np.array([module.hamiltonian(np.ascontiguousarray(z), case.own, case.parameters) for z in path])
    finite = bool(np.isfinite(path).all())
    errors, end = module.path_errors(case, path) if finite else (np.full(1, np.nan), np.full(case.start.size, np.nan))
    arrival: Vector = np.abs(end).reshape(case.start.shape)
    if metadata.adaptive:  # the integrator chooses the steps; only the arrival is evaluated
        residual, cost = max_norm(end), float(2.0 * case.duration * energy[:-1].mean())
    else:
        residual = max(max_norm(errors.ravel()), max_norm(end))
        cost = float(module.path_cost(case, path)) if finite else math.nan
    status, message = attempt.status, attempt.message
    if status == "solved" and not residual <= 10.0 * attempt.tolerance:
        status, message = contradicted(driver, f"the equations have residual {residual:.1e}", other_driver(attempt))
    crossed = intersecting_paths(case.start, case.target)
    if status != "solved" and crossed:
        one, other = crossed[0]
        message += f"; the straight ways of {len(crossed)} pairs of points cross, first those of {one} and {other}"
    summary = {
        "particles": float(case.start.shape[0]),
        "largest_arrival_error": float(arrival.max()),
        "mean_arrival_error": float(arrival.mean()),
        "largest_miss": float(np.abs(path[-1, 0] - case.target).max()),
        "condition_number": condition_number(module, case),
        "crossing_pairs": float(len(crossed)),
        "energy_drift": float(np.abs(energy - energy[0]).max()),
        "domain_margin": min(float(module.domain_margin(np.ascontiguousarray(z))) for z in path),
        "attempts": float(max(1, len(attempt.attempts))),
        "tangents": float(attempt.tangents),
    }
    return Result(
        **origin(metadata, driver, run, attempt, seconds), status=status, message=message, cost=cost, residual=residual,
        t=case.duration / case.steps * np.arange(case.steps + 1.0), q=path[:, 0].reshape(case.steps + 1, -1),
        p=path[:, 1].reshape(case.steps + 1, -1), energy=energy, names=particle_names(metadata, case.start.shape[0]),
        summary=summary, attempts=attempt.attempts,
    )  # fmt: skip


def connect_outline(module: ConnectModule, driver: str, run: Run, attempt: ConnectAttempt) -> Outline:
    """Return the status and the arrays of an attempt, which a sweep stores."""
    return outline_of(connect_result(module, driver, run, attempt))


def connect_numbers(metadata: Record, run: Run) -> int:
    """Return the number of stored floating-point numbers.

    These are the states at all nodes with the data of Newton's method, and two matrices with a row for each particle.
    """
    count = 0 if run.points is None else len(run.points.start)
    return 40 * (run.steps + 1) * count * len(metadata.coordinates) + 2 * count**2


def particle_names(metadata: Record, count: int) -> dict[str, tuple[str, ...]]:
    """Return the names of the columns of q and p, sorted by particle; the number of the particle ends each name."""
    groups = {"q": metadata.coordinates, "p": metadata.rates, "u": ()}
    return {key: tuple(f"{name}_{i + 1}" for i in range(count) for name in group) for key, group in groups.items()}


def case_of(module: ConnectModule, run: Run) -> Case:
    """Return the case of a connect module for the points of a run; raise PointsError for unsuitable points."""
    points = run.points
    if points is None:
        raise PointsError("there are no points to connect", "give a file of points")
    tolerance = TOLERANCE if run.tolerance is None or module.metadata.adaptive else run.tolerance
    try:
        return module.make_case(
            points.start, points.target, run.steps, sigma=points.sigma, tolerance=min(tolerance, 1e-6)
        )
    except ValueError as error:
        raise PointsError(str(error), "correct the points, or the arguments") from error


def intersecting_paths(start: Vector, target: Vector) -> list[tuple[int, int]]:
    """Return the pairs of particles, numbered from 1, whose straight lines from start to target cross.

    `start` and `target` have the shape (n, d). Lines that only touch or overlap are not counted. The list is empty
    unless d = 2.
    """
    pairs = list[tuple[int, int]]()
    if start.shape[1] != 2:
        return pairs

    def side(a: Vector, b: Vector, c: Vector) -> Vector:
        product: Vector = (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1])
        return product - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])

    for i in range(len(start) - 1):
        p, q, r, s = start[i], target[i], start[i + 1 :], target[i + 1 :]
        crossed = (side(p, q, r) * side(p, q, s) < 0.0) & (side(r, s, p) * side(r, s, q) < 0.0)
        pairs += [(i + 1, i + 2 + int(j)) for j in np.flatnonzero(crossed)]
    return pairs


def condition_number(module: ConnectModule, case: Case, most: int = 1500) -> float:
    """Return the condition number of H_pp = d2H/dp2 in the 2-norm at the start; NaN for more than `most` rows."""
    size = case.start.shape[0] * int(module.BLOCKS)
    if size > most:
        return math.nan
    matrix = np.empty((size, size))
    module.momentum_matrix(np.stack([case.start, np.zeros_like(case.start)]), case.own, case.parameters, matrix)
    return float(np.linalg.cond(matrix)) if np.isfinite(matrix).all() else math.nan
