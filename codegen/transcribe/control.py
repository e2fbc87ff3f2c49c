"""Control task -> ControlProgram: the scalar whose stationarity over all intervals is the optimal-control problem.

Variational method: l = Cd + lambda_k . (D1 Ld + f-) + lambda_k1 . (D2 Ld + f+). Summed over intervals the
multipliers of a node meet both halves of its forced discrete Euler-Lagrange equation; at the two end nodes the
momentum boundary conditions (thesis (3.1.3)) arise once lambda_0 . p(0) and -lambda_N . p(T) are added.

Hamiltonian method: l = Cd + mu_k . r_k with the equations r_k of one step.
"""

from __future__ import annotations

from collections.abc import Sequence

import sympy
from sympy import Expr, Symbol

from codegen import legendre
from codegen.discretise import at_nodes, one_step_interval, variational_interval
from codegen.model import Boundary, Model
from codegen.schemes import DiscreteLagrangian, OneStep
from codegen.transcribe.program import ControlProgram, EndElement, Unknown


def variational(model: Model, scheme: DiscreteLagrangian, nodal_controls: bool) -> ControlProgram:
    """Transcribe with unknowns q and lambda on nodes and u on intervals (or nodes)."""
    model = legendre.lagrangian_form(model) if model.form != "lagrangian" else model
    interval = variational_interval(model, scheme, nodal_controls)
    names = [q.name for q in model.coordinates]
    multipliers = [f"lambda_{name}" for name in names]
    nodal = _control_unknowns(model) if nodal_controls else ()
    node = (
        *(Unknown(name, f"coordinate {name}") for name in names),
        *(Unknown(m, f"multiplier of the equation of motion of {n}", True) for m, n in zip(multipliers, names, strict=True)),
        *nodal,
    )
    left_lambda, right_lambda = _symbols(multipliers, "_k"), _symbols(multipliers, "_k1")
    left_half = [-p for p in interval.left_momentum]
    right_half = list(interval.right_momentum)
    element = (
        interval.cost
        + sum(m * e for m, e in zip(left_lambda, left_half, strict=True))
        + sum(m * e for m, e in zip(right_lambda, right_half, strict=True))
    )
    left = (*interval.q.left, *left_lambda, *(interval.q.left_controls if nodal_controls else ()))
    right = (*interval.q.right, *right_lambda, *(interval.q.right_controls if nodal_controls else ()))
    return ControlProgram(
        model=model,
        method="variational",
        scheme=scheme.name,
        nodal_controls=nodal_controls,
        node=node,
        interval=(),
        controls=() if nodal_controls else _control_unknowns(model),
        left_symbols=left,
        interval_symbols=(),
        control_symbols=() if nodal_controls else interval.q.left_controls,
        right_symbols=right,
        element=element,
        cost=interval.cost,
        equations=(
            ("Ld", interval.lagrangian),
            *((f"f-_{n}", f) for n, f in zip(names, interval.force_minus, strict=True) if f != 0),
            *((f"f+_{n}", f) for n, f in zip(names, interval.force_plus, strict=True) if f != 0),
            ("Cd", interval.cost),
        ),
        left_momentum=interval.left_momentum,
        right_momentum=interval.right_momentum,
        start=_momentum_end(model, model.start, "_k", sympy.S.One),
        end=_with_absent_controls_pinned(
            _momentum_end(model, _end(model), "_k1", sympy.S.NegativeOne), element, nodal, right, len(node)
        ),
    )


def hamiltonian(model: Model, scheme: OneStep, nodal_controls: bool) -> ControlProgram:
    """Transcribe with unknowns q and p on nodes, stages, mu and u on intervals (or u on nodes)."""
    free = Boundary((None,) * len(model.coordinates), (None,) * len(model.coordinates))
    phase = legendre.hamiltonian_form(_with_ends(model, free, free))
    interval = one_step_interval(phase, scheme, nodal_controls)
    names = [s.name for s in (*phase.coordinates, *phase.rates)]
    stage_names = [s.name for s in interval.stages]
    equation_names = [*stage_names, *names]
    multipliers = [f"mu_{name}" for name in equation_names]
    nodal = _control_unknowns(model) if nodal_controls else ()
    mu = _symbols(multipliers, "_k")
    element = interval.cost + sum(m * r for m, r in zip(mu, interval.equations, strict=True))
    kinds = ["coordinate"] * len(phase.coordinates) + ["momentum"] * len(phase.rates)
    node = (*(Unknown(n, f"{kind} {n}") for n, kind in zip(names, kinds, strict=True)), *nodal)
    right = (*interval.q.right, *interval.p.right, *(interval.q.right_controls if nodal_controls else ()))
    return ControlProgram(
        model=phase,
        method="hamiltonian",
        scheme=scheme.name,
        nodal_controls=nodal_controls,
        node=node,
        interval=(
            *(Unknown(n, f"stage value {n}") for n in stage_names),
            *(Unknown(m, f"multiplier of the step of {n}", True) for m, n in zip(multipliers, equation_names, strict=True)),
        ),
        controls=() if nodal_controls else _control_unknowns(model),
        left_symbols=(*interval.q.left, *interval.p.left, *(interval.q.left_controls if nodal_controls else ())),
        interval_symbols=(*interval.stages, *mu),
        control_symbols=() if nodal_controls else interval.q.left_controls,
        right_symbols=right,
        element=element,
        cost=interval.cost,
        equations=(
            *((f"0", r) for r in interval.equations),
            ("Cd", interval.cost),
        ),
        left_momentum=tuple(interval.p.left),
        right_momentum=tuple(interval.p.right),
        start=_phase_end(model, phase, model.start, "_k"),
        end=_with_absent_controls_pinned(
            _phase_end(model, phase, _end(model), "_k1"), element, nodal, right, len(node)
        ),
    )


