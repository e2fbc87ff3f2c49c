"""Events and impacts along a motion, in compiled code.

A step whose end lies beyond a zero of an event is made again with a shorter length, for which the event vanishes: the
state at the event satisfies the equations of the scheme. After the effect of the event, the rest of the step follows. A
double zero within a step is found at the extremum of the event, where its rate along the motion vanishes.

A gap g >= 0 has an impact where it vanishes with a negative rate u. The impulse along the normal G,

    p+ = p - (1 + c) u / (G M^-1 G^T) G^T,

changes the rate to -c u. The impacts of a bouncing body accumulate: before the next ones, with the acceleration a < 0,
the time 2 c |u| / (|a| (1 - c)) passes. Where this time is below SETTLED steps, the body rests, and the gap is closed.
A closed gap acts as a constraint by impulses lambda at both nodes of a step of the scheme, as in RATTLE,

    p_k + G(q_k)^T lambda,    the step,    p_k1 + G(q_k1)^T mu    with g(q_k1) = 0 and dg/dt = 0 at the end.

A closed gap opens where the contact force would pull. Several contact forces solve a linear complementarity problem.

Source: Fetecau, Marsden, Ortiz and West (2003), Nonsmooth Lagrangian mechanics and variational collision integrators;
Chandrupatla (1997), A new hybrid quadratic/bisection algorithm for finding the zero of a nonlinear function; Brogliato
(2016), Nonsmooth mechanics, chapters 5 and 7; Broyden (1965), A class of methods for solving nonlinear equations.
"""

from typing import NamedTuple

import numpy as np
from numba import carray, njit

from codegen.runtime.addresses import call, data_of, reals_at
from codegen.runtime.arithmetic import factor_matrix, solve_factored
from codegen.runtime.kernels import ONLY_COMPILED
from codegen.runtime.stepping.steps import advance, checked, set_length, stored, stored_last, work_in

STOPPED, FULL = 1, 2  # outcomes of a motion: a stop event, and a full log, which the caller enlarges
ACCUMULATED, NO_CONTACT = -5, -6  # outcomes of a failed step
STOP, CHANGE, RECORD, IMPACT, REST, OPENING = range(6)  # the members of EventAction in order
ZERO = 1e-13  # a value below this fraction of its terms is zero
SLOW = 1e-12  # a rate of a gap below this fraction of its largest modulus is zero
WEAK = 1e-10  # an acceleration or a contact force below this fraction of its largest modulus is zero
SETTLED = 1e-8  # time for all further impacts, relative to the step, below which a body rests
LOW = 1e-15  # height of the next bounce relative to the terms of a gap, below which a body rests
ELASTIC = 1e-3  # least value of 1 - c in the estimate of this time
MOST = 10_000  # largest number of events in a step
QUICK, MOST_QUICK = 1e-9, 20  # time between two events relative to the step, and number of such events in succession
CORRECTIONS = 40  # largest number of Broyden steps for contact impulses
REACHED = 2e-16  # accuracy of the time of an event, relative to the step
MOST_TRIALS = 200  # of a search for a zero
BITS = 62  # largest number of gaps, whose closed ones are the bits of an integer


class Watched(NamedTuple):
    """The events of a problem for compiled code: addresses of kernels, and numbers of events, gaps and changes.

    `size` is the number of values of a state, and `most` the largest number of iterations of a part of a step.
    """

    values: int
    jumps: int
    normals: int
    events: int
    gaps: int
    changes: int
    size: int
    most: int
    tolerance: float


