"""Motions of many cases of one initial value problem: their numbers, and the compiled loop over the cases.

The cases differ in the length of a step, in parameters and in the initial state. The formulas of a generated module
take arrays in place of numbers, as in `search.stacks`, if the index of a case is the last one of each array.
"""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from numba import config, njit

from codegen.runtime.addresses import call, call_value, data_of, moved, reals_at
from codegen.runtime.kernels import is_kept
from codegen.runtime.search.grid import checked_count
from codegen.runtime.search.stacks import NUMBERS_ONLY, OF_ARRAYS, as_objects, case_of, samples_of, with_names
from codegen.runtime.stepping.events import (
    FULL,
    STOPPED,
    enlarged,
    follow_watched,
    least_gaps,
    residual_with_events,
    room_for,
)
from codegen.runtime.stepping.motion import (
    FIRST_ROWS,
    MOST,
    TOLERANCE,
    EventLog,
    Grid,
    require_constraints,
    require_gaps,
    watched_of,
)
from codegen.runtime.stepping.steps import follow, largest_residual, memory_for, work_in
from codegen.runtime.tabulated import table_numbers

AGREES = 1e-14
"""Largest relative difference between a number of a case and that of the module."""


class Ensemble(NamedTuple):
    """The numbers of k cases.

    Attributes
    ----------
    is_usable : (k,)
        False for a case whose numbers are not finite, or whose duration is not positive.
    h : (k,)
        Lengths of a step.
    parameters : (k, P)
        Parameters, and the numbers of tables.
    start : (k, state)
        Initial states.
    spans : (0, 2)
        There are no steps of other lengths, see `steps.follow`.
    """

    is_usable: np.ndarray
    h: np.ndarray
    parameters: np.ndarray
    start: np.ndarray
    spans: np.ndarray


class Followed(NamedTuple):
    """The motions of k cases.

    Attributes
    ----------
    path, before : (k, M, state), (k, M - 1, state)
        Stored states, and the states one step before all of them but the first. Rows after a failed step are NaN.
        `before` is empty if every state is stored.
    numbers : (k, 4)
        Steps made, states stored, iterations and outcome, as `steps.follow` returns them.
    residual : (k,)
        Largest moduli of the equations of the scheme, evaluated again.
    """

    path: np.ndarray
    before: np.ndarray
    numbers: np.ndarray
    residual: np.ndarray


class Happened(NamedTuple):
    """The events of k cases.

    Attributes
    ----------
    counts : (k,)
        Numbers of events.
    ends : (k,)
        Time of the event that ended the motion, or NaN.
    least : (k,)
        Least value of all gaps in the stored states; infinite without gaps.
    """

    counts: np.ndarray
    ends: np.ndarray
    least: np.ndarray


def ensemble_of(module, steps, arguments, k):
    """Return the Ensemble of k cases, and errors about unusable numbers by the index of the case.

    `arguments` are the keyword arguments of `make_grid` of a generated `module`, with arrays (k,) in place of numbers,
    also inside `start`.
    """
    problem, errors = module.problem, {}
    found = _of_formulas(module, steps, arguments, k)
    if found is None:
        found = _one_by_one(module, steps, arguments, k, errors)
    watched = None if problem.events is None else watched_of(problem)
    if problem.constraints is not None or (watched is not None and watched.gaps):
        for case in np.flatnonzero(found.is_usable).tolist():
            numbers = float(found.h[case]), found.parameters[case], found.start[case]
            grid = Grid(steps, *numbers, TOLERANCE, MOST, problem)
            try:
                if problem.constraints is not None:
                    require_constraints(grid)
                if watched is not None:
                    require_gaps(grid, watched)
            except ValueError as error:
                errors[case] = error
                found.is_usable[case] = False
    for case in np.flatnonzero(~found.is_usable).tolist():
        if case not in errors:
            errors[case] = _error_of(module, steps, arguments, case)
    return found, errors


