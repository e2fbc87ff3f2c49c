"""The linearised field J H'' times directions, from stored second derivatives or, where they are too many, anew."""

import numpy as np
from numba import njit

from codegen.runtime.example_pairs import hamiltonian_hessian, hessian_products
from codegen.runtime.pair_algebra import symmetric_product

STORED = 3.0e7  # numbers in all matrices of second derivatives up to which they are stored (240 MB)


@njit(cache=True, error_model="numpy")
def curvature_at(points, own, parameters):
    """The second derivatives at all points (P, 2, n, d), shape (P, 2nd, 2nd), or an empty array if they are too many."""
    count, size = points.shape[0], points[0].size
    if float(count) * size * size > STORED:
        return np.empty((0, size, size))
    hessians = np.empty((count, size, size))
    for k in range(count):
        hamiltonian_hessian(points[k], own, parameters, hessians[k])
    return hessians


@njit(cache=True, error_model="numpy")
def linearised_field(hessians, points, k, own, parameters, directions, products):
    """Fill `products`, shape (2nd, m), with J H'' at the k-th point times directions."""
    if hessians.shape[0]:
        symmetric_product(hessians[k], directions, products)
    else:
        hessian_products(points[k], own, parameters, directions, products)
    half = directions.shape[0] // 2
    for row in range(half):
        for c in range(directions.shape[1]):
            by_place = products[row, c]
            products[row, c] = products[half + row, c]
            products[half + row, c] = -by_place
