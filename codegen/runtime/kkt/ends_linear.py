"""What the boundary conditions do to the first and last element matrix where they are not curved: pin what is given."""

import numpy as np
from numba import njit

from codegen.runtime.kkt.elements import pin_ends
from codegen.runtime.stand_ins.example import SCALED


@njit(error_model="numpy")
def apply_boundary_conditions(unknowns, k, steps, h, parameters, weight, parts, diagonal, element):
    """Pin what is given in the `element` (ROWS, WIDTH) of interval k."""
    pin_ends(k, steps, diagonal, element)


if SCALED:

    @njit(error_model="numpy")
    def add_end_entries(unknowns, body, steps, h, parameters, terms, effect, curvature):
        """Add derivatives of the ends' own shares to the tables of `scaling`: there are none."""

    @njit(error_model="numpy", inline="always")
    def multiply_ends(unknowns, body, steps, h, parameters, vector, product):
        """Add to `product` (n,) what the ends' own second derivatives make of `vector` (n,): there are none."""


@njit(error_model="numpy", inline="always")
def add_end_terms(unknowns, body, steps, h, parameters, sums):
    """Add the absolute terms of the ends' own shares to `sums` (n,): there are none."""


def end_entries(grid, unknowns):
    """Entries (rows, columns, values) that the ends add to the lower triangle of the KKT matrix: none."""
    return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