def _of_formulas(module, steps, arguments, k):
    """Return the Ensemble from the formulas of the module on arrays; None if these need numbers."""
    problem = module.problem

    def checked_step_grid(_, steps, duration, parameters, start, tables=None, grid=None):
        """Return the numbers of all cases, in place of the function with this name."""
        numbers = table_numbers(problem, tables) if problem.tables else ()
        columns = [np.broadcast_to(np.asarray(value, dtype=float), k) for value in (*parameters, *numbers)]
        h = np.broadcast_to(np.asarray(duration, dtype=float) / checked_count("steps", steps), k)
        return h, np.array(columns).reshape(len(columns), k), start

    def start_values(prescribed, start):
        """Return the values at the start of all cases, in place of the function with this name."""
        return (prescribed | (start or {})).values()

    def array(values, dtype):
        """Return an array (.., k) of the numbers of all cases."""
        return np.array([np.broadcast_to(np.asarray(value, dtype=dtype), k) for value in values])

    names = {
        "math": OF_ARRAYS, "checked_step_grid": checked_step_grid, "start_values": start_values,
        "np": SimpleNamespace(array=array),
    }  # fmt: skip
    try:
        with np.errstate(all="ignore"):
            h, parameters, start = with_names(module.make_grid, names)(steps, **as_objects(arguments))
            h, parameters, start = (np.array(numbers, dtype=float) for numbers in (h, parameters, start))
            is_usable = (h > 0.0) & np.isfinite(np.vstack([h[None], parameters, start])).all(axis=0)
            for case in samples_of(arguments, np.flatnonzero(is_usable)) if is_usable.any() else ():
                own = module.make_grid(steps, **case_of(arguments, case))
                pairs = (own.h, h[case]), (own.parameters, parameters[:, case]), (own.start, start[:, case])
                if not all(np.allclose(one, other, rtol=AGREES, atol=0.0) for one, other in pairs):
                    return None
    except NUMBERS_ONLY:
        return None
    return Ensemble(is_usable, h, np.ascontiguousarray(parameters.T), np.ascontiguousarray(start.T), np.empty((0, 2)))


def _one_by_one(module, steps, arguments, k, errors):
    """Return the Ensemble from the grid of each case; `errors` takes the errors of unusable cases."""
    grids = {}
    for case in range(k):
        try:
            grids[case] = module.make_grid(steps, **case_of(arguments, case))
        except (ValueError, ArithmeticError) as error:
            errors[case] = error
    width = next((grid.parameters.size for grid in grids.values()), 0)
    found = Ensemble(
        np.zeros(k, bool), np.full(k, np.nan), np.full((k, width), np.nan), np.full((k, module.problem.state), np.nan),
        np.empty((0, 2)),
    )  # fmt: skip
    for case, grid in grids.items():
        found.is_usable[case], found.h[case] = True, grid.h
        found.parameters[case], found.start[case] = grid.parameters, grid.start
    return found


def _error_of(module, steps, arguments, case):
    """Return the error that the module raises for the numbers of a case."""
    try:
        module.make_grid(steps, **case_of(arguments, case))
    except (ValueError, ArithmeticError) as error:
        return error
    return ValueError("the numbers of the case are not finite")


def own_cases(ensemble, part):
    """Return the Ensemble of a slice of the cases."""
    return Ensemble(*(numbers[part] for numbers in ensemble[:4]), ensemble.spans)


def followed_in(path, every):
    """Return the Followed whose states go into `path` (k, M, state), without results.

    The array `before` of a path on a device has a shape and no memory.
    """
    k, rows, state = path.shape
    shape = k, 0 if every == 1 else rows - 1, state
    before = np.empty(shape) if isinstance(path, np.ndarray) else np.broadcast_to(np.nan, shape)
    return Followed(path, before, np.zeros((k, 4), np.int64), np.full(k, np.nan))


def are_motions_ready(problem):
    """Return True if machine code of the loop over cases is on the disk, or if numba is switched off."""
    loop = follow_cases if problem.events is None else follow_watched_cases
    return bool(config.DISABLE_JIT) or is_kept(loop.py_func)


