"""The two nodes of an interval: symbols and values there, controls between them, values at points inside."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.discretise.polynomials import between
from codegen.model import Condition, Model
from codegen.schemes import Scheme

STEP = Symbol("h", positive=True)
"""The length h of an interval."""
LENGTHS = tuple(Symbol(f"h_{i}", positive=True) for i in (1, 2))
"""The lengths of the two substeps of a composition's base, where they differ."""


@dataclass(frozen=True)
class Sites:
    """Symbols for the values of quantities at the two ends of an interval, and of controls on it.

    With nodal controls `left_controls` and `right_controls` differ, else both are the interval's own. Controls at
    stages have values of their own at each of the scheme's points, in order, and none of the interval.
    """

    left: tuple[Symbol, ...]
    right: tuple[Symbol, ...]
    left_controls: tuple[Symbol, ...]
    right_controls: tuple[Symbol, ...]
    stage_controls: tuple[tuple[Symbol, ...], ...] = ()

    @property
    def of_interval(self) -> tuple[Symbol, ...]:
        """The controls that an interval has, stage by stage."""
        return tuple(u for stage in self.stage_controls for u in stage) if self.stage_controls else self.left_controls

    @property
    def controlled(self) -> str:
        """Where controls live: interval, nodal or stages."""
        return "stages" if self.stage_controls else "nodal" if self.nodal else "interval"

    def controls_at(self, point: int, c: Expr) -> list[Expr]:
        """The controls at a point of the scheme, c being its abscissa in the step.

        They are the point's own, or the interval's, or on the line between those of both nodes.
        """
        if self.stage_controls:
            return list(self.stage_controls[point])
        return [between(a, b, c) for a, b in zip(self.left_controls, self.right_controls, strict=True)]

    @property
    def nodal(self) -> bool:
        """Whether controls live on nodes."""
        return self.left_controls != self.right_controls


@dataclass(frozen=True)
class PathValue:
    """A path condition, or the bound of a state, at one point of an interval, whose abscissa `c` lies in [0, 1]."""

    condition: Condition
    abscissa: Expr
    value: Expr
    is_bound: bool = False


@dataclass(frozen=True)
class StateValue:
    """The value of a coordinate or rate inside an interval: an unknown of the interval, or where a field is evaluated.

    The abscissa lies strictly between 0 and 1. At the ends of an interval the nodes have the values.
    """

    quantity: Symbol
    abscissa: Expr
    value: Expr


def repeated(scheme: Scheme) -> tuple[tuple[Symbol, ...], Scheme]:
    """What a step repeats, and the symbols for lengths in it: a composition's base, or the scheme with h alone."""
    count = len(scheme.parts[0]) if scheme.parts else 1
    lengths = (STEP,) if count == 1 else LENGTHS[:count]
    return lengths, scheme.part(lengths, STEP)


def at_nodes(symbols: Iterable[Symbol], suffix: str) -> tuple[Symbol, ...]:
    """The symbols that hold the values of quantities at a node (`r` -> `r_k`)."""
    return tuple(Symbol(f"{symbol.name}{suffix}", real=True) for symbol in symbols)


def sites(model: Model, quantities: Sequence[Symbol], controls: str, points: int) -> Sites:
    """Symbols for quantities at both nodes and for the controls of an interval on which a scheme has some points."""
    left_u = at_nodes(model.controls, "_k")
    right_u = at_nodes(model.controls, "_k1") if controls == "nodal" else left_u
    stages = tuple(at_stage(model.controls, i) for i in range(1, points + 1)) if controls == "stages" else ()
    return Sites(at_nodes(quantities, "_k"), at_nodes(quantities, "_k1"), left_u, right_u, stages)


def at_stage(controls: Iterable[Symbol], number: int) -> tuple[Symbol, ...]:
    """The symbols of controls at a point of an interval, counted from one (`u` -> `u_stage1_k`)."""
    return at_nodes(at_nodes(controls, f"_stage{number}"), "_k")


def distinct(values: Sequence[PathValue]) -> tuple[PathValue, ...]:
    """Each condition once, where it has the same value at several points, as a bound on an interval's control has."""
    first: dict[tuple[str, Expr], PathValue] = {}
    for value in values:
        first.setdefault((value.condition.name, value.value), value)
    return tuple(first.values())


def strictly_inside(values: Iterable[StateValue]) -> tuple[StateValue, ...]:
    """Each value once, without those at the ends of an interval or outside it, where some compositions lead."""
    return tuple(dict.fromkeys(v for v in values if v.abscissa.is_positive and (1 - v.abscissa).is_positive))


def substitute(
    model: Model, function: Expr, position: Sequence[Expr], rate: Sequence[Expr], controls: Sequence[Expr], c: Expr
) -> Expr:
    """The value of a function of (q, rates, u, t) at a point of the interval, c being its abscissa in [0, 1]."""
    values = dict(zip(model.coordinates, position, strict=True))
    values |= dict(zip(model.rates, rate, strict=True))
    values |= dict(zip(model.controls, controls, strict=True))
    values[model.time] = model.time + sympy.expand(c * STEP)
    return sympy.sympify(function).xreplace(values)
