"""What drivers are asked, what they claim, and the result that is returned to the user."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np

from codegen.errors import ArgumentError, NumericsError
from codegen.problem.points import PointSet
from codegen.runtime.record import Form, Record
from codegen.solving.loading import Grid, Matrix, Vector
from codegen.solving.results.display import Background, Display
from codegen.solving.results.estimates import Estimates

INACCURATE = 1e-7
"""Parts of their terms that linear equations may leave: beyond it derivatives are not what they should be."""
_NAMED = 3
"""Places that are told of those where strict complementarity fails."""


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of a solution by one quantity, in the problem's units.

    Of the cost, of `durations` (D,), one for each phase, of `free` parameters by name, and of arrays of the result, of
    whose shapes they are: `t`, and at nodes that move with it `q` and `p`; `u`, `multipliers`, and `unknowns` (n,).
    """

    cost: float
    durations: Vector
    free: dict[str, float]
    t: Vector = field(repr=False)
    q: Matrix = field(repr=False)
    p: Matrix = field(repr=False)
    u: Matrix = field(repr=False)
    multipliers: Matrix = field(repr=False)
    unknowns: Vector = field(repr=False)


@dataclass(frozen=True, eq=False)
class Sensitivities(Mapping[str, Derivatives]):
    """Derivatives by all quantities: parameters by their names, boundary values such as `start.x`, and `duration`.

    Boundary values, and a given duration, follow parameters by the problem's formulas, as in a sweep. Where bounds
    hold, they are those with the same set of active bounds. `costs` (m,) are the derivatives of the cost, in the order
    of the names. `reason` says why there are no derivatives; `doubtful` names where strict complementarity fails: there
    bounds begin to hold or cease to, and derivatives are one-sided at best. `inaccuracy` is what is left of the linear
    equations, in parts of their terms.
    """

    names: tuple[str, ...]
    costs: Vector
    reason: str
    doubtful: tuple[str, ...]
    inaccuracy: float
    _by_name: Mapping[str, Derivatives] = field(repr=False)

    def __getitem__(self, name: str) -> Derivatives:
        """Derivatives by a quantity; NumericsError where there are none, KeyError for a name that is no quantity."""
        if self.reason and name in self.names:
            raise NumericsError(f"there are no derivatives by {name}: {self.reason}", "see its reason")
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        """The names of all quantities."""
        return iter(self.names)

    def __len__(self) -> int:
        """How many quantities there are."""
        return len(self.names)

    @property
    def notes(self) -> list[str]:
        """What a user should know, a line each."""
        found = [f"no sensitivities: {self.reason}"] if self.reason else []
        if self.doubtful:
            places, rest = ", ".join(self.doubtful[:_NAMED]), len(self.doubtful) - _NAMED
            more = f" and {rest} more" if rest > 0 else ""
            found.append(f"sensitivities may be one-sided: strict complementarity fails for {places}{more}")
        if not self.reason and self.inaccuracy > INACCURATE:
            found.append(f"sensitivities are inaccurate: {self.inaccuracy:.0e} of their linear equations is left")
        return found


STATUSES = {
    "solved": "the equations hold to the driver's tolerance, or to rounding",
    "iteration limit": "the iterations ran out first",
    "time limit": "the time ran out first",
    "stalled": "no step makes further progress, though the residual is small",
    "infeasible": "the equations cannot be satisfied near the last iterate",
    "rank-deficient": "boundary conditions or controls are redundant or insufficient",
    "saddle point": "the guess is stationary but no minimum",
    "unbounded": "the cost decreases without limit along the equations",
    "non-finite": "an expression became infinite or NaN",
    "outside a table": "the solution reads a table outside its range",
    "singular": "the equations of one step have no unique solution",
    "newton failed": "Newton's method did not converge within one step",
    "not connected": "no attempt found a motion from the given points to their targets",
    "accuracy not reached": "the equations hold, but no grid was found on which their solution is as accurate as asked",
    "inaccurate": "the driver claimed success, but the residuals evaluated afterwards are too large",
}
"""Every status word and its meaning; all but the first are failures."""


Watch: TypeAlias = Callable[[int, tuple[float, ...]], None]
"""What is called with the number of an iterate and its row of the log."""


