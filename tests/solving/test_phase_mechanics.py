"""Switches of mechanical systems, momenta that match velocities there; the gallery's problems of phases."""

from __future__ import annotations

import numpy as np
import pytest
from interpreted import of_problem
from phases_reference import Variables, least
from scipy.optimize import minimize
from sympy import cos

from codegen import (
    Control,
    Phases,
    canonical_pair,
    control,
    controls,
    coordinate,
    coordinates,
    free_parameter,
    parameters,
)
from codegen.show import figures
from codegen.show.figures.quantities import quantities
from codegen.solving import api
from codegen.solving.warm_start import transferred

N = 4


def arm() -> Phases:
    """Two coupled links, one of which drops a load, at a place and with a velocity that are limited there."""
    (a, b), (da, db) = coordinates("a b")
    m1, m2, c, k = parameters(m1=1.5, m2=0.8, c=0.4, k=0.6)
    T1 = free_parameter("T1", 0.8, lower=0.3, upper=2)
    f, g = controls("f g")

    def motion(m) -> dict:
        energy = (m * da**2 * (1 + c * cos(b)) + db**2 + da * db) / 2 - k * a**2 / 2
        return {"lagrangian": energy, "force": {a: f, b: g - db / 5}, "cost": f**2 + g**2, "steps": N}

    first = Control(
        **motion(m1),
        duration=T1,
        start={a: 0, b: 0, da: 0, db: 0},
        end={b: 0.4},
        end_conditions=[da <= 0.5],
        terminal_cost=db**2 / 4 + T1,
    )
    second = Control(**motion(m2), duration=0.6, end={a: 0.5, b: 0, da: 0})
    return Phases(first, second, jumps=[{db: -db / 2 + da / 10, a: a - 0.1}])


def arm_reference() -> tuple[float, dict[str, np.ndarray]]:
    """The discrete Euler-Lagrange equations of the midpoint rule, and the momenta on both sides of the switch."""
    variables = Variables(qa=(N + 1, 2), ua=(N, 2), w=(2,), qb=(N + 1, 2), ub=(N, 2), T=(1,))
    mass, c, k = (1.5, 0.8), 0.4, 0.6

    def momentum(i, q, v):
        return np.array([mass[i] * v[0] * (1 + c * np.cos(q[1])) + v[1] / 2, v[1] + v[0] / 2])

    def momenta(i, q, u, h):
        middle, v = (q[1:] + q[:-1]).T / 2, (q[1:] - q[:-1]).T / h
        push = [u[:, 0] - k * middle[0], u[:, 1] - v[1] / 5 - mass[i] * v[0] ** 2 * c * np.sin(middle[1]) / 2]
        half = h / 2 * np.array(push)
        return (momentum(i, middle, v) - half).T, (momentum(i, middle, v) + half).T

    def equations(z):
        p = variables.parts(z)
        w = p["w"]
        left, right = momenta(0, p["qa"], p["ua"], p["T"][0] / N)
        left_after, right_after = momenta(1, p["qb"], p["ub"], 0.6 / N)
        after = np.array([w[0], -w[1] / 2 + w[0] / 10])
        return np.concatenate(
            [
                p["qa"][0],
                left[0],
                (left[1:] - right[:-1]).ravel(),
                right[-1] - momentum(0, p["qa"][-1], w),
                p["qb"][0] - p["qa"][-1] + np.array([0.1, 0]),
                left_after[0] - momentum(1, p["qb"][0], after),
                (left_after[1:] - right_after[:-1]).ravel(),
                [p["qa"][-1, 1] - 0.4],
                p["qb"][-1] - np.array([0.5, 0]),
                # At the end da is zero, so that the momenta are db/2 and db.
                [right_after[-1, 0] - right_after[-1, 1] / 2],
            ]
        )

    def inequalities(z):
        p = variables.parts(z)
        return np.array([p["w"][0] - 0.5, 0.3 - p["T"][0], p["T"][0] - 2])

    def cost(z):
        p = variables.parts(z)
        effort = p["T"][0] / N * np.sum(p["ua"] ** 2) + 0.6 / N * np.sum(p["ub"] ** 2)
        return effort + p["w"][1] ** 2 / 4 + p["T"][0]

    line = np.linspace(0, 1, N + 1)[:, None]
    start = variables.flat(qa=line * [0.3, 0.4], qb=[0.2, 0.4] + line * [0.3, -0.4], T=0.8)
    least_cost, z = least(cost, equations, inequalities, start)
    return least_cost, variables.parts(z)


@pytest.fixture(scope="module")
def arm_solution():
    return of_problem(arm()).solve()


def test_lagrangian_phases_against_an_independent_program(arm_solution):
    cost, found = arm_reference()
    solution = arm_solution
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(cost, rel=1e-9)
    np.testing.assert_allclose(solution.q, np.concatenate([found["qa"], found["qb"][1:]]), atol=1e-6)
    # Momenta at the switch are those before it, of the velocity w.
    w = found["w"]
    before = [1.5 * w[0] * (1 + 0.4 * np.cos(0.4)) + w[1] / 2, w[1] + w[0] / 2]
    np.testing.assert_allclose(solution.p[N], before, atol=1e-6)