def follow_ensemble(problem, ensemble, steps, every, followed, tolerance=TOLERANCE, most=MOST):
    """Follow the motions of all usable cases, and fill `followed`; the lock of the interpreter is released.

    Return None, or for a problem with events what `Happened`, and the EventLog of all cases, one after the other.
    """
    scheme = problem.scheme
    if problem.events is not None:
        return follow_with_events(problem, ensemble, steps, every, followed, tolerance, most)
    loop = problem.all_steps
    address = 0 if loop is None or loop.is_interpreted else loop.address
    follow_cases(scheme, address, memory_for(scheme), ensemble, steps, tolerance, most, every, followed)
    return None


def follow_with_events(problem, ensemble, steps, every, followed, tolerance, most):
    """Follow the motions of all usable cases with their events, see `follow_ensemble`."""
    watched, scheme = watched_of(problem, tolerance, most), problem.scheme._replace(is_constant=0)
    (room, arrays), memory, k = room_for(watched, problem.rules, FIRST_ROWS), memory_for(scheme), ensemble.h.size
    happened = Happened(np.zeros(k, np.int64), np.full(k, np.nan), np.full(k, np.inf))
    progress, marks, case = np.zeros(8, np.int64), np.zeros(steps, np.int64), 0
    while True:
        case = follow_watched_cases(
            scheme, watched, memory, room, arrays["reals"], arrays["integers"], progress, case, ensemble, steps, every,
            followed, happened, marks,
        )  # fmt: skip
        if case == k:
            break
        room = enlarged(arrays, problem.state)
    numbers, times, states = (arrays[name][: progress[4]] for name in ("rows", "times", "states"))
    columns = numbers[:, 0], numbers[:, 1], times[:, 2], states[:, 1], states[:, 2]
    return happened, EventLog(*(np.array(column) for column in columns))


@njit(cache=True, error_model="numpy", nogil=True)
def follow_watched_cases(
    scheme, watched, memory, room, reals, integers, progress, first, ensemble, steps, every, followed, happened, marks
):
    """Follow the motion of each usable case from the case `first`; return the number of cases, or of a full log.

    After an enlargement of the log, the case with the returned number goes on. `progress` is that of `follow_watched`,
    and zero before the first case. The log holds the events of all cases. `reals` and `integers` are all work arrays.
    """
    for case in range(first, ensemble.h.size):
        if not ensemble.is_usable[case]:
            continue
        path, h, parameters = followed.path[case], ensemble.h[case], ensemble.parameters[case]
        before, numbers = followed.before[case] if every > 1 else path, followed.numbers[case]
        if case > first or progress[1] == 0:
            reals[:] = 0.0
            integers[:] = 0
            for i in range(scheme.state):
                reals[i] = ensemble.start[case, i]  # the first work array is `now`
            progress[0], progress[1], progress[2], progress[3], progress[5] = 0, 1, every, 0, 1
            progress[7] = progress[4]
        outcome = follow_watched(
            scheme, watched, memory, room, progress, steps, h, parameters, every, path, before, ensemble.spans, marks
        )
        if outcome == FULL:
            return case
        made, rows = progress[0], progress[1]
        happened.counts[case] = progress[4] - progress[7]
        times = np.empty(rows)
        for row in range(rows):
            times[row] = h * min(every * row, made)
        if outcome == STOPPED:
            times[rows - 1] = happened.ends[case] = reals_at(room.times)[3 * (progress[4] - 1) + 2]
        if made > 0:
            followed.residual[case] = residual_with_events(
                scheme, watched, memory, room, progress, h, parameters, every, path, before, ensemble.spans, marks
            )
        if watched.gaps:
            least = np.empty(watched.gaps)
            least_gaps(watched, path, times, parameters, least)
            happened.least[case] = least.min()
        numbers[0], numbers[1], numbers[2], numbers[3] = made, rows, progress[3], outcome
        path[rows:] = np.nan
        progress[1] = 0
    return ensemble.h.size


