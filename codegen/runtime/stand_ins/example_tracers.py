"""A hand-written stand-in for generated kernels of tracer points, under the Gaussian kernel of `example_pairs`.

Exists so that the files of this folder can be imported and tested; never included anywhere.
"""

import numpy as np
from numba import njit

BLOCK = 4


@njit(cache=True, error_model="numpy", nogil=True)
def tracer_velocity(positions, z, own, parameters, rates):
    """Fill `rates`, shape (2*BLOCK,), with velocities at `positions`, of the same shape."""
    tracer_gradient(positions, z, own, parameters, rates, np.empty(4 * BLOCK))


@njit(cache=True, error_model="numpy", nogil=True)
def tracer_gradient(positions, z, own, parameters, rates, gradients):
    """Fill `rates` and their derivatives by position, `gradients`, shape (4*BLOCK,)."""
    rates[:], gradients[:] = 0.0, 0.0
    for m in range(BLOCK):
        for j in range(z.shape[1]):
            dx, dy = positions[m] - z[0, j, 0], positions[BLOCK + m] - z[0, j, 1]
            kernel = np.exp(-0.5 * (dx * dx + dy * dy))
            for a in range(2):
                rates[a * BLOCK + m] += kernel * z[1, j, a]
                gradients[2 * a * BLOCK + m] -= kernel * dx * z[1, j, a]
                gradients[(2 * a + 1) * BLOCK + m] -= kernel * dy * z[1, j, a]
