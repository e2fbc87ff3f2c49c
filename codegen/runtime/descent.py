"""What a Newton step promises: the slope of the cost along it, and whether it descends."""

from numba import njit


@njit(cache=True, error_model="numpy")
def measure_step(unknowns, gradient, step, is_multiplier):
    """Slope of the cost along a Newton step, and whether the step promises a descent.

    With W the Hessian as it was factored, A the Jacobian of the equations, d the primal and m the multipliers' part
    of the step, the step's own equations W d + A' m = -gradient and A d = -residual give d' W d and the derivative of
    the cost along d without another product with a matrix. The promise is the inertia-free test of Chiang and Zavala.
    A shift of the multipliers' diagonal, made only where A loses rank, adds an error of its own size.
    """
    slope, curvature, linear, square = 0.0, 0.0, 0.0, 0.0
    for i in range(step.size):
        if is_multiplier[i]:
            slope += gradient[i] * unknowns[i]
            curvature += gradient[i] * step[i]
            linear -= gradient[i] * (unknowns[i] + step[i])
        else:
            slope += gradient[i] * step[i]
            curvature -= gradient[i] * step[i]
            square += step[i] * step[i]
    return slope, curvature + max(linear, 0.0) >= 1e-10 * square
