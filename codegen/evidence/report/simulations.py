"""What is measured of a problem that is simulated: errors of every scheme against steps and run time.

The order of a scheme in simulations, measured on a span of the motion in which the asymptotic range is reached. Over
many periods the error is a sum of terms that grow at different rates with time, and rounding grows with it, so that
between the coarsest useful step and the plateau no power of the step need prevail. On a span in which the state moves
by about its own size one does. The number of steps grows by a third of a doubling at a time until local orders have
settled; where rounding comes first, longer and shorter spans are tried.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from codegen.errors import CodegenError
from codegen.evidence.report.building import Variant, Workshop
from codegen.evidence.report.optima import well_timed
from codegen.evidence.report.orders import Order, is_exhausted, measured_order
from codegen.evidence.report.settings import Extent
from codegen.evidence.report.store import Case, Store, Values
from codegen.solving.loading import SimulateModule, Vector, is_simulation

TIGHT, LOOSE = 3e-14, 1e-13
"""Relative tolerances of the reference, and of the run that tells how far it can be trusted."""
_STATES = 3


@dataclass(frozen=True)
class Motion:
    """States (q, p) at M + 1 times, shape (M + 1, 2n); how far two tolerances differ, by component's size."""

    times: Vector
    states: Any
    error: float
    energy_scale: float
    how: str


def field_of(module: SimulateModule, duration: float) -> Callable[[float, Vector], Vector]:
    """The vector field of a problem, read off a step of its explicit Euler method: (z_1 - z_0)/h, for a long h.

    The step is linear in h, so that a long one loses no digits to the subtraction.
    """
    h = 2.0 ** math.ceil(math.log2(duration))
    grid: Any = module.make_grid(1, duration=h)
    return lambda t, z: np.asarray((module.step(grid, z, t) - z) / h)


def reference_motion(module: SimulateModule, checkpoints: int, duration: float | None = None) -> Motion:
    """DOP853 through the field of an explicit Euler module, restarted at every checkpoint.

    Without a `duration`, over the problem's own.
    """
    duration = duration_of(module) if duration is None else duration
    field, start, times = field_of(module, duration), start_of(module), np.linspace(0.0, duration, checkpoints + 1)
    runs = []
    for tolerance in (LOOSE, TIGHT):
        states = [start]
        size = float(np.abs(start).max()) or 1.0
        for first, last in pairwise(times):
            done = solve_ivp(field, (first, last), states[-1], "DOP853", rtol=tolerance, atol=tolerance * size * 1e-3)
            states.append(done.y[:, -1])
        runs.append(np.array(states))
    error = float((np.abs(runs[1] - runs[0]) / component_sizes(runs[1])).max())
    how = f"DOP853 at relative tolerance {TIGHT:g} through the explicit Euler module's own field"
    # The largest sum of |p_i dq_i/dt|, twice the kinetic energy where there is one, to compare errors of H with.
    half = runs[1].shape[1] // 2
    works = [np.abs(z[half:] * field(t, z)[:half]).sum() for t, z in zip(times, runs[1], strict=True)]
    return Motion(times, runs[1], error, (float(max(works)) or 1.0), how)


def component_sizes(states: Any) -> Vector:
    """The largest place for every place, and the largest momentum for every momentum; shape (2n,)."""
    size = np.abs(states).max(axis=0)
    half = size.size // 2
    return np.concatenate([np.full(half, part.max() or 1.0) for part in (size[:half], size[half:])])


def duration_of(module: SimulateModule) -> float:
    """The problem's own duration."""
    grid = module.make_grid(1)
    return float(grid.h * grid.steps)


def start_of(module: SimulateModule) -> Vector:
    """The initial state (q, p), flat."""
    return np.asarray(module.make_grid(1).start, dtype=float).ravel()


def conserved(module: SimulateModule) -> dict[str, Callable[[Any], Any]]:
    """Momenta that Noether's theorem conserves, by name, as functions of states of shape (..., 2n).

    A momentum whose rate is exactly zero at several states belongs to a cyclic coordinate (and no force acts on it).
    For particles in Cartesian axes the total momentum along an axis and angular momenta are tried in the same way,
    up to rounding.
    """
    field, start = field_of(module, duration_of(module)), start_of(module)
    generator, half = np.random.default_rng(0), start.size // 2
    size = np.where(start == 0.0, 0.1 * float(np.abs(start).max() or 1.0), np.abs(start))
    states = [start + 0.2 * size * generator.uniform(-1.0, 1.0, start.size) for _ in range(_STATES)]
    rates = [field(0.0, z) for z in states]
    found: dict[str, Callable[[Any], Any]] = {}
    if not hasattr(module, "DIMENSION"):
        for i, name in enumerate(module.metadata.momenta or module.metadata.rates):
            if all(rate[half + i] == 0.0 for rate in rates):
                found[f"momentum {name}"] = partial(_momenta, first=half + i, axes=2 * half)
        return found
    axes = int(module.DIMENSION)
    for a in range(axes):
        if all(_vanishes(rate[half + a :: axes]) for rate in rates):
            found[f"total momentum along axis {a + 1}"] = partial(_momenta, first=half + a, axes=axes)
    for a in range(axes):
        for b in range(a):
            if all(_vanishes(_turning_rate(z, rate, a, b, axes)) for z, rate in zip(states, rates, strict=True)):
                found[f"angular momentum in the plane {b + 1}, {a + 1}"] = partial(_turning, a=a, b=b, axes=axes)
    return found


