"""Steps of an initial value problem, in compiled code that calls the kernels of the problem by address.

Implicit steps are solved by Newton's method. Its first correction is exact if the equations are linear. Where Newton's
method fails, the length of the step grows from zero, and each solution is the initial guess of the next.

Source: Allgower and Georg (2003), Introduction to numerical continuation methods, chapter 2.
"""

from typing import NamedTuple

import numpy as np
from numba import carray, njit

from codegen.runtime.addresses import ahead, call, call_value, data_of, integers_at, moved, reals_at
from codegen.runtime.arithmetic import factor_band, solve_band
from codegen.runtime.kernels import ONLY_COMPILED

NON_FINITE, SINGULAR, NOT_CONVERGED, LEFT_TABLE = -1, -2, -3, -4  # outcomes of a failed step
LEAST = 1e-300  # smaller numbers are close to underflow and have no relative size
ROUNDING = 1e-8  # corrections below this, relative to all unknowns, are rounding errors if they no longer shrink
CANCELLED = 10.0  # a correction that exceeds the sum of all unknowns by this factor leaves rounding errors
FIRST_GROWTH, LEAST_GROWTH = 0.125, 1e-5  # of the length of a step in a continuation, relative to the full length
MOST_LENGTHS, FEW = 200, 12  # numbers of lengths in a continuation, and of iterations for each of them
TABLE_MARGIN = 1e-8  # an input may exceed the range of a table by this rounding error, relative to the range

EQUAL = np.empty((0, 2))  # the spans of equal steps

INLINED = njit(error_model="numpy", forceinline=True, **ONLY_COMPILED)


class Scheme(NamedTuple):
    """The data of a `StepProblem` for compiled code, all as integers, so that passing them counts no references.

    The first seven fields are addresses of kernels, 0 for a missing kernel. Then follow numbers. `fractions` and
    `ranges` are the addresses of the arrays (parts, lengths) and (inputs, 2) of the problem. `below` and `above` are
    the numbers of diagonals of the Jacobian on both sides of its main diagonal.
    """

    explicit: int
    predict: int
    residual: int
    jacobian: int
    complete: int
    equations: int
    used_inputs: int
    state: int
    stages: int
    unknowns: int
    is_iterated: int
    is_constant: int
    parts: int
    lengths: int
    inputs: int
    fractions: int
    ranges: int
    below: int
    above: int


class Work(NamedTuple):
    """Addresses of the work arrays of a step; the caller keeps the memory alive.

    Attributes
    ----------
    lengths : int
        Lengths (parts, lengths) of all parts of a step.
    now, begin : int
        The state (state,) before a step, and at the start of a part.
    interval : int
        Values inside a part, then the state at its end, (stages + state,).
    seen : int
        The least and the greatest value (inputs, 2) of each input of a table.
    unknowns, residual, jacobian, pivots : int
        Work space of Newton's method.
    sizes, last : int
        Magnitudes of the unknowns, and the last corrections, for the convergence test.
    shorter : int
        Lengths (lengths,) of a part of a step that is shortened for a continuation.
    reached, earlier : int
        The unknowns that solve the equations for the last two lengths of a continuation.
    defects : int
        Residuals (stages + state,) of the equations of the scheme.
    """

    lengths: int
    now: int
    begin: int
    interval: int
    seen: int
    unknowns: int
    residual: int
    jacobian: int
    pivots: int
    sizes: int
    last: int
    shorter: int
    reached: int
    earlier: int
    defects: int


def memory_for(scheme):
    """Return zeroed memory for the work arrays of a step."""
    count = scheme.unknowns
    lengths = (scheme.parts + 1) * scheme.lengths
    size = lengths + 4 * (scheme.stages + scheme.state) + 2 * scheme.inputs + count * (count + 7)
    return np.zeros(size)


