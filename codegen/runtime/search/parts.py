"""Gradients of single intervals: discrete momenta, shares of the cost."""

import numpy as np
from numba import njit

from codegen.runtime.addresses import call_loop


def interval_parts(grid, unknowns):
    """Return the gradient of each interval's share of the Lagrangian, then its cost: (bodies, N, element + shared + 1).

    `unknowns` (n,) are in the problem's own units.
    """
    s = grid.problem.structure
    parts = np.empty((s.bodies, grid.steps, s.element + s.shared + 1))
    fill(grid.problem.parts.address, unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, parts.reshape(-1))
    return parts


@njit(cache=True, error_model="numpy")
def fill(loop, unknowns, steps, h, nodes, parameters, filled):
    """Call the loop at an address, which fills a vector; return what it returns."""
    return call_loop(
        loop, unknowns.ctypes.data, steps, h, nodes.ctypes.data, parameters.ctypes.data, parameters.shape[1],
        filled.ctypes.data,
    )  # fmt: skip


def discrete_momenta(grid, unknowns):
    """Return the momenta (bodies, N + 1, m) by the forced discrete Legendre transforms.

    p_k = -(D1 Ld + f-) of the interval after a node, and D2 Ld + f+ of the last one: both stand beside the multipliers
    of the equations of motion in an interval's share of the Lagrangian.
    """
    s = grid.problem.structure
    parts = np.empty((s.bodies, grid.steps, s.element + s.shared + 1))
    momenta = np.empty((s.bodies, grid.steps + 1, s.equations.size))
    fill_momenta(
        grid.problem.parts.address, unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, s.equations, s.stride,
        parts, momenta,
    )  # fmt: skip
    return momenta


@njit(cache=True, error_model="numpy")
def fill_momenta(loop, unknowns, steps, h, nodes, parameters, equations, stride, parts, momenta):
    """Fill the momenta (bodies, N + 1, m); `parts` (bodies, N, element + shared + 1) takes what the loop fills."""
    call_loop(
        loop, unknowns.ctypes.data, steps, h, nodes.ctypes.data, parameters.ctypes.data, parameters.shape[1],
        parts.ctypes.data,
    )  # fmt: skip
    for body in range(parts.shape[0]):
        for i in range(equations.size):
            for k in range(steps):
                momenta[body, k, i] = -parts[body, k, equations[i]]
            momenta[body, steps, i] = parts[body, steps - 1, stride + equations[i]]
