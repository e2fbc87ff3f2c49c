"""Elimination of a symmetric matrix with pivots of one or two rows, which also counts the negative eigenvalues.

Rows are eliminated one or two at a time. The order is chosen during the elimination and kept as a list: no row is
moved. The factorisation is K = U' D U. If rows and columns are sorted by that order, U is upper triangular with a unit
diagonal. D holds the pivots. The factors are stored as the rows of U without the diagonal, and the inverse of D.

Rows are padded with zeros to a multiple of four. Entries are computed four at a time, which a compiler turns into one
instruction each (see `packed_operations`). Most functions are inlined, so that the compiler knows the numbers of rows
and columns as constants. This saves a quarter to a third of the time of a factorisation.

Sources: Bunch and Kaufman (1977), Some stable methods for calculating inertia and solving symmetric linear systems;
Higham (2002), Accuracy and stability of numerical algorithms, section 11.1.
"""

import numpy as np
from numba import njit

STEEP = 1e6  # largest curvature, relative to squared coefficients of equations, with which states are eliminated first
BALANCE = 0.6403882032022076  # (1 + sqrt(17)) / 8: entries grow equally with pivots of one and of two rows


@njit(error_model="numpy", forceinline=True)
def clear(matrix):
    """Set all entries of a matrix to zero."""
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            matrix[i, j] = 0.0


@njit(error_model="numpy", forceinline=True)
def eliminate_rows(matrix, first, count, width, upper, inverse, order):
    """Eliminate `count` unknowns; return the number of negative pivots, or -1 if a pivot vanishes or is not finite.

    The first `count` rows of `matrix` (.., width) are overwritten by D U. Columns from `count` on belong to unknowns
    that remain. `upper` (count, width) takes U without its unit diagonal. `order` (count,) takes the row that is
    eliminated at each position. `inverse` (count, 2), in that order, takes the inverse of the pivots: the diagonal, and
    the entry between a row and the next one. Rows before row `first` are eliminated already, see `eliminate_states`.
    """
    for c in range(first, count):
        order[c] = c
    negative, paired = 0, False
    for c in range(first, count):
        if paired:  # eliminated together with the row before it
            paired = False
            continue
        # The largest entry off the diagonal, and the largest one in the row of that entry, decide on the pivot.
        row, position = order[c], c + 1
        own, beside = abs(matrix[row, row]), largest_beside(matrix, row, count)
        if not 0.0 < max(own, beside) < np.inf:
            return -1
        if own < BALANCE * beside:
            while abs(matrix[row, order[position]]) != beside:
                position += 1
            other = order[position]
            largest = largest_beside(matrix, other, count)
            if own * largest < BALANCE * beside * beside:
                paired = abs(matrix[other, other]) < BALANCE * largest
                to = c + 1 if paired else c
                order[position], order[to] = order[to], order[position]
        row = order[c]
        if not paired and not abs(matrix[row, row]) > 1e-300:  # its reciprocal would overflow
            return -1
        if paired:
            eliminate_pair(matrix, c, count, width, upper, inverse, order)
            negative += 1
        else:
            negative += eliminate_one(matrix, c, count, width, upper, inverse, order)
    return negative


@njit(error_model="numpy", forceinline=True)
def are_determined(matrix, states):
    """Return True if `eliminate_states` is accurate for the first `states` rows of `matrix`.

    The equations need a zero diagonal. With a curvature above STEEP times the squared coefficients, such as the
    barrier's close to a bound, the Schur complement is a small difference of large numbers.
    """
    largest, least, is_zero = 0.0, np.inf, True
    for i in range(states):
        largest = max(largest, abs(matrix[i, i]))
        least = min(least, matrix[i, states + i] * matrix[i, states + i])
        is_zero = is_zero and matrix[states + i, states + i] == 0.0
    return is_zero and least > 0.0 and largest <= STEEP * least