@njit(error_model="numpy")
def work_in(scheme, memory, h, parameters_at):
    """Return the addresses of the work arrays in `memory`, for steps of length h.

    A matrix that is the same for all steps is factored here. If it is singular, the first pivot is set to -1.
    """
    count, size = scheme.unknowns, scheme.state
    lengths = memory.ctypes.data
    now = moved(lengths, scheme.parts * scheme.lengths)
    begin = moved(now, size)
    interval = moved(begin, size)
    seen = moved(interval, scheme.stages + size)
    unknowns = moved(seen, 2 * scheme.inputs)
    residual, sizes = moved(unknowns, count), moved(unknowns, 2 * count)
    last, pivots = moved(unknowns, 3 * count), moved(unknowns, 4 * count)
    jacobian_at = moved(unknowns, 5 * count)
    reached = moved(jacobian_at, count * count)
    shorter = moved(reached, 2 * count)
    work = Work(
        lengths, now, begin, interval, seen, unknowns, residual, jacobian_at, pivots, sizes, last, shorter, reached,
        moved(reached, count), moved(shorter, scheme.lengths),
    )  # fmt: skip
    for i in range(memory.size):
        memory[i] = 0.0
    set_length(scheme, work, h)
    if scheme.is_constant:
        call(scheme.jacobian, (unknowns, begin, 0.0, lengths, parameters_at, residual, work.jacobian))
        if count > 1:
            jacobian, factored = carray(reals_at(work.jacobian), (count, count)), carray(integers_at(pivots), (count,))
            if factor_band(jacobian, factored, scheme.below, scheme.above) >= 0:
                factored[0] = -1
    return work


@njit(error_model="numpy")
def set_length(scheme, work, h):
    """Set the lengths of all parts of a step of length h."""
    count = scheme.parts * scheme.lengths
    lengths, fractions = carray(reals_at(work.lengths), (count,)), carray(reals_at(scheme.fractions), (count,))
    for i in range(count):
        lengths[i] = h * fractions[i]


@njit(error_model="numpy", forceinline=True)
def advance(scheme, work, t, tolerance, most, parameters_at):
    """Make a step: replace the state at the address `work.begin` by the state at the end of the step.

    Return the number of iterations, or the negative outcome of a failure. `t` is the time at the start. A part of a
    step is solved when the relative size of a correction is at most `tolerance`. `most` is the largest number of
    iterations of a part.
    """
    state, iterations = carray(reals_at(work.begin), (scheme.state,)), 0
    after = carray(reals_at(moved(work.interval, scheme.stages)), (scheme.state,))
    lengths = carray(reals_at(work.lengths), (scheme.parts, scheme.lengths))
    for part in range(scheme.parts):
        lengths_at = moved(work.lengths, part * scheme.lengths)
        if scheme.unknowns == 0:
            call(scheme.explicit, (work.begin, t, lengths_at, parameters_at, work.interval))
        else:
            outcome = solve_part(scheme, work, t, lengths_at, tolerance, most, parameters_at)
            if outcome < 0:
                return outcome
            iterations += outcome
        if scheme.inputs and first_left(scheme, work, t, lengths_at, parameters_at) >= 0:
            return LEFT_TABLE
        for i in range(scheme.state):
            state[i] = after[i]
        for i in range(scheme.lengths):
            t += lengths[part, i]
    return iterations


@njit(error_model="numpy")
def solve_part(scheme, work, t, lengths_at, tolerance, most, parameters_at):
    """Solve the equations of a part of a step from `work.begin`; return the iterations, or a negative outcome."""
    call(scheme.predict, (work.begin, t, lengths_at, parameters_at, work.unknowns))
    outcome = iterate(scheme, work, t, lengths_at, tolerance, most, parameters_at)
    if outcome < 0 and scheme.is_iterated:
        effort = continue_in_length(scheme, work, t, lengths_at, tolerance, most, parameters_at)
        return effort if effort > 0 else outcome
    return outcome


