"""A hand-written stand-in for the measurements of a module: q of the pendulum, on the line between its nodes."""

from typing import Any

import numpy as np
from numba import njit

FIRST_SAMPLE, SAMPLE = 4, 4
OBSERVATIONS = (np.array([[0.0, 1.0, 0.5], [1.0, 2.0, 0.5]]),)
metadata: dict[str, Any] = {"observations": {"columns": ("q",), "sources": ("pendulum.csv",)}}


@njit(error_model="numpy")
def motion_gradient(x, t, h, parameters, gradient):
    """Nothing moves."""
    return 0.0


@njit(error_model="numpy")
def motion_hessian(x, t, h, parameters, hessian):
    """Nothing moves."""


@njit(error_model="numpy")
def sample_values(x, t, h, parameters, sample, values):
    """The value of q."""
    values[0] = (1 - parameters[sample + 1]) * x[0] + parameters[sample + 1] * x[3]


@njit(error_model="numpy")
def sample_gradient(x, t, h, parameters, sample, gradient):
    """Add the gradient of (w (q - z))^2; returns it."""
    c, z, w = parameters[sample + 1], parameters[sample + 2], parameters[sample + 3]
    error = w * ((1 - c) * x[0] + c * x[3] - z)
    gradient[0] += 2 * w * error * (1 - c)
    gradient[3] += 2 * w * error * c
    return error**2


@njit(error_model="numpy")
def sample_hessian(x, t, h, parameters, sample, hessian):
    """Add the lower triangle of its Hessian."""
    c, w = parameters[sample + 1], parameters[sample + 3]
    hessian[0] += 2 * w**2 * (1 - c) ** 2
    hessian[4] += 2 * w**2 * c * (1 - c)
    hessian[6] += 2 * w**2 * c**2
