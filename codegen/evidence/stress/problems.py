"""The problems of the stress cases: stiff and chaotic motions, orbits, optimal controls, and particles.

All quantities are nondimensional, but for `transfer`, whose parameters may be in any system of units. HLW is Hairer,
Lubich and Wanner (2006), Geometric numerical integration. HW is Hairer and Wanner (1996), Solving ordinary differential
equations II. Ascher and Reich is The midpoint scheme and variants for Hamiltonian systems: advantages and pitfalls,
SIAM Journal on Scientific Computing 21 (1999).
"""

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from sympy import Matrix, Rational, cos, hessian, lambdify, log, pi, sin, sqrt

from codegen import (
    Connect,
    Control,
    Pairwise,
    Simulate,
    canonical_pair,
    canonical_pairs,
    control,
    coordinate,
    coordinates,
    parameters,
    particles,
    states,
    time,
)
from codegen.problem.description import quantities_in
from codegen.problem.symbols import Coordinate, Parameter


def problem(system: str = "oscillator") -> Simulate | Control | Connect:
    """Return the problem with this name."""
    return PROBLEMS[system]()


def oscillator() -> Simulate:
    """Follow a harmonic oscillator, whose discrete motion by any scheme has a closed form.

    H = (p^2 + omega^2 q^2)/2. Source: HLW, I.5.2 and XIII.1.
    """
    q, p = canonical_pair("q", "p")
    (omega,) = parameters(omega=1)
    return Simulate(hamiltonian=(p**2 + omega**2 * q**2) / 2, start={q: 1, p: 0}, duration=10, steps=100)


def spring_pendulum() -> Simulate:
    """Follow a mass that swings on a stiff spring.

    H = |p|^2/2 + k (|q| - 1)^2/2 + y: unit mass, natural length and gravity, stiffness k. Source: Ascher and Reich.
    """
    (x, y), (px, py) = canonical_pairs("x y", "px py")
    (k,) = parameters(k=10000)
    stretch = sqrt(x**2 + y**2) - 1
    return Simulate(
        hamiltonian=(px**2 + py**2) / 2 + k * stretch**2 / 2 + y,
        start={x: 1, y: 0, px: 0, py: 0},
        duration=10,
        steps=1000,
    )


def fput() -> Simulate:
    """Follow a chain of masses with alternating stiff and soft springs (Fermi, Pasta, Ulam and Tsingou).

    Six masses between two walls: the springs inside three pairs are harmonic with frequency omega, the springs between
    pairs and to the walls are quartic. Source: HLW, I.5.1.
    """
    numbers = range(1, 7)
    q, p = canonical_pairs(" ".join(f"q{i}" for i in numbers), " ".join(f"p{i}" for i in numbers))
    (omega,) = parameters(omega=50)
    stiff = sum((q[i + 1] - q[i]) ** 2 for i in (0, 2, 4)) * omega**2 / 4
    soft = q[0] ** 4 + sum((q[i + 1] - q[i]) ** 4 for i in (1, 3)) + q[5] ** 4
    # The first pair is stretched about its centre and moves apart, as in the first figure of the source.
    return Simulate(
        hamiltonian=sum(momentum**2 for momentum in p) / 2 + stiff + soft,
        start=dict.fromkeys((*q, *p), 0) | {q[0]: 0.7, q[1]: 0.72, p[1]: 1.4},
        duration=1,
        steps=1000,
    )


def kepler() -> Simulate:
    """Follow a body on a Kepler ellipse of unit semi-major axis, from its farthest point.

    H = |p|^2/2 - mu/|q|. Source: HLW, I.2.1.
    """
    (x, y), (px, py) = canonical_pairs("x y", "px py")
    (mu,) = parameters(mu=1)
    e = Rational(1, 2)
    return Simulate(
        hamiltonian=(px**2 + py**2) / 2 - mu / sqrt(x**2 + y**2),
        start={x: 1 + e, y: 0, px: 0, py: sqrt((1 - e) / (1 + e))},
        duration=10,
        steps=1000,
    )


