"""Control task by a one-step method -> ControlProgram: Hamilton's equations, or a first-order system x' = f(x, u, t).

l = Cd + mu_k . r_k with the equations r_k of one step, whose unknowns are the states at both nodes, inner stages and
the controls.
"""

from __future__ import annotations

from dataclasses import replace

import sympy
from sympy import Expr, S, Symbol

from codegen.discretise.assembly import Motion, assemble
from codegen.discretise.conditions import holonomic, path
from codegen.discretise.conditions.ends import End, conditioned_end, with_bounds
from codegen.discretise.conditions.linking import Shared, joined_unknowns, shared_unknowns
from codegen.discretise.conditions.path import nodal_conditions
from codegen.discretise.conditions.periodic import Periodic, periodic_unknowns, periodic_velocities_in_momenta
from codegen.discretise.forms import in_momenta, with_symbolic_boundaries
from codegen.discretise.interval import at_nodes, one_step_interval
from codegen.discretise.model.definitions import Boundary, Model
from codegen.discretise.model.guesses import coordinate_guess, momentum_guess
from codegen.discretise.program import BoundaryValue, ControlProgram, Names, Unknown, symbols
from codegen.discretise.schemes.base import FIRST_ORDER, Scheme
from codegen.runtime.record import Kind, Meaning


def one_step(model: Model, scheme: Scheme, method: str, controls: str) -> ControlProgram:
    """Transcribe with unknowns (q, p), or x, on nodes, stages, mu and u on intervals (or u on nodes).

    Raises what the Legendre transform raises, BoundaryError for conditions that do not fit together, and ArgumentError
    for holonomic constraints.
    """
    holonomic.refuse(model, method)
    model, boundary_values = with_symbolic_boundaries(model)
    # Boundary values are those of `model`; dynamics, conditions and terminal cost those of `phase`.
    phase = model if method == FIRST_ORDER else in_momenta(model)
    names = Names(phase)
    guesses = (*coordinate_guess(model), *momentum_guess(model))
    states = (*phase.coordinates, *phase.rates)
    periodic = periodic_unknowns(model, states, guesses, names) + joined_unknowns(phase, states, guesses, names)
    if model.form == "lagrangian":
        periodic += periodic_velocities_in_momenta(model, phase, names)
    shared = shared_unknowns(model, periodic, guesses, names)
    assert model.end is not None, "a control problem has an end"
    free = (None,) * len(phase.rates)  # whose values there may be velocities
    placed = replace(phase, start=Boundary(model.start.positions, free), end=Boundary(model.end.positions, free))
    start, end = _ends(model, placed, periodic, shared, boundary_values, names)
    return assemble(
        phase,
        _motion(phase, scheme, method, controls, guesses),
        boundary_values,
        path.nodal_equalities(placed, nodal_conditions(phase, equality=True), "y", names),
        start,
        end,
        shared,
        names,
    )


def _ends(
    model: Model,
    phase: Model,
    periodic: Periodic,
    shared: Shared,
    boundary_values: tuple[BoundaryValue, ...],
    names: Names,
) -> tuple[End, End]:
    """Given values, conditions and the terminal cost at both ends."""
    assert model.end is not None, "a control problem has an end"
    known = {*model.parameters, *(value.symbol for value in boundary_values)}
    start_conditions = (
        *phase.start_conditions, *path.start_inequalities(phase), *periodic.start_conditions
    )  # fmt: skip
    end_conditions = (*phase.end_conditions, *periodic.end_conditions)
    states = (*phase.coordinates, *phase.rates)
    ends = []
    for boundary, suffix, conditions, cost, aliases in (
        (model.start, "_k", start_conditions, S.Zero, periodic.start_aliases),
        (model.end, "_k1", end_conditions, phase.terminal_cost, periodic.end_aliases),
    ):
        values = _given_values(model, phase, boundary, suffix, known)
        here = symbols([x.name for x in states], suffix)
        pinned = {name for name, _ in values.pins}
        unknowns = {symbol for x, symbol in zip(states, here, strict=True) if x.name not in pinned}
        unknowns |= {own.symbol for own in shared.all}
        substitution = dict(zip(states, here, strict=True))
        aliased = {name for name, *_ in aliases}
        free = {s: x.name for x, s in zip(states, here, strict=True) if s in unknowns and x.name not in aliased}
        own = dict(
            zip(
                free,
                with_bounds([Unknown(name, Meaning(Kind.STATE, name)) for name in free.values()], phase),
                strict=True,
            )
        )
        imposed = conditioned_end(conditions, cost, substitution, suffix, unknowns, names, own, model.parameters)
        ends.append(values + imposed)
    return ends[0], ends[1] + End(element=periodic.end_share)


