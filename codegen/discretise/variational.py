"""Transcription of a control problem by the variational method.

With the discrete cost Cd, the contribution of an interval to the Lagrangian of the optimisation problem is
l = Cd + lambda_k . (D1 Ld + f-) + lambda_k1 . (D2 Ld + f+). Each inner point of a Galerkin variational integrator adds
lambda_i . (D_i Ld + f_i) (Ober-Bloebaum and Saake 2015). Summed over intervals, the multipliers of a node multiply both
halves of its forced discrete Euler-Lagrange equation.

At the end nodes the discrete momenta match the momenta of the velocities, by +lambda_0 . D2 L(q(0), v(0)) at the start
and -lambda_N . D2 L(q(T), v(T)) at the end. A free velocity is an unknown of its end if a matched momentum, a condition
or the terminal cost depends on it. Its momentum is matched too, so that the number of equations is right. The
multiplier of an unmatched momentum is zero. Source: Ober-Bloebaum, Junge and Marsden (2011), Discrete mechanics and
optimal control: an analysis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from sympy import Expr, S, Symbol

from codegen.discretise import contact
from codegen.discretise.assembly import Motion, assemble
from codegen.discretise.conditions import path
from codegen.discretise.conditions.ends import End, conditioned_end, pinned_at_zero, with_bounds
from codegen.discretise.conditions.holonomic import Constraints, require_no_inner_points
from codegen.discretise.conditions.linking import joined_momenta, joined_unknowns, shared_unknowns
from codegen.discretise.conditions.path import nodal_conditions
from codegen.discretise.conditions.periodic import (
    periodic_momenta,
    periodic_unknowns,
    periodic_velocities,
    require_constraints_return,
)
from codegen.discretise.forms import in_velocities, with_symbolic_boundaries
from codegen.discretise.interval import VariationalInterval, at_nodes, variational_interval
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Boundary, Condition, Model
from codegen.discretise.model.guesses import coordinate_guess
from codegen.discretise.program import ControlProgram, Equation, Names, Unknown, occurring, symbols
from codegen.discretise.schemes.base import Scheme
from codegen.errors import BoundaryError
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic.derivatives import gradient


@dataclass(frozen=True)
class EndConditions:
    """Values, conditions and terminal cost at one end; `suffix` and `sign` are `_k` and 1, or `_k1` and -1.

    `momenta` maps indices of coordinates to unknown momenta that are matched, and `aliased` has the names of
    coordinates that equal a linking variable.
    """

    suffix: str
    sign: int
    boundary: Boundary
    conditions: tuple[Condition, ...]
    cost: Expr
    momenta: Mapping[int, Expr]
    aliased: frozenset[str]


def variational(original: Model, scheme: Scheme, controls: str) -> ControlProgram:
    """Return the program with unknowns q and lambda at nodes, and u on intervals (or at nodes).

    Holonomic constraints add kappa and eta to the nodes, rolling constraints kappa and zeta. Raises the errors of the
    Legendre transform, and BoundaryError for conditions that do not fit together.
    """
    model, boundary_values = with_symbolic_boundaries(in_velocities(original))
    names, guesses = Names(model), coordinate_guess(model)
    values = {value.symbol: value.value for value in boundary_values}
    constraints = Constraints(model, names)
    equalities = path.nodal_equalities(model, nodal_conditions(model, equality=True), "y", names)
    periodic = periodic_unknowns(model, model.coordinates, guesses, names)
    periodic += joined_unknowns(model, model.coordinates, guesses, names) + joined_momenta(model, names)
    if original.form == "hamiltonian":
        periodic += periodic_momenta(original, model, names)
    else:
        periodic += periodic_velocities(model, names)
        require_constraints_return(model, periodic, values)
    shared = shared_unknowns(model, periodic, guesses, names)
    assert model.end is not None, "a control problem has an end"
    with_gaps = replace(model, path=(*model.path, *contact.gaps(model)))
    at_start = (*model.start_conditions, *path.start_inequalities(with_gaps), *periodic.start_conditions)
    at_end = (*model.end_conditions, *periodic.end_conditions)
    aliased = [frozenset(name for name, *_ in each) for each in (periodic.start_aliases, periodic.end_aliases)]
    momenta = dict(periodic.start_momenta), dict(periodic.end_momenta)
    ends = (
        EndConditions("_k", 1, model.start, at_start, S.Zero, momenta[0], aliased[0]),
        EndConditions("_k1", -1, model.end, at_end, model.terminal_cost, momenta[1], aliased[1]),
    )
    matched = [_matched_indices(model, e, (*constraints.touched, *contact.touched(model))) for e in ends]
    contact.require_matched_start(model, matched[0] | set(momenta[0]))
    optimised = {own.symbol for own in shared.all}
    start, end = (
        _momentum_end(model, e, indices, constraints, values, optimised, names)
        for e, indices in zip(ends, matched, strict=True)
    )
    return assemble(
        model,
        _motion(model, scheme, controls, constraints),
        boundary_values,
        constraints.nodal_terms((matched[0], matched[1]), (set(momenta[0]), set(momenta[1])), scheme) + equalities,
        start,
        end + End(element=periodic.end_share),
        shared,
        names,
    )


def _matched_indices(model: Model, end: EndConditions, touched: Sequence[set[int]]) -> set[int]:
    """Return the indices of coordinates whose discrete momentum at an end matches the momentum of a velocity.

    The velocity is prescribed, or a condition, the terminal cost, another matched momentum, or a constraint or contact
    with a matched velocity, depends on it. Each of `touched` has the coordinates on which the forces of one act.
    """
    momentum = gradient(model.function, model.rates)
    matched = {i for i, value in enumerate(end.boundary.rates) if value is not None}
    matched |= occurring(model.rates, end.cost, *(condition.expression for condition in end.conditions))
    while True:
        further = occurring(model.rates, *(momentum[i] for i in matched))
        further |= {i for indices in touched if indices & matched for i in indices}
        if further <= matched:
            return matched
        matched |= further


def _momentum_end(
    model: Model,
    end: EndConditions,
    matched: set[int],
    constraints: Constraints,
    values: Mapping[Symbol, Expr],
    shared: set[Symbol],
    names: Names,
) -> End:
    """Return the terms that fix positions, match momenta and impose conditions at an end.

    `values` maps symbols of boundary values to the values; `shared` are the symbols of linking variables.
    """
    both = " ".join(model.coordinates[i].name for i in sorted(matched & set(end.momenta)))
    if both:
        raise BoundaryError(
            f"the momentum of {both} is periodic, and conditions of an end depend on it", "use --method hamiltonian"
        )
    positions = dict(zip(model.coordinates, symbols([q.name for q in model.coordinates], end.suffix), strict=True))
    prescribed = dict(zip(model.coordinates, end.boundary.positions, strict=True))
    free_rates = [model.rates[i] for i in sorted(matched) if end.boundary.rates[i] is None]
    velocities = dict(zip(free_rates, symbols([v.name for v in free_rates], end.suffix), strict=True))
    fixed_rates = {v: x for v, x in zip(model.rates, end.boundary.rates, strict=True) if x is not None}
    substitution: dict[Symbol, Expr] = {**positions, **fixed_rates, **velocities}
    momentum = gradient(model.function, model.rates)
    momenta = {i: momentum[i].xreplace(substitution) for i in sorted(matched)} | dict(sorted(end.momenta.items()))
    impact = contact.end_impulse(model, matched, values, names) if end.suffix == "_k1" else contact.EndImpulse()
    own_names = [unknown.name for unknown in impact.unknowns]
    of_impact = dict(zip((Symbol(n, real=True) for n in own_names), symbols(own_names, end.suffix), strict=True))
    substitution |= of_impact
    multiplier_names = [f"lambda_{q.name}" for q in model.coordinates]
    multipliers = symbols(multiplier_names, end.suffix)
    matching = End(
        pins=tuple((q.name, value) for q, value in prescribed.items() if value is not None),
        extra=(*(Unknown(v.name, Meaning(Kind.END_VELOCITY, v.name)) for v in free_rates), *impact.unknowns),
        element=sum((end.sign * multipliers[i] * p for i, p in momenta.items()), S.Zero)
        + sum((multipliers[i] * f.xreplace(substitution) for i, f in enumerate(impact.impulses)), S.Zero),
        conditions=tuple(Equation(p, f"p_{model.coordinates[i].name}", momentum=True) for i, p in momenta.items()),
    )
    unmatched = [name for i, name in enumerate(multiplier_names) if i not in momenta]
    free = {q: symbol for q, symbol in positions.items() if prescribed[q] is None} | velocities
    bounded = with_bounds([Unknown(x.name, Meaning(Kind.COORDINATE, x.name)) for x in free], model)
    own = {s: u for s, u in zip(free.values(), bounded, strict=True) if u.name not in end.aliased}
    own |= dict(zip(of_impact.values(), impact.unknowns, strict=True))
    imposed = conditioned_end(
        (*end.conditions, *constraints.tangency(end.boundary, matched, values), *impact.conditions),
        end.cost,
        substitution,
        end.suffix,
        {*free.values(), *of_impact.values(), *shared},
        names,
        own,
        model.parameters,
    )
    return matching + pinned_at_zero(unmatched) + imposed


def _motion(model: Model, scheme: Scheme, controls: str, constraints: Constraints) -> Motion:
    """Return the discrete equations of motion: forced Euler-Lagrange equations with constraint forces."""
    interval = variational_interval(path.with_inner_path(model), scheme, controls)
    require_no_inner_points(model, interval.inner, scheme.name)
    names = [q.name for q in model.coordinates]
    multipliers = [f"lambda_{name}" for name in names]
    inner_multipliers = [f"lambda_{q.name}" for q in interval.inner]
    inner = symbols(inner_multipliers, "_k")
    displacements = (*symbols(multipliers, "_k"), *symbols(multipliers, "_k1"), *inner)
    at_left = (f + impulse for f, impulse in zip(constraints.force("_k"), contact.impulses(model), strict=True))
    impulses = (*at_left, *constraints.force("_k1"), *(S.Zero for _ in inner))
    guess = coordinate_guess(model)
    forces = (
        *((f"f-_{n}", f) for n, f in zip(names, interval.force_minus, strict=True)),
        *((f"f+_{n}", f) for n, f in zip(names, interval.force_plus, strict=True)),
        *((f"f_{q}", f) for q, f in zip(interval.inner, interval.force_inner, strict=True)),
    )
    return Motion(
        method="variational",
        scheme=scheme.name,
        node=(
            *(Unknown(name, Meaning(Kind.COORDINATE, name)) for name in names),
            *(Unknown(m, Meaning(Kind.MOTION, name)) for m, name in zip(multipliers, names, strict=True)),
        ),
        interval=(
            *(Unknown(q.name, Meaning(Kind.INNER_VALUE, q.name)) for q in interval.inner),
            *(Unknown(m, Meaning(Kind.MOTION, q.name)) for m, q in zip(inner_multipliers, interval.inner, strict=True)),
        ),
        interval_symbols=(*interval.inner, *inner),
        discrete=interval,
        element=interval.cost + interval.virtual_work(displacements, impulses),
        equations=(
            Equation(interval.lagrangian, "Ld"),
            *(Equation(f, name) for name, f in forces if f != 0),
            Equation(interval.cost, "Cd"),
        ),
        node_guess=guess,
        left_rates=lambda: _left_velocities(model, interval),
        stage_guess=guess * (len(interval.inner) // len(names)),
        stage_times=interval.inner_abscissae,
        contacts=contact.laws(model),
    )


def _left_velocities(model: Model, interval: VariationalInterval) -> tuple[Expr, ...]:
    """Return the velocities at the left node of an interval, from the discrete momenta by the Legendre transform.

    Raises BoundaryError where constraints divide the momentum of a node between its intervals, and the errors of the
    transform.
    """
    if model.holonomic or model.rolling:
        words = "holonomic" if model.holonomic else "rolling"
        raise BoundaryError(
            f"a condition at an inner time depends on velocities, with {words} constraints",
            "write it in coordinates, or as path condition",
        )
    at_left: dict[Symbol, Expr] = dict(zip(model.coordinates, at_nodes(model.coordinates, "_k"), strict=True))
    at_left |= dict(zip(legendre.conjugate_symbols(model), interval.left_momentum, strict=True))
    return tuple(v.subs(at_left, simultaneous=True) for v in legendre.velocity_of_momentum(model))
