"""Let point vortices move each other in a plane fluid at rest at infinity.

Vortex i of circulation G_i at (x_i, y_i) moves with the velocity of the flow that all others make. The Lagrangian
sum_i G_i (y_i dx_i - x_i dy_i)/2 - H is linear in the velocities, with the energy H of the flow, so that places alone
are the state. Energy, both components of the impulse, sum_i G_i (x_i, y_i), and the angular impulse,
sum_i G_i (x_i^2 + y_i^2), are conserved. `four` are two pairs of opposite circulations, which leapfrog: the pair
behind narrows, passes through the pair ahead, and widens. `two` vortices of equal sign turn about their centre of
circulation with the period 4 pi^2 d^2/(G_1 + G_2) for the distance d. Source: Aref (2007), Point vortex dynamics: A
classical mathematics playground, Journal of Mathematical Physics 48, 065401; Love (1894), On the motion of paired
vortices with a common axis, Proceedings of the London Mathematical Society 25.
"""

from itertools import combinations
from typing import Literal

from sympy import Expr, log, pi

from codegen import Simulate, coordinates, parameters
from codegen.drawing import Mass, Trail


def problem(vortices: Literal["four", "two"] = "four") -> Simulate:
    if vortices == "two":
        (x1, y1, x2, y2), rates = coordinates("x1 y1 x2 y2")
        G1, G2 = parameters(G1=1, G2=2)
        strengths, places, duration = [G1, G2], [(x1, y1), (x2, y2)], 4 * pi**2 / (G1 + G2)
        start = {x1: 0, y1: 0, x2: 1, y2: 0}
    else:
        (x1, y1, x2, y2, x3, y3, x4, y4), rates = coordinates("x1 y1 x2 y2 x3 y3 x4 y4")
        (G,) = parameters(G=1)
        strengths, places, duration = [G, G, -G, -G], [(x1, y1), (x2, y2), (x3, y3), (x4, y4)], 40
        start = {x1: 0, y1: 1, x2: 0, y2: 0.4, x3: 0, y3: -0.4, x4: 0, y4: -1}
    theta: Expr = sum(
        G * (y * dx - x * dy) / 2 for G, (x, y), dx, dy in zip(strengths, places, rates[::2], rates[1::2], strict=True)
    )
    energy: Expr = -sum(
        G * K * log((x - a) ** 2 + (y - b) ** 2) / (4 * pi)
        for (G, (x, y)), (K, (a, b)) in combinations(zip(strengths, places, strict=True), 2)
    )
    return Simulate(
        lagrangian=theta - energy,
        duration=duration,
        start=start,
        steps=1000,
        drawing=[*map(Trail, places), *(Mass(place, 0.08) for place in places)],
    )
