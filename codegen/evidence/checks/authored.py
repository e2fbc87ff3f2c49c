"""The check of a generated module against the problem that its author wrote.

All other checks begin with the canonical model. This check reads the author's object itself, and shares no code with
the canonical model, the Legendre transforms, the discretisation and the symbolic derivatives of the package. So it
finds errors in the reading of a problem: a wrong sign of a force, a wrong end value, a wrong duration.

The parameters of the module get random values near their defaults. The author's numbers (duration, boundary values,
bounds) are compared with the numbers of the module's time grid, initial guess and bounds.

Functions of time are compared along smooth random motions q(t), u(t), which fulfil the author's boundary values. With
smooth weights w(t) that vanish at the ends, and the module's residuals R_k on 16, 32, ..., 256 intervals,

    sum_k w(t_k) R_k -> integral of w dL/dq + w' dL/dv + w f  (Lagrange-d'Alembert principle; weights are variations)

for a Lagrangian L and forces f. Hamilton's equations and first-order dynamics tend to the integrals of
w (q' - dH/dp), w (p' + dH/dq - f) and w (x' - f(x, u, t)). Weighted path conditions tend to the integrals of the
author's conditions, and costs to the author's costs. Limits are extrapolated by polynomials in 1/N. Reference
integrals use Gauss-Legendre quadrature. The limits of momentum equations at both ends vanish, because the motion has
the author's end velocities.

A step of a simulation from a random state, divided by its length, must tend to the author's equations of motion. With
constraints the state satisfies them, and momenta are compared along the directions that they leave free: virtual
displacements dq with G dq = 0 for holonomic constraints of gradient G, and A dq = 0 for rolling constraints A v + b.
In optimal control the module's forces kappa of constraints get smooth values of time, and the author's equations of
motion gain w G^T kappa and w A^T kappa.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, combinations
from types import ModuleType

import numpy as np
import sympy
from sympy.calculus.euler import euler_equations

from codegen.evidence.checks.author import (
    Array,
    Author,
    Motion,
    NoMotionError,
    Path,
    Relation,
    Values,
    integral_of,
    relations_of,
    value_at,
    values_along,
)
from codegen.evidence.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.evidence.checks.limits import (
    LIMIT,
    ROUNDING,
    Item,
    Leg,
    Sample,
    absent,
    body_label,
    extrapolated,
    fill_linking,
    free_mask,
    grid_of,
    limit_of,
    named,
    node_times,
    normals_of,
    number_item,
    quadrature,
    sampled,
    trial_force,
    weight,
    weighted_residual,
)
from codegen.identifiers import plain
from codegen.problem import symbols
from codegen.problem.description import quantities_in
from codegen.problem.particles import Connect, Pairwise
from codegen.problem.problem import Control, Event, Expression, Phases, Relations, Simulate
from codegen.problem.tables import Measurements
from codegen.runtime.record import Kind, Method, Sites
from codegen.solving.loading import Grid
from codegen.solving.request import parameter_arguments

NAME = "problem as written"
_SEEDS = (1, 2)  # one random motion for each seed
_AMPLITUDES = (0.25, 0.1, 0.03, 0.01)
"""Sizes of the random part of a motion, relative to its quantities, which are tried until all expressions are real."""
_ROUNDINGS = 4.0  # rounding error of the change in a step, in units in the last place of the state
_SCALES = (1.0, 1e-2, 1e-4, 1e-6)  # lengths of the steps whose limit is taken, relative to the problem's own
_MOST_NAMES = 8  # largest number of names in the text of a finding that passed
_NEAR = 1e-7  # distance of coordinates at which two particles count as coincident


def check_authored(context: Context) -> Iterator[Finding]:
    """Compare numbers, equations of motion, costs and conditions of the module with the author's problem."""
    written, module = context.written, context.module
    if not isinstance(written, (Control, Simulate, Phases)):
        yield does_not_apply(NAME, "the problem object of the author is not at hand")
        return
    author = Author(written, module)
    yield from _verdict("parameters", _parameter_items(author))
    if reason := author.reason_without_motion():
        yield not_measured(NAME, "all but the parameters", reason)
        return
    try:
        if isinstance(written, Simulate):
            yield from _simulation(author)
        else:
            yield from _verdict("duration", _duration_items(author))
            yield from _verdict("values at the start", _end_items(author, "start"))
            yield from _verdict("values at the end", _end_items(author, "end"))
            bounds = (i for i in _bound_items(author) if math.isfinite(i.author) or math.isfinite(i.module))
            yield from _verdict("bounds", bounds)
            items = dict[str, list[Item]]()
            for seed in _SEEDS:
                for subject, item in _measured_along(author, seed):
                    items.setdefault(subject, []).append(item)
            for subject in (
                "equations of motion",
                "velocities at the ends",
                "reported motion",
                "cost",
                "path conditions",
                "conditions",
            ):
                yield from _verdict(subject, items.get(subject, []))
    except NoMotionError as error:
        yield not_measured(NAME, "equations of motion and cost", str(error))


def _verdict(subject: str, items: Iterable[Item]) -> Iterator[Finding]:
    """Yield the finding of compared quantities: the names that differ, or else all names; nothing without items."""
    items = list(items)
    different = {item.name: item for item in reversed(items) if not item.agrees}
    unsure = [item for item in items if item.is_unsure]
    if different:
        texts = [
            f"{name} is missing in the module"
            if math.isnan(item.author)
            else f"{name} is {item.author:.9g} as written, {item.module:.9g} in the module"
            for name, item in different.items()
        ]
        yield Finding(NAME, subject, False, "; ".join(texts))
    elif unsure:
        yield not_measured(NAME, subject, f"the limit of {unsure[0].name} for short intervals converges too slowly")
    elif items:
        names = list(dict.fromkeys(item.name for item in items))
        text = (
            ", ".join(names)
            if len(names) <= _MOST_NAMES
            else f"{', '.join(names[:_MOST_NAMES])} and {len(names) - _MOST_NAMES} more"
        )
        limits = [item.difference / item.tolerance for item in items if item.error]
        how = f", up to {max(limits) * LIMIT:.0e} of all terms" if limits else ""
        yield Finding(NAME, subject, True, f"{text} as written{how}")