class Room(NamedTuple):
    """Work arrays of a motion with events.

    `rules` (events + gaps, 3) has the action, direction and row in `jumps` of each event. `now`, `end`, `trial` and
    `pushed` are states. `values_now`, `values_end` and `values_trial` (events + gaps, 3) have value, rate and scale.
    `sides` has the sign of each event before its next zero, 0 if unknown. `scales` (events + gaps,) and `largest` (2,) are
    the largest moduli so far of the terms of events, and, of all gaps, of the terms of rates and of accelerations.
    `is_closed` marks the gaps that act as constraints. `normals` and `normals_end` (gaps, 3 + 2 coordinates) are filled
    by the kernel `gap_normals`. Other arrays serve linear systems of contact impulses.
    `quick` counts quick events. `rows` (M, 4) has for each event its number, its action, the step, and the closed gaps
    before it. `times` (M, 3) has the time at the start, the length and the time of the event. `states` (M, 3, size) has
    the state at the start, and those before and after the event.
    """

    rules: np.ndarray
    now: np.ndarray
    end: np.ndarray
    trial: np.ndarray
    pushed: np.ndarray
    values_now: np.ndarray
    values_end: np.ndarray
    values_trial: np.ndarray
    sides: np.ndarray
    scales: np.ndarray
    largest: np.ndarray
    is_closed: np.ndarray
    normals: np.ndarray
    normals_end: np.ndarray
    jumps: np.ndarray
    matrix: np.ndarray
    factors: np.ndarray
    pivots: np.ndarray
    forces: np.ndarray
    impulses: np.ndarray
    correction: np.ndarray
    excess: np.ndarray
    excess_before: np.ndarray
    closed: np.ndarray
    quick: np.ndarray
    rows: np.ndarray
    times: np.ndarray
    states: np.ndarray


def room_for(watched, rules, rows):
    """Return work arrays with a log of `rows` events."""
    count, gaps, size = watched.events + watched.gaps, watched.gaps, watched.size
    states = [np.zeros(size) for _ in range(4)]
    values = [np.zeros((count, 3)) for _ in range(3)]
    normals = [np.zeros((gaps, 3 + size)) for _ in range(2)]
    impulses = [np.zeros(gaps) for _ in range(5)]
    return Room(
        np.ascontiguousarray(rules, dtype=np.int64), *states, *values, np.zeros(count), np.zeros(count), np.zeros(2),
        np.zeros(gaps, np.int64), *normals, np.zeros((watched.changes, size)), np.zeros((gaps, gaps)),
        np.zeros((gaps, gaps)), np.zeros(gaps, np.int64), *impulses, np.zeros(gaps, np.int64),
        np.zeros(count, np.int64), *log_of(rows, size),
    )  # fmt: skip


def log_of(rows, size):
    """Return the arrays of a log of events."""
    return np.zeros((rows, 4), np.int64), np.zeros((rows, 3)), np.zeros((rows, 3, size))


@njit(error_model="numpy", **ONLY_COMPILED)
def reach(scheme, work, watched, state, t, length, parameters_at, end):
    """Make a step of any length from `state` and fill `end`; return the iterations, or a negative outcome."""
    set_length(scheme, work, length)
    begin = carray(reals_at(work.begin), (watched.size,))
    for i in range(watched.size):
        begin[i] = state[i]
    outcome = advance(scheme, work, t, watched.tolerance, watched.most, parameters_at)
    outcome = checked(outcome, watched.size, begin)
    for i in range(watched.size):
        end[i] = begin[i]
    return outcome


@njit(error_model="numpy", **ONLY_COMPILED)
def move(scheme, work, watched, room, t, length, parameters_at, end):
    """Make a step of any length from `room.now`, with the impulses of closed gaps; fill `end`.

    Return the iterations, or a negative outcome.
    """
    count, half = count_closed(watched, room), watched.size // 2
    if count == 0:
        return reach(scheme, work, watched, room.now, t, length, parameters_at, end)
    now, pushed, impulses = room.now, room.pushed, room.impulses
    call(watched.normals, (data_of(now), t, parameters_at, data_of(room.normals)))
    if not solve_forces(watched, room, count):
        return NO_CONTACT
    for a in range(count):
        impulses[a] = 0.5 * length * room.forces[a]
    iterations, best, closed = 0, np.inf, room.closed
    for trial in range(CORRECTIONS):
        for i in range(watched.size):
            pushed[i] = now[i]
        for a in range(count):
            for i in range(half):
                pushed[half + i] += impulses[a] * room.normals[closed[a], 3 + i]
        outcome = reach(scheme, work, watched, pushed, t, length, parameters_at, end)
        if outcome < 0:
            return outcome
        iterations += outcome
        call(watched.values, (data_of(end), t + length, parameters_at, data_of(room.values_trial)))
        error = 0.0
        for a in range(count):
            row = watched.events + closed[a]
            room.excess[a] = room.values_trial[row, 0] / length
            scale = max(room.scales[row], room.values_trial[row, 2], 1e-300)
            error = max(error, abs(room.values_trial[row, 0]) / scale)
        if error <= 1e-15 or (trial > 2 and error <= ZERO and error >= 0.5 * best):
            break
        best = min(best, error)
        if trial == 0:
            call(watched.normals, (data_of(end), t + length, parameters_at, data_of(room.normals_end)))
            for a in range(count):
                for b in range(count):
                    total = 0.0
                    for i in range(half):
                        total += room.normals_end[closed[a], 3 + i] * room.normals[closed[b], 3 + half + i]
                    room.matrix[a, b] = total
        else:
            square = 0.0
            for a in range(count):
                square += room.correction[a] ** 2
            if not square > 0.0:
                break
            for a in range(count):
                change = room.excess[a] - room.excess_before[a]
                for b in range(count):
                    change -= room.matrix[a, b] * room.correction[b]
                room.excess_before[a] = change / square
            for a in range(count):
                for b in range(count):
                    room.matrix[a, b] += room.excess_before[a] * room.correction[b]
        for a in range(count):
            room.correction[a] = -room.excess[a]
            room.excess_before[a] = room.excess[a]
        if not solve_closed(room, count, room.correction):
            return NO_CONTACT
        for a in range(count):
            impulses[a] += room.correction[a]
    else:
        return NO_CONTACT
    if not keep_closed(watched, room, end, t + length, parameters_at):
        return NO_CONTACT
    return iterations


