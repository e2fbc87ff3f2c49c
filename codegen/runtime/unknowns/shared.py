"""Unknowns that no node owns: each body's own ones, then those of the whole problem, at the end of all unknowns."""

from numba import njit

from codegen.runtime.stand_ins.example import (
    BODIES,
    COUPLINGS,
    OWN,
    PHASES,
    ROOT,
    SHARED,
    SAMPLED,
    TABLED,
    duration_of,
    phase_durations,
)
from codegen.runtime.stand_ins.example_samples import FIRST_SAMPLE


@njit(error_model="numpy", inline="always")
def root_index(body, j):
    """Index, among the unknowns that no node owns, of the shared unknown j of a body."""
    return body * OWN + j if j < OWN else (BODIES - 1) * OWN + j


@njit(error_model="numpy", inline="always")
def global_index(local, own, first, body, size):
    """Index, among `size` unknowns, of an interval's or an end's, which has `own` from `first` on, then shared ones."""
    return first + local if local < own else size - ROOT + root_index(body, local - own)


@njit(error_model="numpy")
def read_shared(unknowns, body, parameters):
    """Copy a body's shared ones of `unknowns` (n,) behind its `parameters` (BODIES, P + SHARED), where kernels read."""
    first = unknowns.size - ROOT
    behind = parameters.shape[1] - SHARED
    if SAMPLED:
        behind = FIRST_SAMPLE - SHARED  # samples are as many as are given
    if TABLED:
        behind -= TABLED
    for j in range(SHARED):
        parameters[body, behind + j] = unknowns[first + root_index(body, j)]


@njit(error_model="numpy", inline="always")
def add_shared(part, index, body, gradient):
    """Add the entries of `part` from `index` on to `gradient` (n,) by the shared unknowns of a body."""
    first = gradient.size - ROOT
    for j in range(SHARED):
        gradient[first + root_index(body, j)] += part[index + j]


def shared_views(unknowns):
    """Views of the shared ones of `unknowns` (n,): of each body (BODIES, OWN), and of the whole problem, 1-D."""
    first = unknowns.size - ROOT
    own = unknowns[first : first + BODIES * OWN].reshape(BODIES, OWN)
    return own, unknowns[first + BODIES * OWN : unknowns.size - COUPLINGS]


def least_duration(grid, unknowns):
    """The length of the time interval, or of the shortest phase."""
    least = duration_of(grid, unknowns)
    if PHASES:
        least = phase_durations(grid, unknowns).min()
    return least
