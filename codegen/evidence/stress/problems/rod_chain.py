"""Follow a chain of six pendulums on stiff elastic rods that falls from a horizontal start.

H = sum |p_i|^2/2 + y_i + k (|q_i - q_i-1| - 1)^2/2 with q_0 = 0: unit masses, lengths and gravity, stiffness k. Source:
Ascher and Reich, The midpoint scheme and variants for Hamiltonian systems: advantages and pitfalls, SIAM Journal on
Scientific Computing 21 (1999), for a single pendulum. All quantities are nondimensional.
"""

from sympy import sqrt

from codegen import Simulate, canonical_pairs, parameters


def problem() -> Simulate:
    numbers = range(1, 7)
    names = " ".join(f"x{i} y{i}" for i in numbers), " ".join(f"px{i} py{i}" for i in numbers)
    q, p = canonical_pairs(*names)
    (k,) = parameters(k=10000)
    x, y = q[::2], q[1::2]
    stretches = [sqrt(x[0] ** 2 + y[0] ** 2) - 1]
    stretches += [sqrt((x[i] - x[i - 1]) ** 2 + (y[i] - y[i - 1]) ** 2) - 1 for i in range(1, 6)]
    return Simulate(
        hamiltonian=sum(momentum**2 for momentum in p) / 2 + sum(y) + sum(s**2 for s in stretches) * k / 2,
        start={name: i // 2 + 1 if i % 2 == 0 else 0 for i, name in enumerate(q)} | dict.fromkeys(p, 0),
        duration=10,
        steps=20000,
    )
