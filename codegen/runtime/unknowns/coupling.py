"""Conditions that tie shared unknowns together: sums of terms, each an instance of one of a few kinds of term.

Row r of the conditions is the sum of its terms; term i of kind COUPLING_KINDS[i] is a function of the shared unknowns
COUPLING_INDICES[i]. The conditions' share of the Lagrangian is the sum over rows of multiplier times row.
"""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_matrix, zero_vector
from codegen.runtime.stand_ins.example import (
    COUPLING_COUNTS, COUPLING_KINDS, COUPLING_INDICES, COUPLING_ROWS, COUPLINGS, ROOT, SCALED, coupling_term,
)  # fmt: skip


@njit(error_model="numpy")
def add_coupling_gradient(unknowns, parameters, gradient):
    """Add the conditions to `gradient` (n,) by their multipliers, and what they exert to that by shared unknowns."""
    first, multipliers = unknowns.size - ROOT, unknowns.size - COUPLINGS
    width = COUPLING_INDICES.shape[1]
    values, slopes, curvatures = zero_vector(width), zero_vector(width), zero_vector(width * width)
    for i in range(COUPLING_KINDS.size):
        for a in range(COUPLING_COUNTS[i]):
            values[a] = unknowns[first + COUPLING_INDICES[i, a]]
        row = multipliers + COUPLING_ROWS[i]
        gradient[row] += coupling_term(COUPLING_KINDS[i], values, parameters, slopes, curvatures)
        for a in range(COUPLING_COUNTS[i]):
            gradient[first + COUPLING_INDICES[i, a]] += unknowns[row] * slopes[a]


@njit(cache=True, error_model="numpy")
def add_coupling_matrix(unknowns, parameters, weight, matrix):
    """Add the second derivatives of the conditions' share to `matrix` (ROOT, ROOT or more); `unknowns` (n,)."""
    first, multipliers = unknowns.size - ROOT, unknowns.size - COUPLINGS
    width = COUPLING_INDICES.shape[1]
    values, slopes, curvatures = zero_vector(width), zero_vector(width), zero_vector(width * width)
    for i in range(COUPLING_KINDS.size):
        count, row = COUPLING_COUNTS[i], ROOT - COUPLINGS + COUPLING_ROWS[i]
        for a in range(count):
            values[a] = unknowns[first + COUPLING_INDICES[i, a]]
        coupling_term(COUPLING_KINDS[i], values, parameters, slopes, curvatures)
        multiplier = weight * unknowns[multipliers + COUPLING_ROWS[i]]
        for a in range(count):
            index = COUPLING_INDICES[i, a]
            matrix[row, index] += slopes[a]
            matrix[index, row] += slopes[a]
            for b in range(count):
                matrix[index, COUPLING_INDICES[i, b]] += multiplier * curvatures[a * count + b]


if SCALED:

    @njit(error_model="numpy")
    def multiply_couplings(unknowns, parameters, vector, product):
        """Add to `product` what the second derivatives of the conditions make of `vector`, both (n,)."""
        matrix, first = zero_matrix(ROOT, ROOT), unknowns.size - ROOT
        add_coupling_matrix(unknowns, parameters, 1.0, matrix)
        for i in range(ROOT):
            for j in range(ROOT):
                product[first + i] += matrix[i, j] * vector[first + j]


def coupling_entries(grid, unknowns):
    """Entries (rows, columns, values) that the conditions add to the lower triangle of the KKT matrix."""
    matrix = np.zeros((ROOT, ROOT))
    add_coupling_matrix(unknowns, grid.parameters[0], 1.0, matrix)
    rows, columns = np.nonzero(np.tril(matrix))
    return unknowns.size - ROOT + rows, unknowns.size - ROOT + columns, matrix[rows, columns]
