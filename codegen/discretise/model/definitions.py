"""The canonical form of a problem, as frozen dataclasses of plain sympy symbols and expressions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import sympy

from codegen.discretise.model.relations import short, text
from codegen.drawing import Item
from codegen.symbolic.tables import MeasurementData


@dataclass(frozen=True)
class Boundary:
    """Values of the coordinates and of their rates at one end of the time interval; None where an end is free."""

    positions: tuple[sympy.Expr | None, ...]
    rates: tuple[sympy.Expr | None, ...]


@dataclass(frozen=True)
class Condition:
    """An expression that must vanish, or (`equality` false) must not be positive.

    `name` is the author's name of the condition, or else the condition as it was written, which messages shorten.
    `segment` is the number, from 1, of the segment of a motion with delays, or else 0.
    """

    name: str
    expression: sympy.Expr
    equality: bool = True
    segment: int = field(default=0, kw_only=True)

    def __str__(self) -> str:
        return short(self.name)


@dataclass(frozen=True)
class Integral(Condition):
    """The integral of `expression` over the duration equals `value`, or (`equality` false) does not exceed it."""

    value: sympy.Expr = sympy.S.Zero


@dataclass(frozen=True)
class InnerTime:
    """A time between start and end at which conditions hold: given, or (None) free within a window."""

    time: sympy.Expr | None
    earliest: sympy.Expr | None = None
    latest: sympy.Expr | None = None


@dataclass(frozen=True)
class InnerCondition(Condition):
    """A condition that holds at one of the inner times of a model, whose index is `number`."""

    number: int = 0


@dataclass(frozen=True)
class Observed:
    """The quantity of a column of measurements, `name`: the value of `expression` at the time of the sample."""

    name: str
    expression: sympy.Expr


@dataclass(frozen=True)
class Bounds:
    """Bounds of a coordinate, momentum, state or control at every time; None where a side has no bound."""

    symbol: sympy.Symbol
    lower: sympy.Expr | None
    upper: sympy.Expr | None

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """Return the bounds as inequalities."""
        signed = [(-1, ">=", self.lower), (1, "<=", self.upper)]
        return tuple(
            Condition(f"{self.symbol} {relation} {text(limit)}", sign * (self.symbol - limit), equality=False)
            for sign, relation, limit in signed
            if limit is not None
        )


@dataclass(frozen=True)
class FreeParameter:
    """A static parameter that is optimised along with the motion: first guess and bounds."""

    symbol: sympy.Symbol
    guess: sympy.Expr
    lower: sympy.Expr | None
    upper: sympy.Expr | None


@dataclass(frozen=True)
class EndValue:
    """The symbol of one body's coordinate at the end of the time interval, in coupling conditions."""

    symbol: sympy.Symbol
    coordinate: int
    body: int


@dataclass(frozen=True)
class Delay:
    """A delayed value: `symbol` stands for `quantity` at the time t - `lag`.

    `history` is the quantity before t = 0, as a function of the time t.
    """

    symbol: sympy.Symbol
    quantity: sympy.Symbol
    lag: sympy.Expr
    history: sympy.Expr


@dataclass(frozen=True)
class Segments:
    """The division of a motion with delays into `number` segments of equal length, which run side by side.

    `whole` is the problem as its author gave it. Each segment has all of its quantities, in the same order. In the
    order of the delays, a delayed value is the value `steps_back` segments before. `names` has for every quantity of a
    segment its name in the segment, its name in the whole problem and the number of the segment, from 1.
    """

    number: int
    whole: Model
    steps_back: tuple[int, ...]
    names: tuple[tuple[str, str, int], ...]