@njit(error_model="numpy", **ONLY_COMPILED)
def count_closed(watched, room):
    """List the closed gaps in `room.closed`, and return their number."""
    count = 0
    for j in range(watched.gaps):
        if room.is_closed[j]:
            room.closed[count] = j
            count += 1
    return count


@njit(error_model="numpy", **ONLY_COMPILED)
def solve_closed(room, count, right):
    """Solve the system of `room.matrix` for the closed gaps; return False if it is singular."""
    for a in range(count):
        for b in range(count):
            room.factors[a, b] = room.matrix[a, b]
    factors = room.factors[:count, :count]
    if factor_matrix(factors, room.pivots) >= 0:
        return False
    solve_factored(factors, room.pivots, right[:count])
    return True


@njit(error_model="numpy", **ONLY_COMPILED)
def fill_closed(watched, room, count):
    """Fill the matrix G M^-1 G^T of the closed gaps from `room.normals`."""
    half = watched.size // 2
    for a in range(count):
        for b in range(count):
            total = 0.0
            for i in range(half):
                total += room.normals[room.closed[a], 3 + i] * room.normals[room.closed[b], 3 + half + i]
            room.matrix[a, b] = total


@njit(error_model="numpy", **ONLY_COMPILED)
def solve_forces(watched, room, count):
    """Solve for the contact forces of the closed gaps from `room.normals`; return False if they are not determined."""
    fill_closed(watched, room, count)
    for a in range(count):
        acceleration = room.normals[room.closed[a], 0]
        room.largest[1] = max(room.largest[1], abs(acceleration))
        room.forces[a] = -acceleration
    return solve_closed(room, count, room.forces)


@njit(error_model="numpy", **ONLY_COMPILED)
def keep_closed(watched, room, state, t, parameters_at):
    """Project the momenta of a state so that the rates of the closed gaps vanish; return False without a solution."""
    count, half = count_closed(watched, room), watched.size // 2
    call(watched.normals, (data_of(state), t, parameters_at, data_of(room.normals)))
    fill_closed(watched, room, count)
    for _ in range(2):
        call(watched.values, (data_of(state), t, parameters_at, data_of(room.values_trial)))
        for a in range(count):
            room.correction[a] = -room.values_trial[watched.events + room.closed[a], 1]
        if not solve_closed(room, count, room.correction):
            return False
        for a in range(count):
            for i in range(half):
                state[half + i] += room.correction[a] * room.normals[room.closed[a], 3 + i]
    return True


@njit(error_model="numpy", **ONLY_COMPILED)
def watch(watched, room, state, t, parameters_at, values):
    """Fill the values of all events and gaps; the value of a closed gap is its contact force."""
    call(watched.values, (data_of(state), t, parameters_at, data_of(values)))
    if watched.gaps:
        call(watched.normals, (data_of(state), t, parameters_at, data_of(room.normals)))
    count = count_closed(watched, room)
    if count == 0:
        return
    solve_forces(watched, room, count)
    for a in range(count):
        row = watched.events + room.closed[a]
        values[row, 0], values[row, 1] = room.forces[a], 0.0