@dataclass(frozen=True)
class Run:
    """What is asked of a driver.

    The number of steps, for a simulation to store every how many-th of them, and for an optimisation a vector of
    unknowns to start from, and whether that is `near` the solution; for a connect problem the points. None as a
    tolerance, or as the most iterations of an optimiser, stands for the driver's own; `time_limit` is in seconds, and
    `watch` is called with the number and the row of the log of every iterate.
    With the `scaling` "none" an optimiser works in the problem's own units. Intervals are equal, or last the fractions
    `grid` of the duration: (N,), or (phases, N) of the phases.
    """

    steps: int
    every: int = 1
    guess: Vector | None = None
    points: PointSet | None = None
    tolerance: float | None = None
    near: bool = True
    max_iterations: int | None = None
    time_limit: float = math.inf
    watch: Watch | None = None
    scaling: str = "auto"
    grid: Vector | None = None


@dataclass(frozen=True)
class ConnectAttempt:
    """What a driver claims about a connect problem: states at the nodes, shape (N + 1, 2, n, d).

    `generated` says, here and below, that the module's own solver claims it.
    """

    status: str
    message: str
    iterations: int
    path: Any
    tolerance: float
    attempts: tuple[str, ...] = ()
    tangents: int = 0
    generated: bool = False


@dataclass(frozen=True)
class ControlAttempt:
    """What a driver claims about an optimal-control problem; `tolerance` is the accuracy that it promises.

    `trajectories` are what a module makes of the unknowns (`unpack`), and `scaled` is the grid with the sizes that it
    finds at the guess (`scaled_grid`), where a driver has them anyway. Where `is_explained` the message names what was
    wrong, and no equation that is off need be.
    """

    status: str
    message: str
    iterations: int
    unknowns: Vector
    tolerance: float
    log: Matrix | None = None
    trajectories: tuple[Matrix, ...] = ()
    scaled: Grid | None = None
    is_explained: bool = False
    generated: bool = False


@dataclass(frozen=True)
class SimulateAttempt:
    """What a driver claims about a simulation, at the stored steps."""

    status: str
    message: str
    iterations: int
    t: Vector
    q: Matrix
    p: Matrix
    energy: Vector
    steps: int
    residual: float
    tolerance: float
    generated: bool = False


@dataclass(frozen=True)
class Outline:
    """What many solves keep of each: the verdict and the arrays of a Result by their names, and where to start from.

    A cost or a vector of unknowns is None where a task has none; `free` are values of free parameters by name.
    """

    status: str
    message: str
    cost: float | None
    residual: float
    arrays: dict[str, Matrix]
    unknowns: Vector | None
    free: Mapping[str, float] = field(default_factory=dict)


def outline_of(result: Result) -> Outline:
    """A result without what is told of it beside."""
    named = {name: getattr(result, name) for name in ("t", "q", "p", "u", "multipliers", "energy")}
    arrays = {name: array for name, array in named.items() if array is not None}
    return Outline(result.status, result.message, result.cost, result.residual, arrays, result.unknowns)


@dataclass(frozen=True)
class GridLevel:
    """How the solution on one grid ended: intervals of each phase, status, estimated error, iterations, seconds."""

    intervals: int
    status: str
    error: float
    iterations: int
    seconds: float = field(compare=False)


@dataclass(frozen=True)
class Accuracy:
    """What came of a request for accuracy: the estimated relative error, of which quantity it is largest, and when.

    `reason` says why the request was not met, and is empty where it was; `levels` are the grids in their order.
    """

    request: float
    estimate: float
    quantity: str
    time: float
    reason: str
    levels: tuple[GridLevel, ...]


LARGE_ERROR = 0.01
"""Relative error of states or cost from which on a solution has a note.

A choice of this project: an error of one per cent is visible in a figure of the motion.
"""


@dataclass(frozen=True)
class DiscretisationError:
    """The estimated distance of a solution from that of the continuous problem.

    `states` is the largest error of any state or free parameter, relative to the largest value of the same quantity;
    `quantity` and `time` tell where it is. `cost` is relative to the cost.
    """

    states: float
    cost: float
    quantity: str
    time: float

    @property
    def is_large(self) -> bool:
        """True if the error is above the limit for a note."""
        return max(self.states, self.cost) > LARGE_ERROR

    @property
    def note(self) -> str:
        """The message for the author, with the remedy."""
        return (
            f"the estimated error of the discretisation is {_percent(self.states)} of {self.quantity} at t = "
            f"{self.time:.4g}, and {_percent(self.cost)} of the cost: take more --steps, or --accuracy"
        )


