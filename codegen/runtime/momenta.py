"""Momenta of a discrete motion by the forced discrete Legendre transforms."""

import numpy as np

from codegen.runtime.example import ELEMENT, IS_MULTIPLIER, NODE, STRIDE
from codegen.runtime.lagrangian import interval_gradients

EQUATIONS = np.flatnonzero(IS_MULTIPLIER[:NODE])  # places of the multipliers of the equations of motion in a node


def discrete_momenta(grid, unknowns):
    """Momenta (N + 1, n): p_k = -(D1 Ld + f-) of the interval after a node, D2 Ld + f+ of the last one.

    Both are what the multipliers of the equations of motion multiply in an interval's l.
    """
    parts = np.empty((grid.steps, ELEMENT))
    interval_gradients(unknowns, grid.steps, grid.h, grid.parameters, parts, np.empty_like(unknowns))
    return np.vstack([-parts[:, EQUATIONS], parts[-1:, STRIDE + EQUATIONS]])
