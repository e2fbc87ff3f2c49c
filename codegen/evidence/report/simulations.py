"""Simulations: errors of every scheme against steps and run time, measured orders, and the sections of the page.

Orders are measured on a short time span. Over many periods the error is a sum of terms that grow with time at different
rates, and rounding errors grow as well. Between the coarsest useful step and the plateau of rounding, no single power
of the time step need prevail. One power prevails on a span in which the state moves by about its own size. The number
of steps grows by a factor of 2^(1/3) until local orders have settled. If rounding errors dominate first, longer and
shorter spans are tried.

Long motions show the symplecticity of one generated step, and the trend of the energy error in time. The derivative S
of a step is computed by central differences of order ten. In double precision |S'JS - J| is then accurate to about
1e-13. A drift of the energy is a statistical question, because the error oscillates, and rounding makes it a random
walk. A straight line is fitted to the means over blocks of time. The standard error of its slope follows from the
residuals. It is larger if neighbouring residuals are correlated (Priestley 1981, Spectral analysis and time series,
section 5.3).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.stats import linregress

from codegen.errors import CodegenError
from codegen.evidence.report import building
from codegen.evidence.report import comparison as compare
from codegen.evidence.report.building import SURVEYS, Variant, Workshop
from codegen.evidence.report.page import Section, Table, listed, number, power_of_ten
from codegen.evidence.report.store import Case, Extent, Store, Values, section_of
from codegen.evidence.stress.cases import component_sizes, euler_field
from codegen.runtime.record import Form
from codegen.solving import api
from codegen.solving.loading import Matrix, SimulateModule, SimulateSolution, Vector
from codegen.solving.results.result import Result

TIGHT, LOOSE = 3e-14, 1e-13
"""The relative tolerances of the reference, and of a second run that shows the error of the reference."""
CHECKPOINTS = 20  # the number of intervals between the times at which trajectories are compared
BELOW = 3  # the number of halvings from the problem's own number of steps to the coarsest grid
ORDER_CHECKPOINTS = 4
"""The number of intervals between the times of errors for orders; their root mean square is smooth in h."""
SPANS = (2.0, 4.0, 8.0, 1.0)
"""The durations of the spans in the order of trial, in units of the time in which the state moves by its size."""
MOST_STEPS = 40_000
RUNGS = sorted({n for k in range(100) if (n := ORDER_CHECKPOINTS * round(2.0 * 2.0 ** (k / 3.0))) <= MOST_STEPS})
"""The numbers of steps for orders: multiples of ORDER_CHECKPOINTS that grow by about a third of a doubling."""
ENOUGH, LEAST_RUNGS = 0.01, 12
"""No further steps are tried once local orders differ by at most ENOUGH, after at least LEAST_RUNGS trials."""
AGREED, SETTLING, MOST_DOUBLINGS, SLOW = 1e-11, 1e-8, 14, 10.0
"""A reference by a scheme: the error at which refinement ends, the error below which a larger one is due to rounding,
the largest number of doublings of the steps, and the seconds of a solve after which no finer grid follows."""
_STATES = 3
_CLOCKS = ("seconds", "wall seconds")
_QUANTITIES = ("trajectory", "energy", "momentum")


def cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Yield cases: the reference, then each scheme with ever more steps until a solve is slow or rounding dominates.

    A motion with events, or with constraints, has no vector field without them. Its reference is the scheme of highest
    order with many steps, and orders are not measured on a short span.
    """
    store, modules = workshop.store, {v: workshop.simulation(v) for v in workshop.built(variants)}
    euler = next((module for v, module in modules.items() if v.scheme == "explicit-euler"), None)
    has_field = euler is not None and not any(getattr(euler.metadata, name, ()) for name in ("events", "gaps"))
    if not modules:
        return
    finest = max(modules, key=lambda v: (v.order, v.label))
    make = partial(_reference, euler) if has_field and euler else partial(_by_steps, modules[finest], finest.label)
    yield Case(section_of(problem, "reference"), "motion", make)
    reference = store.get(section_of(problem, "reference"), "motion")
    if reference is None or reference["times"] is None:
        return

    def order(module: SimulateModule) -> Values:
        assert euler is not None, "orders need a vector field"
        span = cache(partial(reference_motion, euler, ORDER_CHECKPOINTS))
        # Durations of the spans on which orders are measured, from the speeds along the reference motion.
        duration, states = _duration_of(euler), np.array(reference["states"], dtype=float)
        field, sizes = euler_field(euler, duration), component_sizes(euler, states)
        speeds = [float(np.linalg.norm(field(t, z) / sizes)) for t, z in zip(reference["times"], states, strict=True)]
        unit = 1.0 / (float(np.median(speeds)) or 1.0 / duration)
        durations = dict.fromkeys(min(duration, factor * unit) for factor in SPANS)
        return order_values(module, map(span, durations), extent.limit)

    runs: dict[str, Callable[[], object]] = {}
    for variant, module in modules.items():
        if has_field:
            yield Case(section_of(problem, "orders"), variant.label, partial(order, module))
        first = CHECKPOINTS * max(1, round(int(module.metadata.steps) / 2**BELOW / CHECKPOINTS))
        steps: list[int] = []
        errors: list[float | None] = []
        for doublings in range(extent.simulation_doublings + 1):
            steps.append(first * 2**doublings)
            name = variant.run(steps[-1])
            yield Case(section_of(problem, "errors"), name, partial(_errors, module, euler, reference, steps[-1]))
            values = store.get(section_of(problem, "errors"), name) or {}
            errors.append(values.get("trajectory"))
            if values.get("status") == "solved":
                runs[name] = building.solver(module, steps[-1], every=steps[-1] // CHECKPOINTS)
            if (values.get("seconds of first solve") or 0.0) > extent.limit or compare.is_exhausted(steps, errors):
                break
    yield from building.cases(problem, runs, store, extent.time_budget)


@dataclass(frozen=True)
class Motion:
    """A reference motion: states (q, p), or x, at M + 1 times, shape (M + 1, 2n).

    `error` is the difference between two tolerances, relative to the sizes of the components. `energy_scale` is the
    largest sum of |p_i dq_i/dt|, which is twice the kinetic energy if there is one, or 1 without momenta.
    """

    times: Vector
    states: Matrix
    error: float
    energy_scale: float
    how: str


def reference_motion(module: SimulateModule, checkpoints: int, duration: float | None = None) -> Motion:
    """Return the motion by DOP853 on the vector field of an explicit Euler module, restarted at each checkpoint.

    `checkpoints` is the number of intervals. The default duration is the problem's own.
    """
    duration = _duration_of(module) if duration is None else duration
    field, times = euler_field(module, duration), np.linspace(0.0, duration, checkpoints + 1)
    start = np.asarray(module.make_grid(1).start, dtype=float).ravel()
    runs = []
    for tolerance in (LOOSE, TIGHT):
        states = [start]
        size = float(np.abs(start).max()) or 1.0
        for first, last in pairwise(times):
            done = solve_ivp(field, (first, last), states[-1], "DOP853", rtol=tolerance, atol=tolerance * size * 1e-3)
            states.append(done.y[:, -1])
        runs.append(np.array(states))
    error = float((np.abs(runs[1] - runs[0]) / component_sizes(module, runs[1])).max())
    how = f"DOP853 at relative tolerance {TIGHT:g} through the explicit Euler module's own field; a looser tolerance"
    works = [0.0]
    if is_mechanical(module):
        half = runs[1].shape[1] // 2
        works = [np.abs(z[half:] * field(t, z)[:half]).sum() for t, z in zip(times, runs[1], strict=True)]
    return Motion(times, runs[1], error, (float(max(works)) or 1.0), how)


def is_mechanical(module: SimulateModule) -> bool:
    """Return True if the state has positions and momenta, and False for first-order dynamics."""
    return bool(module.metadata.form != Form.FIRST_ORDER)


def _duration_of(module: SimulateModule) -> float:
    grid = module.make_grid(1)
    return float(grid.h * grid.steps)


def conserved(module: SimulateModule) -> dict[str, Callable[[Matrix], Vector]]:
    """Return the momenta that Noether's theorem conserves, by name, as functions of states of shape (..., 2n).

    A momentum whose rate is exactly zero at several random states belongs to a cyclic coordinate on which no force
    acts. For particles in Cartesian coordinates, the total momentum along each axis and the angular momenta are tested
    in the same way, up to rounding errors. First-order dynamics have no momenta.
    """
    if not is_mechanical(module):
        return {}
    field, start = euler_field(module, _duration_of(module)), np.asarray(module.make_grid(1).start, dtype=float).ravel()
    generator, half = np.random.default_rng(0), start.size // 2
    size = np.where(start == 0.0, 0.1 * float(np.abs(start).max() or 1.0), np.abs(start))
    states = [start + 0.2 * size * generator.uniform(-1.0, 1.0, start.size) for _ in range(_STATES)]
    rates = [field(0.0, z) for z in states]
    momenta: dict[str, Callable[[Matrix], Vector]] = {}
    if not hasattr(module, "DIMENSION"):
        for i, name in enumerate(module.metadata.momenta or module.metadata.rates):
            if all(rate[half + i] == 0.0 for rate in rates):
                momenta[f"momentum {name}"] = partial(_total_momentum, first=half + i, axes=2 * half)
        return momenta
    axes = int(module.DIMENSION)

    def vanish(terms: Iterable[Vector | list[Vector]]) -> bool:
        return all(abs(np.sum(each)) <= 1e-10 * np.abs(each).sum() for each in terms)

    for a in range(axes):
        if vanish(rate[half + a :: axes] for rate in rates):
            momenta[f"total momentum along axis {a + 1}"] = partial(_total_momentum, first=half + a, axes=axes)
    for a in range(axes):
        for b in range(a):
            torques = []  # the terms of the rate of the angular momentum
            for z, rate in zip(states, rates, strict=True):
                (q, p), (dq, dp) = (np.reshape(each, (2, -1, axes)) for each in (z, rate))
                torques.append([dq[:, b] * p[:, a], q[:, b] * dp[:, a], -dq[:, a] * p[:, b], -q[:, a] * dp[:, b]])
            if vanish(torques):
                name = f"angular momentum in the plane {b + 1}, {a + 1}"
                momenta[name] = partial(_angular_momentum, a=a, b=b, axes=axes)
    return momenta


def _total_momentum(z: Matrix, first: int, axes: int) -> Vector:
    return np.asarray(z[..., first::axes].sum(-1))


def _angular_momentum(z: Matrix, a: int, b: int, axes: int) -> Vector:
    q, p = np.split(z, 2, axis=-1)
    return np.asarray((q[..., b::axes] * p[..., a::axes] - q[..., a::axes] * p[..., b::axes]).sum(-1))


def order_values(module: SimulateModule, spans: Iterable[Motion], limit: float) -> Values:
    """Return the errors by number of steps on the first span where local orders settle, else on the last span.

    On each span the number of steps grows until orders have settled, rounding errors dominate, or a solve takes more
    than `limit` seconds. An error is the root mean square over checkpoints and components, relative to component sizes.
    """
    values: Values = {}
    for motion in spans:
        duration, sizes = float(motion.times[-1]), component_sizes(module, motion.states)
        steps: list[int] = []
        errors: list[float | None] = []
        for count in RUNGS:
            begin = time.perf_counter()
            solution = module.solve(count, duration=duration, every=count // ORDER_CHECKPOINTS)
            error = math.nan
            if solution.status == "solved":
                error = float(np.sqrt(np.mean(((_states(solution) - motion.states) / sizes)[1:] ** 2)))
            steps.append(count)
            errors.append(error if math.isfinite(error) else None)
            order = compare.measured_order(steps, errors, motion.error)
            enough = order is not None and order.spread <= ENOUGH and len(steps) >= LEAST_RUNGS
            is_late = len(steps) > 1 and time.perf_counter() - begin > limit
            if enough or is_late or compare.is_exhausted(steps, errors):
                break
        values = {"span": duration, "steps": steps, "errors": errors, "floor": motion.error}
        if order is not None:
            break
    return values


def _reference(module: SimulateModule) -> Values:
    motion = reference_motion(module, CHECKPOINTS)
    energies = None
    if is_mechanical(module):
        parameters = module.make_grid(1).parameters
        energies = [module.energy(z, t, parameters) for z, t in zip(motion.states, motion.times, strict=True)]
    return {
        "times": motion.times, "states": motion.states, "error": motion.error, "energy scale": motion.energy_scale,
        "energies": energies, "of energies": "sum of |p q̇|", "how": motion.how, "conserved": list(conserved(module)),
    }  # fmt: skip


def _by_steps(module: SimulateModule, label: str) -> Values:
    """Return a reference by a scheme on ever finer grids, until two grids agree to `AGREED` or rounding dominates.

    Without two solved grids `times` is None, and `how` is the reason.
    """
    steps = CHECKPOINTS * max(1, round(int(module.metadata.steps) / CHECKPOINTS))
    best, error, coarse = None, math.inf, None
    for doubling in range(MOST_DOUBLINGS):
        try:
            fine = api.solve(module, steps=steps * 2**doubling, every=steps * 2**doubling // CHECKPOINTS)
        except CodegenError as reason:
            return {"times": None, "how": str(reason)}
        if not fine.solved:
            return {"times": None, "how": fine.message}
        if coarse is not None:
            states = _states(fine)
            change = _distance(module, _states(coarse), coarse.t, states, fine.t)
            if change < error:
                best, error = fine, change
            elif error < SETTLING:
                break  # rounding
        if error <= AGREED or fine.seconds_solve > SLOW:
            break
        coarse = fine
    if best is None:
        return {"times": None, "how": f"{label} is too slow for a second grid"}
    energies, works = best.energy, [1.0]
    if energies is not None:
        works = [float(np.ptp(energies)), float(np.abs(energies).max())]
    return {
        "times": best.t, "states": _states(best), "error": error, "energy scale": max(works) or 1.0,
        "how": f"{label} with {best.steps} steps; half as many steps", "energies": energies, "of energies": "energy",
        "conserved": [],
    }  # fmt: skip


def _states(motion: Result | SimulateSolution) -> Matrix:
    """Return the states (q, p) at all times as rows."""
    return np.hstack([np.reshape(part, (len(motion.t), -1)) for part in (motion.q, motion.p)])


def _distance(module: SimulateModule, states: Matrix, times: Vector, exact: Matrix, exact_times: Vector) -> float:
    """Return the largest error of the states at common checkpoints and at the end, and of the time of the end."""
    common, sizes = min(len(states), len(exact)) - 1, component_sizes(module, exact)
    errors = np.abs(np.vstack([states[:common] - exact[:common], states[-1:] - exact[-1:]])) / sizes
    return max(float(errors.max()), abs(float(times[-1] / exact_times[-1]) - 1.0))


def _errors(module: SimulateModule, euler: SimulateModule | None, reference: Values, steps: int) -> Values:
    """Return the largest relative errors at the checkpoints: of the state, the energy and the conserved momenta."""
    try:
        result = api.solve(module, steps=steps, every=steps // CHECKPOINTS)
    except CodegenError as error:  # such as too little memory
        return {"status": "refused", "message": str(error), "steps": steps}
    values: dict[str, float | str | None] = {
        "status": result.status, "steps": steps, "seconds of first solve": result.seconds_solve,
        "iterations": result.iterations, "residual": result.residual, "order": module.metadata.order,
    }  # fmt: skip
    if not result.solved:
        return values
    states, exact = _states(result), np.array(reference["states"], dtype=float)
    values["trajectory"] = _distance(module, states, result.t, exact, np.array(reference["times"], dtype=float))
    if result.energy is not None and len(result.energy) == len(exact):
        energy = np.array(reference["energies"], dtype=float)
        values["energy"] = float(np.abs(result.energy - energy).max()) / reference["energy scale"]
    if reference["conserved"] and euler is not None:
        momenta = conserved(euler)
        along = [momenta[name](states) for name in reference["conserved"]]
        size = np.abs(states[:, states.shape[-1] // 2 :]).max() or 1.0
        values["momentum"] = max(float(np.abs(momentum - momentum[0]).max() / size) for momentum in along)
    return values


def measured(store: Store, problem: Path, variant: Variant) -> compare.Measured:
    """Return the solves of a scheme, the errors of their trajectories, and the order measured on a short span."""
    rows = building.timed_rows(store, problem, variant, "errors")
    values = store.get(section_of(problem, "orders"), variant.label)
    order = None if values is None else compare.measured_order(values["steps"], values["errors"], values["floor"])
    errors = [row.get("trajectory") for row in rows]
    return compare.Measured(rows, errors, order, variant.order, compare.verdict(order, variant.order))


def sections(store: Store, problem: Path, variants: Sequence[Variant], title: str) -> list[Section]:
    """Return the section with errors against steps and time, and with a table of schemes."""
    reference = store.get(section_of(problem, "reference"), "motion")
    schemes = {v: m for v in variants if (m := measured(store, problem, v)).rows}
    if reference is None or not schemes:
        reason = f": {reference['how']}" if reference and reference["times"] is None else ""
        return [Section(title, (f"No scheme of this problem could be compared with a reference{reason}.",))]
    ladders = [
        compare.Ladder(v.label, v.order, [row["steps"] for row in m.rows], [row["seconds"] for row in m.rows],
                       {key: [row.get(key) for row in m.rows] for key in _QUANTITIES})
        for v, m in schemes.items()
    ]  # fmt: skip
    quantities = {
        key: reference["error"] if key == "trajectory" else 0.0
        for key in _QUANTITIES
        if any(error for ladder in ladders for error in ladder.errors[key])
    }
    sentences, choices = compare.choice(ladders, quantities)
    figures = compare.figures(ladders, quantities, "trajectory")
    spans = sorted({values["span"] for v in schemes if (values := store.get(section_of(problem, "orders"), v.label))})
    sentences.append(
        f"Errors are the largest at {len(reference['times']) - 1} equidistant times, relative to the largest position, "
        f"momentum or state, those of energy to the largest {reference['of energies']}. Reference: {reference['how']} "
        f"differs from it by {number(reference['error'], 2)}."
    )
    if reference["conserved"]:
        sentences.append(f"Conserved by Noether's theorem, and compared: {listed(reference['conserved'])}.")
    text = (
        f"Orders are measured on a short span of the motion, of duration {listed([number(s) for s in spans])}, so that "
        "rounding does not come before the asymptotic range. The number of steps N grows by a third of a doubling at a "
        f"time until the orders between neighbours agree within {compare.SETTLED:g} ({compare.SETTLED_HIGH:g} for high "
        f"orders) over a range of {compare.LEAST_RANGE:g} or more in N, at {compare.ABOVE_REFERENCE:g} times the "
        "reference's error or above. The finest such range counts. Without such a range, convergence is called not "
        "asymptotic."
    )
    # Orders, least errors, and the times to trajectory errors of 1e-3 and 1e-6.
    rows = []
    measurements = zip(schemes.items(), ladders, strict=True)
    for (variant, scheme), ladder in sorted(measurements, key=lambda pair: compare.speed(pair[1], "trajectory")):
        solved = [v for v in scheme.rows if v.get("trajectory") is not None]
        failures, last = len(scheme.rows) - len(solved), solved[-1] if solved else None
        rows.append((
            variant.label, str(variant.order), compare.order_text(scheme.order, scheme.verdict),
            scheme.order.range if scheme.order else "–",
            number(min((v["trajectory"] for v in solved), default=None), 2),
            number(min((v["energy"] for v in solved if "energy" in v), default=None), 2),
            *compare.reach_columns(ladder, ["trajectory"]),
            *(number(1e9 * last[key] / last["steps"]) if last and last[key] else "–" for key in _CLOCKS),
            str(failures) if failures else "",
        ))  # fmt: skip
    head = (
        "scheme", "stated order", "measured", "at N", "least error of trajectory", "of energy",
        *(f"time to {power_of_ten(target)}" for target in compare.TARGETS), "ns per step", "by the wall clock",
        "failed runs",
    )  # fmt: skip
    caption = "All schemes, fastest first: measured orders, least errors, processor time to an error of the trajectory."
    table = Table(caption, head, tuple(rows)).without_empty_columns()
    return [
        Section(title, tuple(sentences), (choices,), tuple(figures[:1])),
        Section(
            f"{problem.stem}: all schemes", (building.RULE, *([text] if spans else [])), (table,), tuple(figures[1:])
        ),
    ]


# ---- Long motions ----

STORED, BLOCKS = 2000, 50
"""The number of stored states of a long motion, and the number of time blocks over which they are averaged."""
SIGNIFICANT, BY_ROUNDING = 3.0, 10.0
"""The least significant t value of a slope, and the least ratio of its rise to the random walk by rounding errors."""
GROWN = 2.0  # the error has grown if its range exceeds GROWN times its range in the problem's own duration
_OFFSETS = np.array([-5, -4, -3, -2, -1, 1, 2, 3, 4, 5])
_WEIGHTS = np.array([-2, 25, -150, 600, -2100, 2100, -600, 150, -25, 2]) / 2520.0
_DISTANCE = 0.02
_MOST_FREEDOM = 8  # the largest number of components (q, p) of a state for which the derivative of a step is computed


def drift_cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Yield a case for each scheme; none without an energy, or if the extent has no long motion (`drift_steps` = 0)."""

    def measure(variant: Variant) -> Values:
        module = workshop.simulation(variant)
        api.solve(module, steps=1)  # compiles
        return drift_values(module, extent.drift_steps)

    for variant in workshop.built(variants) if extent.drift_steps else []:
        if not hasattr(workshop.simulation(variant), "energy"):
            continue
        yield Case(section_of(problem, "long motion"), variant.label, partial(measure, variant))


def drift_values(module: SimulateModule, steps: int) -> Values:
    """Return trend, oscillation and rounding error of the energy over `steps` steps, and the symplecticity defect."""
    grid = module.make_grid(int(module.metadata.steps))
    try:
        is_canonical = module.metadata.form != Form.FIRST_ORDER and grid.start.size <= _MOST_FREEDOM
        defect = symplecticity_defect(module, grid.h, np.ravel(grid.start)) if is_canonical else None
        first = module.solve(grid.steps, duration=grid.h * grid.steps)
        solution = module.solve(steps, duration=grid.h * steps, every=max(1, steps // STORED))
    except (CodegenError, ValueError) as error:
        return {"status": f"refused: {error}"}
    if solution.status != "solved":
        return {"status": solution.status, "defect": defect}
    states = _states(solution)
    assert solution.energy is not None, "a mechanical system has an energy"
    assert first.energy is not None, "a mechanical system has an energy"
    errors = solution.energy - solution.energy[0]
    trend = trend_of(solution.t, errors)
    # The energy error by rounding alone: half a unit in the last place of every component, in each of the steps.
    parameters, change = module.make_grid(1).parameters, []
    for z in states[:: max(1, len(states) // 20)]:
        slopes = []
        for i in range(z.size):
            shifted = z.copy()
            shifted[i] += 1e-6 * max(1.0, abs(z[i]))
            rise = module.energy(shifted, 0.0, parameters) - module.energy(z, 0.0, parameters)
            slopes.append(rise / (shifted[i] - z[i]) * z[i])
        change.append(float(np.sum(np.square(slopes))))
    return {
        "status": "solved", "steps": steps, "h": grid.h, "defect": defect, "energy": float(solution.energy[0]),
        "oscillation": float(np.ptp(errors)), "first": float(np.ptp(first.energy)),
        "rise": trend.rise, "standard error": trend.error, "t": trend.t,
        "rounding": float(2.0**-53 * np.sqrt(np.mean(change)) * np.sqrt(steps)),
    }  # fmt: skip


def symplecticity_defect(module: SimulateModule, h: float, state: Vector) -> float:
    """Return max |S'JS - J| with the derivative S of the step h at (q, p), by central differences of order ten."""
    half, columns = state.size // 2, []
    for i in range(state.size):
        distance = _DISTANCE * max(1.0, abs(state[i]))
        ends = []
        for offset in _OFFSETS:
            start = state.copy()
            start[i] += offset * distance
            solution = module.solve(1, duration=h, start=start)
            ends.append(np.concatenate([np.ravel(solution.q[-1]), np.ravel(solution.p[-1])]))
        columns.append(_WEIGHTS @ np.array(ends) / distance)
    derivative = np.array(columns).T
    form = np.block([[np.zeros((half, half)), np.eye(half)], [-np.eye(half), np.zeros((half, half))]])
    return float(np.abs(derivative.T @ form @ derivative - form).max())


@dataclass(frozen=True)
class Trend:
    """The rise of the fitted straight line over the whole time, and the standard error of the rise."""

    rise: float
    error: float

    @property
    def t(self) -> float:
        """Return the rise in standard errors."""
        return self.rise / self.error if self.error else 0.0


def trend_of(times: Vector, values: Vector) -> Trend:
    """Return the trend of oscillating values by block means; correlated residuals (lag one) enlarge its error."""
    size, duration = len(values) // BLOCKS, times[-1] - times[0]
    x, y = (np.reshape(column[: BLOCKS * size], (BLOCKS, size)).mean(axis=1) for column in (times, values))
    fit = linregress(x / duration, y)
    residuals = y - fit.intercept - fit.slope * x / duration
    square = float(residuals @ residuals)
    correlation = max(0.0, float(residuals[1:] @ residuals[:-1]) / square) if square else 0.0
    return Trend(float(fit.slope), float(fit.stderr * np.sqrt((1.0 + correlation) / (1.0 - correlation))))


def drift_section(store: Store, problem: Path, variants: Sequence[Variant], title: str) -> list[Section]:
    """Return the section with energy drift and symplecticity of all schemes, or an empty list without measurements."""
    measured = {
        v: values for v in variants if (values := store.get(section_of(problem, "long motion"), v.label)) is not None
    }
    if not measured:
        return []
    symplectic = {(m, s) for m, s, _, claimed, *_ in (store.get(SURVEYS, problem.stem) or {})["schemes"] if claimed}
    rows = []
    for variant, values in measured.items():
        claim = "yes" if (variant.method, variant.scheme) in symplectic else "no"
        if values["status"] == "solved":
            keys = ("oscillation", "first", "rise", "standard error", "t", "rounding")
            cells = (*(number(values[key], 2) for key in keys), trend_in_words(values))
        else:
            cells = (*["–"] * 6, values["status"])
        rows.append((variant.label, claim, number(values.get("defect"), 2), *cells))
    solved = next((values for values in measured.values() if values["status"] == "solved"), {"steps": 0, "h": 0.0})
    text = (
        "A straight line is fitted to the energy's error, averaged over "
        f"{BLOCKS} blocks of time; t is its rise over the whole time in standard errors. The trend is not told from "
        f"zero for |t| < {SIGNIFICANT:g}. A larger t with a rise below {BY_ROUNDING:g} times the random walk that "
        "rounding makes of the energy is put down to rounding, which no scheme escapes. |S'JS − J| is the defect of "
        "symplecticity of the emitted step, whose derivative is known to about 10⁻¹³. An error that swings by more "
        f"than {GROWN:g} times what it does in the problem's own duration has left its first swing, whatever t is."
    )
    head = ("scheme", "symplectic", "|S'JS − J|", "energy swings by", "in the problem's time", "rise of the trend",
            "its standard error", "t", "random walk by rounding", "trend")  # fmt: skip
    caption = f"Energy over {solved['steps']:,} steps of length {number(solved['h'])}, as the problem has them."
    return [Section(title, (text,), (Table(caption, head, tuple(rows)),))]


def trend_in_words(values: Values) -> str:
    """Return in a few words whether the energy drifts, and why."""
    walk = BY_ROUNDING * values["rounding"]
    if values["oscillation"] > GROWN * values["first"] + walk:
        return "leaves its first swing"
    if abs(values["t"] or 0.0) < SIGNIFICANT:
        return "none"
    return "rounding" if abs(values["rise"]) < walk else "drifts"
