"""Control task by the variational method -> ControlProgram.

l = Cd + lambda_k . (D1 Ld + f-) + lambda_k1 . (D2 Ld + f+), and lambda_i . (D_i Ld + f_i) for each inner point of a
Galerkin variational integrator (Ober-Bloebaum and Saake 2015). Summed over intervals the multipliers of a node meet
both halves of its forced discrete Euler-Lagrange equation; the momentum boundary conditions arise at the two end nodes
(`momentum_ends`). Source: Ober-Bloebaum, Junge and Marsden (2011), Discrete mechanics and optimal control.

Momentum boundary conditions of the variational method.

+lambda_0 . D2 L(q(0), v(0)) at the start and -lambda_N . D2 L(q(T), v(T)) at the end make the discrete momenta of the
ends match those of the velocities there. A velocity that is free, but on which a matched momentum, a condition or the
terminal cost depends, is an unknown of its end, and its momentum is matched too, so that each fixed velocity and each
condition counts once. The multiplier of a momentum that is not matched is zero. Source: Ober-Bloebaum, Junge and
Marsden (2011), Discrete mechanics and optimal control: an analysis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sympy import Expr, S, Symbol

from codegen.discretise.assembly import Motion, assemble
from codegen.discretise.conditions import path
from codegen.discretise.conditions.ends import End, conditioned_end, pinned_at_zero, with_bounds
from codegen.discretise.conditions.holonomic import Constraints
from codegen.discretise.conditions.linking import joined_momenta, joined_unknowns, shared_unknowns
from codegen.discretise.conditions.path import nodal_conditions
from codegen.discretise.conditions.periodic import (
    Periodic,
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
from codegen.discretise.program import ControlProgram, Names, Unknown, occurring, symbols
from codegen.discretise.schemes.base import Scheme
from codegen.errors import BoundaryError, SchemeError
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic.derivatives import gradient


@dataclass(frozen=True)
class EndConditions:
    """What holds at one end of a variational problem: values, conditions, terminal cost, momenta given by unknowns.

    `aliased` names coordinates that are equal to a shared unknown there.
    """

    suffix: str
    sign: int
    boundary: Boundary
    conditions: tuple[Condition, ...]
    cost: Expr
    momenta: Mapping[int, Expr]
    aliased: frozenset[str] = frozenset()


def matched_indices(model: Model, end: EndConditions, constraints: Constraints) -> set[int]:
    """The indices of the momenta that match those of velocities at an end.

    They are those of fixed velocities, and of all on which a condition, the terminal cost, a matched momentum or a
    constraint with a matched velocity depends.
    """
    momentum = gradient(model.function, model.rates)
    matched = {i for i, value in enumerate(end.boundary.rates) if value is not None}
    matched |= occurring(model.rates, end.cost, *(condition.expression for condition in end.conditions))
    while True:
        further = occurring(model.rates, *(momentum[i] for i in matched))
        further |= {i for touched in constraints.touched if touched & matched for i in touched}
        if further <= matched:
            return matched
        matched |= further


def momentum_end(
    model: Model,
    end: EndConditions,
    constraints: Constraints,
    literal: Mapping[Symbol, Expr],
    shared: set[Symbol],
    names: Names,
) -> End:
    """Fix positions, match momenta, impose conditions; `shared` are the unknowns that are common to all nodes."""
    dimension = len(model.coordinates)
    matched = matched_indices(model, end, constraints)
    extra = sorted(i for i in matched if end.boundary.rates[i] is None)
    here = symbols([q.name for q in model.coordinates], end.suffix)
    multiplier_names = [f"lambda_{q.name}" for q in model.coordinates]
    multipliers = symbols(multiplier_names, end.suffix)
    extra_symbols = symbols([model.rates[j].name for j in extra], end.suffix)
    substitution: dict[Symbol, Expr] = dict(zip(model.coordinates, here, strict=True))
    substitution |= {v: value for v, value in zip(model.rates, end.boundary.rates, strict=True) if value is not None}
    substitution |= dict(zip((model.rates[j] for j in extra), extra_symbols, strict=True))
    momentum = gradient(model.function, model.rates)
    momenta = [(i, momentum[i].xreplace(substitution)) for i in sorted(matched)]
    _require_disjoint(model, matched, end.momenta)
    momenta += sorted(end.momenta.items())
    unmatched = [multiplier_names[i] for i in range(dimension) if i not in dict(momenta)]
    own = End(
        pins=tuple(
            (q.name, v) for q, v in zip(model.coordinates, end.boundary.positions, strict=True) if v is not None
        ),
        extra=tuple(Unknown(model.rates[j].name, Meaning(Kind.END_VELOCITY, model.rates[j].name)) for j in extra),
        element=sum((end.sign * multipliers[i] * p for i, p in momenta), S.Zero),
        conditions=tuple((f"p_{model.coordinates[i].name}", p) for i, p in momenta),
    )
    free = {symbol for symbol, value in zip(here, end.boundary.positions, strict=True) if value is None}
    conditions: Sequence[Condition] = (*end.conditions, *constraints.tangency(end.boundary, matched, literal))
    unknowns = free | set(extra_symbols) | shared
    own_symbols = [symbol for symbol in here if symbol in free] + list(extra_symbols)
    own_names = [q.name for q, symbol in zip(model.coordinates, here, strict=True) if symbol in free]
    own_names += [model.rates[j].name for j in extra]
    bounded = with_bounds([Unknown(name, Meaning(Kind.COORDINATE, name)) for name in own_names], model)
    named = {s: u for s, u in zip(own_symbols, bounded, strict=True) if u.name not in end.aliased}
    imposed = conditioned_end(conditions, end.cost, substitution, end.suffix, unknowns, names, named, model.parameters)
    return own + pinned_at_zero(unmatched) + imposed


def _require_disjoint(model: Model, matched: set[int], momenta: Mapping[int, Expr]) -> None:
    """Refuse a Hamiltonian's periodic momentum that conditions of an end bring in as well, through a velocity."""
    both = " ".join(model.coordinates[i].name for i in sorted(matched & set(momenta)))
    if both:
        raise BoundaryError(
            f"the momentum of {both} is periodic, and conditions of an end depend on it", "use --method hamiltonian"
        )