def _parameter_items(author: Author) -> Iterator[Item]:
    """Yield the default values of parameters, in the record and as arguments of the module's functions."""
    arguments, unused = parameter_arguments(author.module), set(map(plain, author.record.unused))
    defaults = {plain(name): (value, arguments[name]) for name, value in author.record.parameters.items()}
    functions = [inspect.signature(each).parameters for each in (author.module.make_grid, author.module.solve)]
    for parameter in author.parameters:
        if parameter.name in defaults:
            value, argument = defaults[parameter.name]
            yield number_item(parameter.name, float(parameter.value), value)
            for function in functions:
                yield number_item(parameter.name, float(parameter.value), function[argument].default)
        elif parameter.name not in unused:
            yield absent(parameter.name)


# ---- Optimal control ----


def _duration_items(author: Author) -> Iterator[Item]:
    module, grid = author.module, grid_of(author, author.levels[0])
    yield number_item("number of intervals", author.first.steps, author.record.steps)
    unknowns = module.initial_guess(grid)
    fill_linking(author, grid, unknowns)
    if grid.problem.phase_durations is None:
        yield number_item("T", author.durations[0], float(module.problem.duration_of(grid, unknowns)))
        return
    found = grid.problem.phase_durations(grid, unknowns)
    for number, (expected, length) in enumerate(zip(author.durations, found, strict=True), start=1):
        yield number_item(f"T of phase {number}", expected, float(length))


def _end_items(author: Author, where: str) -> Iterator[Item]:
    """Yield the values that are prescribed at an end, from the nodes of the module's initial guess.

    Velocities of a discrete Lagrangian are no unknowns. Here they need a momentum equation, which `_velocity_items`
    evaluates.
    """
    phase, record, module = author.phases[0 if where == "start" else -1], author.record, author.module
    written, grid = author.prescribed(where), grid_of(author, author.levels[0], as_written=True)
    is_variational, node = record.method == Method.VARIATIONAL, 0 if where == "start" else -1
    names = {plain(name) for name in getattr(record, where)}
    if is_variational and author.is_hamiltonian:  # the module has velocities in place of momenta
        momenta = {f"d{q}": str(q.partner) for q in author.coordinates}
        names = {momenta.get(name, name) for name in names}
    tied = {s for s, value in written.items() if sympy.sympify(value).free_symbols & set(author.free)}
    left_out = {s for s in written if s in tied or (s.name, where) in record.dependent_values}
    for symbol in written:
        if symbol.name not in names and symbol not in left_out:
            yield absent(symbol.name)
    for name in names - {symbol.name for symbol in written}:
        yield Item(name, math.inf, 0.0, 0.0)
    free = module.views(grid, free_mask(grid))[0][:, node]
    nodes = module.views(grid, module.initial_guess(grid))[0][:, node]
    indices = {plain(name): i for i, name in enumerate(record.node)}
    instant = np.array([0.0 if where == "start" else sum(author.durations)])
    for body in range(record.bodies):
        numbers = {s: float(value_at(value, author.numbers_of(body))) for s, value in written.items()}
        for symbol in (s for s in written if s not in left_out):
            name, expected = f"{symbol}{body_label(author, body)}", numbers[symbol]
            is_rate = isinstance(symbol, (symbols.Velocity, symbols.Momentum))
            if is_rate and is_variational:
                if not free[body, indices[f"lambda_{symbol.partner}"]]:  # nothing imposes it
                    yield absent(name)
                elif not author.is_hamiltonian:
                    found = _boundary_value(grid, author, f"{where} {symbol}", body, expected)
                    yield number_item(name, expected, found)
            elif isinstance(symbol, symbols.Velocity):
                index = indices[plain(record.rates[author.coordinates.index(symbol.partner)])]
                if not free[body, index]:
                    values = {**author.numbers_of(body), **numbers, author.time: instant}
                    momentum = values_along(sympy.diff(phase.lagrangian, symbol), values, instant)
                    yield number_item(name, float(momentum[0]), nodes[body, index])
            elif free[body, indices[symbol.name]]:
                yield absent(name)
            else:
                yield number_item(name, expected, nodes[body, indices[symbol.name]])


def _boundary_value(grid: Grid, author: Author, key: str, body: int, expected: float) -> float:
    """Return the parameter of a module that holds a prescribed velocity, such as "start dx"."""
    where, name = key.split()
    marked = next(str(other) for other in getattr(author.record, where) if plain(other) == name)
    changed = author.module.make_grid(
        **({"grid": np.diff(grid.nodes) / grid.steps} if author.record.inner_times else {"steps": author.levels[0]}),
        **author.arguments, **{where: {marked: expected + 1.0}},
    )  # fmt: skip
    (columns,) = np.nonzero(changed.parameters[body] != grid.parameters[body])
    return float(grid.parameters[body, columns[0]]) if columns.size else expected


def _bound_items(author: Author) -> Iterator[Item]:
    """Yield lower and upper bounds of all quantities, in the middle of each phase."""
    module, record, grid = author.module, author.record, grid_of(author, author.levels[0])
    unbounded = np.full(grid.is_multiplier.size, math.inf)
    lower, upper = module.variable_bounds(grid) if hasattr(module, "variable_bounds") else (-unbounded, unbounded)
    views = [module.views(grid, np.asarray(each)) for each in (lower, upper)]
    size = grid.steps // len(author.phases)
    for number, phase in enumerate(author.phases):
        of_phase = f" in phase {number + 1}" if len(author.phases) > 1 else ""
        present = set(quantities_in(phase))
        moving = {*author.coordinates, *author.rates, *(u for u in author.controls if u in present)}
        for body in range(record.bodies):
            for kind, names in enumerate((record.node, record.interval)):
                for index, name in enumerate(names):
                    symbol = named(author, name)
                    if isinstance(symbol, symbols.Velocity) or symbol not in moving:
                        continue
                    row = number * size + size // 2 + 1
                    for side, expected in enumerate(author.limits(phase, symbol, body)):
                        label = f"{('lower', 'upper')[side]} bound of {symbol}{of_phase}{body_label(author, body)}"
                        yield number_item(label, expected, float(views[side][kind][body, row, index]))
    windows = [getattr(each, "window", (None, None)) for each in getattr(author.first, "waypoints", ())]
    clock = next((i for i, name in enumerate(record.node) if record.waypoints and name.startswith("time_")), 0)
    for number, window in enumerate(windows):
        for side, value in enumerate(window):
            expected = (-math.inf, math.inf)[side] if value is None else float(value_at(value, author.constants))
            label = f"{('earliest', 'latest')[side]} time of waypoint {number + 1}"
            yield number_item(label, expected, float(views[side][0][0, grid.inner[number], clock]))
    first = grid.is_multiplier.size - grid.problem.structure.root
    for index, name in enumerate(record.shared):
        symbol = named(author, name)
        if symbol in author.free:
            yield from _free_bounds(author, symbol, float(lower[first + index]), float(upper[first + index]))