@njit(cache=True, error_model="numpy", nogil=True)
def follow_cases(scheme, all_steps, memory, ensemble, steps, tolerance, most, every, followed):
    """Follow the motion of each usable case; `all_steps` is the address of the loop of an explicit scheme, or 0."""
    numbers, outcome = np.empty(3), np.empty(4)
    for case in range(ensemble.h.size):
        if not ensemble.is_usable[case]:
            continue
        if all_steps == 0:
            follow_case(case, scheme, memory, ensemble, steps, tolerance, most, every, followed)
            continue
        path, before, parameters_at = followed.path[case], followed.before[case], ensemble.parameters[case].ctypes.data
        work = work_in(scheme, memory, ensemble.h[case], parameters_at)
        now, state = reals_at(work.now), reals_at(work.begin)
        for i in range(scheme.state):
            now[i] = state[i] = ensemble.start[case, i]
        numbers[0], numbers[1], numbers[2] = steps, ensemble.h[case], every
        call(
            all_steps,
            (
                work.begin, work.now, work.interval, work.lengths, numbers.ctypes.data, parameters_at,
                data_of(path), data_of(before), outcome.ctypes.data,
            ),
        )  # fmt: skip
        made, rows, iterations, reason = int(outcome[0]), int(outcome[1]), int(outcome[2]), int(outcome[3])
        finish_case(
            case, scheme, memory, ensemble, steps, tolerance, most, every, followed, made, rows, iterations, reason
        )


@njit(error_model="numpy")
def follow_case(case, scheme, memory, ensemble, steps, tolerance, most, every, followed):
    """Follow the motion of one case by `steps.follow`."""
    made, rows, iterations, outcome = follow(
        scheme, memory, ensemble.start[case], steps, ensemble.h[case], ensemble.parameters[case], tolerance, most,
        every, followed.path[case], followed.before[case], ensemble.spans,
    )  # fmt: skip
    finish_case(
        case, scheme, memory, ensemble, steps, tolerance, most, every, followed, made, rows, iterations, outcome
    )


@njit(error_model="numpy")
def finish_case(
    case, scheme, memory, ensemble, steps, tolerance, most, every, followed, made, rows, iterations, outcome
):  # fmt: skip
    """Evaluate the equations of a motion again, and store its numbers."""
    path, numbers, h, parameters = followed.path[case], followed.numbers, ensemble.h[case], ensemble.parameters[case]
    measured, residual = rows if outcome == 0 else 1 + made // every, np.nan
    # One call for each kind of array: on a device they lie in memory in different ways.
    if made > 0 and every == 1:
        residual = largest_residual(
            scheme, memory, path, path, measured, made, h, parameters, tolerance, most, every, ensemble.spans
        )
    elif made > 0:
        residual = largest_residual(
            scheme, memory, followed.before[case], path, measured, made, h, parameters, tolerance, most, every,
            ensemble.spans,
        )  # fmt: skip
    numbers[case, 0], numbers[case, 1], numbers[case, 2], numbers[case, 3] = made, rows, iterations, outcome
    followed.residual[case] = residual
    for row in range(rows, path.shape[0]):
        for i in range(path.shape[1]):
            path[row, i] = np.nan


def energies_of(problem, ensemble, path, times):
    """Return the Hamiltonian (k, M) along each path (k, M, state) at `times` (k, M)."""
    values = np.empty(times.shape)
    fill_energies(problem.energy.address, path, times, ensemble.parameters, values)
    return values


@njit(cache=True, error_model="numpy", nogil=True)
def fill_energies(energy, path, times, parameters, values):
    """Fill `values` (k, M) with the numbers of the function at the address `energy`."""
    for case in range(values.shape[0]):
        parameters_at = parameters[case].ctypes.data
        for row in range(values.shape[1]):
            state_at = moved(path[case].ctypes.data, row * path.shape[2])
            values[case, row] = call_value(energy, (state_at, times[case, row], parameters_at))
