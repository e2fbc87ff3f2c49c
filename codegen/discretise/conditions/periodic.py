"""What has the same value at the end as at the start, up to a shift; `transcribe.conditions.periodic` imposes it.

Motions that end as they began: x(T) = x(0) + shift for coordinates, velocities, momenta and states.

An unknown of the node is the same shared unknown at both ends, up to the shift. A velocity is no unknown of a node;
where equal velocities mean equal momenta, the discrete momenta of both ends match a shared unknown pi: the end
elements gain +lambda_0 pi and -lambda_N pi. Everything else becomes a condition at each end with a shared unknown w:
x - w = 0 at the start, and x - w - shift = 0 at the end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import sympy
from sympy import Expr, S, Symbol, sstr

from codegen.discretise.conditions.base import ConditionKind, Latex, Scope
from codegen.discretise.model.definitions import Condition, Model
from codegen.discretise.model.guesses import at_start, coordinate_guess, momentum_guess
from codegen.discretise.model.relations import Entry, checked_mapping, checked_sequence, entry_of, require_declared
from codegen.discretise.program import Names, Unknown, is_invariant_under_shifts, occurring
from codegen.errors import BoundaryError, ExpressionError
from codegen.problem.problem import SAME_AT_BOTH_ENDS, Control
from codegen.problem.symbols import Parameter
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic.derivatives import gradient


class PeriodicKind(ConditionKind):
    """Coordinates, rates or states, with their shifts."""

    argument, field, words = "periodic", "periodic", "periodic ends"
    scope: ClassVar[Scope] = {"periodic": (Parameter,)}
    not_in_phases = BoundaryError, "it is periodic", SAME_AT_BOTH_ENDS

    def written(self, control: Control) -> Iterator[Entry]:
        """What is periodic; a value that one end gives is given at the other end as well, and periodic no more."""
        for entry in self._shifts(control.periodic):
            symbol, shift = entry.key, entry.expression
            if symbol in control.start and symbol not in control.end:
                yield entry_of("end", f"end of {symbol}", control.start[symbol] + shift, symbol)
            elif symbol in control.end and symbol not in control.start:
                yield entry_of("start", f"start of {symbol}", control.end[symbol] - shift, symbol)
            else:
                yield entry

    def _shifts(self, periodic: Mapping[Symbol, Expr] | Sequence[Symbol]) -> Iterator[Entry]:
        if isinstance(periodic, Mapping):
            shifts = list(checked_mapping("periodic", periodic, "symbol: shift").items())
        else:
            shifts = [(symbol, 0) for symbol in checked_sequence("periodic", periodic, "symbol")]
        for index, (symbol, shift) in enumerate(shifts):
            require_declared("periodic", "lists", symbol)
            if symbol in [other for other, _ in shifts[:index]]:
                raise ExpressionError(f"periodic lists {symbol} twice", "list it once")
            yield entry_of("periodic", f"shift of {symbol}", shift, symbol)

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
        return [f"{q} at the end = {q} at the start{_added(shift)}" for q, shift in model.periodic]

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        if model.periodic:
            rows = tuple((f"{q}@T", Symbol(f"{q}@0", real=True) + shift) for q, shift in model.periodic)
            yield "Periodic ends", rows

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        given: Any = control.periodic
        for symbol, shift in given.items() if isinstance(given, Mapping) else [(symbol, 0) for symbol in given]:
            added = f" + {latex(shift)}" if shift else ""
            yield f"{latex.at(symbol, latex.last)} &= {latex.at(symbol, latex.first)}{added}"


def _added(shift: Expr) -> str:
    text = sstr(shift)
    return "" if shift == 0 else f" - {text[1:]}" if text.startswith("-") and not shift.is_Add else f" + {text}"


Alias = tuple[str, str, Expr]
"""An unknown of the node, the shared unknown that it equals, and the offset."""


@dataclass(frozen=True)
class Own:
    """A shared unknown that every body has for itself: what it is, its symbol, and where it starts.

    One that `follows` an unknown of a node needs no bounds of its own.
    """

    unknown: Unknown
    symbol: Symbol
    guess: Expr
    follows: bool = False


@dataclass(frozen=True)
class Periodic:
    """Shared unknowns and what they do at both ends.

    `start_momenta` and `end_momenta` give for a coordinate's index the momentum there that the discrete one matches.
    `end_share` is what the end gains.
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
        """Both together."""
        return Periodic(*(getattr(self, part.name) + getattr(other, part.name) for part in fields(Periodic)))


def periodic_unknowns(model: Model, quantities: Sequence[Symbol], guesses: Sequence[Expr], names: Names) -> Periodic:
    """Periodicity of the quantities that are unknowns of the node."""
    out = Periodic()
    for quantity, shift in model.periodic:
        if quantity in quantities:
            guess = at_start(model, guesses[list(quantities).index(quantity)])
            out += _tied(model, quantity, quantity, shift, guess, names)
    return out


