"""The linearised field J H'' times directions, from stored second derivatives or, where they are too many, anew.

Stored ones are an array of shape (P, 2nd, 2nd), else there is None: numba compiles what is used of both.
"""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_pairs import hamiltonian_hessian, hessian_products
from codegen.runtime.particles.pair_algebra import symmetric_product

STORED = 3.0e7  # numbers in all matrices of second derivatives up to which they are stored (240 MB)


def curvature_at(points, own, parameters):
    """The second derivatives, shape (P, 2nd, 2nd), at all points, shape (P, 2, n, d), or None if they are too many."""
    if float(points.shape[0]) * points[0].size ** 2 > STORED:
        return None
    hessians = np.empty((points.shape[0], points[0].size, points[0].size))
    fill_curvature(points, own, parameters, hessians)
    return hessians


@njit(cache=True, error_model="numpy")
def fill_curvature(points, own, parameters, hessians):
    """Fill `hessians`, shape (P, 2nd, 2nd), with the second derivatives at all points."""
    for k in range(points.shape[0]):
        hamiltonian_hessian(points[k], own, parameters, hessians[k])


@njit(cache=True, error_model="numpy")
def linearised_field(hessians, points, k, own, parameters, directions, products):
    """Fill `products`, shape (2nd, m), with J H'' at the k-th point times directions."""
    if hessians is None:
        hessian_products(points[k], own, parameters, directions, products)
    else:
        symmetric_product(hessians[k], directions, products)
    half = directions.shape[0] // 2
    for row in range(half):
        for c in range(directions.shape[1]):
            by_position = products[row, c]
            products[row, c] = products[half + row, c]
            products[half + row, c] = -by_position
