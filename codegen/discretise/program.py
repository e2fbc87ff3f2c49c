"""Programs: the results of transcription, and the names of unknowns.

An optimisation becomes a scalar on one interval, with the layout of its unknowns. A simulation becomes one step, solved
explicitly as far as possible.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

from sympy import Expr, S, Symbol

from codegen.discretise.events import EventAtNode, GapAtNode
from codegen.discretise.interval import STEP, at_nodes
from codegen.discretise.model.definitions import Integral, Model
from codegen.discretise.model.guesses import MeasuredGuess
from codegen.runtime.record import Kind, Meaning, Role
from codegen.symbolic.zeros import identically_zero


@dataclass(frozen=True)
class Unknown:
    """An unknown: its name, its meaning, and its bounds, which are expressions in parameters."""

    name: str
    meaning: Meaning
    lower: Expr | None = None
    upper: Expr | None = None

    @property
    def kind(self) -> Kind:
        """The kind of the unknown."""
        return self.meaning.kind

    @property
    def multiplier(self) -> bool:
        """True if the unknown multiplies an equation."""
        return self.kind.role is Role.MULTIPLIER


@dataclass(frozen=True)
class BoundaryValue:
    """A prescribed value at an end: "start" or "end", the name of the quantity, its symbol and its value."""

    where: str
    quantity: str
    symbol: Symbol
    value: Expr


@dataclass(frozen=True)
class Equation:
    """An equation or inequality for display: `left` = `value`, or 0 >= `value` with a `slack` for the difference.

    `condition` is the author's name of an imposed condition. The flags say that a condition holds `at_nodes`, not on
    intervals, and that the value is a `momentum`.
    """

    value: Expr
    left: str = "0"
    condition: str = ""
    slack: str = ""
    at_nodes: bool = False
    momentum: bool = False

    def __str__(self) -> str:
        left = f"-{self.slack}" if self.slack else self.left
        return f"{left} ({self.condition})" if self.condition else left


def in_scales(equations: Iterable[Equation], scales: Mapping[Symbol, Expr]) -> tuple[Equation, ...]:
    """Return equations in which the `scales` replace the symbols of lengths and times."""
    return tuple(replace(equation, value=equation.value.xreplace(scales)) for equation in equations)


@dataclass(frozen=True)
class EndBound:
    """The bounds of an unknown at one end alone, in parameters, and the name of the condition that implies them."""

    lower: Expr | None
    upper: Expr | None
    condition: str


@dataclass(frozen=True)
class EndElement:
    """The terms of one end of the time interval.

    `pins` fix unknowns of the end node (index in the node, value); a multiplier without equation is fixed to zero.
    `element` is the contribution of the end to the Lagrangian of the optimisation problem, in the linking variables and
    the symbols of the node (suffix `_k` at the start, `_k1` at the end). `cost` is its contribution to the discrete
    cost. `shared` equates unknowns of the end node to linking variables (index in the node, index among the linking
    variables, offset). `slacks` are pairs (index of a slack, index of its multiplier); such a slack is not negative.
    `bounds` hold at this end alone (index in the node, bound). Quantities that are fixed or determined at this end have
    no bounds there: `determined` pairs the name of an unknown of the node, or of a slack of the adjacent interval, with
    the active condition, or with "" if none is active. `dependent` names values and equations that follow from path
    equalities and other values, and were left out.
    """

    pins: tuple[tuple[int, Expr], ...]
    element: Expr
    conditions: tuple[Equation, ...]
    cost: Expr = S.Zero
    shared: tuple[tuple[int, int, Expr], ...] = ()
    slacks: tuple[tuple[int, int], ...] = ()
    determined: tuple[tuple[str, str], ...] = ()
    dependent: tuple[str, ...] = ()
    bounds: tuple[tuple[int, EndBound], ...] = ()


@dataclass(frozen=True)
class Coupling:
    """An equation `expression` = 0 between linking variables, with its multiplier."""

    multiplier: Unknown
    expression: Expr


@dataclass(frozen=True)
class LinkingVariables:
    """The variables that belong to no node, their initial guess, and the couplings between them.

    First come `own` variables of each body (coupled coordinates at the end, values of periodic motions), then variables
    of the whole problem (static parameters). `symbols` has the variables of a body once for all bodies. `couplings` are
    written in the symbols of `coupling_symbols` (symbol, body, index among `own`) and in variables of the whole
    problem. Couplings that are `redundant` (number from 1, name) follow from them and are left out.
    """

    unknowns: tuple[Unknown, ...] = ()
    symbols: tuple[Symbol, ...] = ()
    guess: tuple[Expr, ...] = ()
    own: int = 0
    couplings: tuple[Coupling, ...] = ()
    redundant: tuple[tuple[int, str], ...] = ()
    coupling_symbols: tuple[tuple[Symbol, int, int], ...] = ()

    @property
    def of_bodies(self) -> tuple[Unknown, ...]:
        """The linking variables that each body has for itself."""
        return self.unknowns[: self.own]

    @property
    def common(self) -> tuple[Unknown, ...]:
        """The linking variables of the whole problem, such as static parameters."""
        return self.unknowns[self.own :]

    @property
    def common_symbols(self) -> tuple[Symbol, ...]:
        """The symbols of the linking variables of the whole problem."""
        return self.symbols[self.own :]


@dataclass(frozen=True)
class HoldingForces:
    """The guess of constraint forces kappa: the least-squares solution of F + G^T kappa = 0 at the guess of the motion.

    These forces hold the guess at rest. `unknowns` are the indices of kappa (m,) in a node, `forces` F (n,) the other
    forces at rest, and `gradients` the rows of G (m, n), in time, duration and parameters.
    """

    unknowns: tuple[int, ...]
    forces: tuple[Expr, ...]
    gradients: tuple[tuple[Expr, ...], ...]

    @property
    def expressions(self) -> tuple[Expr, ...]:
        """All expressions, the forces first."""
        return (*self.forces, *(entry for row in self.gradients for entry in row))


@dataclass(frozen=True)
class InitialGuess:
    """The initial guess of the primal unknowns of a node, of the stages, and of the controls of an interval or a node.

    The guesses are expressions in time, duration and parameters. Those of stages and controls are evaluated at the
    fractions `stage_times` and `control_times` of an interval. `holding` are guesses of constraint forces.
    """

    node: tuple[Expr, ...]
    stages: tuple[Expr, ...]
    controls: tuple[Expr, ...]
    stage_times: tuple[Expr, ...]
    control_times: tuple[Expr, ...]
    holding: tuple[HoldingForces, ...] = ()


@dataclass(frozen=True)
class IntegralEquation:
    """An integral constraint: the sum of the quadratures over all intervals plus `excess` vanishes.

    `multiplier` and, for an inequality, `slack` are linking variables.
    """

    condition: Integral
    multiplier: Symbol
    slack: Symbol | None

    @property
    def excess(self) -> Expr:
        """The term of the equation without quadrature: minus the value, plus the slack of an inequality."""
        return -self.condition.value if self.slack is None else self.slack - self.condition.value


@dataclass(frozen=True)
class InnerTimes:
    """Conditions at inner times, which are nodes: their unknowns, and the numbers that distinguish the nodes.

    `times` are in order. In the expressions of an interval, each of the `symbols` is a number of the left node. The
    number is zero except at inner times: `numbers` has a row for each symbol with a value for each time. `unknowns` are
    the indices in a node of multipliers and slacks. For each time, `present` has a flag for each of these unknowns;
    unknowns that are not present vanish. `multipliers` are triples: name of a condition, index of its time, index of
    its multiplier in a node. `guess` has for an unknown of nodes its index, pairs (index of a time, value), and two
    flags that are True if start and end have a value as well. Quantities that the equations at a time determine have no
    bounds there: `determined` are triples (index of the time, name of an unknown of the node or of a slack, 1 for a
    slack of the interval before the node, else 0).

    Where times are free, `times` are fractions of the whole motion. `clock` is the index in a node of its time, and
    `windows` are triples (index of a time, earliest and latest time). `scales` replace length and time in the
    expressions of an interval. `lacking` are the indices of unknowns that an interval after an inner time lacks.
    """

    times: tuple[Expr, ...] = ()
    symbols: tuple[Symbol, ...] = ()
    numbers: tuple[tuple[Expr, ...], ...] = ()
    unknowns: tuple[int, ...] = ()
    present: tuple[tuple[bool, ...], ...] = ()
    multipliers: tuple[tuple[str, int, int], ...] = ()
    guess: tuple[tuple[int, tuple[tuple[int, Expr], ...], bool, bool], ...] = ()
    determined: tuple[tuple[int, str, int], ...] = ()
    clock: int | None = None
    windows: tuple[tuple[int, Expr | None, Expr | None], ...] = ()
    scales: tuple[tuple[Symbol, Expr], ...] = ()
    lacking: tuple[int, ...] = ()

    @property
    def values(self) -> tuple[Expr, ...]:
        """The times, then all numbers of each symbol, in their order among the parameters."""
        return (*self.times, *(value for row in self.numbers for value in row))

    @property
    def parameters(self) -> tuple[Symbol, ...]:
        """The symbols of the `values`."""
        names = ["time", *(symbol.name for symbol in self.symbols)]
        return tuple(Symbol(f"{name}[{i}]", real=True) for name in names for i in range(len(self.times)))


@dataclass(frozen=True)
class IntervalElement:
    """The contribution of an interval to the Lagrangian of the optimisation problem, and its discrete cost.

    `lacking` are indices of unknowns, counted in the interval without its nodes, that this interval does not need:
    x^2/2 in `element` makes them vanish.
    """

    element: Expr
    cost: Expr
    lacking: tuple[int, ...] = ()


@dataclass(frozen=True)
class SampleElement:
    """The contribution of one sample of measurements to its interval: the losses of all values of the sample.

    `observed` are the values of the motion at the `fraction` of the interval, and `values` are the measured values.
    `weights` are the inverses of their standard deviations, zero for missing values. `guess` has the unknowns of a node
    that are guessed from measurements.
    """

    element: Expr
    observed: tuple[Expr, ...]
    fraction: Symbol
    values: tuple[Symbol, ...]
    weights: tuple[Symbol, ...]
    guess: tuple[MeasuredGuess, ...]

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """The symbols of a sample, in their order in a generated module."""
        return (self.fraction, *self.values, *self.weights)


@dataclass(frozen=True)
class Phase:
    """One phase of several: the contributions of its intervals, its bounds, guesses, and equations for display.

    `switch` is the contribution of the first interval if it differs from `regular`, because of a switch before it. The
    time t runs from the number of the phase to the next number; all expressions already contain the `duration`. `node`
    and `inside` (interval, controls, slacks) are the unknowns of the program with the bounds of this phase. At the
    switch before the phase, `jumping` are indices in a node of quantities that change: bounds of this phase do not hold
    before. `given` are indices of quantities with a prescribed value, which need no bounds, and `broken` names
    quantities with another value after the switch. Guesses are expressions in the time of the whole problem:
    `node_guess` for the primal unknowns of a node, `holding` for constraint forces, the others with the index in
    `inside`; those of stages also with the fraction of the interval at which they are evaluated.
    """

    duration: Expr
    regular: IntervalElement
    switch: IntervalElement | None
    node: tuple[Unknown, ...]
    inside: tuple[Unknown, ...]
    jumping: tuple[int, ...]
    given: tuple[int, ...]
    broken: tuple[str, ...]
    node_guess: tuple[Expr, ...]
    inside_guess: tuple[tuple[int, Expr, Expr], ...]
    switch_guess: tuple[tuple[int, Expr], ...]
    holding: tuple[HoldingForces, ...]
    equations: tuple[Equation, ...]
    switch_equations: tuple[Equation, ...]
    integrals: tuple[IntegralEquation, ...] = ()

    @property
    def elements(self) -> tuple[IntervalElement, ...]:
        """The contribution of the first interval, if it is special, then of the others."""
        return (self.regular,) if self.switch is None else (self.switch, self.regular)


@dataclass(frozen=True)
class ControlProgram:
    """An optimal-control problem: its Lagrangian is the sum of `element` over all intervals, plus one term at each end.

    Unknowns are ordered node_k, interval_k, control_k, slack_k, node_k1; `controls` and `slacks` belong to intervals.
    `controlled` says what controls belong to: "interval", its "stages" (all controls of the first stage, then of the
    next), or nodes ("linear" or "nodal"). The last `path_multipliers` unknowns of `interval` belong to path
    conditions. Slack i is not negative, and its multiplier is the unknown of `interval` with the index
    `slack_multipliers[i]`.

    All bodies have the same elements. The number of a body may occur in boundary values, bounds and guesses only.
    `linking` are the variables that belong to no node. `integrals` are the integral constraints of each body, with
    quadratures last in `equations`; with several phases they belong to the phases. `inner` are the conditions at inner
    times.

    With `scaled_time` the symbols t and h are fractions of the duration, an expression in parameters and linking
    variables that `element` already contains. `only_at_ends` are indices in a node of unknowns that only the first or
    last node has; at other nodes they are zero. With `phases`, the intervals of all phases, the same number for each,
    form one chain; `element`, `cost`, bounds, guesses and equations then belong to the first phase. `sample` is added
    to an interval for every sample of measurements in it. `equations` are the discrete equations for display.
    """

    model: Model
    method: str
    scheme: str
    controlled: str
    node: tuple[Unknown, ...]
    interval: tuple[Unknown, ...]
    controls: tuple[Unknown, ...]
    interval_symbols: tuple[Symbol, ...]
    control_symbols: tuple[Symbol, ...]
    element: Expr
    cost: Expr
    equations: tuple[Equation, ...]
    only_at_ends: tuple[int, ...]
    start: EndElement
    end: EndElement
    boundary_values: tuple[BoundaryValue, ...]
    guess: InitialGuess
    slacks: tuple[Unknown, ...] = ()
    slack_multipliers: tuple[int, ...] = ()
    path_multipliers: int = 0
    linking: LinkingVariables = LinkingVariables()
    integrals: tuple[IntegralEquation, ...] = ()
    inner: InnerTimes = InnerTimes()
    scaled_time: bool = False
    phases: tuple[Phase, ...] = ()
    sample: SampleElement | None = None

    @cached_property
    def left_symbols(self) -> tuple[Symbol, ...]:
        """The symbols of the unknowns of the left node of an interval."""
        return symbols([unknown.name for unknown in self.node], "_k")

    @cached_property
    def right_symbols(self) -> tuple[Symbol, ...]:
        """The symbols of the unknowns of the right node of an interval."""
        return symbols([unknown.name for unknown in self.node], "_k1")

    @cached_property
    def slack_symbols(self) -> tuple[Symbol, ...]:
        """The symbols of the slacks of an interval."""
        return symbols([slack.name for slack in self.slacks], "_k")

    @property
    def nodal_controls(self) -> bool:
        """True if controls belong to nodes."""
        return self.controlled in ("linear", "nodal")

    def controls_of(self, control: Symbol) -> tuple[Symbol, ...]:
        """Return the symbols of an author's control: for the interval, its stages, or both nodes."""
        if self.nodal_controls:
            return at_nodes([control], "_k") + at_nodes([control], "_k1")
        return self.control_symbols[self.model.controls.index(control) :: len(self.model.controls)]

    @property
    def holonomic_multipliers(self) -> tuple[Unknown, ...]:
        """The unknowns of a node that are forces of constraints: of holonomic, then of rolling constraints."""
        return tuple(unknown for unknown in self.node if unknown.kind is Kind.NORMAL_FORCE)

    def in_time(self, expression: Expr) -> Expr:
        """Return an expression with t and h as times, not fractions of the duration, nor time and pace of a node."""
        if not self.scaled_time:
            return expression
        if self.inner.scales:
            (step, length), (time, there) = self.inner.scales
            return expression.xreplace({length / step: S.One, there: time})
        duration, time = self.model.duration, self.model.time
        return expression.xreplace({STEP: STEP / duration, time: time / duration})

    @property
    def element_symbols(self) -> tuple[Symbol, ...]:
        """The unknowns of an interval and its two nodes, then the linking variables."""
        inside = (*self.interval_symbols, *self.control_symbols, *self.slack_symbols)
        return (*self.left_symbols, *inside, *self.right_symbols, *self.linking.symbols)

    @property
    def interval_elements(self) -> tuple[IntervalElement, ...]:
        """The contributions of all kinds of intervals; a phase may have a special first interval."""
        if not self.phases:
            return (IntervalElement(self.element, self.cost),)
        return tuple(element for phase in self.phases for element in phase.elements)

    @property
    def has_inequalities(self) -> bool:
        """True if an unknown has bounds or is a slack."""
        unknowns = (*self.node, *self.interval, *self.controls, *self.linking.unknowns)
        unknowns += tuple(unknown for phase in self.phases for unknown in (*phase.node, *phase.inside))
        bounded = any(u.lower is not None or u.upper is not None for u in unknowns)
        at_ends = any(end.slacks or end.bounds for end in (self.start, self.end))
        return bounded or at_ends or bool(self.slacks)