def periodic_velocities(model: Model, names: Names) -> Periodic:
    """Periodicity of the velocities of a model in Lagrangian form, by momenta where that says the same.

    Where a condition or the terminal cost depends on a velocity, it is an unknown of the end and stands for itself.
    """
    shifts = dict(model.periodic)
    chosen = [i for i, v in enumerate(model.rates) if v in shifts]
    conditions = (*model.start_conditions, *model.end_conditions)
    wanted = occurring(model.rates, model.terminal_cost, *(condition.expression for condition in conditions))
    by_momentum = set(equivalent_momenta(model, [i for i in chosen if i not in wanted]))
    out = Periodic()
    for i in chosen:
        guess = at_start(model, momentum_guess(model)[i])
        if i in by_momentum:
            out += _matched(model, i, S.Zero, guess, names)
        else:
            velocity = model.rates[i]
            speed = at_start(model, sympy.diff(coordinate_guess(model)[i], model.time))
            out += _by_conditions(velocity, velocity, shifts[velocity], speed, names)
    return out


def periodic_momenta(original: Model, model: Model, names: Names) -> Periodic:
    """Periodicity of the momenta of a Hamiltonian that is transcribed in Lagrangian form, by discrete momenta."""
    shifts = dict(original.periodic)
    out = Periodic()
    for i, p in enumerate(original.rates):
        if p not in shifts:
            continue
        out += _matched(model, i, shifts[p], at_start(model, momentum_guess(model)[i]), names)
    return out


def periodic_velocities_in_momenta(model: Model, phase: Model, names: Names) -> Periodic:
    """Periodicity of the velocities of a Lagrangian that is transcribed in Hamiltonian form."""
    shifts = dict(model.periodic)
    chosen = [i for i, v in enumerate(model.rates) if v in shifts]
    by_momentum = set(equivalent_momenta(model, chosen))
    out = Periodic()
    for i in chosen:
        p, guess = phase.rates[i], at_start(model, momentum_guess(model)[i])
        if i in by_momentum:
            out += _tied(model, p, p, S.Zero, guess, names)
        else:
            velocity = sympy.diff(phase.function, p)
            speed = at_start(model, sympy.diff(coordinate_guess(model)[i], model.time))
            out += _by_conditions(model.rates[i], velocity, shifts[model.rates[i]], speed, names)
    return out


def equivalent_momenta(model: Model, chosen: Sequence[int]) -> tuple[int, ...]:
    """Those of the chosen indices at which equal velocities at both ends mean equal momenta dL/dv.

    The momenta must depend on periodic velocities and coordinates only and must not change under the coordinates'
    shifts; with a holonomic constraint all of its coordinates are needed.
    """
    shifts = dict(model.periodic)
    same = {i for i in chosen if shifts[model.rates[i]] == 0}
    momenta = gradient(model.function, model.rates)
    while True:
        failing = {i for i in same if not _returns(model, momenta[i], same)}
        for constraint in model.holonomic:
            touched = occurring(model.coordinates, constraint)
            failing |= same & touched if not touched <= same else set()
        if not failing:
            return tuple(sorted(same))
        same -= failing


def _returns(model: Model, momentum: Expr, same: set[int]) -> bool:
    shifts = dict(model.periodic)
    present = [model.coordinates[i] for i in occurring(model.coordinates, momentum)]
    if momentum.has(model.time) or not occurring(model.rates, momentum) <= same:
        return False
    return all(q in shifts for q in present) and is_invariant_under_shifts(momentum, {q: shifts[q] for q in present})


def _tied(model: Model, quantity: Symbol, unknown: Symbol, shift: Expr, guess: Expr, names: Names) -> Periodic:
    """An unknown of the node, by aliases."""
    own = _own(names.named("periodic", quantity), Meaning(Kind.START_VALUE, quantity.name), guess)
    name = own.unknown.name
    return Periodic((own,), ((unknown.name, name, S.Zero),), ((unknown.name, name, shift),))


def _matched(model: Model, index: int, shift: Expr, guess: Expr, names: Names) -> Periodic:
    q = model.coordinates[index]
    own = _own(names.named("pi", q), Meaning(Kind.START_MOMENTUM, q.name), guess)
    return Periodic(own=(own,), start_momenta=((index, own.symbol),), end_momenta=((index, own.symbol + shift),))


def _by_conditions(quantity: Symbol, value: Expr, shift: Expr, guess: Expr, names: Names) -> Periodic:
    own = _own(names.named("periodic", quantity), Meaning(Kind.START_VALUE, quantity.name), guess)
    name = f"{quantity} is periodic"
    first = Condition(name, value - own.symbol)
    return Periodic(
        own=(own,), start_conditions=(first,), end_conditions=(Condition(name, value - own.symbol - shift),)
    )


def _own(name: str, meaning: Meaning, guess: Expr) -> Own:
    return Own(Unknown(name, meaning), Symbol(name, real=True), guess)


def require_constraints_return(model: Model, periodic: Periodic) -> None:
    """Refuse velocities that are periodic while others of the same holonomic constraint are not, or are shifted."""
    conditions = (*periodic.start_conditions, *periodic.end_conditions)
    indices = occurring(model.rates, *(condition.expression for condition in conditions))
    for constraint in model.holonomic:
        touched = occurring(model.coordinates, constraint)
        if indices & touched:
            listed = " ".join(model.rates[i].name for i in sorted(touched))
            raise BoundaryError(
                f"velocities of the constraint {constraint} are periodic, but not all of them alike",
                f"make {listed} and their coordinates periodic without a shift of the velocities",
            )
