"""The linearised field J H'' times directions, from stored second derivatives or, where they are too many, anew.

They are a pair: stored ones, an array of shape (P, 2nd, 2nd), and None; or an empty array and True. Where an argument
is None numba leaves out what is for others, so that products without stored ones are compiled only for those.
"""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_pairs import hamiltonian_hessian, hessian_products
from codegen.runtime.particles.pair_algebra import symmetric_product

STORED = 3.0e7  # numbers in all matrices of second derivatives up to which they are stored (240 MB)


def curvature_at(points, own, parameters):
    """The second derivatives at all points, shape (P, 2, n, d), as a pair; none are stored if they are too many."""
    are_too_many = float(points.shape[0]) * points[0].size ** 2 > STORED
    hessians = np.empty((0 if are_too_many else points.shape[0], points[0].size, points[0].size))
    if are_too_many:
        return hessians, True
    fill_curvature(points, own, parameters, hessians)
    return hessians, None


@njit(cache=True, error_model="numpy")
def fill_curvature(points, own, parameters, hessians):
    """Fill `hessians`, shape (P, 2nd, 2nd), with the second derivatives at all points."""
    for k in range(points.shape[0]):
        hamiltonian_hessian(points[k], own, parameters, hessians[k])


@njit(cache=True, error_model="numpy")
def linearised_field(hessians, anew, points, k, own, parameters, directions, products):
    """Fill `products`, shape (2nd, m), with J H'' at the k-th point times directions."""
    if anew is None:
        symmetric_product(hessians[k], directions, products)
    else:
        hessian_products(points[k], own, parameters, directions, products)
    half = directions.shape[0] // 2
    for row in range(half):
        for c in range(directions.shape[1]):
            by_position = products[row, c]
            products[row, c] = products[half + row, c]
            products[half + row, c] = -by_position