@dataclass(frozen=True)
class ConstraintAtNode:
    """A constraint at the left node of a step: its name, value c, rate dc/dt and gradient dc/dq.

    A rolling constraint has the value zero, and A v + b in place of the rate. The terms of the rate are at most of the
    size `scale`.
    """

    name: str
    value: Expr
    rate: Expr
    scale: Expr
    gradient: tuple[Expr, ...]

    @property
    def row(self) -> tuple[Expr, ...]:
        """Value, rate, scale of the rate, and gradient."""
        return (self.value, self.rate, self.scale, *self.gradient)


@dataclass(frozen=True)
class StepProgram:
    """An initial value problem: one step from the left node (q_k, p_k), or x_k, to the right node.

    `equations` are the scheme's equations in textbook form, expressions that must vanish, in the symbols of the left
    node, inner stages and the right node. `summary` has the formulas behind them. The solution has three parts:
    explicit assignments `before`, `unknowns` with a `residual` for Newton's method, and explicit assignments `after`.
    An explicit scheme leaves no unknowns; `linear` is True if one linear solve suffices. For a large mass matrix,
    `guess` and `energy` may contain symbols of `state_assignments`, which depend on the left node alone. `velocities`
    replace positions as unknowns: each has the two positions of its divided difference and the time between them.
    `guess` is the initial guess of Newton's method. `energy` is the Hamiltonian at the left node, or None for
    first-order dynamics. `start` is the initial state in terms of the parameters and the symbols of `start_values`.

    With constraints, the forces along their normals at both nodes are values inside the step, and
    `holonomic_multipliers` are their names without the suffix of a node. `constraints` are read from the left node.
    So are `events` and `gaps`, which may also contain symbols of `event_assignments`.

    For a composition this is one step of its base scheme with the `lengths` as symbols. `fractions` has a row for each
    step of the base: its lengths as fractions of the whole step. Otherwise the only length is h, without fractions.
    """

    model: Model
    method: str
    scheme: str
    order: int
    state: tuple[Unknown, ...]
    left_symbols: tuple[Symbol, ...]
    velocities: tuple[tuple[Symbol, Symbol, Symbol, Expr], ...]
    stage_symbols: tuple[Symbol, ...]
    right_symbols: tuple[Symbol, ...]
    before: tuple[tuple[Symbol, Expr], ...]
    unknowns: tuple[Symbol, ...]
    guess: tuple[Expr, ...]
    residual: tuple[Expr, ...]
    after: tuple[tuple[Symbol, Expr], ...]
    linear: bool
    equations: tuple[tuple[str, Expr], ...]
    summary: tuple[tuple[str, Expr], ...]
    energy: Expr | None
    start_values: tuple[BoundaryValue, ...]
    start: tuple[Expr, ...]
    lengths: tuple[Symbol, ...]
    fractions: tuple[tuple[Expr, ...], ...] = ()
    state_assignments: tuple[tuple[Symbol, Expr], ...] = ()
    holonomic_multipliers: tuple[Unknown, ...] = ()
    constraints: tuple[ConstraintAtNode, ...] = ()
    events: tuple[EventAtNode, ...] = ()
    gaps: tuple[GapAtNode, ...] = ()
    event_assignments: tuple[tuple[Symbol, Expr], ...] = ()

    controlled: ClassVar[str] = "interval"
    """An attribute of control programs, which is constant in simulations."""

    def in_time(self, expression: Expr) -> Expr:
        """Return an expression of t and h unchanged."""
        return expression

    def controls_of(self, control: Symbol) -> tuple[Symbol, ...]:
        """Return no symbols: a simulation has no controls."""
        return ()


