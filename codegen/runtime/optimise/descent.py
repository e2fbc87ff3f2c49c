"""What a Newton step promises: the slope of the cost along it."""

from numba import njit


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def slope_of(unknowns, gradient, step, is_multiplier):
    """Slope of the cost along the primal part of a Newton step.

    `gradient` is that of the Lagrangian, with the equations' residuals at the multipliers. With A the Jacobian of the
    equations and d the primal part, A d = -residual, so the multipliers' share of the Lagrangian has slope
    -multipliers . residual, which is taken away again.
    """
    slope = 0.0
    for i in range(step.size):
        slope += gradient[i] * (unknowns[i] if is_multiplier[i] else step[i])
    return slope
