"""From a model to a program: the choice of the transcription, and the transcription by a one-step method.

One-step methods apply to Hamilton's equations and to systems x' = f(x, u, t) of control problems. The contribution of
an interval to the Lagrangian of the optimisation problem is l = Cd + mu_k . r_k, with the discrete cost Cd. The
equations r_k of one step depend on the states at both nodes, inner stages and the controls.
"""

from __future__ import annotations

from dataclasses import replace
from typing import overload

import sympy
from sympy import S, Symbol

from codegen.discretise import particles, phases, schemes, simulation, variational
from codegen.discretise.assembly import Motion, assemble, in_scaled_time
from codegen.discretise.conditions import holonomic, path
from codegen.discretise.conditions.ends import End, conditioned_end, with_bounds
from codegen.discretise.conditions.linking import joined_unknowns, shared_unknowns
from codegen.discretise.conditions.path import nodal_conditions
from codegen.discretise.conditions.periodic import periodic_unknowns, periodic_velocities
from codegen.discretise.determined_values import without_dependent_values
from codegen.discretise.forms import in_momenta, with_symbolic_boundaries
from codegen.discretise.interval import at_nodes, one_step_interval
from codegen.discretise.model.definitions import Boundary, Model
from codegen.discretise.model.delays import errors_of_the_whole
from codegen.discretise.model.guesses import coordinate_guess, momentum_guess
from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.particles import PairwiseProgram
from codegen.discretise.program import ControlProgram, Equation, Names, StepProgram, Unknown, symbols
from codegen.discretise.schemes.base import FIRST_ORDER, Scheme
from codegen.errors import ArgumentError, SchemeError
from codegen.runtime.record import Kind, Meaning

DEFAULT_SCHEME = "midpoint"
_SYSTEMS = {"lagrangian": "a Lagrangian", "hamiltonian": "a Hamiltonian", "first-order": "a first-order system"}
MOST_PARTS = 16
"""Greatest number of steps of a composition on an interval of a control problem."""


@overload
def transcribe(
    model: Model, scheme: str | None = None, method: str | None = None, controls: str = "interval"
) -> ControlProgram | StepProgram: ...


@overload
def transcribe(
    model: PairwiseModel, scheme: str | None = None, method: str | None = None, controls: str = "interval"
) -> PairwiseProgram: ...


def transcribe(
    model: Model | PairwiseModel, scheme: str | None = None, method: str | None = None, controls: str = "interval"
) -> ControlProgram | StepProgram | PairwiseProgram:
    """Return the program of a model for the named scheme and method; None means the default.

    Raises ArgumentError for a method that the task does not have, SchemeError for a scheme that does not exist.
    """
    if isinstance(model, PairwiseModel):
        if controls != "interval":
            raise ArgumentError("particles have no controls", "leave --controls out")
        return particles.pairwise(model, scheme, method)
    method = method or (methods_for(model)[0] if model.task == "control" else method_with(model, scheme))
    usable = methods_for(model)
    if method not in usable and method in (schemes.FIRST_ORDER, *schemes.METHODS):
        needs = _SYSTEMS["first-order"] if method == schemes.FIRST_ORDER else "a Lagrangian or a Hamiltonian"
        if model.linear:
            needs = "canonical pairs" if method == "hamiltonian" else "a kinetic energy"
        given = "a Lagrangian that is linear in the velocities" if model.linear else _SYSTEMS[model.form]
        finding = f"method {method!r} needs {needs}, and the problem gives {given}"
        raise ArgumentError(finding, f"use {' or '.join(usable)}")
    if method not in usable:
        raise ArgumentError(f"method {method!r} does not exist for task {model.task}", f"use {' or '.join(usable)}")
    chosen = schemes.find(scheme or DEFAULT_SCHEME, method, usable)
    if model.task == "simulate":
        if controls != "interval":
            raise ArgumentError("a simulation has no controls", "leave --controls out")
        return simulation.simulate(model, chosen, method)
    if controls == "linear" and model.controls and not chosen.resolves_lines:
        resolving = [each.name for each in schemes.of_method(method) if each.resolves_lines and not each.parts]
        raise SchemeError(
            f"scheme {chosen.name!r} evaluates cost and forces at one time of an interval, and does not determine both "
            "end values of a linear control",
            f"use --scheme {' or '.join(resolving)}, or --controls interval",
        )
    if controls == "nodal" and model.rolling and model.controls and chosen.name == "midpoint":
        raise SchemeError(
            "rolling with nodal controls by the scheme 'midpoint': the means of neighbouring controls do not determine "
            "the controls, the KKT matrix is singular, and searches stall",
            "use --controls interval, which has the same motions, or --scheme trapezoidal",
        )
    if model.contacts and controls != "interval":
        raise ArgumentError("contact forces belong to intervals", "leave --controls out")
    if model.joined and controls in ("linear", "nodal"):
        raise ArgumentError("controls at nodes beside delays", "use --controls interval or stages")
    if model.phases:
        if controls != "interval":
            raise ArgumentError("a problem of several phases has its controls on intervals", "leave --controls out")
        return phases.chained(model, lambda phase: _controlled(phase, chosen, method, "interval"))
    with errors_of_the_whole(model):
        return without_dependent_values(in_scaled_time(_controlled(model, chosen, method, controls)))


