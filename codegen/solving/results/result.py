"""The request to a driver, the attempt of a driver, and the result that is returned to the user."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias, overload

import numpy as np

from codegen.errors import ArgumentError, NumericsError
from codegen.problem.points import PointSet
from codegen.runtime.record import EventAction, Form, Record
from codegen.solving.loading import EventArrays, Grid, Matrix, Vector
from codegen.solving.results.display import Background, Display
from codegen.solving.results.estimates import Estimates

INACCURATE = 1e-7
"""Relative residual of the linear equations for sensitivities above which the user is warned."""
_NAMED = 3
"""Largest number of unknowns that a note on strict complementarity names."""
LARGE_ERROR = 0.01
"""Relative discretisation error of states or cost above which the user is warned.

A choice of this project: an error of one per cent is visible in a figure of the motion.
"""
UNKNOWN_ERROR = (
    "the error of the discretisation could not be estimated: no optimum was found on half as many intervals; compare "
    "with more --steps, or take --accuracy"
)
"""The note of an optimum without an estimate of its discretisation error."""

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
    "events accumulate": "infinitely many events follow each other in a finite time",
    "contact failed": "the contact forces of closed gaps are not determined, or an event makes a gap negative",
    "not connected": "no attempt found a motion from the given points to their targets",
    "accuracy not reached": "the equations hold, but no grid was found on which their solution is as accurate as asked",
    "inaccurate": "the driver claimed success, but the residuals evaluated afterwards are too large",
}
"""Every termination status and its meaning; all except the first are failures."""


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of a solution with respect to one quantity, in the units of the problem.

    Attributes
    ----------
    cost : float
        Derivative of the optimal cost.
    durations : ndarray, shape (D,)
        Derivatives of the durations of all phases.
    free : dict of str to float
        Derivatives of the optimal free parameters, by the name of the free parameter.
    t, q, p, u, multipliers : ndarray
        Derivatives of the arrays of the result, with the same shapes. `q` and `p` are derivatives of the values at the
        nodes, whose times change by `t`.
    unknowns : ndarray, shape (n,)
        Derivatives of all unknowns.
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
    """The derivatives of a solution with respect to parameters, boundary values and a given duration.

    Keys are names such as `m`, `start.x` and `duration`, and values are `Derivatives`. If the problem defines boundary
    values or the duration by formulas of parameters, they change with these parameters, as in a sweep. The set of
    active bounds is kept.

    Attributes
    ----------
    names : tuple of str
        Names of the m quantities with respect to which derivatives are taken.
    costs : ndarray, shape (m,)
        Derivatives of the cost in the order of `names`.
    reason : str
        Reason for missing derivatives; empty if they exist.
    doubtful : tuple of str
        Unknowns for which strict complementarity fails. A change of a quantity then changes the set of active bounds,
        and derivatives are one-sided.
    inaccuracy : float
        Residual of the linear equations for the derivatives, relative to the size of their terms.
    """

    names: tuple[str, ...]
    costs: Vector
    reason: str
    doubtful: tuple[str, ...]
    inaccuracy: float
    _by_name: Mapping[str, Derivatives] = field(repr=False)

    def __getitem__(self, name: str) -> Derivatives:
        """Return the derivatives with respect to a quantity.

        Raises NumericsError if the solution has no derivatives, and KeyError for an unknown name.
        """
        if self.reason and name in self.names:
            raise NumericsError(f"there are no derivatives by {name}: {self.reason}", "see its reason")
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        """Return an iterator over the names of the quantities."""
        return iter(self.names)

    def __len__(self) -> int:
        """Return the number of quantities."""
        return len(self.names)

    @property
    def notes(self) -> list[str]:
        """Warnings for the user, one line each."""
        notes = [f"no sensitivities: {self.reason}"] if self.reason else []
        if self.doubtful:
            names, rest = ", ".join(self.doubtful[:_NAMED]), len(self.doubtful) - _NAMED
            more = f" and {rest} more" if rest > 0 else ""
            notes.append(f"sensitivities may be one-sided: strict complementarity fails for {names}{more}")
        if not self.reason and self.inaccuracy > INACCURATE:
            notes.append(f"sensitivities are inaccurate: {self.inaccuracy:.0e} of their linear equations is left")
        return notes


Watch: TypeAlias = Callable[[int, tuple[float, ...]], None]
"""A function that a driver calls at every iterate with the number of the iterate and its row of the log."""


@dataclass(frozen=True)
class Run:
    """The request to a driver: the grid, the initial guess and the limits of one solve.

    A simulation stores every `every`-th step. `guess` (n,) is the initial guess of an optimisation; None means the
    guess of the problem. `near` is True if `guess` is close to the solution. `points` belong to a connect problem. If
    `tolerance` or `max_iterations` is None, the default of the driver applies. `time_limit` is in seconds. `watch` is
    called at every iterate. If `scaling` is "none", an optimiser works in the units of the problem. `grid` has the
    lengths of the intervals relative to the duration, with the shape (N,), or (phases, N) for each phase; None means
    equal intervals.
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
class EventRecord:
    """An event of a motion: its name, its effect, its time, and the states (q, p) before and after it."""

    name: str
    action: EventAction
    t: float
    before: Vector
    after: Vector


