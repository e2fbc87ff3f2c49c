"""Controls that are linear between nodes: exact optima, orders, regularity, bounds, interpolation, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from interpreted import of_problem
from scipy.integrate import quad_vec, solve_bvp
from scipy.linalg import expm
from sympy import sin

import codegen
from codegen import Control, Phases, Simulate, control, coordinate, free_parameter, states
from codegen.discretise import schemes
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.transcribe import transcribe
from codegen.emit.naming import Choices
from codegen.errors import ArgumentError, SchemeError
from codegen.evidence.checks import CHECKS
from codegen.evidence.checks.base import Context
from codegen.runtime.record import Sites


def double_integrator(is_first_order: bool) -> Control:
    """A unit mass from rest to rest with the least effort: f = 6 - 12 t is linear, and J* = 12."""
    f = control("f")
    if is_first_order:
        x, v = states("x v")
        motion = {"dynamics": {x: v, v: f}}
    else:
        x, v = coordinate("x")
        motion = {"lagrangian": v**2 / 2, "force": {x: f}}
    return Control(**motion, cost=f**2, duration=1, start={x: 0, v: 0}, end={x: 1, v: 0})


SYSTEM, INPUT, DURATION = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([0.0, 1.0]), 2.0
FREE = expm(SYSTEM * DURATION) @ [1.0, 0.0]
"""The oscillator x'' = -x + u, and the end of the free motion from (1, 0)."""


def oscillator(is_first_order: bool) -> Control:
    """From (1, 0) to rest at 0 in time 2 with the least effort."""
    u = control("u")
    if is_first_order:
        x, v = states("x v")
        motion = {"dynamics": {x: v, v: u - x}}
    else:
        x, v = coordinate("x")
        motion = {"lagrangian": (v**2 - x**2) / 2, "force": {x: u}}
    return Control(**motion, cost=u**2 / 2, duration=DURATION, start={x: 1, v: 0}, end={x: 0, v: 0})


def pushed(t: float) -> np.ndarray:
    """The end of the motion after a unit impulse at a time."""
    return expm(SYSTEM * (DURATION - t)) @ INPUT


def least_effort() -> tuple[np.ndarray, float]:
    """The multipliers a of the optimum u(t) = -a . pushed(t), and its cost: those of the Gramian."""
    gramian = quad_vec(lambda t: np.outer(pushed(t), pushed(t)), 0.0, DURATION, epsabs=1e-13)[0]
    a = np.linalg.solve(gramian, FREE)
    return a, float(FREE @ a / 2.0)


def least_effort_of_lines(steps: int) -> tuple[np.ndarray, float]:
    """The values at nodes and the cost of the best control that is linear on intervals, with the exact motion."""
    h = DURATION / steps
    mass, ends = np.zeros((steps + 1, steps + 1)), np.zeros((2, steps + 1))
    for k in range(steps):
        mass[k : k + 2, k : k + 2] += h / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
        share = quad_vec(lambda c, k=k: np.outer(pushed((k + c) * h), [1.0 - c, c]), 0.0, 1.0, epsabs=1e-13)[0]
        ends[:, k : k + 2] += h * share
    response = np.linalg.solve(mass, ends.T)
    u = -response @ np.linalg.solve(ends @ response, FREE)
    return u, float(u @ mass @ u / 2.0)


def optimum(problem: Control, steps: int, method: str, scheme: str, controls: str = "linear"):
    solution = of_problem(problem, method=method, scheme=scheme, controls=controls).solve(steps, tolerance=1e-12)
    assert solution.status == "solved", solution.message
    return solution


HIGH = [
    ("variational", "gauss-4"), ("variational", "gauss-6"), ("variational", "lobatto-4"),
    ("hamiltonian", "gauss-4"), ("hamiltonian", "radau-5"), ("hamiltonian", "lobatto-4"), ("hamiltonian", "rk4"),
    ("one-step", "gauss-6"), ("one-step", "radau-3"), ("one-step", "radau-5"), ("one-step", "sdirk-4"),
    ("one-step", "hermite-simpson"), ("one-step", "rk4"), ("one-step", "2-steps-of-rk4"),
    ("one-step", "dormand-prince-5"),
]  # fmt: skip


@pytest.mark.parametrize(("method", "scheme"), HIGH)
@pytest.mark.parametrize("steps", [1, 3, 8])
def test_a_linear_optimum_is_exact_on_every_grid(method, scheme, steps):
    solution = optimum(double_integrator(method == "one-step"), steps, method, scheme)
    assert solution.cost == pytest.approx(12.0, rel=1e-12)
    np.testing.assert_allclose(solution.u[:, 0], 6.0 - 12.0 * solution.t, atol=1e-10)
    np.testing.assert_allclose(solution.q[:, 0], 3.0 * solution.t**2 - 2.0 * solution.t**3, atol=1e-12)


@pytest.mark.parametrize(("method", "scheme", "order"), [
    ("variational", "gauss-6", 6), ("hamiltonian", "gauss-6", 6), ("one-step", "gauss-8", 8),
    ("one-step", "2-steps-of-rk4", 4),
])  # fmt: skip
def test_optima_approach_those_of_an_exact_first_order_hold(method, scheme, order):
    """On one grid, at the order of the scheme, while the control of the continuous problem is approached at order 2."""
    errors = []
    for steps in (3, 6):
        u, cost = least_effort_of_lines(steps)
        solution = optimum(oscillator(method == "one-step"), steps, method, scheme)
        errors.append((np.abs(solution.u[:, 0] - u).max(), abs(solution.cost - cost) / cost))
    (coarse, coarse_cost), (fine, fine_cost) = errors
    assert np.log2(coarse / fine) > order - 1.2  # values at nodes weigh the first moment of an interval
    assert np.log2(coarse_cost / fine_cost) > order - 0.5
    assert fine < 1e-2 * least_effort_of_lines(6)[0][-1] * (1.0 / 3.0) ** (order - 2)


@pytest.mark.parametrize(("method", "scheme", "order"), [
    ("variational", "trapezoidal", 2), ("variational", "gauss-4", 4), ("hamiltonian", "stormer-verlet", 2),
    ("hamiltonian", "rk4", 4), ("one-step", "radau-3", 3), ("one-step", "hermite-simpson", 4), ("one-step", "rk4", 4),
    ("one-step", "yoshida-4", 4),
])  # fmt: skip
def test_orders_of_cost_and_control(method, scheme, order):
    a, cost = least_effort()
    errors = []
    for steps in (8, 16):
        solution = optimum(oscillator(method == "one-step"), steps, method, scheme)
        exact = np.array([-a @ pushed(t) for t in solution.t])
        errors.append((abs(solution.cost - cost), np.abs(solution.u[:, 0] - exact).max()))
    (coarse, coarse_u), (fine, fine_u) = errors
    assert np.log2(coarse / fine) > order - 0.35
    assert np.log2(coarse_u / fine_u) == pytest.approx(2.0, abs=0.35)


def test_constant_controls_have_a_cost_of_order_two():
    _, cost = least_effort()
    found = {c: optimum(oscillator(False), 16, "variational", "gauss-4", c).cost - cost for c in ("interval", "linear")}
    assert 0.0 < 100.0 * found["linear"] < found["interval"]


def pendulum() -> Control:
    """A pendulum that is raised against gravity, at a cost of effort and of its angle."""
    x, v = states("x v")
    u = control("u")
    return Control(
        dynamics={x: v, v: u - sin(x)}, cost=u**2 + x**2, duration=3, start={x: 0, v: 0}, end={x: 2, v: 0}, steps=12,
        guess={x: 0.5},
    )  # fmt: skip


def test_a_nonlinear_optimum_is_that_of_the_maximum_principle():
    # H = u^2 + x^2 + a v + b (u - sin x): u = -b/2.
    def rates(t, y):
        x, v, a, b, _ = y
        return np.array([v, -b / 2.0 - np.sin(x), -2.0 * x + b * np.cos(x), -a, b**2 / 4.0 + x**2])

    def ends(start, end):
        return np.array([start[0], start[1], end[0] - 2.0, end[1], start[4]])

    exact = solve_bvp(rates, ends, np.linspace(0.0, 3.0, 60), np.zeros((5, 60)), tol=1e-10, max_nodes=50000)
    assert exact.success
    errors = []
    for steps in (16, 32):
        solution = optimum(pendulum(), steps, "one-step", "gauss-4")
        u = -exact.sol(solution.t)[3] / 2.0
        errors.append((abs(solution.cost - exact.y[4, -1]), np.abs(solution.u[:, 0] - u).max()))
    assert np.log2(errors[0][0] / errors[1][0]) == pytest.approx(4.0, abs=0.3)
    assert np.log2(errors[0][1] / errors[1][1]) == pytest.approx(2.0, abs=0.2)
    assert errors[1][0] < 1e-5


@pytest.mark.parametrize(("method", "scheme"), [("variational", "gauss-4"), ("hamiltonian", "rk4")])
def test_controls_of_the_orbital_transfer_have_no_sawtooth(interpreted, method, scheme):
    module = interpreted("orbital_transfer", method=method, scheme=scheme, controls="linear")
    solutions = [module.solve(steps) for steps in (10, 20, 40)]
    assert all(solution.status == "solved" for solution in solutions)
    largest = [np.abs(np.diff(solution.u[:, 0], 2)).max() for solution in solutions]
    # Second differences of a smooth function decrease by the square of the step.
    assert largest[1] < 0.35 * largest[0]
    assert largest[2] < 0.35 * largest[1]
    assert solutions[-1].cost == pytest.approx(0.0487491711595, rel=1e-5)  # of the maximum principle, by collocation


def shortest() -> Control:
    """A unit mass from rest to rest over a unit distance in the least time with a force in [-1, 1]: T* = 2."""
    x, v = coordinate("x")
    f, T = control("f"), free_parameter("T", guess=2.5, lower=0.1)
    return Control(
        lagrangian=v**2 / 2, force={x: f}, duration=T, terminal_cost=T, start={x: 0, v: 0}, end={x: 1, v: 0},
        bounds={f: (-1, 1)}, guess={x: 0.5},
    )  # fmt: skip


@pytest.mark.parametrize(("method", "scheme"), [("variational", "gauss-4"), ("hamiltonian", "hermite-simpson")])
def test_the_least_time_of_lines(method, scheme):
    """On N = 2m intervals the force is 1, then a line to -1 over two intervals: T = 2m/sqrt(m^2 - 1/3)."""
    for m in (3, 6):
        solution = optimum(shortest(), 2 * m, method, scheme)
        assert solution.cost == pytest.approx(2.0 * m / np.sqrt(m**2 - 1.0 / 3.0), rel=1e-8)
        np.testing.assert_allclose(solution.u[:, 0], np.sign(np.arange(m, -m - 1, -1)), atol=1e-6)


def test_bounds_hold_at_nodes_and_between_them():
    problem = double_integrator(True)
    (f,) = (s for s in problem.cost.free_symbols if s.name == "f")
    module = of_problem(replace(problem, bounds={f: (-5, 4)}), scheme="gauss-4", controls="linear")
    result = codegen.solve(module, steps=8)
    assert result.solved
    assert result.u.max() == pytest.approx(4.0, abs=1e-6)
    assert result.cost > 12.0
    inside = result.controls_at(np.linspace(0.0, 1.0, 101))
    assert inside.min() >= -5.0 - 1e-7
    assert inside.max() <= 4.0 + 1e-7


def test_results_have_controls_at_nodes_and_lines_between_them():
    module = of_problem(oscillator(True), scheme="gauss-4", controls="linear")
    assert module.metadata.controls == Sites.LINEAR
    result = codegen.solve(module, steps=6, doublings=2)
    np.testing.assert_array_equal(result.control_times, result.t)
    middles = 0.5 * (result.t[1:] + result.t[:-1])
    np.testing.assert_allclose(result.controls_at(middles), 0.5 * (result.u[1:] + result.u[:-1]), rtol=1e-13)
    data = result.to_dataset()
    assert data["u"].dims == ("node", "control")
    np.testing.assert_array_equal(data["u"].values, result.u)
    np.testing.assert_array_equal(result.to_frame()["u"].to_numpy(), result.u[:, 0])
    assert result.summary["observed_order"] == pytest.approx(4.0, abs=0.1)
    assert abs(result.summary["cost_extrapolated"] - least_effort()[1]) < 0.02 * abs(result.cost - least_effort()[1])
    # Figures draw a line through the nodes, not a step for each interval.
    (panel,) = (axes for axes in result.plot(panels=["u"]).figure.axes if axes.get_ylabel() == "$u$")
    assert any(np.array_equal(line.get_ydata(), result.u[:, 0]) for line in panel.get_lines())
    assert not panel.patches


def test_a_requested_accuracy_is_met_on_uneven_grids():
    module = of_problem(pendulum(), scheme="gauss-4", controls="linear")
    result = codegen.solve(module, steps=6, accuracy=1e-4)
    fine = codegen.solve(module, steps=160)
    assert result.solved
    assert result.grid is not None
    assert result.cost == pytest.approx(fine.cost, rel=1e-4)


@pytest.mark.parametrize(("method", "scheme", "has_cost"), [
    ("variational", "trapezoidal", True), ("variational", "gauss-4", True), ("hamiltonian", "stormer-verlet", True),
    ("one-step", "rk4", True), ("one-step", "radau-3", True),
    ("variational", "trapezoidal", False), ("variational", "gauss-4", False), ("hamiltonian", "rk4", False),
])  # fmt: skip
def test_checks_find_no_null_mode(method, scheme, has_cost):
    model = normalise(oscillator(method == "one-step") if has_cost else shortest())
    program = transcribe(model, scheme, method, "linear")
    context = Context(Choices(scheme, method, "linear"), model, program, schemes.find(scheme, method), None)
    (finding,) = CHECKS["null controls"].findings(context)
    assert finding.passed
    assert finding.subject == f"linear control {'u' if has_cost else 'f'}"
    assert ("seen by the cost" if has_cost else "the motion sees the alternating control") in finding.detail
    assert all(finding.passed for finding in CHECKS["discrete equations"].findings(context))


@pytest.mark.parametrize(("method", "scheme"), [
    ("variational", "midpoint"), ("variational", "rectangle"), ("hamiltonian", "midpoint"),
    ("hamiltonian", "symplectic-euler"), ("hamiltonian", "position-verlet"), ("hamiltonian", "alpha-1/3"),
    ("one-step", "midpoint"), ("one-step", "explicit-euler"), ("one-step", "implicit-euler"),
])  # fmt: skip
def test_schemes_that_leave_an_end_value_undetermined_are_refused(method, scheme):
    model = normalise(oscillator(method == "one-step"))
    with pytest.raises(SchemeError, match=rf"'{scheme}'.*both end values of a linear control; use --scheme .*gauss-4"):
        transcribe(model, scheme, method, "linear")


def test_repeated_midpoint_steps_determine_both_end_values():
    for method in ("hamiltonian", "one-step"):
        solution = optimum(oscillator(method == "one-step"), 10, method, "2-steps-of-midpoint")
        assert solution.cost == pytest.approx(least_effort()[1], rel=0.02)


def test_refusals():
    x, v = states("x v")
    u = control("u")
    one = Control(dynamics={x: v, v: u}, cost=u**2, duration=1, start={x: 1, v: 0}, steps=2)
    with pytest.raises(ArgumentError, match="several phases has its controls on intervals"):
        transcribe(normalise(Phases(one, replace(one, start={}, end={x: 0}))), "gauss-4", controls="linear")
    late = Control(
        dynamics={x: v, v: u - x.delayed(1)}, cost=u**2, duration=3, start={x: 1, v: 0}, end={x: 0}, history={x: 1}
    )
    with pytest.raises(ArgumentError, match="controls at nodes beside delays"):
        transcribe(normalise(late), "gauss-4", controls="linear")
    motion = Simulate(dynamics={x: v, v: -x}, duration=1, start={x: 1, v: 0})
    with pytest.raises(ArgumentError, match="a simulation has no controls"):
        transcribe(normalise(motion), "gauss-4", controls="linear")