def _vanishes(terms: Any) -> bool:
    return bool(abs(np.sum(terms)) <= 1e-10 * np.abs(terms).sum())


def _momenta(z: Any, first: int, axes: int) -> Any:
    return np.asarray(z)[..., first::axes].sum(-1)


def _turning(z: Any, a: int, b: int, axes: int) -> Any:
    z = np.asarray(z)
    half = z.shape[-1] // 2
    q, p = z[..., :half], z[..., half:]
    return (q[..., b::axes] * p[..., a::axes] - q[..., a::axes] * p[..., b::axes]).sum(-1)


def _turning_rate(z: Any, rate: Any, a: int, b: int, axes: int) -> Any:
    half = z.size // 2
    q, p, dq, dp = z[:half], z[half:], rate[:half], rate[half:]
    return np.concatenate(
        [dq[b::axes] * p[a::axes], q[b::axes] * dp[a::axes], -dq[a::axes] * p[b::axes], -q[a::axes] * dp[b::axes]]
    )


ORDER_CHECKPOINTS = 4
"""Intervals between the times at which errors are taken; their root mean square varies smoothly with the step."""
SPANS = (2.0, 4.0, 8.0, 1.0)
"""Spans in turn, in units of the time in which the state moves by its own size."""
ENOUGH = 0.01
"""Once local orders differ by no more than this, no more steps are taken."""
LEAST_RUNGS, MOST_STEPS = 12, 40_000


@dataclass(frozen=True)
class Span:
    """A part of the motion: its duration, in words, and the reference on it."""

    duration: float
    motion: Motion


class Spans:
    """Spans that are computed one after the other, when an iteration first comes to them."""

    def __init__(self, source: Iterator[Span]) -> None:
        """Take them from `source`."""
        self._source, self._known = source, list[Span]()

    def __iter__(self) -> Iterator[Span]:
        yield from self._known
        for span in self._source:
            self._known.append(span)
            yield span


def rungs() -> Iterator[int]:
    """Numbers of steps, multiples of the number of checkpoints that grow by a third of a doubling."""
    before = 0
    for k in range(100):
        steps = ORDER_CHECKPOINTS * round(2.0 * 2.0 ** (k / 3.0))
        if steps > MOST_STEPS:
            return
        if steps > before:
            yield steps
        before = steps


def spans_of(euler: SimulateModule, times: Sequence[float], states: Any) -> Iterator[Span]:
    """The spans of a problem, each made when it is asked for, with the motion by an explicit Euler module's field."""
    duration = duration_of(euler)
    field, sizes = field_of(euler, duration), component_sizes(states)
    speeds = [float(np.linalg.norm(field(t, z) / sizes)) for t, z in zip(times, states, strict=True)]
    unit = 1.0 / (float(np.median(speeds)) or 1.0 / duration)
    lengths = dict.fromkeys(min(duration, factor * unit) for factor in SPANS)
    for length in lengths:
        yield Span(length, reference_motion(euler, ORDER_CHECKPOINTS, length))


def order_values(module: SimulateModule, spans: Iterable[Span], limit: float) -> Values:
    """The first span on which local orders settle, with every error on it; else the last span, without an order.

    `limit` is how many seconds a solve may take before no more steps are tried.
    """
    found: dict[str, Any] = {}
    for span in spans:
        steps, errors = _ladder(module, span, limit)
        order = measured_order(steps, errors, span.motion.error)
        found = {"span": span.duration, "steps": steps, "errors": errors, "floor": span.motion.error}
        if order is not None:
            break
    return found


def order_from(values: Values | None) -> Order | None:
    """The order that stored errors show."""
    return None if values is None else measured_order(values["steps"], values["errors"], values["floor"])


def _ladder(module: SimulateModule, span: Span, limit: float) -> tuple[list[int], list[float | None]]:
    steps: list[int] = []
    errors: list[float | None] = []
    for count in rungs():
        begin = time.perf_counter()
        steps.append(count)
        errors.append(_error(module, span, count))
        order = measured_order(steps, errors, span.motion.error)
        enough = order is not None and order.spread <= ENOUGH and len(steps) >= LEAST_RUNGS
        if enough or is_exhausted(steps, errors) or (len(steps) > 1 and time.perf_counter() - begin > limit):
            break
    return steps, errors


