"""Conditions at the ends, terminal costs, periodicity and coupled bodies, against closed forms by a dense assembly."""

from dataclasses import replace

import numpy as np
import pytest
import sympy
from dense_assembly import DenseProblem
from sympy import Rational, cos, pi, sin

from codegen import (
    Control,
    body_number,
    canonical_pair,
    control,
    controls,
    coordinate,
    coordinates,
    free_parameter,
    parameters,
    states,
    time,
)
from codegen.discretise.model.definitions import Condition
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.transcribe import transcribe
from codegen.errors import BoundaryError

METHODS = ("variational", "hamiltonian")


def solved(problem: Control, method=None, scheme="midpoint", steps=6):
    dense = DenseProblem(transcribe(normalise(problem), scheme, method), steps)
    z = dense.newton(dense.initial())
    assert dense.program_cost(z) == pytest.approx(dense.cost(z), rel=1e-10)
    return dense, z


def particle(**given) -> tuple[Control, sympy.Symbol, sympy.Symbol]:
    """A particle of mass two, from rest at zero; force u costs u^2/2 in unit time."""
    q, v = coordinate("q")
    u = control("u")
    ends = {key: make(q, v) for key, make in given.items()}
    return Control(lagrangian=v**2, force={q: u}, cost=u**2 / 2, duration=1, start={q: 0, v: 0}, **ends)


@pytest.mark.parametrize("method", METHODS)
def test_terminal_cost_of_position_and_velocity(method):
    """2 q'' = u is linear in (q(1), v(1)), so the discrete optimum is a quadratic problem in these two."""
    dense, z = solved(particle(terminal_cost=lambda q, v: 5 * (q - 1) ** 2 + 3 * (v - 2) ** 2), method)
    steps, h = 6, 1 / 6
    reach = np.array([[h * (1 - (k + 0.5) * h), h] for k in range(steps)]).T / 2
    gram = reach @ reach.T / h
    # min x.G^-1 x/2 + (x - a).W (x - a)/2 over x = (q, v) at the end, with u = R^T G^-1 x / h
    weight, target = np.diag([10.0, 6.0]), np.array([1.0, 2.0])
    inverse = np.linalg.inv(gram)
    x = np.linalg.solve(inverse + weight, weight @ target)
    expected = x @ inverse @ x / 2 + (x - target) @ weight @ (x - target) / 2
    assert dense.cost(z) == pytest.approx(expected, rel=1e-9)
    assert dense.at_nodes(z, "q")[-1] == pytest.approx(x[0], rel=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_end_conditions_on_position_and_velocity(method):
    """q(1) + v(1) = 1, one condition on two quantities: u is proportional to its influence on their sum."""
    dense, z = solved(particle(end_conditions=lambda q, v: [sympy.Eq(q + v, 1)]), method)
    influence = np.array([(1 - (k + 0.5) / 6 + 1) / 6 / 2 for k in range(6)])
    expected = 1 / (2 * np.sum(influence**2 * 6))
    assert dense.cost(z) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("level", "active"), [(1.0, True), (0.0, False)])
