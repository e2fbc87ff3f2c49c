"""Derivatives by data of an interval's share l with its samples of measurements."""

from numba import njit

from codegen.runtime.stand_ins.example_mixed import motion_mixed, sample_mixed
from codegen.runtime.stand_ins.example_samples import SAMPLE
from codegen.runtime.unknowns.samples import first_sample


@njit(error_model="numpy")
def interval_mixed(unknowns, t, h, parameters, slopes, mixed):
    """Derivatives of an interval's share l, with its samples: `slopes` (DATA,) by data, `mixed` by both."""
    motion_mixed(unknowns, t, h, parameters, slopes, mixed)
    sample = first_sample(t, parameters)
    while sample < parameters.size and parameters[sample] < t + h:
        sample_mixed(unknowns, t, h, parameters, sample, slopes, mixed)
        sample += SAMPLE
