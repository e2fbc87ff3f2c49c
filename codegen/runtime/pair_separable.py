"""One step of a composition method for a separable Hamiltonian: places and momenta take turns, nothing is solved.

z1 = z0 + f h (H_p(p), -H_q(q)) at q = (1 - a) q0 + a q1, p = (1 - b) p0 + b p1, with a and b zero or one, not both one.
"""

import numpy as np
from numba import njit

from codegen.runtime.example_pairs import POINTS, SUBSTEPS, slope, velocity

NON_FINITE = -1  # what `advance` returns when a state is infinite or not a number


@njit(cache=True, error_model="numpy")
def advance(z, h, own, parameters, points, after):
    """Fill the state `after` a step; return 0, or why it failed. Nothing is written to `points`."""
    rates, slopes = np.empty(z[0].shape), np.empty(z[0].shape)
    for s in range(2):
        for i in range(z.shape[1]):
            for k in range(z.shape[2]):
                after[s, i, k] = z[s, i, k]
    for s in range(POINTS):
        step, a, b = h * SUBSTEPS[s][0], SUBSTEPS[s][1], SUBSTEPS[s][2]
        if a > 0.0:
            velocity(after, own, parameters, rates)
            moved(after, 0, step, rates)
            slope(after, own, parameters, rates)
            moved(after, 1, -step, rates)
        else:
            slope(after, own, parameters, slopes)
            if b > 0.0:
                moved(after, 1, -step, slopes)
            velocity(after, own, parameters, rates)
            moved(after, 0, step, rates)
            if not b > 0.0:
                moved(after, 1, -step, slopes)
    total = 0.0
    for i in range(z.shape[1]):
        for k in range(z.shape[2]):
            total += abs(after[0, i, k]) + abs(after[1, i, k])
    return 0 if total < np.inf else NON_FINITE


@njit(cache=True, error_model="numpy")
def moved(z, part, step, rates):
    """Add step times rates to the places (part 0) or momenta (part 1) of a state."""
    for i in range(z.shape[1]):
        for k in range(z.shape[2]):
            z[part, i, k] += step * rates[i, k]
