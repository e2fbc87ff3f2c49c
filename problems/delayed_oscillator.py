"""Calm an oscillator whose spring answers late.

m q''(t) = -k q(t - tau) + u(t), released at q = 1 after a rest there. Left alone, the late answer feeds the
oscillation, which grows. Over five delays the control minimises the integral of q^2 + w u^2. All quantities are
nondimensional.
"""

from codegen import Control, control, coordinate, parameters


def problem() -> Control:
    (q, dq), u = coordinate("q"), control("u")
    m, k, w, tau = parameters(m=1, k=1, w=0.1, tau=1)
    return Control(
        lagrangian=m * dq**2 / 2,
        force={q: -k * q.delayed(tau) + u},
        cost=q**2 + w * u**2,
        duration=5 * tau,
        history={q: 1},
        steps=100,
    )
