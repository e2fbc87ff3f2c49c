"""The gradient of H by several threads: blocks of particles are gathered independently of each other.

What a particle gets does not depend on who adds it up, so that results are those of one thread to the last digit.
"""

from numba import njit, prange

from codegen.runtime.stand_ins.example_pairs import GROUP, gradient_of_some


@njit(cache=True, error_model="numpy", parallel=True)
def gradient_by_threads(z, own, parameters, gradient):
    """Fill `gradient`, shape (2, n, d), with H_q and H_p, one block of particles after the other by any thread."""
    count = z.shape[1]
    for block in prange((count + GROUP - 1) // GROUP):
        begin = block * GROUP
        gradient_of_some(z, own, parameters, begin, min(begin + GROUP, count), gradient)


@njit(cache=True, error_model="numpy")
def hamiltonian_gradient(z, own, parameters, gradient):
    """Fill `gradient`, shape (2, n, d), with H_q and H_p; a single block is not worth waking threads."""
    if z.shape[1] > GROUP:
        gradient_by_threads(z, own, parameters, gradient)
    else:
        gradient_of_some(z, own, parameters, 0, z.shape[1], gradient)