@njit(error_model="numpy", **ONLY_COMPILED)
def zero_of(scheme, work, watched, room, t, column, row, a, fa, b, fb, length, parameters_at):
    """Return the length in (a, b) at which an entry of the values vanishes, by Chandrupatla's method, and an outcome.

    `fa` and `fb` have opposite signs. `room.trial` takes the state there.
    """
    accuracy = REACHED * length
    c, fc, share = a, fa, 0.5
    for _ in range(MOST_TRIALS):
        x = a + share * (b - a)
        outcome = move(scheme, work, watched, room, t, x, parameters_at, room.trial)
        if outcome < 0:
            return x, outcome
        watch(watched, room, room.trial, t + x, parameters_at, room.values_trial)
        fx = room.values_trial[row, column]
        if (fx > 0.0) == (fa > 0.0):
            c, fc = a, fa
        else:
            c, fc, b, fb = b, fb, a, fa
        a, fa = x, fx
        width = abs(b - a)
        if fx == 0.0 or width <= 2.0 * accuracy:
            return a if abs(fa) < abs(fb) else b, 0
        least = accuracy / width
        share, xi, phi = 0.5, (a - b) / (c - b), (fa - fb) / (fc - fb)
        if phi * phi < xi and (1.0 - phi) * (1.0 - phi) < 1.0 - xi:
            share = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
        share = min(max(share, least), 1.0 - least)
    return x, 0


@njit(error_model="numpy", **ONLY_COMPILED)
def first_zero(scheme, work, watched, room, t, length, row, parameters_at):
    """Return the length of the step to the first zero of an event, or -1 without a zero, and an outcome.

    `room.now` and `room.end` are the states at both ends of the step, `values_now` and `values_end` their values.
    """
    side, is_gap = room.sides[row], row >= watched.events
    if side == 0.0:
        return -1.0, 0
    wanted, level = room.rules[row, 1], ZERO * room.scales[row]
    if is_gap and room.is_closed[row - watched.events]:
        level = WEAK * abs(room.values_now[row, 0])
    start, end = side * room.values_now[row, 0], side * room.values_end[row, 0]
    is_right = wanted == 0 or wanted == -int(side)
    b, fb = length, end
    if end > 0.0 or (is_gap and end > -level):
        if not (side * room.values_now[row, 1] < 0.0 and side * room.values_end[row, 1] > 0.0):
            return -1.0, 0
        slopes = room.values_now[row, 1], room.values_end[row, 1]
        b, outcome = zero_of(
            scheme, work, watched, room, t, 1, row, 0.0, slopes[0], length, slopes[1], length, parameters_at
        )
        if outcome < 0:
            return -1.0, outcome
        fb = side * room.values_trial[row, 0]
        if is_gap and fb > -level:
            return -1.0, 0
        if fb > level or not is_right:
            return -1.0, 0
        if fb >= -level:
            return b, 0
    elif not is_right:
        return -1.0, 0
    elif end == 0.0:
        return length, 0
    return zero_of(
        scheme, work, watched, room, t, 0, row, 0.0, side * max(start, 1e-300), b, side * fb, length, parameters_at
    )


@njit(error_model="numpy", **ONLY_COMPILED)
def set_side(watched, room, values, row, length):
    """Set the sign of an event before its next zero: the sign of its value, or of its rate where it vanishes."""
    level = ZERO * room.scales[row]
    room.sides[row] = 0.0
    if abs(values[row, 0]) > level:
        room.sides[row] = np.sign(values[row, 0])
    elif abs(values[row, 1]) * length > level:
        room.sides[row] = np.sign(values[row, 1])


@njit(error_model="numpy", **ONLY_COMPILED)
def grow_scales(watched, room, values):
    """Update the largest moduli of the terms of events, and of rates and accelerations of gaps, from `room.normals`."""
    for i in range(watched.events + watched.gaps):
        room.scales[i] = max(room.scales[i], values[i, 2])
    for j in range(watched.gaps):
        room.largest[0] = max(room.largest[0], room.normals[j, 2])
        room.largest[1] = max(room.largest[1], abs(room.normals[j, 0]))


