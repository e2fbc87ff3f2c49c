"""Simulate task -> StepProgram: one step from (q_k, p_k) to (q_k1, p_k1), solved explicitly as far as possible.

Variational method: the position-momentum form of the forced discrete Euler-Lagrange equations, p_k = -D1 Ld - f- and
p_k1 = D2 Ld + f+. They are solved for the velocity (q_k1 - q_k)/h instead of q_k1, because the difference of two nearby
positions would lose digits. Source: Marsden and West (2001), section 1.5.3.

Inner points of a Galerkin variational integrator are replaced by velocities in the same way.

Hamiltonian method: the equations of a one-step method, inner stages included.

A composition is one step of its base scheme, which the generated module repeats with other lengths: code does not grow
with their number.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy import Add, Expr, Symbol, diff, expand_mul

from codegen.discretise import (
    STEP,
    VariationalInterval,
    at_nodes,
    one_step_interval,
    repeated,
    variational_interval,
)
from codegen.model import Model, legendre
from codegen.runtime.record import Kind, Meaning
from codegen.schemes import Scheme
from codegen.transcribe.boundary import with_symbolic_boundaries
from codegen.transcribe.program import Unknown
from codegen.transcribe.simulation.elimination import Elimination, eliminate
from codegen.transcribe.simulation.phase_functions import phase_functions
from codegen.transcribe.step_program import StepProgram

Equation = tuple[str, Expr]


@dataclass(frozen=True)
class _Step:
    """One step: the textbook's equations, where they come from, how they are solved, and where Newton starts."""

    equations: tuple[Equation, ...]
    summary: tuple[Equation, ...]
    velocities: tuple[tuple[Symbol, Symbol, Symbol, Expr], ...]
    stages: tuple[Symbol, ...]
    solution: Elimination
    guesses: dict[Symbol, Expr]


def simulate(model: Model, scheme: Scheme, method: str) -> StepProgram:
    """Transcribe an initial value problem by the "variational" or the "hamiltonian" method.

    Raises SchemeError when the scheme belongs to the other method, and what the Legendre transforms raise.
    """
    model, start_values = with_symbolic_boundaries(model)
    stepwise = phase_functions(model) if method == "variational" else None
    phase = legendre.in_phase_space(model) if stepwise else legendre.hamiltonian_form(model)
    left = (*at_nodes(phase.coordinates, "_k"), *at_nodes(phase.rates, "_k"))
    right = (*at_nodes(phase.coordinates, "_k1"), *at_nodes(phase.rates, "_k1"))
    lengths, part = repeated(scheme)
    if method == "variational":
        velocities = [_at(phase, v, left) for v in stepwise.velocities] if stepwise else _mean_velocities(phase, left)
        step = _variational_step(legendre.lagrangian_form(model), part, left, right, velocities)
    else:
        step = _one_step(phase, part, left, right, lengths)
    kinds = [*((Kind.COORDINATE, q) for q in phase.coordinates), *((Kind.MOMENTUM, p) for p in phase.rates)]
    solution = step.solution
    return StepProgram(
        model=model,
        method=method,
        scheme=scheme.name,
        order=scheme.order,
        state=tuple(Unknown(symbol.name, Meaning(kind, symbol.name)) for kind, symbol in kinds),
        left_symbols=left,
        velocities=step.velocities,
        stage_symbols=step.stages,
        right_symbols=right,
        before=solution.before,
        unknowns=solution.unknowns,
        guess=tuple(step.guesses[y] for y in solution.unknowns),
        residual=solution.residual,
        after=solution.after,
        linear=solution.linear,
        equations=step.equations,
        summary=step.summary,
        energy=_at(phase, stepwise.energy if stepwise else phase.function, left),
        state_assignments=tuple((w, _at(phase, value, left)) for w, value in stepwise.assignments) if stepwise else (),
        start_values=start_values,
        start=tuple(value for value in (*phase.start.positions, *phase.start.rates) if value is not None),
        lengths=lengths,
        fractions=scheme.parts,
    )


