"""Inertia of the KKT matrix: how many of its eigenvalues are negative.

At a minimum there are as many as equations; that is the second-order condition, and makes a Newton step a descent. By
Sylvester's law a symmetric block elimination counts them. Blocks of nodes and intervals are eliminated in their order,
each with pivoting inside; the first block of a body, which is singular by itself because its equations are matched by
later unknowns, is carried along as a border to the end. LU with row exchanges, which solves the system, gives no
inertia. Sources: Bunch and Parlett (1971), Direct methods for solving symmetric indefinite systems of linear equations;
Haynsworth (1968), Determination of the inertia of a partitioned Hermitian matrix; Nocedal and Wright (2006), theorem
16.3.
"""

import numpy as np
from numba import njit

from codegen.runtime.callbacks import multiplier_unknowns
from codegen.runtime.coupling import add_coupling_matrix
from codegen.runtime.elements import BLOCK, SIZE
from codegen.runtime.example import BODIES, COUPLINGS, HESSIAN_ROWS, NODE, ROOT, SHARED, STRIDE
from codegen.runtime.frontal import fill_element
from codegen.runtime.shared import read_shared, root_place

BORDERED = SIZE + BLOCK + SHARED  # rows of the front: block k, node k + 1, block 0, shared unknowns


def excess_negative(grid, unknowns, diagonal, system):
    """Negative eigenvalues of the KKT matrix beyond one for every equation; None when a pivot vanishes.

    Zero at a minimum. To be asked after factor_kkt with the same arguments, because it uses what that condensed.
    """
    root = np.zeros((ROOT, ROOT))
    root.flat[:: ROOT + 1] = diagonal[diagonal.size - ROOT :]
    negative = count_negative(unknowns, grid.steps, grid.h, grid.parameters, diagonal, system[-1], root)
    return None if negative < 0 else negative - multiplier_unknowns(grid).size


@njit(cache=True, error_model="numpy")
def count_negative(unknowns, steps, h, parameters, diagonal, condensed, root):
    """Number of negative eigenvalues, or -1 when a pivot vanishes."""
    front, element = np.empty((BORDERED, BORDERED)), np.empty((SIZE + SHARED, SIZE + SHARED))
    hessian = np.empty(HESSIAN_ROWS.size)
    places = np.empty(SIZE + SHARED, np.int64)
    chain, negative = steps * STRIDE + NODE, 0
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        own, added = unknowns[body * chain : (body + 1) * chain], diagonal[body * chain : (body + 1) * chain]
        for i in range(BORDERED):
            for j in range(BORDERED):
                front[i, j] = 0.0
        for k in range(steps):
            interval = body * steps + k
            fill_element(own, k, steps, h, parameters[body], 1.0, added, hessian, condensed, interval, element)
            for i in range(SIZE + SHARED):
                places[i] = i if i < SIZE else i + BLOCK
                if k == 0:
                    places[i] = i + SIZE if i < BLOCK else i - BLOCK if i < SIZE else i + BLOCK
            for i in range(SIZE + SHARED):
                for j in range(SIZE + SHARED):
                    front[places[i], places[j]] += element[i, j]
            if k > 0:
                found = eliminate_symmetric(front, 0, BLOCK)
                if found < 0:
                    return -1
                negative += found
                move_node(front)
        for i in range(NODE, SIZE):
            front[i, i] = 1.0  # nothing is left there
        found = eliminate_symmetric(front, 0, SIZE + BLOCK)
        if found < 0:
            return -1
        negative += found
        for i in range(SHARED):
            for j in range(SHARED):
                root[root_place(body, i), root_place(body, j)] += front[SIZE + BLOCK + i, SIZE + BLOCK + j]
    if COUPLINGS:
        add_coupling_matrix(unknowns, parameters[0], 1.0, root)
    found = eliminate_symmetric(root, 0, ROOT)
    return -1 if found < 0 else negative + found


@njit(error_model="numpy")
def move_node(front):
    """Move what elimination left in the rows and columns of node k + 1 to the place of node k."""
    for i in range(NODE):
        for j in range(BORDERED):
            front[i, j] = front[BLOCK + i, j]
    for i in range(BORDERED):
        for j in range(NODE):
            front[i, j] = front[i, BLOCK + j]
    for i in range(BORDERED):
        for j in range(NODE, SIZE):
            front[i, j] = 0.0
            front[j, i] = 0.0


@njit(error_model="numpy")
def eliminate_symmetric(matrix, first, last):
    """Eliminate unknowns first to last - 1 with pivots of one or two rows; the number of negative ones, -1 if singular.

    A pivot is the largest diagonal entry, unless an entry beside the diagonal is larger by the factor that balances
    the growth of both kinds (Bunch and Parlett); such a pair of rows has one positive and one negative eigenvalue.
    """
    size, negative, c = matrix.shape[0], 0, first
    while c < last:
        place, largest, row, column, beside = c, -1.0, c, c, 0.0
        for i in range(c, last):
            if abs(matrix[i, i]) > largest:
                place, largest = i, abs(matrix[i, i])
            for j in range(c, i):
                if abs(matrix[i, j]) > beside:
                    row, column, beside = i, j, abs(matrix[i, j])
        if not 0.0 < max(largest, beside) < np.inf:
            return -1
        if largest >= 0.6404 * beside:
            exchange(matrix, c, place)
            pivot = matrix[c, c]
            negative += pivot < 0.0
            for i in range(c + 1, size):
                factor = matrix[i, c] / pivot
                if factor != 0.0:
                    for j in range(c + 1, size):
                        matrix[i, j] -= factor * matrix[c, j]
            c += 1
        else:
            exchange(matrix, c, column)
            exchange(matrix, c + 1, row)
            a, b, d = matrix[c, c], matrix[c + 1, c], matrix[c + 1, c + 1]
            determinant = a * d - b * b
            negative += 1
            for i in range(c + 2, size):
                one = (d * matrix[i, c] - b * matrix[i, c + 1]) / determinant
                two = (a * matrix[i, c + 1] - b * matrix[i, c]) / determinant
                if one != 0.0 or two != 0.0:
                    for j in range(c + 2, size):
                        matrix[i, j] -= one * matrix[c, j] + two * matrix[c + 1, j]
            c += 2
    return negative


@njit(error_model="numpy")
def exchange(matrix, i, j):
    """Exchange two rows and the same two columns."""
    if i != j:
        for k in range(matrix.shape[0]):
            matrix[i, k], matrix[j, k] = matrix[j, k], matrix[i, k]
        for k in range(matrix.shape[0]):
            matrix[k, i], matrix[k, j] = matrix[k, j], matrix[k, i]