UNKNOWN_ERROR = (
    "the error of the discretisation could not be estimated: no optimum was found on half as many intervals; compare "
    "with more --steps, or take --accuracy"
)
"""The note of a solution without an estimate."""


def _percent(part: float) -> str:
    return f"{100.0 * part:.2g} %"


@dataclass(frozen=True, kw_only=True, eq=False)
class Result(Display):
    """A solution with its residuals; arrays run over the nodes, `u` over intervals, nodes or stages.

    `residual` is the max-norm of all discrete equations, `stationarity` that of the optimality conditions, both
    evaluated outside the driver. `iterations` are those of the last run. `seconds_solve` is the time of the fastest
    one; `seconds_code` is the time of machine code, which was compiled if `compiled`, else read from the disk.
    `unknowns` is the vector from which a warm start can be made. `levels` tells how the grids of a refinement ended.
    `grid` holds the fractions of the duration, or of every phase, that intervals last where they are not equal,
    `accuracy` what came of a request for it, `error` the estimated error of the discretisation of an optimal-control
    problem, and `estimates` what measurements say of free parameters; `sensitivity` is what `sensitivities()` gives.
    `notes` are sentences on a solution whose equations hold, and whose motion violates conditions between its nodes.
    `by_segments` is the result of a problem with delays as its module has it, with columns for every segment;
    `background` is what pictures need. `labels` are entries of the summary as tables write them where an author's names
    are in them, which `label` looks up. `units` are those of columns by name, of the time `t`, and of `cost` and
    `energy`, as far as the author gave them. `parameters` are those that the solve was given in place of the problem's
    own.
    """

    problem: str
    title: str
    task: str
    method: str
    scheme: str
    driver: str
    steps: int
    status: str
    message: str
    cost: float | None = None
    residual: float
    stationarity: float | None = None
    iterations: int
    t: Vector = field(repr=False)
    q: Matrix = field(repr=False)
    p: Matrix = field(repr=False)
    u: Matrix | None = field(default=None, repr=False)
    multipliers: Matrix | None = field(default=None, repr=False)
    energy: Vector | None = field(default=None, repr=False)
    log: Matrix | None = field(default=None, repr=False)
    unknowns: Vector | None = field(default=None, repr=False)
    names: dict[str, tuple[str, ...]]
    summary: dict[str, float]
    labels: Mapping[str, str] = field(default_factory=dict, repr=False, compare=False)
    units: Mapping[str, str] = field(default_factory=dict, repr=False, compare=False)
    parameters: Mapping[str, float] = field(default_factory=dict)
    seconds_solve: float = field(default=float("nan"), compare=False)
    seconds_code: float = field(default=float("nan"), compare=False)
    compiled: bool = field(default=False, compare=False)
    attempts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    levels: tuple[Result, ...] = ()
    stage_abscissae: tuple[float, ...] = ()
    grid: Vector | None = field(default=None, repr=False)
    accuracy: Accuracy | None = None
    error: DiscretisationError | None = None
    estimates: Estimates | None = None
    by_segments: Result | None = field(default=None, repr=False)
    sensitivity: Sensitivities | None = field(default=None, repr=False)
    background: Background | None = field(default=None, repr=False, compare=False)

    def sensitivities(self) -> Sensitivities:
        """Derivatives by parameters, boundary values and a given duration, of a solve that was asked for them.

        `result.sensitivities()["start.x"].cost` is the one of the cost by a boundary value, `.q` has the shape of `q`.
        Raises ArgumentError where nobody asked.
        """
        if self.sensitivity is None:
            raise ArgumentError("this result has no sensitivities", "solve with sensitivities=True")
        return self.sensitivity

    def unit_of(self, entry: str) -> str:
        """The unit of an entry of the summary, or of a value such as `start.x`, as far as it is known; else nothing."""
        of_time = {"duration": "t", "energy_drift": "energy", "energy_change": "energy"}
        name = of_time.get(entry, entry.removeprefix("final_").removeprefix("start.").removeprefix("end."))
        return self.units.get(name, "")

    def label(self, entry: str) -> str:
        """An entry of the summary for people to read: an author's names as written, blanks between other words."""
        return self.labels.get(entry, entry.replace("_", " "))

    @property
    def solved(self) -> bool:
        """Whether the numerics succeeded."""
        return self.status == "solved"

    @property
    def control_times(self) -> Vector:
        """The times of the rows of `u`: nodes, stages of all intervals, or the middles of intervals."""
        assert self.u is not None, "a simulation has no controls"
        if not self.stage_abscissae and len(self.u) == self.t.size:
            return self.t
        abscissae = np.array(self.stage_abscissae or (0.5,))
        return np.asarray((self.t[:-1, None] + np.diff(self.t)[:, None] * abscissae).ravel())

    def controls_at(self, times: Vector) -> Matrix:
        """The controls at any times, a row for each: constant on intervals, linear between nodes, else polynomials.

        On every interval the polynomial goes through the values at its stages, their mean at one abscissa.
        """
        assert self.u is not None, "a simulation has no controls"
        times = np.atleast_1d(np.asarray(times, dtype=float))
        if not self.stage_abscissae and len(self.u) == self.t.size:
            return np.column_stack([np.interp(times, self.t, column) for column in self.u.T])
        interval = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, self.t.size - 2)
        stages = np.array(self.stage_abscissae or (0.5,))
        abscissae = np.unique(stages)
        same = stages == abscissae[:, None]
        values = (same / same.sum(axis=1)[:, None]) @ self.u.reshape(self.t.size - 1, stages.size, -1)
        fractions = (times - self.t[interval]) / np.diff(self.t)[interval]
        shares = np.ones((times.size, abscissae.size))
        for i, own in enumerate(abscissae):
            for other in abscissae[abscissae != own]:
                shares[:, i] *= (fractions - other) / (own - other)
        return np.asarray(np.einsum("ti,tij->tj", shares, values[interval]))

    @property
    def intervals(self) -> str:
        """How many steps were made, for people: `20 steps`, or `2 x 20 steps` in two phases."""
        phases = (self.t.size - 1) // self.steps  # a simulation may have stored fewer
        return f"{phases} x {self.steps} steps" if phases > 1 else f"{self.steps} steps"