def _error(module: SimulateModule, span: Span, count: int) -> float | None:
    """Root mean square over checkpoints and components of the state's error, by component's size."""
    solution: Any = module.solve(count, duration=span.duration, every=count // ORDER_CHECKPOINTS)
    if solution.status != "solved":
        return None
    shape = (ORDER_CHECKPOINTS + 1, -1)
    states: Vector = np.hstack([np.reshape(solution.q, shape), np.reshape(solution.p, shape)])
    wrong = (states - span.motion.states) / component_sizes(span.motion.states)
    error = float(np.sqrt(np.mean(wrong[1:] ** 2)))
    return error if math.isfinite(error) else None


CHECKPOINTS = 20
"""Intervals between the times at which trajectories are compared."""
BELOW = 1
"""The coarsest ladder step is the problem's own number of steps halved so often."""


def errors_of(problem: Path) -> str:
    """The section of the store that holds the errors of all schemes."""
    return f"{problem.stem}: errors"


def references_of(problem: Path) -> str:
    """The section of the store that holds the reference motion."""
    return f"{problem.stem}: reference"


def orders_of(problem: Path) -> str:
    """The section of the store that holds the measurements of orders."""
    return f"{problem.stem}: orders"


def case_name(variant: Variant, steps: int) -> str:
    """The name of a case."""
    return f"{variant.label}; N {steps}"


def ladder(own_steps: int, doublings: int) -> list[int]:
    """Numbers of steps: multiples of the number of checkpoints, doubled so often."""
    first = CHECKPOINTS * max(1, round(own_steps / 2**BELOW / CHECKPOINTS))
    return [first * 2**k for k in range(doublings + 1)]


def cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """The reference, then every scheme with ever more steps, until one takes too long or rounding has taken over."""
    store, built = workshop.store, workshop.built(variants)
    euler = [v for v in built if v.scheme == "explicit-euler"]
    if not euler:
        return
    yield Case(references_of(problem), "motion", lambda: _reference(_simulation(workshop, euler[0])))
    spans = _spans(_simulation(workshop, euler[0]), store, problem)
    for variant in built:
        yield Case(
            orders_of(problem),
            variant.label,
            lambda v=variant: order_values(_simulation(workshop, v), spans, extent.limit),  # type: ignore[misc]
        )
        own_steps = int(workshop.module(variant).metadata.steps)
        rungs = ladder(own_steps, extent.simulation_doublings)
        for steps in rungs:
            name = case_name(variant, steps)
            yield Case(
                errors_of(problem),
                name,
                lambda v=variant, n=steps: _errors(  # type: ignore[misc]
                    _simulation(workshop, v), _simulation(workshop, euler[0]), store, problem, n, extent.repeat
                ),
            )
            values = store.get(errors_of(problem), name)
            if values is not None and (values["seconds"] or 0.0) > extent.limit:
                break
            rows = [store.get(errors_of(problem), case_name(variant, n)) or {} for n in rungs if n <= steps]
            if is_exhausted(rungs[: len(rows)], [row.get("trajectory") for row in rows]):
                break


def _simulation(workshop: Workshop, variant: Variant) -> SimulateModule:
    module = workshop.module(variant)
    assert is_simulation(module)
    return module


def _spans(euler: SimulateModule, store: Store, problem: Path) -> Spans:
    """The spans on which orders are measured, each computed when it is first needed."""
    reference = store.get(references_of(problem), "motion")
    assert reference is not None
    return Spans(spans_of(euler, reference["times"], np.array(reference["states"], dtype=float)))


def _reference(module: SimulateModule) -> Values:
    motion = reference_motion(module, CHECKPOINTS)
    return {
        "times": motion.times,
        "states": motion.states,
        "error": motion.error,
        "energy scale": motion.energy_scale,
        "how": motion.how,
        "conserved": list(conserved(module)),
    }


def _errors(
    module: SimulateModule, euler: SimulateModule, store: Store, problem: Path, steps: int, repeat: int
) -> Values:
    """Largest errors at the checkpoints: of the state by component's size, of energy and conserved momenta."""
    reference = store.get(references_of(problem), "motion")
    assert reference is not None
    try:
        result = well_timed(module, "newton", repeat, steps=steps, every=steps // CHECKPOINTS)
    except CodegenError as error:  # such as too little memory
        return {"status": "refused", "message": str(error), "steps": steps, "seconds": None}
    found: dict[str, Any] = {
        "status": result.status, "steps": steps, "seconds": result.seconds_solve, "iterations": result.iterations,
        "residual": result.residual, "order": module.metadata.order,
    }  # fmt: skip
    if not result.solved:
        return found
    states, exact = np.hstack([result.q, result.p]), np.array(reference["states"], dtype=float)
    found["trajectory"] = float((np.abs(states - exact) / component_sizes(exact)).max())
    assert result.energy is not None
    times = reference["times"]
    parameters = euler.make_grid(1).parameters
    exact_energy = np.array([euler.energy(z, t, parameters) for z, t in zip(exact, times, strict=True)])
    found["energy"] = float(np.abs(result.energy - exact_energy).max()) / reference["energy scale"]
    momenta = conserved(euler)
    drifts = [_drift(momenta[name], states) for name in reference["conserved"]]
    if drifts:
        found["momentum"] = max(drifts)
    return found


def _drift(momentum: Any, states: Any) -> float:
    values = momentum(states)
    half = states.shape[-1] // 2
    return float(np.abs(values - values[0]).max() / (np.abs(states[:, half:]).max() or 1.0))
