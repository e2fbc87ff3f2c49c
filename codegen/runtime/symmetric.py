"""Symmetric elimination with pivots of one or two rows: factors, and the number of negative eigenvalues.

Source: Bunch and Parlett (1971), Direct methods for solving symmetric indefinite systems of linear equations; Higham
(2002), Accuracy and stability of numerical algorithms, section 11.1.
"""

import numpy as np
from numba import njit

BALANCE = 0.6403882032022076  # (1 + sqrt(17)) / 8 balances the growth by both kinds of pivots


@njit(error_model="numpy", inline="always")
def eliminate_symmetric(matrix, count, rows, lower, inverse, places):
    """Eliminate the first `count` of `rows` unknowns; return how many pivots are negative, or -1 if one vanishes.

    Of the matrix the first `count` columns and the lower triangle of the rest are read; the rest becomes the Schur
    complement. `lower` takes the unit lower factor, `inverse` (count, 2) the inverse of the pivots: diagonal and what
    is beside it in a pivot of two rows. `places` says with which row each was exchanged, -1 - row in a pair's second.
    """
    negative, c = 0, 0
    while c < count:
        place, largest, row, column, beside = c, -1.0, c, c, 0.0
        for i in range(c, count):
            if abs(matrix[i, i]) > largest:
                place, largest = i, abs(matrix[i, i])
            for j in range(c, i):
                if abs(matrix[i, j]) > beside:
                    row, column, beside = i, j, abs(matrix[i, j])
        if not 0.0 < max(largest, beside) < np.inf:
            return -1
        if largest >= BALANCE * beside:
            exchange(matrix, c, c, place, count, rows)
            places[c] = place
            negative += matrix[c, c] < 0.0
            inverse[c, 0] = 1.0 / matrix[c, c]
            inverse[c, 1] = 0.0
            for i in range(c + 1, rows):
                lower[i, c] = matrix[i, c] * inverse[c, 0]
                for j in range(c + 1, count):
                    matrix[i, j] -= lower[i, c] * matrix[c, j]
            c += 1
        else:
            exchange(matrix, c, c, column, count, rows)
            exchange(matrix, c, c + 1, row, count, rows)
            places[c], places[c + 1] = column, -1 - row
            negative += 1
            a, b, d = matrix[c, c], matrix[c + 1, c], matrix[c + 1, c + 1]
            determinant = a * d - b * b
            inverse[c, 0], inverse[c + 1, 0] = d / determinant, a / determinant
            inverse[c, 1] = inverse[c + 1, 1] = -b / determinant
            for i in range(c + 2, rows):
                one, two = matrix[i, c], matrix[i, c + 1]
                lower[i, c] = one * inverse[c, 0] + two * inverse[c, 1]
                lower[i, c + 1] = one * inverse[c, 1] + two * inverse[c + 1, 0]
                for j in range(c + 2, count):
                    matrix[i, j] -= lower[i, c] * matrix[c, j] + lower[i, c + 1] * matrix[c + 1, j]
            c += 2
    # Columns of the eliminated unknowns hold what they were when their turn came: lower times pivots.
    for i in range(count, rows):
        for j in range(count, i + 1):
            value = 0.0
            for c in range(count):
                value += matrix[i, c] * lower[j, c]
            matrix[i, j] -= value
    return negative


@njit(error_model="numpy")
def exchange(matrix, first, i, j, count, rows):
    """Exchange two of the unknowns `first` to `count`, which are not eliminated yet."""
    if i != j:
        for k in range(first, count):
            matrix[i, k], matrix[j, k] = matrix[j, k], matrix[i, k]
        for k in range(first, rows):
            matrix[k, i], matrix[k, j] = matrix[k, j], matrix[k, i]


@njit(error_model="numpy", inline="always")
def solve_lower(lower, places, count, right):
    """Overwrite the first `count` entries of a right-hand side by their solution with the unit lower factor."""
    c = 0
    while c < count:
        pair = c + 1 < count and places[c + 1] < 0
        swap(right, c, places[c])
        if pair:
            swap(right, c + 1, -1 - places[c + 1])
        for i in range(c + 1 + pair, count):
            right[i] -= lower[i, c] * right[c]
            if pair:
                right[i] -= lower[i, c + 1] * right[c + 1]
        c += 1 + pair


@njit(error_model="numpy", inline="always")
def solve_pivots(inverse, places, count, right):
    """Multiply the first `count` entries by the inverse of the pivots."""
    c = 0
    while c < count:
        if c + 1 < count and places[c + 1] < 0:
            one, two = right[c], right[c + 1]
            right[c] = inverse[c, 0] * one + inverse[c, 1] * two
            right[c + 1] = inverse[c, 1] * one + inverse[c + 1, 0] * two
            c += 2
        else:
            right[c] *= inverse[c, 0]
            c += 1


@njit(error_model="numpy", inline="always")
def solve_upper(lower, places, count, right):
    """Overwrite the first `count` entries by their solution with the transposed factor, in the original order."""
    c = count - 1
    while c >= 0:
        pair = places[c] < 0
        first = c - pair
        for i in range(c + 1, count):
            right[first] -= lower[i, first] * right[i]
            if pair:
                right[c] -= lower[i, c] * right[i]
        if pair:
            swap(right, c, -1 - places[c])
        swap(right, first, places[first])
        c = first - 1


@njit(error_model="numpy", inline="always")
def swap(values, i, j):
    """Exchange two entries."""
    value = values[i]
    values[i] = values[j]
    values[j] = value
