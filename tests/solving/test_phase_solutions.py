"""Problems of several phases by generated solvers, uncompiled, against closed forms and independent programs."""

from __future__ import annotations

import types

import numpy as np
import pytest
from interpreted import of_problem
from phases_reference import Variables, least, midpoint_steps
from sympy import cos, sin

from codegen import (
    Control,
    Phases,
    canonical_pair,
    control,
    controls,
    coordinate,
    free_parameter,
    parameters,
    states,
    time,
)
from codegen.runtime.search import point
from codegen.show.figures.quantities import inequalities
from codegen.solving import api


def split(given: dict, duration: float, steps: int) -> tuple[Control, Phases]:
    """A problem on one time interval, and the same problem as three phases with equally long intervals."""
    first = {key: value for key, value in given.items() if key not in ("end", "terminal_cost")}
    second = {key: value for key, value in given.items() if key != "start"}
    whole = Control(**given, duration=duration, steps=3 * steps)
    middle = {key: value for key, value in first.items() if key != "start"}
    third = duration / 3
    return whole, Phases(*(Control(**part, duration=third, steps=steps) for part in (first, middle, second)))


def driven(form: str) -> dict:
    """A driven oscillator, in Lagrangian, Hamiltonian or first-order form."""
    u, t = control("u"), time()
    k, r = parameters(k=2, r=0.5)
    common = {"cost": r * u**2 * (1 + t)}
    if form == "lagrangian":
        q, v = coordinate("q")
        return common | {
            "lagrangian": (1 + t / 9) * (v**2 / 2 - k * q**2 / 2),
            "force": {q: u * (1 + t / 5) - v / 10},
            "start": {q: 1, v: 0},
            "end": {q: 0},
            "terminal_cost": v**2,
        }
    if form == "hamiltonian":
        q, p = canonical_pair("q", "p")
        return common | {
            "hamiltonian": p**2 / 2 / (1 + t / 9) + k * q**4 / 2,
            "force": {q: u},
            "start": {q: 1, p: 0},
            "end": {q: 0, p: 0.2},
        }
    x, v = states("x v")
    return common | {
        "dynamics": {x: v + x**2 / 9, v: u - k * x * t},
        "start": {x: 1, v: 0},
        "end": {x: 0},
        "terminal_cost": v**2,
    }


SPLIT = [
    ("lagrangian", "variational", "midpoint"),
    pytest.param("lagrangian", "variational", "trapezoidal", marks=pytest.mark.slow),
    pytest.param("hamiltonian", "hamiltonian", "symplectic-euler", marks=pytest.mark.slow),
    ("hamiltonian", "hamiltonian", "stormer-verlet"),
    pytest.param("lagrangian", "hamiltonian", "midpoint", marks=pytest.mark.slow),
    pytest.param("hamiltonian", "variational", "midpoint", marks=pytest.mark.slow),
    ("first-order", "one-step", "trapezoidal"),
]


@pytest.mark.parametrize(("form", "method", "scheme"), SPLIT)
def test_phases_that_only_continue_are_one_problem(form, method, scheme):
    whole, phases = split(driven(form), 1.5, 2)
    alone = of_problem(whole, method=method, scheme=scheme).solve()
    chain = of_problem(phases, method=method, scheme=scheme).solve()
    assert (alone.status, chain.status) == ("solved", "solved")
    assert chain.cost == pytest.approx(alone.cost, rel=1e-10)
    for name in ("t", "q", "p", "u"):
        np.testing.assert_allclose(getattr(chain, name), getattr(alone, name), rtol=1e-7, atol=1e-8)


# ---- Least effort of a double integrator: linear least squares in the controls ----


def by_least_squares(rows: np.ndarray, values: list[float], weights: np.ndarray) -> float:
    """The least sum of weights z^2 such that rows z = values."""
    scaled = rows / np.sqrt(weights)
    return float(np.linalg.norm(np.linalg.lstsq(scaled, np.array(values, dtype=float), rcond=None)[0]) ** 2)


def test_way_point_at_a_given_time():
    x, v = states("x v")
    u = control("u")
    motion = {"dynamics": {x: v, v: u}, "cost": u**2, "steps": 4}
    phases = Phases(
        Control(**motion, duration=1, start={x: 0, v: 0}, end={x: 2}),
        Control(**motion, duration=0.5, end={x: 1, v: 0}),
    )
    solution = of_problem(phases).solve()
    # With the midpoint rule v gains h u on an interval, and x gains that times the time that is left in its middle.
    h = np.repeat([1 / 4, 1 / 8], 4)
    ends, middles = np.cumsum(h), np.cumsum(h) - h / 2
    rows = np.array([h * (ends <= 1) * (1 - middles), h * (1.5 - middles), h])
    assert solution.status == "solved"
    assert solution.iterations == 1
    assert solution.cost == pytest.approx(by_least_squares(rows, [2, 1, 0], h), rel=1e-12)
    assert solution.q[4, 0] == pytest.approx(2, abs=1e-12)


