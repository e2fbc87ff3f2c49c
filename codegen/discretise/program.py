"""What transcription of an optimisation produces: a scalar on one interval, and the layout of its unknowns.

What transcription of a simulation produces: one step, solved explicitly as far as possible.

Names of unknowns that the author did not declare, and the symbols of named unknowns at the nodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

from sympy import Expr, S, Symbol

from codegen.discretise.interval import STEP, at_nodes
from codegen.discretise.model.definitions import Integral, Model
from codegen.runtime.record import Kind, Meaning, Role
from codegen.symbolic.zeros import identically_zero


@dataclass(frozen=True)
class Unknown:
    """One unknown: its name, what it is, and its bounds (of parameters)."""

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
    """A number that a boundary condition prescribes: at the start or end, for which quantity, symbol and value."""

    where: str
    quantity: str
    symbol: Symbol
    value: Expr


@dataclass(frozen=True)
class EndBound:
    """The least and greatest value of an unknown at one end alone, of parameters; and the condition that says so."""

    lower: Expr | None
    upper: Expr | None
    condition: str


@dataclass(frozen=True)
class EndElement:
    """What happens at one end of the time interval.

    `pins` fix unknowns of the end node (local index, value); a multiplier whose equation is absent is pinned to zero.
    `element` is the end's own share of the Lagrangian of the optimisation problem, in the symbols of the node (suffix
    `_k` at the start, `_k1` at the end) and of the shared unknowns; `cost` is what the discrete cost gains by it.
    `shared` fixes unknowns of the end node to shared ones (local index, index of the shared unknown, offset).
    `slacks` are pairs (local index of a slack, of its multiplier); such a slack is not negative. `bounds` hold at this
    end alone (local index, what bounds it). What is given or
    determined at this end has no bounds there: `determined` names, in pairs, an unknown of the node or a slack of the
    interval beside it, and the condition on whose limit it lies, "" where it does not. `dependent` names what follows
    from path equalities and other values, and was left out.
    """

    pins: tuple[tuple[int, Expr], ...]
    element: Expr
    conditions: tuple[tuple[str, Expr], ...]
    cost: Expr = S.Zero
    shared: tuple[tuple[int, int, Expr], ...] = ()
    slacks: tuple[tuple[int, int], ...] = ()
    determined: tuple[tuple[str, str], ...] = ()
    dependent: tuple[str, ...] = ()
    bounds: tuple[tuple[int, EndBound], ...] = ()


@dataclass(frozen=True)
class Coupling:
    """A condition between shared unknowns: expression = 0, multiplied by the unknown `multiplier`."""

    multiplier: Unknown
    expression: Expr


@dataclass(frozen=True)
class IntegralEquation:
    """A condition on an integral: the sum of its quadratures over all intervals plus `excess` vanishes.

    `multiplier` and, of an inequality, `slack` are shared unknowns.
    """

    condition: Integral
    multiplier: Symbol
    slack: Symbol | None

    @property
    def excess(self) -> Expr:
        """What is added to the sum: minus the value, and the slack."""
        return -self.condition.value if self.slack is None else self.slack - self.condition.value


@dataclass(frozen=True)
class InnerTimes:
    """Conditions at inner times, which are nodes: how they are told from each other, and what they mean.

    `times` are in order. A symbol of `symbols` stands, in an interval's share, for a number of the interval's left
    node: zero unless that is at an inner time, and there what `numbers` has, a row for each symbol with a value for
    each time. `unknowns` are indices in a node of multipliers and slacks, and `present` says for each time which of
    them it has; elsewhere they vanish. `multipliers` names every condition with the index of its time, and of its
    multiplier in a node. `guess` has for unknowns of nodes, by index, pairs of a time's number and the value there, and
    whether start and end give one as well. What the equations at a time decide there has no bounds: `determined` has
    the number of the time, the name of an unknown of the node or of a slack, and how many intervals before the node
    that slack belongs to.

    Where times are free, `times` are parts of the chain, `clock` is the index in a node of its time, and `windows` has
    the numbers of times with the least and greatest of each. `scales` replace length and time in an interval's share;
    `lacking` are indices, among the unknowns of an interval, of those that one after an inner time does not have.
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
        """The times, then all numbers of each symbol, as they stand among the parameters."""
        return (*self.times, *(value for row in self.numbers for value in row))

    @property
    def parameters(self) -> tuple[Symbol, ...]:
        """The symbols of these values."""
        names = ["time", *(symbol.name for symbol in self.symbols)]
        return tuple(Symbol(f"{name}[{i}]", real=True) for name in names for i in range(len(self.times)))


