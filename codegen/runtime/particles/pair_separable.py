"""One step of a composition method for a separable Hamiltonian: positions and momenta take turns, nothing is solved.

z1 = z0 + f h (H_p(p), -H_q(q)) at q = (1 - a) q0 + a q1, p = (1 - b) p0 + b p1, with a and b zero or one, not both one.
"""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_pairs import POINTS, SUBSTEPS, slope, velocity


@njit(cache=True, error_model="numpy")
def advance(z, t, h, given, work, after):
    """Fill the state `after` a step from `z`, both of shape (2, n, d); return 0 iterations.

    Neighbouring substeps share what has not changed between them: H_q as long as positions rest, H_p as long as momenta
    do. `points[0]` keeps H_q and the positions to which it belongs, for the step that follows.
    """
    (parameters, own), points = given, work[0]
    rates, slopes, positions = np.empty(z[0].shape), points[0, 0], points[0, 1]
    has_rates, has_slopes = False, True
    for i in range(z.shape[1]):
        for k in range(z.shape[2]):
            after[0, i, k], after[1, i, k] = z[0, i, k], z[1, i, k]
            has_slopes = has_slopes and positions[i, k] == z[0, i, k]
    for s in range(POINTS):
        step, a, b = h * SUBSTEPS[s][0], SUBSTEPS[s][1], SUBSTEPS[s][2]
        if not (a > 0.0 or has_slopes):
            slope(after, own, parameters, slopes)
            has_slopes = True
        if b > 0.0:
            moved(after, 1, -step, slopes)
            has_rates = False
        if not has_rates:
            velocity(after, own, parameters, rates)
            has_rates = True
        if not (a > 0.0 or b > 0.0):
            moved(after, 1, -step, slopes)
            has_rates = False
        moved(after, 0, step, rates)
        has_slopes = False
        if a > 0.0:
            slope(after, own, parameters, slopes)
            moved(after, 1, -step, slopes)
            has_rates, has_slopes = False, True
    for i in range(z.shape[1]):
        for k in range(z.shape[2]):
            positions[i, k] = after[0, i, k] if has_slopes else np.nan
    return 0


@njit(cache=True, error_model="numpy")
def moved(z, part, step, rates):
    """Add step times rates, shape (n, d), to the positions (part 0) or momenta (part 1) of a state, shape (2, n, d)."""
    for i in range(z.shape[1]):
        for k in range(z.shape[2]):
            z[part, i, k] += step * rates[i, k]
