"""Minimal problems on which a solver may give up too soon: values forced onto bounds, saddle points, rounding."""

from math import asin
from math import sin as sine

import pytest
from interpreted import of_problem
from scipy.optimize import brentq
from sympy import Eq, cos, exp, pi, sin, sqrt, tan, tanh

from codegen import Control, Phases, control, controls, coordinates, free_parameter, states

HILL = 8.33032459938
"""IPOPT 3.14 from y = sin(pi t), at a tolerance of 1e-10, on the program of `around_a_hill`."""


def going_nowhere():
    """With x from 0 to 0 and v >= 0, all speeds are zero: the equations leave no room inside the bound."""
    x, v = states("x v")
    u = control("u")
    return Control(
        dynamics={x: v, v: u}, cost=(u - 1) ** 2, duration=1, start={x: 0}, end={x: 0}, bounds={v: (0, None)}, steps=10
    )


def test_states_that_equations_force_onto_their_bound():
    """The cost is the integral of (0 - 1)^2."""
    solution = of_problem(going_nowhere()).solve()
    assert solution.status == "solved"
    assert solution.cost == pytest.approx(1.0, abs=1e-9)
    assert (solution.q[:, 1] >= 0.0).all()


def flying_robot():
    """Problem 10.43 of Betts (2010), whose robot starts on the limit |x| <= 10 and cannot leave it at once."""
    x, y, a, p, q, w = states("x y a p q w")
    u1, u2, u3, u4 = controls("u1 u2 u3 u4")
    left, right = u1 - u2, u3 - u4
    rest = {p: 0, q: 0, w: 0}
    return Control(
        dynamics={x: p, y: q, a: w, p: (left + right) * cos(a), q: (left + right) * sin(a), w: (left - right) / 5},
        cost=u1 + u2 + u3 + u4,
        duration=12,
        start={x: -10, y: -10, a: pi / 2, **rest},
        end={x: 0, y: 0, a: 0, **rest},
        bounds={
            **dict.fromkeys((u1, u2, u3, u4), (0, None)),
            **dict.fromkeys((x, y), (-10, 10)),
            **dict.fromkeys((p, q), (-2, 2)),
            a: (-pi, pi),
            w: (-1, 1),
        },
        path=[u1 + u2 <= 1, u3 + u4 <= 1],
        steps=40,
    )


def test_start_on_a_bound_ends_at_rounding():
    """IPOPT 3.14 finds 7.9486121696 on the same program, with bounds relaxed by 1e-8; the gap must reach 1e-9."""
    solution = of_problem(flying_robot()).solve()
    assert solution.status == "solved"
    assert solution.cost == pytest.approx(7.9486121696, abs=1e-6)
    assert solution.residual <= 1e-10
    assert solution.iterations <= 60


def around_a_hill(bounded):
    """Straight over the hill is stationary by symmetry, and costs 10.74."""
    x, y = states("x y")
    u, w = controls("u w")
    cost = u**2 + w**2 + 20 * exp(-4 * (x**2 + y**2))
    ends = {"start": {x: -1, y: 0}, "end": {x: 1, y: 0}}
    bounds = {u: (-9, 9)} if bounded else {}
    return Control(dynamics={x: u, y: w}, cost=cost, duration=1, steps=20, bounds=bounds, **ends)


@pytest.mark.parametrize("bounded", [False, True])
def test_saddle_point_is_left(bounded):
    """IPOPT 3.14 from the straight line ends on the hill as well."""
    solution = of_problem(around_a_hill(bounded)).solve()
    assert solution.status == "solved"
    assert solution.cost == pytest.approx(HILL, rel=1e-8)


TURN = 0.6
"""The largest steering angle of a car whose axles are one unit of length apart."""


def parked_sideways():
    """Linearised at the guess, where the car is at rest and looks along x, nothing changes y: 0 = 1."""
    x, y, theta = states("x y theta")
    v, delta = controls("v delta")
    T = free_parameter("T", 4)
    return Control(
        dynamics={x: v * cos(theta), y: v * sin(theta), theta: v * tan(delta)},
        terminal_cost=T,
        duration=T,
        start={x: 0, y: 0, theta: 0},
        end={x: 0, y: 1, theta: 0},
        bounds={v: (-1, 1), delta: (-TURN, TURN)},
        steps=40,
    )


