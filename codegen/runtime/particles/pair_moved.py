"""Positions and momenta moved along the field (H_p, -H_q)."""

from numba import njit


@njit(cache=True, error_model="numpy")
def moved(before, step, gradient, after):
    """Fill `after`, shape (2, n, d), with before + step (H_p, -H_q); return the largest change and entry."""
    change, size = 0.0, 0.0
    for i in range(before.shape[1]):
        for k in range(before.shape[2]):
            position = before[0, i, k] + step * gradient[1, i, k]
            momentum = before[1, i, k] - step * gradient[0, i, k]
            change = max(change, abs(position - after[0, i, k]), abs(momentum - after[1, i, k]))
            size = max(size, abs(position), abs(momentum))
            after[0, i, k], after[1, i, k] = position, momentum
    return change, size