class Names:
    """A source of names `<stem>_1`, `<stem>_2`, ... and `<stem>_<quantity>` that no symbol of the model has."""

    def __init__(self, model: Model) -> None:
        """Reserve all names that the author declared, and names derived from them."""
        quantities = (*model.coordinates, *model.rates, *model.controls, *model.parameters, model.time)
        others = (*(p.symbol for p in model.free_parameters), *(value.symbol for value in model.end_values))
        self._taken = {symbol.name for symbol in (*quantities, *others)}
        self._taken |= {f"{prefix}_{q.name}" for prefix in ("lambda", "mu", "nu", "p") for q in quantities}

    def numbered(self, stem: str) -> str:
        """Return the next free name `<stem>_<number>`."""
        number = 1
        while f"{stem}_{number}" in self._taken:
            number += 1
        self._taken.add(f"{stem}_{number}")
        return f"{stem}_{number}"

    def named(self, stem: str, quantity: Symbol) -> str:
        """Return the name `<stem>_<quantity>`, with underscores appended until it is free."""
        name = f"{stem}_{quantity.name}"
        while name in self._taken:
            name += "_"
        self._taken.add(name)
        return name

    def reserve(self, names: Iterable[str]) -> None:
        """Exclude names from later results."""
        self._taken |= set(names)


def symbols(names: Iterable[str], suffix: str) -> tuple[Symbol, ...]:
    """Return the symbols `<name><suffix>` of unknowns at a node (`_k`, `_k1`) or on the interval (`_k`)."""
    return at_nodes([Symbol(name) for name in names], suffix)


def occurring(quantities: Sequence[Symbol], *expressions: Expr) -> set[int]:
    """Return the indices of the quantities that occur in any of the expressions."""
    present = set[Symbol]().union(*(expression.free_symbols for expression in expressions), set())
    return {i for i, quantity in enumerate(quantities) if quantity in present}


def is_invariant_under_shifts(expression: Expr, shifts: dict[Symbol, Expr]) -> bool:
    """Return True if an expression keeps its value when quantities are shifted, such as an angle by 2 pi."""
    shifted = expression.subs({q: q + shift for q, shift in shifts.items() if shift != 0}, simultaneous=True)
    return bool(shifted == expression) or identically_zero(shifted - expression)
