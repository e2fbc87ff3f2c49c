"""The motion on a part of a step, with gaps that are closed.

A closed gap acts as a constraint by impulses lambda at both nodes of a step of the scheme, as in RATTLE,

    p_k + G(q_k)^T lambda,    the step,    p_k1 + G(q_k1)^T mu    with g(q_k1) = 0 and dg/dt = 0 at the end.

A closed gap opens where the contact force would pull. Several contact forces solve a linear complementarity problem.

`events` explains the arguments.

Source: Brogliato (2016), Nonsmooth mechanics, chapters 5 and 7; Broyden (1965), A class of methods for solving
nonlinear equations.
"""

import numpy as np
from numba import carray, njit

from codegen.runtime.addresses import call, integers_at, reals_at
from codegen.runtime.arithmetic import factor_matrix, solve_factored
from codegen.runtime.kernels import ONLY_COMPILED
from codegen.runtime.stepping.steps import advance, checked, set_length

ZERO = 1e-13  # a value below this fraction of its terms is zero
NO_CONTACT = -6  # the outcome of a failed step
CORRECTIONS = 40  # largest number of Broyden steps for contact impulses


@njit(error_model="numpy", **ONLY_COMPILED)
def copy(size, source, target):
    """Copy a state; both arguments are addresses."""
    a, b = reals_at(source), reals_at(target)
    for i in range(size):
        b[i] = a[i]


@njit(error_model="numpy", **ONLY_COMPILED)
def reach(scheme, work, watched, state, t, length, parameters_at, end):
    """Make a step of any length from the state at one address to another; return the iterations, or an outcome."""
    set_length(scheme, work, length)
    copy(watched.size, state, work.begin)
    outcome = advance(scheme, work, t, watched.tolerance, watched.most, parameters_at)
    outcome = checked(outcome, watched.size, reals_at(work.begin))
    copy(watched.size, work.begin, end)
    return outcome


@njit(error_model="numpy", **ONLY_COMPILED)
def move(scheme, work, watched, room, t, length, parameters_at, end):
    """Make a step of any length from `room.now`, with the impulses of closed gaps, to the address `end`.

    Return the iterations, or a negative outcome.
    """
    count = count_closed(watched, room)
    if count > 0:
        return move_in_contact(scheme, work, watched, room, t, length, parameters_at, end, count)
    return reach(scheme, work, watched, room.now, t, length, parameters_at, end)


@njit(error_model="numpy", **ONLY_COMPILED)
def move_in_contact(scheme, work, watched, room, t, length, parameters_at, end, count):
    """Make a step with `count` closed gaps, whose impulses are found by Broyden's method; see `move`."""
    half, width = watched.size // 2, watched.width
    pushed, impulses, closed = reals_at(room.pushed), reals_at(room.impulses), integers_at(room.closed)
    normals, normals_end = reals_at(room.normals), reals_at(room.normals_end)
    values, scales, forces = reals_at(room.values_trial), reals_at(room.scales), reals_at(room.forces)
    excess, before, correction = reals_at(room.excess), reals_at(room.excess_before), reals_at(room.correction)
    matrix = reals_at(room.matrix)
    call(watched.normals, (room.now, t, parameters_at, room.normals))
    if not solve_forces(watched, room, count):
        return NO_CONTACT
    for a in range(count):
        impulses[a] = 0.5 * length * forces[a]
    iterations, best = 0, np.inf
    for trial in range(CORRECTIONS):
        copy(watched.size, room.now, room.pushed)
        for a in range(count):
            for i in range(half):
                pushed[half + i] += impulses[a] * normals[width * closed[a] + 3 + i]
        outcome = reach(scheme, work, watched, room.pushed, t, length, parameters_at, end)
        if outcome < 0:
            return outcome
        iterations += outcome
        call(watched.values, (end, t + length, parameters_at, room.values_trial))
        error = 0.0
        for a in range(count):
            row = watched.events + closed[a]
            excess[a] = values[3 * row] / length
            error = max(error, abs(values[3 * row]) / max(scales[row], values[3 * row + 2], 1e-300))
        if error <= 1e-15 or (trial > 2 and error <= ZERO and error >= 0.5 * best):
            break
        best = min(best, error)
        if trial == 0:
            call(watched.normals, (end, t + length, parameters_at, room.normals_end))
            for a in range(count):
                for b in range(count):
                    total = 0.0
                    for i in range(half):
                        response = normals[width * closed[b] + 3 + half + i]
                        total += normals_end[width * closed[a] + 3 + i] * response
                    matrix[count * a + b] = total
        else:
            square = 0.0
            for a in range(count):
                square += correction[a] ** 2
            if not square > 0.0:
                break
            for a in range(count):
                change = excess[a] - before[a]
                for b in range(count):
                    change -= matrix[count * a + b] * correction[b]
                before[a] = change / square
            for a in range(count):
                for b in range(count):
                    matrix[count * a + b] += before[a] * correction[b]
        for a in range(count):
            correction[a], before[a] = -excess[a], excess[a]
        if not solve_closed(room, count, room.correction):
            return NO_CONTACT
        for a in range(count):
            impulses[a] += correction[a]
    else:
        return NO_CONTACT
    if not keep_closed(watched, room, end, t + length, parameters_at):
        return NO_CONTACT
    return iterations


