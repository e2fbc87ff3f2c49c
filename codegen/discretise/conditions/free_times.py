"""Free times on one chain: every node has its time, and a pace, at which time passes along the interval before it.

The chain's own parameter runs from 0 to 1, the same part of it between any two inner times that follow each other. With
the time e and the pace a > 0 an interval of length h lasts a_k1 h, and it gains

    mu_e (e_k1 - e_k - a_k1 h) + mu_a (a_k1 - a_k)

in its l, the latter only where its left node is not at an inner time: the pace is the same between two of them. So each
interval knows its own length alone, and the system stays as narrow as it is, however many inner times there are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from sympy import Expr, S, Symbol

from codegen.discretise.conditions.ends import End
from codegen.discretise.guesses import DURATION
from codegen.discretise.interval import STEP
from codegen.discretise.model.definitions import InnerCondition, Model
from codegen.discretise.model.relations import text
from codegen.discretise.program import Names, Unknown, symbols
from codegen.runtime.record import Kind, Meaning


@dataclass(frozen=True)
class Clock:
    """The names of time and pace at nodes, and of the multipliers of their equations on intervals."""

    model: Model
    time: str
    pace: str
    multipliers: tuple[str, str]

    @property
    def node(self) -> tuple[Unknown, Unknown]:
        """The unknowns of a node."""
        return Unknown(self.time, Meaning(Kind.TIME)), Unknown(self.pace, Meaning(Kind.PACE), lower=S.Zero)

    @property
    def interval(self) -> tuple[Unknown, Unknown]:
        """The unknowns of an interval."""
        of_time, of_pace = self.multipliers
        return Unknown(of_time, Meaning(Kind.PASSING_TIME)), Unknown(of_pace, Meaning(Kind.CONSTANT_PACE))

    @property
    def symbol(self) -> Symbol:
        """The symbol of time in conditions at inner times."""
        return Symbol(self.time, real=True)

    @property
    def guess(self) -> tuple[Expr, Expr]:
        """Time and pace where all intervals are as long."""
        return self.model.time, DURATION

    @property
    def scales(self) -> tuple[tuple[Symbol, Expr], ...]:
        """What an interval's length and the time at its left node are."""
        (pace,), (time,) = symbols([self.pace], "_k1"), symbols([self.time], "_k")
        return (STEP, pace * STEP), (self.model.time, time)

    def share(self, at_inner_time: Expr) -> Expr:
        """What l gains, before lengths are replaced; the symbol is one after an inner time, and zero elsewhere."""
        left, right = symbols([self.time, self.pace], "_k"), symbols([self.time, self.pace], "_k1")
        of_time, of_pace = symbols(self.multipliers, "_k")
        stays = of_pace * (right[1] - left[1])
        return of_time * (right[0] - left[0] - STEP) + stays + at_inner_time * (of_pace**2 / 2 - stays)

    def start(self) -> End:
        """Time begins at zero."""
        return End(pins=((self.time, S.Zero),))

    def end(self, names: Names) -> End:
        """And ends with the duration."""
        duration = self.model.duration
        if not duration.free_symbols & {parameter.symbol for parameter in self.model.free_parameters}:
            return End(pins=((self.time, duration),))
        multiplier = Unknown(names.numbered("nu"), Meaning(Kind.DURATION))
        (nu,), (time,) = symbols([multiplier.name], "_k1"), symbols([self.time], "_k1")
        return End(
            extra=(multiplier,), element=nu * (time - duration), conditions=((f"0 ({self.time})", time - duration),)
        )


def clock_of(model: Model, names: Names) -> Clock | None:
    """The clock of a model that has free times between start and end."""
    if not model.has_free_times:
        return None
    time, pace = names.named("time", model.time), names.named("pace", model.time)
    return Clock(model, time, pace, (names.numbered("mu_time"), names.numbered("mu_pace")))


def with_given_times(model: Model, clock: Clock | None) -> Model:
    """The model whose given times, and windows without length, are conditions on the clock, if there is one."""
    if clock is None:
        return model
    conditions, times = list(model.inner_conditions), list(model.inner_times)
    for number, inner in enumerate(model.inner_times):
        given = inner.earliest if inner.earliest == inner.latest else None
        given = inner.time if inner.time is not None else given
        if given is not None:
            name = f"the time {text(given)}"
            conditions.append(InnerCondition(name, clock.symbol - given, True, number))
            times[number] = replace(inner, earliest=None, latest=None)
    conditions = [replace(c, expression=c.expression.xreplace({model.time: clock.symbol})) for c in conditions]
    return replace(model, inner_conditions=tuple(conditions), inner_times=tuple(times))