@njit(error_model="numpy", **ONLY_COMPILED)
def log(watched, room, progress, row, action, step, span, t, before):
    """Add an event to the log; `span` are the time and state at the start of the part of the step before it."""
    n, size = progress[4], watched.size
    mask = 0
    for j in range(watched.gaps):
        mask |= room.is_closed[j] << j
    room.rows[n, 0], room.rows[n, 1], room.rows[n, 2], room.rows[n, 3] = row, action, step, mask
    room.times[n, 0], room.times[n, 1], room.times[n, 2] = span[0], span[1], t
    for i in range(size):
        room.states[n, 0, i] = room.states[n, 1, i] = before[i]
        room.states[n, 2, i] = room.now[i]
    progress[4] = n + 1


@njit(error_model="numpy", **ONLY_COMPILED)
def settle(watched, room, progress, step, t, length, parameters_at, forced):
    """Resolve impacts and contacts at `room.now`; return 0 or a negative outcome.

    `forced` is a gap that has just vanished, or -1. Impacts at one time follow each other in the order of the gaps.
    """
    now, half, first, is_hit = room.now, watched.size // 2, watched.events, False
    for _ in range(MOST):
        if progress[4] >= room.rows.shape[0] - 2:
            return ACCUMULATED
        call(watched.values, (data_of(now), t, parameters_at, data_of(room.values_trial)))
        call(watched.normals, (data_of(now), t, parameters_at, data_of(room.normals)))
        grow_scales(watched, room, room.values_trial)
        values, impact = room.values_trial, -1
        for j in range(watched.gaps):
            touches = room.is_closed[j] or j == forced or values[first + j, 0] <= ZERO * room.scales[first + j]
            if touches and values[first + j, 1] < (-SLOW * room.largest[0] if j != forced else 0.0):
                impact = j
                break
        if impact >= 0:
            room.pushed[:] = now
            admittance = 0.0
            for i in range(half):
                admittance += room.normals[impact, 3 + i] * room.normals[impact, 3 + half + i]
            if not admittance > 0.0:
                return NO_CONTACT
            impulse = -(1.0 + room.normals[impact, 1]) * values[first + impact, 1] / admittance
            for i in range(half):
                now[half + i] += impulse * room.normals[impact, 3 + i]
            is_hit = True
            log(watched, room, progress, first + impact, IMPACT, step, (t, 0.0), t, room.pushed)
            room.is_closed[impact] = 0
            continue
        # Accelerations of all gaps under the forces of the closed ones.
        count = count_closed(watched, room)
        if count > 0 and not solve_forces(watched, room, count):
            return NO_CONTACT
        weakest, opening = 0.0, -1
        for a in range(count):
            j = room.closed[a]
            scale = WEAK * room.largest[1] / room.matrix[a, a]
            if values[first + j, 1] > SLOW * room.largest[0]:
                opening = j
                break
            if room.forces[a] < -scale and room.forces[a] < weakest:
                weakest, opening = room.forces[a], j
        if opening >= 0:
            log(watched, room, progress, first + opening, OPENING, step, (t, 0.0), t, now)
            room.is_closed[opening] = 0
            continue
        strongest, closing, wait = 0.0, -1, 0.0
        for j in range(watched.gaps):
            if room.is_closed[j]:
                continue
            if not (j == forced or values[first + j, 0] <= ZERO * room.scales[first + j]):
                continue
            acceleration = room.normals[j, 0]
            for a in range(count):
                for i in range(half):
                    acceleration += (
                        room.forces[a] * room.normals[room.closed[a], 3 + i] * room.normals[j, 3 + half + i]
                    )
            if not acceleration < (-WEAK * room.largest[1] if j != forced else 0.0):
                continue
            rate = max(values[first + j, 1], 0.0)
            left = 2.0 * rate / -acceleration / max(1.0 - room.normals[j, 1], ELASTIC)
            is_low = 0.5 * rate * rate / -acceleration <= LOW * room.scales[first + j]
            # A gap that has vanished although it grows is zero to rounding.
            is_settled = left <= SETTLED * length or is_low or (j == forced and not is_hit)
            if is_settled and acceleration < strongest:
                strongest, closing, wait = acceleration, j, left
        if closing < 0:
            return 0
        room.pushed[:] = now
        log(watched, room, progress, first + closing, REST, step, (t, 0.0), t + wait, room.pushed)
        room.is_closed[closing] = 1
        if not keep_closed(watched, room, now, t, parameters_at):
            return NO_CONTACT
        room.states[progress[4] - 1, 2, :] = now
    return ACCUMULATED


