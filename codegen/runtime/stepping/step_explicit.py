"""One step of an explicit scheme."""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_step import explicit_step


@njit(cache=True, error_model="numpy")
def allocate_work(h, given):
    """An explicit step needs no arrays of its own."""
    return np.empty(0)


@njit(cache=True, error_model="numpy")
def advance(state, t, h, given, work, interval):
    """Fill `interval`, shape (STAGES + STATE,), with inner stages and the state at the right node; return 0 iterations.

    `state` has shape (STATE,).
    """
    explicit_step(state, t, h, given[0], interval)
    return 0
