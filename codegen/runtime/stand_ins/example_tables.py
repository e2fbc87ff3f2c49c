"""A hand-written stand-in for the tables of a module: y = x^3 on three breakpoints, with its slopes."""

from typing import Any

import numpy as np
from numba import njit

TABLES = {"cube": np.array([0.0, 1.0, 2.0, 0.0, 0.0, 1.0, 3.0, 8.0, 12.0])}
metadata: dict[str, Any] = {"tables": {"cube": {"sizes": (3,)}}}
RANGED, RANGES, RANGE_NAMES = 1, np.array([[4, 6]]), ("x of table cube",)


@njit(error_model="numpy")
def interval_inputs(x, t, h, parameters, inputs):
    """The index in the middle."""
    inputs[0, 0] = inputs[0, 1] = (x[0] + x[3]) / 2


@njit(error_model="numpy")
def start_inputs(x, t, parameters, inputs):
    """Nothing is read there."""


@njit(error_model="numpy")
def end_inputs(x, t, parameters, inputs):
    """Nothing is read there."""


@njit(error_model="numpy")
def step_inputs(state, interval, t, h, parameters, inputs):
    """The place in the middle."""
    inputs[0, 0] = inputs[0, 1] = (state[0] + interval[0]) / 2