@njit(error_model="numpy", **ONLY_COMPILED)
def count_closed(watched, room):
    """List the closed gaps in `room.closed`, and return their number."""
    count, is_closed, closed = 0, integers_at(room.is_closed), integers_at(room.closed)
    for j in range(watched.gaps):
        if is_closed[j]:
            closed[count] = j
            count += 1
    return count


@njit(error_model="numpy", **ONLY_COMPILED)
def solve_closed(room, count, right):
    """Solve the system of `room.matrix` for the closed gaps; return False if it is singular."""
    matrix, factors = reals_at(room.matrix), carray(reals_at(room.factors), (count, count))
    pivots = carray(integers_at(room.pivots), (count,))
    for a in range(count):
        for b in range(count):
            factors[a, b] = matrix[count * a + b]
    if factor_matrix(factors, pivots) >= 0:
        return False
    solve_factored(factors, pivots, carray(reals_at(right), (count,)))
    return True


@njit(error_model="numpy", **ONLY_COMPILED)
def product(watched, room, i, j):
    """Return G_i M^-1 G_j^T of two gaps from `room.normals`."""
    half, width, normals, total = watched.size // 2, watched.width, reals_at(room.normals), 0.0
    for k in range(half):
        total += normals[width * i + 3 + k] * normals[width * j + 3 + half + k]
    return total


@njit(error_model="numpy", **ONLY_COMPILED)
def fill_closed(watched, room, count):
    """Fill the matrix G M^-1 G^T of the closed gaps from `room.normals`."""
    matrix, closed = reals_at(room.matrix), integers_at(room.closed)
    for a in range(count):
        for b in range(count):
            matrix[count * a + b] = product(watched, room, closed[a], closed[b])


@njit(error_model="numpy", **ONLY_COMPILED)
def solve_forces(watched, room, count):
    """Solve for the contact forces of the closed gaps from `room.normals`; return False if they are not determined."""
    closed, normals, forces = integers_at(room.closed), reals_at(room.normals), reals_at(room.forces)
    largest = reals_at(room.largest)
    fill_closed(watched, room, count)
    for a in range(count):
        forces[a] = -normals[watched.width * closed[a]]
        largest[1] = max(largest[1], abs(forces[a]))
    return solve_closed(room, count, room.forces)


@njit(error_model="numpy", **ONLY_COMPILED)
def keep_closed(watched, room, state_at, t, parameters_at):
    """Project the momenta of a state so that the rates of the closed gaps vanish; return False without a solution."""
    count, half, width = count_closed(watched, room), watched.size // 2, watched.width
    state, normals, correction = reals_at(state_at), reals_at(room.normals), reals_at(room.correction)
    values, closed = reals_at(room.values_trial), integers_at(room.closed)
    call(watched.normals, (state_at, t, parameters_at, room.normals))
    fill_closed(watched, room, count)
    for _ in range(2):
        call(watched.values, (state_at, t, parameters_at, room.values_trial))
        for a in range(count):
            correction[a] = -values[3 * (watched.events + closed[a]) + 1]
        if not solve_closed(room, count, room.correction):
            return False
        for a in range(count):
            for i in range(half):
                state[half + i] += correction[a] * normals[width * closed[a] + 3 + i]
    return True