def test_midpoint_rules_of_both_methods_agree_on_lagrangian_phases(arm_solution):
    solutions = [arm_solution, of_problem(arm(), method="hamiltonian").solve()]
    assert [solution.status for solution in solutions] == ["solved"] * 2
    assert solutions[0].cost == pytest.approx(solutions[1].cost, rel=1e-10)
    np.testing.assert_allclose(solutions[0].q, solutions[1].q, atol=1e-8)


@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_a_jump_of_the_momentum_is_one_of_the_velocity(method):
    m, e = 1.5, 0.8
    f, T = control("f"), free_parameter("T", 0.4, lower=0.05)
    costs = []
    for form in ("lagrangian", "hamiltonian"):
        y, rate = coordinate("y") if form == "lagrangian" else canonical_pair("y", "p")
        energy = m * rate**2 / 2 - 9.81 * m * y if form == "lagrangian" else rate**2 / 2 / m + 9.81 * m * y
        motion = {form: energy, "force": {y: f}, "cost": f**2, "steps": 4}
        phases = Phases(
            Control(**motion, duration=T, start={y: 1, rate: 0}, end={y: 0}),
            Control(**motion, duration=0.4, end={y: 0.9, rate: 0}),
            jumps=[{rate: -e * rate}],
        )
        solution = of_problem(phases, method=method).solve()
        assert solution.status == "solved", solution.message
        costs.append(solution.cost)
    assert costs[0] == pytest.approx(costs[1], rel=1e-10)


# ---- The gallery, whose discrete optima are compared with those by CasADi and IPOPT in test_gallery ----


def test_two_stage_rocket_against_its_closed_form(interpreted):
    exact = 568.6954317577531
    module = interpreted("two_stage_rocket")
    errors = []
    for steps in (5, 10):
        solution = module.solve(steps)
        assert solution.status == "solved", solution.message
        errors.append(exact + solution.cost)
        # Both stages burn at full thrust: for c fuel / F.
        np.testing.assert_allclose(solution.t[[steps, 2 * steps]], [92 / 3, 92 / 3 + 65], rtol=1e-8)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.05)


def effort(a: float, b: float, T: float) -> float:
    """Least integral of the squared acceleration: a is the distance beyond that of the first velocity, b its change."""
    return 12 * a * a / T**3 - 12 * a * b / T**2 + 4 * b * b / T


def test_bouncing_ball_against_its_closed_form(interpreted):
    g, e, f = 9.81, 0.8, 0.7

    def total(z):
        T_1, T_2, dy, dx, x = z
        fall = effort(g * T_1**2 / 2 - 1, dy + g * T_1, T_1) + effort(x, dx, T_1)
        rise = effort(0.9 + g * T_2**2 / 2 + e * dy * T_2, e * dy + g * T_2, T_2)
        return fall + rise + effort(1 - x - f * dx * T_2, -f * dx, T_2)

    found = minimize(total, [0.45, 0.43, -4.5, 1.0, 0.5], method="BFGS", options={"gtol": 1e-7})
    assert found.fun == pytest.approx(17.27107933, rel=1e-8)
    module = interpreted("bouncing_ball")
    errors = []
    for steps in (5, 10):
        solution = module.solve(steps)
        assert solution.status == "solved", solution.message
        errors.append(solution.cost - found.fun)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.05)
    assert solution.t[10] == pytest.approx(found.x[0], abs=4e-3)
    assert solution.p[10, 1] == pytest.approx(found.x[2], abs=0.05)


def test_warm_start_from_a_coarser_grid(interpreted):
    module = interpreted("bouncing_ball")
    coarse, cold = (api.solve(module, steps=steps) for steps in (4, 8))
    warm = api.solve(module, steps=8, warm=coarse.unknowns)
    assert (coarse.steps, cold.steps, warm.steps) == (4, 8, 8)
    assert (cold.status, warm.status) == ("solved", "solved")
    assert warm.cost == pytest.approx(cold.cost, rel=1e-10)
    assert warm.summary["switch_1"] == pytest.approx(warm.t[8])
    np.testing.assert_allclose(transferred(module, warm.unknowns, 8), warm.unknowns, atol=1e-12)


def test_figure(interpreted):
    module = interpreted("two_stage_rocket")
    result = api.solve(module, steps=5)
    found = quantities(module, result)
    m, thrust = found["state"][2], found["control"][0]
    assert (m.jumps, found["state"][0].jumps) == ((5,), ())
    np.testing.assert_allclose(thrust.upper[:, 0], [0.06] * 5 + [0.012] * 5 + [np.inf] * 5)
    assert np.isnan(thrust.values[:, 0]).tolist() == [False] * 10 + [True] * 5
    figure = figures.control_figure(module, result)
    axes = next(axes for axes in figure.axes if axes.get_ylabel() == "$m$")
    assert [line.get_xdata().size for line in axes.lines[:2]] == [6, 10]