def variational(original: Model, scheme: Scheme, controls: str) -> ControlProgram:
    """Transcribe with unknowns q and lambda on nodes and u on intervals (or nodes).

    Holonomic constraints add kappa and eta to the nodes. Raises what the Legendre transform raises, and BoundaryError
    for conditions that do not fit together.
    """
    model, boundary_values = with_symbolic_boundaries(in_velocities(original))
    names = Names(model)
    constraints = Constraints(model, names)
    equalities = path.nodal_equalities(model, nodal_conditions(model, equality=True), "y", names)
    periodic = _periodic(original, model, names)
    shared = shared_unknowns(model, periodic, coordinate_guess(model), names)
    ends = _end_conditions(model, periodic)
    literal = {value.symbol: value.value for value in boundary_values}
    optimised = {own.symbol for own in shared.all}
    start, end = (momentum_end(model, e, constraints, literal, optimised, names) for e in ends)
    start_indices, end_indices = (matched_indices(model, e, constraints) for e in ends)
    by_momentum = {i for i, _ in periodic.start_momenta}, {i for i, _ in periodic.end_momenta}
    return assemble(
        model,
        _motion(model, scheme, controls, constraints),
        boundary_values,
        constraints.nodal_terms((start_indices, end_indices), by_momentum) + equalities,
        start,
        end + End(element=periodic.end_share),
        shared,
        names,
    )


def _periodic(original: Model, model: Model, names: Names) -> Periodic:
    guesses = coordinate_guess(model)
    out = periodic_unknowns(model, model.coordinates, guesses, names)
    out += joined_unknowns(model, model.coordinates, guesses, names) + joined_momenta(model, names)
    if original.form == "hamiltonian":
        return out + periodic_momenta(original, model, names)
    out += periodic_velocities(model, names)
    require_constraints_return(model, out)
    return out


