"""What a Newton step promises: the slope of the cost along it; and whether it is one at all."""

from numba import njit

SINGULAR = 1e12  # times the right-hand side: a longer step is one of rounding


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def slope_of(unknowns, gradient, step, is_multiplier):
    """Slope of the cost along the primal part of a Newton step; whether it is so long that rounding made it.

    `gradient` is that of the Lagrangian, with the equations' residuals at the multipliers. With A the Jacobian of the
    equations and d the primal part, A d = -residual, so the multipliers' share of the Lagrangian has slope
    -multipliers . residual, which is taken away again.
    """
    slope = longest = right = 0.0
    for i in range(step.size):
        slope += gradient[i] * (unknowns[i] if is_multiplier[i] else step[i])
        longest, right = max(longest, abs(step[i])), max(right, abs(gradient[i]))
    return slope, longest > SINGULAR * right
