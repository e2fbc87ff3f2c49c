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
from codegen.runtime.unknowns.times import span

ACCURATE = 1e-10  # residuals up to it, in parts of the right-hand side and the solution, are as good as none
LARGE_STEP = 1e6  # times the right-hand side: what is beyond does not excuse a residual
SOLVED_AGAIN = 10  # times at most, as in IPOPT
NEARLY_ACCURATE = 1e-6  # residuals up to it may be rounding of large solutions, where two corrections do not halve them


@njit(cache=True, error_model="numpy")
def multiply_kkt(unknowns, steps, h, nodes, parameters, vector, product):
    """Add to `product` what the second derivatives of the Lagrangian, at `unknowns`, make of `vector`, all (n,)."""
    hessian = zero_vector(HESSIAN_ROWS.size)
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
                product[row] += hessian[j] * vector[column]
                if row != column:
                    product[column] += hessian[j] * vector[row]
        multiply_ends(unknowns, body, steps, h, parameters[body], vector, product)
    if COUPLINGS:
        multiply_couplings(unknowns, parameters[0], vector, product)


def linear_residual(grid, unknowns, diagonal, gradient, step):
    """KKT matrix . step + gradient (n,), which is zero for an exact step; the matrix is as `factor_kkt` says."""
    product, vector = np.zeros(step.size), step
    if SCALED and grid.sizes.size:
        roots = np.sqrt(grid.sizes * grid.forces)
        unknowns, vector = unknowns * grid.sizes, roots * step
    multiply_kkt(unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, vector, product)
    if SCALED and grid.sizes.size:
        product *= roots
    product += diagonal * step + gradient
    if TIED:
        add_tied(product, grid.steps)
    return np.where(free_unknowns(grid), product, 0.0)


@njit(cache=True, error_model="numpy")
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
    left = linear_residual(grid, unknowns, diagonal, gradient, step)
    for refinement in range(SOLVED_AGAIN):
        errors.append(inaccuracy(gradient, step, left, grid.is_multiplier))
        if not ACCURATE < errors[-1] < np.inf:
            return refinement > 0
        if refinement == 2 and 0.5 * errors[0] < errors[-1] <= NEARLY_ACCURATE:
            return False
        corrections.append(np.empty_like(step))
        solve_kkt(grid, system, left / np.linalg.norm(left), corrections[-1])
        products.append(linear_residual(grid, unknowns, diagonal, zero, corrections[-1]))
        if not np.isfinite(products[-1]).all():
            return True
        parts, *_ = np.linalg.lstsq(np.array(products).T, -left, rcond=None)
        step += parts @ np.array(corrections)
        left = linear_residual(grid, unknowns, diagonal, gradient, step)
    return True