def _end_conditions(model: Model, periodic: Periodic) -> tuple[EndConditions, EndConditions]:
    assert model.end is not None, "a control problem has an end"
    inequalities = path.start_inequalities(model)
    start = (*model.start_conditions, *inequalities, *periodic.start_conditions)
    end = (*model.end_conditions, *periodic.end_conditions)
    aliased = [frozenset(name for name, *_ in each) for each in (periodic.start_aliases, periodic.end_aliases)]
    return (
        EndConditions("_k", 1, model.start, start, S.Zero, dict(periodic.start_momenta), aliased[0]),
        EndConditions("_k1", -1, model.end, end, model.terminal_cost, dict(periodic.end_momenta), aliased[1]),
    )


def _motion(model: Model, scheme: Scheme, controls: str, constraints: Constraints) -> Motion:
    """The forced discrete Euler-Lagrange equations, with the forces of the constraints, times their multipliers."""
    interval = variational_interval(path.with_inner_path(model), scheme, controls)
    if interval.inner and model.holonomic:
        raise SchemeError(
            f"scheme {scheme.name!r} has inner points, where holonomic constraints are not imposed",
            "use midpoint or trapezoidal",
        )
    names = [q.name for q in model.coordinates]
    multipliers = [f"lambda_{name}" for name in names]
    pairs = list(zip(multipliers, names, strict=True))
    inner_multipliers = [f"lambda_{q.name}" for q in interval.inner]
    inner = symbols(inner_multipliers, "_k")
    displacements = (*symbols(multipliers, "_k"), *symbols(multipliers, "_k1"), *inner)
    impulses = (*constraints.force("_k"), *constraints.force("_k1"), *(S.Zero for _ in inner))
    guess = coordinate_guess(model)
    return Motion(
        method="variational",
        scheme=scheme.name,
        node=(
            *(Unknown(name, Meaning(Kind.COORDINATE, name)) for name in names),
            *(Unknown(m, Meaning(Kind.MOTION, name)) for m, name in pairs),
        ),
        interval=(
            *(Unknown(q.name, Meaning(Kind.INNER_VALUE, q.name)) for q in interval.inner),
            *(Unknown(m, Meaning(Kind.MOTION, q.name)) for m, q in zip(inner_multipliers, interval.inner, strict=True)),
        ),
        interval_symbols=(*interval.inner, *inner),
        discrete=interval,
        element=interval.cost + interval.virtual_work(displacements, impulses),
        equations=_equations(names, interval),
        node_guess=guess,
        left_rates=lambda: _left_velocities(model, interval),
        stage_guess=guess * (len(interval.inner) // len(names)),
    )


def _left_velocities(model: Model, interval: VariationalInterval) -> tuple[Expr, ...]:
    """The velocities that belong to the discrete momenta at the left node of an interval, by the Legendre transform.

    Raises BoundaryError where constraints share out the momentum of a node between its intervals, and what the
    transform raises.
    """
    if model.holonomic:
        raise BoundaryError(
            "a condition at an inner time depends on velocities, beside holonomic constraints",
            "write it in coordinates, or as path condition",
        )
    here: dict[Symbol, Expr] = dict(zip(model.coordinates, at_nodes(model.coordinates, "_k"), strict=True))
    here |= dict(zip(legendre.conjugate_symbols(model), interval.left_momentum, strict=True))
    return tuple(v.subs(here, simultaneous=True) for v in legendre.velocity_of_momentum(model))


def _equations(names: list[str], interval: VariationalInterval) -> tuple[tuple[str, Expr], ...]:
    return (
        ("Ld", interval.lagrangian),
        *((f"f-_{n}", f) for n, f in zip(names, interval.force_minus, strict=True) if f != 0),
        *((f"f+_{n}", f) for n, f in zip(names, interval.force_plus, strict=True) if f != 0),
        *((f"f_{q}", f) for q, f in zip(interval.inner, interval.force_inner, strict=True) if f != 0),
        ("Cd", interval.cost),
    )