@dataclass(frozen=True)
class IntervalElement:
    """The share of an interval in the Lagrangian of the optimisation problem, and its discrete cost.

    `lacking` are the indices, among the unknowns of an interval (without its nodes), of those that this one does not
    have: x^2/2 in `element` makes them vanish.
    """

    element: Expr
    cost: Expr
    lacking: tuple[int, ...] = ()


@dataclass(frozen=True)
class SampleElement:
    """What one sample adds to the share of the interval in which it lies: the losses of all its values.

    `observed` is what the motion has there, `fraction` says where in the interval it lies, `values` are what was
    measured, and `weights` the inverses of their standard deviations, zero where nothing was measured. `guess` pairs
    unknowns of nodes, by index, with the index of what measures them.
    """

    element: Expr
    observed: tuple[Expr, ...]
    fraction: Symbol
    values: tuple[Symbol, ...]
    weights: tuple[Symbol, ...]
    guess: tuple[tuple[int, int], ...]

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """What belongs to a sample, in the order in which a module keeps it."""
        return (self.fraction, *self.values, *self.weights)


@dataclass(frozen=True)
class Phase:
    """What belongs to one phase of several: the shares of its intervals, bounds, guesses, equations to read.

    `switch` is the share of the first interval where that differs from the others, because the phase follows another.
    The symbols t and h run from the phase's number to the next; `duration` is already inside. `node` and `inside`
    (interval, controls, slacks) are the program's unknowns with the bounds of this phase. At the switch before the
    phase, `jumping` are indices in a node of what changes, so that bounds of this phase do not hold before, and `given`
    of what has a prescribed value and needs no bounds; `broken` names what has another value after it. Guesses are
    expressions of the time of the whole problem: of a node's primal unknowns in their order, and of unknowns of an
    interval, or of the first one, as pairs (index, value).
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
    inside_guess: tuple[tuple[int, Expr], ...]
    switch_guess: tuple[tuple[int, Expr], ...]
    equations: tuple[tuple[str, Expr], ...]
    switch_equations: tuple[tuple[str, Expr], ...]
    integrals: tuple[IntegralEquation, ...] = ()

    @property
    def elements(self) -> tuple[IntervalElement, ...]:
        """That of the first interval, where it is one of its own, then that of the others."""
        return (self.regular,) if self.switch is None else (self.switch, self.regular)


@dataclass(frozen=True)
class ControlProgram:
    """An optimal-control problem as sum over intervals of one scalar `element`, plus one scalar at each end.

    Unknowns are ordered node_k, interval_k, control_k, slack_k, node_k1; `controls` and `slacks` live on intervals.
    `controlled` says where controls live: on the interval, at its stages (all of the first, then of the next), or at
    nodes (nodal).
    The last `path_multipliers` of `interval` are those of path conditions. A slack belongs to the unknown of
    `interval` at the same index of `slack_multipliers`, and is not negative.

    `shared` unknowns belong to no node: first the `own` ones of each body (its coordinates at the end where bodies
    are coupled, or at both ends of a periodic motion), named in `shared_symbols` once for any body, then those of the
    whole problem (static parameters). All `bodies` have the same elements; `body` is the symbol for a body's number,
    and it may occur in boundary values, bounds and guesses only. `couplings` are written in the symbols of
    `coupling_symbols` (symbol, body, index among `own`) and of the problem's own shared unknowns; the redundant ones
    (number from 1, name) follow from them and are left out. `integrals` are conditions on integrals over the duration,
    of each body, with quadratures last in `equations`; of several phases they stand with the phase. `inner` are the
    conditions at inner times.

    With `scaled_time` the symbols t and h are fractions of the duration, an expression of parameters and shared
    unknowns that is already inside `element`.
    `only_at_ends` are indices in a node of unknowns that only the first or last node has; elsewhere they are zero.
    Where there are `phases`, intervals of equal number for each follow each other in one chain; `element`, `cost`,
    bounds, guesses and equations are then those of the first. Where there are measurements, every `sample` of them adds
    to the share of its interval.
    `equations` are the discrete equations for people to read, the guesses are expressions of time, duration and
    parameters, for the primal unknowns of a node, the stages of an interval and the controls.
    """

    model: Model
    method: str
    scheme: str
    controlled: str
    node: tuple[Unknown, ...]
    interval: tuple[Unknown, ...]
    controls: tuple[Unknown, ...]
    left_symbols: tuple[Symbol, ...]
    interval_symbols: tuple[Symbol, ...]
    control_symbols: tuple[Symbol, ...]
    right_symbols: tuple[Symbol, ...]
    element: Expr
    cost: Expr
    equations: tuple[tuple[str, Expr], ...]
    only_at_ends: tuple[int, ...]
    start: EndElement
    end: EndElement
    boundary_values: tuple[BoundaryValue, ...]
    node_guess: tuple[Expr, ...]
    stage_guess: tuple[Expr, ...]
    control_guess: tuple[Expr, ...]
    slacks: tuple[Unknown, ...] = ()
    slack_symbols: tuple[Symbol, ...] = ()
    slack_multipliers: tuple[int, ...] = ()
    path_multipliers: int = 0
    shared: tuple[Unknown, ...] = ()
    shared_symbols: tuple[Symbol, ...] = ()
    shared_guess: tuple[Expr, ...] = ()
    own: int = 0
    bodies: int = 1
    body: Symbol | None = None
    couplings: tuple[Coupling, ...] = ()
    redundant_couplings: tuple[tuple[int, str], ...] = ()
    coupling_symbols: tuple[tuple[Symbol, int, int], ...] = ()
    integrals: tuple[IntegralEquation, ...] = ()
    inner: InnerTimes = InnerTimes()
    scaled_time: bool = False
    phases: tuple[Phase, ...] = ()
    sample: SampleElement | None = None

    @property
    def nodal_controls(self) -> bool:
        """Whether controls live on nodes."""
        return self.controlled == "nodal"

    def controls_of(self, control: Symbol) -> tuple[Symbol, ...]:
        """The symbols that stand for one of the author's controls: of the interval, its stages, or both nodes."""
        if self.nodal_controls:
            return at_nodes([control], "_k") + at_nodes([control], "_k1")
        return self.control_symbols[self.model.controls.index(control) :: len(self.model.controls)]

    @property
    def holonomic_multipliers(self) -> tuple[Unknown, ...]:
        """The unknowns of a node that are multipliers of holonomic constraints: they follow those of the motion."""
        first = 2 * len(self.model.coordinates)
        return self.node[first : first + len(self.model.holonomic)]

    def in_time(self, expression: Expr) -> Expr:
        """Undo that t and h are fractions of the duration, or tell of a node's own time and pace."""
        if not self.scaled_time:
            return expression
        if self.inner.scales:
            (step, length), (time, there) = self.inner.scales
            return expression.xreplace({length / step: S.One, there: time})
        duration, time = self.model.duration, self.model.time
        return expression.xreplace({STEP: STEP / duration, time: time / duration})

    @property
    def element_symbols(self) -> tuple[Symbol, ...]:
        """The unknowns of an interval with both its nodes, then the shared ones."""
        inside = (*self.interval_symbols, *self.control_symbols, *self.slack_symbols)
        return (*self.left_symbols, *inside, *self.right_symbols, *self.shared_symbols)

    @property
    def interval_elements(self) -> tuple[IntervalElement, ...]:
        """The shares of all kinds of intervals: of a phase that of the first one, if it is special, and of others."""
        if not self.phases:
            return (IntervalElement(self.element, self.cost),)
        return tuple(element for phase in self.phases for element in phase.elements)

    @property
    def has_inequalities(self) -> bool:
        """Whether an unknown has bounds or is a slack."""
        unknowns = (*self.node, *self.interval, *self.controls, *self.shared)
        unknowns += tuple(unknown for phase in self.phases for unknown in (*phase.node, *phase.inside))
        bounded = any(u.lower is not None or u.upper is not None for u in unknowns)
        at_ends = any(end.slacks or end.bounds for end in (self.start, self.end))
        return bounded or at_ends or bool(self.slacks)


