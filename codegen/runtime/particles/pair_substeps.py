"""One step of a composition method: in each substep the field is taken at one point between its ends.

z1 = z0 + f h F(q, p) at q = (1 - a) q0 + a q1, p = (1 - b) p0 + b p1, with F = (H_p, -H_q).
"""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_pairs import IMPLICIT, POINTS, SUBSTEPS, hamiltonian_gradient
from codegen.runtime.particles.pair_algebra import copy_state
from codegen.runtime.particles.pair_curvature import linearised_field
from codegen.runtime.particles.pair_implicit import implicit_directions, implicit_substep
from codegen.runtime.particles.pair_moved import moved

NON_FINITE = -1  # what `advance` returns when a state is infinite or not a number


@njit(cache=True, error_model="numpy")
def advance(z, t, h, given, work, after):
    """Fill the state `after` a step from `z`, both of shape (2, n, d); return iterations, or why it failed.

    Of `work`, the first, shape (POINTS, 2, n, d), takes the points of the step. Where it holds those of a step from a
    nearby state, the second is the relative accuracy that suffices for implicit substeps, which then begin there; else
    it is zero.
    """
    (parameters, own), (points, near) = given, work
    before, gradient, iterations = np.empty(z.shape), np.empty(z.shape), 0
    copy_state(z, before)
    for s in range(POINTS):
        step, a, b = h * SUBSTEPS[s][0], SUBSTEPS[s][1], SUBSTEPS[s][2]
        if IMPLICIT and (a > 0.0 or b > 0.0):
            outcome = implicit_substep(before, step, a, b, own, parameters, near, gradient, points[s], after)
            if outcome < 0:
                return outcome
            iterations += outcome
        else:
            copy_state(before, points[s])
            hamiltonian_gradient(before, own, parameters, gradient)
            moved(before, step, gradient, after)
        if not copy_state(after, before):
            return NON_FINITE
    return iterations


@njit(cache=True, error_model="numpy")
def advance_directions(curvature, points, first, h, own, parameters, directions, after):
    """Fill `after`, shape (2nd, m), with the derivative of a step times directions.

    The step's points are those from number `first`. Return whether the linear equations of every substep were solved.
    """
    hessians, anew = curvature
    before, products = directions.copy(), np.empty(directions.shape)
    for s in range(POINTS):
        step, a, b = h * SUBSTEPS[s][0], SUBSTEPS[s][1], SUBSTEPS[s][2]
        if IMPLICIT and (a > 0.0 or b > 0.0):
            if not implicit_directions(
                hessians, anew, points, first + s, step, a, b, own, parameters, before, products, after
            ):
                return False
        else:
            linearised_field(hessians, anew, points, first + s, own, parameters, before, products)
            for row in range(before.shape[0]):
                for c in range(before.shape[1]):
                    after[row, c] = before[row, c] + step * products[row, c]
        for row in range(before.shape[0]):
            for c in range(before.shape[1]):
                before[row, c] = after[row, c]
    return True
