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
    """Factor the matrix if it `is_new`, by eliminating all bodies, and solve for `step` (n,) unless that is empty.

    `unknowns`, `gradient`, `sizes`, `forces`, `diagonal` (n,), `nodes` (N + 1,), `parameters` (BODIES, P); the
    factors are those of `allocate_factors`. Return whether that was possible, and the excess of negative pivots: where
    there is one, elimination has stopped, and there is no step.
    """
    excess, chain = 0, steps * STRIDE + NODE
    if CARRIED:  # noqa: SIM108  decided when a module is made
        carried = is_new
    else:
        carried = False
    if is_new:
        parts, last = zero_vector(ELEMENT), zero_matrix(LAST, LAST_WIDTH)
        fill_parts(sizes, forces, parts)
        for body in range(BODIES):
            first, behind = body * chain, (body + 1) * chain
            regular, negative, beyond = eliminate_body(
                unknowns[first:behind], gradient[first:behind], diagonal[first:behind], steps, h, nodes,
                parameters[body], weight, parts, upper[body], inverse[body], order[body], inverses[body],
                couplings[body], last,
            )  # fmt: skip
            if not regular or beyond > 0:
                return regular, beyond
            excess += negative
        excess -= equations
    if step.size and excess <= 0:
        substitute(gradient, carried, steps, upper, inverse, order, inverses, couplings, step)
    return True, excess


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