# Sums keep their order (no "reassoc"), as in `subtract_products`.
@njit(error_model="numpy", fastmath={"contract"}, forceinline=True)
def eliminate_states(matrix, states, count, width, upper, inverse, order):
    """Eliminate the first `states` unknowns, each with the equation that determines it: a step of a Riccati recursion.

    The first rows of `matrix` (.., width) are the states at the end of an interval, the next `states` rows their
    equations: [[P, E, W], [E, 0, G], [W', G', H]], with a diagonal E. A state and its equation are a pivot of two rows
    with one negative eigenvalue. These pivots leave P and G as they are, and no search is needed. `eliminate_rows`
    explains the arrays; it eliminates the other rows up to `count` afterwards.
    """
    done = 2 * states
    first = done // 4 * 4  # columns before it belong to states and their equations
    for i in range(states):
        equation, reciprocal = states + i, 1.0 / matrix[i, states + i]
        curvature = matrix[i, i]
        order[2 * i], order[2 * i + 1] = i, equation
        inverse[2 * i, 0], inverse[2 * i, 1] = 0.0, reciprocal
        inverse[2 * i + 1, 0], inverse[2 * i + 1, 1] = -curvature * reciprocal * reciprocal, 0.0
        for j in range(first, width, 4):
            one, two, three, four = matrix[i, j], matrix[i, j + 1], matrix[i, j + 2], matrix[i, j + 3]
            for k in range(i):
                multiple = matrix[i, k]
                one -= multiple * upper[k, j]
                two -= multiple * upper[k, j + 1]
                three -= multiple * upper[k, j + 2]
                four -= multiple * upper[k, j + 3]
            matrix[i, j] = one
            matrix[i, j + 1] = two
            matrix[i, j + 2] = three
            matrix[i, j + 3] = four
            w, x = matrix[equation, j] * reciprocal, matrix[equation, j + 1] * reciprocal
            y, z = matrix[equation, j + 2] * reciprocal, matrix[equation, j + 3] * reciprocal
            upper[i, j] = w
            upper[i, j + 1] = x
            upper[i, j + 2] = y
            upper[i, j + 3] = z
            upper[equation, j] = (one - curvature * w) * reciprocal
            upper[equation, j + 1] = (two - curvature * x) * reciprocal
            upper[equation, j + 2] = (three - curvature * y) * reciprocal
            upper[equation, j + 3] = (four - curvature * z) * reciprocal
        for j in range(done):
            upper[i, j] = 0.0
            upper[equation, j] = matrix[i, j] * reciprocal if i < j < states else 0.0
    for row in range(done, count):
        for j in range(first, width, 4):
            one, two, three, four = matrix[row, j], matrix[row, j + 1], matrix[row, j + 2], matrix[row, j + 3]
            for k in range(done):
                multiple = matrix[k, row]
                one -= multiple * upper[k, j]
                two -= multiple * upper[k, j + 1]
                three -= multiple * upper[k, j + 2]
                four -= multiple * upper[k, j + 3]
            matrix[row, j] = one
            matrix[row, j + 1] = two
            matrix[row, j + 2] = three
            matrix[row, j + 3] = four
        for j in range(done):
            matrix[row, j] = 0.0


@njit(error_model="numpy", forceinline=True)
def largest_beside(matrix, row, count):
    """Return the largest modulus of an entry off the diagonal in a row, within the first `count` columns.

    Columns of eliminated unknowns are zero. Reading all columns in the order of memory, with unsigned indices, takes
    half the time of reading only the columns that remain.
    """
    largest = 0.0
    for j in range(np.uint64(count)):
        if j != row and abs(matrix[row, j]) > largest:
            largest = abs(matrix[row, j])
    return largest


@njit(error_model="numpy", forceinline=True)
def eliminate_one(matrix, c, count, width, upper, inverse, order):
    """Eliminate the row at position c; return True if its pivot is negative.

    `eliminate_rows` explains the arrays.
    """
    p = order[c]
    reciprocal = 1.0 / matrix[p, p]
    inverse[c, 0], inverse[c, 1] = reciprocal, 0.0
    for k in range(c + 1, count):
        i = order[k]
        if matrix[i, p] != 0.0:  # most entries of an element matrix are zeros
            subtract_row(matrix[i, p] * reciprocal, matrix, p, width, matrix, i)
            matrix[i, p] = 0.0
    for j in range(0, width, 4):
        one, two = matrix[p, j] * reciprocal, matrix[p, j + 1] * reciprocal
        three, four = matrix[p, j + 2] * reciprocal, matrix[p, j + 3] * reciprocal
        upper[p, j] = one
        upper[p, j + 1] = two
        upper[p, j + 2] = three
        upper[p, j + 3] = four
    upper[p, p] = 0.0
    return reciprocal < 0.0


