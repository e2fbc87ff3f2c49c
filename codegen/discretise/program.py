"""Programs: the results of transcription, and the names of unknowns.

An optimisation becomes a scalar on one interval, with the layout of its unknowns. A simulation becomes one step, solved
explicitly as far as possible.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

from sympy import Expr, S, Symbol

from codegen.discretise.interval import STEP, at_nodes
from codegen.discretise.model.definitions import Integral, Model
from codegen.runtime.record import Kind, Meaning, Role
from codegen.symbolic.zeros import identically_zero


@dataclass(frozen=True)
class Unknown:
    """One unknown: its name, its meaning, and its bounds (of parameters)."""

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
    """A number that a boundary condition prescribes: the end, the quantity, its symbol and its value."""

    where: str
    quantity: str
    symbol: Symbol
    value: Expr


@dataclass(frozen=True)
class Equation:
    """An equation or inequality to read: `left` = `value`, or 0 >= `value` with a `slack` for the difference.

    An imposed condition has the author's words in `condition`. Some conditions hold `at_nodes`, not on intervals. The
    value may be a `momentum`.
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
    """Replace the symbols of lengths and times in equations."""
    return tuple(replace(equation, value=equation.value.xreplace(scales)) for equation in equations)


@dataclass(frozen=True)
class EndBound:
    """The bounds of an unknown at one end alone, of parameters, and the condition that implies them."""

    lower: Expr | None
    upper: Expr | None
    condition: str


@dataclass(frozen=True)
class EndElement:
    """The terms of one end of the time interval.

    `pins` fix unknowns of the end node (local index, value); a multiplier whose equation is absent is pinned to zero.
    `element` is the end's own share of the Lagrangian of the optimisation problem, in the symbols of the node (suffix
    `_k` at the start, `_k1` at the end) and of the shared unknowns. `cost` is its share of the discrete cost.
    `shared` fixes unknowns of the end node to shared ones (local index, index of the shared unknown, offset).
    `slacks` are pairs (local index of a slack, of its multiplier); such a slack is not negative. `bounds` hold at this
    end alone (local index, bound). Quantities that are fixed or determined at this end have no bounds there:
    `determined` pairs the name of an unknown of the node, or of a slack of the adjacent interval, with the active
    condition, or "" where no limit is active. `dependent` names values and equations that follow from path equalities
    and other values, and were left out.
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
        """Return the constant of the equation: minus the value, plus the slack of an inequality."""
        return -self.condition.value if self.slack is None else self.slack - self.condition.value


@dataclass(frozen=True)
class InnerTimes:
    """Conditions at inner times, which are nodes: their unknowns, and the numbers that distinguish the nodes.

    `times` are in order. A symbol of `symbols` stands, in an interval's share, for a number of the interval's left
    node. The number is zero except at inner times, where `numbers` has a row for each symbol with a value for each
    time. `unknowns` are indices in a node of multipliers and slacks, and `present` tells for each time which of them
    exist; the others vanish. `multipliers` has every condition's name, the index of its time, and the index of its
    multiplier in a node. `guess` has for unknowns of nodes, by index, pairs of a time's number and the value there, and
    two flags that are True if start and end have a value as well. Quantities that the equations at a time determine
    have no bounds there: `determined` has the number of the time, the name of an unknown of the node or of a slack, and
    the number of intervals between the slack and the node.

    Where times are free, `times` are fractions of the chain, `clock` is the index in a node of its time, and `windows`
    has the numbers of times with their least and greatest values. `scales` replace length and time in an interval's
    share. `lacking` are indices, among the unknowns of an interval, of those that an interval after an inner time does
    not have.
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
        """Return the times, then all numbers of each symbol, in their order among the parameters."""
        return (*self.times, *(value for row in self.numbers for value in row))

    @property
    def parameters(self) -> tuple[Symbol, ...]:
        """Return the symbols of these values."""
        names = ["time", *(symbol.name for symbol in self.symbols)]
        return tuple(Symbol(f"{name}[{i}]", real=True) for name in names for i in range(len(self.times)))


@dataclass(frozen=True)
class IntervalElement:
    """The share of an interval in the Lagrangian of the optimisation problem, and its discrete cost.

    `lacking` are the indices, among the unknowns of an interval (without its nodes), of unknowns that this interval
    does not have: x^2/2 in `element` makes them vanish.
    """

    element: Expr
    cost: Expr
    lacking: tuple[int, ...] = ()