def _free_bounds(author: Author, symbol: sympy.Symbol, lower: float, upper: float) -> Iterator[Item]:
    """Yield the bounds of a free parameter; a duration without a lower bound has the bound zero."""
    written = [[getattr(symbol, "lower", None)], [getattr(symbol, "upper", None)]]
    for phase in author.phases:
        for side, value in enumerate(getattr(phase, "bounds", {}).get(symbol, (None, None))):
            written[side].append(value)
    for side, found in ((0, lower), (1, upper)):
        values = [float(value_at(value, author.constants)) for value in written[side] if value is not None]
        expected = values[0] if values else (-math.inf, math.inf)[side]
        if not values and side == 0 and any(phase.duration == symbol for phase in author.phases):
            expected = found if found == 0.0 else expected
        yield number_item(f"{('lower', 'upper')[side]} bound of {symbol}", expected, found)


def _measured_along(author: Author, seed: int) -> list[tuple[str, Item]]:
    """Return (subject, item) for all limits along the largest random motion on which they converge."""
    found, reason = list[tuple[str, Item]](), ""
    for amplitude in _AMPLITUDES:
        try:
            items = list(_limits_along(author, seed, amplitude))
        except NoMotionError as error:
            reason = str(error)
            continue
        found = found or items
        if not any(item.is_unsure for _, item in items):
            return items
    if not found:
        raise NoMotionError(reason)
    return found


def _limits_along(author: Author, seed: int, amplitude: float) -> Iterator[tuple[str, Item]]:
    """Yield (subject, item) for the limits of all residuals and of the cost along a random motion."""
    motions = [author.motions(seed, amplitude, body) for body in range(author.record.bodies)]
    samples = [sampled(author, motions, steps) for steps in author.levels]
    begins, costs = np.cumsum([0.0, *author.durations]), list[float]()
    for body, of_phases in enumerate(motions):
        for index, (phase, motion) in enumerate(zip(author.phases, of_phases, strict=True)):
            where = f" in phase {index + 1}" if len(author.phases) > 1 else ""
            leg = Leg(index, float(begins[index]), author.durations[index], body, where + body_label(author, body))
            t, weights = quadrature(leg.begin, leg.length)
            for name, (label, terms) in _equations(author, phase, motion(t), *weight(t, leg)).items():
                expected, size = sum(float(weights @ x) for x in terms), sum(float(weights @ np.abs(x)) for x in terms)
                sums = [weighted_residual(author, sample, leg, name) for sample in samples]
                yield "equations of motion", limit_of(f"{label}{leg.label}", expected, sums, size)
            if isinstance(phase, Control):
                yield from (("path conditions", item) for item in _path_items(author, phase, motion, leg, samples))
                # Both parts of the integral by their signs, the terminal cost, and all losses.
                running = values_along(author.cost(phase), motion(t).values, t)
                instant = np.array([leg.begin + leg.length])
                terminal = sympy.sympify(phase.terminal_cost) - sympy.sympify(phase.terminal_maximise)
                at_end = float(values_along(terminal, motion(instant).values, instant)[0])
                ends = [float(weights @ np.maximum(running, 0.0)), float(weights @ np.minimum(running, 0.0)), at_end]
                costs += [*ends, *_losses(phase, motion, leg)]
        yield from (("velocities at the ends", item) for item in _velocity_items(author, samples, of_phases, body))
        for end in ("start", "end"):
            yield from (("conditions", item) for item in _end_conditions(author, samples[0], of_phases, body, end))
    yield from (("reported motion", item) for item in _reported_items(author, samples[0], motions))
    for items in (
        _coupling_items(author, samples[0], motions),
        _periodic_items(author, samples[0]),
        _switch_items(author, samples, motions[0]),
        _integral_items(author, samples, motions),
        _inner_items(author, samples[0], motions[0][0]),
    ):
        yield from (("conditions", item) for item in items)
    yield "cost", limit_of("cost", sum(costs), [sample.cost for sample in samples], sum(map(abs, costs)))


def _losses(phase: Control, motion: Path, leg: Leg) -> Iterator[float]:
    """Yield the sum of the author's losses for each measured quantity of a body."""
    listed = [phase.observations] if isinstance(phase.observations, Measurements) else list(phase.observations)
    if not listed:
        return
    measured = listed[leg.body]
    rows, count = measured.data.array, len(measured.values)
    t = rows[:, 0]
    along = motion(t).values
    for column, quantity in enumerate(measured.values, start=1):
        errors = (values_along(quantity, along, t) - rows[:, column]) / rows[:, column + count]
        squares = errors[np.isfinite(errors)] ** 2
        match measured.loss:
            case "huber":
                losses = np.where(squares > 1.0, 2.0 * np.sqrt(squares) - 1.0, squares)
            case "soft-l1":
                losses = 2.0 * (np.sqrt(1.0 + squares) - 1.0)
            case _:
                losses = squares
        yield float(losses.sum())