@njit(error_model="numpy")
def continue_in_length(scheme, work, t, lengths_at, tolerance, most, parameters_at):
    """Solve the equations of a part for lengths that grow from zero to the full length; return the iterations.

    Without a prediction, the unknowns at length zero are the values at the start. Each further initial guess continues
    the last two solutions linearly. The growth doubles after a success, and is quartered after a failure. Return -1 if
    the growth becomes too small, as at a length beyond which the equations have no solution.
    """
    count, at, before, growth, iterations = scheme.unknowns, 0.0, 0.0, FIRST_GROWTH, 0
    lengths, shorter = (
        carray(reals_at(lengths_at), (scheme.lengths,)),
        carray(reals_at(work.shorter), (scheme.lengths,)),
    )
    unknowns, reached = carray(reals_at(work.unknowns), (count,)), carray(reals_at(work.reached), (count,))
    earlier = carray(reals_at(work.earlier), (count,))
    for i in range(scheme.lengths):
        shorter[i] = 0.0
    call(scheme.predict, (work.begin, t, work.shorter, parameters_at, work.unknowns))
    for i in range(count):
        reached[i] = earlier[i] = unknowns[i]
    for _ in range(MOST_LENGTHS):
        end = min(1.0, at + growth)
        for i in range(scheme.lengths):
            shorter[i] = end * lengths[i]
        slope = (end - at) / (at - before) if at > before else 0.0
        for i in range(count):
            unknowns[i] = reached[i] + slope * (reached[i] - earlier[i])
        outcome = iterate(scheme, work, t, work.shorter, tolerance, min(most, FEW), parameters_at)
        if outcome < 0:
            growth *= 0.25
            if growth < LEAST_GROWTH:
                return -1
            continue
        iterations += outcome
        if end == 1.0:
            return iterations
        for i in range(count):
            earlier[i], reached[i] = reached[i], unknowns[i]
        at, before, growth = end, at, 2.0 * growth
    return -1


@njit(error_model="numpy")
def iterate(scheme, work, t, lengths_at, tolerance, most, parameters_at):
    """Solve the equations of a part of a step by Newton's method; return the iterations, or a negative outcome.

    `work.unknowns` are the initial guess. Corrections are taken in full. A line search is no help: shortened
    corrections ended in spurious minima of the residual as often as in a solution.
    """
    count, magnitude = scheme.unknowns, 0.0
    unknowns, residual = carray(reals_at(work.unknowns), (count,)), carray(reals_at(work.residual), (count,))
    jacobian, pivots = carray(reals_at(work.jacobian), (count, count)), carray(integers_at(work.pivots), (count,))
    sizes, last = carray(reals_at(work.sizes), (count,)), carray(reals_at(work.last), (count,))
    state = carray(reals_at(work.begin), (scheme.state,))
    for i in range(state.size):
        magnitude += abs(state[i])
    for i in range(count):
        sizes[i], last[i] = max(0.5 * sizes[i], LEAST), np.inf
    arguments = work.unknowns, work.begin, t, lengths_at, parameters_at
    for iteration in range(1, most + 1):
        if scheme.is_constant:
            call(scheme.residual, (*arguments, work.residual))
        else:
            for i in range(count):  # exchanges of rows have widened the band
                for j in range(max(0, i - scheme.below), min(count, i + scheme.below + scheme.above + 1)):
                    jacobian[i, j] = 0.0
            call(scheme.jacobian, (*arguments, work.residual, work.jacobian))
        if scheme.is_iterated:
            total = 0.0
            for i in range(count):
                total += abs(residual[i])
            if not total < np.inf:
                return NON_FINITE
        if count == 1:
            if not abs(jacobian[0, 0]) > 0.0:
                return SINGULAR
            residual[0] /= jacobian[0, 0]
        else:
            if pivots[0] < 0 if scheme.is_constant else factor_band(jacobian, pivots, scheme.below, scheme.above) >= 0:
                return SINGULAR
            solve_band(jacobian, pivots, residual, scheme.below, scheme.above)
        scale, correction = magnitude, 0.0
        for i in range(count):
            unknowns[i] -= residual[i]
            scale += abs(unknowns[i])
            correction += abs(residual[i])
        # Linear equations need one correction, and a second one if a guess was so large that digits are lost.
        done = not correction > CANCELLED * scale
        if scheme.is_iterated:
            done = has_converged(unknowns, residual, tolerance, ROUNDING * scale, sizes, last)
        if done:
            call(scheme.complete, (*arguments, work.interval))
            return iteration
    return NOT_CONVERGED