def pendulum_chain() -> Simulate:
    """Follow a double pendulum that falls from a horizontal start.

    Point masses `heavy` and `light` on massless rods of unit length, absolute angles, 0 when hanging. Source:
    Goldstein, Poole and Safko, Classical Mechanics (2002), chapter 1, exercises.
    """
    angles, rates = coordinates("q1 q2")
    heavy, light, g = parameters(heavy=1, light=1, g=1)
    lagrangian, height, forward, upward = 0, 0, 0, 0
    for mass, angle, rate in zip((heavy, light), angles, rates, strict=True):
        height -= cos(angle)
        forward += cos(angle) * rate
        upward += sin(angle) * rate
        lagrangian += mass * (forward**2 + upward**2) / 2 - mass * g * height
    return Simulate(
        lagrangian=lagrangian,
        start=dict.fromkeys(angles, pi / 2) | dict.fromkeys(rates, 0),
        duration=10,
        steps=1000,
    )


def rod_chain() -> Simulate:
    """Follow a chain of six pendulums on stiff elastic rods that falls from a horizontal start.

    H = sum |p_i|^2/2 + y_i + k (|q_i - q_i-1| - 1)^2/2 with q_0 = 0: unit masses, lengths and gravity, stiffness k.
    Source: Ascher and Reich, for a single pendulum.
    """
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


def prothero_robinson() -> Simulate:
    """Follow a slow motion with a fast decay towards it: the damping and the order reduction of schemes.

    y' = rate (y - cos t) - sin t, whose solution from y(0) = 1 is cos t. Source: Prothero and Robinson, On the
    stability and accuracy of one-step methods for solving stiff systems, Mathematics of Computation 28 (1974).
    """
    (y,) = states("y")
    t = time()
    (rate,) = parameters(rate=-1e6)
    return Simulate(dynamics={y: rate * (y - cos(t)) - sin(t)}, start={y: 1}, duration=1, steps=20)


def robertson() -> Simulate:
    """Follow three reactions with rates from 0.04 to 3e7.

    Source: HW, IV.1 (Robertson 1966).
    """
    x, y, z = states("x y z")
    slow, fast, back = 0.04 * x, 3e7 * y**2, 1e4 * y * z
    dynamics = {x: back - slow, y: slow - back - fast, z: fast}
    return Simulate(dynamics=dynamics, start={x: 1, y: 0, z: 0}, duration=40, steps=400)


def van_der_pol() -> Simulate:
    """Follow van der Pol's oscillator along its slow part, with a decay mu times as fast.

    y'' = mu ((1 - y^2) y' - y). Source: HW, IV.1.
    """
    y, v = states("y v")
    (mu,) = parameters(mu=1000)
    return Simulate(dynamics={y: v, v: mu * ((1 - y**2) * v - y)}, start={y: 2, v: 0}, duration=0.5, steps=100)


def hires() -> Simulate:
    """Follow eight reactions of plants to light.

    Source: HW, IV.10 (Schaefer 1975).
    """
    y = states("y1 y2 y3 y4 y5 y6 y7 y8")
    bound = 280 * y[5] * y[7]
    rates = (
        -1.71 * y[0] + 0.43 * y[1] + 8.32 * y[2] + 0.0007,
        1.71 * y[0] - 8.75 * y[1],
        -10.03 * y[2] + 0.43 * y[3] + 0.035 * y[4],
        8.32 * y[1] + 1.71 * y[2] - 1.12 * y[3],
        -1.745 * y[4] + 0.43 * y[5] + 0.43 * y[6],
        -bound + 0.69 * y[3] + 1.71 * y[4] - 0.43 * y[5] + 0.69 * y[6],
        bound - 1.81 * y[6],
        1.81 * y[6] - bound,
    )
    start = dict(zip(y, (1, 0, 0, 0, 0, 0, 0, 0.0057), strict=True))
    return Simulate(dynamics=dict(zip(y, rates, strict=True)), start=start, duration=321.8122, steps=2000)


def actuator() -> Simulate:
    """Drive a mass on a spring by an actuator with a tiny time constant.

    x'' = a - x, lag a' = 1 - a, from rest. The problem is linear: its exact motion is a matrix exponential.
    """
    x, v, a = states("x v a")
    (lag,) = parameters(lag=1e-9)
    return Simulate(dynamics={x: v, v: a - x, a: (1 - a) / lag}, start={x: 0, v: 0, a: 0}, duration=10, steps=200)


