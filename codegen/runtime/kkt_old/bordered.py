"""Factor the KKT matrix, and solve with its factors, where bodies share unknowns: the separator, which comes last."""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_matrix, zero_vector
from codegen.runtime.kkt.static_condensation import condense, recover_condensed
from codegen.runtime.unknowns.coupling import add_coupling_matrix
from codegen.runtime.kkt.elements import BLOCK, padded
from codegen.runtime.unknowns.tied_ends import copy_shared_to_tied, add_tied_to_shared
from codegen.runtime.stand_ins.example import (
    BACKWARD, BODIES, CARRIED, COUPLINGS, ELEMENT, NODE, ROOT, SCALED, SHARED, STRIDE, TIED,
)  # fmt: skip
from codegen.runtime.kkt.frontal import LAST, LAST_WIDTH, allocate_factors, eliminate_body, fill_parts
from codegen.runtime.unknowns.layout import multiplier_unknowns
from codegen.runtime.unknowns.shared import read_shared, root_index
from codegen.runtime.kkt.substitution import backward, forward
from codegen.runtime.kkt.symmetric import eliminate_rows, solve_backward, solve_forward, solve_pivots, subtract_products

SHARED_WIDTH, ROOT_WIDTH, PARTS = padded(SHARED + CARRIED), padded(ROOT), ELEMENT + SHARED


def allocate_system(grid):
    """Room for the factors and for what is condensed, and the number of equations.

    The factors of the shared unknowns come last: the rows (ROOT, ROOT_WIDTH) of the upper factor, the inverse (ROOT, 2)
    of the pivots, the order (ROOT,) of elimination, and the right-hand side (ROOT,), less what the elimination of the
    bodies has taken away.
    """
    root = np.zeros((ROOT, ROOT_WIDTH)), np.zeros((ROOT, 2)), np.zeros(ROOT, np.uint64), np.zeros(ROOT)
    return (*allocate_factors(grid), *root), multiplier_unknowns(grid).size


@njit(cache=True, error_model="numpy")
def solve_system(
    is_new, unknowns, gradient, sizes, forces, steps, h, nodes, parameters, weight, diagonal, equations, upper, inverse,
    order, inverses, couplings, root_upper, root_inverse, root_order, root_right, step,
):  # fmt: skip
    """Factor the matrix if it `is_new`, bodies and then the shared unknowns, and solve for `step` unless that is empty.

    `unknowns`, `gradient`, `sizes`, `forces`, `diagonal`, `step` (n,), `nodes` (N + 1,), `parameters` (BODIES,
    P + SHARED); the factors are those of `allocate_system`. Return whether that was possible, and the excess of
    negative pivots: where there is one, elimination has stopped, and there is no step.
    """
    excess, chain = 0, steps * STRIDE + NODE
    if CARRIED:  # noqa: SIM108  decided when a module is made
        carried = is_new
    else:
        carried = False
    if is_new:
        last, root, parts = zero_matrix(LAST + SHARED, LAST_WIDTH), zero_matrix(ROOT, ROOT_WIDTH), zero_vector(PARTS)
        fill_parts(sizes, forces, parts)
        for i in range(ROOT):
            root_right[i] = -gradient[gradient.size - ROOT + i]
        for body in range(BODIES):
            first, behind = body * chain, (body + 1) * chain
            read_shared(unknowns, body, parameters)
            regular, negative, beyond = eliminate_body(
                unknowns[first:behind], gradient[first:behind], diagonal[first:behind], steps, h, nodes,
                parameters[body], weight, parts, upper[body], inverse[body], order[body], inverses[body],
                couplings[body], last,
            )  # fmt: skip
            if not regular or beyond > 0:
                return regular, beyond
            excess += negative
            add_to_root(body, upper[body, steps * BLOCK :], last, root, root_right)
        for i in range(ROOT):
            root[i, i] += diagonal[diagonal.size - ROOT + i]
        if COUPLINGS:
            add_conditions(unknowns, sizes, forces, parameters[0], weight, root)
        negative = eliminate_rows(root, *root.shape, root_upper, root_inverse, root_order)
        if negative < 0:
            return False, 0
        excess += negative - equations
    if step.size and excess <= 0:
        substitute(
            gradient, carried, steps, upper, inverse, order, inverses, couplings, root_upper, root_inverse, root_order,
            root_right, step,
        )  # fmt: skip
    return True, excess