@njit(error_model="numpy", forceinline=True)
def has_converged(unknowns, corrections, tolerance, rounding, sizes, last):
    """Return True if each correction (unknowns,) is small, or is a rounding error that no longer shrinks.

    Newton's method squares the error: after a correction of relative size 1e-13 only rounding errors remain. Each
    correction is relative to its own unknown, also to the magnitude of this unknown a few steps ago. A sum over
    unknowns would depend on their units. `rounding` bounds corrections that may be rounding errors. `sizes` and `last`
    keep data for the next call.
    """
    settled = True
    for i in range(unknowns.size):
        change = abs(corrections[i])
        sizes[i] = max(sizes[i], abs(unknowns[i]))
        stagnates = change <= rounding and change >= 0.5 * last[i]
        settled = settled and (stagnates or change <= tolerance * sizes[i])
        last[i] = 0.0 if stagnates else change
    return settled


@njit(error_model="numpy")
def first_left(scheme, work, t, lengths_at, parameters_at):
    """Return the index of the first input of a table that leaves its range in a part of a step, or -1.

    `work.seen` takes the least and the greatest value of each input.
    """
    seen = carray(reals_at(work.seen), (scheme.inputs, 2))
    ranges, parameters = carray(integers_at(scheme.ranges), (scheme.inputs, 2)), reals_at(parameters_at)
    for j in range(scheme.inputs):
        seen[j, 0], seen[j, 1] = np.inf, -np.inf
    call(scheme.used_inputs, (work.begin, work.interval, t, lengths_at, parameters_at, work.seen))
    for j in range(scheme.inputs):
        least, greatest = parameters[ranges[j, 0]], parameters[ranges[j, 1]]
        margin = TABLE_MARGIN * (greatest - least)
        if seen[j, 0] < least - margin or seen[j, 1] > greatest + margin:
            return j
    return -1


@INLINED
def checked(outcome, size, after):
    """Return the outcome of a step, or NON_FINITE if a number of the state after the step is not finite.

    `after` is a pointer to this state (size,).
    """
    total = 0.0
    for i in range(size):
        total += abs(after[i])
    return outcome if outcome < 0 or total < np.inf else NON_FINITE


@INLINED
def stored(made, steps, every, wait, rows, size, now, after, path, before):
    """Store the state (size,) `after` a step if it is due; return the steps until the next storage and the rows in use.

    `made` is the number of steps made, and `wait` counts the steps until the next storage. The rows of `path` (M, size)
    take every `every`-th state and the last state. Row i of `before` takes the state one step before row i + 1 of
    `path`. With `every` 1 nothing is written to `before`. Then `after` is copied to `now`. All arrays are pointers.
    """
    wait -= 1
    if wait == 0 or made == steps:
        for i in range(size):
            path[rows * size + i] = after[i]
        if every > 1:
            for i in range(size):
                before[(rows - 1) * size + i] = now[i]
        rows, wait = rows + 1, every
    for i in range(size):
        now[i] = after[i]
    return wait, rows


@INLINED
def stored_last(wait, every, rows, size, now, path):
    """Store the last good state `now` (size,) in `path` unless it is already stored; return the rows in use."""
    if wait < every:
        for i in range(size):
            path[rows * size + i] = now[i]
        rows += 1
    return rows