def contact() -> Simulate:
    """Drop a unit mass onto a stiff spring with a damper, which act only below the ground.

    x'' = stiffness d(x) - damping d(x)/(d(x) + width) x' - 1 with the depth d(x) = (sqrt(x^2 + width^2) - x)/2.
    """
    x, v = states("x v")
    stiffness, damping, width = parameters(stiffness=1e6, damping=1e3, width=1e-4)
    depth = (sqrt(x**2 + width**2) - x) / 2
    force = stiffness * depth - damping * depth / (depth + width) * v
    return Simulate(dynamics={x: v, v: force - 1}, start={x: 0.1, v: 0}, duration=1, steps=4000)


def linear_regulator() -> Control:
    """Steer a decaying scalar state between two values; the cost of state and control leads to boundary layers.

    x' = -a x + u from `begin` to `goal`, cost (x^2 + eps^2 u^2)/2. With a = 0 the state is far from zero only in layers
    of width eps at the two ends; with a = eps = 1 and a long duration the problem is hypersensitive. Source: Rao and
    Mease, Eigenvector approximate dichotomic basis method for solving hyper-sensitive optimal control problems (2000).
    """
    (x,) = states("x")
    u = control("u")
    a, eps, T, begin, goal = parameters(a=1, eps=1, T=10, begin=1.5, goal=1)
    return Control(
        dynamics={x: -a * x + u},
        cost=(x**2 + eps**2 * u**2) / 2,
        duration=T,
        start={x: begin},
        end={x: goal},
        steps=100,
    )


def cubic_regulator() -> Control:
    """Steer a cubic system between two given states in a long time, most of which it spends near rest.

    x' = -x^3 + u from 1 to 3/2, cost x^2 + u^2. Source: Betts, Practical Methods for Optimal Control (2010), example
    10.7.
    """
    (x,) = states("x")
    u = control("u")
    T, begin, goal = parameters(T=10, begin=1, goal=1.5)
    return Control(
        dynamics={x: -(x**3) + u},
        cost=x**2 + u**2,
        duration=T,
        start={x: begin},
        end={x: goal},
        guess={x: 0},
        steps=100,
    )


def transfer() -> Control:
    """Raise a satellite from one circular orbit to another in `turns` mean revolutions by tangential thrust.

    Mass m, gravitational parameter GM, radii r0 and r1; the cost is the integral of the squared thrust. The parameters
    may be in any system of units: the solution in other units is known. Source: Junge, Marsden and Ober-Bloebaum,
    Discrete mechanics and optimal control (2005).
    """
    (r, phi), (dr, dphi) = coordinates("r phi")
    u = control("u")
    m, GM, r0, r1, turns = parameters(m=1, GM=1, r0=1, r1=1.2, turns=1)
    return Control(
        lagrangian=m / 2 * (dr**2 + r**2 * dphi**2) + GM * m / r,
        force={phi: r * u},
        cost=u**2,
        duration=pi * turns * (sqrt(r0**3 / GM) + sqrt(r1**3 / GM)),
        start={r: r0, phi: 0, dr: 0, dphi: sqrt(GM / r0**3)},
        end={r: r1, phi: 2 * pi * turns, dr: 0, dphi: sqrt(GM / r1**3)},
        steps=50,
    )


def arm() -> Control:
    """Swing a pendulum by a torque from rest at one angle to rest at another in a given time.

    Unit mass and length, gravity g; the cost is the integral of the squared torque. Large turns pass through the
    upright position. If both angles are the same equilibrium, no torque is needed.
    """
    q, dq = coordinate("q")
    u = control("u")
    g, T, begin, goal = parameters(g=1, T=1, begin=0, goal=1)
    return Control(
        lagrangian=dq**2 / 2 + g * cos(q),
        force={q: u},
        cost=u**2,
        duration=T,
        start={q: begin, dq: 0},
        end={q: goal, dq: 0},
        steps=50,
    )


