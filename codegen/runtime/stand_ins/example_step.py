"""A hand-written stand-in for generated kernels: one step of the pendulum q'' = -sin q by the midpoint rule.

Momentum form, with q_k1 eliminated, so that p_k1 is the only unknown. Exists so that the files of this folder can be
imported and tested; never included anywhere.
"""

import numpy as np
from numba import njit

STATE, STAGES, UNKNOWNS, PARTS, RANGED = 2, 0, 1, 0, 0
ITERATED, CONSTANT, SYSTEM = 1, 0, 0
FRACTIONS = np.empty((0, 1))


@njit(cache=True, error_model="numpy")
def predict_step(state, t, h, parameters, unknowns):
    """Explicit Euler step of the momentum."""
    unknowns[0] = state[1] - h * np.sin(state[0])


@njit(cache=True, error_model="numpy")
def step_residual(unknowns, state, t, h, parameters, residual):
    """Residual p_k1 - p_k + h sin((q_k + q_k1)/2)."""
    residual[0] = unknowns[0] - state[1] + h * np.sin(state[0] + h / 4 * (state[1] + unknowns[0]))


@njit(cache=True, error_model="numpy")
def step_jacobian(unknowns, state, t, h, parameters, residual, jacobian):
    """Residual and its derivative by p_k1."""
    middle = state[0] + h / 4 * (state[1] + unknowns[0])
    residual[0] = unknowns[0] - state[1] + h * np.sin(middle)
    jacobian[0, 0] = 1 + h**2 / 4 * np.cos(middle)


@njit(cache=True, error_model="numpy")
def complete_step(unknowns, state, t, h, parameters, interval):
    """State at the right node."""
    interval[0] = state[0] + h / 2 * (state[1] + unknowns[0])
    interval[1] = unknowns[0]


@njit(cache=True, error_model="numpy")
def explicit_step(state, t, h, parameters, interval):
    """State at the right node by the symplectic Euler method, as an example of an explicit scheme."""
    momentum = state[1] - h * np.sin(state[0])
    interval[0] = state[0] + h * momentum
    interval[1] = momentum


@njit(cache=True, error_model="numpy")
def step_equations(state, interval, t, h, parameters, residual):
    """Both equations of the midpoint rule."""
    residual[0] = interval[0] - state[0] - h / 2 * (state[1] + interval[1])
    residual[1] = interval[1] - state[1] + h * np.sin((state[0] + interval[0]) / 2)


@njit(cache=True, error_model="numpy")
def energy(state, t, parameters):
    """Hamiltonian p^2/2 - cos q."""
    return state[1] ** 2 / 2 - np.cos(state[0])