@njit(error_model="numpy", forceinline=True)
def eliminate_pair(matrix, c, count, width, upper, inverse, order):
    """Eliminate the rows at positions c and c + 1 together; one eigenvalue of their pivot is negative.

    `eliminate_rows` explains the arrays.
    """
    p, q = order[c], order[c + 1]
    a, b, d = matrix[p, p], matrix[p, q], matrix[q, q]
    determinant = a * d - b * b
    first, both, second = d / determinant, -b / determinant, a / determinant
    inverse[c, 0], inverse[c, 1], inverse[c + 1, 0], inverse[c + 1, 1] = first, both, second, 0.0
    for k in range(c + 2, count):
        i = order[k]
        x, y = matrix[i, p], matrix[i, q]
        if x != 0.0 or y != 0.0:
            subtract_two_rows(x * first + y * both, p, x * both + y * second, q, matrix, width, matrix, i)
            matrix[i, p] = matrix[i, q] = 0.0
    for row, x, y in ((p, first, both), (q, both, second)):
        for j in range(0, width, 4):
            one = x * matrix[p, j] + y * matrix[q, j]
            two = x * matrix[p, j + 1] + y * matrix[q, j + 1]
            three = x * matrix[p, j + 2] + y * matrix[q, j + 2]
            four = x * matrix[p, j + 3] + y * matrix[q, j + 3]
            upper[row, j] = one
            upper[row, j + 1] = two
            upper[row, j + 2] = three
            upper[row, j + 3] = four
    upper[p, p] = upper[p, q] = upper[q, p] = upper[q, q] = 0.0


@njit(error_model="numpy", fastmath={"contract"}, forceinline=True)
def subtract_row(multiple, source, p, width, target, i):
    """Subtract a multiple of row p of `source` (r, width) from row i of `target` (r, width).

    Both arrays may be the same.
    """
    for j in range(0, width, 4):
        one = target[i, j] - multiple * source[p, j]
        two = target[i, j + 1] - multiple * source[p, j + 1]
        three = target[i, j + 2] - multiple * source[p, j + 2]
        four = target[i, j + 3] - multiple * source[p, j + 3]
        target[i, j] = one
        target[i, j + 1] = two
        target[i, j + 2] = three
        target[i, j + 3] = four


@njit(error_model="numpy", fastmath={"contract"}, forceinline=True)
def subtract_two_rows(multiple, p, other, q, source, width, target, i):
    """Subtract multiples of rows p and q of `source` (r, width) from row i of `target` (r, width).

    Both arrays may be the same.
    """
    for j in range(0, width, 4):
        one = target[i, j] - multiple * source[p, j] - other * source[q, j]
        two = target[i, j + 1] - multiple * source[p, j + 1] - other * source[q, j + 1]
        three = target[i, j + 2] - multiple * source[p, j + 2] - other * source[q, j + 2]
        four = target[i, j + 3] - multiple * source[p, j + 3] - other * source[q, j + 3]
        target[i, j] = one
        target[i, j + 1] = two
        target[i, j + 2] = three
        target[i, j + 3] = four


