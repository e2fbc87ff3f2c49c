"""Bounds, conditions, couplings and free parameters of a model, from expressions in plain symbols."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import sympy

from codegen.author.bodies import require_single_bodies
from codegen.errors import BoundaryError
from codegen.model.definitions import Bounds, Condition, FreeParameter, Integral
from codegen.model.relations import text
from codegen.model.written import Entry


def conditions_of(entries: Sequence[Entry], role: str) -> tuple[Condition, ...]:
    """The relations of a role in the order in which they were written."""
    return tuple(_condition(entry) for entry in entries if entry.role == role)


def integrals_of(entries: Sequence[Entry]) -> tuple[Integral, ...]:
    """The conditions on integrals in the order in which they were written."""
    integrands, limits = ([e for e in entries if e.role == role] for role in ("integral", "integral value"))
    return tuple(
        Integral(entry.name, entry.expression, limit.expression, entry.equality)
        for entry, limit in zip(integrands, limits, strict=True)
    )


def couplings_of(
    entries: Sequence[Entry], end_values: Sequence[sympy.Symbol], moving: Sequence[sympy.Symbol]
) -> tuple[tuple[Condition, ...], tuple[Condition, ...]]:
    """The end conditions that tie bodies together, and those that hold for every body by itself.

    `end_values` belong to single bodies; `moving` are the coordinates and rates, which any body has. Raises
    BoundaryError for a coupling that is an inequality, ExpressionError for one that does not tell whose coordinate it
    means.
    """
    couplings, others = [], []
    for entry in entries:
        if entry.role != "end_conditions":
            continue
        own = entry.expression.free_symbols & set(end_values)
        if not own:
            others.append(_condition(entry))
            continue
        if not entry.equality:
            raise BoundaryError(f"{entry.what} couples bodies by an inequality", "couple them by equations only")
        require_single_bodies(entry.what, own, entry.expression.free_symbols & set(moving))
        couplings.append(_condition(entry))
    return tuple(couplings), tuple(others)


def bounds_of(entries: Sequence[Entry], symbols: Sequence[sympy.Symbol]) -> tuple[Bounds, ...]:
    """Bounds of the given symbols, without those that have none."""
    lower, upper = _values(entries, "lower bound"), _values(entries, "upper bound")
    return tuple(Bounds(s, lower.get(s), upper.get(s)) for s in symbols if s in lower or s in upper)


def velocity_bounds(entries: Sequence[Entry], velocities: Sequence[sympy.Symbol]) -> tuple[Condition, ...]:
    """Bounds of velocities as conditions, since in Lagrangian form velocities are no unknowns of their own."""
    return tuple(condition for bound in bounds_of(entries, velocities) for condition in _as_conditions(bound))


def free_parameters_of(entries: Sequence[Entry], symbols: Sequence[sympy.Symbol]) -> tuple[FreeParameter, ...]:
    """The given symbols with their first guesses and bounds."""
    guess, lower, upper = (_values(entries, role) for role in ("first guess", "lower bound", "upper bound"))
    return tuple(FreeParameter(s, guess[s], lower.get(s), upper.get(s)) for s in symbols)


def _condition(entry: Entry) -> Condition:
    return Condition(entry.name, entry.expression, entry.equality)


def _values(entries: Sequence[Entry], role: str) -> dict[sympy.Symbol, sympy.Expr]:
    return {entry.key: entry.expression for entry in entries if entry.role == role and entry.key is not None}


def _as_conditions(bound: Bounds) -> Iterator[Condition]:
    if bound.lower is not None:
        yield Condition(f"{bound.symbol} >= {text(bound.lower)}", bound.lower - bound.symbol, equality=False)
    if bound.upper is not None:
        yield Condition(f"{bound.symbol} <= {text(bound.upper)}", bound.symbol - bound.upper, equality=False)
