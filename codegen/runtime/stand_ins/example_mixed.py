"""A hand-written stand-in for derivatives by data of the pendulum's shares, its boundary values."""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example import EQUATIONS

QUANTITIES = ("start.q", "start.dq", "end.q", "end.dq")
DATA, PARAMETRIC, OWN_QUANTITIES, CLOCK = 6, 4, 4, 0
CURVED = MOVING = CLOCKED = 0
VARIATIONAL = EQUATIONS.size
ACTING = BOUNDING = MIXED_ROWS = MIXED_COLUMNS = np.zeros(0, np.int64)
START_MIXED_ROWS, START_MIXED_COLUMNS = np.array([1]), np.array([1])
END_MIXED_ROWS, END_MIXED_COLUMNS = np.array([1]), np.array([3])


@njit(error_model="numpy")
def interval_mixed(x, t, h, parameters, slopes, mixed):
    """No boundary value acts inside; the duration is not given."""


@njit(error_model="numpy")
def motion_mixed(x, t, h, parameters, slopes, mixed):
    """Nothing moves."""


@njit(error_model="numpy")
def sample_mixed(x, t, h, parameters, sample, slopes, mixed):
    """What is measured depends on no boundary value."""


@njit(error_model="numpy")
def start_mixed(x, t, parameters, slopes, mixed):
    """Those of lambda_0 v(0)."""
    slopes[1], mixed[0] = x[1], 1.0


@njit(error_model="numpy")
def end_mixed(x, t, parameters, slopes, mixed):
    """Those of -lambda_N v(T)."""
    slopes[3], mixed[0] = -x[1], -1.0


@njit(error_model="numpy")
def coupling_mixed(kind, values, parameters, slopes, mixed):
    """Nothing is coupled."""


def data_rates(grid, given):
    """Every boundary value by itself."""
    return np.eye(4)[:, None, :], np.zeros(4)


def pinned_rates(grid, rates):
    """The positions at both ends."""
    moves = np.zeros((len(rates), grid.is_multiplier.size))
    moves[:, 0], moves[:, -2] = rates[:, 0, 0], rates[:, 0, 2]
    return moves


def bound_rates(grid, rates):
    """No bound moves."""
    return np.zeros(grid.is_multiplier.size), np.zeros(grid.is_multiplier.size)


def duration_rates(grid, unknowns, vectors, rates, duration):
    """The duration is not given."""
    return duration[:, None]
