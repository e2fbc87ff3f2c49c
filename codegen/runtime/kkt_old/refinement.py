"""Iterative refinement: what a solution of the KKT system leaves of its right-hand side is solved for again.

The elimination pairs the state of a node with the equation of the interval after it, and so runs the dynamics
backwards. Where that grows, as dissipative dynamics do over a long time, the factors are those of a matrix that is off
by far more than rounding, and a step leaves equations unsolved. Refinement with residuals of the matrix itself makes up
for it. Corrections one after the other need not converge with such factors; their best combination, by generalised
conjugate residuals with the factors to precondition them, does. Sources: Higham (2002), Accuracy and stability of
numerical algorithms, chapter 12; Eisenstat, Elman and Schultz (1983), Variational iterative methods for nonsymmetric
systems of linear equations; the measure of the residual is that of Waechter and Biegler (2006), section 3.10.
"""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_vector
from codegen.runtime.unknowns.coupling import multiply_couplings
from codegen.runtime.kkt.ends_linear import multiply_ends
from codegen.runtime.kkt.system import solve_kkt
from codegen.runtime.stand_ins.example import (
    BODIES, COUPLINGS, ELEMENT, HESSIAN_COLUMNS, HESSIAN_ROWS, NODE, SCALED, SHARED, STRIDE, TIED, interval_hessian,
)  # fmt: skip
from codegen.runtime.unknowns.tied_ends import add_tied
from codegen.runtime.unknowns.layout import free_unknowns
from codegen.runtime.unknowns.shared import global_index, read_shared
from codegen.runtime.unknowns.time_grid import NONE
from codegen.runtime.unknowns.times import span

ACCURATE = 1e-10  # residuals up to it, in parts of the right-hand side and the solution, are as good as none
LARGE_STEP = 1e6  # times the right-hand side: what is beyond does not excuse a residual
SOLVED_AGAIN = 10  # times at most, as in IPOPT
NEARLY_ACCURATE = 1e-6  # residuals up to it may be rounding of large solutions, where two corrections do not halve them


@njit(cache=True, error_model="numpy")
def fill_residual(
    unknowns, roots, steps, h, nodes, parameters, diagonal, gradient, step, vector, is_free, is_multiplier, left
):  # fmt: skip
    """Fill `left` (n,) with KKT matrix . `step` + `gradient`; return how much that is, as `inaccuracy` says.

    `unknowns` are in the problem's own units. Where there are `roots`, of sizes times forces, the matrix is in parts of
    them, and `vector` is `roots` times `step`; elsewhere it is the step.
    """
    hessian = zero_vector(HESSIAN_ROWS.size)
    for i in range(left.size):
        left[i] = 0.0
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        for k in range(steps):
            first = body * (steps * STRIDE + NODE) + k * STRIDE
            t, length = span(nodes, k, h)
            interval_hessian(unknowns[first : first + ELEMENT], t, length, parameters[body], hessian)
            for j in range(HESSIAN_ROWS.size):
                row, column = first + HESSIAN_ROWS[j], first + HESSIAN_COLUMNS[j]
                if SHARED:
                    row = global_index(HESSIAN_ROWS[j], ELEMENT, first, body, unknowns.size)
                    column = global_index(HESSIAN_COLUMNS[j], ELEMENT, first, body, unknowns.size)
                left[row] += hessian[j] * vector[column]
                if row != column:
                    left[column] += hessian[j] * vector[row]
        multiply_ends(unknowns, body, steps, h, parameters[body], vector, left)
    if COUPLINGS:
        multiply_couplings(unknowns, parameters[0], vector, left)
    for i in range(left.size):
        if SCALED and roots.size:
            left[i] *= roots[i]
        left[i] += diagonal[i] * step[i] + gradient[i]
    if TIED:
        add_tied(left, steps)
    for i in range(left.size):
        if not is_free[i]:
            left[i] = 0.0
    return inaccuracy(gradient, step, left, is_multiplier)


def linear_residual(grid, unknowns, diagonal, gradient, step):
    """KKT matrix . step + gradient (n,), which is zero for an exact step, and how much that is, as `inaccuracy` says.

    The matrix is as `factor_kkt` says.
    """
    steps, h, nodes, _, parameters, is_multiplier, sizes, forces, *_ = grid
    roots, vector, left = NONE, step, np.empty(step.size)
    if SCALED and sizes.size:
        roots = np.sqrt(sizes * forces)
        unknowns, vector = unknowns * sizes, roots * step
    data, masks = (steps, h, nodes, parameters), (free_unknowns(grid), is_multiplier)
    return left, fill_residual(unknowns, roots, *data, diagonal, gradient, step, vector, *masks, left)


@njit(error_model="numpy")
def inaccuracy(gradient, step, left, is_multiplier):
    """How much of the equations, and of all rows, is `left` (n,), in parts of their right-hand side and solution.

    Large multipliers, and barriers close to their bounds, take no part in the equations. NaN if `left` is not finite.
    """
    unsolved, remaining, right, slope, multiplier, primal = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(left.size):
        if not abs(left[i]) < np.inf:
            return np.nan
        if is_multiplier[i]:
            unsolved, right = max(unsolved, abs(left[i])), max(right, abs(gradient[i]))
            multiplier = max(multiplier, abs(step[i]))
        else:
            remaining, slope = max(remaining, abs(left[i])), max(slope, abs(gradient[i]))
            primal = max(primal, abs(step[i]))
    most = LARGE_STEP * max(right, slope)
    of_equations = unsolved / max(right + min(primal, most), 1e-300)
    scale = max(right, slope) + min(max(primal, multiplier), most)
    return max(of_equations, max(unsolved, remaining) / max(scale, 1e-300))


def refine(grid, unknowns, diagonal, system, gradient, step):
    """Refine `step` (n,) in place until it is accurate, or only rounding is left; return whether that lowered it.

    The system is still factored, and the matrix as `factor_kkt` says. Each time, what the factors make of the residual
    is one more correction, and that sum of all corrections is added which leaves least.
    """
    zero, corrections, products, errors = np.zeros_like(step), [], [], []
    left, error = linear_residual(grid, unknowns, diagonal, gradient, step)
    for refinement in range(SOLVED_AGAIN):
        errors.append(error)
        if not ACCURATE < errors[-1] < np.inf:
            return refinement > 0
        if refinement == 2 and 0.5 * errors[0] < errors[-1] <= NEARLY_ACCURATE:
            return False
        corrections.append(np.empty_like(step))
        solve_kkt(grid, system, left / np.linalg.norm(left), corrections[-1])
        products.append(linear_residual(grid, unknowns, diagonal, zero, corrections[-1])[0])
        if not np.isfinite(products[-1]).all():
            return True
        parts, *_ = np.linalg.lstsq(np.array(products).T, -left, rcond=None)
        step += parts @ np.array(corrections)
        left, error = linear_residual(grid, unknowns, diagonal, gradient, step)
    return True
