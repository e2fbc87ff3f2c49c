"""Momentum boundary conditions of the variational method.

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

from codegen.discretise.conditions.ends import End, conditioned_end, pinned_at_zero, with_bounds
from codegen.discretise.conditions.holonomic import Constraints
from codegen.discretise.model.definitions import Boundary, Condition, Model
from codegen.discretise.program import Names, Unknown, occurring, symbols
from codegen.errors import BoundaryError
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