@njit(error_model="numpy", **ONLY_COMPILED)
def watched_step(scheme, work, watched, room, progress, step, t, length, parameters_at):
    """Make a step of `room.now` with all events; return the iterations, STOPPED as a negative number, or an outcome.

    The first number returned is 0, STOPPED, or a negative outcome; the second one counts iterations, and the third one
    is the time that has passed.
    """
    done, iterations, fired, count = 0.0, 0, 0, watched.events + watched.gaps
    for i in range(watched.events):
        room.quick[i] = 0
    while True:
        at, left = t + done, length - done
        watch(watched, room, room.now, at, parameters_at, room.values_now)
        grow_scales(watched, room, room.values_now)
        for j in range(watched.gaps):
            row = watched.events + j
            is_closing = room.values_now[row, 1] < -SLOW * room.largest[0]
            if not room.is_closed[j] and is_closing and room.values_now[row, 0] <= ZERO * room.scales[row]:
                room.end[:] = room.now
                outcome = settle(watched, room, progress, step, at, length, parameters_at, j)
                if outcome < 0:
                    return outcome, iterations, done
                refresh(watched, room, at, length, parameters_at, -1)
                watch(watched, room, room.now, at, parameters_at, room.values_now)
        outcome = move(scheme, work, watched, room, at, left, parameters_at, room.end)
        if outcome < 0:
            return outcome, iterations, done
        iterations += outcome
        watch(watched, room, room.end, at + left, parameters_at, room.values_end)
        grow_scales(watched, room, room.values_end)
        nearest, which = np.inf, -1
        for row in range(count):
            reached, outcome = first_zero(scheme, work, watched, room, at, left, row, parameters_at)
            if outcome < 0:
                return outcome, iterations, done
            if reached >= 0.0 and reached < nearest:
                nearest, which = reached, row
        if which < 0:
            for i in range(watched.size):
                room.now[i] = room.end[i]
            for row in range(watched.events):
                if abs(room.values_end[row, 0]) > ZERO * room.scales[row]:
                    room.sides[row] = np.sign(room.values_end[row, 0])
            return 0, iterations, length
        fired += 1
        if fired > MOST or progress[4] >= room.rows.shape[0] - 2:
            return ACCUMULATED, iterations, done
        outcome = move(scheme, work, watched, room, at, nearest, parameters_at, room.end)
        if outcome < 0:
            return outcome, iterations, done
        first = progress[4]
        for i in range(watched.size):
            room.trial[i], room.now[i] = room.now[i], room.end[i]
        done, instant = done + nearest, at + nearest
        left, action = length - done, room.rules[which, 0]
        if which >= watched.events:
            gap = which - watched.events
            if room.is_closed[gap]:
                log(watched, room, progress, which, OPENING, step, (at, nearest), instant, room.end)
                room.is_closed[gap] = 0
                outcome = settle(watched, room, progress, step, instant, length, parameters_at, -1)
            else:
                outcome = settle(watched, room, progress, step, instant, length, parameters_at, gap)
        else:
            log(watched, room, progress, which, action, step, (at, nearest), instant, room.end)
            if action == CHANGE:
                call(watched.jumps, (data_of(room.end), instant, parameters_at, data_of(room.jumps)))
                for i in range(watched.size):
                    room.now[i] = room.jumps[room.rules[which, 2], i]
                    room.states[first, 2, i] = room.now[i]
                if watched.gaps:
                    outcome = settle(watched, room, progress, step, instant, length, parameters_at, -1)
                room.quick[which] = room.quick[which] + 1 if nearest < QUICK * length else 0
                if room.quick[which] > MOST_QUICK:
                    return ACCUMULATED, iterations, done
        if progress[4] > first:  # the log of the first event at this time has the start of its part of the step
            room.times[first, 0], room.times[first, 1] = at, nearest
            for i in range(watched.size):
                room.states[first, 0, i] = room.trial[i]
        if outcome < 0:
            return outcome, iterations, done
        if which < watched.events and action == STOP:
            return STOPPED, iterations, done
        refresh(watched, room, instant, length, parameters_at, which)
        if left <= 2.0 * REACHED * max(length, abs(t)):
            return 0, iterations, length


@njit(error_model="numpy", **ONLY_COMPILED)
def refresh(watched, room, t, length, parameters_at, fired):
    """Set the signs of the event that `fired`, and of events whose values have changed by its effect."""
    call(watched.values, (data_of(room.now), t, parameters_at, data_of(room.values_trial)))
    call(watched.values, (data_of(room.end), t, parameters_at, data_of(room.values_end)))
    for row in range(watched.events):
        change = abs(room.values_trial[row, 0] - room.values_end[row, 0])
        if row == fired or change > ZERO * room.scales[row]:
            set_side(watched, room, room.values_trial, row, length)