@dataclass(frozen=True)
class Model:
    """A problem in canonical form; `rates` are velocities of a Lagrangian, momenta of a Hamiltonian.

    `form` is lagrangian, hamiltonian or first-order. In first-order form coordinates are the states, there are no
    rates, `function` is zero and `dynamics` holds the right-hand sides of x' = f(x, u, t); `force` is empty.

    `path` conditions hold at every time and may depend on coordinates, rates, controls, time and parameters. They
    include bounds on velocities. `integrals` are conditions on integrals over the duration. Each of the
    `inner_conditions` holds at one of the `inner_times`, and both are in the order of the times. `start_conditions` and
    `end_conditions` are conditions on coordinates and rates of one end, in addition to the values of `start` and `end`.
    `terminal_cost` is added to the integral of `cost` and depends on coordinates and rates at the end and on
    parameters. Both are negated where the author asked for a maximum (`maximised`). `holonomic` constraints c(q) = 0
    hold at every time. The `loss` of the differences between `observed` expressions and `measurements` is added to the
    cost. The measurements are files of one layout, one file for each body.
    `periodic` gives pairs (coordinate or rate, shift): the value at the end is the value at the start plus the shift.
    `joined` gives pairs of coordinates: the first one at the end equals the second one at the start, and so do their
    rates. Models with `delays` have symbols for delayed values; only the whole problem behind `segments` has them.

    With `bodies` > 1 the system is that many identical bodies without interaction. `body` is the symbol of a body's
    number 0, 1, ... in boundary values, guesses and bounds. `couplings` tie bodies together at the end, in the symbols
    of `end_values` and parameters. The duration may depend on free parameters. `scales` are the author's typical sizes
    of unknowns. `drawing` and `units` serve pictures alone. `units` pairs names with texts: of coordinates, rates,
    momenta, controls, parameters, the time `t`, `cost` and `energy`.

    A problem of P phases has a model for each phase in `phases`. The P - 1 `jumps` give pairs (coordinate or rate,
    value after the switch as an expression of the values before). The model of the problem itself has the start of the
    first phase, the end of the last one, and the sum of all durations. Its controls, parameters and free parameters
    are the ones of all phases, and its time runs through all phases.
    """

    task: str
    name: str
    title: str
    form: str
    coordinates: tuple[sympy.Symbol, ...]
    rates: tuple[sympy.Symbol, ...]
    controls: tuple[sympy.Symbol, ...]
    parameters: tuple[sympy.Symbol, ...]
    defaults: tuple[float, ...]
    time: sympy.Symbol
    function: sympy.Expr
    force: tuple[sympy.Expr, ...]
    cost: sympy.Expr | None
    duration: sympy.Expr
    start: Boundary
    end: Boundary | None
    guess: tuple[tuple[sympy.Symbol, sympy.Expr], ...]
    steps: int
    dynamics: tuple[sympy.Expr, ...] = ()
    bounds: tuple[Bounds, ...] = ()
    path: tuple[Condition, ...] = ()
    integrals: tuple[Integral, ...] = ()
    inner_times: tuple[InnerTime, ...] = ()
    inner_conditions: tuple[InnerCondition, ...] = ()
    start_conditions: tuple[Condition, ...] = ()
    end_conditions: tuple[Condition, ...] = ()
    terminal_cost: sympy.Expr = sympy.S.Zero
    maximised: bool = False
    holonomic: tuple[sympy.Expr, ...] = ()
    periodic: tuple[tuple[sympy.Symbol, sympy.Expr], ...] = ()
    joined: tuple[tuple[sympy.Symbol, sympy.Symbol], ...] = ()
    delays: tuple[Delay, ...] = ()
    segments: Segments | None = None
    free_parameters: tuple[FreeParameter, ...] = ()
    bodies: int = 1
    body: sympy.Symbol | None = None
    end_values: tuple[EndValue, ...] = ()
    couplings: tuple[Condition, ...] = ()
    drawing: tuple[Item, ...] = ()
    phases: tuple[Model, ...] = ()
    jumps: tuple[tuple[tuple[sympy.Symbol, sympy.Expr], ...], ...] = ()
    scales: tuple[tuple[sympy.Symbol, float], ...] = ()
    observed: tuple[Observed, ...] = ()
    measurements: tuple[MeasurementData, ...] = ()
    loss: str = "squares"
    unused: tuple[str, ...] = ()
    units: tuple[tuple[str, str], ...] = ()

    @property
    def with_free_ends(self) -> Model:
        """Return the model with free ends, since a Legendre transform may fail for fixed rates."""
        free = Boundary((None,) * len(self.coordinates), (None,) * len(self.rates))
        return replace(self, start=free, end=free if self.end else None)

    @property
    def authored(self) -> Model:
        """Return the problem as its author gave it, with delays."""
        return self.segments.whole if self.segments else self

    @property
    def default_values(self) -> dict[sympy.Symbol, float]:
        """Return the parameters with their default values."""
        return dict(zip(self.parameters, self.defaults, strict=True))


def prescribed(model: Model, end: str) -> dict[sympy.Symbol, sympy.Expr]:
    """Return the values of coordinates and rates that `start` or `end` fixes."""
    boundary = model.start if end == "start" else model.end
    if boundary is None:
        return {}
    pairs = zip([*model.coordinates, *model.rates], [*boundary.positions, *boundary.rates], strict=True)
    return {symbol: value for symbol, value in pairs if value is not None}


def expressions_of(model: Model) -> Iterator[sympy.Expr]:
    """Yield cost, Lagrangian or Hamiltonian, forces, dynamics, and the expressions of path and integral conditions."""
    yield from (e for e in (model.cost, model.function, *model.force, *model.dynamics) if e is not None)
    yield from (condition.expression for condition in model.path)
    yield from (integral.expression for integral in model.integrals)
