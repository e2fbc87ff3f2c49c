"""Segments of one motion that run side by side and meet: a quantity at the end is another one at the start.

The value w where two segments meet is a shared unknown: what begins there equals it, and for what ends there the end
gains zeta (x - w), where the multiplier zeta is shared as well. Each segment by itself is then an initial value problem
with a solution, also in what no control moves. A velocity is no unknown of a node: since all segments have the same
Lagrangian, equal velocities mean equal momenta, and the discrete momenta of both match a shared unknown pi, the last
one by a multiplier that is shared.
"""

from __future__ import annotations

from collections.abc import Sequence

from sympy import Expr, S, Symbol

from codegen.model import Model
from codegen.runtime.record import Kind, Meaning
from codegen.transcribe.conditions.periodic import Own, Periodic
from codegen.transcribe.guesses import at_start, momentum_guess
from codegen.transcribe.names import Names, symbols
from codegen.transcribe.program import Unknown


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
