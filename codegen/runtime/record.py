"""The record of a generated module: names, sizes and meanings of its contents, as data.

The attribute `metadata` of a module is a record. Code reads the fields; `phrase` makes English texts from them.
Enumeration members are strings and are compared by `==`, because a standalone module has copies of these classes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum, auto
from fractions import Fraction


class Task(StrEnum):
    """The task of a generated module.

    The tasks are optimal control, the simulation of motions, and the connection of points by motions.
    """

    CONTROL = "control"
    SIMULATE = "simulate"
    CONNECT = "connect"


class Form(StrEnum):
    """The form in which the dynamics are stated."""

    LAGRANGIAN = "lagrangian"
    HAMILTONIAN = "hamiltonian"
    FIRST_ORDER = "first-order"


class Method(StrEnum):
    """The method of discretisation or, for a module that connects points, the method for the connecting motions."""

    VARIATIONAL = "variational"
    HAMILTONIAN = "hamiltonian"
    ONE_STEP = "one-step"
    STEPPING = "stepping"
    FULL = "full"
    ACTION = "action"


class Sites(StrEnum):
    """The location of the values of a control: one on each interval, one at each stage, or one at each node.

    Between nodes a control is LINEAR, or a scheme averages the values of both nodes (NODAL).
    """

    INTERVAL = "interval"
    STAGES = "stages"
    LINEAR = "linear"
    NODAL = "nodal"


class StepSolver(StrEnum):
    """The solver for the equations of one time step of a simulation.

    The equations are explicit, linear with a CONSTANT matrix that is factored once, linear, or solved by Newton's
    method.
    """

    EXPLICIT = "explicit"
    CONSTANT = "constant"
    LINEAR = "linear"
    NEWTON = "newton"


class EventAction(StrEnum):
    """The effect of an event of a simulation.

    An event stops the motion, changes the state or is only recorded. A gap has an impact, comes to rest at zero, or
    opens again.
    """

    STOP = "stop"
    CHANGE = "change"
    RECORD = "record"
    IMPACT = "impact"
    REST = "rest"
    OPENING = "opening"


class Role(StrEnum):
    """The role of an unknown in the optimisation: a value of the motion, a multiplier of an equation, or a slack."""

    VALUE = ""
    MULTIPLIER = "multiplier of "
    SLACK = "slack of "


class Place(StrEnum):
    """The location of the condition that an unknown belongs to; OWN is the node or interval of the unknown itself."""

    OWN = auto()
    START = auto()
    END = auto()
    AN_END = auto()
    INTERVAL = auto()
    STAGE = auto()
    INNER_TIME = auto()
    SWITCH = auto()
    BEFORE_SWITCH = auto()
    AFTER_SWITCH = auto()
    BODIES = auto()


class Kind(StrEnum):
    """The kind of an unknown: its role, a text for the quantity or condition that it belongs to, and the location.

    The braces in a text stand for the name of the quantity, or for the condition in the author's words.
    """

    role: Role
    text: str
    place: Place

    def __new__(cls, role: Role, text: str, place: Place) -> "Kind":
        """Make a member; its value contains the role, the text and the location, so that it is unique."""
        value = f"{place}: {role}{text}"
        member = str.__new__(cls, value)
        member._value_, member.role, member.text, member.place = value, role, text, place
        return member

    COORDINATE = Role.VALUE, "coordinate {}", Place.OWN
    STATE = Role.VALUE, "state {}", Place.OWN
    MOMENTUM = Role.VALUE, "momentum {}", Place.OWN
    CONTROL = Role.VALUE, "control {}", Place.OWN
    STAGE_CONTROL = Role.VALUE, "control {}", Place.STAGE
    STAGE_VALUE = Role.VALUE, "stage value {}", Place.OWN
    INNER_VALUE = Role.VALUE, "inner value {}", Place.OWN
    END_VELOCITY = Role.VALUE, "velocity {}", Place.AN_END
    SWITCH_VELOCITY = Role.VALUE, "velocity {}", Place.BEFORE_SWITCH
    SWITCH_MOMENTUM = Role.VALUE, "momentum {}", Place.BEFORE_SWITCH
    NORMAL_FORCE = Role.VALUE, "force along the normal of the constraint {}", Place.OWN
    SWITCH_FORCE = Role.VALUE, "force along the normal of the constraint {}", Place.AFTER_SWITCH
    TIME = Role.VALUE, "time at a node", Place.OWN
    PACE = Role.VALUE, "pace of time before a node", Place.OWN
    FREE_PARAMETER = Role.VALUE, "free parameter {}", Place.OWN
    START_VALUE = Role.VALUE, "{}", Place.START
    END_VALUE = Role.VALUE, "{}", Place.END
    END_IMPULSE = Role.VALUE, "impulse of {}", Place.END
    START_MOMENTUM = Role.VALUE, "momentum of {}", Place.START

    MOTION = Role.MULTIPLIER, "the equation of motion of {}", Place.OWN
    STEP = Role.MULTIPLIER, "the step of {}", Place.OWN
    PATH = Role.MULTIPLIER, "{}", Place.INTERVAL
    BOUND = Role.MULTIPLIER, "the bound {}", Place.INTERVAL
    GAP = Role.MULTIPLIER, "the gap {}", Place.INTERVAL
    FRICTION = Role.MULTIPLIER, "the friction of {}", Place.INTERVAL
    COMPLEMENTARITY = Role.MULTIPLIER, "the complementarity of {}", Place.INTERVAL
    NODAL = Role.MULTIPLIER, "{}", Place.OWN
    CONSTRAINT = Role.MULTIPLIER, "the constraint {}", Place.OWN
    ROLLING = Role.MULTIPLIER, "the rolling constraint {} before a node", Place.OWN
    START_CONDITION = Role.MULTIPLIER, "{}", Place.START
    END_CONDITION = Role.MULTIPLIER, "{}", Place.END
    SWITCH_CONDITION = Role.MULTIPLIER, "{}", Place.SWITCH
    INNER_CONDITION = Role.MULTIPLIER, "a condition", Place.INNER_TIME
    INTEGRAL = Role.MULTIPLIER, "the integral {}", Place.OWN
    COUPLING = Role.MULTIPLIER, "{}", Place.BODIES
    VELOCITY = Role.MULTIPLIER, "the condition on {}", Place.OWN
    SWITCH_MATCH = Role.MULTIPLIER, "the momentum of {}", Place.AFTER_SWITCH
    CONTINUITY = Role.MULTIPLIER, "the continuity of {}", Place.OWN
    MOMENTUM_CONTINUITY = Role.MULTIPLIER, "the continuity of the momentum of {}", Place.OWN
    PASSING_TIME = Role.MULTIPLIER, "the time that passes", Place.OWN
    CONSTANT_PACE = Role.MULTIPLIER, "the pace that stays", Place.OWN
    DURATION = Role.MULTIPLIER, "the duration", Place.OWN

    PATH_SLACK = Role.SLACK, "{}", Place.INTERVAL
    BOUND_SLACK = Role.SLACK, "the bound {}", Place.INTERVAL
    GAP_SLACK = Role.SLACK, "the gap {}", Place.INTERVAL
    FRICTION_SLACK = Role.SLACK, "the friction of {}", Place.INTERVAL
    COMPLEMENTARITY_SLACK = Role.SLACK, "the complementarity of {}", Place.INTERVAL
    START_SLACK = Role.SLACK, "{}", Place.START
    END_SLACK = Role.SLACK, "{}", Place.END
    SWITCH_SLACK = Role.SLACK, "{}", Place.SWITCH
    INNER_SLACK = Role.SLACK, "a condition", Place.INNER_TIME
    INTEGRAL_SLACK = Role.SLACK, "the integral {}", Place.OWN


@dataclass(frozen=True)
class Meaning:
    """The meaning of an unknown.

    Attributes
    ----------
    kind : Kind
        Role and location.
    of : str
        The quantity or condition that the unknown belongs to, in the author's words.
    at : float
        Abscissa of a point of an interval, between 0 and 1, or the number of a stage or switch.
    segment : int
        Number, from 1, of the segment of the motion in which the condition holds, if delays divide the motion into
        segments; otherwise 0.
    others : tuple of Meaning
        Meanings of the same unknown in other phases.
    """

    kind: Kind
    of: str = ""
    at: float = 0
    segment: int = 0
    others: "tuple[Meaning, ...]" = ()

    @property
    def subject(self) -> str:
        """The quantity or condition with a word for its kind, such as `coordinate x`, without role and location."""
        return self.kind.text.format(self.of)


def phrase(meaning: Meaning, role: bool = True, where: str | None = None, longest: int | None = None) -> str:
    """Return an unknown in words, as in `slack of x + v <= 1 at 1/2 of an interval`.

    Parameters
    ----------
    meaning : Meaning
        Meaning of the unknown.
    role : bool
        True for a text that begins with the role.
    where : str or None
        The node or interval of the unknown, as in ` on interval 3 (t = 0.2) of body 1`. None stands for any interval,
        "" for a text without interval.
    longest : int or None
        The number of characters after which role and subject are cut off.
    """
    *before, last = replace(meaning, others=()), *meaning.others
    text = "".join(f"{phrase(other, role)} or " for other in before) + (last.kind.role if role else "") + last.subject
    if longest is not None and len(text) > longest:
        text = f"{text[:longest].rstrip()} ..."
    place = last.kind.place
    number = Fraction(last.at).limit_denominator(1000)
    text += PLACES.get(place, "").format(number if abs(number - last.at) < 1e-12 else f"{last.at:.4g}")
    if place == Place.INTERVAL:
        where = " on an interval" if where is None else where
        return text + where.replace(" on ", " of ", 1)
    if place in (Place.START, Place.END):
        return text + (where or "").partition(")")[2]
    return text + (where or "")


PLACES = {
    Place.START: " at the start",
    Place.END: " at the end",
    Place.AN_END: " at an end",
    Place.INTERVAL: " at {}",
    Place.STAGE: " at stage {}",
    Place.INNER_TIME: " at an inner time",
    Place.SWITCH: " at switch {}",
    Place.BEFORE_SWITCH: " before a switch",
    Place.AFTER_SWITCH: " after a switch",
}
"""The words of `phrase` for each location; the abscissa or number of a Meaning replaces the braces."""


@dataclass(frozen=True)
class TableRecord:
    """A table of values that a problem interpolates.

    Attributes
    ----------
    file : str
        The file with the values.
    inputs, output : tuple of str, str
        Names of the inputs and of the output.
    kind, outside : str
        The kind of interpolation, and the continuation outside the breakpoints.
    sizes : tuple of int
        The number of breakpoints of each input.
    """

    file: str
    inputs: tuple[str, ...]
    output: str
    kind: str
    outside: str
    sizes: tuple[int, ...]


@dataclass(frozen=True)
class ObservationRecord:
    """The measurements to which a motion is fitted.

    Attributes
    ----------
    sources : tuple of str
        The source of the measurements of each body.
    time : str
        Name of the column of times.
    columns : tuple of str
        Names of the columns of measured values.
    sigmas : tuple
        The standard deviation of each of these columns: a number, the name of a column, or None.
    values : tuple of str
        The measured quantities.
    loss : str
        The loss function.
    """

    sources: tuple[str, ...]
    time: str
    columns: tuple[str, ...]
    sigmas: tuple[float | str | None, ...]
    values: tuple[str, ...]
    loss: str


@dataclass(frozen=True)
class SegmentRecord:
    """The segments into which delays divide a motion.

    Attributes
    ----------
    number : int
        The number of segments.
    names : mapping
        For the name of each quantity of the divided problem: the name of the original quantity, and its segment.
    """

    number: int
    names: Mapping[str, tuple[str, int]]


@dataclass(frozen=True, kw_only=True)
class Record:
    """The fields that all records have.

    Attributes
    ----------
    problem, title, inputs : str
        The name of the problem, its title, and a digest of everything that the module was made from.
    steps : int
        The default number of intervals, or of time steps.
    parameters : mapping
        Default values of parameters.
    method, scheme, order, form : Method, str, int, Form
        The discretisation, its order, and the form of the dynamics.
    coordinates, rates : tuple of str
        Names of coordinates or states, and of velocities or momenta.
    start, end : tuple of str
        Quantities with a prescribed value at the start, and at the end.
    bodies, phases, inner_times : int
        Numbers of bodies, phases, and inner times. Conditions hold at inner times, between start and end.
    control_names : tuple of str
        Names of controls.
    attitudes : tuple of str
        Names of attitudes, whose quaternions are coordinates or states such as `R_w`.
    units : mapping
        Units of quantities.
    unused : tuple of str
        Symbols that are declared but not used.
    tables : mapping
        Tables by name.
    observations : ObservationRecord or None
        Measurements.
    segments : SegmentRecord or None
        The segments into which delays divide the motion.
    sensitivities : tuple of str or None
        Quantities with respect to which the module differentiates solutions; None for a module without sensitivities.
    conservative : bool
        False if forces act on the motion, or if the dynamics depend on time.
    points : str
        The file of points that the problem names, or "".
    operations : mapping
        For each kernel two numbers of operations: of its formulas, and of its code with shared common subexpressions.
    left_out : tuple of str
        Features that the module lacks because the problem does not need them, with reasons.
    """

    problem: str
    title: str
    inputs: str
    steps: int
    parameters: Mapping[str, float]
    method: Method
    scheme: str
    order: int
    form: Form
    coordinates: tuple[str, ...]
    rates: tuple[str, ...]
    start: tuple[str, ...] = ()
    end: tuple[str, ...] = ()
    bodies: int = 1
    phases: int = 1
    inner_times: int = 0
    control_names: tuple[str, ...] = ()
    attitudes: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    unused: tuple[str, ...] = ()
    tables: Mapping[str, TableRecord] = field(default_factory=dict)
    observations: ObservationRecord | None = None
    segments: SegmentRecord | None = None
    sensitivities: tuple[str, ...] | None = None
    conservative: bool = True
    points: str = ""
    operations: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    task = Task.SIMULATE
    of_particles = False


@dataclass(frozen=True, kw_only=True)
class ControlRecord(Record):
    """The record of a module of optimal control.

    Attributes
    ----------
    controls : Sites
        Location of controls.
    free_parameters : tuple of str
        Names of free parameters.
    node, interval, shared : tuple of str
        Names of the unknowns of a node, of the unknowns of an interval, and of the linking variables, in their order.
    inequalities : bool
        True if an unknown has bounds.
    meanings : mapping
        Meanings of multipliers, slacks and forces of constraints.
    slacks : tuple of mapping
        Meanings of slacks in each of several phases.
    jumps : tuple
        For each switch between phases, the coordinates and momenta that jump there.
    stages : mapping
        For the name of each unknown at a stage, the name of the same quantity at nodes.
    stage_abscissae : tuple of float
        Positions of the stages in an interval, from 0 to 1, if controls have values at stages.
    scale, angles : mapping
        `scale` has the scaling factors that the author states. `angles` has the value of one radian in the unit of each
        quantity that is an argument of sines and cosines.
    integrals : tuple
        Pairs (condition on an integral, index of its multiplier among linking variables).
    waypoints : bool
        True if inner times are free.
    inner_conditions : tuple
        Triples (condition, number of its time, index of its multiplier in a node).
    maximised : bool
        True if the author's cost is maximised.
    unseen_controls : tuple of str
        Controls whose alternation from interval to interval does not change the cost.
    history_jumps : tuple
        Triples (quantity, value at the start, last value of its history) of quantities whose two values differ.
    kinks, discontinuities : tuple of str
        Terms of the cost, and terms of controls in the equations of motion, whose slope jumps. Borders at which a
        function of the problem jumps.
    singular_at_guess : tuple
        Triples of texts (function, first derivative of the function that is not finite at the guess, point).
    coupling_conditions : int
        The number of conditions between bodies, if some are redundant; otherwise 0.
    redundant_conditions : tuple
        Pairs (number, name) of the conditions between bodies that are left out because they follow from others.
    dependent_values, decided_conditions : tuple
        Pairs (quantity, end) of prescribed values that follow from other values, and pairs (condition, end) of
        conditions that prescribed values decide.
    relaxation : str
        Name of the parameter that bounds the products of contact forces and gaps; empty without contact.
    contact_forces : tuple of str
        Names of the controls that are contact forces.
    end_impulses : tuple of str
        Names of the unknowns of a node that are contact impulses at the end.
    """

    controls: Sites = Sites.INTERVAL
    free_parameters: tuple[str, ...] = ()
    node: tuple[str, ...]
    interval: tuple[str, ...]
    shared: tuple[str, ...] = ()
    inequalities: bool = False
    meanings: Mapping[str, Meaning] = field(default_factory=dict)
    slacks: tuple[Mapping[str, Meaning], ...] = ()
    jumps: tuple[tuple[str, ...], ...] = ()
    stages: Mapping[str, str] = field(default_factory=dict)
    stage_abscissae: tuple[float, ...] = ()
    scale: Mapping[str, float] = field(default_factory=dict)
    angles: Mapping[str, float] = field(default_factory=dict)
    integrals: tuple[tuple[str, int], ...] = ()
    waypoints: bool = False
    inner_conditions: tuple[tuple[str, int, int], ...] = ()
    maximised: bool = False
    unseen_controls: tuple[str, ...] = ()
    history_jumps: tuple[tuple[str, str, str], ...] = ()
    kinks: tuple[str, ...] = ()
    discontinuities: tuple[str, ...] = ()
    singular_at_guess: tuple[tuple[str, str, str], ...] = ()
    coupling_conditions: int = 0
    redundant_conditions: tuple[tuple[int, str], ...] = ()
    dependent_values: tuple[tuple[str, str], ...] = ()
    decided_conditions: tuple[tuple[str, str], ...] = ()
    relaxation: str = ""
    contact_forces: tuple[str, ...] = ()
    end_impulses: tuple[str, ...] = ()

    task = Task.CONTROL

    @property
    def slack_meanings(self) -> tuple[Mapping[str, Meaning], ...]:
        """The meanings of slacks, one mapping for each phase."""
        return self.slacks or (self.meanings,)

    def kind(self, name: str) -> Kind | None:
        """The kind of an unknown, or None if `meanings` does not contain the unknown."""
        return self.meanings[name].kind if name in self.meanings else None

    def is_slack(self, name: str) -> bool:
        """Return True if an unknown is a slack."""
        kind = self.kind(name)
        return kind is not None and kind.role == Role.SLACK


@dataclass(frozen=True, kw_only=True)
class SimulationRecord(Record):
    """The record of a module that computes a motion.

    Attributes
    ----------
    parts : int
        The number of steps of the base scheme in one step of a composition; 0 for a scheme that is no composition.
    solver : StepSolver
        The solver of the equations of a step.
    momenta, node, stages, unknowns : tuple of str
        Names of momenta, of the state at a node, of values inside a step, and of the unknowns of a step.
    constraints : tuple of str
        The holonomic constraints, then the rolling constraints, as expressions that vanish.
    rolling : tuple of str
        The rolling constraints among them.
    events, gaps : tuple of str
        Names of the events, and of the gaps that do not become negative.
    """

    parts: int = 0
    solver: StepSolver
    momenta: tuple[str, ...] = ()
    node: tuple[str, ...]
    stages: tuple[str, ...] = ()
    unknowns: tuple[str, ...] = ()
    constraints: tuple[str, ...] = ()
    rolling: tuple[str, ...] = ()
    events: tuple[str, ...] = ()
    gaps: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ParticleRecord(Record):
    """The record of a module that moves particles.

    In a simulation, `coordinates` and `rates` name the coordinates and momenta of every single particle.

    Attributes
    ----------
    own : tuple of str
        Parameters of which every particle has its own value.
    separable, quadratic : bool
        `separable` is True if the Hamiltonian is separable. `quadratic` is True if the Hamiltonian is a quadratic form
        in the momenta.
    """

    own: tuple[str, ...] = ()
    separable: bool = False
    quadratic: bool = False

    of_particles = True


@dataclass(frozen=True, kw_only=True)
class ConnectRecord(ParticleRecord):
    """The record of a module that connects points by motions.

    Attributes
    ----------
    adaptive : str
        The method of scipy that chooses the steps, or "" for a fixed number of steps.
    passive : bool
        True if the module also moves tracer points.
    """

    adaptive: str = ""
    passive: bool = False

    task = Task.CONNECT