@dataclass(frozen=True, eq=False)
class MotionEvents(Sequence[EventRecord]):
    """The M events of a motion in the order of time, as a sequence of `EventRecord`.

    Attributes
    ----------
    names : tuple of str
        The name of each event. Impacts, and the beginning and end of a contact, have the name of their gap.
    actions : tuple of EventAction
        The effect of each event.
    t : ndarray, shape (M,)
        Times.
    before, after : ndarray, shape (M, state)
        States (q, p) before and after the events.
    """

    names: tuple[str, ...]
    actions: tuple[EventAction, ...]
    t: Vector
    before: Matrix
    after: Matrix

    @overload
    def __getitem__(self, index: int) -> EventRecord: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[EventRecord]: ...

    def __getitem__(self, index: int | slice) -> EventRecord | Sequence[EventRecord]:
        """Return an event by its number, or several events."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        values = self.names[index], self.actions[index], float(self.t[index])
        return EventRecord(*values, self.before[index], self.after[index])

    def __len__(self) -> int:
        """Return the number of events."""
        return len(self.names)

    def times(self, name: str, action: str = "") -> Vector:
        """Return the times of the events with a name, and with an action such as "impact" if one is given."""
        pairs = zip(self.names, self.actions, strict=True)
        return self.t[[own == name and action in ("", effect) for own, effect in pairs]]


@dataclass(frozen=True)
class ConnectAttempt:
    """The attempt of a driver at a connect problem, before its residuals are checked.

    `path` (N + 1, 2, n, d) has the positions and momenta of n particles in d dimensions at the nodes. `attempts`
    describes the initial guesses that were tried. `tangents` is the number of tangent vectors that were propagated.
    `generated` is True if the driver is the generated solver.
    """

    status: str
    message: str
    iterations: int
    path: Matrix
    tolerance: float
    attempts: tuple[str, ...] = ()
    tangents: int = 0
    generated: bool = False


@dataclass(frozen=True)
class ControlAttempt:
    """The attempt of a driver at an optimal-control problem, before its residuals are checked.

    The driver promises residuals below `tolerance`. It may add `trajectories`, the arrays t, q, p, u and multipliers,
    and `scaled`, the grid with the scaling factors at the initial guess. `is_explained` is True if `message` already
    names the cause of a failure. `generated` is True if the driver is the generated solver.
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
    """The attempt of a driver at a simulation, before its residuals are checked; arrays have a row per stored step.

    `steps` is the number of computed steps. `generated` is True if the driver is the generated solver. `events` are the
    events, or None for a problem without events.
    """

    status: str
    message: str
    iterations: int
    t: Vector
    q: Matrix
    p: Matrix
    energy: Vector | None
    steps: int
    residual: float
    tolerance: float
    events: EventArrays | None = None
    generated: bool = False