@njit(cache=True, error_model="numpy", nogil=True)
def follow(scheme, memory, start, steps, h, parameters, tolerance, most, every, path, before, spans):
    """Make all steps from the state `start` (state,), and store states in `path` and `before` (M, state).

    All steps have the length h, unless `spans` (steps, 2) has the time at the start and the length of each. `stored`
    explains `every`, `path` and `before`. A step that fails ends the motion; the last good state is then stored. Return
    four numbers: the steps made, the rows of `path` in use, the iterations, and the outcome. The outcome is 0, or a
    negative number for the reason of a failure.
    """
    parameters_at, size = parameters.ctypes.data, scheme.state
    work = work_in(scheme, memory, h, parameters_at)
    now, after, rows, iterations, wait = reals_at(work.now), reals_at(work.begin), 1, 0, every
    states, states_before = reals_at(data_of(path)), reals_at(data_of(before))
    for i in range(size):
        path[0, i] = after[i] = now[i] = start[i]
    for k in range(steps):
        t = k * h
        if spans.shape[0] > 0:
            t = spans[k, 0]
            set_length(scheme, work, spans[k, 1])
        outcome = checked(advance(scheme, work, t, tolerance, most, parameters_at), size, after)
        if outcome < 0:
            break
        iterations += outcome
        wait, rows = stored(k + 1, steps, every, wait, rows, size, now, after, states, states_before)
    else:
        k, outcome = steps, 0
    if outcome < 0:
        rows = stored_last(wait, every, rows, size, now, states)
    return k, rows, iterations, outcome


@INLINED
def follow_explicitly(
    step, size, stages, parts, count, state, now, interval, lengths, numbers, parameters, path, before, outcome
):  # fmt: skip
    """Make all steps of an explicit scheme, by a function `step` that is inlined; store states as `follow` does.

    A step has `parts` parts, each with `count` lengths. All arrays are pointers. `state` and `now` hold the first
    state. `numbers` holds the number of steps, their length and `every`. `outcome` takes the results of `follow`.
    """
    steps, h, every = int(numbers[0]), numbers[1], int(numbers[2])
    rows, wait, made, reason = 1, every, 0, 0
    for i in range(size):
        path[i] = state[i]
    for k in range(steps):
        t = k * h
        for part in range(parts):
            step(state, t, ahead(lengths, part * count), parameters, interval)
            for i in range(size):
                state[i] = interval[stages + i]
            for i in range(count):
                t += lengths[part * count + i]
        reason = checked(0, size, state)
        if reason < 0:
            rows = stored_last(wait, every, rows, size, now, path)
            break
        made += 1
        wait, rows = stored(made, steps, every, wait, rows, size, now, state, path, before)
    outcome[0], outcome[1], outcome[2], outcome[3] = made, rows, 0, reason


@njit(cache=True, error_model="numpy", nogil=True)
def make_step(scheme, memory, start, t, h, parameters, tolerance, most, interval, seen):
    """Make one step from the state `start` (state,); return the iterations, or the negative outcome of a failure.

    `interval` (stages + state,) takes the inner stages and the end of the last part. `seen` (inputs, 2) takes the least
    and the greatest value of each input of a table in that part.
    """
    parameters_at = parameters.ctypes.data
    work = work_in(scheme, memory, h, parameters_at)
    begin, made = carray(reals_at(work.begin), (scheme.state,)), carray(reals_at(work.interval), (interval.size,))
    for i in range(scheme.state):
        begin[i] = start[i]
    outcome = advance(scheme, work, t, tolerance, most, parameters_at)
    for i in range(interval.size):
        interval[i] = made[i]
    inputs = carray(reals_at(work.seen), (scheme.inputs, 2))
    for j in range(scheme.inputs):
        seen[j, 0], seen[j, 1] = inputs[j, 0], inputs[j, 1]
    return outcome