def test_an_impulse_at_the_switch_is_a_free_parameter_of_the_jump():
    x, v = states("x v")
    u, impulse = control("u"), free_parameter("impulse", 0)
    (price,) = parameters(price=0.3)
    motion = {"dynamics": {x: v, v: u}, "cost": u**2, "steps": 3}
    phases = Phases(
        Control(**motion, duration=1, start={x: 0, v: 0}, terminal_cost=price * impulse**2),
        Control(**motion, duration=2, end={x: 1, v: 0}),
        jumps=[{v: v + impulse}],
    )
    solution = of_problem(phases).solve()
    h = np.repeat([1 / 3, 2 / 3], 3)
    middles = np.cumsum(h) - h / 2
    rows = np.array([[*(h * (3 - middles)), 2.0], [*h, 1.0]])
    assert solution.status == "solved"
    assert solution.cost == pytest.approx(by_least_squares(rows, [1, 0], np.append(h, 0.3)), rel=1e-12)


# ---- Everything at once, against SLSQP on programs written out by hand ----

N = 4


def mixed() -> Phases:
    """Three first-order phases with time, free lengths, a coast, path conditions, bounds, a jump, costs on the way."""
    x, v = states("x v")
    (u, w), t = controls("u w"), time()
    d, a = parameters(d=0.7, a=0.3)
    T1, T3 = free_parameter("T1", 1.0, lower=0.2, upper=3), free_parameter("T3", 1.0, lower=0.3)
    first = Control(
        dynamics={x: v + w, v: u + sin(t) - v / 10},
        cost=u**2 + w**2,
        duration=T1,
        start={x: 0, v: 0},
        end={x: 0.5},
        end_conditions=[v >= 0.3],
        terminal_cost=v**2 / 5 + T1,
        path=[u + w <= 1.2],
        bounds={v: (None, 0.9), u: (-1, 1)},
        steps=N,
    )
    coast = Control(dynamics={x: v, v: cos(t) - a * x}, cost=x**2, duration=d, path=[x <= 1.02], steps=N)
    last = Control(
        dynamics={x: v, v: 2 * u + t / 4},
        cost=u**2,
        duration=T3,
        path=[u >= -0.6, u - v <= 0.9],
        bounds={x: (0.1, None)},
        end={x: 2, v: 0},
        terminal_cost=T3**2 / 2,
        steps=N,
    )
    return Phases(first, coast, last, jumps=[{v: 0.8 * v - x / 10}, {}])


@pytest.fixture(scope="module")
def mixed_module() -> types.ModuleType:
    return of_problem(mixed())


def mixed_reference() -> tuple[float, dict[str, np.ndarray]]:
    variables = Variables(x1=(N + 1, 2), u1=(N, 2), x2=(N + 1, 2), x3=(N + 1, 2), u3=(N, 1), T=(2,))
    parts = variables.parts
    d, a = 0.7, 0.3

    def equations(z):
        p = parts(z)
        T1, T3 = p["T"]
        x, v = p["x1"][-1]
        return np.concatenate(
            [
                midpoint_steps(
                    p["x1"], p["u1"], T1 / N, 0.0, lambda x, u, t: (x[1] + u[1], u[0] + np.sin(t) - x[1] / 10)
                ),
                midpoint_steps(p["x2"], np.zeros((N, 0)), d / N, T1, lambda x, u, t: (x[1], np.cos(t) - a * x[0])),
                midpoint_steps(p["x3"], p["u3"], T3 / N, T1 + d, lambda x, u, t: (x[1], 2 * u[0] + t / 4)),
                p["x1"][0],
                [x - 0.5],
                p["x2"][0] - np.array([x, 0.8 * v - x / 10]),
                p["x3"][0] - p["x2"][-1],
                p["x3"][-1] - np.array([2, 0]),
            ]
        )

    def inequalities(z):
        p = parts(z)
        (T1, T3), (u, w), u3 = p["T"], p["u1"].T, p["u3"][:, 0]
        v3 = (p["x3"][1:, 1] + p["x3"][:-1, 1]) / 2
        lengths = [0.3 - p["x1"][-1, 1], 0.2 - T1, T1 - 3, 0.3 - T3]
        walls = [p["x1"][1:, 1] - 0.9, p["x2"][1:, 0] - 1.02, 0.1 - p["x3"][:-1, 0]]
        return np.concatenate([lengths, *walls, u + w - 1.2, u - 1, -1 - u, -0.6 - u3, u3 - v3 - 0.9])

    def cost(z):
        p = parts(z)
        T1, T3 = p["T"]
        middle = (p["x2"][1:, 0] + p["x2"][:-1, 0]) / 2
        running = T1 / N * np.sum(p["u1"] ** 2) + d / N * np.sum(middle**2) + T3 / N * np.sum(p["u3"] ** 2)
        return running + p["x1"][-1, 1] ** 2 / 5 + T1 + T3**2 / 2

    line = np.linspace(0, 1, N + 1)[:, None]
    start = variables.flat(x1=line * [0.5, 0.5], x2=[0.7, 0.5], x3=0.7 + line * [1.3, 0], u1=0.1, u3=0.1, T=1.0)
    least_cost, z = least(cost, equations, inequalities, start)
    return least_cost, parts(z)