def methods_for(model: Model) -> tuple[str, ...]:
    """Return the methods for a model: "variational" comes first, except in simulations of a Hamiltonian."""
    if model.form == "first-order":
        has_pairs = model.linear is not None and model.linear.pairs is not None
        return ("hamiltonian", schemes.FIRST_ORDER) if has_pairs else (schemes.FIRST_ORDER,)
    return tuple(sorted(schemes.METHODS, reverse=model.task == "control" or model.form == "lagrangian"))


def method_with(model: Model, scheme: str | None) -> str:
    """Return the first method that a model can use and that has the scheme, or else the first method."""
    methods = methods_for(model)
    return next((method for method in methods if scheme is None or schemes.is_known(scheme, method)), methods[0])


def _controlled(model: Model, scheme: schemes.Scheme, method: str, controls: str) -> ControlProgram:
    if scheme.variational:
        return variational.variational(model, scheme, controls)
    if len(scheme.parts) > MOST_PARTS:
        raise SchemeError(
            f"scheme {scheme.name!r} has {len(scheme.parts)} steps, each with unknowns on every interval of a "
            "control problem",
            f"use gauss-4 or gauss-6, or a composition of at most {MOST_PARTS} steps such as suzuki-4",
        )
    return one_step(model, scheme, method, controls)


