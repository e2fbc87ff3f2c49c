"""Keep the pole of a cart upright, as a controller does that solves this problem at every sampling time.

Cart (1 kg), pole (0.3 kg on a massless rod of 0.5 m) and the limit of 20 N are those of `cart_pole`, but the angle
counts from the upright position. From the present state on, over the next 2 s, the cart is to be at `place` with the
pole upright. `push` is a force on the bob along the rail, where it is known. Source of the data: Kelly, SIAM Review 59
(2017), appendix E.1; of the form of the cost: Rawlings, Mayne and Diehl, Model Predictive Control (2017), section 1.3.

With `plant=True` it is the system alone, for `codegen.close_loop`: u and push are numbers, and time is a sampling time.
"""

from sympy import cos

from codegen import Control, Simulate, control, coordinates, parameter, parameters


def problem(plant: bool = False) -> Control | Simulate:
    (x, theta), (dx, dtheta) = coordinates("x theta")
    u = parameter("u", 0) if plant else control("u")
    m1, m2, rod, g, T = parameters(m1=1, m2=0.3, rod=0.5, g=9.81, T=2)
    u_max, d_max, place, push = parameters(u_max=20, d_max=2, place=0, push=0)

    kinetic = (m1 + m2) / 2 * dx**2 + m2 * rod * cos(theta) * dx * dtheta + m2 * rod**2 / 2 * dtheta**2
    system = {
        "lagrangian": kinetic - m2 * g * rod * cos(theta),
        "force": {x: u + push, theta: push * rod * cos(theta)},
        "start": {x: 0, theta: 0.2, dx: 0, dtheta: 0},
    }
    if plant:
        return Simulate(**system, duration=T / 40, steps=10)
    away = (x - place) ** 2 + 10 * theta**2 + 0.1 * dx**2 + 0.1 * dtheta**2
    return Control(
        **system,
        cost=away + 0.001 * u**2,
        terminal_cost=away,
        duration=T,
        bounds={x: (-d_max, d_max), u: (-u_max, u_max)},
        steps=40,
    )
