"""The cases of a user's own problem, with expectations from the linearised motion, and the sentence on its schemes.

A simulation is compared with DOP853 of scipy, or Radau if it is stiff, on the vector field of an explicit Euler module.
The eigenvalues of the field's Jacobian along this motion tell which steps resolve the motion, and which are stable.
Optima, motions of particles and motions with holonomic constraints are compared with the same scheme on eight times as
many intervals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from codegen.discretise.particles import PARTICLE_SCHEMES
from codegen.discretise.schemes import METHODS, find, of_method
from codegen.discretise.schemes.base import FIRST_ORDER, Scheme
from codegen.errors import NumericsError
from codegen.evidence.stress import systems
from codegen.evidence.stress.cases import Case, Row, Setup, Truth, component_sizes, euler_field
from codegen.evidence.stress.motions import CONSTANT
from codegen.problem.points import read_points
from codegen.runtime.record import Form, Method
from codegen.solving.loading import (
    ControlModule,
    GeneratedModule,
    Matrix,
    SimulateModule,
    Vector,
    is_connect,
    is_of_particles,
    is_simulation,
    load,
)

SAMPLES = 40  # the number of times along the motion at which it is linearised
STIFF = 1e4  # the fastest decay times the duration above which an implicit integrator gives the exact motion
MOST_TIMES = 2000
SECONDS = 60.0
LOST = 1e3  # the amplification of a motion above which steps are expected to be unsuitable
GOOD = 0.1  # the largest error, relative to the sizes of components or to the cost, of a scheme that may be taken
GUESSES, ENOUGH = 20, 0.5  # the number of noisy guesses, and the share that is expected to lead to the optimum
CONTROL_SCHEMES = ("midpoint", "hermite-simpson", "gauss-4")
"""Schemes for optimal control in addition to the problem's own. Modules of optima compile slowly."""
Candidate = tuple[Setup, Scheme]


def cases_of(problem: Path, arguments: Mapping[str, str]) -> list[Case]:
    """Return the cases of a problem file for every scheme that may apply; raise CodegenError if it cannot be built."""
    from codegen.problem.sources import settings_of
    from codegen.solving import compiler

    default = load(compiler.build(problem, arguments).path)
    first = default.metadata.form == Form.FIRST_ORDER

    def candidate(method: str | None, scheme: Scheme) -> Candidate:
        return Setup(problem.absolute(), scheme.name, method, tuple(sorted(arguments.items()))), scheme

    if is_of_particles(default):
        points: tuple[tuple[float, ...], ...] = ()
        if is_connect(default):
            chosen = settings_of(problem, arguments).points
            file = Path(chosen) if chosen is not None else problem.parent / default.metadata.points
            read = read_points(file, len(default.metadata.coordinates))
            points = tuple((*map(float, a), *map(float, b)) for a, b in zip(read.start, read.target, strict=True))
        of_particles = [candidate(None, scheme) for scheme in PARTICLE_SCHEMES.values() if not scheme.adaptive]
        return [case for one in of_particles for case in refined_cases(default, one, points)]
    methods = (FIRST_ORDER,) if first else ("hamiltonian", "variational")
    if first and default.metadata.method == Method.HAMILTONIAN:  # a Lagrangian that is linear in the velocities
        methods = ("hamiltonian", FIRST_ORDER)
    if is_simulation(default) and default.metadata.constraints:  # explicit Euler gives no vector field
        usable = [scheme for scheme in of_method("variational") if len(scheme.discrete_lagrangian().nodes) == 2]
        return [case for s in usable for case in refined_cases(default, candidate("variational", s), ())]
    if is_simulation(default):
        candidates = [candidate(method, scheme) for method in methods for scheme in of_method(method)]
        if default.metadata.events or default.metadata.gaps:  # a vector field has no impacts
            return [case for one in candidates for case in refined_cases(default, one, ())]
        method = FIRST_ORDER if first else "hamiltonian"
        euler = compiler.build(problem, arguments, scheme="explicit-euler", method=method)
        field = load(euler.path)
        assert is_simulation(field)
        return motion_cases(field, candidates)
    own = default.metadata.method
    pairs: list[tuple[str, str]] = [(own, default.metadata.scheme)]
    for name in CONTROL_SCHEMES:
        pairs.append((FIRST_ORDER if first else own if name in METHODS[own] else "hamiltonian", name))
    named = dict.fromkeys(pairs)
    return [
        case for method, name in named for case in refined_cases(default, candidate(method, find(name, method)), ())
    ]


# ---- Motions ----