def test_equations_that_contradict_each_other_at_the_guess():
    """The least time is that of four arcs (Reeds and Shepp, 1990), which switch at nodes here; IPOPT takes 3000."""
    radius = 1 / float(tan(TURN))

    def way_to_the_side(angle):
        first = asin(sine(angle) / 2)  # x is what it was
        return 2 * radius * (2 * float(cos(first)) - 1 - float(cos(angle)))

    exact = 2 * radius * brentq(lambda angle: way_to_the_side(angle) - 1, 0.5, 1.5)
    solution = of_problem(parked_sideways()).solve()
    assert solution.status == "solved"
    assert exact <= solution.cost <= 1.02 * exact
    assert solution.iterations <= 200


def swing_up_with_friction():
    """A cart-pole whose bearings have Coulomb friction, smooth within a hundredth of a metre per second."""
    (x, theta), (v, w) = coordinates("x theta")
    u = control("u")
    kinetic = 1.3 * v**2 / 2 + 0.15 * v * w * cos(theta) + 0.075 * w**2 / 2
    return Control(
        lagrangian=kinetic + 0.15 * 9.81 * cos(theta),
        force={x: u - 0.8 * tanh(v / 0.01), theta: -0.02 * tanh(w / 0.01)},
        cost=u**2,
        duration=2,
        start={x: 0, theta: 0, v: 0, w: 0},
        end={x: 1, theta: pi, v: 0, w: 0},
        bounds={u: (-20, 20), x: (-2, 2)},
        steps=20,
    )


def hopper():
    """A runner on a spring of 20 kN/m: flight, stance with a force along the leg, and flight to the next apex."""
    (x, y), (dx, dy) = coordinates("x y")
    force = control("F")
    times = [free_parameter(f"T{i}", 0.3, lower=0.05, upper=1) for i in (1, 2, 3)]
    mass, stiffness, foot = 80, 20000, 0.7
    leg = sqrt((x - foot) ** 2 + y**2)
    ballistic = mass / 2 * (dx**2 + dy**2) - mass * 9.81 * y
    touches = Eq((x - foot) ** 2 + y**2, 1)
    return Phases(
        Control(
            lagrangian=ballistic,
            duration=times[0],
            start={x: 0, y: 1.1, dx: 2, dy: 0},
            end_conditions=[touches],
            steps=10,
        ),
        Control(
            lagrangian=ballistic - stiffness / 2 * (leg - 1) ** 2,
            force={x: force * (x - foot) / leg, y: force * y / leg},
            cost=1e-6 * force**2,
            duration=times[1],
            bounds={force: (-1000, 1000)},
            end_conditions=[touches, dy >= 0.1],
            steps=10,
        ),
        Control(lagrangian=ballistic, duration=times[2], end={x: 1.4, y: 1.1, dx: 2, dy: 0}, steps=10),
    )


IN_CYCLES = [(swing_up_with_friction, 72.39460461959129, 32), (hopper, 0.11495889247830338, 14)]
"""Problems whose steps might go round in circles; cost and iterations of IPOPT 3.14 on the same program."""


@pytest.mark.parametrize(("problem", "cost", "iterations"), IN_CYCLES)
def test_steps_do_not_go_round_in_circles(problem, cost, iterations):
    solution = of_problem(problem()).solve()
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(cost, rel=1e-9)
    assert solution.iterations <= 2 * iterations


def test_a_search_without_progress_makes_way_for_another():
    """The straight guess leads through the middle of a disc; one search creeps for ever where the cost is 2070."""
    (x, y), (vx, vy) = coordinates("x y")
    ux, uy = controls("ux uy")
    ends = {"start": {x: 0, y: 0, vx: 0, vy: 0}, "end": {x: 1, y: 0, vx: 0, vy: 0}}
    around = [(x - 0.5) ** 2 + y**2 >= 0.04]
    kinetic = (vx**2 + vy**2) / 2
    problem = Control(
        lagrangian=kinetic, force={x: ux, y: uy}, cost=ux**2 + uy**2, duration=2, path=around, steps=40, **ends
    )
    solution = of_problem(problem).solve()
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(2.46334386, rel=1e-8)  # as with bounds of the forces
    assert solution.iterations < 1000