def _momentum_end(model: Model, boundary: Boundary, suffix: str, sign: Expr) -> EndElement:
    """Fix positions; match the discrete momentum with D2 L(q, v) wherever a velocity is fixed.

    Free velocities on which a matched momentum depends (through the mass matrix) become unknowns of this end, and
    their momenta are matched too, so that each fixed velocity costs exactly one condition.
    """
    dimension = len(model.coordinates)
    momentum = [sympy.diff(model.function, v) for v in model.rates]
    matched = {i for i in range(dimension) if boundary.rates[i] is not None}
    extra: set[int] = set()
    while True:
        coupled = {j for i in matched for j in range(dimension) if momentum[i].has(model.rates[j])}
        missing = {j for j in coupled if boundary.rates[j] is None} - extra
        if not missing:
            break
        extra |= missing
        matched |= missing
    here = _symbols([q.name for q in model.coordinates], suffix)
    multipliers = _symbols([f"lambda_{q.name}" for q in model.coordinates], suffix)
    extra_symbols = tuple(Symbol(f"{model.rates[j].name}{suffix}", real=True) for j in sorted(extra))
    velocity = {v: value for v, value in zip(model.rates, boundary.rates, strict=True) if value is not None}
    velocity |= dict(zip((model.rates[j] for j in sorted(extra)), extra_symbols, strict=True))
    place = dict(zip(model.coordinates, here, strict=True))
    matched_momenta = [(i, momentum[i].subs({**place, **velocity}, simultaneous=True)) for i in sorted(matched)]
    pins = [(i, value) for i, value in enumerate(boundary.positions) if value is not None]
    pins += [(dimension + i, sympy.S.Zero) for i in range(dimension) if i not in matched]
    return EndElement(
        pins=tuple(pins),
        extra=tuple(Unknown(model.rates[j].name, f"velocity {model.rates[j].name} at this end") for j in sorted(extra)),
        extra_symbols=extra_symbols,
        element=sum((sign * multipliers[i] * p for i, p in matched_momenta), sympy.S.Zero),
        conditions=tuple((f"p_{model.coordinates[i].name}", p) for i, p in matched_momenta),
    )


def _phase_end(model: Model, phase: Model, boundary: Boundary, suffix: str) -> EndElement:
    """Fix positions and momenta; velocities that do not fix a momentum by themselves become equations."""
    dimension = len(model.coordinates)
    pins = [(i, value) for i, value in enumerate(boundary.positions) if value is not None]
    fixed_positions = {q: v for q, v in zip(model.coordinates, boundary.positions, strict=True) if v is not None}
    fixed_rates = {v: x for v, x in zip(model.rates, boundary.rates, strict=True) if x is not None}
    node = dict(zip((*phase.coordinates, *phase.rates), _symbols(
        [s.name for s in (*phase.coordinates, *phase.rates)], suffix), strict=True))
    names, terms, conditions = [], [], []
    for i, value in enumerate(boundary.rates):
        if value is None:
            continue
        momentum = value
        if model.form == "lagrangian":
            momentum = sympy.diff(model.function, model.rates[i]).subs({**fixed_positions, **fixed_rates}, simultaneous=True)
        if not momentum.free_symbols - set(model.parameters):
            pins.append((dimension + i, momentum))
            conditions.append((phase.rates[i].name, momentum))
            continue
        velocity = sympy.diff(phase.function, phase.rates[i]).subs(node, simultaneous=True)
        names.append(f"nu_{model.rates[i].name}")
        terms.append(velocity - value)
        conditions.append((model.rates[i].name, velocity))
    symbols = _symbols(names, suffix)
    return EndElement(
        pins=tuple(pins),
        extra=tuple(Unknown(n, f"multiplier of the condition on {n.removeprefix('nu_')}", True) for n in names),
        extra_symbols=symbols,
        element=sum((nu * term for nu, term in zip(symbols, terms, strict=True)), sympy.S.Zero),
        conditions=tuple(conditions),
    )


def _with_absent_controls_pinned(
    end: EndElement, element: Expr, nodal: Sequence[Unknown], right: Sequence[Symbol], size: int
) -> EndElement:
    """Pin controls of the last node that no interval reads (nodal controls with a one-sided scheme)."""
    first = size - len(nodal)
    absent = [(i, sympy.S.Zero) for i in range(first, size) if right[i] not in element.free_symbols]
    return EndElement((*end.pins, *absent), end.extra, end.extra_symbols, end.element, end.conditions)


def _control_unknowns(model: Model) -> tuple[Unknown, ...]:
    return tuple(Unknown(u.name, f"control {u.name}") for u in model.controls)


def _symbols(names: Sequence[str], suffix: str) -> tuple[Symbol, ...]:
    return at_nodes([Symbol(name) for name in names], suffix)


def _end(model: Model) -> Boundary:
    assert model.end is not None, "a control problem has an end"
    return model.end


def _with_ends(model: Model, start: Boundary, end: Boundary) -> Model:
    from dataclasses import replace

    return replace(model, start=start, end=end)
