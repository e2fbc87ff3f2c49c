"""The motion from an initial state: checks of arguments, steps, and quantities of the stored states.

The functions from `path_residual` on evaluate single steps, for root finders and other programs.
"""

from typing import NamedTuple

import numpy as np

from codegen.runtime.search.grid import checked_count, checked_times, checked_tolerance
from codegen.runtime.stepping.contacts import NO_CONTACT
from codegen.runtime.stepping.events import (
    ACCUMULATED,
    FULL,
    MOST_EVENTS,
    STOPPED,
    VIOLATED,
    Watched,
    enlarged,
    follow_watched,
    least_gaps,
    residual_with_events,
    room_for,
)
from codegen.runtime.stepping.problem import StepProblem
from codegen.runtime.stepping.steps import (
    EQUAL,
    LEFT_TABLE,
    energies,
    largest_constraints,
    largest_residual,
    make_step,
    memory_for,
)
from codegen.runtime.tabulated import table_numbers

CONSISTENT = 1e-10  # accuracy of constraints at the start, relative to their terms
LEAST_LENGTH = 1e-6  # least size of coordinates in these terms
DEPENDENT, NEARLY = 1e-10, 1e-3  # limits of singular gradients at the start, and after a failed step
AWAY, INVOLVED = 0.1, 1e-6  # relative distance of a regular point; least weight of a constraint in a dependence
HALVINGS = 30  # of a failed step, whose longest part is sought
TOLERANCE, MOST = 1e-13, 50  # defaults of Newton's method: relative size of the last correction, number of iterations
FAILURES = {
    -1: ("non-finite", "a state is infinite or not a number; use more steps, or check start and parameters"),
    -2: ("singular", "the equations of the step have no unique solution; use more steps, or check the parameters"),
    -3: ("newton failed", "Newton's method did not converge; use more steps, or raise max_iterations"),
    -4: ("outside a table", "{}; keep the motion inside, take a wider table, or give it outside='clamp' or 'extend'"),
}

EVENT_FAILURES = FAILURES | {
    ACCUMULATED: (
        "events accumulate",
        "event {!r} returns without end near t = {:.10g}; end the motion there, or write an impact as unilateral",
    ),
    NO_CONTACT: (
        "contact failed",
        "the contact forces are not determined, last of {!r} at t = {:.12g}; use more steps, or fewer gaps",
    ),
    VIOLATED: (
        "contact failed",
        "the change of event {!r} at t = {:.12g} makes a gap negative; give new values in `then` that keep every gap",
    ),
}
FIRST_ROWS = 2 * MOST_EVENTS  # of the log of events


class Grid(NamedTuple):
    """N steps of mean length h, parameters, the initial state (state,), the accuracy of implicit steps, the problem.

    `spans` (N, 2) are the time at the start and the length of each step; without rows all steps have the length h.
    """

    steps: int
    h: float
    parameters: np.ndarray
    start: np.ndarray
    tolerance: float
    max_iterations: int
    problem: StepProblem
    spans: np.ndarray = EQUAL


class EventLog(NamedTuple):
    """The M events of a motion in the order of time.

    Attributes
    ----------
    number, action : array (M,)
        Number of the event among all events and gaps, and number of its effect in the order of `record.EventAction`.
    t : array (M,)
        Times.
    before, after : array (M, state)
        States before and after the event.
    """

    number: np.ndarray
    action: np.ndarray
    t: np.ndarray
    before: np.ndarray
    after: np.ndarray