def test_end_inequality(method, level, active):
    problem = particle(
        end_conditions=lambda q, v: [v**2 <= 4, q >= level], terminal_cost=lambda q, v: (q - sympy.Rational(1, 2)) ** 2
    )
    program = transcribe(normalise(problem), "midpoint", method)
    assert len(program.end.slacks) == 1
    ((index, bound),) = program.end.bounds
    assert (program.node[index].name, float(bound.lower), bound.upper) == ("q", level, None)
    assert not program.start.slacks
    assert not program.start.bounds
    dense = DenseProblem(program, 5)
    result = dense.slsqp(dense.initial() + 0.1)
    assert result.success
    final = dense.at_nodes(result.z, "q")[-1]
    if active:
        assert final == pytest.approx(level, abs=1e-6)
    else:
        # Without the inequalities: gram of q(1) is 1/12 (1 - 1/(4 N^2)), J = x^2/(2 g) + (x - 1/2)^2.
        gram = (1 - 1 / 100) / 12
        assert final == pytest.approx(1 / (1 / gram + 2), abs=1e-6)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("conditions", "bounded"),
    [
        (lambda q, v, a: [2 * q >= a - 1], {"q": ("a/2 - 1/2", None)}),
        (lambda q, v, a: [v <= a, v >= -a], {"dq": ("-a", "a")}),  # one unknown between two limits, no slacks
        (lambda q, v, a: [sympy.Eq(q + v, a), q >= 0], {}),  # an equation may say what q is
        (lambda q, v, a: [q + v <= a, q**2 <= a, a * q <= 1], {}),
        (lambda q, v, a: [q <= a, q <= 3], {"q": (None, "a")}),  # either may be the tighter one
    ],
)
def test_inequalities_on_one_unknown_of_an_end_are_its_bounds(method, conditions, bounded):
    (a,) = parameters(a=2)
    program = transcribe(normalise(particle(end_conditions=lambda q, v: conditions(q, v, a))), "midpoint", method)
    found = {}
    for index, bound in program.end.bounds:
        least, greatest = found.get(program.node[index].name, (None, None))
        found[program.node[index].name] = bound.lower or least, bound.upper or greatest
    if method == "hamiltonian" and "dq" in bounded:  # of the momentum of a mass of two
        bounded = {"p_q": ("-2*a", "2*a")}
    assert {name: tuple(None if v is None else str(v) for v in pair) for name, pair in found.items()} == bounded


def test_conditions_at_both_ends_of_coupled_velocities():
    """A condition on one velocity brings in the other one, which the mass matrix couples to it."""
    (x, y), (dx, dy) = coordinates("x y")
    f, g = controls("f g")
    problem = Control(
        lagrangian=dx**2 + dx * dy + dy**2 - x**2 * y,
        force={x: f, y: g},
        cost=(f**2 + g**2) / 2,
        duration=1,
        start_conditions=[dx - 1, x, y],
        end_conditions=[dx + x, y - 1],
    )
    costs = []
    for method in METHODS:
        dense, z = solved(problem, method)
        costs.append(dense.cost(z))
        assert [len(end.conditions) for end in (dense.program.start, dense.program.end)] >= [3, 2]
    # The midpoint rule is the same discretisation on both sides.
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)


def test_an_end_condition_on_given_values_is_refused():
    model = normalise(particle(end=lambda q, v: {q: 1}))
    q = model.coordinates[0]
    with pytest.raises(BoundaryError, match="q - 1 = 0 at the end is on values that are given there"):
        transcribe(replace(model, end_conditions=(Condition("q - 1 = 0", q - 1),)))


@pytest.mark.parametrize(
    ("method", "scheme", "order"),
    [("variational", "midpoint", 2), ("variational", "rectangle", 2), ("hamiltonian", "stormer-verlet", 2)],
)
def test_periodic_motion_of_a_driven_oscillator(method, scheme, order):
    """q'' = -q + u tracks cos 2t: q = cos(2t)/10, u = -3 q, J = 9 pi/40 over one period pi."""
    q, v = coordinate("q")
    u, t = control("u"), time()
    problem = Control(
        lagrangian=v**2 / 2 - q**2 / 2,
        force={q: u},
        cost=((q - cos(2 * t)) ** 2 + u**2) / 2,
        duration=pi,
        periodic=[q, v],
    )
    errors = []
    for steps in (10, 20):
        dense, z = solved(problem, method, scheme, steps)
        nodes = dense.at_nodes(z, "q")
        assert nodes[0] == pytest.approx(nodes[-1], abs=1e-12)
        errors.append(abs(dense.cost(z) - 9 * np.pi / 40))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.2)
    names = [u.name for u in dense.program.linking.unknowns]
    assert names == (["periodic_q", "pi_q"] if method == "variational" else ["periodic_q", "periodic_p_q"])


def test_periodic_states_with_a_shift():
    """x' = u to x(1) = x(0) + 2 at least effort with a wish for x: u = 2, x(0) from the mean of the cost."""
    (x,) = states("x")
    u = control("u")
    problem = Control(dynamics={x: u}, cost=u**2 / 2 + (x - 5) ** 2 / 2, duration=1, periodic={x: 2})
    dense, z = solved(problem, steps=8)
    nodes = dense.at_nodes(z, "x")
    assert nodes[-1] - nodes[0] == pytest.approx(2)
    assert (nodes[0] + nodes[-1]) / 2 == pytest.approx(5)
    # By symmetry x - 5 = sinh(t - 1/2)/sinh(1/2) in continuous time, J = coth(1/2).
    assert dense.cost(z) == pytest.approx(1 / np.tanh(0.5), rel=1e-2)