def part_of_step(scheme, start, t, lengths, parameters, tolerance, most, interval):
    """Make one part of a step from the state `start` (state,) at time t; `lengths` are its lengths.

    Inputs of tables may leave their ranges. Other arguments and the result are as in `make_step`.
    """
    lengths = np.ascontiguousarray(lengths, dtype=float)
    alone = scheme._replace(parts=1, fractions=lengths.ctypes.data, inputs=0)
    arguments = memory_for(alone), start, float(t), 1.0, parameters, tolerance, most
    return make_step(alone, *arguments, interval, np.empty((0, 2)))


@njit(cache=True, error_model="numpy", nogil=True)
def largest_residual(scheme, memory, before, path, rows, steps, h, parameters, tolerance, most, every, spans):
    """Return the max-norm of the equations of the scheme, over the steps from `before` to `path`.

    For i from 1 to `rows` - 1, one step goes from row i - 1 of `before` to row i of `path` (M, state). `steps` is the
    number of steps of the motion. `spans` is as in `follow`. Inner stages and states between the parts of a step are
    not stored. They are computed again from the state before the step.
    """
    size, stages, parameters_at, largest = scheme.state, scheme.stages, parameters.ctypes.data, 0.0
    work = work_in(scheme, memory, h, parameters_at)
    state, interval = carray(reals_at(work.begin), (size,)), carray(reals_at(work.interval), (stages + size,))
    lengths = carray(reals_at(work.lengths), (scheme.parts, scheme.lengths))
    residual = carray(reals_at(work.defects), (stages + size,))
    for row in range(1, rows):
        k = min(row * every, steps) - 1
        t = k * h
        if spans.shape[0] > 0:
            t = spans[k, 0]
            set_length(scheme, work, spans[k, 1])
        for i in range(size):
            state[i] = before[row - 1, i]
        for part in range(scheme.parts):
            lengths_at, is_last = moved(work.lengths, part * scheme.lengths), part == scheme.parts - 1
            if stages > 0 or not is_last:
                if scheme.unknowns == 0:
                    call(scheme.explicit, (work.begin, t, lengths_at, parameters_at, work.interval))
                else:
                    solve_part(scheme, work, t, lengths_at, tolerance, most, parameters_at)
            if is_last:
                for i in range(size):
                    interval[stages + i] = path[row, i]
            call(scheme.equations, (work.begin, work.interval, t, lengths_at, parameters_at, work.defects))
            for i in range(stages + size):
                if not abs(residual[i]) < np.inf:
                    return np.inf
                largest = max(largest, abs(residual[i]))
            for i in range(size):
                state[i] = interval[stages + i]
            for i in range(scheme.lengths):
                t += lengths[part, i]
    return largest


@njit(cache=True, error_model="numpy", nogil=True)
def largest_constraints(constraints, count, path, times, parameters):
    """Return the largest modulus of each of `count` constraints and of its rate (2, count) along a `path` (M, size).

    `times` (M,) are the times of the states. `constraints` is the address of the kernel of a `StepProblem`.
    """
    largest, values = np.zeros((2, count)), np.zeros((count, 3 + path.shape[1] // 2))
    for row in range(path.shape[0]):
        state_at = path.ctypes.data + 8 * row * path.shape[1]
        call(constraints, (state_at, times[row], parameters.ctypes.data, values.ctypes.data))
        for i in range(count):
            for j in range(2):
                largest[j, i] = max(largest[j, i], abs(values[i, j]))
    return largest


@njit(cache=True, error_model="numpy", nogil=True)
def energies(energy, path, times, parameters, values):
    """Fill `values` (M,) with the Hamiltonian along the first M rows of `path` (.., size) at `times`.

    `energy` is the address of a compiled function that returns the Hamiltonian.
    """
    for row in range(values.size):
        state_at = path.ctypes.data + 8 * row * path.shape[1]
        values[row] = call_value(energy, (state_at, times[row], parameters.ctypes.data))