class Solution(NamedTuple):
    """The motion; arrays have a row for each of the M stored states: the first, every `every`-th, and the last.

    Attributes
    ----------
    status : str
        "solved", or the reason why a step failed.
    message : str
        A sentence that names the failed step and a remedy, or the number of steps.
    steps : int
        Number of steps made.
    t : array (M,)
        Times.
    q, p : array (M, coordinates)
        Positions and momenta. For first-order dynamics `q` has the states, and `p` has no columns. The same holds for
        the coordinates of a Lagrangian that is linear in the velocities.
    energy : array (M,) or None
        The Hamiltonian; None for first-order dynamics.
    residual : float
        Max-norm of the equations of the scheme, evaluated again for the step to each stored state. With `every` 1 these
        are all steps. A last state that was stored because the next step failed is left out. NaN if no step was made.
    iterations : int
        Number of linear systems solved.
    events : EventLog or None
        The events; None for a problem without events.
    """

    status: str
    message: str
    steps: int
    t: np.ndarray
    q: np.ndarray
    p: np.ndarray
    energy: np.ndarray | None
    residual: float
    iterations: int
    events: EventLog | None = None


def checked_step_grid(problem, steps, duration, parameters, start, tables=None, grid=None):
    """Return a Grid; ValueError if a number is not finite or not positive, or a shape does not fit.

    `tables` maps names of tables to new numbers, with as many breakpoints as before. `grid` (N,) are the lengths of N
    steps relative to the duration, or None for equal steps.
    """
    steps, duration = checked_times(steps if grid is None else len(grid), duration)
    numbers = table_numbers(problem, tables) if problem.tables else ()
    parameters, start = np.array([*parameters, *numbers], dtype=float), np.array(start, dtype=float)
    if start.shape != (problem.state,):
        order = "first positions, then momenta" if problem.positions < problem.state else "all states"
        raise ValueError(f"start has shape {start.shape}, expected ({problem.state},): {order}")
    require_finite(parameters, start)
    spans = EQUAL if grid is None else checked_spans(grid, duration)
    return Grid(steps, duration / steps, parameters, start, TOLERANCE, MOST, problem, spans)


def checked_spans(fractions, duration):
    """Return the time at the start and the length (N, 2) of steps that are fractions (N,) of the duration.

    Raise ValueError unless the fractions are positive numbers whose sum is one.
    """
    fractions = np.array(fractions, dtype=float)
    if fractions.ndim != 1 or not (fractions > 0.0).all() or not abs(fractions.sum() - 1.0) <= 1e-6:
        raise ValueError(f"grid must hold positive fractions whose sum is one, got {fractions!r}")
    ends = np.cumsum(fractions)
    return duration / ends[-1] * np.column_stack([ends - fractions, fractions])


def require_finite(parameters, start):
    """Raise ValueError if a parameter or a number of the initial state is not finite."""
    for name, values in (("parameters", parameters), ("start", start)):
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite, got {values}")


def start_values(prescribed, start):
    """Return the values at the start: those in `prescribed`, by name, replaced by those in `start`.

    ValueError if `start` has a name that is not prescribed.
    """
    for quantity, value in (start or {}).items():
        if quantity not in prescribed:
            raise ValueError(f"{quantity!r} is not prescribed at the start; prescribed: {', '.join(prescribed)}")
        prescribed[quantity] = float(value)
    return prescribed.values()


