"""LU factorisation with partial pivoting of a square band matrix of half-bandwidth BANDWIDTH.

Row i of `band` holds the entries (i, i - BANDWIDTH) ... (i, i + 2 BANDWIDTH); the last BANDWIDTH places take the
fill-in that row exchanges cause. Source: Golub and Van Loan (2013), Matrix computations, section 4.3.
"""

import numpy as np
from numba import njit

from codegen.runtime.example import BANDWIDTH


@njit(cache=True, error_model="numpy")
def factor_banded(band, pivots):
    """Factor in place. Return -1, or the first row whose pivot is zero or not finite."""
    size = band.shape[0]
    reach = 0  # last column that any row exchanged so far can touch
    for i in range(size):
        last = min(i + BANDWIDTH, size - 1)
        pivot = i
        largest = abs(band[i, BANDWIDTH])
        for j in range(i + 1, last + 1):
            candidate = abs(band[j, BANDWIDTH - j + i])
            if candidate > largest:
                largest = candidate
                pivot = j
        if not (0.0 < largest < np.inf):
            return i
        pivots[i] = pivot
        reach = max(reach, min(pivot + BANDWIDTH, size - 1))
        width = reach - i + 1
        if pivot != i:
            shift = BANDWIDTH - pivot + i
            for c in range(width):
                band[i, BANDWIDTH + c], band[pivot, shift + c] = band[pivot, shift + c], band[i, BANDWIDTH + c]
        inverse = 1.0 / band[i, BANDWIDTH]
        for j in range(i + 1, last + 1):
            shift = BANDWIDTH - j + i
            if band[j, shift] != 0.0:
                factor = band[j, shift] * inverse
                band[j, shift] = factor
                for c in range(1, width):
                    band[j, shift + c] -= factor * band[i, BANDWIDTH + c]
    return -1


@njit(cache=True, error_model="numpy")
def solve_banded(band, pivots, right_hand_side):
    """Solve in place with the factors that `factor_banded` left in `band`."""
    size = band.shape[0]
    for i in range(size):
        pivot = pivots[i]
        value = right_hand_side[pivot]
        right_hand_side[pivot] = right_hand_side[i]
        right_hand_side[i] = value
        for j in range(i + 1, min(i + BANDWIDTH, size - 1) + 1):
            right_hand_side[j] -= band[j, BANDWIDTH - j + i] * value
    for i in range(size - 1, -1, -1):
        value = right_hand_side[i]
        for c in range(1, min(2 * BANDWIDTH, size - 1 - i) + 1):
            value -= band[i, BANDWIDTH + c] * right_hand_side[i + c]
        right_hand_side[i] = value / band[i, BANDWIDTH]