def motion_cases(module: SimulateModule, candidates: Sequence[Candidate]) -> list[Case]:
    """Return the cases of a simulation: largest stable step, its own step, and ten times this step.

    `module` is an explicit Euler module, whose step is linear in h: (z_1 - z_0)/h is the vector field.
    """
    steps = int(module.metadata.steps)
    coarse = max(1, steps // 10)
    truth, rates, moduli = exact_motion(module, (steps, coarse))
    duration = float(truth.times[-1])
    gaps = duration / max(1, len(rates) - 1)
    growths = np.maximum(rates.real, 0.0).max(axis=1)
    phase = float(gaps * moduli[1:].sum())
    amplified = math.exp(min(50.0, 2.0 * gaps * float(growths[1:].sum()))) if not math.isfinite(truth.energy) else 1.0
    fastest = rates.ravel()[np.abs(rates).argmax()]
    known = f"the fastest rate along the motion is {fastest if abs(fastest) == truth.rate else truth.rate:.3g}"
    cases = []
    for setup, scheme in candidates:
        stable = stable_rate(scheme, rates, truth.rate)

        def case(name: str, expect: str, reason: str, n: int, _setup: Setup = setup, **more: object) -> Case:
            return Case(
                name, _setup.problem, _setup, expect, reason, n, every=max(1, n // MOST_TIMES), truth=truth,
                seconds=SECONDS, **more,  # type: ignore[arg-type]
            )  # fmt: skip

        # Steps beyond a tenth of the duration are not tried. Implicit equations need steps that resolve the motion. If
        # motions grow at all steps, as by explicit Euler, the growth by exp(h lambda phase/2) is small for short steps.
        least = 0.5 * min(stable or 1.0 / (1.0 + phase), 1.0, 0.2 * duration * truth.rate)
        where = "at no step" if stable == 0.0 else "at any step" if math.isinf(stable) else f"up to {stable:.3g}"
        cases.append(case(
            "largest stable step", "bounded", f"{known}; the linear motion is stable {where}", steps, limit=True,
            bound=least,
        ))  # fmt: skip
        for name, n in ((f"{steps} steps, the problem's own", steps), (f"{coarse} steps, a tenth", coarse)):
            x, allowed = duration / n * truth.rate, tuple[str, ...]()
            factor = amplification(scheme, rates * duration / n, n)
            bound = x**scheme.order * (1.0 + phase) * amplified / CONSTANT.get(scheme.order, 1.0)
            if x < 0.5 and bound < 0.5:
                expect, reason, bound = "accurate", f"order {scheme.order} at h lambda = {x:.3g}, {known}", bound + 1e-8
            elif 0.6 * stable < x < 1.6 * stable:
                expect, reason = "unsuitable", f"h lambda = {x:.3g} is close to the limit, stable {where}"
                allowed, bound = ("bounded",), math.nan
            elif factor > LOST:
                reason = f"h lambda = {x:.3g}, stable {where}: the steps amplify a motion by {factor:.2g}"
                expect, bound = "unsuitable", math.nan
            elif factor > 1.0 + systems.GROWTH * n:
                reason = f"h lambda = {x:.3g}, stable {where}, but the steps amplify a motion by {factor:.2g} only"
                expect, allowed, bound = "bounded", ("unsuitable", "refused"), math.nan
            else:
                expect, reason, bound = "bounded", f"stable at h lambda = {x:.3g}, which does not resolve it", math.nan
                if not systems.preserves_areas(scheme) and math.isfinite(truth.energy):
                    factors = [math.log(max(abs(systems.area(scheme, r * duration / n)), 1e-300)) for r in moduli]
                    change = abs(math.expm1(min(n * float(np.mean(factors)), 700.0)))
                    reason = f"steps at h lambda = {x:.3g} change the energy by about {change:.2g} of itself"
                    expect = "unsuitable" if change > 0.5 else "bounded"
                    allowed = ("bounded", "unsuitable") if change > 0.1 else ()
                if x > 1.0:
                    reason, allowed = f"{reason}; implicit equations may have no solution there", (*allowed, "refused")
            drift = 0.5
            if systems.preserves_areas(scheme):
                drift = 1.0 if x >= 1.5 else min(1.0, 0.1 + 2.0 * systems.swing(scheme, x))
            cases.append(case(
                name, expect, reason, n, reference="exact_motion", bound=bound, h_omega=x, drift=drift, allowed=allowed
            ))  # fmt: skip
    return cases


def exact_motion(module: SimulateModule, grids: Sequence[int]) -> tuple[Truth, np.ndarray, Vector]:
    """Return the motion at the nodes of grids of so many steps, and rates along it.

    The rates are the eigenvalues (SAMPLES + 1, 2n), and the fastest rate (SAMPLES + 1,): the largest modulus of an
    eigenvalue, or the largest speed of a component relative to its size. A fall has speeds and no eigenvalues.
    """
    grid = module.make_grid(1)
    duration, start, parameters = float(grid.h), np.asarray(grid.start, dtype=float), grid.parameters
    field = euler_field(module, duration)

    def jacobian(t: float, z: Vector) -> Matrix:
        changes = 6e-6 * np.maximum(np.abs(z), 1e-3 * (np.abs(z).max() or 1.0))
        return np.array([(field(t, z + d) - field(t, z - d)) / (2.0 * d.max()) for d in np.diag(changes)]).T

    kept = [np.arange(0, n + 1, max(1, n // MOST_TIMES)) / n for n in grids]
    samples = np.linspace(0.0, 1.0, SAMPLES + 1)
    together = np.concatenate([samples, *kept])
    rounded, first = np.unique(together.round(12), return_index=True)  # times that differ by rounding are one time
    times, at_samples = duration * together[first], np.searchsorted(rounded, samples.round(12))

    def follow(method: str, tolerance: float) -> Matrix:
        size = float(np.abs(start).max()) or 1.0
        options = {"jac": jacobian} if method == "Radau" else {}
        done = solve_ivp(
            field, (0.0, duration), start, method, t_eval=times, rtol=tolerance, atol=tolerance * 1e-3 * size, **options
        )
        if not done.success:
            raise NumericsError(f"scipy's {method} does not follow the motion", "try a shorter duration")
        return np.asarray(done.y.T)

    loose = follow("Radau", 1e-6)[at_samples]
    rates = np.array([np.linalg.eigvals(jacobian(t, z)) for t, z in zip(times[at_samples], loose, strict=True)])
    is_stiff = max(0.0, -float(rates.real.min())) * duration > STIFF
    states = follow("Radau", 1e-11) if is_stiff else follow("DOP853", 3e-14)
    sizes, energy, conserved = component_sizes(module, states), math.nan, np.zeros(start.size, bool)
    if module.metadata.form != Form.FIRST_ORDER:
        half = start.size // 2
        conserved[half:] = (np.ptp(states, axis=0) <= 1e-10 * sizes)[half:]
        if module.metadata.conservative:
            rest = [np.concatenate([z[:half], 0.0 * z[half:]]) for z in states]
            potential, total = (
                np.array([module.energy(z, t, parameters) for z, t in zip(which, times, strict=True)])
                for which in (rest, states)
            )
            energy = float(max(np.ptp(potential), np.abs(total - potential).max()))
    speeds = [np.abs(field(times[i], states[i]) / sizes).max() for i in at_samples]
    moduli = np.maximum(np.abs(rates).max(axis=1), speeds)
    return Truth(times, states, sizes, conserved, energy, float(moduli.max())), rates, moduli


def stable_rate(scheme: Scheme, rates: np.ndarray, fastest: float) -> float:
    """Return the largest h times the `fastest` rate up to which the linear motion is stable at every time.

    Slow rates are left out: their growth within the duration is no instability of steps.
    """
    if not systems.is_runge_kutta(scheme):
        return float(systems.limit_along(scheme, 1j))
    important = rates[(np.abs(rates) > 0.1 * fastest) & (rates.real <= 1e-6 * fastest)]  # growth is no instability
    directions = {complex(round(r.real / abs(r), 2), round(abs(r.imag) / abs(r), 2)): abs(r) for r in important}
    limits = [systems.limit_along(scheme, d / abs(d)) * fastest / size for d, size in directions.items()]
    return float(min(limits, default=math.inf))


def amplification(scheme: Scheme, steps: np.ndarray, count: int) -> float:
    """Return the factor by which so many steps amplify a motion that decays or oscillates.

    The rows of `steps` (M, 2n) are h lambda at equidistant times.
    """
    growths = []
    for row in steps:
        if not row.any():  # a free fall neither decays nor oscillates
            growths.append(1.0)
        elif systems.is_runge_kutta(scheme):
            decaying = [z for z in row if z.real <= 1e-6 * abs(z)]
            growths.append(max((abs(systems.stability_function(scheme, z)) for z in decaying), default=1.0))
        else:
            growths.append(systems.growth(scheme, float(np.abs(row).max())))
    return math.exp(min(count * float(np.mean(np.log(np.maximum(growths, 1.0)))), 500.0))


def largest_stable(module: SimulateModule, truth: Truth) -> float:
    """Return the largest step times the fastest rate by which the motion stays near the exact one, by bisection.

    Zero stands for no step, infinity for all up to a tenth of the duration. A motion stays near if no component leaves
    the range of the exact motion by more than its size.
    """
    duration = float(truth.times[-1])
    low, high = truth.states.min(axis=0) - truth.sizes, truth.states.max(axis=0) + truth.sizes

    def is_stable(steps: int) -> bool:
        done = module.solve(steps, every=max(1, steps // MOST_TIMES))
        states = np.hstack([done.q, done.p])
        return bool(done.status == "solved" and np.isfinite(states).all() and ((states > low) & (states < high)).all())

    most = int(min(2e5, max(20.0, 100.0 * duration * truth.rate)))
    tried = sorted({round(n) for n in np.geomspace(10, most, 1 + math.ceil(3 * math.log2(most / 10)))}, reverse=True)
    unstable = next((n for n in tried if not is_stable(n)), 0)
    if unstable == tried[0]:
        return 0.0
    if unstable == 0:
        return math.inf
    stable = min(n for n in tried if n > unstable)
    while stable - unstable > max(1, stable // 200):
        middle = (stable + unstable) // 2
        stable, unstable = (middle, unstable) if is_stable(middle) else (stable, middle)
    return float(duration / stable * truth.rate)


# ---- Optima and particles ----


def refined_cases(default: GeneratedModule, candidate: Candidate, points: tuple[tuple[float, ...], ...]) -> list[Case]:
    """Return the cases of one scheme: its own grid, ten times as many intervals, a long horizon, noisy guesses."""
    setup, steps = candidate[0], int(default.metadata.steps)
    is_control = not (is_of_particles(default) or is_simulation(default))

    def case(name: str, reason: str, n: int, reference: str = "refined", **more: object) -> Case:
        return Case(
            name, setup.problem, setup, "accurate", reason, n, points=points, truth=Truth(), drift=math.nan,
            reference=reference, seconds=SECONDS, **more,  # type: ignore[arg-type]
        )  # fmt: skip

    reason = "the result announces its error, by comparison with half as many intervals"
    cases = [
        case(f"{steps} intervals, the problem's own", reason, steps),
        case(f"{10 * steps} intervals, ten times as many", reason, 10 * steps),
    ]
    if is_control:
        module: ControlModule = default  # type: ignore[assignment]
        try:
            horizon = 10.0 * float(module.make_grid(steps).h) * steps
            module.make_grid(steps, duration=horizon)
        except (TypeError, ValueError):  # the duration is an unknown
            horizon = math.nan
        if math.isfinite(horizon) and not module.problem.structure.phases and not module.metadata.waypoints:
            name = "horizon times ten, with ten times as many intervals"
            cases.append(case(name, reason, 10 * steps, values=(("duration", horizon),)))
        cases.append(case(
            f"{GUESSES} guesses with noise of a tenth", "half of the guesses lead to an optimum, none to a lower cost",
            steps, "", noise=0.1, guesses=GUESSES, bound=1.0 - ENOUGH,
        ))  # fmt: skip
    return cases


# ---- The verdict ----


def verdict(rows: Sequence[Row]) -> str:
    """Return a sentence on which scheme to take for a user's own problem, and which not."""
    by_scheme: dict[str, list[Row]] = {}
    for row in rows:
        by_scheme.setdefault(row.case.setup.label, []).append(row)
    own = {name: ours[1 if ours[0].case.limit else 0] for name, ours in by_scheme.items() if len(ours) > 1}
    solved = {name: row for name, row in own.items() if row.measurement.status == "solved"}
    good = {name: row for name, row in solved.items() if row.measurement.error < GOOD}
    kept = [name for name, row in solved.items() if name not in good and row.outcome == "bounded"]
    bad = [name for name in by_scheme if name not in good and name not in kept]
    words = [f"No scheme has an error below {GOOD:g} at the problem's own grid: take more steps."]
    if good:
        best = min(good, key=lambda name: good[name].measurement.error)
        words = [f"Take {best}: error {good[best].measurement.error:.1e} at the problem's own grid."]
        simple = [name for name, row in good.items() if row.measurement.error < 0.01 and name != best]
        quick = min(simple, key=lambda name: good[name].measurement.seconds, default=best)
        if good[quick].measurement.seconds < 0.7 * good[best].measurement.seconds:
            words.append(f"{quick} takes the least time of those below 0.01, with {good[quick].measurement.error:.1e}.")
    lower = [-row.measurement.error for row in rows if row.case.guesses and row.measurement.error < 0.0]
    if lower:
        words.append(f"The optimum is only local: a noisy guess leads to a cost lower by {max(lower):.1e} of itself.")
    if kept:
        words.append(f"For averages only, since the phase is lost: {', '.join(kept)}.")
    if bad:
        words.append(f"Do not take {', '.join(bad)}: wrong, unstable or without solution at this grid.")
    return " ".join(words)