def follow_motion(grid, every=1, tolerance=TOLERANCE, max_iterations=MOST):
    """Make all steps and return a Solution; a step that fails ends the motion without an error.

    Parameters
    ----------
    grid : Grid
        Steps, their length, parameters, the initial state and the problem.
    every : int
        Every `every`-th state is stored, and the first and the last.
    tolerance : float
        Size of a Newton correction, relative to each unknown, after which a step is accepted.
    max_iterations : int
        Largest number of Newton corrections of each part of a step.

    Raises
    ------
    ValueError
        If an argument is unusable.
    """
    grid = grid._replace(
        tolerance=checked_tolerance(tolerance, 1e-6), max_iterations=checked_count("max_iterations", max_iterations)
    )
    problem, (steps, h, parameters, start) = grid.problem, grid[:4]
    if problem.constraints is not None:
        require_constraints(grid)
    every, size = min(checked_count("every", every), steps), start.size
    if problem.events is not None:
        return follow_with_events(grid, every)
    path = np.empty((1 - (-steps // every), size))
    before = path if every == 1 else np.empty((path.shape[0] - 1, size))
    accuracy, memory = (grid.tolerance, grid.max_iterations), memory_for(problem.scheme)
    spans, states = grid.spans, (path, before)
    made, rows, iterations, outcome = problem.follow(start, steps, h, parameters, *accuracy, every, *states, spans)
    t, energy = times_at(grid, np.minimum(every * np.arange(rows), made)), None
    if problem.energy is not None:
        energy = np.empty(rows)
        energies(problem.energy.address, path, t, parameters, energy)
    measured = rows if outcome == 0 else 1 + made // every
    scheme = problem.scheme if len(spans) == 0 else problem.scheme._replace(is_constant=0)
    residual = largest_residual(scheme, memory, before, path, measured, made, h, parameters, *accuracy, every, spans)
    failed = times_at(grid, np.minimum([made, made + 1], steps))
    status, message = describe(steps, failed, made, iterations, outcome)
    if outcome == LEFT_TABLE:
        message = message.format(range_left(grid, path[rows - 1], times_at(grid, made)))
    if outcome < 0 and problem.constraints is not None:
        reached = longest_part(grid, path[rows - 1], times_at(grid, made))
        if names := dependent_constraints(grid, *reached, NEARLY):
            message += f"; {names} there"
    positions = problem.positions
    q, p = path[:rows, :positions].copy(), path[:rows, positions:].copy()
    return Solution(status, message, made, t, q, p, energy, residual if made else np.nan, iterations)


def follow_with_events(grid, every):
    """Make all steps with events, and return a Solution; arguments are those of `follow_motion`, checked."""
    problem, (steps, h, parameters, start) = grid.problem, grid[:4]
    watched = watched_of(problem, grid.tolerance, grid.max_iterations)
    size, scheme = start.size, problem.scheme._replace(is_constant=0)
    require_gaps(grid, watched)
    path = np.empty((1 - (-steps // every), size))
    before = path if every == 1 else np.empty((path.shape[0] - 1, size))
    (room, arrays), memory = room_for(watched, problem.rules, FIRST_ROWS), memory_for(scheme)
    arrays["now"][:] = start
    progress, marks, outcome = np.array([0, 1, every, 0, 0, 1, 0, 0]), np.zeros(steps, np.int64), FULL
    while outcome == FULL:
        outcome = follow_watched(
            scheme, watched, memory, room, progress, steps, h, parameters, every, path, before, grid.spans, marks
        )
        if outcome == FULL:
            room = enlarged(arrays, size)
    made, rows, _, iterations, logged = map(int, progress[:5])
    numbers, times, states = (arrays[name][:logged].copy() for name in ("rows", "times", "states"))
    t = times_at(grid, np.minimum(every * np.arange(rows), made))
    if outcome == STOPPED:
        t[-1] = times[-1, 2]
    log = EventLog(numbers[:, 0], numbers[:, 1], times[:, 2], states[:, 1], states[:, 2])
    energy = None
    if problem.energy is not None:
        energy = np.empty(rows)
        energies(problem.energy.address, path, t, parameters, energy)
    residual = residual_with_events(
        scheme, watched, memory, room, progress, h, parameters, every, path, before, grid.spans, marks
    )
    failed = times_at(grid, np.minimum([made, made + 1], steps))
    status, message = describe(steps, failed, made, iterations, min(outcome, 0), EVENT_FAILURES)
    names = (*problem.metadata.events, *problem.metadata.gaps)
    if outcome == STOPPED:
        message = stop_message(names[log.number[-1]], t[-1], made, steps)
    elif outcome in (ACCUMULATED, NO_CONTACT, VIOLATED):
        message = message.format(*((names[log.number[-1]], log.t[-1]) if logged else (names[-1], 0.0)))
    if outcome == LEFT_TABLE:
        message = message.format(range_left(grid, path[rows - 1], times_at(grid, made)))
    positions = problem.positions
    q, p = path[:rows, :positions].copy(), path[:rows, positions:].copy()
    return Solution(status, message, made, t, q, p, energy, residual if made else np.nan, iterations, log)


def gap_values(grid, path, times):
    """Return the least value of all gaps along a `path` (M, size) at `times` (M,)."""
    watched = watched_of(grid.problem)
    least = np.empty(watched.gaps)
    least_gaps(watched, np.ascontiguousarray(path, dtype=float), np.array(times, dtype=float), grid.parameters, least)
    return float(least.min())


def watched_of(problem, tolerance=TOLERANCE, most=MOST):
    """Return the events of a problem for compiled code."""
    count = len(problem.metadata.events)
    kernels = (0 if kernel is None else kernel.address for kernel in (problem.events, problem.jumps, problem.normals))
    gaps, changes = len(problem.rules) - count, int((problem.rules[:, 2] >= 0).sum())
    return Watched(*kernels, count, gaps, changes, problem.state, 3 + problem.state, most, tolerance)


def require_gaps(grid, watched):
    """Raise ValueError if a gap is negative at the start, if it closes there, or for a wrong restitution."""
    if not watched.gaps:
        return
    values = np.empty((watched.events + watched.gaps, 3))
    grid.problem.events(grid.start, 0.0, grid.parameters, values)
    normals = np.empty((watched.gaps, 3 + grid.start.size))
    grid.problem.normals(grid.start, 0.0, grid.parameters, normals)
    for name, (value, rate, scale), (_, restitution, speed) in zip(
        grid.problem.metadata.gaps, values[watched.events :], normals[:, :3], strict=True
    ):
        if not 0.0 <= restitution <= 1.0:
            raise ValueError(f"the restitution of {name} is {restitution:g}; give a number from 0 to 1")
        if value < -CONSISTENT * max(scale, LEAST_LENGTH):
            raise ValueError(f"start violates {name}: the gap is {value:g}; correct the start, or the parameters")
        if value <= CONSISTENT * scale and rate < -CONSISTENT * speed:
            raise ValueError(f"start closes {name} with the velocity {rate:g}; start before the impact, or after it")


def constraint_values(grid, state, t=0.0):
    """Return the constraints at `state` as an array (constraints, 3 + coordinates).

    The columns are value, rate, scale of the rate, and gradient. A rolling constraint A v + b has the value zero, the
    rate A v + b and the gradient A.
    """
    values = np.zeros((len(grid.problem.metadata.constraints), 3 + grid.problem.state // 2))
    if grid.problem.constraints is not None:
        grid.problem.constraints(np.array(state, dtype=float), float(t), grid.parameters, values.reshape(-1))
    return values


def constraint_errors(grid, path, times):
    """Return the largest modulus of each constraint and of its rate (2, constraints) along `path` (M, size)."""
    path, times = np.ascontiguousarray(path, dtype=float), np.ascontiguousarray(times, dtype=float)
    constraints, count = grid.problem.constraints, len(grid.problem.metadata.constraints)
    return largest_constraints(constraints.address, count, path, times, grid.parameters)


def require_constraints(grid):
    """Raise ValueError if the start violates a constraint or its rate, or if constraints depend on each other there."""
    largest = max(LEAST_LENGTH, np.abs(grid.start[: grid.problem.state // 2]).max(initial=0.0))
    rows = zip(grid.problem.metadata.constraints, constraint_values(grid, grid.start), strict=True)
    for name, (value, rate, scale, *gradient) in rows:
        if not abs(value) <= CONSISTENT * np.abs(gradient).sum() * largest:
            raise ValueError(f"the start violates the constraint {name} = 0, whose value is {value:.6g}")
        if not abs(rate) <= CONSISTENT * scale:
            kind, word = ("rolling ", "value") if name in grid.problem.metadata.rolling else ("", "rate")
            raise ValueError(
                f"the velocities at the start violate the {kind}constraint {name} = 0, whose {word} is {rate:.6g}"
            )
    if names := dependent_constraints(grid, grid.start, 0.0, DEPENDENT):
        raise ValueError(f"the start does not determine the constraint forces: {names}")


def dependent_constraints(grid, state, t, limit):
    """Return a text on the constraints whose gradients at `state` vanish or depend on each other, or "".

    A gradient vanishes if its length is below `limit` times its length at a point away from the start. Gradients of
    length one are dependent if their matrix has a singular value below `limit`.
    """
    names, half = grid.problem.metadata.constraints, grid.problem.state // 2
    gradients = constraint_values(grid, state, t)[:, 3:]
    if not names or not np.isfinite(gradients).all():
        return ""
    away = grid.start.copy()
    away[:half] += AWAY * (np.abs(away[:half]).max() or 1.0) * np.linspace(0.5, 1.0, half)
    lengths, typical = (np.linalg.norm(g, axis=1) for g in (gradients, constraint_values(grid, away, t)[:, 3:]))
    for name, length, usual in zip(names, lengths, typical, strict=True):
        if not length > limit * usual:
            return f"the gradient of the constraint {name} = 0 vanishes"
    left, singular, _ = np.linalg.svd(gradients / lengths[:, None])
    if len(names) <= half and singular[-1] > limit:
        return ""
    involved = [f"{name} = 0" for name, weight in zip(names, left[:, -1], strict=True) if abs(weight) > INVOLVED]
    return f"the constraints {' and '.join(involved)} depend on each other"


def longest_part(grid, state, t):
    """Return the state at the end of the longest part of a step from `state` that can be made, and its time."""
    reached, done, failed, length = state, 0.0, 1.0, length_at(grid, t)
    for _ in range(HALVINGS):
        part = 0.5 * (done + failed)
        outcome, interval, _ = _made(grid._replace(h=part * length, spans=EQUAL), state, t)
        if outcome >= 0 and np.isfinite(interval).all():
            reached, done = interval[grid.problem.stages :], part
        else:
            failed = part
    return reached, t + done * length


def describe(steps, failed, made, iterations, outcome, failures=FAILURES):
    """Return the status and a sentence on how the motion of `steps` steps ended, after `made` steps.

    `failed` are the times at both ends of the next step, which has failed unless the outcome is 0. `failures` maps each
    negative outcome to a status and a remedy.
    """
    if outcome == 0:
        effort = f" with {iterations / made:.2f} iterations each" if iterations else ""
        return "solved", f"all {made} steps were made{effort}"
    status, remedy = failures[outcome]
    where = f"step {made + 1} of {steps}, from t = {failed[0]:g} to {failed[1]:g}"
    return status, f"{status} in {where}: {remedy}"


def stop_message(name, t, made, steps):
    """Return a sentence on an event that ended the motion of `steps` steps in step `made`."""
    return f"event {name!r} ended the motion at t = {t:.12g}, in step {made} of {steps}"


def path_residual(grid, path):
    """Return the max-norm of the equations of the scheme along consecutive states `path` (M, size)."""
    path, accuracy = np.array(path, dtype=float), (grid.tolerance, grid.max_iterations)
    count, scheme, h = path.shape[0], grid.problem.scheme, grid.h
    if len(grid.spans):
        scheme = scheme._replace(is_constant=0)
    memory = memory_for(scheme)
    return largest_residual(scheme, memory, path, path, count, count, h, grid.parameters, *accuracy, 1, grid.spans)


def times_at(grid, numbers):
    """Return the times of nodes by their numbers, a number or an array."""
    if len(grid.spans) == 0:
        return grid.h * numbers
    return np.append(grid.spans[:, 0], grid.h * grid.steps)[numbers]


def length_at(grid, t):
    """Return the length of the step that starts at time t."""
    return grid.spans[np.abs(grid.spans[:, 0] - t).argmin(), 1] if len(grid.spans) else grid.h


def step(grid, state, t=0.0):
    """Return the state (size,) one step after `state`; NaN if the equations of the step are not solved."""
    outcome, interval, _ = _made(grid, np.array(state, dtype=float), t)
    return interval[grid.problem.stages :] if outcome >= 0 else np.full(grid.problem.state, np.nan)


def range_left(grid, state, t):
    """Return a text that names the input furthest outside the range of its table, in the step from `state` (size,).

    The text is "" if all inputs stay in their ranges.
    """
    outcome, _, inputs = _made(grid, np.array(state, dtype=float), t)
    if outcome != LEFT_TABLE:
        return ""
    ends, names = grid.parameters[grid.problem.ranges], grid.problem.range_names
    excess = np.maximum(ends[:, 0] - inputs[:, 0], inputs[:, 1] - ends[:, 1]) / (ends[:, 1] - ends[:, 0])
    j = int(np.argmax(excess))
    value = inputs[j, 0] if inputs[j, 0] < ends[j, 0] else inputs[j, 1]
    return f"{names[j]} is {value:g}, outside {ends[j, 0]:g} to {ends[j, 1]:g}"


def first_outside(grid, path):
    """Return the number of the first step along consecutive states `path` (M, size) that leaves a table, and a text.

    The text names the input. The result is 0 and "" if no step leaves a table. The inner stages are computed by the
    scheme from each state.
    """
    for k in range(len(path) - 1 if grid.problem.inputs else 0):
        message = range_left(grid, path[k], times_at(grid, k))
        if message:
            return k + 1, message
    return 0, ""


def _made(grid, state, t):
    """Make a step from `state` at time t; return the outcome, the interval, and the extreme inputs of tables.

    The outcome is the number of iterations, or negative after a failure. `steps.make_step` explains the arrays.
    """
    problem, interval = grid.problem, np.empty(grid.problem.stages + grid.problem.state)
    inputs, accuracy = np.empty((len(problem.ranges), 2)), (grid.tolerance, grid.max_iterations)
    outcome = make_step(
        problem.scheme, memory_for(problem.scheme), state, float(t), length_at(grid, t), grid.parameters, *accuracy,
        interval, inputs,
    )  # fmt: skip
    return outcome, interval, inputs


def predict(grid, state, t=0.0):
    """Return an initial guess (unknowns,) of the unknowns of a step from `state` (size,)."""
    unknowns = np.empty(grid.problem.unknowns)
    grid.problem.predict(np.array(state, dtype=float), t, lengths(grid, t), grid.parameters, unknowns)
    return unknowns


def residual(grid, unknowns, state, t=0.0):
    """Return the residual (unknowns,) of the equations of a step from `state` (size,).

    Quantities that follow explicitly from the unknowns are eliminated from these equations.
    """
    values, unknowns = np.empty(grid.problem.unknowns), np.array(unknowns, dtype=float)
    grid.problem.residual(unknowns, np.array(state, dtype=float), t, lengths(grid, t), grid.parameters, values)
    return values


def jacobian(grid, unknowns, state, t=0.0):
    """Return the Jacobian (unknowns, unknowns) of `residual` with respect to the unknowns."""
    count, unknowns = grid.problem.unknowns, np.array(unknowns, dtype=float)
    values, matrix = np.empty(count), np.zeros((count, count))
    grid.problem.jacobian(unknowns, np.array(state, dtype=float), t, lengths(grid, t), grid.parameters, values, matrix)
    return matrix


def complete(grid, unknowns, state, t=0.0):
    """Return the state (size,) at the end of a step from `state`, for `unknowns` that solve its equations."""
    problem, unknowns = grid.problem, np.array(unknowns, dtype=float)
    interval = np.empty(problem.stages + problem.state)
    problem.complete(unknowns, np.array(state, dtype=float), t, lengths(grid, t), grid.parameters, interval)
    return interval[problem.stages :]


def lengths(grid, t):
    """Return the lengths (lengths,) of the first part of the step that starts at time t, in units of time."""
    return length_at(grid, t) * grid.problem.fractions[0]