Attempt: TypeAlias = ConnectAttempt | ControlAttempt | SimulateAttempt


def origin(metadata: Record, driver: str, run: Run, attempt: Attempt, seconds: float) -> dict[str, Any]:
    """What a result says of where it comes from, whatever the task."""
    own = {name: str(getattr(metadata, name)) for name in ("problem", "title", "task", "method", "scheme")}
    told = {"driver": driver, "steps": run.steps, "iterations": attempt.iterations, "seconds_solve": seconds}
    return {**own, **told, "units": component_units(metadata)}


def contradicted(driver: str, finding: str, remedy: str) -> tuple[str, str]:
    """Status and message where a driver claims what is not so."""
    return "inaccurate", f"{driver} reported success, but {finding}; {remedy}"


def other_driver(attempt: Attempt) -> str:
    """What to try where a driver claims what is not so: another one, or other numbers."""
    return "try more steps, or another guess" if attempt.generated else "try more steps, or driver newton"


def max_norm(values: Vector) -> float:
    """Max-norm; infinite when an entry is not finite."""
    if values.size == 0:
        return 0.0
    norm = float(np.abs(values).max())
    return norm if math.isfinite(norm) else math.inf


def component_names(metadata: Record) -> dict[str, tuple[str, ...]]:
    """What the columns of q, p and u are called; those of several bodies carry the body's number."""
    coordinates = tuple(metadata.coordinates)
    momenta = tuple(metadata.rates) if metadata.form == Form.HAMILTONIAN else None
    if momenta is None:
        momenta = () if metadata.form == Form.FIRST_ORDER else tuple(f"p_{name}" for name in coordinates)
    names = {"q": coordinates, "p": momenta, "u": tuple(metadata.control_names)}
    bodies = metadata.bodies
    if bodies == 1:
        return names
    return {key: tuple(f"{name}_{body}" for body in range(bodies) for name in row) for key, row in names.items()}


def component_units(metadata: Record) -> dict[str, str]:
    """The units of columns by their names, beside those of everything else that has one."""
    units: dict[str, str] = dict(metadata.units)
    if units and metadata.bodies > 1:
        for row in component_names(replace(metadata, bodies=1)).values():
            each = {f"{name}_{body}": units[name] for name in row for body in range(metadata.bodies) if name in units}
            units |= each
    return units