@njit(cache=True, error_model="numpy", nogil=True)
def follow_watched(
    scheme, watched, memory, room, progress, steps, h, parameters, every, path, before, spans, marks
):  # fmt: skip
    """Make steps with events until the last step, a stop, a failure, or a full log; return the outcome and a time.

    `progress` (6,) has the number of steps made, the rows of `path` in use, the steps until the next storage,
    iterations, logged events, and 1 before the first call. `marks` (steps,) are set for steps with events or closed
    gaps. The time is the part of the last step that was made. Other arguments are as in `steps.follow`.
    """
    parameters_at, size = parameters.ctypes.data, watched.size
    work = work_in(scheme, memory, h, parameters_at)
    states, states_before = reals_at(data_of(path)), reals_at(data_of(before))
    saved = reals_at(work.now)
    if progress[5] == 1:
        progress[5] = 0
        length = spans[0, 1] if spans.shape[0] > 0 else h
        for i in range(size):
            path[0, i] = room.now[i]
        for j in range(watched.gaps):
            room.sides[watched.events + j] = 1.0
        watch(watched, room, room.now, 0.0, parameters_at, room.values_now)
        grow_scales(watched, room, room.values_now)
        if watched.gaps:
            outcome = settle(watched, room, progress, 0, 0.0, length, parameters_at, -1)
            if outcome < 0:
                return outcome, 0.0
        call(watched.values, (data_of(room.now), 0.0, parameters_at, data_of(room.values_now)))
        for row in range(watched.events):
            set_side(watched, room, room.values_now, row, length)
    for k in range(progress[0], steps):
        if room.rows.shape[0] - progress[4] < MOST:
            return FULL, 0.0
        t, length = k * h, h
        if spans.shape[0] > 0:
            t, length = spans[k, 0], spans[k, 1]
        for i in range(size):
            saved[i] = room.now[i]
        logged = progress[4]
        marks[k] = count_closed(watched, room) > 0
        outcome, iterations, done = watched_step(
            scheme, work, watched, room, progress, k, t, length, parameters_at
        )
        marks[k] |= progress[4] > logged or count_closed(watched, room) > 0
        progress[3] += iterations
        if outcome < 0:
            progress[1] = stored_last(progress[2], every, progress[1], size, saved, states)
            return outcome, done
        last = k + 1 if outcome == STOPPED else steps
        progress[0] = k + 1
        progress[2], progress[1] = stored(
            k + 1, last, every, progress[2], progress[1], size, saved, reals_at(data_of(room.now)), states, states_before
        )
        if outcome == STOPPED:
            return STOPPED, done
    return 0, 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def largest_defect(scheme, watched, memory, room, numbers, starts, spans, ends, h, parameters):
    """Return the largest defect of parts of steps with events, relative to the length h of a step.

    Part i leads from `starts` to `ends` (M, size), begins at the time `spans` (M, 2) and has the length there. The bits
    of `numbers` (M,) are the closed gaps. Each part is made again.
    """
    parameters_at, largest = parameters.ctypes.data, 0.0
    work = work_in(scheme, memory, h, parameters_at)
    for i in range(numbers.size):
        for j in range(watched.gaps):
            room.is_closed[j] = (numbers[i] >> j) & 1
        room.now[:] = starts[i]
        if move(scheme, work, watched, room, spans[i, 0], spans[i, 1], parameters_at, room.end) < 0:
            return np.inf
        for k in range(watched.size):
            largest = max(largest, abs(room.end[k] - ends[i, k]) / h)
    return largest


@njit(cache=True, error_model="numpy", nogil=True)
def least_gaps(watched, path, times, parameters, least):
    """Fill `least` (gaps,) with the least value of each gap along a `path` (M, size) at `times` (M,)."""
    values = np.empty((watched.events + watched.gaps, 3))
    least[:] = np.inf
    for row in range(times.size):
        state_at = path.ctypes.data + 8 * row * path.shape[1]
        call(watched.values, (state_at, times[row], parameters.ctypes.data, values.ctypes.data))
        for j in range(watched.gaps):
            least[j] = min(least[j], values[watched.events + j, 0])