@pytest.mark.parametrize("given", ["start", "end"])
def test_a_periodic_value_that_one_end_gives_holds_at_both(given):
    """The oscillator above with its phase fixed, which the optimum has anyway: q = 1/10 where the period begins."""
    q, v = coordinate("q")
    u, t = control("u"), time()
    phase = {given: {q: Rational(1, 10), v: 0}}
    cost = ((q - cos(2 * t)) ** 2 + u**2) / 2
    motion = {"lagrangian": v**2 / 2 - q**2 / 2, "force": {q: u}, "cost": cost, "duration": pi}
    dense, z = solved(Control(**motion, periodic=[q, v], **phase), steps=20)
    assert dense.at_nodes(z, "q")[[0, -1]] == pytest.approx([0.1, 0.1], abs=1e-12)
    assert dense.cost(z) == pytest.approx(9 * np.pi / 40, rel=2e-2)
    free = solved(Control(**motion, periodic={q: 0, v: 0}), steps=20)
    assert dense.cost(z) >= free[0].cost(free[1])


def test_a_shift_carries_the_value_at_one_end_to_the_other():
    (x,) = states("x")
    u = control("u")
    problem = Control(dynamics={x: u}, cost=u**2 / 2, duration=1, end={x: 5}, periodic={x: 2})
    dense, z = solved(problem, steps=4)
    assert dense.at_nodes(z, "x") == pytest.approx(np.linspace(3, 5, 5))


def test_periodic_velocity_with_a_shift_and_a_mass_that_varies():
    q, v = coordinate("q")
    u = control("u")
    problem = Control(
        lagrangian=(1 + q**2) * v**2 / 2, force={q: u}, cost=u**2 / 2, duration=1, start={q: 0}, end={q: 1},
        periodic={v: 0.5},
    )  # fmt: skip
    costs = []
    for method in METHODS:
        dense, z = solved(problem, method)
        costs.append(dense.cost(z))
        if method == "variational":
            speeds = dense.at_nodes(z, "dq")
            assert speeds[-1] - speeds[0] == pytest.approx(0.5)
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)


def test_periodic_momentum_of_a_hamiltonian():
    q, p = canonical_pair("q", "p")
    u = control("u")
    problem = Control(
        hamiltonian=p**2 / 2 + cos(q), force={q: u}, cost=u**2 / 2, duration=2, periodic={q: 2 * pi, p: 0.25},
        start_conditions=[q],
    )  # fmt: skip
    costs = []
    for method in METHODS:
        dense, z = solved(problem, method, steps=10)
        costs.append(dense.cost(z))
        assert dense.at_nodes(z, "q")[-1] == pytest.approx(2 * np.pi)
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_two_bodies_meet_halfway(method):
    """From 0 and 1 at rest to rest at a distance of 3: each moves by two, J = 2 * 6 * 4/(1 - 1/N^2)."""
    q, v = coordinate("q")
    u, body = control("u"), body_number()
    problem = Control(
        lagrangian=v**2 / 2, force={q: u}, cost=u**2 / 2, duration=1, bodies=2, start={q: body, v: 0}, end={v: 0},
        end_conditions=[q.of(0) - q.of(1) - 3],
    )  # fmt: skip
    dense, z = solved(problem, method)
    program = dense.program
    assert (program.model.bodies, program.linking.own, len(program.linking.couplings)) == (2, 1, 1)
    assert [(s.name, b, j) for s, b, j in program.linking.coupling_symbols] == [("q_0", 0, 0), ("q_1", 1, 0)]
    assert dense.cost(z) == pytest.approx(48 / (1 - 1 / 36), rel=1e-9)
    assert [dense.at_nodes(z, "q", j)[-1] for j in (0, 1)] == pytest.approx([2.0, -1.0])