def _variational_step(
    model: Model,
    scheme: Scheme,
    left: Sequence[Symbol],
    right: Sequence[Symbol],
    mean_velocities: Sequence[Expr],
) -> _Step:
    interval = variational_interval(model, scheme)
    dimension = len(model.coordinates)
    transforms = [
        *zip(left[dimension:], interval.left_momentum, strict=True),
        *zip(right[dimension:], interval.right_momentum, strict=True),
    ]
    names = [q.name for q in model.coordinates]
    summary = [("Ld", interval.lagrangian)]
    for mark, forces in (("f-", interval.force_minus), ("f+", interval.force_plus)):
        summary += [(f"{mark}_{name}", f) for name, f in zip(names, forces, strict=True) if f != 0]
    inner = [(f"inner balance of {q}", value) for q, value in zip(interval.inner, interval.inner_balance, strict=True)]
    velocities = at_nodes(model.rates, "_k")
    points = range(1, len(interval.inner) // dimension + 1)
    velocities += tuple(v for i in points for v in at_nodes(model.rates, f"_stage{i}"))
    return _Step(
        equations=(*inner, *((p.name, p - momentum) for p, momentum in transforms)),
        summary=(
            *summary,
            *((f"0 = {name}", value) for name, value in inner),
            *((p.name, momentum) for p, momentum in transforms),
        ),
        velocities=tuple((v, *d) for v, d in zip(velocities, _differences(interval), strict=True)),
        stages=interval.inner,
        solution=_solved_for_velocities(model, interval, velocities, left, right),
        guesses=dict(zip(velocities, list(mean_velocities) * (1 + len(points)), strict=True)),
    )


def _differences(interval: VariationalInterval) -> list[tuple[Symbol, Symbol, Expr]]:
    """Right nodes and inner points, the left node, and the time between them."""
    left = interval.q.left
    outer = [(q1, q, STEP) for q1, q in zip(interval.q.right, left, strict=True)]
    inside = enumerate(zip(interval.inner, interval.inner_abscissae, strict=True))
    return outer + [(q, left[i % len(left)], c * STEP) for i, (q, c) in inside]


def _one_step(
    phase: Model,
    scheme: Scheme,
    left: Sequence[Symbol],
    right: Sequence[Symbol],
    lengths: Sequence[Symbol],
) -> _Step:
    interval = one_step_interval(phase, scheme)
    unknowns = (*interval.stages, *right)
    equations = tuple((f"step of {y}", e) for y, e in zip(unknowns, interval.equations, strict=True))
    return _Step(
        equations=equations,
        summary=tuple((f"0 = {name}", value) for name, value in equations),
        velocities=(),
        stages=interval.stages,
        solution=eliminate(interval.equations, unknowns, (*phase.parameters, *lengths)),
        guesses=_euler_guesses(phase, scheme, left, unknowns),
    )


def _solved_for_velocities(
    model: Model,
    interval: VariationalInterval,
    velocities: Sequence[Symbol],
    left: Sequence[Symbol],
    right: Sequence[Symbol],
) -> Elimination:
    """Eliminate from the position-momentum form, with q_k1 = q_k + h v_k put in before anything is evaluated.

    Inner points become q_k + c h v, c being their abscissa.
    """
    dimension = len(model.coordinates)
    arriving = interval.right_momentum
    if interval.inner:
        # All equations together: rounded coefficients of velocities would make the energy drift.
        arriving = tuple(p + gained for p, gained in zip(left[dimension:], interval.impulse, strict=True))
    arrival: dict[Symbol, Expr] = {
        q1: q + STEP * v for q1, q, v in zip(interval.q.right, interval.q.left, velocities, strict=False)
    }
    inside = zip(interval.inner, interval.inner_abscissae, velocities[dimension:], strict=True)
    for i, (q, c, v) in enumerate(inside):
        arrival[q] = interval.q.left[i % dimension] + c * STEP * v

    def in_velocities(momentum: Expr) -> Expr:
        # (q_k1 - q_k)/h stands in one sum, so that sympy cancels q_k by itself and v_k remains.
        terms = Add.make_args(momentum.xreplace(arrival))
        return Add(*(expand_mul(term, deep=False) if term.has(1 / STEP) else term for term in terms))

    equations = [
        *(p - in_velocities(value) for p, value in zip(left[dimension:], interval.left_momentum, strict=True)),
        *(in_velocities(value) for value in interval.inner_balance),
        *(q1 - value for q1, value in arrival.items()),
        *(p - in_velocities(value) for p, value in zip(right[dimension:], arriving, strict=True)),
    ]
    unknowns = (*velocities, *arrival, *right[dimension:])
    return eliminate(equations, unknowns, model.parameters)


def _euler_guesses(
    phase: Model, scheme: Scheme, left: Sequence[Symbol], unknowns: Sequence[Symbol]
) -> dict[Symbol, Expr]:
    """Start every stage and the right node from explicit Euler steps that begin at the left node."""
    rates = dict(zip(left, rates_of_change(phase, left), strict=True))
    abscissae = scheme.step().abscissae
    guesses = dict[Symbol, Expr]()
    for y in unknowns:
        stage = re.search(r"_stage(\d+)$", y.name)
        c = abscissae[int(stage[1]) - 1] if stage else abscissae[-1]
        name = y.name[: stage.start()] if stage else y.name.removesuffix("_k1")
        x = next(x for x in left if x.name == f"{name}_k")
        guesses[y] = x + sympy.expand(c * STEP) * rates[x]
    return guesses


def _mean_velocities(phase: Model, left: Sequence[Symbol]) -> list[Expr]:
    """Guess the velocities of a step: those of the left node, or of half a step later where that costs little."""
    dimension = len(phase.coordinates)
    rates = rates_of_change(phase, left)
    velocities, slopes = rates[:dimension], rates[dimension:]
    if any(velocity.has(*left[:dimension]) for velocity in velocities):
        return velocities
    momenta = left[dimension:]
    later = {p: p + STEP * slope / 2 for p, slope in zip(momenta, slopes, strict=True)}
    return [velocity.xreplace(later) for velocity in velocities]


def rates_of_change(phase: Model, left: Sequence[Symbol]) -> list[Expr]:
    """The forced Hamiltonian vector field at the left node."""
    velocity = [diff(phase.function, p) for p in phase.rates]
    slope = [f - diff(phase.function, q) for q, f in zip(phase.coordinates, phase.force, strict=True)]
    return [_at(phase, value, left) for value in (*velocity, *slope)]


def _at(phase: Model, expression: Expr, left: Sequence[Symbol]) -> Expr:
    return expression.xreplace(dict(zip((*phase.coordinates, *phase.rates), left, strict=True)))