def _path_items(author: Author, phase: Control, motion: Path, leg: Leg, samples: Sequence[Sample]) -> Iterator[Item]:
    """Yield the weighted path conditions and holonomic constraints of a phase."""
    record, (t, weights) = author.record, quadrature(leg.begin, leg.length)
    values, factors = motion(t).values, weights * weight(t, leg)[0]
    names = [name for name in (*record.interval, *record.node) if record.kind(name) in (Kind.PATH, Kind.NODAL)]
    found = [[weighted_residual(author, s, leg, plain(name), by_length=True) for s in samples] for name in names]
    constraints = [plain(name) for name in record.node if record.kind(name) == Kind.CONSTRAINT]
    constraints += [plain(name) for name in record.node if record.kind(name) == Kind.ROLLING]
    written = [(relation.name, relation.expression, -1) for relation in author.path(phase)]
    forced = (*phase.constraint, *(relation.expression for relation in relations_of(phase.rolling)))
    written += [(f"{c} = 0", c, index) for index, c in enumerate(forced)]
    for name, expression, index in written:
        g, label = values_along(expression, values, t), f"{name}{leg.label}"
        expected, size = float(factors @ g), float(np.abs(factors) @ np.abs(g))
        if index < 0:
            sums = _closest_limit(found, expected)
        elif index < len(constraints):
            sums = [weighted_residual(author, s, leg, constraints[index], by_length=True) for s in samples]
        else:
            sums = None
        yield absent(label) if sums is None else limit_of(label, expected, sums, size)


def _equations(
    author: Author, phase: Control | Simulate, along: Motion, w: Array, slope: Array
) -> dict[str, tuple[str, list[Array]]]:
    """Return the weighted equations of motion, by the name of the multiplier: a label, and terms of the integrand."""
    t, values = along.t, along.values
    if phase.dynamics is not None:
        return {
            f"mu_{x}": (str(x), [w * along.slopes[x], -w * values_along(phase.dynamics[x], values, t)])
            for x in author.coordinates
        }
    function = phase.hamiltonian if author.is_hamiltonian else phase.lagrangian
    found = dict[str, tuple[str, list[Array]]]()
    momenta = author.momenta(phase, values, t)
    normals = normals_of(phase, author.coordinates)
    for i, q in enumerate(author.coordinates):
        force = values_along(phase.force.get(q, 0), values, t)
        gradient = values_along(sympy.diff(function, q), values, t) * (-1.0 if author.is_hamiltonian else 1.0)
        terms = [w * gradient, slope * momenta[q], w * force]
        for number, normal in enumerate(normals):
            kappa = trial_force(author, number, t)
            terms.append(w * kappa * values_along(normal[i], values, t))
        if author.record.method == Method.VARIATIONAL:
            found[f"lambda_{q}"] = str(q), terms
            continue
        momentum = plain(author.record.rates[i])
        found[f"mu_{momentum}"] = momentum, [-term for term in terms]
        velocity = along.slopes[q]
        rate = values_along(sympy.diff(function, q.partner), values, t) if author.is_hamiltonian else velocity
        found[f"mu_{q}"] = str(q), [w * velocity, -w * rate]
    return found


def _reported_items(author: Author, sample: Sample, motions: Sequence[Sequence[Path]]) -> Iterator[Item]:
    """Yield times, coordinates and controls that the module reports for a motion, where they differ most."""
    record, size = author.record, sample.grid.steps // len(author.phases)
    times, positions, _, controls, _ = author.module.unpack(sample.grid, sample.unknowns)
    for body, of_phases in enumerate(motions):
        for index, (phase, motion) in enumerate(zip(author.phases, of_phases, strict=True)):
            # The node at a switch belongs to the phase before.
            t, first = node_times(author, sample.grid, index), 1 if index else 0
            rows, at_nodes = slice(index * size + first, (index + 1) * size + 1), motion(t).values
            pairs = [("t", times[rows], t[first:])]
            for column, name in enumerate(record.coordinates):
                reported = positions[rows, body * len(record.coordinates) + column]
                pairs.append((plain(name), reported, np.asarray(at_nodes[named(author, name)])[first:]))
            inside = motion((t[:-1] + t[1:]) / 2).values
            present = set(quantities_in(phase))
            for column, name in enumerate(record.control_names):
                if record.controls == Sites.INTERVAL and named(author, name) in present:
                    reported = controls[index * size : (index + 1) * size, body * len(record.control_names) + column]
                    pairs.append((plain(name), reported, np.asarray(inside[named(author, name)])))
            for name, reported, expected in pairs:
                worst = int(np.argmax(np.abs(reported - expected)))
                tolerance = ROUNDING * float(np.abs(expected).max()) + 1e-14
                yield Item(name, float(expected[worst]), float(reported[worst]), tolerance)


def _velocity_items(author: Author, samples: Sequence[Sample], motions: Sequence[Path], body: int) -> Iterator[Item]:
    """Yield the equations for prescribed velocities at both ends, which a motion with these velocities fulfils.

    A discrete Lagrangian has momentum equations. Other methods have the velocity itself, unless its momentum is fixed.
    """
    record, nodes = author.record, [plain(name) for name in author.record.node]
    is_variational = record.method == Method.VARIATIONAL
    for where, node, phase in (("start", 0, 0), ("end", -1, -1)):
        problem, written = author.phases[phase], author.ends(where, body)
        of_rates = [q for q in author.coordinates if author.rates and q.partner in written]
        if author.is_hamiltonian and not is_variational:
            continue  # momenta are unknowns, and were compared
        instant = np.array([0.0 if where == "start" else sum(author.durations)])
        values = motions[phase](instant).values
        momenta = author.momenta(problem, values, instant) if of_rates else {}
        t = instant + (1 if where == "start" else -1) * np.linspace(0.0, author.durations[phase], 33)
        largest = author.momenta(problem, motions[phase](t).values, t) if of_rates else {}
        of_body = body_label(author, body)
        for q in of_rates:
            if is_variational:
                rows = [float(sample.nodes[body, node, nodes.index(f"lambda_{q}")]) for sample in samples]
                limit, error = extrapolated(rows)
                p, size = float(momenta[q][0]), max(float(np.abs(largest[q]).max()), abs(rows[0]))
                expected = written[q.partner] if author.is_hamiltonian else p
                # The residual is the module's momentum less that of the motion, or its negative.
                sign = 1.0 if where == "start" else -1.0
                tolerance = LIMIT * max(size, abs(expected)) + 1e-12
                yield Item(f"p_{q} at the {where}{of_body}", expected, p + sign * limit, tolerance, error)
                continue
            free = author.module.views(samples[0].grid, free_mask(samples[0].grid))[0][body, node]
            if not free[nodes.index(plain(record.rates[author.coordinates.index(q)]))]:
                continue  # the momentum is fixed, and was compared
            multiplier, label = f"nu_{q.partner}", f"{q.partner} at the {where}{of_body}"
            if multiplier not in nodes or not free[nodes.index(multiplier)]:
                yield absent(label)
                continue
            velocity = float(np.ravel(values[q.partner])[0])
            residual = float(samples[0].nodes[body, node, nodes.index(multiplier)])
            yield Item(label, velocity, velocity + residual, 1e-9 * max(1.0, abs(velocity)))