def test_triangle_with_a_redundant_coupling_and_a_free_side():
    """Three particles end as an equilateral triangle around the origin whose side is optimised along."""
    (x, y), (dx, dy) = coordinates("x y")
    f, g = controls("f g")
    body, side = body_number(), free_parameter("side", 2.0, lower=0.1)
    angle = 2 * pi * body / 3

    def distance(i, j):
        return (x.of(i) - x.of(j)) ** 2 + (y.of(i) - y.of(j)) ** 2

    centre = [x.of(0) + x.of(1) + x.of(2), y.of(0) + y.of(1) + y.of(2)]
    problem = Control(
        lagrangian=(dx**2 + dy**2) / 2, force={x: f, y: g}, cost=(f**2 + g**2) / 2, duration=1, bodies=3,
        start={x: cos(angle), y: sin(angle), dx: 0, dy: 0}, end={dx: 0, dy: 0},
        terminal_cost=sympy.Rational(1, 3) * 6 * (side / sympy.sqrt(3) - 2) ** 2,
        guess={x: cos(angle) * 1.1, y: sin(angle) * 1.1},
        end_conditions=[
            *(sympy.Eq(distance(i, j), side**2) for i, j in ((0, 1), (1, 2), (2, 0))), *centre,
            sympy.Eq(y.of(0), 0), centre[0] + centre[1],
        ],
    )  # fmt: skip
    program = transcribe(normalise(problem))
    assert len(program.linking.couplings) == 6, "the last one follows from two others"
    dense = DenseProblem(program, 2)
    z = dense.newton(dense.initial())
    # Each body moves outward by d: 3 * 6 d^2/(1 - 1/N^2) + 6 (1 + d - 2)^2 with N = 2, least at d = 1/5.
    assert dense.shared_value(z, "side") == pytest.approx(1.2 * np.sqrt(3), rel=1e-9)
    assert dense.cost(z) == pytest.approx(24 * 0.04 + 6 * 0.64, rel=1e-9)


def test_a_coupled_coordinate_that_is_periodic():
    """Two bodies, each periodic in x with shift 1, and one end value tied: both starts follow."""
    (x,) = states("x")
    u, body = control("u"), body_number()
    (w,) = parameters(w=3)
    problem = Control(
        dynamics={x: u}, cost=u**2 / 2 + w * x**2 / 2, duration=1,
        bodies=2, periodic={x: 1}, end_conditions=[x.of(0) - x.of(1) - 2], guess={x: body},
    )  # fmt: skip
    dense, z = solved(problem, steps=4)
    assert dense.program.linking.own == 1
    ends = [dense.at_nodes(z, "x", j) for j in (0, 1)]
    assert ends[0][-1] - ends[1][-1] == pytest.approx(2)
    assert [e[-1] - e[0] for e in ends] == pytest.approx([1, 1])


@pytest.mark.parametrize("method", METHODS)
def test_periodic_velocity_on_which_the_terminal_cost_depends(method):
    """q'' = u with q and v periodic and (v(1) - 1)^2 at the end: a detour back pays for speed."""
    q, v = coordinate("q")
    u = control("u")
    problem = Control(
        lagrangian=v**2 / 2, force={q: u}, cost=u**2 / 2, terminal_cost=(v - 1) ** 2, duration=1, start_conditions=[q],
        periodic=[q, v],
    )  # fmt: skip
    dense, z = solved(problem, method)
    # With speed w at the ends q returns when sum h u (1 - t) = -w: J = 6 w^2/(1 - 1/N^2) + (w - 1)^2.
    c = 6 / (1 - 1 / 36)
    assert dense.cost(z) == pytest.approx(c / (1 + c), rel=1e-9)


def test_shared_unknowns_keep_the_bounds_of_what_equals_them():
    (x,) = states("x")
    u = control("u")
    (top,) = parameters(top=3)
    model = normalise(
        Control(dynamics={x: u}, cost=u**2 + (x - 9) ** 2, duration=1, periodic={x: 1}, bounds={x: (0, top)})
    )
    program = transcribe(model)
    (start,) = program.linking.unknowns
    # x(0) lies in [0, top], and so does x(0) + 1.
    assert (start.lower, start.upper) == (0, sympy.Symbol("top", real=True) - 1)
    dense = DenseProblem(program, 4)
    nodes = dense.at_nodes(dense.slsqp(dense.initial()).z, "x")
    assert [nodes[0], nodes[-1]] == pytest.approx([2, 3], abs=1e-6)