Attempt: TypeAlias = ConnectAttempt | ControlAttempt | SimulateAttempt


@dataclass(frozen=True)
class Outline:
    """The part of a result that sweeps store.

    `arrays` has the arrays of the result by name, and `free` the values of free parameters by name. `unknowns` (n,) are
    stored for warm starts.
    """

    status: str
    message: str
    cost: float | None
    residual: float
    arrays: dict[str, Matrix]
    unknowns: Vector | None
    free: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class GridLevel:
    """The solve on one grid of a refinement: number of intervals of each phase, status, and estimated error."""

    intervals: int
    status: str
    error: float
    iterations: int
    seconds: float = field(compare=False)


@dataclass(frozen=True)
class Accuracy:
    """The outcome of a solve with a requested accuracy, which refines the grid repeatedly.

    `request` is the requested and `estimate` the estimated relative error. The error is largest for `quantity` at
    `time`. `reason` states why the accuracy was not reached, and is otherwise empty. `levels` are the solves on all
    grids, in order.
    """

    request: float
    estimate: float
    quantity: str
    time: float
    reason: str
    levels: tuple[GridLevel, ...]


@dataclass(frozen=True)
class DiscretisationError:
    """The estimated distance of a solution from the solution of the continuous problem.

    `states` is the largest error of a state or free parameter, relative to the largest value of the same quantity.
    This error occurs for `quantity` at `time`. `cost` is the error of the cost relative to the cost, None for a
    simulation.
    """

    states: float
    cost: float | None
    quantity: str
    time: float

    @property
    def is_large(self) -> bool:
        """True if the error is so large that the user is warned."""
        return max(self.states, self.cost or 0.0) > LARGE_ERROR

    @property
    def note(self) -> str:
        """The warning for the user, with the remedy."""
        states = (
            f"the estimated error of the discretisation is {100.0 * self.states:.2g} % of {self.quantity} at t = "
            f"{self.time:.4g}"
        )
        cost = "" if self.cost is None else f", and {100.0 * self.cost:.2g} % of the cost"
        return f"{states}{cost}: take more --steps, or --accuracy"


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Result(Display):
    """A solution with its residuals.

    `result["theta"]` and `result.theta` return the column of `q`, `p` or `u` with the name "theta".

    Attributes
    ----------
    status, message : str
        Termination status and its explanation; `solved` is True for the status "solved".
    cost : float or None
        Cost of an optimisation, None for a simulation.
    residual, stationarity : float
        Max-norm of all discrete equations, and of the optimality conditions. Both are evaluated independently of the
        driver.
    iterations : int
        Iterations of the last run.
    t, q, p : ndarray, shapes (M + 1,), (M + 1, coordinates)
        Times, coordinates (or states) and momenta at the nodes.
    u : ndarray or None
        Controls, with a row for each entry of `control_times`; None for a simulation.
    multipliers, energy, log, unknowns : ndarray or None
        Multipliers of the equations of motion; energy at the nodes; table of the iterates, with a row for each; vector
        of all unknowns (n,), for a warm start.
    names, units : dict
        Names of the columns of `q`, `p` and `u`; units of columns, `t`, `cost` and `energy` by name.
    summary, labels : dict
        Further numbers by name; texts that tables print for these names, see `label`.
    parameters : dict
        Parameter overrides of the solve.
    seconds_solve, seconds_code : float
        Time of the fastest run; time for compiling machine code, or for reading it from the disk.
    compiled : bool
        True if machine code was compiled.
    attempts, notes : tuple of str
        Descriptions of the initial guesses that were tried; warnings about the solution.
    levels : tuple of Result
        Results on all grids of a refinement.
    stage_abscissae : tuple of float
        Positions of the stages as fractions of an interval; empty if controls are not at stages.
    events : MotionEvents or None
        Events of a simulation in the order of time; None for a problem without events.
    attitudes : tuple of str
        Names of the attitudes; `result["R"]` are their matrices.
    grid : ndarray or None
        Lengths of the intervals relative to the duration, or for each phase; None for equal intervals.
    accuracy, error, estimates, sensitivity
        Outcome of a solve with a requested accuracy; estimated discretisation error; standard errors of free
        parameters; derivatives of the solution, which the method `sensitivities` returns.
    gaps : dict
        Gaps (N,) at the ends of all intervals by name, for a problem with contact forces.
    by_segments : Result or None
        For a problem with delays, the same result with separate columns for each segment.
    background : Background or None
        Module and problem, which figures need.
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
    t: Vector
    q: Matrix
    p: Matrix
    u: Matrix | None = None
    multipliers: Matrix | None = None
    energy: Vector | None = None
    log: Matrix | None = None
    unknowns: Vector | None = None
    names: dict[str, tuple[str, ...]]
    summary: dict[str, float]
    labels: Mapping[str, str] = field(default_factory=dict, compare=False)
    units: Mapping[str, str] = field(default_factory=dict, compare=False)
    parameters: Mapping[str, float] = field(default_factory=dict)
    seconds_solve: float = field(default=float("nan"), compare=False)
    seconds_code: float = field(default=float("nan"), compare=False)
    compiled: bool = field(default=False, compare=False)
    attempts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    levels: tuple[Result, ...] = ()
    stage_abscissae: tuple[float, ...] = ()
    events: MotionEvents | None = None
    attitudes: tuple[str, ...] = ()
    grid: Vector | None = None
    accuracy: Accuracy | None = None
    error: DiscretisationError | None = None
    estimates: Estimates | None = None
    gaps: Mapping[str, Vector] = field(default_factory=dict)
    by_segments: Result | None = None
    sensitivity: Sensitivities | None = None
    background: Background | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        cost = "" if self.cost is None else f", cost={self.cost:.6g}"
        return f"Result({self.problem!r}, {self.status!r}{cost}, steps={self.steps}, iterations={self.iterations})"

    def sensitivities(self) -> Sensitivities:
        """Return the derivatives with respect to parameters, boundary values and a given duration.

        Returns
        -------
        Sensitivities
            `result.sensitivities()["start.x"].cost` is the derivative of the cost with respect to a boundary value.
            `result.sensitivities()["start.x"].q` is the derivative of `q`, and has the shape of `q`.

        Raises
        ------
        ArgumentError
            If the solve did not have the option `sensitivities=True`.
        """
        if self.sensitivity is None:
            raise ArgumentError("this result has no sensitivities", "solve with sensitivities=True")
        return self.sensitivity

    def unit_of(self, entry: str) -> str:
        """Return the unit of an entry of the summary, or of a value such as `start.x`; empty if no unit is declared."""
        of_time = {"duration": "t", "energy_drift": "energy", "energy_change": "energy"}
        name = of_time.get(entry, entry.removeprefix("final_").removeprefix("start.").removeprefix("end."))
        return self.units.get(name, "")

    def label(self, entry: str) -> str:
        """Return the text that tables print for an entry of the summary.

        Names from the problem are unchanged. In other entries blanks replace underscores.
        """
        return self.labels.get(entry, entry.replace("_", " "))

    @property
    def solved(self) -> bool:
        """True if the status is "solved"."""
        return self.status == "solved"

    @property
    def control_times(self) -> Vector:
        """Times of the rows of `u`: nodes, stages of all intervals, or midpoints of intervals."""
        assert self.u is not None, "a simulation has no controls"
        if not self.stage_abscissae and len(self.u) == self.t.size:
            return self.t
        abscissae = np.array(self.stage_abscissae or (0.5,))
        return np.asarray((self.t[:-1, None] + np.diff(self.t)[:, None] * abscissae).ravel())

    def controls_at(self, times: Vector) -> Matrix:
        """Return the controls at any times.

        Parameters
        ----------
        times : array_like, shape (T,)
            Times in the unit of `t`.

        Returns
        -------
        ndarray, shape (T, controls)
            Controls are constant on intervals, linear between nodes, or polynomials through the values at the stages
            of an interval. At an abscissa with several stages the polynomial has the mean of their values.
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
        weights = np.ones((times.size, abscissae.size))
        for i, abscissa in enumerate(abscissae):
            for other in abscissae[abscissae != abscissa]:
                weights[:, i] *= (fractions - other) / (abscissa - other)
        return np.asarray(np.einsum("ti,tij->tj", weights, values[interval]))

    @property
    def intervals(self) -> str:
        """The number of steps as text: `20 steps`, or `2 x 20 steps` in two phases."""
        phases = (self.t.size - 1) // self.steps  # zero for a simulation that did not store every step
        return f"{phases} x {self.steps} steps" if phases > 1 else f"{self.steps} steps"