@dataclass(frozen=True)
class SampleElement:
    """The share of one sample in the share of its interval: the losses of all its values.

    `observed` are the values by the motion, `fraction` is the place of the sample in the interval, and `values` are the
    measured values. `weights` are the inverses of their standard deviations, zero for missing values. `guess` pairs
    unknowns of nodes, by index, with the index of the value that measures them.
    """

    element: Expr
    observed: tuple[Expr, ...]
    fraction: Symbol
    values: tuple[Symbol, ...]
    weights: tuple[Symbol, ...]
    guess: tuple[tuple[int, int], ...]

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """Return the symbols of a sample, in their order in a module."""
        return (self.fraction, *self.values, *self.weights)


@dataclass(frozen=True)
class Phase:
    """One phase of several: the shares of its intervals, bounds, guesses, equations to read.

    `switch` is the share of the first interval where it differs from the others, because the phase follows another.
    The symbols t and h run from the phase's number to the next; `duration` is already inside. `node` and `inside`
    (interval, controls, slacks) are the program's unknowns with the bounds of this phase. At the switch before the
    phase, `jumping` are indices in a node of quantities that change, so that bounds of this phase do not hold before.
    `given` are indices of quantities with a prescribed value, which need no bounds, and `broken` names quantities with
    another value after the switch. Guesses are expressions of the time of the whole problem: of a node's primal
    unknowns in their order, and of unknowns of an interval, or of the first one, as pairs (index, value).
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
    equations: tuple[Equation, ...]
    switch_equations: tuple[Equation, ...]
    integrals: tuple[IntegralEquation, ...] = ()

    @property
    def elements(self) -> tuple[IntervalElement, ...]:
        """Return the share of the first interval, where it is special, then that of the others."""
        return (self.regular,) if self.switch is None else (self.switch, self.regular)


@dataclass(frozen=True)
class ControlProgram:
    """An optimal-control problem as sum over intervals of one scalar `element`, plus one scalar at each end.

    Unknowns are ordered node_k, interval_k, control_k, slack_k, node_k1; `controls` and `slacks` live on intervals.
    `controlled` is the place of controls: the interval, its stages (all of the first, then of the next), or the nodes
    (nodal).
    The last `path_multipliers` of `interval` belong to path conditions. A slack belongs to the unknown of
    `interval` at the same index of `slack_multipliers`, and is not negative.

    `shared` unknowns belong to no node: first the `own` ones of each body (its coordinates at the end where bodies are
    coupled, or at both ends of a periodic motion), then the unknowns of the whole problem (static parameters).
    `shared_symbols` has the own ones once for all bodies. All `bodies` have the same elements; `body` is the symbol of
    a body's number, and it may occur in boundary values, bounds and guesses only. `couplings` are written in the
    symbols of `coupling_symbols` (symbol, body, index among `own`) and of the problem's own shared unknowns; the
    redundant ones (number from 1, name) follow from them and are left out. `integrals` are conditions on integrals over
    the duration, of each body, with quadratures last in `equations`; of several phases they stand with the phase.
    `inner` are the conditions at inner times.

    With `scaled_time` the symbols t and h are fractions of the duration, an expression of parameters and shared
    unknowns that is already inside `element`. `only_at_ends` are indices in a node of unknowns that only the first or
    last node has; elsewhere they are zero. Where there are `phases`, intervals of equal number for each follow each
    other in one chain; `element`, `cost`, bounds, guesses and equations are then taken from the first. Where there are
    measurements, every `sample` of them adds to the share of its interval. `equations` are the discrete equations for
    people to read, the guesses are expressions of time, duration and parameters, for the primal unknowns of a node, the
    stages of an interval and the controls.
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
    equations: tuple[Equation, ...]
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
        """Return True if controls belong to nodes."""
        return self.controlled == "nodal"

    def controls_of(self, control: Symbol) -> tuple[Symbol, ...]:
        """Return the symbols of one of the author's controls: of the interval, its stages, or both nodes."""
        if self.nodal_controls:
            return at_nodes([control], "_k") + at_nodes([control], "_k1")
        return self.control_symbols[self.model.controls.index(control) :: len(self.model.controls)]

    @property
    def holonomic_multipliers(self) -> tuple[Unknown, ...]:
        """Return the unknowns of a node that are multipliers of holonomic constraints, behind those of the motion."""
        first = 2 * len(self.model.coordinates)
        return self.node[first : first + len(self.model.holonomic)]

    def in_time(self, expression: Expr) -> Expr:
        """Write an expression in t and h as times, instead of fractions of the duration or a node's time and pace."""
        if not self.scaled_time:
            return expression
        if self.inner.scales:
            (step, length), (time, there) = self.inner.scales
            return expression.xreplace({length / step: S.One, there: time})
        duration, time = self.model.duration, self.model.time
        return expression.xreplace({STEP: STEP / duration, time: time / duration})

    @property
    def element_symbols(self) -> tuple[Symbol, ...]:
        """Return the unknowns of an interval with both its nodes, then the shared ones."""
        inside = (*self.interval_symbols, *self.control_symbols, *self.slack_symbols)
        return (*self.left_symbols, *inside, *self.right_symbols, *self.shared_symbols)

    @property
    def interval_elements(self) -> tuple[IntervalElement, ...]:
        """Return the shares of all kinds of intervals; a phase may have a special first interval."""
        if not self.phases:
            return (IntervalElement(self.element, self.cost),)
        return tuple(element for phase in self.phases for element in phase.elements)

    @property
    def has_inequalities(self) -> bool:
        """Return True if an unknown has bounds or is a slack."""
        unknowns = (*self.node, *self.interval, *self.controls, *self.shared)
        unknowns += tuple(unknown for phase in self.phases for unknown in (*phase.node, *phase.inside))
        bounded = any(u.lower is not None or u.upper is not None for u in unknowns)
        at_ends = any(end.slacks or end.bounds for end in (self.start, self.end))
        return bounded or at_ends or bool(self.slacks)


