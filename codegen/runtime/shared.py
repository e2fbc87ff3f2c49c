"""Unknowns that no node owns: each body's own ones, then those of the whole problem, at the end of all unknowns."""

import numpy as np
from numba import njit

from codegen.runtime.example import (
    BODIES,
    COUPLINGS,
    END_SHARED,
    END_SHARED_PLACES,
    NODE,
    OWN,
    ROOT,
    SHARED,
    START_SHARED,
    START_SHARED_PLACES,
    STRIDE,
)


@njit(error_model="numpy", inline="always")
def root_place(body, j):
    """Place, among the unknowns that no node owns, of the shared unknown j of a body."""
    return body * OWN + j if j < OWN else (BODIES - 1) * OWN + j


@njit(error_model="numpy")
def read_shared(unknowns, body, parameters):
    """Copy the values of a body's shared unknowns behind its parameters, where kernels read them."""
    first = unknowns.size - ROOT
    behind = parameters.shape[1] - SHARED
    for j in range(SHARED):
        parameters[body, behind + j] = unknowns[first + root_place(body, j)]


@njit(error_model="numpy", inline="always")
def add_shared(part, place, body, gradient):
    """Add the entries of a share from `place` on to the gradient by the shared unknowns of a body."""
    first = gradient.size - ROOT
    for j in range(SHARED):
        gradient[first + root_place(body, j)] += part[place + j]


@njit(error_model="numpy")
def release_shared(start, end, body, gradient):
    """Move the gradient by what equals a shared unknown, at the first and last node of a body, to that unknown."""
    first = gradient.size - ROOT
    for i in range(START_SHARED.size):
        gradient[first + root_place(body, START_SHARED[i])] += gradient[start + START_SHARED_PLACES[i]]
    for i in range(END_SHARED.size):
        gradient[first + root_place(body, END_SHARED[i])] += gradient[end + END_SHARED_PLACES[i]]


@njit(cache=True, error_model="numpy")
def follow_shared(chain, step):
    """Give the unknowns that equal a shared one, at the first and last nodes, its step."""
    first = step.size - ROOT
    for body in range(BODIES):
        for i in range(START_SHARED.size):
            step[body * chain + START_SHARED_PLACES[i]] = step[first + root_place(body, START_SHARED[i])]
        for i in range(END_SHARED.size):
            last = (body + 1) * chain - NODE
            step[last + END_SHARED_PLACES[i]] = step[first + root_place(body, END_SHARED[i])]


@njit(error_model="numpy", inline="always")
def release_rows(places, shared, first, size, element):
    """Add the rows and columns of unknowns that equal a shared one to the shared one's, which begin at `size`."""
    for i in range(places.size):
        place, to = first + places[i], size + shared[i]
        for j in range(element.shape[1]):
            element[to, j] += element[place, j]
        for j in range(element.shape[0]):
            element[j, to] += element[j, place]


def shared_representatives(grid, size):
    """For every unknown its own place, or that of the shared unknown which it equals."""
    places, chain = np.arange(size), grid.steps * STRIDE + NODE
    for body in range(BODIES):
        shared = np.array([size - ROOT + root_place(body, j) for j in range(SHARED)])
        places[body * chain + START_SHARED_PLACES] = shared[START_SHARED]
        places[(body + 1) * chain - NODE + END_SHARED_PLACES] = shared[END_SHARED]
    return places


def shared_views(unknowns):
    """Views of the shared unknowns: those of each body (bodies, OWN), and those of the whole problem."""
    first = unknowns.size - ROOT
    own = unknowns[first : first + BODIES * OWN].reshape(BODIES, OWN)
    return own, unknowns[first + BODIES * OWN : unknowns.size - COUPLINGS]
