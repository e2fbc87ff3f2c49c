"""Value and gradient of the Lagrangian of the optimisation problem: a sum over bodies, intervals and ends.

The n unknowns lie in one vector: for each body node 0, interval 0, node 1, interval 1, ..., node N, which are
N STRIDE + NODE; then the ROOT ones that no node owns. In docstrings n and N = `steps` are these numbers, P is that of
parameters. The gradient by the multipliers is the residual of the discrete equations, the gradient by the other
unknowns is the stationarity of the optimum.
"""

from numba import njit

from codegen.runtime.arrays import copy_part, zero_vector
from codegen.runtime.unknowns.coupling import add_coupling_gradient
from codegen.runtime.stand_ins.example import (
    BODIES, COUPLINGS, ELEMENT, END_PINNED, NODE, ROOT, SHARED, START_PINNED, STRIDE, TIED, end_gradient,
    interval_gradient, start_gradient,
)  # fmt: skip
from codegen.runtime.unknowns.shared import add_shared, read_shared
from codegen.runtime.unknowns.tied_ends import add_tied_to_shared


@njit(error_model="numpy")
def lagrangian_gradient(unknowns, steps, h, parameters, gradient):
    """Fill the `gradient` (n,) by `unknowns` (n,), zero where they are pinned, and return the discrete cost."""
    chain = steps * STRIDE + NODE
    for i in range(gradient.size):
        gradient[i] = 0.0
    local, part = zero_vector(ELEMENT), zero_vector(ELEMENT + SHARED)
    at_end = zero_vector(NODE + SHARED)
    cost = 0.0
    for body in range(BODIES):
        first, last, own = body * chain, (body + 1) * chain - NODE, parameters[body]
        if SHARED:
            read_shared(unknowns, body, parameters)
        for i in range(at_end.size):
            at_end[i] = 0.0
        cost += start_gradient(unknowns[first : first + NODE], 0.0, own, at_end)
        add_end(at_end, first, NODE, body, gradient)
        for i in range(at_end.size):
            at_end[i] = 0.0
        cost += end_gradient(unknowns[last : last + NODE], steps * h, own, at_end)
        add_end(at_end, last, NODE, body, gradient)
        for k in range(steps):
            here = first + k * STRIDE
            copy_part(unknowns, here, local)
            cost += interval_gradient(local, k * h, h, own, part)
            add_end(part, here, ELEMENT, body, gradient)
        if TIED:
            add_tied_to_shared(gradient, first, last, body, gradient[gradient.size - ROOT :])
        for i in START_PINNED:
            gradient[first + i] = 0.0
        for i in END_PINNED:
            gradient[last + i] = 0.0
    if COUPLINGS:
        add_coupling_gradient(unknowns, parameters[0], gradient)
    return cost


@njit(error_model="numpy", inline="always")
def add_end(part, first, size, body, gradient):
    """Add `part` (size + SHARED,) to `gradient` (n,): to `size` from `first` on, then to the body's shared unknowns."""
    for i in range(size):
        gradient[first + i] += part[i]
    if SHARED:
        add_shared(part, size, body, gradient)
