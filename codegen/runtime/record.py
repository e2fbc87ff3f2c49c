"""The record of a generated module: names, sizes and meanings of its contents, as data.

The attribute `metadata` of a module is a record. Code reads the fields; `phrase` makes texts for people from them.
Members of enumerations are texts and are compared by `==`: a standalone module has copies of these classes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum, auto
from fractions import Fraction


class Task(StrEnum):
    """The task of a problem."""

    CONTROL = "control"
    SIMULATE = "simulate"
    CONNECT = "connect"


class Form(StrEnum):
    """The form of the dynamics."""

    LAGRANGIAN = "lagrangian"
    HAMILTONIAN = "hamiltonian"
    FIRST_ORDER = "first-order"


class Method(StrEnum):
    """The discretisation of the equations, or the unknowns of particles that are connected."""

    VARIATIONAL = "variational"
    HAMILTONIAN = "hamiltonian"
    ONE_STEP = "one-step"
    STEPPING = "stepping"
    FULL = "full"
    ACTION = "action"


class Sites(StrEnum):
    """The location of controls: one value on an interval, values at its stages, or values at nodes."""

    INTERVAL = "interval"
    STAGES = "stages"
    NODAL = "nodal"


class StepSolver(StrEnum):
    """The solver of one step of a simulation; the matrix of `constant` is factored once."""

    EXPLICIT = "explicit"
    CONSTANT = "constant"
    LINEAR = "linear"
    NEWTON = "newton"


class Role(StrEnum):
    """The role of an unknown in the optimisation: a value of the motion, a multiplier of an equation, or a slack."""

    VALUE = ""
    MULTIPLIER = "multiplier of "
    SLACK = "slack of "


class Place(StrEnum):
    """The location of the condition of an unknown: OWN is the node or interval of the unknown."""

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
    """The kind of an unknown: its role, a text with the quantity or condition that it belongs to, and the place."""

    role: Role
    text: str
    place: Place

    def __new__(cls, role: Role, text: str, place: Place) -> "Kind":
        """Make a member, which is unique by all three."""
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
    TIME = Role.VALUE, "time at a node", Place.OWN
    PACE = Role.VALUE, "pace of time before a node", Place.OWN
    FREE_PARAMETER = Role.VALUE, "free parameter {}", Place.OWN
    START_VALUE = Role.VALUE, "{}", Place.START
    END_VALUE = Role.VALUE, "{}", Place.END
    START_MOMENTUM = Role.VALUE, "momentum of {}", Place.START

    MOTION = Role.MULTIPLIER, "the equation of motion of {}", Place.OWN
    STEP = Role.MULTIPLIER, "the step of {}", Place.OWN
    PATH = Role.MULTIPLIER, "{}", Place.INTERVAL
    BOUND = Role.MULTIPLIER, "the bound {}", Place.INTERVAL
    NODAL = Role.MULTIPLIER, "{}", Place.OWN
    CONSTRAINT = Role.MULTIPLIER, "the constraint {}", Place.OWN
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
        Role and place.
    of : str
        The quantity or condition that the unknown belongs to, in the author's words.
    at : float
        Abscissa of a point of an interval, between 0 and 1, or the number of a stage or switch.
    segment : int
        Number, from 1, of the segment of a condition where delays cut the motion, else 0.
    others : tuple of Meaning
        Meanings of the unknown in other phases.
    """

    kind: Kind
    of: str = ""
    at: float = 0
    segment: int = 0
    others: "tuple[Meaning, ...]" = ()

    @property
    def subject(self) -> str:
        """The quantity or condition, with a word for its kind: without role and place."""
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
        The node or interval of the unknown, as in ` on interval 3 (t = 0.2) of body 1`; None for any, "" for a text
        without.
    longest : int or None
        The number of characters after which role and subject are cut.
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
"""The words of `phrase` for each place, with an abscissa or a number."""


@dataclass(frozen=True)
class TableRecord:
    """A table: its file, names of inputs and output, kind, continuation outside and numbers of breakpoints."""

    file: str
    inputs: tuple[str, ...]
    output: str
    kind: str
    outside: str
    sizes: tuple[int, ...]


@dataclass(frozen=True)
class ObservationRecord:
    """Measurements: a source for each body, names of columns with standard deviations, and the measured quantities."""

    sources: tuple[str, ...]
    time: str
    columns: tuple[str, ...]
    sigmas: tuple[float | str | None, ...]
    values: tuple[str, ...]
    loss: str


@dataclass(frozen=True)
class SegmentRecord:
    """The segments into which delays cut a motion: their number; name and segment of every quantity."""

    number: int
    names: Mapping[str, tuple[str, int]]