@dataclass(frozen=True)
class StepProgram:
    """An initial value problem: one step from the left node (q_k, p_k) to the right node (q_k1, p_k1).

    `equations` are the scheme's equations in textbook form, expressions that must vanish, in the symbols of the left
    node, of inner stages and of the right node. `summary` derives them in formulas. The solution has three parts:
    `before` are explicit assignments in order, `unknowns` with `residual` remain for Newton's method (none for an
    explicit scheme; `linear` if one linear solve suffices), and `after` are the final explicit assignments. Where a
    mass matrix is large, `guess` and `energy` may read `state_assignments`, which depend on the left node alone.
    `velocities` are unknowns in place of positions, each with the two positions of its divided difference and the time
    between them. `guess` starts Newton's method. `energy` is the Hamiltonian at the left node. `start` holds the
    initial (q, p) in terms of the parameters and of the symbols of `start_values`.

    For a composition this is one step of its base, whose lengths are the symbols `lengths`. `fractions` has a row for
    each step of the base with these lengths as fractions of the whole step. Otherwise the only length is h, and there
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
    """Attributes of optimisations, which have no content in simulations."""

    def in_time(self, expression: Expr) -> Expr:
        """Return an expression of t and h unchanged."""
        return expression

    def controls_of(self, control: Symbol) -> tuple[Symbol, ...]:
        """Return no symbols: a simulation has no controls."""
        return ()


class Names:
    """A source of names `<stem>_1`, `<stem>_2`, ... and `<stem>_<quantity>` that no symbol of the model has."""

    def __init__(self, model: Model) -> None:
        """Reserve every name that the author declared, and those derived from them."""
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
        """Exclude names from those that are returned."""
        self._taken |= set(names)


def symbols(names: Iterable[str], suffix: str) -> tuple[Symbol, ...]:
    """Return the symbols of named unknowns at a node (`_k`, `_k1`) or on the interval (`_k`)."""
    return at_nodes([Symbol(name) for name in names], suffix)


def occurring(quantities: Sequence[Symbol], *expressions: Expr) -> set[int]:
    """Return the indices of those quantities that occur in any of the expressions."""
    present = set[Symbol]().union(*(expression.free_symbols for expression in expressions), set())
    return {i for i, quantity in enumerate(quantities) if quantity in present}


def is_invariant_under_shifts(expression: Expr, shifts: dict[Symbol, Expr]) -> bool:
    """Return True if an expression keeps its value when quantities are shifted, as an angle by 2 pi."""
    shifted = expression.subs({q: q + shift for q, shift in shifts.items() if shift != 0}, simultaneous=True)
    return bool(shifted == expression) or identically_zero(shifted - expression)