def _motion(phase: Model, scheme: Scheme, method: str, controls: str, guesses: tuple[Expr, ...]) -> Motion:
    """The equations of one step times their multipliers."""
    interval = one_step_interval(path.with_inner_path(phase), scheme, controls)
    names = [s.name for s in (*phase.coordinates, *phase.rates)]
    stage_names = [s.name for s in interval.stages]
    equation_names = [*stage_names, *names]
    multipliers = [f"mu_{name}" for name in equation_names]
    mu = symbols(multipliers, "_k")
    coordinate = Kind.STATE if phase.form == "first-order" else Kind.COORDINATE
    kinds = [coordinate] * len(phase.coordinates) + [Kind.MOMENTUM] * len(phase.rates)
    pairs = zip(multipliers, equation_names, strict=True)
    return Motion(
        method=method,
        scheme=scheme.name,
        node=tuple(Unknown(n, Meaning(kind, n)) for n, kind in zip(names, kinds, strict=True)),
        interval=(
            *(Unknown(n, Meaning(Kind.STAGE_VALUE, n)) for n in stage_names),
            *(Unknown(m, Meaning(Kind.STEP, n)) for m, n in pairs),
        ),
        interval_symbols=(*interval.stages, *mu),
        discrete=interval,
        element=interval.cost + sum(m * r for m, r in zip(mu, interval.equations, strict=True)),
        equations=(*(("0", r) for r in interval.equations), ("Cd", interval.cost)),
        node_guess=guesses,
        left_rates=lambda: at_nodes(phase.rates, "_k"),
        stage_guess=tuple(guesses[names.index(s.name.rpartition("_stage")[0])] for s in interval.stages),
    )


def _given_values(model: Model, phase: Model, boundary: Boundary, suffix: str, known: set[Symbol]) -> End:
    """Fix positions and momenta; velocities that do not fix a momentum by themselves become equations."""
    pins = [(q.name, v) for q, v in zip(model.coordinates, boundary.positions, strict=True) if v is not None]
    fixed = {q: v for q, v in zip(model.coordinates, boundary.positions, strict=True) if v is not None}
    fixed |= {v: x for v, x in zip(model.rates, boundary.rates, strict=True) if x is not None}
    quantities = (*phase.coordinates, *phase.rates)
    node = dict(zip(quantities, symbols([s.name for s in quantities], suffix), strict=True))
    extra, terms, conditions = list[Unknown](), list[Expr](), list[tuple[str, Expr]]()
    for i, value in enumerate(boundary.rates):
        if value is None:
            continue
        momentum = value
        if model.form == "lagrangian":
            momentum = sympy.diff(model.function, model.rates[i]).subs(fixed, simultaneous=True)
        if momentum.free_symbols <= known:
            pins.append((phase.rates[i].name, momentum))
            conditions.append((phase.rates[i].name, momentum))
            continue
        velocity = sympy.diff(phase.function, phase.rates[i]).subs(node, simultaneous=True)
        name = model.rates[i].name
        extra.append(Unknown(f"nu_{name}", Meaning(Kind.VELOCITY, name)))
        terms.append(velocity - value)
        conditions.append((name, velocity))
    multipliers = symbols([unknown.name for unknown in extra], suffix)
    return End(
        pins=tuple(pins),
        extra=tuple(extra),
        element=sum((nu * term for nu, term in zip(multipliers, terms, strict=True)), S.Zero),
        conditions=tuple(conditions),
    )
