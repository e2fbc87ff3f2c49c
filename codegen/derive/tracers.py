"""The velocity of a particle without momentum, and its derivative by position, from those of the pair term."""

from __future__ import annotations

from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.derive.pairwise import Assignment, PairDerivatives
from codegen.errors import ExpressionError
from codegen.expressions.zeros import identically_zero
from codegen.model.pairwise import PairwiseModel


@dataclass(frozen=True)
class TracerDerivatives:
    """What particle j contributes to the velocity of a tracer point i: `velocity`, d entries, and `gradient`.

    Entry a*d + b of the gradient is the derivative of velocity component a by coordinate b. `assignments` are
    differences, scalars and derivatives by them that both are written in.
    """

    assignments: tuple[Assignment, ...]
    velocity: tuple[Expr, ...]
    gradient: tuple[Expr, ...]


def tracer_derivatives(model: PairwiseModel, derivatives: PairDerivatives) -> TracerDerivatives:
    """Put p_i = 0 into the derivatives of the pair term.

    Raises ExpressionError where a particle without momentum does not stay so, where it does not only follow the
    others, or where it would not stay with another one that it meets.
    """
    rest = dict.fromkeys(model.first.p, sympy.S.Zero)
    for name, term in (("pair_term", model.pair_term), ("self_term", model.self_term)):
        for q in model.first.q:
            if not identically_zero(sympy.diff(term, q).xreplace(rest)):
                raise ExpressionError(
                    f"the system has no tracer points: without momentum, {name} still changes with {q}",
                    "leave out passive=True, or write kinetic energies alone",
                )
    for p in model.first.p:
        if not identically_zero(sympy.diff(model.self_term, p).xreplace(rest)):
            raise ExpressionError(
                f"tracer points would move by themselves: self_term changes with {p} where momenta vanish",
                "leave out passive=True, or write a self_term of second degree in momenta",
            )
        if sympy.diff(model.pair_term, p).xreplace(rest).free_symbols & set(model.first.own):
            raise ExpressionError(
                f"a tracer point has no {', '.join(model.own)}, on which its velocity depends",
                "leave out passive=True, or own parameters",
            )
    _require_company(model)
    pair, size = derivatives.pair, len(model.coordinates)
    known: dict[Symbol, Expr] = dict.fromkeys(model.first.p, sympy.S.Zero)
    assignments: list[Assignment] = []
    for symbol, value in (*pair.differences, *pair.scalars, *pair.slopes, *pair.curvatures):
        reduced = value.xreplace(known)
        if reduced.is_number:
            known[symbol] = reduced
        else:
            assignments.append((symbol, reduced))
    entries = {(row, column): value for row, column, value in pair.hessian}
    return TracerDerivatives(
        assignments=tuple(assignments),
        velocity=tuple(value.xreplace(known) for value in pair.gradient[size : 2 * size]),
        gradient=tuple(
            entries.get((size + a, b), sympy.S.Zero).xreplace(known) for a in range(size) for b in range(size)
        ),
    )


def _require_company(model: PairwiseModel) -> None:
    """A tracer point that lies on a particle has its velocity: the limit of the pair term gives that of self_term."""
    if model.limit is None:
        raise ExpressionError(
            "the system has no tracer points: where one meets a particle, its velocity has no limit",
            "leave out passive=True, or write a pair_term that is continuous",
        )
    rest = dict.fromkeys(model.first.p, sympy.S.Zero)
    alone = dict(zip((*model.second.p, *model.second.own), (*model.first.p, *model.first.own), strict=True))
    for p in model.first.p:
        met = sympy.diff(model.limit, p).xreplace(rest).xreplace(alone)
        if not identically_zero(met - sympy.diff(model.self_term, p)):
            raise ExpressionError(
                "a tracer point would leave the particle that it lies on: self_term is not half the limit of "
                "pair_term at coincidence",
                "leave out self_term, or passive=True",
            )