@njit(error_model="numpy")
def add_to_root(body, upper, last, root, root_right):
    """Add what the elimination of a body leaves of the shared unknowns, in `last` (LAST + SHARED, LAST_WIDTH).

    `upper` (LAST, WIDTH) are the factors of its last node; `root` (ROOT, ROOT_WIDTH), `root_right` (ROOT,).
    """
    left = zero_matrix(SHARED, SHARED_WIDTH)
    for i in range(SHARED):
        for j in range(SHARED + CARRIED):
            left[i, j] = last[LAST + i, LAST + j]
    subtract_products(upper, last, LAST, LAST, SHARED, SHARED_WIDTH, left)
    for i in range(SHARED):
        for j in range(SHARED):
            root[root_index(body, i), root_index(body, j)] += left[min(i, j), max(i, j)]
        if CARRIED:
            root_right[root_index(body, i)] += left[i, SHARED]


if TIED:

    @njit(error_model="numpy")
    def ends_of(steps):
        """Where the first and the last node begin among the unknowns of a body's blocks."""
        return (steps * BLOCK, 0) if BACKWARD else (0, steps * BLOCK)


if COUPLINGS:

    @njit(error_model="numpy")
    def add_conditions(unknowns, sizes, forces, parameters, weight, root):
        """Add the conditions to the matrix `root` (ROOT, ROOT_WIDTH), in parts of `sizes` (n,) if there are any."""
        if SCALED and sizes.size:
            matrix, first = zero_matrix(ROOT, ROOT), sizes.size - ROOT
            add_coupling_matrix(unknowns, parameters, weight, matrix)
            for i in range(ROOT):
                for j in range(ROOT):
                    factor = sizes[first + i] * forces[first + i] * sizes[first + j] * forces[first + j]
                    root[i, j] += np.sqrt(factor) * matrix[i, j]
        else:
            add_coupling_matrix(unknowns, parameters, weight, root)


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def substitute(
    gradient, carried, steps, upper, inverse, order, inverses, couplings, root_upper, root_inverse, root_order,
    root_right, step,
):  # fmt: skip
    """Solve with the factors to `step` (n,): forward unless it is `carried`, the shared unknowns, and backward."""
    chain = steps * STRIDE + NODE
    right, last = zero_matrix(BODIES, steps * BLOCK + NODE + SHARED), zero_matrix(BODIES, LAST_WIDTH)
    shared = zero_vector(ROOT_WIDTH)
    for i in range(ROOT):
        shared[i] = root_right[i] if carried else -gradient[gradient.size - ROOT + i]
    if not carried:
        for body in range(BODIES):
            slopes = gradient[body * chain : (body + 1) * chain]
            condense(slopes, inverses[body], couplings[body], steps, right[body])
            if TIED:
                start, end = ends_of(steps)
                add_tied_to_shared(right[body], start, end, body, shared)
            forward(upper[body], inverse[body], order[body], steps, right[body], last[body])
            for i in range(SHARED):
                shared[root_index(body, i)] += right[body, steps * BLOCK + NODE + i] + last[body, LAST + i]
    solve_forward(root_upper, root_order, *root_upper.shape, shared)
    solve_pivots(root_inverse, root_order, ROOT, shared)
    solve_backward(root_upper, root_order, *root_upper.shape, shared)
    for i in range(ROOT):
        step[step.size - ROOT + i] = shared[i]
    for body in range(BODIES):
        slopes, solution = gradient[body * chain : (body + 1) * chain], step[body * chain : (body + 1) * chain]
        for i in range(SHARED):
            last[body, LAST + i] = right[body, steps * BLOCK + NODE + i] = shared[root_index(body, i)]
        if CARRIED:
            last[body, LAST + SHARED] = -1.0 if carried else 0.0
        backward(upper[body], order[body], steps, carried, last[body], right[body])
        if TIED:
            start, end = ends_of(steps)
            copy_shared_to_tied(right[body], start, end, body, shared)
        recover_condensed(slopes, inverses[body], couplings[body], steps, right[body], solution)
