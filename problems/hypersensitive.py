"""Follow a stable state in, stay at rest for almost all of the time, and leave along an unstable one.

x' = -x + u from x(0) = 3/2 to x(T) = 1; the cost is half the integral of x^2 + u^2. The motion decays and grows like
exp(-sqrt(2) t) at its two ends, however long T is. Source: Rao and Mease, Eigenvector approximate dichotomic basis
method for solving hyper-sensitive optimal control problems (2000); the linear form and its data are dymos's. All
quantities are nondimensional. Closed form, with a = x(0), b = x(T) and z = sqrt(2) T:

    J* = (sqrt(2) ((a^2 + b^2) coth(z) - 2 a b/sinh(z)) + b^2 - a^2)/2,    1.673093978 for T = 10
"""

from codegen import Control, control, parameters, states


def problem(duration: float = 10) -> Control:
    (x,) = states("x")
    u = control("u")
    T, a, b = parameters(T=duration, a=1.5, b=1)

    return Control(
        dynamics={x: -x + u},
        cost=(x**2 + u**2) / 2,
        duration=T,
        start={x: a},
        end={x: b},
        steps=100,
    )
