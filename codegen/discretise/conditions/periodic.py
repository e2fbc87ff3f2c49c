"""Periodic motions: quantities with the same value at the end as at the start, up to a shift.

The condition is x(T) = x(0) + shift for coordinates, velocities, momenta and states.

An unknown of the node equals one linking variable at both ends, up to the shift. A velocity is no unknown of a node. If
equal velocities mean equal momenta, the discrete momenta of both ends match a linking variable pi. The contributions of
the ends to the Lagrangian gain +lambda_0 pi and -lambda_N pi. Every other quantity has a linking variable w, with the
condition x - w = 0 at the start, and x - w - shift = 0 at the end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import ClassVar

import sympy
from sympy import Expr, S, Symbol, sstr

from codegen.discretise.conditions.base import ConditionKind, Latex, Scope
from codegen.discretise.model.definitions import Condition, Model
from codegen.discretise.model.guesses import coordinate_guess, momentum_guess
from codegen.discretise.model.relations import Entry, checked_mapping, checked_sequence, entry_of, require_declared
from codegen.discretise.program import Names, Unknown, is_invariant_under_shifts, occurring
from codegen.errors import BoundaryError, ExpressionError
from codegen.problem.problem import SAME_AT_BOTH_ENDS, Control
from codegen.problem.symbols import Parameter
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic.derivatives import gradient


class PeriodicKind(ConditionKind):
    """Coordinates, rates or states with the same value at both ends, up to a shift."""

    argument, field, words = "periodic", "periodic", "periodic ends"
    scope: ClassVar[Scope] = {"periodic": (Parameter,)}
    not_in_phases = BoundaryError, "it is periodic", SAME_AT_BOTH_ENDS

    def written(self, control: Control) -> Iterator[Entry]:
        """Yield the shifts of periodic quantities; if one end prescribes a value, yield the value at the other end."""
        periodic = control.periodic
        if isinstance(periodic, Mapping):
            shifts = list(checked_mapping("periodic", periodic, "symbol: shift").items())
        else:
            shifts = [(symbol, 0) for symbol in checked_sequence("periodic", periodic, "symbol")]
        for index, (symbol, written) in enumerate(shifts):
            require_declared("periodic", "lists", symbol)
            if symbol in [other for other, _ in shifts[:index]]:
                raise ExpressionError(f"periodic lists {symbol} twice", "list it once")
            entry = entry_of("periodic", f"shift of {symbol}", written, symbol)
            shift = entry.expression
            if symbol in control.start and symbol not in control.end:
                yield entry_of("end", f"end of {symbol}", control.start[symbol] + shift, symbol)
            elif symbol in control.end and symbol not in control.start:
                yield entry_of("start", f"start of {symbol}", control.end[symbol] - shift, symbol)
            else:
                yield entry

    def require_fitting(self, entry: Entry, control: Control, form: str) -> None:
        if entry.key in control.start:
            raise BoundaryError(
                f"start and end fix {entry.key}, which is periodic", "leave it out of one end, or out of periodic"
            )

    def conditions(self, entries: Sequence[Entry]) -> tuple[tuple[Symbol, Expr], ...]:
        return tuple((entry.key, entry.expression) for entry in entries if entry.role == self.argument)

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        yield from ()

    def numbers(self, model: Model) -> Iterator[tuple[str, Expr]]:
        yield from ((f"shift of {symbol}", shift) for symbol, shift in model.periodic)

    def sentences(self, model: Model) -> list[str]:
        lines = []
        for q, shift in model.periodic:
            written = sstr(shift)
            term = f" - {written[1:]}" if written.startswith("-") and not shift.is_Add else f" + {written}"
            lines.append(f"{q} at the end = {q} at the start{term if shift != 0 else ''}")
        return lines

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        if model.periodic:
            rows = tuple((f"{q}@T", Symbol(f"{q}@0", real=True) + shift) for q, shift in model.periodic)
            yield "Periodic ends", rows

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        periodic = control.periodic
        for symbol, shift in periodic.items() if isinstance(periodic, Mapping) else [(s, 0) for s in periodic]:
            added = f" + {latex(shift)}" if shift else ""
            yield f"{latex.at(symbol, latex.last)} &= {latex.at(symbol, latex.first)}{added}"


Alias = tuple[str, str, Expr]
"""The name of an unknown of a node, the name of the linking variable that it equals, and the offset."""


@dataclass(frozen=True)
class Own:
    """A linking variable with its symbol and its initial guess.

    A variable that `follows` an unknown of a node needs no bounds of its own.
    """

    unknown: Unknown
    symbol: Symbol
    guess: Expr
    follows: bool = False


@dataclass(frozen=True)
class Periodic:
    """The linking variables of periodic quantities, or of joined segments, and their terms at both ends.

    `start_momenta` and `end_momenta` are pairs (index of a coordinate, value that the discrete momentum matches).
    `end_share` is a contribution of the end to the Lagrangian of the optimisation problem.
    """

    own: tuple[Own, ...] = ()
    start_aliases: tuple[Alias, ...] = ()
    end_aliases: tuple[Alias, ...] = ()
    start_conditions: tuple[Condition, ...] = ()
    end_conditions: tuple[Condition, ...] = ()
    start_momenta: tuple[tuple[int, Expr], ...] = ()
    end_momenta: tuple[tuple[int, Expr], ...] = ()
    end_share: Expr = S.Zero

    def __add__(self, other: Periodic) -> Periodic:
        """Return the terms of both."""
        return Periodic(*(getattr(self, part.name) + getattr(other, part.name) for part in fields(Periodic)))


def periodic_unknowns(model: Model, quantities: Sequence[Symbol], guesses: Sequence[Expr], names: Names) -> Periodic:
    """Return the terms for periodic `quantities`, which are unknowns of a node and have the `guesses`."""
    out = Periodic()
    for quantity, shift in model.periodic:
        if quantity in quantities:
            guess = guesses[list(quantities).index(quantity)].subs(model.time, 0)
            out += _tied(quantity, shift, guess, names)
    return out


def periodic_velocities(model: Model, names: Names, phase: Model | None = None) -> Periodic:
    """Return the terms for the periodic velocities of a Lagrangian, by momenta where these are equivalent.

    `phase` is the model in Hamiltonian form, if momenta are unknowns of nodes. Otherwise a velocity in a condition or
    in the terminal cost is an unknown of the end, and keeps a condition of its own.
    """
    shifts = dict(model.periodic)
    chosen = [i for i, v in enumerate(model.rates) if v in shifts]
    conditions = (*model.start_conditions, *model.end_conditions)
    at_ends = occurring(model.rates, model.terminal_cost, *(condition.expression for condition in conditions))
    by_momentum = set(equivalent_momenta(model, [i for i in chosen if phase is not None or i not in at_ends]))
    out = Periodic()
    for i in chosen:
        velocity, guess = model.rates[i], momentum_guess(model)[i].subs(model.time, 0)
        if i in by_momentum:
            out += _tied(phase.rates[i], S.Zero, guess, names) if phase else _matched(model, i, S.Zero, guess, names)
        else:
            value = sympy.diff(phase.function, phase.rates[i]) if phase else velocity
            speed = sympy.diff(coordinate_guess(model)[i], model.time).subs(model.time, 0)
            out += _by_conditions(velocity, value, shifts[velocity], speed, names)
    return out


def periodic_momenta(original: Model, model: Model, names: Names) -> Periodic:
    """Return the terms for periodic momenta of a Hamiltonian model `original`, transcribed in Lagrangian form."""
    shifts = dict(original.periodic)
    out = Periodic()
    for i, p in enumerate(original.rates):
        if p in shifts:
            out += _matched(model, i, shifts[p], momentum_guess(model)[i].subs(model.time, 0), names)
    return out


def equivalent_momenta(model: Model, chosen: Sequence[int]) -> tuple[int, ...]:
    """Return the `chosen` indices of velocities whose periodicity is equivalent to periodic momenta dL/dv.

    The momenta must depend on periodic velocities and coordinates only, and must not change under the coordinates'
    shifts. All coordinates on which the force of a constraint acts must qualify, or none is returned.
    """
    shifts = dict(model.periodic)
    same = {i for i in chosen if shifts[model.rates[i]] == 0}
    momenta = gradient(model.function, model.rates)

    def returns(momentum: Expr) -> bool:
        present = [model.coordinates[i] for i in occurring(model.coordinates, momentum)]
        if momentum.has(model.time) or not occurring(model.rates, momentum) <= same:
            return False
        return all(q in shifts for q in present) and is_invariant_under_shifts(
            momentum, {q: shifts[q] for q in present}
        )

    while True:
        failing = {i for i in same if not returns(momenta[i])}
        for touched in touched_by_constraints(model):
            failing |= same & touched if not touched <= same else set()
        if not failing:
            return tuple(sorted(same))
        same -= failing


def touched_by_constraints(model: Model) -> list[set[int]]:
    """Return the indices of the coordinates on which the force of each constraint acts, holonomic ones first."""
    touched = [occurring(model.coordinates, constraint) for constraint in model.holonomic]
    return touched + [occurring(model.rates, constraint) for constraint in model.rolling]


def _tied(quantity: Symbol, shift: Expr, guess: Expr, names: Names) -> Periodic:
    """Return the terms that equate an unknown of the node at both ends to a linking variable."""
    own = own_unknown(names.named("periodic", quantity), Kind.START_VALUE, quantity, guess)
    name = own.unknown.name
    return Periodic((own,), ((quantity.name, name, S.Zero),), ((quantity.name, name, shift),))


def _matched(model: Model, index: int, shift: Expr, guess: Expr, names: Names) -> Periodic:
    """Return the terms that match the discrete momenta of both ends to a linking variable."""
    q = model.coordinates[index]
    own = own_unknown(names.named("pi", q), Kind.START_MOMENTUM, q, guess)
    return Periodic(own=(own,), start_momenta=((index, own.symbol),), end_momenta=((index, own.symbol + shift),))


def _by_conditions(quantity: Symbol, value: Expr, shift: Expr, guess: Expr, names: Names) -> Periodic:
    """Return the terms that impose a condition with a linking variable at each end."""
    own = own_unknown(names.named("periodic", quantity), Kind.START_VALUE, quantity, guess)
    at_ends = (Condition(f"{quantity} is periodic", value - own.symbol - offset) for offset in (S.Zero, shift))
    start, end = at_ends
    return Periodic(own=(own,), start_conditions=(start,), end_conditions=(end,))


def own_unknown(name: str, kind: Kind, of: Symbol, guess: Expr, follows: bool = False) -> Own:
    """Return a linking variable of each body, which belongs to the quantity `of`."""
    return Own(Unknown(name, Meaning(kind, of.name)), Symbol(name, real=True), guess, follows)


def require_constraints_return(model: Model, periodic: Periodic, values: Mapping[Symbol, Expr]) -> None:
    """Raise BoundaryError if constraints and periodic velocities do not fit together.

    Velocities of a constraint must be periodic all alike, without a shift. A rolling constraint must be the same at
    both ends, because one force acts there. `values` maps the symbols of boundary values to the values.
    """
    conditions = (*periodic.start_conditions, *periodic.end_conditions)
    indices = occurring(model.rates, *(condition.expression for condition in conditions))
    matched, shifts = {i for i, _ in periodic.start_momenta}, dict(model.periodic)
    assert model.end is not None, "a control problem has an end"
    for q, first, last in zip(model.coordinates, model.start.positions, model.end.positions, strict=True):
        if first is not None and last is not None:
            shifts[q] = last.xreplace(values) - first.xreplace(values)
    every = (*model.holonomic, *model.rolling)
    for constraint, touched in zip(every, touched_by_constraints(model), strict=True):
        if constraint in model.rolling and touched & matched:
            moving = {q: shifts.get(q) for q in model.coordinates if constraint.has(q)}
            known = {q: shift for q, shift in moving.items() if shift is not None}
            is_same = known == moving and is_invariant_under_shifts(constraint, known)
            if constraint.has(model.time) or not is_same:
                raise BoundaryError(
                    f"the rolling constraint {constraint} = 0 is not the same at both ends of a periodic motion",
                    "make its coordinates periodic, with shifts that leave it unchanged",
                )
        if indices & touched:
            listed = " ".join(model.rates[i].name for i in sorted(touched))
            raise BoundaryError(
                f"velocities of the constraint {constraint} are periodic, but not all of them alike",
                f"make {listed} and their coordinates periodic without a shift of the velocities",
            )
