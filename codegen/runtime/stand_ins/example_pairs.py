"""A hand-written stand-in for generated kernels: landmarks in the plane under a Gaussian kernel of width one.

H = 1/2 sum_ij p_i . p_j exp(-|q_i - q_j|^2/2). Exists so that the files of this folder can be imported and tested;
never included anywhere.
"""

import numpy as np
from numba import njit

DIMENSION, BLOCKS, QUADRATIC, DOMAIN = 2, 1, 1, 0
POINTS, IMPLICIT = 1, 0
SUBSTEPS = ((1.0, 0.0, 0.0),)
ROWS = ((0.0, 0.0), (0.5, 0.0))
WEIGHTS = (0.0, 1.0)
COST_WEIGHTS = (1.0,)
ABSCISSA = 0.0
GROUP = 4


@njit(cache=True, error_model="numpy")
def mirror_lower_triangle(matrix):
    """Copy what is below the diagonal to above it."""
    for row in range(matrix.shape[0]):
        for column in range(row):
            matrix[column, row] = matrix[row, column]


@njit(cache=True, error_model="numpy")
def hamiltonian(z, own, parameters):
    """H at a state."""
    energy = 0.0
    for i in range(z.shape[1]):
        for j in range(z.shape[1]):
            d = z[0, i] - z[0, j]
            energy += 0.5 * (z[1, i] * z[1, j]).sum() * np.exp(-0.5 * (d * d).sum())
    return energy


@njit(cache=True, error_model="numpy")
def hamiltonian_gradient(z, own, parameters, gradient):
    """Fill `gradient`, shape (2, n, d), with H_q and H_p."""
    gradient[:] = 0.0
    for i in range(z.shape[1]):
        for j in range(z.shape[1]):
            d = z[0, i] - z[0, j]
            kernel = np.exp(-0.5 * (d * d).sum())
            gradient[0, i] -= (z[1, i] * z[1, j]).sum() * kernel * d
            gradient[1, i] += kernel * z[1, j]


@njit(cache=True, error_model="numpy")
def gradient_of_some(z, own, parameters, begin, end, gradient):
    """Fill the rows of particles from `begin` to `end`."""
    whole = np.empty(z.shape)
    hamiltonian_gradient(z, own, parameters, whole)
    gradient[:, begin:end] = whole[:, begin:end]


@njit(cache=True, error_model="numpy")
def hamiltonian_hessian(z, own, parameters, hessian):
    """Fill `hessian`, shape (2nd, 2nd), by differences of the gradient, good enough for an example."""
    shifted, up, down = z.copy(), np.empty(z.shape), np.empty(z.shape)
    flat = shifted.reshape(-1)
    for column in range(flat.size):
        value = flat[column]
        flat[column] = value + 1e-5
        hamiltonian_gradient(shifted, own, parameters, up)
        flat[column] = value - 1e-5
        hamiltonian_gradient(shifted, own, parameters, down)
        flat[column] = value
        hessian[:, column] = (up.reshape(-1) - down.reshape(-1)) / 2e-5


@njit(cache=True, error_model="numpy")
def hessian_products(z, own, parameters, directions, products):
    """Fill `products` with the second derivatives of H times directions, both of shape (2nd, m)."""
    hessian = np.empty((z.size, z.size))
    hamiltonian_hessian(z, own, parameters, hessian)
    products[:] = 0.0
    for row in range(z.size):
        for column in range(z.size):
            products[row] += hessian[row, column] * directions[column]


@njit(cache=True, error_model="numpy")
def momentum_matrix(z, own, parameters, matrix):
    """Fill `matrix`, shape (n, n), with the kernel between all particles."""
    for i in range(z.shape[1]):
        for j in range(z.shape[1]):
            d = z[0, i] - z[0, j]
            matrix[i, j] = np.exp(-0.5 * (d * d).sum())


@njit(cache=True, error_model="numpy")
def domain_margin(z):
    """No place is forbidden."""
    return np.inf


@njit(cache=True, error_model="numpy")
def guide(start, target, fraction, position):
    """A straight line from start to target."""
    position[:] = start + fraction * (target - start)


def make_own():
    """Particles have no parameters of their own."""
    return np.zeros((1, 0))


@njit(cache=True, error_model="numpy")
def velocity(z, own, parameters, rates):
    """H_p of a separable Hamiltonian, as an example: unit masses."""
    rates[:] = z[1]


@njit(cache=True, error_model="numpy")
def slope(z, own, parameters, rates):
    """H_q of a separable Hamiltonian, as an example: springs to the origin."""
    rates[:] = z[0]
