"""Events and impacts along a motion, in compiled code.

A step whose end lies beyond a zero of an event is made again with a shorter length, for which the event vanishes: the
state at the event satisfies the equations of the scheme. After the effect of the event, the rest of the step follows. A
double zero within a step is found at the extremum of the event, where its rate along the motion vanishes.

A gap g >= 0 has an impact where it vanishes with a negative rate u. The impulse along the normal G,

    p+ = p - (1 + c) u / (G M^-1 G^T) G^T,

changes the rate to -c u. The impacts of a bouncing body accumulate: before the next ones, with the acceleration a < 0,
the time 2 c |u| / (|a| (1 - c)) passes. Where this time is below SETTLED steps, the body rests, and the gap is closed.
A closed gap acts as a constraint, see `contacts`.

Source: Fetecau, Marsden, Ortiz and West (2003), Nonsmooth Lagrangian mechanics and variational collision integrators;
Chandrupatla (1997), A new hybrid quadratic/bisection algorithm for finding the zero of a nonlinear function.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.addresses import ahead, call, data_of, integers_at, reals_at
from codegen.runtime.kernels import ONLY_COMPILED
from codegen.runtime.stepping.contacts import (
    NO_CONTACT,
    ZERO,
    copy,
    count_closed,
    keep_closed,
    move,
    product,
    solve_forces,
)
from codegen.runtime.stepping.steps import largest_residual, stored, stored_last, work_in

STOPPED, FULL = 1, 2  # outcomes of a motion: a stop event, and a full log, which the caller enlarges
ACCUMULATED, VIOLATED = -5, -7  # outcomes of a failed step, as NO_CONTACT
STOP, CHANGE, RECORD, IMPACT, REST, OPENING = range(6)  # the members of EventAction in order
SLOW = 1e-12  # a rate of a gap below this fraction of its largest modulus is zero
WEAK = 1e-10  # an acceleration or a contact force below this fraction of its largest modulus is zero
SETTLED = 1e-8  # time for all further impacts, relative to the step, below which a body rests
INSIDE = 1e-9  # value of a gap after a change of the state, relative to its terms, that is taken for rounding
LOW = 1e-15  # height of the next bounce relative to the terms of a gap, below which a body rests
ELASTIC = 1e-3  # least value of 1 - c in the estimate of this time
MOST_EVENTS = 10_000  # largest number of events in a step
QUICK, MOST_QUICK = 1e-8, 20  # time between two events relative to the step, and number of such events in succession
REACHED = 2e-16  # accuracy of the time of an event, relative to the step
MOST_TRIALS = 200  # of a search for a zero


class Watched(NamedTuple):
    """The events of a problem for compiled code: addresses of kernels, and numbers of events, gaps and changes.

    `size` is the number of values of a state, and `width` the number of values of a gap that the kernel `normals`
    fills. `most` is the largest number of iterations of a part of a step.
    """

    values: int
    jumps: int
    normals: int
    events: int
    gaps: int
    changes: int
    size: int
    width: int
    most: int
    tolerance: float


class Room(NamedTuple):
    """Addresses of the work arrays of a motion with events, and the `capacity` M of the log; the caller keeps them.

    Attributes
    ----------
    rules : int
        Action, direction and row in `jumps` (events + gaps, 3) of each event.
    now, end, trial, pushed : int
        States (size,): at the start and the end of a part of a step, at trial lengths, and with impulses added.
    values_now, values_end, values_trial, values_pushed : int
        Value, rate and scale (events + gaps, 3) of each event in these states.
    sides : int
        The sign of each event before its next zero, 0 if unknown.
    scales, largest : int
        The largest moduli so far of the terms of events (events + gaps,), and, of all gaps, of the terms of rates and
        of accelerations (2,).
    normals, normals_end : int
        Arrays (gaps, width) of the kernel `gap_normals`.
    jumps : int
        States (changes, size) after events.
    matrix, factors, forces, impulses, correction, excess, excess_before : int
        Linear systems of contact forces and impulses.
    is_closed, closed, pivots : int
        Marks (gaps,) of the gaps that act as constraints, their list, and pivots.
    quick : int
        Numbers of quick events in succession.
    rows, times, states : int
        The log: number, action, step, and closed gaps as bits (M, 4); time at the start of a part, its length and the
        time of the event (M, 3); the states at the start, before and after the event (M, 3, size).
    """

    rules: int
    now: int
    end: int
    trial: int
    pushed: int
    values_now: int
    values_end: int
    values_trial: int
    values_pushed: int
    sides: int
    scales: int
    largest: int
    normals: int
    normals_end: int
    jumps: int
    matrix: int
    factors: int
    forces: int
    impulses: int
    correction: int
    excess: int
    excess_before: int
    is_closed: int
    closed: int
    pivots: int
    quick: int
    rows: int
    times: int
    states: int
    capacity: int


def room_for(watched, rules, rows):
    """Return work arrays with a log of `rows` events: their addresses, and the arrays by name.

    The arrays `reals` and `integers` hold all numbers that are zero before a motion.
    """
    count, gaps, size = watched.events + watched.gaps, watched.gaps, watched.size
    reals = dict.fromkeys(("now", "end", "trial", "pushed"), size)
    reals |= dict.fromkeys(("values_now", "values_end", "values_trial", "values_pushed"), 3 * count)
    reals |= {"sides": count, "scales": count, "largest": 2, "jumps": watched.changes * size}
    reals |= dict.fromkeys(("normals", "normals_end"), gaps * watched.width)
    reals |= dict.fromkeys(("matrix", "factors"), gaps * gaps)
    reals |= dict.fromkeys(("forces", "impulses", "correction", "excess", "excess_before"), gaps)
    integers = dict.fromkeys(("is_closed", "closed", "pivots"), gaps) | {"quick": count}
    arrays = {"rules": np.ascontiguousarray(rules, dtype=np.int64), **log_of(rows, size)}
    for whole, sizes, kind in (("reals", reals, np.float64), ("integers", integers, np.int64)):
        arrays[whole] = np.zeros(sum(sizes.values()), kind)
        parts = np.split(arrays[whole], np.cumsum(list(sizes.values()))[:-1])
        arrays |= dict(zip(sizes, parts, strict=True))
    return addresses_of(arrays), arrays


def log_of(rows, size):
    """Return the arrays of a log of events by name."""
    return {"rows": np.zeros((rows, 4), np.int64), "times": np.zeros((rows, 3)), "states": np.zeros((rows, 3, size))}


def addresses_of(arrays):
    """Return the addresses of work arrays."""
    return Room(*(arrays[name].ctypes.data for name in Room._fields[:-1]), len(arrays["rows"]))


def enlarged(arrays, size):
    """Double the log among the work arrays, and return the addresses of the arrays."""
    rows = len(arrays["rows"])
    for name, array in log_of(2 * rows, size).items():
        array[:rows] = arrays[name]
        arrays[name] = array
    return addresses_of(arrays)


@njit(error_model="numpy", **ONLY_COMPILED)
def watch(watched, room, state, t, length, parameters_at, values_at):
    """Fill the values of all events and gaps at a state; the value of a closed gap is its contact force.

    The kernel has no contact forces in the rates of events. They are added as a central difference over impulses of the
    duration `length`, which is exact for events that are quadratic in the momenta.
    """
    call(watched.values, (state, t, parameters_at, values_at))
    if watched.gaps:
        call(watched.normals, (state, t, parameters_at, room.normals))
    count = count_closed(watched, room)
    if count == 0:
        return
    values, forces, closed = reals_at(values_at), reals_at(room.forces), integers_at(room.closed)
    solve_forces(watched, room, count)
    for a in range(count):
        row = watched.events + closed[a]
        values[3 * row], values[3 * row + 1] = forces[a], 0.0
    half, pushed, normals = watched.size // 2, reals_at(room.pushed), reals_at(room.normals)
    moved = reals_at(room.values_pushed)
    for side in range(2 if watched.events else 0):
        impulse = (1.0 - 2.0 * side) * length
        copy(watched.size, state, room.pushed)
        for a in range(count):
            for i in range(half):
                pushed[half + i] += impulse * forces[a] * normals[watched.width * closed[a] + 3 + i]
        call(watched.values, (room.pushed, t, parameters_at, room.values_pushed))
        for row in range(watched.events):
            values[3 * row + 1] += moved[3 * row] / (2.0 * impulse)


@njit(error_model="numpy", **ONLY_COMPILED)
def zero_of(scheme, work, watched, room, t, column, row, fa, b, fb, length, parameters_at):
    """Return the length in (0, b) at which an entry of the values vanishes, by Chandrupatla's method, and an outcome.

    `fa` and `fb`, the values at both ends, have opposite signs.
    """
    accuracy, values = REACHED * length, reals_at(room.values_trial)
    a, c, fc, share, x = 0.0, 0.0, fa, 0.5, 0.5 * b
    for _ in range(MOST_TRIALS):
        x = a + share * (b - a)
        outcome = move(scheme, work, watched, room, t, x, parameters_at, room.trial)
        if outcome < 0:
            return x, outcome
        watch(watched, room, room.trial, t + x, length, parameters_at, room.values_trial)
        fx = values[3 * row + column]
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
    now, end = ahead(reals_at(room.values_now), 3 * row), ahead(reals_at(room.values_end), 3 * row)
    side, is_gap = reals_at(room.sides)[row], row >= watched.events
    if side == 0.0:
        return -1.0, 0
    wanted, level = integers_at(room.rules)[3 * row + 1], ZERO * reals_at(room.scales)[row]
    if is_gap and integers_at(room.is_closed)[row - watched.events]:
        level = WEAK * abs(now[0])
    is_right, b, fb, column, fa = wanted == 0 or wanted == -int(side), length, end[0], 0, now[0]
    is_double = side * end[0] > (-level if is_gap else 0.0)
    if is_double:
        if not (side * now[1] < 0.0 and side * end[1] > 0.0 and is_right):
            return -1.0, 0
        column, fa, fb = 1, now[1], end[1]
    elif not is_right:
        return -1.0, 0
    elif end[0] == 0.0:
        return length, 0
    for _ in range(2):
        if column == 0:
            fa = side * max(side * fa, 1e-300)
        reached, outcome = zero_of(scheme, work, watched, room, t, column, row, fa, b, fb, length, parameters_at)
        if outcome < 0:
            return reached, outcome
        if column == 0:
            # The sign also changes at a pole.
            if not abs(reals_at(room.values_trial)[3 * row]) <= max(abs(now[0]), abs(end[0])):
                reals_at(room.sides)[row] = np.sign(end[0])
                return -1.0, 0
            return reached, outcome
        extremum = side * reals_at(room.values_trial)[3 * row]
        if extremum > (-level if is_gap else level):
            return -1.0, 0
        if extremum >= -level:
            return reached, 0
        b, fb, column, fa = reached, side * extremum, 0, now[0]
    return -1.0, 0


@njit(error_model="numpy", **ONLY_COMPILED)
def set_side(room, values_at, row, length):
    """Set the sign of an event before its next zero: the sign of its value, or of its rate where it vanishes."""
    level, values, sides = ZERO * reals_at(room.scales)[row], reals_at(values_at), reals_at(room.sides)
    sides[row] = 0.0
    if abs(values[3 * row]) > level:
        sides[row] = np.sign(values[3 * row])
    elif abs(values[3 * row + 1]) * length > level:
        sides[row] = np.sign(values[3 * row + 1])


@njit(error_model="numpy", **ONLY_COMPILED)
def grow_scales(watched, room, values_at):
    """Update the largest moduli of the terms of events, and of rates and accelerations of gaps, from `room.normals`."""
    values, scales, largest = reals_at(values_at), reals_at(room.scales), reals_at(room.largest)
    normals = reals_at(room.normals)
    for i in range(watched.events + watched.gaps):
        scales[i] = max(scales[i], values[3 * i + 2])
    for j in range(watched.gaps):
        largest[0] = max(largest[0], normals[watched.width * j + 2])
        largest[1] = max(largest[1], abs(normals[watched.width * j]))


@njit(error_model="numpy", **ONLY_COMPILED)
def log(watched, room, progress, row, action, step, start, length, t, before):
    """Add an event to the log; `start` and `length` are those of the part of the step that leads to the event.

    `before` is the address of the state before the event; the state after the event is `room.now`.
    """
    n, size, mask, is_closed = progress[4], watched.size, 0, integers_at(room.is_closed)
    for j in range(watched.gaps):
        mask |= is_closed[j] << j
    rows, times = ahead(integers_at(room.rows), 4 * n), ahead(reals_at(room.times), 3 * n)
    rows[0], rows[1], rows[2], rows[3] = row, action, step, mask
    times[0], times[1], times[2] = start, length, t
    for part in range(2):
        copy(size, before, room.states + 8 * size * (3 * n + part))
    copy(size, room.now, room.states + 8 * size * (3 * n + 2))
    progress[4] = n + 1


@njit(error_model="numpy", **ONLY_COMPILED)
def settle(watched, room, progress, step, t, length, parameters_at, forced):
    """Resolve impacts and contacts at `room.now`; return 0 or a negative outcome.

    `forced` is a gap that has just vanished, or -1. Impacts at one time follow each other in the order of the gaps.
    """
    half, width, first, is_hit = watched.size // 2, watched.width, watched.events, False
    now, normals, values = reals_at(room.now), reals_at(room.normals), ahead(reals_at(room.values_trial), 3 * first)
    scales, largest = ahead(reals_at(room.scales), first), reals_at(room.largest)
    is_closed, closed, forces = integers_at(room.is_closed), integers_at(room.closed), reals_at(room.forces)
    for _ in range(MOST_EVENTS):
        if progress[4] >= progress[6]:
            return ACCUMULATED
        call(watched.values, (room.now, t, parameters_at, room.values_trial))
        call(watched.normals, (room.now, t, parameters_at, room.normals))
        grow_scales(watched, room, room.values_trial)
        impact = -1
        for j in range(watched.gaps):
            touches = is_closed[j] or j == forced or values[3 * j] <= ZERO * scales[j]
            # A gap that has just vanished has an impact at any negative rate, the first time.
            if touches and values[3 * j + 1] < (0.0 if j == forced and not is_hit else -SLOW * largest[0]):
                impact = j
                break
        if impact >= 0:
            admittance, rate = product(watched, room, impact, impact), values[3 * impact + 1]
            if not admittance > 0.0:
                return NO_CONTACT
            copy(watched.size, room.now, room.pushed)
            impulse = -(1.0 + normals[width * impact + 1]) * rate / admittance
            for i in range(half):
                now[half + i] += impulse * normals[width * impact + 3 + i]
            log(watched, room, progress, first + impact, IMPACT, step, t, 0.0, t, room.pushed)
            is_closed[impact], is_hit = 0, True
            continue
        count = count_closed(watched, room)
        if count > 0 and not solve_forces(watched, room, count):
            return NO_CONTACT
        weakest, opening = 0.0, -1
        for a in range(count):
            j = closed[a]
            if values[3 * j + 1] > SLOW * largest[0]:
                opening = j
                break
            if forces[a] < -WEAK * largest[1] / product(watched, room, j, j) and forces[a] < weakest:
                weakest, opening = forces[a], j
        if opening >= 0:
            log(watched, room, progress, first + opening, OPENING, step, t, 0.0, t, room.now)
            is_closed[opening] = 0
            continue
        strongest, closing, wait = 0.0, -1, 0.0
        for j in range(watched.gaps):
            if is_closed[j] or not (j == forced or values[3 * j] <= ZERO * scales[j]):
                continue
            acceleration = normals[width * j]  # under the forces of the closed gaps
            for a in range(count):
                acceleration += forces[a] * product(watched, room, j, closed[a])
            if not acceleration < (-WEAK * largest[1] if j != forced else 0.0):
                continue
            rate = max(values[3 * j + 1], 0.0)
            left = 2.0 * rate / -acceleration / max(1.0 - normals[width * j + 1], ELASTIC)
            is_low = 0.5 * rate * rate / -acceleration <= LOW * scales[j]
            # A gap that has vanished although it grows is zero to rounding.
            is_settled = left <= SETTLED * length or is_low or (j == forced and not is_hit)
            if is_settled and acceleration < strongest:
                strongest, closing, wait, is_hit = acceleration, j, left, True
        if closing < 0:
            return 0
        copy(watched.size, room.now, room.pushed)
        log(watched, room, progress, first + closing, REST, step, t, 0.0, t + wait, room.pushed)
        is_closed[closing] = 1
        if not keep_closed(watched, room, room.now, t, parameters_at):
            return NO_CONTACT
        copy(watched.size, room.now, room.states + 8 * watched.size * (3 * progress[4] - 1))
    return ACCUMULATED


@njit(error_model="numpy", **ONLY_COMPILED)
def watched_step(scheme, work, watched, room, progress, step, t, length, parameters_at):
    """Make a step of `room.now` with all events; return 0, STOPPED or a negative outcome, and the iterations."""
    done, iterations, fired, count = 0.0, 0, 0, watched.events + watched.gaps
    values_now, values_end = reals_at(room.values_now), reals_at(room.values_end)
    quick, rules, is_closed = integers_at(room.quick), integers_at(room.rules), integers_at(room.is_closed)
    scales, largest, sides = reals_at(room.scales), reals_at(room.largest), reals_at(room.sides)
    for i in range(watched.events):
        quick[i] = 0
    while True:
        at, left = t + done, length - done
        watch(watched, room, room.now, at, length, parameters_at, room.values_now)
        grow_scales(watched, room, room.values_now)
        for j in range(watched.gaps):
            row = watched.events + j
            is_closing = values_now[3 * row + 1] < -SLOW * largest[0] and values_now[3 * row] <= ZERO * scales[row]
            if is_closing and not is_closed[j]:
                copy(watched.size, room.now, room.end)
                outcome = settle(watched, room, progress, step, at, length, parameters_at, j)
                if outcome < 0:
                    return outcome, iterations
                refresh(watched, room, at, length, parameters_at, -1)
                watch(watched, room, room.now, at, length, parameters_at, room.values_now)
        outcome = move(scheme, work, watched, room, at, left, parameters_at, room.end)
        if outcome < 0:
            return outcome, iterations
        iterations += outcome
        watch(watched, room, room.end, at + left, length, parameters_at, room.values_end)
        grow_scales(watched, room, room.values_end)
        nearest, which = np.inf, -1
        for row in range(count):
            reached, outcome = first_zero(scheme, work, watched, room, at, left, row, parameters_at)
            if outcome < 0:
                return outcome, iterations
            if reached >= 0.0 and reached < nearest:
                nearest, which = reached, row
        if which < 0:
            copy(watched.size, room.end, room.now)
            for row in range(watched.events):
                if abs(values_end[3 * row]) > ZERO * scales[row]:
                    sides[row] = np.sign(values_end[3 * row])
            return 0, iterations
        fired += 1
        if fired > MOST_EVENTS or progress[4] >= progress[6]:
            return ACCUMULATED, iterations
        outcome = move(scheme, work, watched, room, at, nearest, parameters_at, room.end)
        if outcome < 0:
            return outcome, iterations
        first, outcome = progress[4], 0
        copy(watched.size, room.now, room.trial)
        copy(watched.size, room.end, room.now)
        done, instant = done + nearest, at + nearest
        left, action, gap, closing = length - done, rules[3 * which], which - watched.events, -1
        if gap >= 0 and is_closed[gap]:
            log(watched, room, progress, which, OPENING, step, at, nearest, instant, room.end)
            is_closed[gap] = 0
        elif gap >= 0:
            closing = gap
        else:
            if action == CHANGE:
                call(watched.jumps, (room.end, instant, parameters_at, room.jumps))
                copy(watched.size, room.jumps + 8 * watched.size * rules[3 * which + 2], room.now)
                quick[which] = quick[which] + 1 if nearest < QUICK * length else 0
                if quick[which] > MOST_QUICK:
                    outcome = ACCUMULATED
                elif violates(watched, room, instant, parameters_at):
                    outcome = VIOLATED
            log(watched, room, progress, which, action, step, at, nearest, instant, room.end)
            if action == STOP:
                copy(watched.size, room.trial, room.states + 8 * watched.size * 3 * first)
                return STOPPED, iterations
        if outcome == 0 and watched.gaps and (gap >= 0 or action == CHANGE):
            outcome = settle(watched, room, progress, step, instant, length, parameters_at, closing)
        if progress[4] > first:  # the first event at this time follows from a part of the step
            times = ahead(reals_at(room.times), 3 * first)
            times[0], times[1] = at, nearest
            copy(watched.size, room.trial, room.states + 8 * watched.size * 3 * first)
        if outcome < 0:
            return outcome, iterations
        refresh(watched, room, instant, length, parameters_at, which)
        # The changes of a bouncing body become smaller than rounding errors; then the next side is unknown.
        if gap < 0 and action == CHANGE and sides[which] == 0.0 and quick[which] > 0:
            return ACCUMULATED, iterations
        if left <= 2.0 * REACHED * max(length, abs(t)):
            return 0, iterations


@njit(error_model="numpy", **ONLY_COMPILED)
def violates(watched, room, t, parameters_at):
    """Return True if a gap is negative in the state `room.now`."""
    values = reals_at(room.values_trial)
    call(watched.values, (room.now, t, parameters_at, room.values_trial))
    for row in range(watched.events, watched.events + watched.gaps):
        if values[3 * row] < -INSIDE * values[3 * row + 2]:
            return True
    return False


@njit(error_model="numpy", **ONLY_COMPILED)
def refresh(watched, room, t, length, parameters_at, fired):
    """Set the signs of the event that `fired`, and of events whose values have changed by its effect."""
    after, before, scales = reals_at(room.values_trial), reals_at(room.values_end), reals_at(room.scales)
    watch(watched, room, room.now, t, length, parameters_at, room.values_trial)
    call(watched.values, (room.end, t, parameters_at, room.values_end))
    for row in range(watched.events):
        if row == fired or abs(after[3 * row] - before[3 * row]) > ZERO * scales[row]:
            set_side(room, room.values_trial, row, length)


@njit(cache=True, error_model="numpy", nogil=True)
def follow_watched(
    scheme, watched, memory, room, progress, steps, h, parameters, every, path, before, spans, marks
):  # fmt: skip
    """Make steps with events until the last step, a stop, a failure, or a full log; return the outcome.

    `progress` (8,) has the number of steps made, the rows of `path` in use, the steps until the next storage,
    iterations, the number of rows of the log in use, 1 before the first call, the largest number of these rows in this
    step, and the row of the first event. `marks` (steps,) are set for steps with events or closed gaps. Other arguments
    are as in `steps.follow`.
    """
    if room.capacity - progress[4] < MOST_EVENTS:
        return FULL
    parameters_at, size = parameters.ctypes.data, watched.size
    work = work_in(scheme, memory, h, parameters_at)
    states, states_before = reals_at(data_of(path)), reals_at(data_of(before))
    saved, now = reals_at(work.now), reals_at(room.now)
    if progress[5] == 1:
        progress[5], progress[6] = 0, progress[4] + MOST_EVENTS - 2
        length = spans[0, 1] if spans.shape[0] > 0 else h
        for i in range(size):
            path[0, i] = now[i]
        for j in range(watched.gaps):
            reals_at(room.sides)[watched.events + j] = 1.0
        watch(watched, room, room.now, 0.0, length, parameters_at, room.values_now)
        grow_scales(watched, room, room.values_now)
        if watched.gaps:
            outcome = settle(watched, room, progress, 0, 0.0, length, parameters_at, -1)
            if outcome < 0:
                return outcome
        watch(watched, room, room.now, 0.0, length, parameters_at, room.values_now)
        for row in range(watched.events):
            set_side(room, room.values_now, row, length)
    for k in range(progress[0], steps):
        if room.capacity - progress[4] < MOST_EVENTS:
            return FULL
        t, length = k * h, h
        if spans.shape[0] > 0:
            t, length = spans[k, 0], spans[k, 1]
        copy(size, room.now, work.now)
        logged = progress[4]
        progress[6] = logged + MOST_EVENTS - 2
        marks[k] = count_closed(watched, room) > 0
        outcome, iterations = watched_step(scheme, work, watched, room, progress, k, t, length, parameters_at)
        marks[k] |= progress[4] > logged or count_closed(watched, room) > 0
        progress[3] += iterations
        if outcome < 0:
            progress[1] = stored_last(progress[2], every, progress[1], size, saved, states)
            return outcome
        last = k + 1 if outcome == STOPPED else steps
        progress[0] = k + 1
        progress[2], progress[1] = stored(
            k + 1, last, every, progress[2], progress[1], size, saved, now, states, states_before
        )
        if outcome == STOPPED:
            return STOPPED
    return 0


@njit(cache=True, error_model="numpy", nogil=True)
def residual_with_events(scheme, watched, memory, room, progress, h, parameters, every, path, before, spans, marks):
    """Return the largest residual of a motion with events.

    Steps without events are evaluated as in other motions, those to stored states alone. Parts of the other steps are
    made again, and the differences of the states are divided by the length of a step. Other arguments are those of
    `follow_watched` after the motion.
    """
    made, rows, largest, row = progress[0], progress[1], 0.0, 1
    while row < rows:
        begin = row
        while row < rows and marks[min(row * every, made) - 1] == 0:
            row += 1
        count = row - begin
        if count == 0:
            row += 1
            continue
        lengths = np.empty((count, 2))
        for i in range(count):
            k = min((begin + i) * every, made) - 1
            lengths[i, 0], lengths[i, 1] = k * h, h
            if spans.shape[0] > 0:
                lengths[i, 0], lengths[i, 1] = spans[k, 0], spans[k, 1]
        residual = largest_residual(
            scheme, memory, before[begin - 1 : row - 1], path[begin - 1 : row], count + 1, count, h, parameters,
            watched.tolerance, watched.most, 1, lengths,
        )  # fmt: skip
        largest = max(largest, residual)
    return max(largest, largest_defect(scheme, watched, memory, room, progress[7], progress[4], h, parameters))


@njit(error_model="numpy")
def largest_defect(scheme, watched, memory, room, first, last, h, parameters):
    """Return the largest defect of the parts of steps that lead to the events `first` to `last` - 1 of the log.

    Each part is made again. Defects are relative to the length h of a step.
    """
    parameters_at, largest, is_closed, size = parameters.ctypes.data, 0.0, integers_at(room.is_closed), watched.size
    work, end = work_in(scheme, memory, h, parameters_at), reals_at(room.end)
    for i in range(first, last):
        times, mask = ahead(reals_at(room.times), 3 * i), integers_at(room.rows)[4 * i + 3]
        if not times[1] > 0.0:
            continue
        for j in range(watched.gaps):
            is_closed[j] = (mask >> j) & 1
        start = room.states + 8 * size * 3 * i
        before = reals_at(start + 8 * size)
        copy(size, start, room.now)
        if move(scheme, work, watched, room, times[0], times[1], parameters_at, room.end) < 0:
            return np.inf
        for k in range(size):
            largest = max(largest, abs(end[k] - before[k]) / h)
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