def one_step(model: Model, scheme: Scheme, method: str, controls: str) -> ControlProgram:
    """Return the program with unknowns (q, p), or x, at nodes, and stages, mu and u on intervals (or u at nodes).

    Raises the errors of the Legendre transform, BoundaryError for conditions that do not fit together, and
    ArgumentError for holonomic constraints.
    """
    holonomic.refuse(model, method)
    model, boundary_values = with_symbolic_boundaries(model)
    assert model.end is not None, "a control problem has an end"
    # `model` has the boundary values; `phase` has dynamics, conditions and terminal cost.
    phase = model if method == FIRST_ORDER else in_momenta(model)
    names = Names(phase)
    guesses = (*coordinate_guess(model), *momentum_guess(model))
    states = (*phase.coordinates, *phase.rates)
    periodic = periodic_unknowns(model, states, guesses, names) + joined_unknowns(phase, states, guesses, names)
    if model.form == "lagrangian":
        periodic += periodic_velocities(model, names, phase)
    shared = shared_unknowns(model, periodic, guesses, names)
    free_rates = (None,) * len(phase.rates)  # their values may be velocities
    placed = replace(
        phase,
        start=Boundary(model.start.positions, free_rates),
        end=Boundary(model.end.positions, free_rates),
    )
    start_conditions = (*phase.start_conditions, *path.start_inequalities(placed), *periodic.start_conditions)
    end_conditions = (*phase.end_conditions, *periodic.end_conditions)
    constants = {*model.parameters, *(value.symbol for value in boundary_values)}
    ends = []
    for boundary, suffix, conditions, cost, aliases in (
        (model.start, "_k", start_conditions, S.Zero, periodic.start_aliases),
        (model.end, "_k1", end_conditions, phase.terminal_cost, periodic.end_aliases),
    ):
        values = _prescribed_values(model, phase, boundary, suffix, constants)
        at_end = dict(zip(states, symbols([x.name for x in states], suffix), strict=True))
        pinned, aliased = {name for name, _ in values.pins}, {name for name, *_ in aliases}
        unknowns = {symbol for x, symbol in at_end.items() if x.name not in pinned} | {o.symbol for o in shared.all}
        free = [x for x, symbol in at_end.items() if symbol in unknowns and x.name not in aliased]
        bounded = with_bounds([Unknown(x.name, Meaning(Kind.STATE, x.name)) for x in free], placed)
        own = dict(zip((at_end[x] for x in free), bounded, strict=True))
        ends.append(values + conditioned_end(conditions, cost, at_end, suffix, unknowns, names, own, model.parameters))
    interval = one_step_interval(path.with_inner_path(phase), scheme, controls)
    state_names = [s.name for s in (*phase.coordinates, *phase.rates)]
    stage_names = [s.name for s in interval.stages]
    multipliers = {f"mu_{name}": name for name in (*stage_names, *state_names)}
    mu = symbols(multipliers, "_k")
    coordinate = Kind.STATE if phase.form == "first-order" else Kind.COORDINATE
    kinds = [coordinate] * len(phase.coordinates) + [Kind.MOMENTUM] * len(phase.rates)
    return assemble(
        phase,
        Motion(
            method=method,
            scheme=scheme.name,
            node=tuple(Unknown(n, Meaning(kind, n)) for n, kind in zip(state_names, kinds, strict=True)),
            interval=(
                *(Unknown(n, Meaning(Kind.STAGE_VALUE, n)) for n in stage_names),
                *(Unknown(m, Meaning(Kind.STEP, n)) for m, n in multipliers.items()),
            ),
            interval_symbols=(*interval.stages, *mu),
            discrete=interval,
            element=interval.cost + sum(m * r for m, r in zip(mu, interval.equations, strict=True)),
            equations=(*map(Equation, interval.equations), Equation(interval.cost, "Cd")),
            node_guess=guesses,
            left_rates=lambda: at_nodes(phase.rates, "_k"),
            stage_guess=tuple(guesses[state_names.index(s.name.rpartition("_stage")[0])] for s in interval.stages),
            stage_times=tuple(
                scheme.step().abscissae[int(s.name.rpartition("_stage")[2]) - 1] for s in interval.stages
            ),
        ),
        boundary_values,
        path.nodal_equalities(placed, nodal_conditions(phase, equality=True), "y", names),
        ends[0],
        ends[1] + End(element=periodic.end_share),
        shared,
        names,
    )


def _prescribed_values(model: Model, phase: Model, boundary: Boundary, suffix: str, constants: set[Symbol]) -> End:
    """Return an end that fixes positions and momenta; velocities without a momentum in `constants` are equations."""
    fixed = {q: v for q, v in zip(model.coordinates, boundary.positions, strict=True) if v is not None}
    pins = [(q.name, v) for q, v in fixed.items()]
    fixed |= {v: x for v, x in zip(model.rates, boundary.rates, strict=True) if x is not None}
    quantities = (*phase.coordinates, *phase.rates)
    node = dict(zip(quantities, symbols([s.name for s in quantities], suffix), strict=True))
    extra, element, conditions = list[Unknown](), S.Zero, list[Equation]()
    for i, value in enumerate(boundary.rates):
        if value is None:
            continue
        momentum = value
        if model.form == "lagrangian":
            momentum = sympy.diff(model.function, model.rates[i]).subs(fixed, simultaneous=True)
        if momentum.free_symbols <= constants:
            pins.append((phase.rates[i].name, momentum))
            conditions.append(Equation(momentum, phase.rates[i].name))
            continue
        velocity = sympy.diff(phase.function, phase.rates[i]).subs(node, simultaneous=True)
        name = model.rates[i].name
        extra.append(Unknown(f"nu_{name}", Meaning(Kind.VELOCITY, name)))
        (nu,) = symbols([extra[-1].name], suffix)
        element += nu * (velocity - value)
        conditions.append(Equation(velocity, name))
    return End(pins=tuple(pins), extra=tuple(extra), element=element, conditions=tuple(conditions))
