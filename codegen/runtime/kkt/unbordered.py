"""Factor the KKT matrix, and solve with its factors, where no unknown is shared: one body after the other."""

from numba import njit

from codegen.runtime.arrays import zero_matrix, zero_vector
from codegen.runtime.kkt.static_condensation import condense, recover_condensed
from codegen.runtime.kkt.elements import BLOCK
from codegen.runtime.stand_ins.example import BODIES, CARRIED, ELEMENT, NODE, STRIDE
from codegen.runtime.kkt.frontal import LAST, LAST_WIDTH, allocate_factors, eliminate_body, fill_parts
from codegen.runtime.unknowns.layout import multiplier_unknowns
from codegen.runtime.kkt.substitution import backward, forward


def allocate_system(grid):
    """Room for the factors and for what is condensed, and the number of equations."""
    return allocate_factors(grid), multiplier_unknowns(grid).size


@njit(cache=True, error_model="numpy")
def solve_system(
    is_new, unknowns, gradient, sizes, forces, steps, h, nodes, parameters, weight, diagonal, equations, upper, inverse,
    order, inverses, couplings, step,
):  # fmt: skip
    """Factor a matrix that `is_new`; with its factors, fill `step` (n,) unless that is empty, or they are incomplete.

    Arrays are those of `factor`, and so is what is returned. Python calls this alone, and once for both.
    """
    regular, excess, carried = True, 0, False
    if CARRIED:
        carried = is_new
    if is_new:
        regular, excess = factor(
            unknowns, gradient, sizes, forces, steps, h, nodes, parameters, weight, diagonal, equations, upper,
            inverse, order, inverses, couplings,
        )  # fmt: skip
    if step.size and regular and excess <= 0:
        substitute(gradient, carried, steps, upper, inverse, order, inverses, couplings, step)
    return regular, excess


@njit(error_model="numpy")
def factor(
    unknowns, gradient, sizes, forces, steps, h, nodes, parameters, weight, diagonal, equations, upper, inverse,
    order, inverses, couplings,
):  # fmt: skip
    """Eliminate all bodies; whether that was possible, and the excess of negative pivots.

    `unknowns`, `gradient`, `sizes`, `forces`, `diagonal` (n,), `nodes` (N + 1,), `parameters` (BODIES, P); the
    factors are those of `allocate_factors`.
    """
    parts = zero_vector(ELEMENT)
    fill_parts(sizes, forces, parts)
    negative, chain, last = 0, steps * STRIDE + NODE, zero_matrix(LAST, LAST_WIDTH)
    for body in range(BODIES):
        first, behind = body * chain, (body + 1) * chain
        regular, found, excess = eliminate_body(
            unknowns[first:behind], gradient[first:behind], diagonal[first:behind], steps, h, nodes,
            parameters[body], weight, parts, upper[body], inverse[body], order[body], inverses[body], couplings[body],
            last,
        )  # fmt: skip
        if not regular or excess > 0:
            return regular, excess
        negative += found
    return True, negative - equations


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def substitute(gradient, carried, steps, upper, inverse, order, inverses, couplings, step):
    """Solve with the factors, forward, unless `carried`: elimination has done that, and backward to `step` (n,)."""
    chain = steps * STRIDE + NODE
    for body in range(BODIES):
        slopes, solution = gradient[body * chain : (body + 1) * chain], step[body * chain : (body + 1) * chain]
        right, last = zero_vector(steps * BLOCK + NODE), zero_vector(LAST_WIDTH)
        if not carried:
            condense(slopes, inverses[body], couplings[body], steps, right)
            forward(upper[body], inverse[body], order[body], steps, right, last)
        if CARRIED:
            last[LAST] = -1.0 if carried else 0.0
        backward(upper[body], order[body], steps, carried, last, right)
        recover_condensed(slopes, inverses[body], couplings[body], steps, right, solution)