@dataclass(frozen=True)
class StepProgram:
    """An initial value problem: one step from the left node (q_k, p_k) to the right node (q_k1, p_k1).

    `equations` are the scheme's equations as a textbook writes them, expressions that must vanish, in the symbols of
    the left node, of inner stages and of the right node; `summary` says in formulas where they come from. Solving
    them takes three parts: `before` are explicit assignments in order, `unknowns` with `residual` are what is left
    for Newton's method (none for an explicit scheme; `linear` when one linear solve will do), `after` are explicit
    assignments that follow. Where a mass matrix is large, `guess` and `energy` may read `state_assignments`, which
    depend on the left node alone. `velocities` are unknowns in place of positions, each with the two positions of
    which it is the divided difference and the time between them. `guess` starts Newton's method. `energy` is the
    Hamiltonian at the left node; `start` holds the initial (q, p) in terms of the parameters and of the symbols of
    `start_values`.

    Of a composition all this is one step of its base, whose lengths are the symbols `lengths`; `fractions` has a row
    for each step of the base with these lengths in parts of the whole step. Otherwise the only length is h, and there
    are no fractions.
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
    energy: Expr
    start_values: tuple[BoundaryValue, ...]
    start: tuple[Expr, ...]
    lengths: tuple[Symbol, ...]
    fractions: tuple[tuple[Expr, ...], ...] = ()
    state_assignments: tuple[tuple[Symbol, Expr], ...] = ()

    controlled: ClassVar[str] = "interval"
    holonomic_multipliers: ClassVar[tuple[Unknown, ...]] = ()
    """Where controls would live, and of constraints what optimisations alone have."""

    def in_time(self, expression: Expr) -> Expr:
        """An expression of t and h, which are times as they stand."""
        return expression

    def controls_of(self, control: Symbol) -> tuple[Symbol, ...]:
        """Where a control lives: a simulation has none."""
        return ()


class Names:
    """Hands out names `<stem>_1`, `<stem>_2`, ... and `<stem>_<quantity>` that no symbol of the model has."""

    def __init__(self, model: Model) -> None:
        """Take note of every name that the author declared, or that is derived from one."""
        quantities = (*model.coordinates, *model.rates, *model.controls, *model.parameters, model.time)
        others = (*(p.symbol for p in model.free_parameters), *(value.symbol for value in model.end_values))
        self._taken = {symbol.name for symbol in (*quantities, *others)}
        self._taken |= {f"{prefix}_{q.name}" for prefix in ("lambda", "mu", "nu", "p") for q in quantities}

    def numbered(self, stem: str) -> str:
        """The next free name `<stem>_<number>`."""
        number = 1
        while f"{stem}_{number}" in self._taken:
            number += 1
        return self._take(f"{stem}_{number}")

    def named(self, stem: str, quantity: Symbol) -> str:
        """The name `<stem>_<quantity>`, with underscores appended until it is free."""
        name = f"{stem}_{quantity.name}"
        while name in self._taken:
            name += "_"
        return self._take(name)

    def reserve(self, names: Iterable[str]) -> None:
        """Never hand out these names."""
        self._taken |= set(names)

    def _take(self, name: str) -> str:
        self._taken.add(name)
        return name


def symbols(names: Iterable[str], suffix: str) -> tuple[Symbol, ...]:
    """The symbols of named unknowns at a node (`_k`, `_k1`) or on the interval (`_k`)."""
    return at_nodes([Symbol(name) for name in names], suffix)


def occurring(quantities: Sequence[Symbol], *expressions: Expr) -> set[int]:
    """The indices of those quantities that occur in any of the expressions."""
    present = set[Symbol]().union(*(expression.free_symbols for expression in expressions), set())
    return {i for i, quantity in enumerate(quantities) if quantity in present}


def is_invariant_under_shifts(expression: Expr, shifts: dict[Symbol, Expr]) -> bool:
    """Whether an expression keeps its value when quantities are shifted, as an angle by 2 pi."""
    moved = expression.subs({q: q + shift for q, shift in shifts.items() if shift != 0}, simultaneous=True)
    return bool(moved == expression) or identically_zero(moved - expression)