def _end_conditions(author: Author, sample: Sample, motions: Sequence[Path], body: int, where: str) -> Iterator[Item]:
    """Yield the conditions at the start or at the end, and end values that depend on free parameters."""
    record, number = author.record, 0 if where == "start" else len(author.phases) - 1
    phase, node = author.phases[number], 0 if where == "start" else -1
    values = motions[number](np.array([0.0 if where == "start" else sum(author.durations)])).values
    relations = [r for r in relations_of(getattr(phase, f"{where}_conditions", ())) if not _end_values(r)]
    for symbol, value in getattr(phase, where, {}).items():
        if sympy.sympify(value).free_symbols & set(author.free):
            relations.append(Relation(f"{symbol} = {value}", symbol - value, True))
    decided = {name for name, end in record.decided_conditions if end == where}
    kind = Kind.START_CONDITION if where == "start" else Kind.END_CONDITION
    found = [float(sample.nodes[body, node, i]) for i, name in enumerate(record.node) if record.kind(name) == kind]
    for relation in relations:
        is_bound = not relation.equality and _is_bound_at(author, sample, relation, values, body, node)
        if relation.name not in decided and not is_bound:
            label = f"{relation.name} at the {where}{body_label(author, body)}"
            yield _closest_number(label, relation.expression, values, found)


def _end_values(relation: Relation) -> list[symbols.EndValue]:
    """Return the symbols of single bodies in a relation."""
    return [symbol for symbol in relation.expression.free_symbols if isinstance(symbol, symbols.EndValue)]


def _closest_number(label: str, expression: sympy.Expr, values: Values, found: Sequence[float]) -> Item:
    """Return the item of an expression, and of the residual of the module that is closest to its value."""
    expected = _number_at(expression, values)
    size = sum(abs(_number_at(term, values)) for term in sympy.Add.make_args(expression))
    if not found:
        return absent(label)
    closest = min(found, key=lambda value: abs(value - expected))
    return Item(label, expected, closest, ROUNDING * size + 1e-12)


def _number_at(expression: sympy.Expr, values: Values) -> float:
    return float(np.ravel(value_at(expression, values))[0])


def _is_bound_at(author: Author, sample: Sample, relation: Relation, values: Values, body: int, node: int) -> bool:
    """Return True if an inequality in one quantity is a bound of this unknown at one end."""
    moving = [s for s in relation.expression.free_symbols if s in (*author.coordinates, *author.rates)]
    names = [plain(name) for name in author.record.node]
    if len(moving) != 1 or moving[0].name not in names or not hasattr(author.module, "variable_bounds"):
        return False
    for bound in author.module.variable_bounds(sample.grid):
        limit = float(author.module.views(sample.grid, np.asarray(bound))[0][body, node, names.index(moving[0].name)])
        if math.isfinite(limit) and abs(_number_at(relation.expression, {**values, moving[0]: limit})) < 1e-9:
            return True
    return False


def _coupling_items(author: Author, sample: Sample, motions: Sequence[Sequence[Path]]) -> Iterator[Item]:
    """Yield the conditions between bodies at the end; with redundant conditions, none, because some are left out."""
    record, values = author.record, dict[sympy.Symbol, float | Array](author.constants)
    relations = [r for r in relations_of(getattr(author.phases[-1], "end_conditions", ())) if _end_values(r)]
    instant = np.array([sum(author.durations)])
    for symbol in (symbol for relation in relations for symbol in _end_values(relation)):
        q = symbol.partner
        values[symbol] = float(np.ravel(motions[symbol.body][-1](instant).values[q])[0])
        if q in author.shifts:  # the unknown is the value at the start
            first = motions[symbol.body][0](np.zeros(1)).values[q]
            values[symbol] = float(np.ravel(first)[0]) + float(value_at(author.shifts[q], author.constants))
    found = [float(sample.linking[i]) for i, n in enumerate(record.shared) if record.kind(n) == Kind.COUPLING]
    for relation in relations if not record.redundant_conditions else ():
        yield _closest_number(relation.name, relation.expression, values, found)


def _periodic_items(author: Author, sample: Sample) -> Iterator[Item]:
    """Yield, for periodic quantities that are unknowns of nodes, the value at the end less the value at the start."""
    names = [plain(name) for name in author.record.node]
    unknowns = np.linspace(0.3, 0.7, sample.grid.is_multiplier.size)
    nodes = author.module.views(sample.grid, author.module.with_pinned_values(sample.grid, unknowns))[0][0]
    for symbol, shift in author.shifts.items():
        if symbol.name in names:
            index, expected = names.index(symbol.name), float(value_at(shift, author.constants))
            label = f"{symbol} at the end less {symbol} at the start"
            yield number_item(label, expected, float(nodes[-1, index] - nodes[0, index]))


