"""Unknowns that belong to no node: static parameters of the problem, and each body's coordinates that are coupled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sympy import Expr, Max, Min, S, Symbol

from codegen.errors import BoundaryError
from codegen.model import Condition, Model
from codegen.runtime.record import Kind, Meaning
from codegen.transcribe.conditions.periodic import Alias, Own, Periodic
from codegen.transcribe.guesses import at_end
from codegen.transcribe.names import Names
from codegen.transcribe.program import Coupling, Unknown
from codegen.transcribe.redundancy.redundant_couplings import independent_couplings


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