def outline_of(result: Result) -> Outline:
    """Return the part of a result that sweeps store."""
    named = {name: getattr(result, name) for name in ("t", "q", "p", "u", "multipliers", "energy")}
    arrays = {name: array for name, array in named.items() if array is not None}
    return Outline(result.status, result.message, result.cost, result.residual, arrays, result.unknowns)


def origin(metadata: Record, driver: str, run: Run, attempt: Attempt, seconds: float) -> dict[str, Any]:
    """Return the arguments of a Result that do not depend on the task."""
    texts = {name: str(getattr(metadata, name)) for name in ("problem", "title", "task", "method", "scheme")}
    numbers = {"steps": run.steps, "iterations": attempt.iterations, "seconds_solve": seconds}
    attitudes = tuple(metadata.attitudes)
    return {**texts, "driver": driver, **numbers, "units": component_units(metadata), "attitudes": attitudes}


def contradicted(driver: str, finding: str, remedy: str) -> tuple[str, str]:
    """Return the status and the message for a driver that reports success although equations are violated.

    `finding` states which equations are violated.
    """
    return "inaccurate", f"{driver} reported success, but {finding}; {remedy}"


def other_driver(attempt: Attempt) -> str:
    """Return the text of the remedy if a driver reports success although equations are violated."""
    return "try more steps, or another guess" if attempt.generated else "try more steps, or driver newton"


