"""A hand-written stand-in for generated kernels: swing a pendulum, q'' = -sin q + u, with least integral of u^2.

Variational midpoint rule, unknowns (q, lambda) on nodes and u on intervals; parameters are the boundary values q(0),
v(0), q(T), v(T). Exists so that the files of this folder can be imported and tested; never included anywhere.
"""

from typing import Any

import numpy as np
from numba import njit

NODE, CONDENSED, STRIDE, ELEMENT = 2, 1, 3, 5
BODIES, OWN, SHARED, COUPLINGS, ROOT, TIED, PHASES, INEQUALITIES = 1, 0, 0, 0, 0, 0, 0, 1
BORDERED, CARRIED, SEVERAL, SCALED, SHARED_MULTIPLIERS, UNBOUNDED, TABLED, RANGED, SAMPLED = 1, 1, 0, 1, 0, 1, 0, 0, 0
SLACKED = COSTLESS = FORWARD = 0
MOTION_EQUATIONS = MOTION_UNKNOWNS = np.zeros(0, np.int64)
BACKWARD = 0
INNER_TIMES = INNER_FIRST = FREE_TIMES = 0
INNER_UNKNOWNS, INNER_PRESENT = np.zeros(0, np.int64), np.zeros((0, 0), bool)
INNER_LACKS = np.zeros(0, np.int64)
PHASE_LACKS = SWITCH_LACKS = np.zeros((0, 1), bool)
SHARED_IS_MULTIPLIER = np.zeros(0, bool)
IS_MULTIPLIER = np.array([False, True, False])
START_PINNED = END_PINNED = np.array([0])
ONLY_AT_ENDS = np.zeros(0, np.int64)
EQUATIONS = np.array([1])
SLACKS = SLACK_MULTIPLIERS = np.zeros(0, np.int64)
START_TIED = START_SHARED = END_TIED = END_SHARED = np.zeros(0, np.int64)
COUPLING_KINDS = COUPLING_COUNTS = COUPLING_ROWS = np.zeros(0, np.int64)
COUPLING_INDICES = np.zeros((0, 0), np.int64)
HESSIAN_ROWS = np.array([0, 1, 2, 2, 3, 3, 3, 4, 4, 4])
HESSIAN_COLUMNS = np.array([0, 0, 1, 2, 0, 1, 3, 0, 2, 3])
START_HESSIAN_ROWS = START_HESSIAN_COLUMNS = END_HESSIAN_ROWS = END_HESSIAN_COLUMNS = np.zeros(0, np.int64)
metadata: dict[str, Any] = {"node": ("q", "lambda_q"), "interval": ("u",), "shared": (), "free_parameters": ()}
metadata |= {"meanings": {}, "parameters": {}}


@njit(error_model="numpy")
def interval_gradient(x, t, h, parameters, gradient):
    """Gradient of l = h u^2 + lambda_k (D1 Ld + h u/2) + lambda_k1 (D2 Ld + h u/2); returns the cost h u^2."""
    q, left, u, q1, right = x[0], x[1], x[2], x[3], x[4]
    middle, v = (q + q1) / 2, (q1 - q) / h
    curvature = -h / 4 * np.cos(middle) * (left + right)
    gradient[0] = curvature + (left - right) / h
    gradient[1] = -h / 2 * np.sin(middle) - v + h * u / 2
    gradient[2] = 2 * h * u + h / 2 * (left + right)
    gradient[3] = curvature - (left - right) / h
    gradient[4] = -h / 2 * np.sin(middle) + v + h * u / 2
    return h * u * u


@njit(error_model="numpy")
def interval_hessian(x, t, h, parameters, hessian):
    """Fill the lower triangle of the Hessian."""
    middle = (x[0] + x[3]) / 2
    second = h / 8 * np.sin(middle) * (x[1] + x[4])
    mixed = -h / 4 * np.cos(middle)
    hessian[0] = second
    hessian[1] = mixed + 1 / h
    hessian[2] = h / 2
    hessian[3] = 2 * h
    hessian[4] = second
    hessian[5] = mixed - 1 / h
    hessian[6] = second
    hessian[7] = mixed - 1 / h
    hessian[8] = h / 2
    hessian[9] = mixed + 1 / h


@njit(cache=True, error_model="numpy")
def control_hessian(h, parameters, block):
    """Second derivative of l by u."""
    block[0, 0] = 2 * h


@njit(error_model="numpy")
def start_gradient(x, t, parameters, gradient):
    """Add the gradient of lambda_0 v(0); returns its cost, none."""
    gradient[1] += parameters[1]
    return 0.0


@njit(error_model="numpy")
def coupling_term(kind, values, parameters, slopes, curvatures):
    """Nothing is coupled."""
    return 0.0


@njit(error_model="numpy")
def end_gradient(x, t, parameters, gradient):
    """Add the gradient of -lambda_N v(T); returns its cost, none."""
    gradient[1] -= parameters[3]
    return 0.0


@njit(error_model="numpy")
def start_hessian(x, t, parameters, hessian):
    """Nothing is curved at the start."""


@njit(error_model="numpy")
def end_hessian(x, t, parameters, hessian):
    """Nothing is curved at the end."""


def phase_durations(grid, unknowns):
    """There are no phases."""
    return np.zeros(0)


def with_pinned_values(grid, unknowns):
    """No unknown equals another one."""
    return unknowns


def variable_bounds(grid):
    """Nothing is bounded."""
    return np.full(grid.is_multiplier.size, -np.inf), np.full(grid.is_multiplier.size, np.inf)


def duration_of(grid, unknowns):
    """The length of the time interval."""
    return grid.steps * grid.h