@pytest.mark.slow
def test_first_order_phases_against_an_independent_program(mixed_module):
    cost, found = mixed_reference()
    solution = mixed_module.solve()
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(cost, rel=1e-9)
    T1, T3 = found["T"]
    np.testing.assert_allclose(solution.t[[N, 2 * N, 3 * N]], [T1, T1 + 0.7, T1 + 0.7 + T3], rtol=1e-6)
    # The node at a switch holds the values before the jump.
    states_found = np.concatenate([found["x1"], found["x2"][1:], found["x3"][1:]])
    np.testing.assert_allclose(solution.q, states_found, atol=1e-6)
    np.testing.assert_allclose(solution.u[:N], found["u1"], atol=1e-6)
    assert not solution.u[N : 2 * N].any()


def test_layout_in_time(mixed_module):
    assert mixed_module.metadata.phases == 3
    for steps in (1, 7, 49):
        grid = mixed_module.make_grid(steps)
        assert grid.steps == 3 * steps
        guess = mixed_module.initial_guess(grid)
        t = mixed_module.unpack(grid, guess)[0]
        assert t.shape == (3 * steps + 1,)
        np.testing.assert_allclose(np.diff(t), np.repeat([1.0, 0.7, 1.0], steps) / steps, rtol=1e-12)
    with pytest.raises(ValueError, match=r"steps is 2\.5"):
        mixed_module.make_grid(2.5)


def test_bounds_at_switches(mixed_module):
    grid = mixed_module.make_grid(2)
    lower, upper = (mixed_module.views(grid, side)[0][0] for side in mixed_module.variable_bounds(grid))
    infinite = np.inf
    # x: given at both ends, bounded in the last phase and at the switch before it, where it does not jump.
    np.testing.assert_array_equal(lower[:, 0], [-infinite] * 4 + [0.1] * 2 + [-infinite])
    # v: bounded in the first phase, at whose end it is free.
    np.testing.assert_array_equal(upper[:, 1], [infinite, 0.9, 0.9] + [infinite] * 4)
    lower, _ = (mixed_module.views(grid, side)[1][0] for side in mixed_module.variable_bounds(grid))
    slacks = [mixed_module.metadata.interval.index(name) for name in ("s_1", "s_2")]
    # Every phase has one inequality at least, and the last one has two.
    np.testing.assert_array_equal(lower[:, slacks[0]], [0.0] * 6)
    np.testing.assert_array_equal(lower[:, slacks[1]], [-infinite] * 4 + [0.0] * 2)


def test_derivatives_of_the_whole_problem(mixed_module):
    grid = mixed_module.make_grid(2)
    generator = np.random.default_rng(3)
    z = mixed_module.initial_guess(grid) + 0.3 * generator.uniform(-1, 1, grid.is_multiplier.size)
    z = mixed_module.with_pinned_values(grid, z)
    primal, multipliers = mixed_module.primal_unknowns(grid), mixed_module.multiplier_unknowns(grid)
    step = np.zeros(z.size)
    step[primal] = 1e-6 * generator.uniform(-1, 1, primal.size)

    def change(function):
        return (function(grid, z + step) - function(grid, z - step)) / 2

    def product(entries, size):
        return np.bincount(entries[0], entries[2] * step[primal][entries[1]], minlength=size)

    slope = point.cost_gradient(grid, z) @ step[primal]
    assert change(point.cost) == pytest.approx(slope, rel=1e-6, abs=1e-14)
    rows = product(point.jacobian(grid, z), multipliers.size)
    np.testing.assert_allclose(change(point.constraints), rows, rtol=1e-5, atol=1e-13)
    rows = product(point.hessian(grid, z), primal.size)
    np.testing.assert_allclose(change(point.stationarity), rows, rtol=1e-5, atol=1e-12)


def test_a_path_inequality_is_shown_in_the_phases_that_have_it(mixed_module):
    result = api.solve(mixed_module)
    shown = {one.name: one for one in inequalities(mixed_module, result)}
    assert set(shown) == {"u + w <= 1.2", "x <= 1.02", "u >= -0.6", "u - v <= 0.9"}
    switches = [result.summary["switch_1"], result.summary["switch_2"]]
    assert np.all(shown["u + w <= 1.2"].t < switches[0])
    assert np.all((shown["x <= 1.02"].t > switches[0]) & (shown["x <= 1.02"].t <= switches[1]))
