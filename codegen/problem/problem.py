"""The classes for problems: dynamics, forces, a cost, conditions on the motion.

A problem file returns an object of one of these classes. The object has the expressions as the user wrote them.
`codegen.discretise.model` validates them, and converts them to the form that later stages read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, MISSING, dataclass, field, fields
from functools import wraps
from typing import Any, ClassVar, TypeVar

from codegen.drawing import Item
from codegen.errors import ExpressionError, ProblemFileError
from codegen.problem import AuthorObject, perhaps
from codegen.problem.rotations import in_coordinates, jumps_in_coordinates, phases_with_arcs
from codegen.problem.tables import Measurements, Trajectory

FORMS = {"lagrangian": "lagrangian", "hamiltonian": "hamiltonian", "dynamics": "first-order"}
"""The arguments that define the motion, with the name of the form of the model for each argument."""

Expression = Any
"""A sympy expression or a number."""

Values = Mapping[Any, Expression]
"""Expressions by declared symbols."""

SAME_AT_BOTH_ENDS = (
    'declare V = free_parameter("V", guess) for each quantity v that returns, and write Eq(v, V) into the '
    "start_conditions of the first phase and into the end_conditions of the last"
)
"""The remedy for a periodic motion of several phases."""

Relation = Any
"""A sympy relation (Eq, <=, >=), or an expression that must be zero."""

Relations = Sequence[Relation] | Mapping[str, Relation]
"""Relations as a list, or as a mapping from names to relations; messages use the names."""


Author = TypeVar("Author", bound=type[Any])


def refusing(kind: Author) -> Author:
    """Return the class with an `__init__` that raises ProblemFileError for unknown and for missing arguments.

    The remedy in the message suggests a similar argument.
    """
    written = kind.__init__

    @wraps(written)
    def initialised(self: object, *positional: object, **named: object) -> None:
        known = [argument.name for argument in fields(kind)]
        for name in named:
            if name in known:
                continue
            remedy = perhaps(name, known) or f"use one of {', '.join(known)}"
            if kind is Simulate and name in [argument.name for argument in fields(Control)]:
                remedy = "a simulation follows the motion from its start; write a Control(...) for costs and conditions"
                if name in ("friction", "slip"):
                    remedy = "contacts of a simulation have no friction; write it as a force, or a Control(...)"
            if kind is Control and name in ("restitution", "events"):
                remedy = (
                    "contacts of a Control are inelastic; write Phases(..., jumps=[...]) for other impacts and events"
                )
            raise ProblemFileError(f"{kind.__name__}(...) has no argument {name!r}", remedy)
        for each in fields(kind):
            if not positional and each.name not in named and each.default is each.default_factory is MISSING:
                raise ProblemFileError(f"{kind.__name__}(...) lacks {each.name!r}", f"give it, as in {each.name}=...")
        written(self, *positional, **named)

    setattr(kind, "__init__", initialised)  # noqa: B010  a method is not declared to change
    return kind


@dataclass(frozen=True)
class Event:
    """A zero of an expression along the motion of a simulation, with its effect.

    Parameters
    ----------
    expression : expression
        Expression of coordinates and velocities (or momenta, or states), time and parameters, whose zeros count.
    then : "stop", "record" or dict
        A stop ends the motion, and a record lets it continue. A dict has the values after the event, as expressions of
        the values before, as in `{v: -0.8 * v}`. All other values are continuous, for a Lagrangian the velocities.
    direction : int
        1 for zeros at which the expression increases, -1 for zeros at which it decreases, 0 for all zeros.
    """

    expression: Expression
    _: KW_ONLY
    then: str | Values = "stop"
    direction: int = 0


@dataclass(frozen=True)
class Waypoint:
    """Relations that hold at a time which the solver determines.

    Parameters
    ----------
    conditions : list or dict of relations
        Relations that hold at this time.
    window : pair of expressions
        Earliest and latest time; None means no limit.
    """

    conditions: Relations
    _: KW_ONLY
    window: tuple[Expression | None, Expression | None] = (None, None)


@dataclass(frozen=True)
class Problem(AuthorObject):
    """A system and the time interval [0, T] of its motion.

    Parameters
    ----------
    lagrangian, hamiltonian, dynamics : expression, expression, dict
        Exactly one of these arguments defines the motion: the Lagrangian L(q, dq, t), the Hamiltonian H(q, p, t), or
        the time derivative of each state, x' = f(x, u, t).
    force : dict
        Generalised forces by coordinates, the components of the covector f in the Lagrange-d'Alembert principle.
    duration : expression
        Duration T of the motion.
    start : dict
        Values at t = 0 of coordinates and velocities (or momenta, or states).
    steps : int
        Default number N of intervals.
    drawing : sequence of Item
        Drawing of the system for figures and films (see `codegen.drawing`), without effect on the solution.
    """

    task: ClassVar[str] = ""

    _: KW_ONLY
    lagrangian: Expression = None
    hamiltonian: Expression = None
    dynamics: Values | None = None
    force: Values = field(default_factory=dict)
    duration: Expression
    start: Values = field(default_factory=dict)
    steps: int = 100
    drawing: Sequence[Item] = ()

    def __post_init__(self) -> None:
        """Write rotations, poses and unit vectors out in their coordinates, with their holonomic constraints."""
        for name, value in in_coordinates(self).items():
            object.__setattr__(self, name, value)


@refusing
@dataclass(frozen=True)
class Simulate(Problem):
    """Simulate the motion from a complete initial state, step by step.

    For delays, use a Control without controls and cost, whose time steps are solved together.

    Parameters
    ----------
    lagrangian, hamiltonian, dynamics : expression, expression, dict
        Exactly one of these arguments defines the motion: the Lagrangian L(q, dq, t), the Hamiltonian H(q, p, t), or
        the time derivative of each state, x' = f(x, t). A Lagrangian is quadratic in all velocities, or linear in all.
    force : dict
        Generalised forces by coordinates.
    duration : expression
        Duration T of the motion.
    start : dict
        Values at t = 0 of all coordinates and all velocities (or all momenta), or of all states. Without velocities if
        the Lagrangian is linear in the velocities, because coordinates determine them.
    constraint : list of expressions
        Holonomic constraints c(q) = 0 of a Lagrangian system, which the values at the start must satisfy, and their
        time derivatives too. Every stored state satisfies both to rounding. The scheme is midpoint, trapezoidal
        (RATTLE for a constant mass matrix) or rectangle, or a composition of midpoint or trapezoidal.
    rolling : list of expressions
        Constraints a(q, t) dq + b(q, t) = 0 on the velocities of a Lagrangian system, as in
        `[dx*sin(phi) - dy*cos(phi)]` for a blade. Their forces follow the principle of Lagrange and d'Alembert. The
        velocities at the start must satisfy them, and those of every stored state do to rounding. The schemes are
        those of `constraint`.
    events : dict
        Events by name: expressions whose first zero ends the motion, or an Event with another effect. A value of zero
        at the start is no event. The time of an event is found to rounding.
    unilateral : relations
        Gaps that never become negative, as in `{"floor": y >= 0}`, in coordinates and time. An impact reverses the rate
        of the gap by an impulse along its gradient. Simultaneous impacts follow each other in the order of the gaps.
    restitution : expression, or list with one for each gap
        Coefficient of restitution, a number or parameter from 0 (inelastic) to 1 (elastic, the default).
    steps : int
        Default number N of time steps.
    drawing : sequence of Item
        Drawing of the system for figures and films (see `codegen.drawing`), without effect on the solution.
    """

    task: ClassVar[str] = "simulate"

    _: KW_ONLY
    constraint: Sequence[Expression] = ()
    rolling: Sequence[Expression] = ()
    events: Mapping[str, Expression | Event] = field(default_factory=dict)
    unilateral: Relations = ()
    restitution: Expression | Sequence[Expression] = 1


@refusing
@dataclass(frozen=True)
class Control(Problem):
    """Minimise the integral of `cost` over [0, T] plus `terminal_cost` at T.

    Relations are a list, or a dict from names to relations, as in `path={"heating rate": q <= 70}`. Messages use the
    names.

    Parameters
    ----------
    lagrangian, hamiltonian, dynamics : expression, expression, dict
        Exactly one of these arguments defines the motion: the Lagrangian L(q, dq, t), the Hamiltonian H(q, p, t), or
        the time derivative of each state, x' = f(x, u, t).
    force : dict
        Generalised forces by coordinates, which may contain controls.
    duration : expression
        Duration T of the motion; a free parameter makes it free.
    start : dict
        Values at t = 0 of coordinates and velocities (or momenta, or states). Values that `start` and `end` omit are
        free.
    steps, drawing
        Default number N of intervals; drawing of the system, as for `Simulate`.
    cost, terminal_cost : expression
        Integrand of the cost, and cost at T.
    maximise, terminal_maximise : expression
        Quantities to maximise in place of the costs: an integrand and a value at T. The `cost` of a solution is minus
        their sum, and `maximum` in its summary is the sum.
    end : dict
        Values at T, of the same quantities as in `start`.
    start_conditions, end_conditions : relations
        Relations between coordinates and velocities (or momenta, or states) at the start or at the end.
    path : relations
        Relations that hold at every time; they may contain controls.
    integral : relations
        Relations between the integral of one side over [0, T], or over a phase, and a constant, as in
        `[Eq(sqrt(1 + u**2), 4)]`.
    at : dict of relations
        Relations at times between start and end, which become nodes, as in `{0.75: [Eq(x, 0.9)], 2: [y >= 1]}`.
    waypoints : list of relations
        Relations at times that the solver determines, in order, as in `[[Eq(x, 1), Eq(y, 2)], [y >= 3]]`. A Waypoint
        limits the time.
    bounds : dict
        Pairs (lower, upper) for coordinates, velocities, momenta, states, controls and free parameters; None means no
        bound.
    constraint : list of expressions
        Holonomic constraints c(q) = 0 of a Lagrangian system.
    rolling : list of expressions
        Constraints a(q, t) dq + b(q, t) = 0 on the velocities of a Lagrangian system, as for `Simulate`.
    unilateral : relations
        Gaps that never become negative, as in `{"floor": y >= 0}`, in coordinates and time of a Lagrangian system. The
        contact forces are unknown in time and sequence. They are further controls, such as `normal_floor`, without
        influence on the cost. Impacts are inelastic. The scheme is midpoint, trapezoidal or rectangle.
    friction : expression, or list with one for each gap
        Coefficient of Coulomb friction, a number or parameter.
    slip : list
        Velocity of the point of contact along the surface for each gap with friction, as in `[dx - r*dphi]`. In space
        it is a pair of velocities, and the cone of friction is a pyramid.
    periodic : list or dict
        Quantities that have the same value at T and at 0; a dict has the value at T minus the value at 0 for each.
    history : dict
        Values before t = 0 of quantities x with delays, as expressions of t. `x.delayed(tau)` is the value at t - tau
        of a state, coordinate, velocity, momentum or control. A motion starts with the last value of its history,
        unless `start` or `start_conditions` prescribe another value.
    bodies : int
        Number H of identical systems. Values that depend on `body_number()` differ between bodies. End conditions in
        `q.of(0)`, `q.of(1)`, ... couple the bodies.
    observations : Measurements, or a list with one for each body
        Measurements, whose distance from the motion is added to the cost.
    guess : dict or Trajectory
        Initial guesses of coordinates, states and controls: expressions of parameters and time, or tables of time. By
        default coordinates are linear between boundary values or measurements, and controls are zero. The guess of a
        free parameter is an argument of `free_parameter`.
    scale : dict
        Typical magnitudes of coordinates, momenta, states, controls and free parameters, positive numbers that are used
        in place of automatic scaling factors.
    """

    task: ClassVar[str] = "control"

    _: KW_ONLY
    cost: Expression = 0
    terminal_cost: Expression = 0
    end: Values = field(default_factory=dict)
    maximise: Expression = 0
    terminal_maximise: Expression = 0
    start_conditions: Relations = ()
    end_conditions: Relations = ()
    bounds: Mapping[Any, tuple[Expression | None, Expression | None]] = field(default_factory=dict)
    path: Relations = ()
    integral: Relations = ()
    at: Mapping[Expression, Relations] = field(default_factory=dict)
    waypoints: Sequence[Relations | Waypoint] = ()
    constraint: Sequence[Expression] = ()
    rolling: Sequence[Expression] = ()
    unilateral: Relations = ()
    friction: Expression | Sequence[Expression] = 0
    slip: Sequence[Expression | Sequence[Expression]] = ()
    periodic: Values | Sequence[Expression] = ()
    history: Values = field(default_factory=dict)
    bodies: int = 1
    observations: Measurements | Sequence[Measurements] = ()
    guess: Values | Trajectory = field(default_factory=dict)
    scale: Values = field(default_factory=dict)


@dataclass(frozen=True, init=False)
class Phases(AuthorObject):
    """Control problems that follow each other in time, with different dynamics, bounds and costs.

    All phases have the same form (Lagrangian, Hamiltonian or dynamics), the same coordinates or states, and the same
    holonomic and rolling constraints. Each phase has its own duration, and `steps` intervals. Time continues from phase
    to phase. Only the first phase has a `start`. The arguments `end`, `end_conditions` and `terminal_cost` of an
    earlier phase hold at the switch before the jump.

    Parameters
    ----------
    *phases : Control
        The phases in order.
    jumps : list of dicts
        A dict for each switch between two phases. It has expressions for states, or coordinates and velocities (or
        momenta), after the switch in terms of the values before, as in `[{m: m - dry_mass}]` or `[{dq: -e * dq}]`. All
        other values are continuous; for a Lagrangian velocities are continuous, not momenta.
    """

    phases: tuple[Control, ...]
    jumps: Sequence[Values]

    def __init__(self, *phases: Control, jumps: Sequence[Values] = (), **others: object) -> None:
        """Store the phases and the jumps; raise ProblemFileError for arguments that belong to a single phase."""
        for name in others:
            raise ProblemFileError(
                f"Phases(...) has no argument {name!r}",
                SAME_AT_BOTH_ENDS if name == "periodic" else "give phases and jumps; the rest belongs to each Control",
            )
        jumps = jumps_in_coordinates(jumps)
        object.__setattr__(self, "phases", phases_with_arcs(phases, jumps))
        object.__setattr__(self, "jumps", jumps)


def form_of(problem: Problem) -> str:
    """Return the name of the argument that defines the motion, such as "lagrangian".

    Raise ExpressionError unless exactly one of the three arguments is given.
    """
    given = [form for form in FORMS if getattr(problem, form) is not None]
    if len(given) != 1:
        raise ExpressionError(
            "a problem needs exactly one of lagrangian, hamiltonian and dynamics",
            "give one of them" if not given else f"leave out all but one of {', '.join(given)}",
        )
    return given[0]