def walled_cart() -> Control:
    """Return a cart to its start with the least effort, without passing a wall.

    A unit mass starts at 0 with velocity 1 and must return to 0 with velocity -1 after one unit of time. Source:
    Bryson, Denham and Dreyfus, Optimal programming problems with inequality constraints I, AIAA Journal 1 (1963). The
    least cost, half the integral of the squared force, is 4/(9 wall) for walls nearer than 1/6.
    """
    x, dx = coordinate("x")
    f = control("f")
    wall, T = parameters(wall=1 / 9, T=1)
    return Control(
        lagrangian=dx**2 / 2,
        force={x: f},
        cost=f**2 / 2,
        duration=T,
        start={x: 0, dx: 1},
        end={x: 0, dx: -1},
        bounds={x: (None, wall)},
        steps=60,
    )


def gravity() -> Simulate:
    """Follow two bodies that attract each other, written as particles with pairwise interaction.

    H = sum |p|^2/(2 m) - sum G m_i m_j/r. Source: HLW, I.2.
    """
    i, j = particles("x y", "px py", "m")
    (G,) = parameters(G=1)
    (m,), (m_j,) = i.own, j.own
    distance = sqrt(sum((a - b) ** 2 for a, b in zip(i.q, j.q, strict=True)))
    return Simulate(
        hamiltonian=Pairwise((i, j), self_term=sum(p**2 for p in i.p) / (2 * m), pair_term=-G * m * m_j / distance),
        start={i.q[0]: [0, 1], i.q[1]: [0, 0], i.p[0]: [0, 0], i.p[1]: [-0.001, 0.001], m: [1, 0.001]},
        duration=10,
        steps=1000,
    )


def landmarks() -> Connect:
    """Move landmarks in the unit disc to their targets along a geodesic, with the clamped plate's Green's function.

    H = 1/2 sum_ij p_i . p_j G(q_i, q_j). Source: Mills and Marsland, Interpolating diffeomorphisms and landmark
    registration (2005); Boggio (1905) for G.
    """
    i, j = particles("x y", "px py")
    a, b = (1 - sum(x**2 for x in k.q) for k in (i, j))
    s = sum((x - y) ** 2 for x, y in zip(i.q, j.q, strict=True))
    green = a * b / 2 - s / 2 * log(1 + a * b / s)
    return Connect(
        hamiltonian=Pairwise((i, j), pair_term=sum(x * y for x, y in zip(i.p, j.p, strict=True)) * green, domain=[a]),
        points=Path(__file__).with_name("two_landmarks.csv"),
        steps=10,
    )


PROBLEMS = {
    function.__name__: function
    for function in (
        oscillator, spring_pendulum, fput, kepler, pendulum_chain, rod_chain, prothero_robinson, robertson,
        van_der_pol, hires, actuator, contact, linear_regulator, cubic_regulator, transfer, arm, walled_cart,
        gravity, landmarks
    )
}  # fmt: skip


# ---- Equations of motion ----


@cache
def defaults(name: str) -> Mapping[str, float]:
    """Return the parameters of a problem by name; none for the name of a problem of another file."""
    known = quantities_in(PROBLEMS[name]()) if name in PROBLEMS else ()
    return {symbol.name: float(symbol.value) for symbol in known if isinstance(symbol, Parameter)}


@cache
def field_of(name: str) -> Callable[[Mapping[str, Any], Any], Any]:
    """Return the rates of a problem as a function of its parameters and the state, in any floating type of numpy.

    The state is x of first-order dynamics, (q, p) of a Hamiltonian, or (q, v) of a Lagrangian.
    """
    written = PROBLEMS[name]()
    if written.dynamics is not None:
        symbols, rates = list(written.dynamics), list(written.dynamics.values())
    else:
        q = [symbol for symbol in quantities_in(written) if isinstance(symbol, Coordinate)]
        moving = [x.partner for x in q]
        symbols, H, L = [*q, *moving], written.hamiltonian, written.lagrangian
        if H is not None:
            rates = [*(H.diff(p) for p in moving), *(-H.diff(x) for x in q)]
        else:  # L_vv v' = L_q - L_vq v
            bends = Matrix([L.diff(v) for v in moving]).jacobian(q) * Matrix(moving)
            rates = [*moving, *hessian(L, moving).LUsolve(Matrix([L.diff(x) for x in q]) - bends)]
    constants = [symbol for symbol in quantities_in(written) if isinstance(symbol, Parameter)]
    function = lambdify([constants, symbols], rates, "numpy", cse=True)
    return lambda values, state: np.array(function([values[p.name] for p in constants], state))