@dataclass(frozen=True, kw_only=True)
class Record:
    """The fields that all records have.

    Attributes
    ----------
    problem, title, inputs : str
        The name of the problem, its title, and a digest of all that the module was made from.
    steps : int
        The number of intervals, or of steps.
    parameters : mapping
        Default values of parameters.
    method, scheme, order, form : Method, str, int, Form
        The discretisation, its order, and the form of the dynamics.
    coordinates, rates : tuple of str
        Names of coordinates or states, and of velocities or momenta.
    start, end : tuple of str
        Quantities with a prescribed value at the start, and at the end.
    bodies, phases, inner_times : int
        Numbers of bodies, phases, and times inside at which conditions hold.
    control_names : tuple of str
        Names of controls.
    units : mapping
        Units of quantities.
    unused : tuple of str
        Symbols that are declared and occur nowhere.
    tables : mapping
        Tables by name.
    observations : ObservationRecord or None
        Measurements.
    segments : SegmentRecord or None
        The segments into which delays cut the motion.
    sensitivities : tuple of str or None
        Quantities by which solutions are differentiated, for a module with sensitivities.
    conservative : bool
        False where forces act on a motion or something depends on time.
    points : str
        The file of points that the problem names, or "".
    operations : mapping
        For each kernel the number of operations, and that of its code, in which common subexpressions are shared.
    left_out : tuple of str
        Features that the problem does not need, with reasons.
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
        Names of the unknowns of a node, of an interval, and of those that belong to neither, in their order.
    inequalities : bool
        True if an unknown has bounds.
    meanings : mapping
        Meanings of multipliers, slacks and forces of constraints.
    slacks : tuple of mapping
        Meanings of slacks in each of several phases.
    jumps : tuple
        Coordinates and momenta that jump at each switch.
    stages : mapping
        Names at stages, each with the name of the same quantity at nodes.
    stage_abscissae : tuple of float
        Abscissae of controls at stages in an interval.
    scale, angles : mapping
        The author's sizes of quantities; one radian in the unit of a quantity that is an argument of sines and cosines.
    integrals : tuple
        Pairs (condition on an integral, index of its multiplier among shared unknowns).
    waypoints : bool
        True if inner times are free.
    inner_conditions : tuple
        Triples (condition, number of its time, index of its multiplier in a node).
    maximised : bool
        True if the author's cost is maximised.
    unseen_controls : tuple of str
        Controls whose alternation from interval to interval does not change the cost.
    history_jumps : tuple
        Triples (quantity, value at the start, last value of its history), where both differ.
    kinks, discontinuities : tuple of str
        Terms of the cost whose slope jumps; borders at which something jumps.
    singular_at_guess : tuple
        Triples (function, quantity without a finite value, place).
    coupling_conditions : int
        The number of conditions between bodies; `redundant_conditions` has number and name of those left out.
    dependent_values, decided_conditions : tuple
        Pairs (quantity, end) of values that follow from others; pairs (condition, end) that prescribed values decide.
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

    task = Task.CONTROL

    @property
    def slack_meanings(self) -> tuple[Mapping[str, Meaning], ...]:
        """The meanings of slacks in each phase."""
        return self.slacks or (self.meanings,)

    def kind(self, name: str) -> Kind | None:
        """The kind of an unknown, if its meaning is on record."""
        return self.meanings[name].kind if name in self.meanings else None

    def is_slack(self, name: str) -> bool:
        """Return True if an unknown is a slack."""
        kind = self.kind(name)
        return kind is not None and kind.role == Role.SLACK


@dataclass(frozen=True, kw_only=True)
class SimulationRecord(Record):
    """The record of a module that follows a motion.

    Attributes
    ----------
    parts : int
        The number of steps of the base scheme that one step of a composition consists of, else 0.
    solver : StepSolver
        Solver of the equations of a step.
    momenta, node, stages, unknowns : tuple of str
        Names of momenta, of the state, of values inside a step, and of the unknowns of a step.
    """

    parts: int = 0
    solver: StepSolver
    momenta: tuple[str, ...] = ()
    node: tuple[str, ...]
    stages: tuple[str, ...] = ()
    unknowns: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ParticleRecord(Record):
    """The record of a module that moves particles; a simulation names coordinates and momenta of every particle.

    Attributes
    ----------
    own : tuple of str
        Parameters of which every particle has its own value.
    separable, quadratic : bool
        True if the Hamiltonian is separable, and if it is a quadratic form in the momenta.
    """

    own: tuple[str, ...] = ()
    separable: bool = False
    quadratic: bool = False

    of_particles = True


@dataclass(frozen=True, kw_only=True)
class ConnectRecord(ParticleRecord):
    """The record of a module that connects points.

    Attributes
    ----------
    adaptive : str
        The method of scipy that chooses the steps, "" for a fixed number of steps.
    passive : bool
        True if the module carries tracer points along.
    """

    adaptive: str = ""
    passive: bool = False

    task = Task.CONNECT
