"""The canonical form of a problem, as frozen dataclasses of plain sympy symbols and expressions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import sympy

from codegen.discretise.model.relations import short, text
from codegen.drawing import Item
from codegen.runtime.record import EventAction
from codegen.symbolic.tables import MeasurementData


@dataclass(frozen=True)
class Boundary:
    """The prescribed values of coordinates and rates at one end of the time interval; None for a free value."""

    positions: tuple[sympy.Expr | None, ...]
    rates: tuple[sympy.Expr | None, ...]


@dataclass(frozen=True)
class Condition:
    """An expression that must vanish, or (`equality` false) must not be positive.

    `name` is the author's name of the condition, or else the condition as it was written; messages shorten it.
    `segment` is the number, from 1, of the segment of a motion with delays, or 0 without delays.
    """

    name: str
    expression: sympy.Expr
    equality: bool = True
    segment: int = field(default=0, kw_only=True)

    def __str__(self) -> str:
        return short(self.name)


@dataclass(frozen=True)
class Integral(Condition):
    """An integral constraint: the integral of `expression` equals `value`, or (`equality` false) does not exceed it."""

    value: sympy.Expr = sympy.S.Zero


@dataclass(frozen=True)
class InnerTime:
    """A time between start and end at which conditions hold; `time` is None if it is free within the window."""

    time: sympy.Expr | None
    earliest: sympy.Expr | None = None
    latest: sympy.Expr | None = None


@dataclass(frozen=True)
class InnerCondition(Condition):
    """A condition that holds at the inner time of the model with the index `number`."""

    number: int = 0


@dataclass(frozen=True)
class Observed:
    """The quantity that the column `name` of measurements contains: `expression` at the time of each sample."""

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
        """The bounds as inequalities."""
        signed = [(-1, ">=", self.lower), (1, "<=", self.upper)]
        return tuple(
            Condition(f"{self.symbol} {relation} {text(limit)}", sign * (self.symbol - limit), equality=False)
            for sign, relation, limit in signed
            if limit is not None
        )


@dataclass(frozen=True)
class FreeParameter:
    """A static parameter that is optimised together with the motion, with its initial guess and bounds."""

    symbol: sympy.Symbol
    guess: sympy.Expr
    lower: sympy.Expr | None
    upper: sympy.Expr | None


@dataclass(frozen=True)
class EndValue:
    """The symbol, in couplings, of the value at the end of a coordinate (given by its index) of one body."""

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
class MotionEvent:
    """An event of a simulation: an expression in coordinates, rates and time whose zeros have the effect `action`.

    `direction` is 1 or -1 if the expression must increase or decrease, and else 0. `changes` are pairs (coordinate or
    rate, value after the event as an expression in the values before).
    """

    name: str
    expression: sympy.Expr
    action: EventAction
    direction: int
    changes: tuple[tuple[sympy.Symbol, sympy.Expr], ...]


@dataclass(frozen=True)
class Gap:
    """An expression in coordinates and time that does not become negative, with its coefficient of restitution."""

    name: str
    expression: sympy.Expr
    restitution: sympy.Expr


@dataclass(frozen=True)
class Contact:
    """A gap `expression` >= 0 of a control problem, whose contact forces are unknowns; `name` is the author's.

    `slips` are sliding velocities along the surface, affine in the velocities, and `friction` is the coefficient of
    friction. The symbols are controls: the `normal` force, which is not negative, and a `tangential` force for each
    sliding velocity.
    """

    name: str
    expression: sympy.Expr
    friction: sympy.Expr
    slips: tuple[sympy.Expr, ...]
    normal: sympy.Symbol
    tangential: tuple[sympy.Symbol, ...]

    @property
    def forces(self) -> tuple[sympy.Symbol, ...]:
        """The normal force and the tangential forces."""
        return (self.normal, *self.tangential)


@dataclass(frozen=True)
class Segments:
    """The division of a motion with delays into `number` segments of equal length, integrated simultaneously.

    `whole` is the problem as its author gave it. Each segment has copies of all quantities, in the same order. The
    value of delay i is a value `steps_back[i]` segments before. `names` are triples: name of a quantity in a segment,
    its name in the whole problem, and the number of the segment, from 1.
    """

    number: int
    whole: Model
    steps_back: tuple[int, ...]
    names: tuple[tuple[str, str, int], ...]


@dataclass(frozen=True)
class CanonicalPairs:
    """Coordinates `positions` x, whose `momenta` p = theta_x(x, y, t) replace the other half, the `partners` y.

    `velocities` are x' and `slopes` are p', both in terms of coordinates and time.
    """

    positions: tuple[sympy.Symbol, ...]
    partners: tuple[sympy.Symbol, ...]
    momenta: tuple[sympy.Expr, ...]
    velocities: tuple[sympy.Expr, ...]
    slopes: tuple[sympy.Expr, ...]


@dataclass(frozen=True)
class LinearLagrangian:
    """A Lagrangian theta(q, t).v - H(q, t), which is linear in all velocities.

    `function` is the Lagrangian in the velocities `rates`, `one_form` is theta and `energy` is H. `pairs` is None if
    theta gives no canonical pairs, or if the method uses none.
    """

    function: sympy.Expr
    rates: tuple[sympy.Symbol, ...]
    one_form: tuple[sympy.Expr, ...]
    energy: sympy.Expr
    force: tuple[sympy.Expr, ...]
    pairs: CanonicalPairs | None = None


@dataclass(frozen=True)
class Model:
    """A problem in canonical form; `rates` are velocities of a Lagrangian, momenta of a Hamiltonian.

    `form` is lagrangian, hamiltonian or first-order. In first-order form coordinates are the states, there are no
    rates, `function` is zero and `dynamics` holds the right-hand sides of x' = f(x, u, t); `force` is empty. A
    Lagrangian that is linear in the velocities has this form too, and `linear` keeps it.

    `path` conditions hold at every time and may depend on coordinates, rates, controls, time and parameters. They
    include bounds on velocities. `integrals` are conditions on integrals over the duration. Each of the
    `inner_conditions` holds at one of the `inner_times`, and both are in the order of the times. `start_conditions` and
    `end_conditions` are conditions on coordinates and rates of one end, in addition to the values of `start` and `end`.
    `terminal_cost` is added to the integral of `cost` and depends on coordinates and rates at the end and on
    parameters. Both are negated where the author asked for a maximum (`maximised`). `holonomic` constraints c(q) = 0
    and `rolling` constraints A(q) v + b(q) = 0 hold at every time. `rotations` are quadruples of coordinates, the unit
    quaternions of attitudes; their lengths are constraints too. `attitudes` are the names of all attitudes, also of
    those that are states. A simulation may have `events` and `gaps`, and a control problem `contacts`. Products of
    contact forces and gaps do not exceed the parameter `relaxation`. The `loss`
    of the differences between `observed` expressions and `measurements` is added to the cost. The measurements are
    files with the same layout, one file for each body.
    `periodic` gives pairs (coordinate or rate, shift): the value at the end is the value at the start plus the shift.
    `joined` gives pairs of coordinates: the first one at the end equals the second one at the start, and so do their
    rates. Models with `delays` have symbols for delayed values. After the division into segments only the problem
    `segments.whole` has delays.

    With `bodies` > 1 the system is that number of identical bodies without interaction. `body` is the symbol of the
    number 0, 1, ... of a body in boundary values, guesses and bounds. `couplings` are equations between `end_values` of
    several bodies and parameters. The duration may depend on free parameters. `scales` are the author's scaling factors
    of unknowns. `drawing` and `units` affect pictures alone. `units` are pairs (name, text) for coordinates, rates,
    momenta, controls, parameters, the time `t`, `cost` and `energy`.

    A problem of P phases has a model for each phase in `phases`. Each of the P - 1 `jumps` has pairs (coordinate or
    rate, value after the switch as an expression in the values before). The model of the problem has the start of the
    first phase, the end of the last phase, and the sum of all durations. It has the controls, parameters and free
    parameters of all phases, and its time runs through all phases.
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
    rotations: tuple[tuple[sympy.Symbol, ...], ...] = ()
    attitudes: tuple[str, ...] = ()
    events: tuple[MotionEvent, ...] = ()
    gaps: tuple[Gap, ...] = ()
    contacts: tuple[Contact, ...] = ()
    relaxation: sympy.Symbol | None = None
    rolling: tuple[sympy.Expr, ...] = ()
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
    linear: LinearLagrangian | None = None

    @property
    def with_free_ends(self) -> Model:
        """The model without prescribed values at its ends, since a Legendre transform may fail for fixed rates."""
        free = Boundary((None,) * len(self.coordinates), (None,) * len(self.rates))
        return replace(self, start=free, end=free if self.end else None)

    @property
    def authored(self) -> Model:
        """The problem as its author gave it, with delays."""
        return self.segments.whole if self.segments else self

    @property
    def default_values(self) -> dict[sympy.Symbol, float]:
        """The default values of the parameters."""
        return dict(zip(self.parameters, self.defaults, strict=True))


def prescribed(model: Model, end: str) -> dict[sympy.Symbol, sympy.Expr]:
    """Return the prescribed values of coordinates and rates at one end, "start" or "end"."""
    boundary = model.start if end == "start" else model.end
    if boundary is None:
        return {}
    pairs = zip([*model.coordinates, *model.rates], [*boundary.positions, *boundary.rates], strict=True)
    return {symbol: value for symbol, value in pairs if value is not None}


def expressions_of(model: Model) -> Iterator[sympy.Expr]:
    """Yield cost, Lagrangian or Hamiltonian, forces, dynamics, path conditions and integrands of a model."""
    yield from (e for e in (model.cost, model.function, *model.force, *model.dynamics) if e is not None)
    yield from (condition.expression for condition in model.path)
    yield from (integral.expression for integral in model.integrals)