def _switch_items(author: Author, samples: Sequence[Sample], motions: Sequence[Path]) -> Iterator[Item]:
    """Yield the conditions at switches between phases, and the values with which the next phase begins."""
    record, ends = author.record, np.cumsum(author.durations)
    for switch, phase in enumerate(author.phases[:-1], start=1):
        instant = np.array([ends[switch - 1]])
        before, after = motions[switch - 1](instant).values, motions[switch](instant).values
        # The motion has the author's values at the end of a phase.
        names = [n for n in record.shared if record.kind(n) == Kind.SWITCH_CONDITION]
        names = [n for n in names if record.meanings[n].at == switch]
        found = [float(samples[0].linking[record.shared.index(name)]) for name in names]
        relations = [Relation(f"{x} = {value}", x - value, True) for x, value in getattr(phase, "end", {}).items()]
        for relation in (*relations, *relations_of(getattr(phase, "end_conditions", ()))):
            yield _closest_number(f"{relation.name} at switch {switch}", relation.expression, before, found)
        # The first interval after the switch begins with the values after the jump.
        momenta = author.momenta(author.phases[switch], after, instant) if author.rates else {}
        by_name = {q.name: after[q] for q in author.coordinates}
        by_name |= {plain(name): p for name, p in zip(record.rates, momenta.values(), strict=False)}
        compared = set[str]()
        for index, name in enumerate(record.interval):
            if record.kind(name) not in (Kind.STEP, Kind.SWITCH_MATCH) or name in record.stages:
                continue
            of, is_momentum = plain(record.meanings[name].of), record.kind(name) == Kind.SWITCH_MATCH
            value = momenta[author.quantities[of]] if is_momentum else by_name[of]
            rows = [float(s.intervals[0, switch * (s.grid.steps // len(author.phases)), index]) for s in samples]
            limit, error = extrapolated(rows)
            expected = float(np.ravel(value)[0])
            tolerance = LIMIT * max(abs(expected), abs(rows[0])) + 1e-12
            label = f"{'momentum of ' if is_momentum else ''}{of} after switch {switch}"
            compared.add(f"momentum of {of}" if is_momentum else of)
            yield Item(label, expected, expected + limit, tolerance, error)
        for symbol in dict(author.jumps[switch - 1]):
            # A discrete Lagrangian shows the jump of a position by a momentum that would be infinite without it.
            q = symbol if symbol in author.coordinates else symbol.partner
            of = f"momentum of {q}" if record.method == Method.VARIATIONAL else symbol.name
            if of == symbol.name and isinstance(symbol, symbols.Velocity):
                of = plain(record.rates[author.coordinates.index(q)])
            if of not in compared:
                yield absent(f"the jump of {symbol} at switch {switch}")


def _integral_items(author: Author, samples: Sequence[Sample], motions: Sequence[Sequence[Path]]) -> Iterator[Item]:
    """Yield the conditions on integrals over the motion of the single body in the single phase."""
    record = author.record
    if not isinstance(author.first, Control) or len(author.phases) > 1 or record.bodies > 1:
        return
    rows = [i for i, name in enumerate(record.shared) if record.kind(name) == Kind.INTEGRAL]
    found = [[float(sample.linking[i]) for sample in samples] for i in rows]
    given = author.first.integral
    t, weights = quadrature(0.0, author.durations[0])
    along = motions[0][0](t).values
    for name, relation in given.items() if isinstance(given, Mapping) else [("", each) for each in given]:
        integrand, limit = integral_of(relation, {s for s in along if np.ndim(along[s])})
        g, c = values_along(integrand, along, t), float(value_at(limit, author.constants))
        label, expected = f"integral {name or relation}", float(weights @ g) - c
        sums = _closest_limit(found, expected)
        yield absent(label) if sums is None else limit_of(label, expected, sums, float(weights @ np.abs(g)) + abs(c))


def _closest_limit(found: Sequence[list[float]], expected: float) -> list[float] | None:
    """Return the sequence whose limit is closest to a value; None without sequences."""
    if not found:
        return None
    return min(found, key=lambda values: abs(extrapolated(values)[0] - expected))


def _inner_items(author: Author, sample: Sample, motion: Path) -> Iterator[Item]:
    """Yield the inner times that the author fixes, and the conditions at all inner times."""
    record, at, groups = author.record, getattr(author.first, "at", {}), list[Relations]()
    times = node_times(author, sample.grid, 0)
    for index, instant in enumerate(sorted(at, key=lambda instant: float(value_at(instant, author.constants)))):
        expected, found = float(value_at(instant, author.constants)), float(times[sample.grid.inner[index]])
        yield number_item(f"inner time {index + 1}", expected, found)
        groups.append(at[instant])
    groups += [getattr(each, "conditions", each) for each in getattr(author.first, "waypoints", ())]
    for index, group in enumerate(groups):
        node = sample.grid.inner[index]
        values = motion(times[node : node + 1]).values
        found_here = [float(sample.nodes[0, node, i]) for _, other, i in record.inner_conditions if other == index]
        for relation in relations_of(group):
            yield _closest_number(f"{relation.name} at inner time {index + 1}", relation.expression, values, found_here)


# ---- Simulations ----


def _simulation(author: Author) -> Iterator[Finding]:
    """Compare a module that computes a motion with the author's problem."""
    module, arguments, phase = author.module, author.arguments, author.first
    grid = module.make_grid(author.levels[0], **arguments)
    duration = number_item("T", author.durations[0], grid.h * grid.steps)
    yield from _verdict("duration", [duration, number_item("number of steps", phase.steps, author.record.steps)])
    numbers = author.constants
    start: dict[sympy.Symbol, float | Array] = {**numbers, author.time: np.zeros(1)}
    start |= {s: np.array([float(value_at(value, numbers))]) for s, value in phase.start.items()}
    start |= {v: np.zeros(1) for v in author.rates if author.is_linear}
    momenta = author.rates if author.is_hamiltonian else [f"p_{q}" for q in author.coordinates if author.has_momenta]
    names = [*author.coordinates, *momenta]
    expected = _state(author, start)
    pairs = zip(names, expected, grid.start, strict=True)
    yield from _verdict("values at the start", [number_item(str(n), a, b) for n, a, b in pairs])
    motions, energies, written, generator = list[Item](), list[Item](), list[Item](), np.random.default_rng(5)
    moving = [*author.coordinates, *author.rates]
    for _ in range(3):
        values: dict[sympy.Symbol, float | Array] = dict(start)
        for s in moving:
            size = np.abs(start[s]) + 0.1
            values[s] = start[s] + 0.2 * size * generator.uniform(-1.0, 1.0)
        t = generator.uniform(0.0, author.durations[0], 1)
        values[author.time] = t
        free = _constrained(author, values, t)
        state, terms = _state(author, values), _rates(author, values, t)
        rates, sizes = (free @ [sum(row) for row in terms], np.abs(free) @ [sum(map(abs, row)) for row in terms])
        sizes += 1e-6 * max(sizes)
        limits = _step_limits(author, state, float(t[0]), sizes, free)
        along = [f"momentum {i + 1} along the constraints" for i in range(len(free) - len(author.coordinates))]
        labels = names if len(free) == len(state) else [*author.coordinates, *along]
        for name, rate, size, (limit, error) in zip(labels, rates, sizes, limits, strict=True):
            motions.append(Item(str(name), float(rate), limit, LIMIT * size, error))
        if author.rates and (energy := getattr(module, "energy", None)) is not None:
            exact, moduli = _energy(author, values, t)
            parameters = module.make_grid(1, **arguments).parameters
            energies.append(Item("H", exact, float(energy(state, float(t[0]), parameters)), 1e-10 * moduli))
        written.extend(_events(author, values, state, float(t[0])))
    yield from _verdict("equations of motion", motions)
    yield from _verdict("energy", energies)
    yield from _verdict("events and gaps", written)


def _events(author: Author, values: dict[sympy.Symbol, float | Array], state: Array, t: float) -> Iterator[Item]:
    """Yield values of events and gaps, restitutions, and states after events, as written and in the module."""
    phase = author.first
    events = {name: e if isinstance(e, Event) else Event(e) for name, e in getattr(phase, "events", {}).items()}
    gaps = relations_of(getattr(phase, "unilateral", ()))
    if not events and not gaps:
        return
    module, number = author.module, partial(_number_along, values=values, t=np.array([t]))
    parameters = module.make_grid(1, **author.arguments).parameters

    expressions = {**{name: e.expression for name, e in events.items()}, **{gap.name: -gap.expression for gap in gaps}}
    numbers = np.empty((len(expressions), 3))
    module.event_values(state, t, parameters, numbers)
    for (name, expression), row in zip(expressions.items(), numbers, strict=True):
        yield number_item(name, number(expression), float(row[0]))
    changing = {name: e.then for name, e in events.items() if isinstance(e.then, Mapping)}
    jumps = np.empty((len(changing), state.size))
    if changing:
        module.event_jumps(state, t, parameters, jumps)
    for (name, then), row in zip(changing.items(), jumps, strict=True):
        after = _state(author, {**values, **{symbol: np.array([number(value)]) for symbol, value in then.items()}})
        yield from (number_item(f"state {i + 1} after {name}", a, b) for i, (a, b) in enumerate(zip(after, row)))
    normals = np.empty((len(gaps), 3 + state.size))
    if gaps:
        module.gap_normals(state, t, parameters, normals)
    given = getattr(phase, "restitution", 1)
    given = given if isinstance(given, (list, tuple)) else [given] * len(gaps)
    for gap, restitution, row in zip(gaps, given, normals, strict=True):
        yield number_item(f"restitution of {gap.name}", number(restitution), float(row[1]))


def _constrained(author: Author, values: dict[sympy.Symbol, float | Array], t: Array) -> Array:
    """Move coordinates and velocities onto the constraints; return the free directions (rows, state).

    The rows of the result are all directions of coordinates, then an orthonormal basis of the momenta without forces
    of the constraints. Raise NoMotionError if the constraints cannot be satisfied near the given values.
    """
    size, constraints = len(author.coordinates), relations_of(getattr(author.first, "constraint", ()))
    rolling = [relation.expression for relation in relations_of(getattr(author.first, "rolling", ()))]
    if not constraints and not rolling:
        return np.eye(2 * size if author.has_momenta else size)

    def numbers(expressions: Iterable[Expression]) -> Array:
        return np.array([_number_along(e, values, t) for e in expressions])

    written = [relation.expression for relation in constraints]
    slopes = [sympy.diff(c, q) for c in written for q in author.coordinates]
    for _ in range(50 if written else 0):
        gradients = numbers(slopes).reshape(len(written), size)
        change = np.linalg.pinv(gradients) @ numbers(written)
        for q, correction in zip(author.coordinates, change, strict=True):
            values[q] = values[q] - correction
        if np.abs(change).max() < 1e-14 * (1.0 + max(np.abs(values[q]).max() for q in author.coordinates)):
            break
    else:
        if written:
            raise NoMotionError("the constraints have no solution near the start")
    normals = normals_of(author.first, author.coordinates)
    gradients = numbers(chain.from_iterable(normals)).reshape(len(normals), size)
    clock = sympy.Dummy("t")  # authors must not differentiate by the time, which has other rules in their expressions
    partial = [sympy.diff(c.xreplace({author.time: clock}), clock).xreplace({clock: author.time}) for c in written]
    velocities = np.array([np.ravel(values[v])[0] for v in author.rates])
    excess = np.append(gradients[: len(written)] @ velocities + numbers(partial), numbers(rolling))
    for v, correction in zip(author.rates, np.linalg.pinv(gradients) @ excess, strict=True):
        values[v] = values[v] - correction
    tangents = np.linalg.svd(gradients)[2][len(gradients) :]
    return np.block([[np.eye(size), np.zeros((size, size))], [np.zeros((len(tangents), size)), tangents]])


def _step_limits(author: Author, state: Array, t: float, sizes: Array, directions: Array) -> list[tuple[float, float]]:
    """Return the limit of the change per time for short steps along `directions` (rows, state), and its error.

    Of several step lengths, down to a millionth of the problem's own, those with the least errors relative to `sizes`
    are taken: stiff dynamics need short steps, and very short steps have rounding errors. The error contains the
    rounding error of the quotient, of a few units in the last place of the state over the shortest step.
    """
    found = list[list[tuple[float, float]]]()
    rounding = _ROUNDINGS * np.finfo(float).eps * (np.abs(directions) @ np.abs(state))
    for scale in _SCALES:
        rows = []
        for h in (scale * author.durations[0] / author.first.steps / 2**i for i in range(1, 6)):
            grid = author.module.make_grid(1, **author.arguments, duration=h)
            rows.append(directions @ (np.asarray(author.module.step(grid, state, t)) - state) / h)
        limits = [extrapolated(column) for column in zip(*rows, strict=True)]
        found.append([(limit, error + own / h) for (limit, error), own in zip(limits, rounding, strict=True)])

    def worst(limits: list[tuple[float, float]]) -> float:
        """Return the largest relative error, infinite if any error is not a number."""
        errors = [error / size for (_, error), size in zip(limits, sizes, strict=True)]
        return max(errors) if all(map(math.isfinite, errors)) else math.inf

    return min(found, key=worst)


def _number_along(expression: Expression, values: Values, t: Array) -> float:
    return float(values_along(expression, values, t)[0])


def _state(author: Author, values: Values) -> Array:
    """Return the module's state at values of coordinates and velocities (or momenta, or states)."""
    t = np.zeros(1)
    momenta = author.momenta(author.first, values, t) if author.has_momenta else {}
    parts = [values[q] for q in author.coordinates] + [momenta[q] for q in momenta]
    return np.array([float(np.ravel(part)[0]) for part in parts])


def _rates(author: Author, values: Values, t: Array) -> list[list[float]]:
    """Return the terms of the derivative of each entry of the state."""
    phase, number = author.first, partial(_number_along, values=values, t=t)
    if phase.dynamics is not None:
        return [[number(phase.dynamics[x])] for x in author.coordinates]
    if author.is_linear:
        return _determined_velocities(author, number)
    function, sign = (phase.hamiltonian, -1.0) if author.is_hamiltonian else (phase.lagrangian, 1.0)
    rates = [[number(sympy.diff(function, v)) if author.is_hamiltonian else number(v)] for v in author.rates]
    forces = [[sign * number(sympy.diff(function, q)), number(phase.force.get(q, 0))] for q in author.coordinates]
    return rates + forces


def _determined_velocities(author: Author, number: Callable[[Expression], float]) -> list[list[float]]:
    """Return the terms of the velocities by sympy's Euler-Lagrange equations, which are linear in the velocities."""
    phase, clock = author.first, sympy.Dummy("t")
    motions = [sympy.Function(f"motion_{q}")(clock) for q in author.coordinates]
    moving = dict(zip(author.coordinates, motions, strict=True)) | {author.time: clock}
    moving |= {v: motion.diff(clock) for v, motion in zip(author.rates, motions, strict=True)}
    written = euler_equations(sympy.sympify(phase.lagrangian).xreplace(moving), motions, [clock])
    back: list[dict[sympy.Expr, sympy.Symbol]] = [
        {motion.diff(clock): v for v, motion in zip(author.rates, motions, strict=True)}
    ]
    back.append(dict(zip(motions, author.coordinates, strict=True)) | {clock: author.time})
    balances = [sympy.expand(e.lhs.doit()).xreplace(back[0]).xreplace(back[1]) for e in written]
    balances = [e + phase.force.get(q, 0) for e, q in zip(balances, author.coordinates, strict=True)]
    matrix = np.array([[number(sympy.diff(e, v)) for v in author.rates] for e in balances])
    at_rest = dict.fromkeys(author.rates, sympy.S.Zero)
    right = np.array([number(e.xreplace(at_rest)) for e in balances])
    return (-np.linalg.inv(matrix) * right).tolist()  # type: ignore[no-any-return]


def _energy(author: Author, values: Values, t: Array) -> tuple[float, float]:
    """Return the Hamiltonian p v - L, and the sum of the moduli of its terms."""
    phase = author.first
    if author.is_hamiltonian:
        terms = [_number_along(term, values, t) for term in sympy.Add.make_args(sympy.sympify(phase.hamiltonian))]
    else:
        momenta = author.momenta(phase, values, t)
        terms = [float(momenta[q][0] * np.ravel(values[q.partner])[0]) for q in author.coordinates]
        terms.append(-_number_along(phase.lagrangian, values, t))
    return sum(terms), sum(map(abs, terms))


# ---- Particles ----


def check_particles(written: Connect | Simulate, module: ModuleType) -> Iterator[Finding]:
    """Compare parameters and the Hamiltonian of a module of particles with the author's pairwise Hamiltonian."""
    record, pairwise, generator = module.metadata, written.hamiltonian, np.random.default_rng(3)
    assert isinstance(pairwise, Pairwise), "the problem is one of particles"
    parameters = {s.name: s for s in quantities_in(written) if isinstance(s, symbols.Parameter)}
    defaults = {plain(name): value for name, value in record.parameters.items()}
    items = [number_item(name, float(parameters[name].value), value) for name, value in defaults.items()]
    yield from _verdict("parameters", [*items, number_item("number of steps", written.steps, record.steps)])
    first, second = pairwise.pair
    one = (*first.q, *first.p, *first.own)
    other = (*second.q, *second.p, *second.own)
    values = {parameters[name]: value * generator.uniform(0.9, 1.1) for name, value in defaults.items()}
    energies, count = list[Item](), 4
    for _ in range(3):
        state = generator.uniform(-0.6, 0.6, (2, count, len(first.q))) / math.sqrt(len(first.q))
        rows = [(*state[0, i], *state[1, i], *[1.0] * len(first.own)) for i in range(count)]
        terms = [
            _number_at(pairwise.term_of_pair, {**values, **dict(zip((*one, *other), (*a, *b), strict=True))})
            for a, b in combinations(rows, 2)
        ]
        for row in rows:
            at_one = dict(zip(one, row, strict=True))
            if pairwise.self_term is not None:
                terms.append(_number_at(sympy.sympify(pairwise.self_term), {**values, **at_one}))
                continue
            # By default a particle acts on itself by half the limit of the pair term.
            left, right = (
                (*(x + sign * _NEAR / 2 for x in row[: len(first.q)]), *row[len(first.q) :]) for sign in (-1, 1)
            )
            at_both = dict(zip((*one, *other), (*left, *right), strict=True))
            terms.append(_number_at(pairwise.term_of_pair, {**values, **at_both}) / 2)
        own, numbers = np.ones((count, len(first.own))), np.array([values[parameters[name]] for name in defaults])
        found = float(module.hamiltonian(state, own, numbers))
        energies.append(Item("H", sum(terms), found, 1e-9 * sum(map(abs, terms))))
    yield from _verdict("Hamiltonian", energies)
