"""Unknowns that belong to no node: static parameters of the problem, and each body's coordinates that are coupled.

Segments of one motion that run side by side and meet: a quantity at the end is another one at the start.

The value w where two segments meet is a shared unknown: what begins there equals it, and for what ends there the end
gains zeta (x - w), where the multiplier zeta is shared as well. Each segment by itself is then an initial value problem
with a solution, also in what no control moves. A velocity is no unknown of a node: since all segments have the same
Lagrangian, equal velocities mean equal momenta, and the discrete momenta of both match a shared unknown pi, the last
one by a multiplier that is shared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sympy import Expr, Max, Min, S, Symbol

from codegen.discretise.conditions.periodic import Alias, Own, Periodic
from codegen.discretise.guesses import at_end, at_start, momentum_guess
from codegen.discretise.model.definitions import Condition, Model
from codegen.discretise.program import Coupling, Names, Unknown, symbols
from codegen.discretise.redundant_couplings import independent_couplings
from codegen.errors import BoundaryError
from codegen.runtime.record import Kind, Meaning


@dataclass(frozen=True)
class Shared:
    """Shared unknowns, first each body's own ones, then the common ones; and what couples bodies.

    `start_aliases` and `end_aliases` say what equals them at the ends; `redundant` are the couplings that
    follow from the others: numbers, from 1, among all of them, and names.
    """

    own: tuple[Own, ...]
    common: tuple[Own, ...]
    start_aliases: tuple[Alias, ...]
    end_aliases: tuple[Alias, ...]
    couplings: tuple[Coupling, ...]
    coupling_symbols: tuple[tuple[Symbol, int, int], ...]
    redundant: tuple[tuple[int, str], ...]

    @property
    def all(self) -> tuple[Own, ...]:
        """All of them in order."""
        return (*self.own, *self.common)


def shared_unknowns(model: Model, periodic: Periodic, guesses: Sequence[Expr], names: Names) -> Shared:
    """Collect static parameters, what periodicity shares, and the coupled coordinates at the end.

    `guesses` are those of the coordinates. Raises BoundaryError when a coupled coordinate is given at the end.
    """
    common = tuple(
        Own(Unknown(p.symbol.name, Meaning(Kind.FREE_PARAMETER, p.symbol.name), p.lower, p.upper), p.symbol, p.guess)
        for p in model.free_parameters
    )
    own, aliases = list(periodic.own), list[Alias]()
    index: dict[int, int] = {}
    offset: dict[int, Expr] = {}
    tied = {name: (other, shift) for name, other, shift in periodic.end_aliases}
    for i in sorted({value.coordinate for value in model.end_values}):
        q = model.coordinates[i]
        assert model.end is not None, "a control problem has an end"
        if model.end.positions[i] is not None:
            raise BoundaryError(f"{q} is given at the end, and couplings depend on it", "leave out one of the two")
        if q.name in tied:
            name, offset[i] = tied[q.name]
            index[i] = next(j for j, o in enumerate(own) if o.unknown.name == name)
            continue
        name = names.named("coupled", q)
        index[i], offset[i] = len(own), S.Zero
        unknown = Unknown(name, Meaning(Kind.END_VALUE, q.name))
        own.append(Own(unknown, Symbol(name, real=True), at_end(model, guesses[i])))
        aliases.append((q.name, name, S.Zero))
    values = model.end_values
    shifted = {v.symbol: v.symbol + offset[v.coordinate] for v in values if offset[v.coordinate] != 0}
    kept = _independent(model)
    tied_nodes = (*periodic.start_aliases, *periodic.end_aliases, *aliases)
    return Shared(
        own=tuple(o if o.follows else replace(o, unknown=_bounded(model, o.unknown, tied_nodes)) for o in own),
        common=common,
        start_aliases=periodic.start_aliases,
        end_aliases=(*periodic.end_aliases, *aliases),
        couplings=tuple(
            Coupling(Unknown(names.numbered("nu"), Meaning(Kind.COUPLING, c.name)), c.expression.xreplace(shifted))
            for c in kept
        ),
        coupling_symbols=tuple((v.symbol, v.body, index[v.coordinate]) for v in values),
        redundant=tuple((i, c.name) for i, c in enumerate(model.couplings, start=1) if c not in kept),
    )


def _bounded(model: Model, unknown: Unknown, aliases: Sequence[Alias]) -> Unknown:
    """Give a shared unknown the bounds of the quantities that equal it, up to their offsets, at the ends."""
    bounds = {bound.symbol.name: bound for bound in model.bounds}
    tied = [(bounds[name], offset) for name, other, offset in aliases if other == unknown.name and name in bounds]
    lower = [bound.lower - offset for bound, offset in tied if bound.lower is not None]
    upper = [bound.upper - offset for bound, offset in tied if bound.upper is not None]
    return replace(unknown, lower=Max(*lower) if lower else None, upper=Min(*upper) if upper else None)


def _independent(model: Model) -> tuple[Condition, ...]:
    """The couplings without those that follow from the others, which would make the KKT matrix singular.

    All of them where they seem to contradict each other: what follows from the others there need not hold with them.
    Raises BoundaryError for a condition without a slope, which no Newton step can reach.
    """
    found = independent_couplings(model)
    if not found.consistent:
        return model.couplings
    for index, others in found.dropped:
        if not others:
            raise BoundaryError(
                f"the condition {model.couplings[index]} between bodies has no slope where it holds",
                "write it without its square, or leave it out",
            )
    return tuple(model.couplings[i] for i in found.kept)


def joined_unknowns(model: Model, quantities: Sequence[Symbol], guesses: Sequence[Expr], names: Names) -> Periodic:
    """What joins the quantities that are unknowns of the node: coordinates, and momenta where these are."""
    out, known = Periodic(), dict(zip(quantities, guesses, strict=True))
    for group in (model.coordinates, model.rates):
        for i, j in _indices(model) if group and set(group) <= set(quantities) else ():
            last, first = group[i], group[j]
            own = _own(
                names.named("joined", first), Meaning(Kind.START_VALUE, first.name), at_start(model, known[first])
            )
            zeta = _multiplier(names.named("nu", first), Meaning(Kind.CONTINUITY, last.name))
            (there,) = symbols([last.name], "_k1")
            share = zeta.symbol * (there - own.symbol)
            out += Periodic((own, zeta), start_aliases=((first.name, own.unknown.name, S.Zero),), end_share=share)
    return out


def joined_momenta(model: Model, names: Names) -> Periodic:
    """What joins the rates of a model in Lagrangian form, whose momenta the discrete ones match."""
    out = Periodic()
    for i, j in _indices(model):
        last, first = model.coordinates[i], model.coordinates[j]
        guess = at_start(model, momentum_guess(model)[j])
        own = _own(names.named("pi", first), Meaning(Kind.START_MOMENTUM, first.name), guess)
        zeta = _multiplier(names.named("nu", model.rates[j]), Meaning(Kind.MOMENTUM_CONTINUITY, last.name))
        alias = (f"lambda_{last}", zeta.unknown.name, S.Zero)
        momenta = ((j, own.symbol),), ((i, own.symbol),)
        out += Periodic((own, zeta), end_aliases=(alias,), start_momenta=momenta[0], end_momenta=momenta[1])
    return out


def _indices(model: Model) -> list[tuple[int, int]]:
    """The coordinates that are joined: indices of that at the end and of that at the start."""
    return [(model.coordinates.index(last), model.coordinates.index(first)) for last, first in model.joined]


def _own(name: str, meaning: Meaning, guess: Expr) -> Own:
    return Own(Unknown(name, meaning), Symbol(name, real=True), guess, follows=True)


def _multiplier(name: str, meaning: Meaning) -> Own:
    return Own(Unknown(name, meaning), Symbol(name, real=True), S.Zero, follows=True)
