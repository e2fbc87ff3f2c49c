"""Measurements on an interval: what its samples add to its share of the Lagrangian.

Samples stand behind the parameters of a body, sorted by time, in rows of SAMPLE numbers: the middle of the interval in
which one lies, the fraction of the interval at which it does, its values, and the inverses of their standard
deviations. Middles tell intervals apart whatever is rounded.
"""

from numba import njit

from codegen.runtime.stand_ins.example_samples import (
    FIRST_SAMPLE, SAMPLE, motion_gradient, motion_hessian, sample_gradient, sample_hessian,
)  # fmt: skip


@njit(error_model="numpy")
def interval_gradient(unknowns, t, h, parameters, gradient):
    """Gradient (ELEMENT + SHARED,) of an interval's share l, with its samples; returns Cd and their losses."""
    cost = motion_gradient(unknowns, t, h, parameters, gradient)
    sample = first_sample(t, parameters)
    while sample < parameters.size and parameters[sample] < t + h:
        cost += sample_gradient(unknowns, t, h, parameters, sample, gradient)
        sample += SAMPLE
    return cost


@njit(error_model="numpy")
def interval_hessian(unknowns, t, h, parameters, hessian):
    """Hessian (HESSIAN_ROWS.size,), lower triangle, of an interval's share l, with its samples."""
    motion_hessian(unknowns, t, h, parameters, hessian)
    sample = first_sample(t, parameters)
    while sample < parameters.size and parameters[sample] < t + h:
        sample_hessian(unknowns, t, h, parameters, sample, hessian)
        sample += SAMPLE


@njit(error_model="numpy")
def first_sample(t, parameters):
    """Where the first sample stands whose interval does not end before t, by bisection."""
    low, high = 0, (parameters.size - FIRST_SAMPLE) // SAMPLE
    while low < high:
        middle = (low + high) // 2
        if parameters[FIRST_SAMPLE + middle * SAMPLE] < t:
            low = middle + 1
        else:
            high = middle
    return FIRST_SAMPLE + low * SAMPLE