def max_norm(values: Vector) -> float:
    """Return the max-norm of an array: 0 if it is empty, and infinity if an entry is not finite."""
    if values.size == 0:
        return 0.0
    norm = float(np.abs(values).max())
    return norm if math.isfinite(norm) else math.inf


def component_names(metadata: Record) -> dict[str, tuple[str, ...]]:
    """Return the names of the columns of q, p and u; for several bodies each name ends with the number of the body."""
    coordinates = tuple(metadata.coordinates)
    if metadata.form == Form.HAMILTONIAN:
        momenta = tuple(metadata.rates)
    else:
        momenta = () if metadata.form == Form.FIRST_ORDER else tuple(f"p_{name}" for name in coordinates)
    names = {"q": coordinates, "p": momenta, "u": tuple(metadata.control_names)}
    bodies = metadata.bodies
    if bodies == 1:
        return names
    return {key: tuple(f"{name}_{body}" for body in range(bodies) for name in row) for key, row in names.items()}


def component_units(metadata: Record) -> dict[str, str]:
    """Return the declared units of columns and other quantities by name."""
    units: dict[str, str] = dict(metadata.units)
    if units and metadata.bodies > 1:
        for row in component_names(replace(metadata, bodies=1)).values():
            units |= {f"{name}_{body}": units[name] for name in row for body in range(metadata.bodies) if name in units}
    return units


def notes_of_parts(result: Result) -> list[str]:
    """Return the warnings about the estimates and the sensitivities of a result."""
    return [note for part in (result.estimates, result.sensitivity) if part is not None for note in part.notes]
