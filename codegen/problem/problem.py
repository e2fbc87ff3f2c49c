"""What an author writes: dynamics, forces, a cost, conditions on the motion, and what to do with them.

A problem file returns one of the classes below. They hold the author's expressions as written;
`codegen.discretise.model` checks them and brings them into the one form that the rest of the pipeline reads.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields
from functools import wraps
from typing import Any, ClassVar, TypeVar

from codegen.drawing import Item
from codegen.errors import ExpressionError, ProblemFileError
from codegen.problem import AuthorObject, perhaps
from codegen.problem.tables import Measurements, Trajectory

FORMS = {"lagrangian": "lagrangian", "hamiltonian": "hamiltonian", "dynamics": "first-order"}
"""The arguments that may say how a system moves, and the form that each makes of a model."""

Expression = Any
"""A sympy expression or a number."""

SAME_AT_BOTH_ENDS = (
    'declare V = free_parameter("V", guess) for each quantity v that returns, and write Eq(v, V) into the '
    "start_conditions of the first phase and into the end_conditions of the last"
)
"""How a motion of several phases is made periodic."""

Relation = Any
"""A sympy relation (Eq, <=, >=), or an expression that is to vanish."""

Relations = Sequence[Relation] | Mapping[str, Relation]
"""Relations, each with a name for messages where they are a mapping."""


OF_CONTROLS = {
    "constraint": "write the motion in coordinates that fulfil it, or as Control(...) without controls and cost",
}
"""Remedies for arguments of a Control that a Simulate lacks, where there is more to say than that."""

Author = TypeVar("Author", bound=type[Any])


def refusing(kind: Author) -> Author:
    """Have a class say, as a ProblemFileError, which of its named arguments is unknown, and what may be meant."""
    written = kind.__init__

    @wraps(written)
    def initialised(self: Any, *positional: Any, **given: Any) -> None:
        known = [own.name for own in fields(kind)]
        for name in given:
            if name not in known:
                raise ProblemFileError(f"{kind.__name__}(...) has no argument {name!r}", _remedy(kind, name, known))
        written(self, *positional, **given)

    setattr(kind, "__init__", initialised)  # noqa: B010  a method is not declared to change
    return kind


def _remedy(kind: type[Any], name: str, known: Sequence[str]) -> str:
    if kind is Simulate and name in OF_CONTROLS:
        return OF_CONTROLS[name]
    if kind is Simulate and name in [own.name for own in fields(Control)]:
        return "a simulation follows the motion from its start; what else is asked of it makes it a Control(...)"
    return perhaps(name, known) or f"use one of {', '.join(known)}"


@dataclass(frozen=True)
class Waypoint:
    """Relations that hold at a time which the solver finds, not before the first and not after the second of `window`.

    Either may be None.
    """

    conditions: Relations
    _: KW_ONLY
    window: tuple[Expression | None, Expression | None] = (None, None)


@dataclass(frozen=True)
class Problem(AuthorObject):
    """A system and the time interval [0, T] on which it moves.

    Exactly one of these says how: a Lagrangian L(q, dq, t), a Hamiltonian H(q, p, t), or `dynamics`, which maps each
    state of a first-order system to its derivative, x' = f(x, u, t). `force` maps a coordinate to the generalised
    force on it (the covector component of f in the Lagrange-d'Alembert principle). `duration` is T; `steps` is the
    default number N of intervals. `start` maps coordinates and velocities (or momenta, or states) to their values at
    t = 0. `drawing` lists what a picture of the system shows (see `codegen.drawing`); nothing else depends
    on it.
    """

    task: ClassVar[str] = ""

    _: KW_ONLY
    lagrangian: Expression = None
    hamiltonian: Expression = None
    dynamics: Mapping[Any, Expression] | None = None
    force: Mapping[Any, Expression] = field(default_factory=dict)
    duration: Expression
    start: Mapping[Any, Expression] = field(default_factory=dict)
    steps: int = 100
    drawing: Sequence[Item] = ()


@refusing
@dataclass(frozen=True)
class Simulate(Problem):
    """Follow the motion from a complete initial state (all coordinates, and all velocities or all momenta).

    It takes a Lagrangian or a Hamiltonian. First-order dynamics, holonomic constraints and values of the past are
    followed by a Control without controls and cost, whose steps are solved for together.
    """

    task: ClassVar[str] = "simulate"


@refusing
@dataclass(frozen=True)
class Control(Problem):
    """Move the system such that `terminal_cost` at T plus the integral of `cost` over [0, T] is least.

    Or, with `maximise` and `terminal_maximise` in their place, such that the same sum of those is greatest; the `cost`
    of a solution is then minus that sum, and the summary has it as `maximum`.

    What `start` or `end` leaves out is free, up to `start_conditions` and `end_conditions`: relations between
    coordinates and velocities (or momenta, or states) at that end. `path` relations hold at every time and may have
    controls in them. Relations are a list, or map names, which messages use, to relations, as in
    `path={"heating rate": q <= 70}`. `integral` relations compare the integral of one side over [0, T] (in a problem of
    phases over the phase) with the other side, a value that does not move, as in `integral=[Eq(sqrt(1 + u**2), 4)]`.
    `at` maps times between start and end, which become nodes, to relations between coordinates and velocities (or
    momenta, or states) that hold there, as in `at={0.75: [Eq(x, 0.9)], 2: [y >= 1]}`. `waypoints` lists such relations
    for times that the solver finds, in the order of the list, as in `waypoints=[[Eq(x, 1), Eq(y, 2)], [y >= 3]]`; an
    entry may be a Waypoint, which limits its time.
    `bounds` maps coordinates, velocities, momenta, states, controls and free
    parameters to pairs (lower, upper), None where there is none. A `constraint` c(q) = 0 is holonomic: a Lagrangian
    system moves on the manifold where it vanishes. `periodic` lists what has the same value at T as at 0, or maps it to
    the difference.

    `x.delayed(tau)`, for a state, coordinate, velocity, momentum or control x, is its value at the time t - tau.
    `history` maps x to what it was before t = 0, an expression of t; x starts where its history ends, unless `start` or
    `start_conditions` say otherwise.

    With `bodies=H` there are H of these systems, which start and end each for itself where a value depends on
    `body_number()`, and which end conditions in `q.of(0)`, `q.of(1)`, ... tie together.

    `observations`, a file of measurements or with several bodies one for each, add to the cost how far the motion is
    from them.

    `guess` maps coordinates, states and controls to expressions of parameters and time, or to tables of one input,
    which is time then; or it is a Trajectory, which reads them from a file. From there the solver starts; without it
    coordinates are interpolated linearly between their end values, or between measurements of them, and controls are
    zero. Free parameters have their first guess there. `scale` maps coordinates, momenta, states, controls and free
    parameters to their typical size, a positive number, where the solver is not to find it by itself.
    """

    task: ClassVar[str] = "control"

    _: KW_ONLY
    cost: Expression = 0
    terminal_cost: Expression = 0
    end: Mapping[Any, Expression] = field(default_factory=dict)
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
    periodic: Mapping[Any, Expression] | Sequence[Any] = ()
    history: Mapping[Any, Expression] = field(default_factory=dict)
    bodies: int = 1
    observations: Measurements | Sequence[Measurements] = ()
    guess: Mapping[Any, Expression] | Trajectory = field(default_factory=dict)
    scale: Mapping[Any, float] = field(default_factory=dict)


@dataclass(frozen=True, init=False)
class Phases(AuthorObject):
    """Control problems that follow each other in time, where dynamics, bounds and cost may change from one to the next.

    All phases are given in the same way (Lagrangian, Hamiltonian or dynamics) and have the same coordinates or states;
    each has a duration and `steps` intervals of its own. Time does not begin anew with a phase. Only the first phase
    has a `start`; what an earlier phase says of its end (`end`, `end_conditions`, `terminal_cost`) holds at the switch
    to the next one, before the jump there.

    `jumps` has one mapping for each switch, which gives states, or coordinates and velocities (or momenta), their
    values after the switch in terms of those before it, as in `jumps=[{m: m - dry_mass}]` or `jumps=[{dq: -e * dq}]`.
    What is left out has the same value after as before; of a Lagrangian these are velocities, whatever momenta do.
    """

    phases: tuple[Control, ...]
    jumps: Sequence[Mapping[Any, Expression]]

    def __init__(self, *phases: Control, jumps: Sequence[Mapping[Any, Expression]] = (), **others: Any) -> None:
        """Put the phases in order; ProblemFileError for arguments that phases do not have in common."""
        for name in others:
            raise ProblemFileError(
                f"Phases(...) has no argument {name!r}",
                SAME_AT_BOTH_ENDS if name == "periodic" else "give phases and jumps; the rest belongs to each Control",
            )
        object.__setattr__(self, "phases", phases)
        object.__setattr__(self, "jumps", jumps)


def form_of(problem: Problem) -> str:
    """Which argument says how the system moves; ExpressionError unless it is exactly one."""
    given = [form for form in FORMS if getattr(problem, form) is not None]
    if len(given) != 1:
        raise ExpressionError(
            "a problem needs exactly one of lagrangian, hamiltonian and dynamics",
            "give one of them" if not given else f"leave out all but one of {', '.join(given)}",
        )
    return given[0]