# Sums keep their order (no "reassoc"): otherwise numba vectorises the loop over `count`, which takes longer.
@njit(error_model="numpy", fastmath={"contract"}, forceinline=True)
def subtract_products(upper, matrix, count, first, rows, width, rest):
    """Subtract `upper`' `matrix` from `rest` (rows, width): the effect of `count` eliminated rows on others.

    `upper` and `matrix` have `count` rows. Their columns from `first` on belong to the rows and columns of `rest`.
    Afterwards only the upper triangle of `rest` is valid.
    """
    # Compute tiles of four rows and four columns: each number that is read enters four products.
    for i in range(0, rows - 3, 4):
        for j in range(i, width, 4):
            a0 = a1 = a2 = a3 = 0.0
            b0 = b1 = b2 = b3 = 0.0
            c0 = c1 = c2 = c3 = 0.0
            d0 = d1 = d2 = d3 = 0.0
            for c in range(count):
                p, q = upper[c, first + i], upper[c, first + i + 1]
                r, s = upper[c, first + i + 2], upper[c, first + i + 3]
                w, x = matrix[c, first + j], matrix[c, first + j + 1]
                y, z = matrix[c, first + j + 2], matrix[c, first + j + 3]
                a0 += p * w
                a1 += p * x
                a2 += p * y
                a3 += p * z
                b0 += q * w
                b1 += q * x
                b2 += q * y
                b3 += q * z
                c0 += r * w
                c1 += r * x
                c2 += r * y
                c3 += r * z
                d0 += s * w
                d1 += s * x
                d2 += s * y
                d3 += s * z
            subtract_four(rest, i, j, a0, a1, a2, a3)
            subtract_four(rest, i + 1, j, b0, b1, b2, b3)
            subtract_four(rest, i + 2, j, c0, c1, c2, c3)
            subtract_four(rest, i + 3, j, d0, d1, d2, d3)
    for i in range(rows - rows % 4, rows):
        for j in range(i // 4 * 4, width, 4):
            one = two = three = four = 0.0
            for c in range(count):
                multiple = upper[c, first + i]
                one += multiple * matrix[c, first + j]
                two += multiple * matrix[c, first + j + 1]
                three += multiple * matrix[c, first + j + 2]
                four += multiple * matrix[c, first + j + 3]
            subtract_four(rest, i, j, one, two, three, four)


@njit(error_model="numpy", forceinline=True)
def subtract_four(target, i, j, one, two, three, four):
    """Subtract the numbers `one` to `four` from row i of `target`, in the columns from j on."""
    one, two = target[i, j] - one, target[i, j + 1] - two
    three, four = target[i, j + 2] - three, target[i, j + 3] - four
    target[i, j] = one
    target[i, j + 1] = two
    target[i, j + 2] = three
    target[i, j + 3] = four


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def solve_forward(upper, order, count, width, values):
    """Replace the first `count` of `values` by inverse(U') times these numbers.

    The effect on the other values (width in all) is subtracted from them.
    """
    for c in range(count):
        p = order[c]
        value = values[p]
        for j in range(0, width, 4):
            one, two = values[j] - upper[p, j] * value, values[j + 1] - upper[p, j + 1] * value
            three, four = values[j + 2] - upper[p, j + 2] * value, values[j + 3] - upper[p, j + 3] * value
            values[j] = one
            values[j + 1] = two
            values[j + 2] = three
            values[j + 3] = four


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def solve_pivots(inverse, order, count, values):
    """Multiply the first `count` of `values` by the `inverse` (count, 2) of the pivots, in `order` (count,)."""
    carried = 0.0
    for c in range(count):
        value = values[order[c]]
        values[order[c]] = inverse[c, 0] * value + carried
        if inverse[c, 1] != 0.0:
            values[order[c]] += inverse[c, 1] * values[order[c + 1]]
        carried = inverse[c, 1] * value


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def solve_backward(upper, order, count, width, values):
    """Replace the first `count` of `values` (width,) by the solution with U; the other values are known.

    The known values are first moved to the right-hand sides, so that only the short sums over the unknowns depend on
    each other. These sums begin with the values that are computed first, so that they wait for one product only.
    """
    fours = (count + 3) // 4 * 4
    for p in range(count):
        one = two = three = four = 0.0
        for j in range(count, fours):
            one += upper[p, j] * values[j]
        for j in range(fours, width, 4):
            one += upper[p, j] * values[j]
            two += upper[p, j + 1] * values[j + 1]
            three += upper[p, j + 2] * values[j + 2]
            four += upper[p, j + 3] * values[j + 3]
        values[p] -= (one + two) + (three + four)
    for c in range(count - 2, -1, -1):
        subtract_known(upper, order, c, count, values)


# Sums keep their order (no "reassoc"): otherwise numba vectorises the loop, whose entries lie apart in memory.
@njit(error_model="numpy", fastmath={"contract"}, forceinline=True)
def subtract_known(upper, order, c, count, values):
    """Subtract from the value at position c its row of U times the values that are already computed."""
    value = values[order[c]]
    for k in range(count - 1, c, -1):
        value -= upper[order[c], order[k]] * values[order[k]]
    values[order[c]] = value


# The functions below are compiled once and not inlined. They serve matrices that a factorisation eliminates once.


@njit(error_model="numpy")
def eliminate_once(matrix, count, width, upper, inverse, order):
    """Eliminate rows as `eliminate_rows` does."""
    return eliminate_rows(matrix, 0, count, width, upper, inverse, order)


@njit(error_model="numpy")
def forward_once(upper, inverse, order, count, width, values):
    """Solve as `solve_forward` and then `solve_pivots` do."""
    solve_forward(upper, order, count, width, values)
    solve_pivots(inverse, order, count, values)


@njit(error_model="numpy")
def backward_once(upper, order, count, width, values):
    """Solve as `solve_backward` does."""
    solve_backward(upper, order, count, width, values)
